"""Marginals of the predictor, and cavities: marginals without the entry's own factor."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.backward import SmoothedPredictor
from lfm_ppl.filtering.ep.quadrature import MeanVariance
from lfm_ppl.filtering.update import Factors
from lfm_ppl.utils.linalg import diagonal

_DOMINANT_SITE = 0.5
"""Share of the marginal's precision from its own factor, above which the cavity is taken from leave-one-out terms."""


class FactorMarginals(NamedTuple):
    """Marginals of the predictor (T, D), with and without an entry's factor.

    Attributes:
        cavity: without the factor (to its power).
        marginal: with it.
        valid: whether both have a positive variance.
        deterministic: whether the predictor has no variance: it has no factor, and its term is log p at its mean.
    """

    cavity: MeanVariance
    marginal: MeanVariance
    valid: jax.Array
    deterministic: jax.Array


def cavities(predictor: SmoothedPredictor, factors: Factors, present: jax.Array, power: float) -> FactorMarginals:
    """Remove an entry's own factor, to a power, from its marginal.

    With s = 1 - a tau v the cavity has the variance v / s and, from c, the mean (m - a v nu) / s. Where a factor
    outweighs all other information these are differences of nearly equal numbers, and the leave-one-out terms of the
    smoother, s = C / tau and the mean (nu - u / s) / tau, are not.

    Args:
        predictor: smoothed, (T, ...).
        factors: (T, D) each.
        present: (T, D).
        power: a.
    """
    m, v = predictor.mean - factors.centre, diagonal(predictor.covariance)
    nu, tau = factors.nu, factors.tau
    deterministic = is_deterministic(predictor.mean, jnp.abs(v))
    v = jnp.where(deterministic, placeholder_variance(predictor.mean), v)
    share = jnp.where(deterministic, 0.0, power * tau * v)
    is_dominant = (share > _DOMINANT_SITE) & (power == 1.0)
    safe_tau = jnp.where(is_dominant, tau, 1.0)
    remaining = jnp.where(is_dominant, diagonal(predictor.precision) / safe_tau, 1.0 - share)
    valid = (remaining > 0) & (v > 0) & jnp.isfinite(m)
    remaining = jnp.where(valid, remaining, 1.0)
    mean = jnp.where(is_dominant, (nu - predictor.score / remaining) / safe_tau, (m - power * v * nu) / remaining)
    mean = jnp.where(deterministic, m, mean)
    v = jnp.where(valid, v, 1.0)
    marginal = MeanVariance(jnp.where(valid, predictor.mean, 0.0), v)
    cavity = MeanVariance(jnp.where(valid, factors.centre + mean, 0.0), v / remaining)
    return FactorMarginals(cavity, marginal, valid | ~present, deterministic)


def is_deterministic(mean: jax.Array, variance: jax.Array) -> jax.Array:
    """Return whether a predictor has no variance, or a standard deviation below the spacing of numbers at its mean."""
    info = jnp.finfo(variance.dtype)
    # The derivative of 1 / variance must not overflow.
    return variance <= (8.0 * info.eps * mean) ** 2 + float(info.tiny) ** (1.0 / 3.0)


def placeholder_variance(mean: jax.Array) -> jax.Array:
    """Return the variance with which a deterministic predictor goes through a quadrature that is not used."""
    return jax.lax.stop_gradient(1e-20 * (1e-6 + mean**2))


def with_positive_variance(mean: jax.Array, variance: jax.Array) -> MeanVariance:
    """Return mean and variance, with a placeholder for the variance of a deterministic predictor."""
    return MeanVariance(mean, jnp.where(is_deterministic(mean, variance), placeholder_variance(mean), variance))


def is_valid(predictor: SmoothedPredictor, cavity: FactorMarginals) -> jax.Array:
    """Return whether a sweep is finite and every entry has a cavity."""
    return jnp.isfinite(predictor.mean).all() & jnp.isfinite(predictor.covariance).all() & cavity.valid.all()


def clip_to_proper(factors: Factors) -> Factors:
    """Return the factors of positive precision, under which every entry has a cavity; the others become empty."""
    return factors._replace(nu=jnp.where(factors.tau > 0, factors.nu, 0.0), tau=jnp.maximum(factors.tau, 0.0))
