"""Where the sites of an observation family do not converge, near the draws of a posterior."""

from __future__ import annotations

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


class SiteFailures(NamedTuple):
    """How often there is no likelihood, a step away from the draws.

    Attributes:
        points: at which it was tried.
        unconverged: of them, where sites do not converge.
        impossible: of them, where the likelihood is zero, for that reason or another.
    """

    points: int
    unconverged: int
    impossible: int


def site_failures(bound: BoundModel, z: np.ndarray, seed: int = 0, points: int = POINTS) -> SiteFailures | None:
    """Try the likelihood where a sampler would look next: at draws plus scaled differences of two others.

    At draws themselves the likelihood is never zero, for a point where it is gets rejected. The differences are those
    of differential evolution, z_i + 2.38 / sqrt(2 d) (z_j - z_k), which have the shape of the posterior.

    Args:
        bound: the model and its data.
        z: draws (C, S, d) of the unconstrained parameters.
        seed: of the choice of draws.
        points: at which to try.

    Returns:
        Counts; None for a model of Gaussian observations, which has no sites.

    Source: ter Braak (2006), Statistics and Computing 16.
    """
    if not isinstance(bound.site.example.ssm.model.observation, ObservationFamily) or not z.size:
        return None
    flat = z.reshape(-1, z.shape[-1])
    first, second, third = np.random.default_rng(seed).integers(len(flat), size=(3, points))
    near = flat[first] + 2.38 / np.sqrt(2.0 * flat.shape[1]) * (flat[second] - flat[third])

    def one(distribution: MarginalLikelihood, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = distribution.evidence(y)
        return found.refined.found.converged, jnp.isfinite(found.log_evidence)

    def per_draw(values: Any, key: jax.Array, y: Any) -> tuple[jax.Array, jax.Array]:
        return each(bound.likelihood(values, y), one, bound.data(y))

    converged, possible = over_draws(bound, "convergence of the sites", per_draw, bound.constrain_draws(near),
                                     jax.random.key(0), bound.times.size)
    every = lambda known: np.asarray(known).reshape(points, -1).all(axis=1)  # noqa: E731
    return SiteFailures(points, int((~every(converged)).sum()), int((~every(possible)).sum()))
