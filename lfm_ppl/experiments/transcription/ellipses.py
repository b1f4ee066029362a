"""The ellipses of elliptical slice sampling: of the prior, as in the source, or of a Gaussian like the posterior.

A posterior proportional to N(u; 0, C) L(u) is also proportional to N(u; m, P) L(u)/l(u) where N(u; m, P) is the
posterior of a Gaussian likelihood l(u) = N(y; H u + b, S). Slices of L/l on ellipses of that Gaussian leave the same
posterior invariant, and the nearer l is to L the farther a step goes.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.experiments.transcription import problem
from lfm_ppl.latent_grid.latent_grid import LatentGrid
from lfm_ppl.particles.normals import normals

RULE = "riemann"
"""Integration rule, the source's."""

_USED = 10
"""One in so many of the kept draws serves to find the Gaussian."""

_OUTPUTS = problem.OBSERVED * problem.GENES


class Gaussian(NamedTuple):
    """A Gaussian like the posterior of a data set, and the likelihood l that makes it from the prior.

    Attributes:
        slope: (39, 363), H.
        residual: (39,), y - b.
        noise_root: (39, 39), lower triangular factor of S.
        mean: (363,), m.
        gain: (363, 39), C H' (H C H' + S)^-1.
    """

    slope: Any
    residual: Any
    noise_root: Any
    mean: Any
    gain: Any


class Point(NamedTuple):
    """A force, and H times it, so that l costs no product of matrices at each point of an ellipse."""

    force: jax.Array
    linear: jax.Array


class Ellipses(NamedTuple):
    """How to slice.

    Attributes:
        point: from a force to its `Point`.
        log_ratio: log L of a point, or log L/l.
        draw: from a random key to a draw of the prior, or of the Gaussian.
        mean: of the prior, or of the Gaussian.
    """

    point: Callable[[jax.Array], Point]
    log_ratio: Callable[[Point], jax.Array]
    draw: Callable[[jax.Array], Point]
    mean: Point


def on_grid(link: str, gamma: Any, rates: problem.Rates) -> LatentGrid:
    """Return the model of a data set with its force on the grid."""
    return LatentGrid(problem.system(link, gamma, rates), problem.TIMES, problem.GRID, RULE)


def around(latent: LatentGrid, y: jax.Array, gaussian: Gaussian | None) -> Ellipses:
    """Return the ellipses of a Gaussian; without one, those of the prior."""
    def prior_draw(key: jax.Array) -> jax.Array:
        white = normals(key, 2, (problem.POINTS + 1) // 2).ravel()[: problem.POINTS]
        return latent.root[0] @ white

    if gaussian is None:
        nothing = jnp.zeros(0)
        return Ellipses(lambda u: Point(u, nothing), lambda point: latent.log_likelihood(point.force[None], y),
                        lambda key: Point(prior_draw(key), nothing), Point(jnp.zeros(problem.POINTS), nothing))

    def log_ratio(point: Point) -> jax.Array:
        z = jax.scipy.linalg.solve_triangular(gaussian.noise_root, gaussian.residual - point.linear, lower=True)
        return latent.log_likelihood(point.force[None], y) + 0.5 * z @ z

    def draw(key: jax.Array) -> Point:
        """Return a draw by Matheron's rule: one of the prior, corrected by its observation."""
        first, second = jax.random.split(key)
        u = prior_draw(first)
        noisy = gaussian.slope @ u + gaussian.noise_root @ normals(second, 2, (_OUTPUTS + 1) // 2).ravel()[:_OUTPUTS]
        u = u + gaussian.gain @ (gaussian.residual - noisy)
        return Point(u, gaussian.slope @ u)

    return Ellipses(lambda u: Point(u, gaussian.slope @ u), log_ratio, draw,
                    Point(gaussian.mean, gaussian.slope @ gaussian.mean))


def resembling(latent: LatentGrid, y: jax.Array, draws: jax.Array) -> Gaussian:
    """Return the Gaussian of the posterior linearisation over draws (S, 363).

    H is the mean Jacobian of the expression x(u) at the observation times, b the mean of x(u) - H u, and S the
    observation noise and the covariance of x(u) - H u.
    """
    def output(u: jax.Array) -> jax.Array:
        return latent.state(u[None]).ravel()

    slope = jax.lax.map(jax.jacrev(output), draws).mean(axis=0)
    rest = jax.vmap(output)(draws) - draws @ slope.T
    offset = rest.mean(axis=0)
    spread = (rest - offset).T @ (rest - offset) / len(draws)
    noise = spread + problem.NOISE**2 * jnp.eye(_OUTPUTS)
    across = latent.root[0] @ (slope @ latent.root[0]).T
    gain = jnp.linalg.solve(slope @ across + noise, across.T).T
    residual = y.ravel() - offset
    return Gaussian(slope, residual, jnp.linalg.cholesky(noise), gain @ residual, gain)


@functools.cache
def program(link: str) -> Callable:
    """Return `resembling` for many data sets, compiled: gamma, rates, observations, draws (N, S, 363) -> Gaussians."""
    def one(gamma: jax.Array, rates: problem.Rates, y: jax.Array, draws: jax.Array) -> Gaussian:
        return resembling(on_grid(link, gamma, rates), y, draws[::_USED])

    return jax.jit(jax.vmap(one, in_axes=(None, 0, 0, 0)))


def shapes(count: int) -> tuple:
    """Return the shapes of gamma, and of rates, observations and Gaussians of ``count`` data sets."""
    of = lambda *shape: jax.ShapeDtypeStruct((count, *shape), float)  # noqa: E731
    return (jax.ShapeDtypeStruct((), float), problem.Rates(*[of(problem.GENES)] * 4),
            of(problem.OBSERVED, problem.GENES),
            Gaussian(of(_OUTPUTS, problem.POINTS), of(_OUTPUTS), of(_OUTPUTS, _OUTPUTS), of(problem.POINTS),
                     of(problem.POINTS, _OUTPUTS)))
