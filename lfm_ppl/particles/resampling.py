"""Resampling: from weighted particles to equally weighted ones, without bias."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp

RESAMPLING = ("systematic", "stratified", "multinomial")


def resample(key: jax.Array, weights: jax.Array, scheme: str) -> jax.Array:
    """Draw ancestors so that particle i is chosen N W_i times on average.

    The ancestors are the quantiles of the weights at N points of [0, 1): ``(i + u)/N`` with one uniform u
    (systematic), ``(i + u_i)/N`` (stratified), or N uniforms in order (multinomial). Systematic resampling adds the
    least variance, as a rule; of the other two it is known that the variance is at most that of multinomial.

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
    # Side "right" never picks a particle of weight zero, whose value equals its predecessor's.
    found = jnp.searchsorted(cumulative, points * cumulative[-1], side="right")
    last = size - 1 - jnp.argmax(weights[::-1] > 0)
    return jnp.minimum(found, last).astype(int)


def reweighted(log_weights: jax.Array, log_density: jax.Array, otherwise: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Multiply normalised weights (N,) by densities (N,); return the new weights, normalised, and the log of their sum.

    Where no particle explains what was seen the estimate is zero for good, and the particles go on with the weights
    ``otherwise``.
    """
    joint = log_weights + log_density
    total = logsumexp(joint)
    alive = jnp.isfinite(total)
    return jnp.where(alive, joint - jnp.where(alive, total, 0.0), otherwise), total


def effective_sample_size(weights: jax.Array) -> jax.Array:
    """Return 1 / sum W_i^2 of normalised weights (N,)."""
    return 1.0 / (weights**2).sum()
