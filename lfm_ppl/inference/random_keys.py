"""Random keys outside of compiled code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

_FEWEST = 64
"""Smallest number of keys that is made: one program serves chains, attempts and short runs."""


def split_keys(key: jax.Array, count: int) -> Callable[[Any], jax.Array]:
    """Return the function that picks from ``count`` new keys, by any index of NumPy's.

    They are those of `jax.random.split`. JAX compiles a program for each number of keys, so they are split into a power
    of two, which begins with the same keys, and picked by NumPy.

    Example:
        >>> picked = split_keys(jax.random.key(0), 3)
        >>> bool((picked(1) == jax.random.split(jax.random.key(0), 3)[1]).all())
        True
    """
    kind = jax.random.key_impl(key)
    # Each key is then a function of its own index alone.
    by_index = (jax.config.jax_threefry_partitionable  # type: ignore[attr-defined]
                and str(kind) == "threefry2x32")
    count = int(count)  # NumPy's integers have no bit_length
    made = max(_FEWEST, 1 << (count - 1).bit_length()) if by_index else count
    data = np.asarray(jax.random.key_data(jax.random.split(key, made)))[:count]
    return lambda index: jax.random.wrap_key_data(data[index], impl=kind)
