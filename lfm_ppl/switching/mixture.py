"""Mixtures of Gaussians, one component a particle: what Rao-Blackwellised particles say of a number."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp, ndtr
from jax.scipy.stats import norm

from lfm_ppl import checks

_HALVINGS = 60


class Mixture(eqx.Module):
    """Distributions of D numbers at T times, each ``sum_i W_i N(mean_i, variance_i)``.

    Attributes:
        mean: (T, N, D), of the components.
        variance: (T, N, D), or (T, 1, D) where all components share it.
        log_weights: (T, N), normalised.

    Example:
        >>> import jax.numpy as jnp
        >>> two = Mixture(jnp.array([[[-1.0], [1.0]]]), jnp.ones((1, 1, 1)), jnp.log(jnp.full((1, 2), 0.5)))
        >>> mean, sd = two.moments()
        >>> round(float(mean[0, 0]), 6), round(float(sd[0, 0]), 6)
        (0.0, 1.414214)
    """

    mean: jax.Array
    variance: jax.Array
    log_weights: jax.Array

    def moments(self) -> tuple[jax.Array, jax.Array]:
        """Return mean and standard deviation (T, D)."""
        weights = jnp.exp(self.log_weights)[:, :, None]
        mean = (weights * self.mean).sum(1)
        variance = (weights * (self.variance + (self.mean - mean[:, None, :]) ** 2)).sum(1)
        return mean, jnp.sqrt(variance)

    def error(self) -> jax.Array:
        """Return the Monte Carlo error (T, D) of the mean, for particles that are independent."""
        weights = jnp.exp(self.log_weights)[:, :, None]
        mean = (weights * self.mean).sum(1, keepdims=True)
        return jnp.sqrt((weights**2 * (self.mean - mean) ** 2).sum(1))

    def log_density(self, value: Any) -> jax.Array:
        """Return the log density (T, D) of each number of ``value`` (T, D).

        NaN where that is, or where a component has no variance.
        """
        terms = norm.logpdf(jnp.asarray(checks.unmask(value), float)[:, None, :], self.mean, jnp.sqrt(self.variance))
        return logsumexp(self.log_weights[:, :, None] + terms, axis=1)

    def quantiles(self, p: Any) -> jax.Array:
        """Return the values (Q, T, D) below which the shares ``p`` (Q,) lie, by bisection.

        Raises:
            ValueError: a share that is not between zero and one.
        """
        p = np.atleast_1d(np.asarray(p, float))
        if np.any((p <= 0) | (p >= 1)):
            raise ValueError(f"p must lie between 0 and 1, got {p.tolist()}.")
        checks.finite("p", p)
        return _quantiles(self, jnp.asarray(p))


@eqx.filter_jit
def _quantiles(mixture: Mixture, p: jax.Array) -> jax.Array:
    sd = jnp.sqrt(jnp.broadcast_to(mixture.variance, mixture.mean.shape))
    weights = jnp.exp(mixture.log_weights)[:, :, None]
    # No component has a share of 1e-9 beyond six, nor of 1 - 1e-9 before.
    reach = 8.0 + jnp.sqrt(-2.0 * jnp.log(jnp.minimum(p, 1 - p).min()))
    low, high = (mixture.mean - reach * sd).min(1), (mixture.mean + reach * sd).max(1)

    def one(share: jax.Array) -> jax.Array:
        def halve(_: int, ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            middle = 0.5 * (ends[0] + ends[1])
            scale = jnp.where(sd > 0, sd, 1.0)
            away = middle[:, None, :] - mixture.mean
            below = jnp.where(sd > 0, ndtr(away / scale), (away >= 0).astype(float))
            under = (weights * below).sum(1) < share
            return jnp.where(under, middle, ends[0]), jnp.where(under, ends[1], middle)

        ends = jax.lax.fori_loop(0, _HALVINGS, halve, (low, high))
        return 0.5 * (ends[0] + ends[1])

    return jax.lax.map(one, p)
