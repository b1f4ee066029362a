"""Random keys outside of compiled code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np


def split_keys(key: jax.Array, count: int) -> Callable[[Any], jax.Array]:
    """Return the function that picks from ``count`` new keys, by any index of NumPy's.

    They are those of `jax.random.split`. To pick some of these would compile a program for each shape.

    Example:
        >>> picked = split_keys(jax.random.key(0), 3)
        >>> bool((picked(1) == jax.random.split(jax.random.key(0), 3)[1]).all())
        True
    """
    data, kind = np.asarray(jax.random.key_data(jax.random.split(key, count))), jax.random.key_impl(key)
    return lambda index: jax.random.wrap_key_data(data[index], impl=kind)
