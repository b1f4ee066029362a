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
"""By how much the log density has fallen from its largest value at the ends of the quadrature."""
_UNDERFLOW = -600.0
"""Logarithm of a probability from which its exponential is not used."""


def truncated_moments(cavity: Marginal, width: jax.Array | float = np.inf) -> Tilted:
    """Return log P(0 <= f <= width), and mean and variance of f there, for f ~ N(cavity).

    The moments are integrals from the mode b, with d = b - m the density of f = b + x is in proportion to
    exp(-(d x + x^2 / 2) / v): nothing cancels, however far outside the mean m is and however narrow the interval.

    Args:
        cavity: mean m and variance v.
        width: upper end, infinity for none.
    """
    m, v = cavity
    bounded, width = _bounded(m, width)
    mode = jnp.maximum(m, 0.0)
    mode = jnp.where(bounded, jnp.minimum(mode, width), mode)
    d = mode - m
    far = jnp.sqrt(d**2 + 2.0 * _DEPTH * v)
    up, down = (2.0 * _DEPTH * v / (far + jnp.abs(d)) for _ in range(2))
    up = jnp.where(bounded, jnp.minimum(up, width - mode), up)
    down = jnp.minimum(down, mode)
    lead = (slice(None),) + (None,) * jnp.ndim(m)
    half = 0.5 * (up + down)
    x = half * jnp.asarray(_NODES)[lead] + 0.5 * (up - down)
    density = jnp.asarray(_WEIGHTS)[lead] * jnp.exp(-(d + 0.5 * x) * x / v)
    total = density.sum(0)
    mean = (density * x).sum(0) / total
    variance = (density * (x - mean) ** 2).sum(0) / total
    return Tilted(log_share(cavity, width=jnp.where(bounded, width, jnp.inf)), mode + mean, variance, d + mean)


def _bounded(m: jax.Array, width: jax.Array | float) -> tuple[jax.Array, jax.Array]:
    """Return whether there is an upper end, and a width that is finite, for derivatives without NaN."""
    width = jnp.broadcast_to(jnp.asarray(width, float), jnp.shape(m))
    bounded = jnp.isfinite(width)
    return bounded, jnp.where(bounded, width, 1.0)


def _tails(cavity: Marginal, width: jax.Array | float) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Return the ends a < b of the interval in standard deviations, mirrored so that a + b <= 0, and whether they are.

    An end at minus infinity is -1e9: its probability is zero, and so are its derivatives.
    """
    sd = jnp.sqrt(cavity.variance)
    bounded, width = _bounded(cavity.mean, width)
    a, b = -cavity.mean / sd, (width - cavity.mean) / sd
    mirrored = ~bounded | (a + b > 0)
    low = jnp.where(mirrored, jnp.where(bounded, -b, -1e9), a)
    return low, jnp.where(mirrored, -a, b), mirrored, sd


def log_share(cavity: Marginal, width: jax.Array | float = np.inf) -> jax.Array:
    """Return log P(0 <= f <= width) for f ~ N(cavity)."""
    low, high, _, _ = _tails(cavity, width)
    none = low <= -1e9
    log_high = norm.logcdf(high)
    # Where there is no lower end, a number whose derivatives are finite however far the upper one is.
    below = jnp.where(none, -1.0, norm.logcdf(jnp.where(none, -1.0, low)) - log_high)
    return log_high + jnp.where(none, 0.0, jnp.log(-jnp.expm1(below)))


def quantile(cavity: Marginal, width: jax.Array | float, share: jax.Array | float) -> jax.Array:
    """Return the quantile of f ~ N(cavity) given 0 <= f <= width.

    Where the interval lies so far in the tail that its probability underflows, the distribution is an exponential one.
    """
    low, high, mirrored, sd = _tails(cavity, width)
    share = jnp.where(mirrored, 1.0 - jnp.asarray(share), share)
    log_high, none = norm.logcdf(high), low <= -1e9
    log_low = jnp.where(none, -jnp.inf, norm.logcdf(jnp.where(none, high - 1.0, low)))
    ratio = jnp.exp(jnp.where(none, 0.0, log_low - log_high))
    inside = jnp.log(share + (1.0 - share) * jnp.where(none, 0.0, ratio))
    tail = log_high + inside
    ordinary = tail > _UNDERFLOW
    z = jnp.where(ordinary, ndtri(jnp.exp(jnp.where(ordinary, tail, -1.0))),
                  high + inside / jnp.where(high < 0, -high, 1.0))
    # The mirror image of the tail is exact, one minus it is not.
    z = jnp.clip(z, low, high)
    value = jnp.where(mirrored, cavity.mean - sd * z, cavity.mean + sd * z)
    bounded, finite = _bounded(cavity.mean, width)
    value = jnp.maximum(value, 0.0)
    return jnp.where(bounded, jnp.minimum(value, finite), value)
