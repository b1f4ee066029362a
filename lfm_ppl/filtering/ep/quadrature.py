"""Moments of a Gaussian times a function of one variable, entry by entry."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

_RANGE = 6.0
"""Nodes of a rule are x = sinh(a u) / a at equal steps of u in [-6, 6]."""

_NODES, _STRETCH = 48, 0.5
"""Number of nodes and a of the rule, which reaches to 20 standard deviations on either side."""

_COARSE_NODES, _COARSE_STRETCH = 24, 0.25
"""The same of a coarse rule to 8.5 standard deviations, as exact where the product is nearly Gaussian."""

_LARGEST_SUM = 8
"""Number of entries up to which a sum is cheaper than a call of XLA's matrix product."""

_LOG_2PI = float(np.log(2.0 * np.pi))


class MeanVariance(NamedTuple):
    """Means and variances of independent Gaussians, arrays of one shape."""

    mean: jax.Array
    variance: jax.Array


class TiltedMoments(NamedTuple):
    """Moments of tilted distributions N(f; m, v) p(f) / Z, arrays of one shape.

    Attributes:
        log_partition: log Z.
        mean: E[f].
        variance: Var[f].
        shift: E[f] - m, which a difference of the means would lose where the cavity is narrow.
    """

    log_partition: jax.Array
    mean: jax.Array
    variance: jax.Array
    shift: jax.Array


def _rule(count: int = _NODES, stretch: float = _STRETCH) -> tuple[np.ndarray, np.ndarray]:
    u = np.linspace(-_RANGE, _RANGE, count)
    return np.sinh(stretch * u) / stretch, np.log((u[1] - u[0]) * np.cosh(stretch * u))


def tilted_moments(log_function: Callable[[jax.Array], jax.Array], cavity: MeanVariance, centre: MeanVariance,
                   is_coarse: bool = False) -> TiltedMoments:
    """Return log Z, mean and variance of N(f; m, v) p(f) by quadrature about the product.

    The trapezoidal rule in u with f = centre.mean + centre.sd sinh(a u) / a: its nodes are dense in the middle and
    reach 20 standard deviations, so that one rule serves products that are narrow, skew, and heavy in the tails.

    Args:
        log_function: log p, of nodes (J, ...), entry by entry.
        cavity: m and v.
        centre: location and width of the product; its own moments are best.
        is_coarse: use half of the nodes, to 8.5 standard deviations.

    Source: Mori and Sugihara (2001), Journal of Computational and Applied Mathematics 127.
    """
    cavity, centre = jax.lax.optimization_barrier((cavity, centre))
    nodes, log_mass = _log_masses(log_function, cavity, centre, is_coarse)
    # The barriers keep XLA from computing the moments again at each node, and the function in each sum, 4 times slower;
    # so does a table of 2 axes.
    log_mass = jax.lax.optimization_barrier(log_mass.reshape(len(nodes), -1))
    largest = jax.lax.optimization_barrier(jax.lax.stop_gradient(log_mass.max(0)))
    mass = jnp.exp(log_mass - jnp.where(jnp.isfinite(largest), largest, 0.0))
    powers = jnp.stack([jnp.ones_like(nodes), nodes, nodes**2])
    if mass.shape[1] > _LARGEST_SUM:
        total, first, second = powers @ jax.lax.optimization_barrier(mass)
    else:
        total, first, second = (powers[:, :, None] * mass).sum(1)
    is_positive = total > 0
    total = jnp.where(is_positive, total, 1.0)
    middle = first / total
    log_total, middle, spread = (part.reshape(cavity.mean.shape) for part in (
        jnp.where(is_positive, largest + jnp.log(total), -jnp.inf), middle, second / total - middle**2))
    log_partition = log_total + 0.5 * (jnp.log(centre.variance / cavity.variance) - _LOG_2PI)
    offset = jnp.sqrt(centre.variance) * middle
    return TiltedMoments(log_partition, centre.mean + offset, centre.variance * spread,
                         (centre.mean - cavity.mean) + offset)


def _log_masses(log_function: Callable[[jax.Array], jax.Array], cavity: MeanVariance, centre: MeanVariance,
                is_coarse: bool) -> tuple[jax.Array, jax.Array]:
    """Return the nodes x (J,) and the log masses (J, ...) of N(f; m, v) p(f) at centre.mean + centre.sd x."""
    nodes, log_weights = map(jnp.asarray, _rule(_COARSE_NODES, _COARSE_STRETCH) if is_coarse else _rule())
    shape = (len(nodes),) + (1,) * jnp.ndim(cavity.mean)
    half, distance = -0.5 / cavity.variance, jnp.sqrt(centre.variance) * nodes.reshape(shape)
    # Rounding a node must not enter its distance from the cavity's mean: a narrow cavity would be rounding errors.
    log_mass = (log_weights.reshape(shape) + half * ((centre.mean - cavity.mean) + distance) ** 2
                + log_function(centre.mean + distance))
    # Not a number is no mass: a link that overflows far out.
    return nodes, jnp.where(jnp.isnan(log_mass), -jnp.inf, log_mass)


def expectations(function: Callable[[jax.Array], jax.Array],
                 gaussian: MeanVariance) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return E g under f ~ N(m, v), and its derivatives by the mean and by the variance.

    They are derivatives of the quadrature itself.
    """
    value, pullback = jax.vjp(lambda m, v: expectation(function, MeanVariance(m, v)), *gaussian)
    return value, *pullback(jnp.ones_like(value))


def expectation(function: Callable[[jax.Array], jax.Array], gaussian: MeanVariance) -> jax.Array:
    """Return E g under f ~ N(m, v), entry by entry; ``function`` takes nodes (J, ...)."""
    nodes, log_weights = _rule()
    shares = np.exp(log_weights - 0.5 * nodes**2)
    shape = (_NODES,) + (1,) * jnp.ndim(gaussian.mean)
    x, weights = (jnp.asarray(part).reshape(shape) for part in (nodes, shares / shares.sum()))
    value = function(gaussian.mean + jnp.sqrt(gaussian.variance) * x)
    return (weights * jnp.where(weights > 1e-30, value, 0.0)).sum(0)
