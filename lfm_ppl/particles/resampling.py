"""Unbiased resampling: replace weighted particles by equally weighted ones."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp

RESAMPLING = ("systematic", "stratified", "multinomial")


def resample(key: jax.Array, weights: jax.Array, scheme: str) -> jax.Array:
    """Draw the ancestors of N new particles, particle i N W_i times on average.

    The ancestors are the quantiles of the weights at N points of [0, 1): ``(i + u)/N`` with one uniform u
    (systematic), ``(i + u_i)/N`` (stratified), or N sorted uniforms (multinomial). Systematic resampling usually adds
    the least variance; stratified resampling provably adds no more than multinomial.

    Args:
        key: a JAX random key.
        weights: (N,), non-negative; they need not sum to one.
        scheme: "systematic", "stratified" or "multinomial".

    Returns:
        (N,) indices in increasing order.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> resample(jax.random.key(0), jnp.array([0.0, 1.0, 0.0, 1.0]), "systematic").tolist()
        [1, 1, 3, 3]

    Source: Douc, Cappé and Moulines (2005), Comparison of resampling schemes for particle filtering.
    """
    size = weights.shape[0]
    if scheme == "systematic":
        points = (jnp.arange(size) + jax.random.uniform(key)) / size
    elif scheme == "stratified":
        points = (jnp.arange(size) + jax.random.uniform(key, (size,))) / size
    else:
        # The order statistics of N uniforms are partial sums of N + 1 exponentials over their total.
        sums = jnp.cumsum(jax.random.exponential(key, (size + 1,)))
        points = sums[:-1] / sums[-1]
    cumulative = jnp.cumsum(weights)
    # Side "right" never picks a particle of weight zero, whose cumulative weight equals that of its predecessor.
    ancestors = jnp.searchsorted(cumulative, points * cumulative[-1], side="right")
    last = size - 1 - jnp.argmax(weights[::-1] > 0)
    return jnp.minimum(ancestors, last).astype(int)


def reweight(log_weights: jax.Array, log_density: jax.Array, fallback: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Multiply normalised weights by densities and normalise the products.

    Args:
        log_weights: (N,), logarithms of normalised weights.
        log_density: (N,), log density of the observation given each particle.
        fallback: (N,), log weights with which the particles continue where the density of all of them is zero.

    Returns:
        The new log weights (N,), and the logarithm of the sum before normalisation.
    """
    joint = log_weights + log_density
    total = logsumexp(joint)
    is_possible = jnp.isfinite(total)
    return jnp.where(is_possible, joint - jnp.where(is_possible, total, 0.0), fallback), total


def effective_sample_size(weights: jax.Array) -> jax.Array:
    """Return 1 / sum W_i^2 of normalised weights (N,)."""
    return 1.0 / (weights**2).sum()
