"""Diagnostics of likelihoods with factors: where factors do not converge, and how many weighted trajectories count."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import jax
import numpy as np

from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.draw_batches import DrawFunction, map_draws
from lfm_ppl.inference.trajectories import evenly_spaced
from lfm_ppl.likelihoods.constrained_likelihood import ConstrainedLikelihood

POINTS = 100
"""Points at which the likelihood is evaluated."""

_WEIGHT_DRAWS = 25
"""Draws at which the weights of trajectories are computed."""


@dataclass(frozen=True)
class FactorFailures:
    """Counts of points at which factors do not converge or the likelihood is zero.

    Attributes:
        points: number of points.
        unconverged: points at which factors do not converge.
        impossible: points at which the likelihood is zero, for that reason or another.
    """

    points: int
    unconverged: int
    impossible: int


@dataclass(frozen=True)
class PathESS:
    """Effective sample size of the weighted trajectories in the evidence under constraints, over posterior draws.

    Attributes:
        trajectories: number of weighted trajectories.
        median: median of their effective sample size.
        least: smallest effective sample size.
    """

    trajectories: int
    median: float
    least: float


def factor_failures(bound: BoundModel, z: np.ndarray, seed: int = 0) -> FactorFailures | None:
    """Evaluate the likelihood at proposals of a sampler: draws plus scaled differences of two other draws.

    At draws themselves the likelihood is never zero, because a sampler rejects such points. The proposals of
    differential evolution, z_i + 2.38 / sqrt(2 d) (z_j - z_k), have the shape of the posterior.

    Args:
        bound: the model and its data.
        z: draws (C, S, d) of the unconstrained parameters.
        seed: seed of the choice of draws.

    Returns:
        Counts; None for a model of Gaussian observations without constraints, which has no factors.

    Source: ter Braak (2006), Statistics and Computing 16.
    """
    if not bound.site.example.has_factors or not z.size:
        return None
    flat = z.reshape(-1, z.shape[-1])
    first, second, third = np.random.default_rng(seed).integers(len(flat), size=(3, POINTS))
    proposals = flat[first] + 2.38 / np.sqrt(2.0 * flat.shape[1]) * (flat[second] - flat[third])
    return failures_at(bound, bound.constrain_draws(proposals))


def failures_at(bound: BoundModel, values: Mapping[str, Any]) -> FactorFailures | None:
    """Evaluate the likelihood at values of the sites, name -> (S, ...), or at `POINTS` of them; None as above."""
    if not bound.site.example.has_factors:
        return None

    def per_draw(values: Any, key: jax.Array, y: Any) -> tuple[jax.Array, jax.Array]:
        return bound.likelihood(values, y).mapped(lambda series, y: series.convergence(y), bound.data(y))

    def in_all_series(flags: Any) -> np.ndarray:
        return np.all(np.asarray(flags).reshape(len(flags), -1), axis=1)

    converged, possible = map(in_all_series, map_draws(
        bound, DrawFunction("convergence of the factors", per_draw), _evenly_spaced(values, POINTS), jax.random.key(0),
        rows=bound.times.size))
    return FactorFailures(len(converged), int((~converged).sum()), int((~possible).sum()))


def path_ess(bound: BoundModel, values: Mapping[str, Any]) -> PathESS | None:
    """Return the effective sample size of weighted trajectories at values of the sites, name -> (S, ...).

    It is None without constraints, and where expectation propagation alone gives the evidence under constraints.
    """
    example = bound.site.example
    if not isinstance(example, ConstrainedLikelihood) or not example.draws:
        return None

    def per_draw(values: Any, key: jax.Array, y: Any) -> jax.Array:
        distribution = cast(ConstrainedLikelihood, bound.likelihood(values, y))
        return distribution.truncated_posterior().effective_sample_size(bound.data(y), distribution.draws)

    sizes = map_draws(bound, DrawFunction("weights of trajectories", per_draw), _evenly_spaced(values, _WEIGHT_DRAWS),
                      jax.random.key(0), rows=bound.times.size)
    return PathESS(example.draws, float(np.median(sizes)), float(sizes.min()))


def _evenly_spaced(values: Mapping[str, Any], limit: int) -> dict[str, np.ndarray]:
    """Return at most ``limit`` draws."""
    _, rows = evenly_spaced(1, len(next(iter(values.values()))), limit)
    return {name: np.asarray(value)[rows] for name, value in values.items()}
