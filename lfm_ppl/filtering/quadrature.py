"""Moments of a Gaussian times a function of one variable, entry by entry."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

_END = 6.0
"""Of a rule: nodes x = sinh(a u) / a at equal steps of u in [-6, 6]."""

_NODES, _STRETCH = 48, 0.5
"""Of the rule, which reaches to 20 standard deviations on either side."""

_ROUGH_NODES, _ROUGH_STRETCH = 24, 0.25
"""Of one to 8.5: as exact where the product is nearly Gaussian, and no match for one that is far from it."""

_FEW = 8
"""Entries up to which a sum is cheaper than a call of XLA's matrix product."""

_once = jax.lax.optimization_barrier

_LOG_2PI = float(np.log(2.0 * np.pi))


class Marginal(NamedTuple):
    """Means and variances, of one shape: an entry each."""

    mean: jax.Array
    variance: jax.Array


class Tilted(NamedTuple):
    """What a tilted distribution N(f; m, v) p(f) / Z is like, an entry each.

    Attributes:
        log_partition: log Z.
        mean: of f.
        variance: of f.
        shift: the mean less that of the cavity; a difference of the two means loses it where the cavity is narrow.
    """

    log_partition: jax.Array
    mean: jax.Array
    variance: jax.Array
    shift: jax.Array


def _rule(count: int = _NODES, stretch: float = _STRETCH) -> tuple[np.ndarray, np.ndarray]:
    u = np.linspace(-_END, _END, count)
    return np.sinh(stretch * u) / stretch, np.log((u[1] - u[0]) * np.cosh(stretch * u))


def tilted_moments(log_function: Callable[[jax.Array], jax.Array], cavity: Marginal, near: Marginal,
                   rough: bool = False) -> Tilted:
    """Return log Z, mean and variance of N(f; m, v) p(f) by quadrature, about where the product is.

    The trapezoidal rule in u with f = near.mean + near.sd sinh(a u) / a: its nodes are dense in the middle and reach
    20 standard deviations, so that one rule serves products that are narrow, skew, and heavy in the tails.

    Args:
        log_function: log p, of nodes (J, ...), entry by entry.
        cavity: m and v.
        near: about where the product is, and how wide; its own moments are best.
        rough: half of the nodes, to 8.5 standard deviations.

    Source: Mori and Sugihara (2001), Journal of Computational and Applied Mathematics 127.
    """
    cavity, near = _once((cavity, near))
    nodes, log_mass = _log_masses(log_function, cavity, near, rough)
    # The barriers keep XLA from computing the moments again at each node, and the function in each sum, 4 times slower;
    # so does a table of 2 axes.
    log_mass = _once(log_mass.reshape(len(nodes), -1))
    largest = _once(jax.lax.stop_gradient(log_mass.max(0)))
    mass = jnp.exp(log_mass - jnp.where(jnp.isfinite(largest), largest, 0.0))
    powers = jnp.stack([jnp.ones_like(nodes), nodes, nodes**2])
    if mass.shape[1] > _FEW:
        total, first, second = powers @ _once(mass)
    else:
        total, first, second = (powers[:, :, None] * mass).sum(1)
    possible = total > 0
    total = jnp.where(possible, total, 1.0)
    middle = first / total
    log_total, middle, spread = (part.reshape(cavity.mean.shape) for part in (
        jnp.where(possible, largest + jnp.log(total), -jnp.inf), middle, second / total - middle**2))
    log_partition = log_total + 0.5 * (jnp.log(near.variance / cavity.variance) - _LOG_2PI)
    moved = jnp.sqrt(near.variance) * middle
    return Tilted(log_partition, near.mean + moved, near.variance * spread, (near.mean - cavity.mean) + moved)


def _log_masses(log_function: Callable[[jax.Array], jax.Array], cavity: Marginal, near: Marginal,
                rough: bool) -> tuple[jax.Array, jax.Array]:
    """Return the nodes x (J,), and the logarithm (J, ...) of the mass of N(f; m, v) p(f) at near.mean + near.sd x."""
    nodes, log_weights = map(jnp.asarray, _rule(_ROUGH_NODES, _ROUGH_STRETCH) if rough else _rule())
    lead = (len(nodes),) + (1,) * jnp.ndim(cavity.mean)
    half, distance = -0.5 / cavity.variance, jnp.sqrt(near.variance) * nodes.reshape(lead)
    # Rounding a node must not enter its distance from the cavity's mean: a narrow cavity would be rounding errors.
    log_mass = (log_weights.reshape(lead) + half * ((near.mean - cavity.mean) + distance) ** 2
                + log_function(near.mean + distance))
    # Not a number is no mass: a link that overflows far out.
    return nodes, jnp.where(jnp.isnan(log_mass), -jnp.inf, log_mass)


def tilted_shape(log_function: Callable[[jax.Array], jax.Array], cavity: Marginal,
                 near: Marginal) -> tuple[jax.Array, jax.Array]:
    """Return skewness and excess kurtosis of N(f; m, v) p(f), both zero for a Gaussian; arguments as above."""
    nodes, log_mass = _log_masses(log_function, cavity, near, False)
    share = jax.nn.softmax(log_mass, axis=0)
    x = nodes.reshape((-1,) + (1,) * (share.ndim - 1))
    away = x - (share * x).sum(0)
    variance = (share * away**2).sum(0)
    return (share * away**3).sum(0) / variance**1.5, (share * away**4).sum(0) / variance**2 - 3.0


def expectations(function: Callable[[jax.Array], jax.Array], about: Marginal) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return E g, and the derivatives of it by the mean and by the variance, under f ~ N(m, v), by the same rule.

    The derivatives are those of the quadrature itself.
    """
    value, back = jax.vjp(lambda m, v: expectation(function, Marginal(m, v)), *about)
    return value, *back(jnp.ones_like(value))


def expectation(function: Callable[[jax.Array], jax.Array], about: Marginal) -> jax.Array:
    """Return E g under f ~ N(m, v), entry by entry; ``function`` takes nodes (J, ...)."""
    nodes, log_weights = _rule()
    shares = np.exp(log_weights - 0.5 * nodes**2)
    lead = (_NODES,) + (1,) * jnp.ndim(about.mean)
    x, weights = (jnp.asarray(part).reshape(lead) for part in (nodes, shares / shares.sum()))
    value = function(about.mean + jnp.sqrt(about.variance) * x)
    return (weights * jnp.where(weights > 1e-30, value, 0.0)).sum(0)
