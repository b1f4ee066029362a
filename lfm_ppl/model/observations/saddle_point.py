"""Log probabilities of counts that stay accurate where the counts are large.

Terms such as y log m, m and log y! are as large as y log y, and their sum is of order one: of counts from 1e7 on, their
rounding errors exceed the tolerance of the factors. A family therefore computes

1. the log probability where the mean m is the count y, from the error e(y) of Stirling's formula,

       log y! = log(sqrt(2 pi y) (y / e)^y) + e(y),

2. the difference from there, a function of log(m / y) by `expm1`: for Poisson counts y log(m / y) - (m - y).

Source: Loader (2000), Fast and accurate computation of binomial probabilities.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln

_LARGE = 16.0
"""Smallest number for which five terms of the series of Stirling's error are exact to rounding."""

LOG_2PI = float(np.log(2.0 * np.pi))


def stirling_error(n: jax.Array) -> jax.Array:
    """Return log Gamma(n + 1) - log(sqrt(2 pi n) (n / e)^n) for n > 0."""
    is_large = n >= _LARGE
    large, small = jnp.where(is_large, n, _LARGE), jnp.where(is_large, 1.0, n)
    series, square = jnp.zeros_like(large), 1.0 / large**2
    for coefficient in (1 / 1188, -1 / 1680, 1 / 1260, -1 / 360, 1 / 12):
        series = coefficient + square * series
    return jnp.where(is_large, series / large,
                     gammaln(small + 1.0) - (small + 0.5) * jnp.log(small) + small - 0.5 * LOG_2PI)
