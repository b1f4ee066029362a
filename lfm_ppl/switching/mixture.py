"""Mixtures of Gaussians with one component for each Rao-Blackwellised particle."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp, ndtr
from jax.scipy.stats import norm

from lfm_ppl.utils import checks
from lfm_ppl.utils.programs import shared_jit

_HALVINGS = 60
"""Bisection steps of a quantile; each halves the bracket."""


class Mixture(eqx.Module):
    """Marginal distributions ``sum_i W_i N(mean_i, variance_i)`` of D quantities at T times.

    Attributes:
        mean: (T, N, D), means of the components.
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
        """Return means and standard deviations (T, D)."""
        weights = jnp.exp(self.log_weights)[:, :, None]
        mean = (weights * self.mean).sum(1)
        variance = (weights * (self.variance + (self.mean - mean[:, None, :]) ** 2)).sum(1)
        return mean, jnp.sqrt(variance)

    def error(self) -> jax.Array:
        """Return the Monte Carlo standard errors (T, D) of the means, for independent particles."""
        weights = jnp.exp(self.log_weights)[:, :, None]
        mean = (weights * self.mean).sum(1, keepdims=True)
        return jnp.sqrt((weights**2 * (self.mean - mean) ** 2).sum(1))

    def log_density(self, value: Any) -> jax.Array:
        """Return the log densities (T, D) of the entries of ``value`` (T, D).

        NaN for a NaN entry, and for a component with variance zero.
        """
        terms = norm.logpdf(jnp.asarray(checks.unmask(value), float)[:, None, :], self.mean, jnp.sqrt(self.variance))
        return logsumexp(self.log_weights[:, :, None] + terms, axis=1)

    def quantiles(self, p: Any) -> jax.Array:
        """Return the quantiles (Q, T, D) for the probabilities ``p`` (Q,), by bisection.

        Raises:
            ValueError: a probability that is not between zero and one.
        """
        p = np.atleast_1d(np.asarray(p, float))
        if np.any((p <= 0) | (p >= 1)):
            raise ValueError(f"p must lie between 0 and 1, got {p.tolist()}.")
        checks.finite("p", p)
        return _quantiles(self, jnp.asarray(p))


@shared_jit
def _quantiles(mixture: Mixture, p: jax.Array) -> jax.Array:
    sd = jnp.sqrt(jnp.broadcast_to(mixture.variance, mixture.mean.shape))
    weights = jnp.exp(mixture.log_weights)[:, :, None]
    # A Gaussian has a probability below q beyond sqrt(-2 log q) standard deviations; 8 more are a margin.
    reach = 8.0 + jnp.sqrt(-2.0 * jnp.log(jnp.minimum(p, 1 - p).min()))
    low, high = (mixture.mean - reach * sd).min(1), (mixture.mean + reach * sd).max(1)

    def quantile(probability: jax.Array) -> jax.Array:
        def halve(_: int, bracket: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            low, high = bracket
            middle = 0.5 * (low + high)
            scale = jnp.where(sd > 0, sd, 1.0)
            difference = middle[:, None, :] - mixture.mean
            # A component without variance is a step.
            component_cdf = jnp.where(sd > 0, ndtr(difference / scale), (difference >= 0).astype(float))
            is_below = (weights * component_cdf).sum(1) < probability
            return jnp.where(is_below, middle, low), jnp.where(is_below, high, middle)

        lower, upper = jax.lax.fori_loop(0, _HALVINGS, halve, (low, high))
        return 0.5 * (lower + upper)

    return jax.lax.map(quantile, p)
