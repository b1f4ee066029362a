"""Where sites of observations or constraints do not converge near the draws, and what weights are worth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood
from lfm_ppl.inference.posterior import each, over_draws
from lfm_ppl.model.observations.family import ObservationFamily

POINTS = 100
"""At which it is tried."""

_OF_WEIGHTS = 25
"""Draws at which weights are looked at."""


class SiteFailures(NamedTuple):
    """How often sites do not converge or there is no likelihood, at draws or a step away from them.

    Attributes:
        points: at which it was tried.
        unconverged: of them, where sites do not converge.
        impossible: of them, where the likelihood is zero, for that reason or another.
    """

    points: int
    unconverged: int
    impossible: int


class PathsWorth(NamedTuple):
    """How many of the weighted trajectories count in the evidence under constraints, at draws of the parameters.

    Attributes:
        trajectories: that are weighted.
        median: what they are worth at half of the draws.
        least: at the worst draw.
    """

    trajectories: int
    median: float
    least: float


def site_failures(bound: BoundModel, z: np.ndarray, seed: int = 0, points: int = POINTS) -> SiteFailures | None:
    """Try the likelihood where a sampler would look next: at draws plus scaled differences of two others.

    At draws themselves the likelihood is never zero, for a point where it is gets rejected, and sites that do not
    converge at a draw often do not converge beside it. The differences are those of differential evolution,
    z_i + 2.38 / sqrt(2 d) (z_j - z_k), which have the shape of the posterior.

    Args:
        bound: the model and its data.
        z: draws (C, S, d) of the unconstrained parameters.
        seed: of the choice of draws.
        points: at which to try.

    Returns:
        Counts; None for a model of Gaussian observations without constraints, which has no sites.

    Source: ter Braak (2006), Statistics and Computing 16.
    """
    if not _has_sites(bound) or not z.size:
        return None
    flat = z.reshape(-1, z.shape[-1])
    first, second, third = np.random.default_rng(seed).integers(len(flat), size=(3, points))
    near = flat[first] + 2.38 / np.sqrt(2.0 * flat.shape[1]) * (flat[second] - flat[third])
    return failures_at(bound, bound.constrain_draws(near), points)


def failures_at(bound: BoundModel, values: Mapping[str, Any], most: int = POINTS) -> SiteFailures | None:
    """Try the likelihood at values of the sites, name -> (S, ...), or at ``most`` of them; None as above."""
    if not _has_sites(bound):
        return None

    def one(distribution: MarginalLikelihood, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        if distribution.constrained:
            problem = distribution.bounded()
            return problem.converged(y), jnp.isfinite(problem.log_likelihood(y, distribution.draws))
        found = distribution.evidence(y)
        return found.refined.found.converged, jnp.isfinite(found.log_evidence)

    def per_draw(values: Any, key: jax.Array, y: Any) -> tuple[jax.Array, jax.Array]:
        return each(bound.likelihood(values, y), one, bound.data(y))

    chosen = _spread(values, most)
    converged, possible = over_draws(bound, "convergence of the sites", per_draw, chosen, jax.random.key(0),
                                     bound.times.size)
    every = lambda known: np.asarray(known).reshape(known.shape[0], -1).all(axis=1)  # noqa: E731
    return SiteFailures(len(converged), int((~every(converged)).sum()), int((~every(possible)).sum()))


def paths_worth(bound: BoundModel, values: Mapping[str, Any], most: int = _OF_WEIGHTS) -> PathsWorth | None:
    """Return what weighted trajectories are worth at values of the sites, name -> (S, ...), or ``most`` of them.

    None without constraints, and where the evidence under constraints is that of expectation propagation alone.
    """
    example = bound.site.example
    if not example.constrained or not example.draws:
        return None

    def per_draw(values: Any, key: jax.Array, y: Any) -> jax.Array:
        distribution = bound.likelihood(values, y)
        return distribution.bounded().effective_sample_size(bound.data(y), distribution.draws)

    found = over_draws(bound, "weights of trajectories", per_draw, _spread(values, most), jax.random.key(0),
                       bound.times.size)
    return PathsWorth(example.draws, float(np.median(found)), float(found.min()))


def _has_sites(bound: BoundModel) -> bool:
    example = bound.site.example
    return example.constrained or isinstance(example.ssm.model.observation, ObservationFamily)


def _spread(values: Mapping[str, Any], most: int) -> dict[str, np.ndarray]:
    """Return at most so many draws, evenly spread."""
    count = len(next(iter(values.values())))
    chosen = np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))
    return {name: np.asarray(value)[chosen] for name, value in values.items()}
