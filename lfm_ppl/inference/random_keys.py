"""Random keys outside of compiled code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

_FEWEST = 64
"""Keys that are made at least, so that one program serves chains, attempts and short runs."""


def split_keys(key: jax.Array, count: int) -> Callable[[Any], jax.Array]:
    """Return the function that picks from ``count`` new keys, by any index of NumPy's.

    They are those of `jax.random.split`. To pick some of these would compile a program for each shape; to split into
    numbers that differ would, too, where a power of two that is not smaller begins with the same keys.

    Example:
        >>> picked = split_keys(jax.random.key(0), 3)
        >>> bool((picked(1) == jax.random.split(jax.random.key(0), 3)[1]).all())
        True
    """
    kind = jax.random.key_impl(key)
    # Each key is then a function of its own index alone.
    by_index = (jax.config.jax_threefry_partitionable  # type: ignore[attr-defined]
                and str(kind) == "threefry2x32")
    made = max(_FEWEST, 1 << (count - 1).bit_length()) if by_index else count
    data = np.asarray(jax.random.key_data(jax.random.split(key, made)))[:count]
    return lambda index: jax.random.wrap_key_data(data[index], impl=kind)
