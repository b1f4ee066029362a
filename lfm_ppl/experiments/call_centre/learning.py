"""The parameters of a method given three days: the most likely ones, and their posterior.

The posterior is that of the logarithms z under the model's priors, by importance samples about all modes that are
found, see `lfm_ppl.results.importance_at_modes`.
"""

from __future__ import annotations

import numpy as np

from lfm_ppl.experiments.call_centre import problem
from lfm_ppl.experiments.call_centre.problem import Method
from lfm_ppl.inference.optimise import End, Minimum, quasi_newton
from lfm_ppl.results.importance_at_modes import Weighted, weighted_posterior

LIMITS = {"mean": (1.0, 30.0), "scale": (0.1, 30.0), "lengthscale": (10.0, 10_000.0), "memory": (0.2, 10_000.0),
          "noise_sd": (0.01, 5.0)}
"""Parameter -> least and largest value."""

STARTS = (
    {"mean": 6.0, "scale": 2.0, "lengthscale": 150.0, "memory": 10.0, "noise_sd": 2.0},
    {"mean": 4.0, "scale": 3.5, "lengthscale": 220.0, "memory": 1.0, "noise_sd": 1.5},
    {"mean": 7.0, "scale": 1.3, "lengthscale": 110.0, "memory": 60.0, "noise_sd": 1.0},
)
"""Where searches start: cycles somewhat alike, hardly alike, and nearly the same. From a small noise a search gets lost
where cycles differ more than a model allows."""

SAME = 0.1
"""Ends of searches that differ by less than this in every logarithm are the same mode."""

FAR = 7.0
"""Modes that are so much lower in log density than the highest are left out: below a thousandth of it. Unless they are
much wider, they hold next to nothing."""

_SEARCH = {"ftol": 1e-7, "gtol": 1e-3, "maxfun": 60}


def searches(method: Method, y: np.ndarray, prior: float = 0.0) -> tuple[list[End], int]:
    """Return where searches from `STARTS` end within `LIMITS`, the most likely end first, and all evaluations.

    The readings y (63, 1) are those of the training as logarithms; the prior is 0 for maxima of the likelihood, 1 for
    those of the posterior density of z. Values are minus the log density; where no search finds a finite one it is a
    ValueError.
    """
    objective = problem.posterior(method).objective(y, prior)
    bounds, *starts = (np.log([given[name] for name in method.names]) for given in (LIMITS, *STARTS))
    ends = [quasi_newton(objective, start, bounds=bounds, options=_SEARCH) for start in starts]
    if not any(np.isfinite(end.value) for end in ends):
        raise ValueError(f"the likelihood is not finite wherever a search for the parameters of {method.force} starts; "
                         "are there readings that no queue can have?")
    return sorted((end for end in ends if np.isfinite(end.value)), key=lambda end: end.value), objective.evaluations


def posterior(method: Method, y: np.ndarray, count: int, seed: int) -> Weighted:
    """Return ``count`` importance samples of z about all modes; method and readings as for `searches`."""
    return weighted_posterior(problem.posterior(method), y, modes(method, y), count, seed)


def modes(method: Method, y: np.ndarray) -> list[Minimum]:
    """Return the different modes of the posterior with their curvature, the highest first; arguments as `searches`.

    A lower one without a positive definite curvature is none, but the edge of what is allowed or of a search.
    """
    ends, _ = searches(method, y, prior=1.0)
    objective = problem.posterior(method).objective(y)
    different: list[End] = []
    for end in ends:
        if end.value - ends[0].value < FAR and all(np.abs(end.point - one.point).max() > SAME for one in different):
            different.append(end)

    def with_curvature(point: np.ndarray) -> Minimum:
        value, gradient = objective.value_and_gradient(point)
        return Minimum(point, value, objective.curvature(point), 0.0, np.zeros_like(point), gradient)

    highest, *lower = [with_curvature(end.point) for end in different]
    return [highest, *(mode for mode in lower if mode.curvature is not None and mode.curvature.definite)]
