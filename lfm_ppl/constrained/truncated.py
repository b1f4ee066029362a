"""Moments, probabilities and quantiles of a normal distribution within 0 <= f <= width, entry by entry."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri
from jax.scipy.stats import norm

from lfm_ppl.filtering.quadrature import Marginal, Tilted

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)
_DEPTH = 40.0
"""Difference between the largest log density and the log density at the ends of the quadrature."""

_UNDERFLOW = -600.0
"""Log probability below which the probability itself is not used, because it may underflow."""

_NO_LOWER_END = -1e9
"""Finite number for a lower end at minus infinity: its probability is zero, and so are its derivatives."""


def truncated_moments(cavity: Marginal, width: jax.Array | float = np.inf) -> Tilted:
    """Return log P(0 <= f <= width), and the mean and variance of f in this interval, for f ~ N(cavity).

    The moments are quadratures about the mode b. With d = b - m, the density of f = b + x is proportional to
    exp(-(d x + x^2 / 2) / v). Nothing cancels, even if the mean m is far outside or the interval is narrow.

    Args:
        cavity: mean m and variance v.
        width: upper end, infinity for none.
    """
    m, v = cavity
    has_upper_end, width = _finite_width(m, width)
    mode = jnp.maximum(m, 0.0)
    mode = jnp.where(has_upper_end, jnp.minimum(mode, width), mode)
    d = mode - m
    root = jnp.sqrt(d**2 + 2.0 * _DEPTH * v)
    reach = 2.0 * _DEPTH * v / (root + jnp.abs(d))
    up = jnp.where(has_upper_end, jnp.minimum(reach, width - mode), reach)
    down = jnp.minimum(reach, mode)
    node_axis = (slice(None),) + (None,) * jnp.ndim(m)
    half_length = 0.5 * (up + down)
    x = half_length * jnp.asarray(_NODES)[node_axis] + 0.5 * (up - down)
    density = jnp.asarray(_WEIGHTS)[node_axis] * jnp.exp(-(d + 0.5 * x) * x / v)
    total = density.sum(0)
    mean = (density * x).sum(0) / total
    variance = (density * (x - mean) ** 2).sum(0) / total
    log_probability = log_share(cavity, width=jnp.where(has_upper_end, width, jnp.inf))
    return Tilted(log_probability, mode + mean, variance, d + mean)


def _finite_width(m: jax.Array, width: jax.Array | float) -> tuple[jax.Array, jax.Array]:
    """Return whether there is an upper end, and the width, 1 instead of infinity, for derivatives without NaN."""
    width = jnp.broadcast_to(jnp.asarray(width, float), jnp.shape(m))
    has_upper_end = jnp.isfinite(width)
    return has_upper_end, jnp.where(has_upper_end, width, 1.0)


def _standardised_ends(cavity: Marginal, width: jax.Array | float) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Return the ends a < b of the interval in standard deviations, mirrored at zero if a + b > 0.

    The normal distribution function is accurate in its lower tail.

    Returns:
        a, b, whether they are mirrored, and the standard deviation.
    """
    sd = jnp.sqrt(cavity.variance)
    has_upper_end, width = _finite_width(cavity.mean, width)
    a, b = -cavity.mean / sd, (width - cavity.mean) / sd
    is_mirrored = ~has_upper_end | (a + b > 0)
    low = jnp.where(is_mirrored, jnp.where(has_upper_end, -b, _NO_LOWER_END), a)
    return low, jnp.where(is_mirrored, -a, b), is_mirrored, sd


def log_share(cavity: Marginal, width: jax.Array | float = np.inf) -> jax.Array:
    """Return log P(0 <= f <= width) for f ~ N(cavity)."""
    low, high, _, _ = _standardised_ends(cavity, width)
    is_half_line = low <= _NO_LOWER_END
    log_high = norm.logcdf(high)
    # On a half line, -1 is a number whose derivatives are finite for any upper end.
    log_ratio = jnp.where(is_half_line, -1.0, norm.logcdf(jnp.where(is_half_line, -1.0, low)) - log_high)
    return log_high + jnp.where(is_half_line, 0.0, jnp.log(-jnp.expm1(log_ratio)))


def quantile(cavity: Marginal, width: jax.Array | float, share: jax.Array | float) -> jax.Array:
    """Return the quantile of f ~ N(cavity) given 0 <= f <= width for the probability ``share``.

    If the interval is so far in the tail that its probability underflows, the distribution is treated as exponential.
    """
    low, high, is_mirrored, sd = _standardised_ends(cavity, width)
    share = jnp.where(is_mirrored, 1.0 - jnp.asarray(share), share)
    log_high, is_half_line = norm.logcdf(high), low <= _NO_LOWER_END
    log_low = jnp.where(is_half_line, -jnp.inf, norm.logcdf(jnp.where(is_half_line, high - 1.0, low)))
    ratio = jnp.exp(jnp.where(is_half_line, 0.0, log_low - log_high))
    log_fraction = jnp.log(share + (1.0 - share) * jnp.where(is_half_line, 0.0, ratio))
    log_cdf = log_high + log_fraction
    has_quantile = log_cdf > _UNDERFLOW
    z = jnp.where(has_quantile, ndtri(jnp.exp(jnp.where(has_quantile, log_cdf, -1.0))),
                  high + log_fraction / jnp.where(high < 0, -high, 1.0))
    z = jnp.clip(z, low, high)
    value = jnp.where(is_mirrored, cavity.mean - sd * z, cavity.mean + sd * z)
    has_upper_end, finite_width = _finite_width(cavity.mean, width)
    value = jnp.maximum(value, 0.0)
    return jnp.where(has_upper_end, jnp.minimum(value, finite_width), value)
