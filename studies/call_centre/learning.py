"""Parameters of a model of the arrivals, given three days: the most likely ones, and their posterior.

The posterior of the logarithms z under the model's priors is represented by importance samples about all modes that
searches find, see `lfm_ppl.studies.importance_at_modes`.
"""

from __future__ import annotations

import numpy as np

from lfm_ppl.inference.optimise import End, Minimum, quasi_newton

from ..importance_at_modes import Weighted, weighted_posterior
from . import problem
from .problem import ArrivalModel

LIMITS = {"mean": (1.0, 30.0), "scale": (0.1, 30.0), "lengthscale": (10.0, 10_000.0), "memory": (0.2, 10_000.0),
          "noise_sd": (0.01, 5.0)}
"""Parameter -> smallest and largest value."""

STARTS = (
    {"mean": 6.0, "scale": 2.0, "lengthscale": 150.0, "memory": 10.0, "noise_sd": 2.0},
    {"mean": 4.0, "scale": 3.5, "lengthscale": 220.0, "memory": 1.0, "noise_sd": 1.5},
    {"mean": 7.0, "scale": 1.3, "lengthscale": 110.0, "memory": 60.0, "noise_sd": 1.0},
)
"""Starts of the searches: moderately similar, dissimilar and nearly equal cycles. With a small noise a search would
fail where the cycles differ by more than the model permits."""

MODE_TOLERANCE = 0.1
"""Largest difference of z, in every component, between ends of searches that belong to one mode."""

MODE_GAP = 7.0
"""Largest difference in log density from the highest mode: lower modes have less than a thousandth of its density, and
a negligible share of the posterior unless they are much wider."""

_SEARCH = {"ftol": 1e-7, "gtol": 1e-3, "maxfun": 60}


def run_searches(arrival_model: ArrivalModel, y: np.ndarray, prior: float = 0.0) -> tuple[list[End], int]:
    """Return the ends of searches from `STARTS` within `LIMITS`, and the number of evaluations.

    Args:
        arrival_model: model of the arrivals.
        y: training readings (63, 1) as logarithms.
        prior: 0 to maximise the likelihood, 1 to maximise the posterior density of z.

    Returns:
        The ends, with the highest density first, whose values are minus the log density; and the number of evaluations.

    Raises:
        ValueError: no search finds a finite density.
    """
    objective = problem.posterior(arrival_model).objective(y, prior)
    bounds, *starts = (np.log([values[name] for name in arrival_model.names]) for values in (LIMITS, *STARTS))
    end_points = [quasi_newton(objective, start, bounds=bounds, options=_SEARCH) for start in starts]
    finite = [end for end in end_points if np.isfinite(end.value)]
    if not finite:
        raise ValueError(f"the likelihood is not finite at any start of the searches for {arrival_model.force}; check "
                         "the counts for values that no queue can reach.")
    return sorted(finite, key=lambda end: end.value), objective.evaluations


def sample_posterior(arrival_model: ArrivalModel, y: np.ndarray, count: int, seed: int) -> Weighted:
    """Return ``count`` importance samples of z about all modes; model and readings as in `run_searches`."""
    return weighted_posterior(problem.posterior(arrival_model), y, find_modes(arrival_model, y), count, seed)


def find_modes(arrival_model: ArrivalModel, y: np.ndarray) -> list[Minimum]:
    """Return the distinct modes of the posterior with their curvature, the highest first; arguments as `run_searches`.

    A lower mode without a positive definite curvature is dropped: it lies at a bound, or its search did not converge.
    """
    end_points, _ = run_searches(arrival_model, y, prior=1.0)
    objective = problem.posterior(arrival_model).objective(y)
    distinct: list[End] = []
    for end in end_points:
        is_high = end.value - end_points[0].value < MODE_GAP
        if is_high and all(np.abs(end.point - mode.point).max() > MODE_TOLERANCE for mode in distinct):
            distinct.append(end)

    def with_curvature(point: np.ndarray) -> Minimum:
        value, gradient = objective.value_and_gradient(point)
        return Minimum(point, value, objective.curvature(point), 0.0, np.zeros_like(point), gradient)

    highest, *lower = [with_curvature(end.point) for end in distinct]
    return [highest, *(mode for mode in lower if mode.curvature is not None and mode.curvature.definite)]
