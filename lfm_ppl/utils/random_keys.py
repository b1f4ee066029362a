"""Random keys: one key for each purpose, and keys outside of compiled code.

A key is split once, where it is consumed, and not used again. `jax.random.fold_in` with a small integer gives no other
keys: with JAX's partitionable keys ``fold_in(key, i)`` equals ``split(key, n)[i]``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import jax
import numpy as np

_FEWEST = 64
"""Smallest number of split keys, so that one program serves chains, attempts and short runs."""


def split_by_name(key: jax.Array, names: Iterable[str]) -> dict[str, jax.Array]:
    """Split a key into one key for each name, in compiled code too.

    Example:
        >>> keys = split_by_name(jax.random.key(0), ("path", "noise"))
        >>> list(keys)
        ['path', 'noise']
    """
    names = tuple(names)
    return dict(zip(names, jax.random.split(key, len(names)), strict=True))


def split_keys(key: jax.Array, count: int) -> Callable[[Any], jax.Array]:
    """Return a function from an index, as NumPy takes it, to the keys of ``jax.random.split(key, count)``.

    JAX compiles a program for each number of keys. The key is therefore split into a power of two, whose first keys
    are the same, and NumPy selects from them.

    Example:
        >>> keys = split_keys(jax.random.key(0), 3)
        >>> bool((keys(1) == jax.random.split(jax.random.key(0), 3)[1]).all())
        True
    """
    kind = jax.random.key_impl(key)
    # With partitionable keys, each key depends on its index only.
    is_partitionable = (jax.config.jax_threefry_partitionable  # type: ignore[attr-defined]
                        and str(kind) == "threefry2x32")
    count = int(count)  # NumPy's integers have no bit_length
    split_count = max(_FEWEST, 1 << (count - 1).bit_length()) if is_partitionable else count
    data = np.asarray(jax.random.key_data(jax.random.split(key, split_count)))[:count]
    return lambda index: jax.random.wrap_key_data(data[index], impl=kind)
