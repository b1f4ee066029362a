"""Posterior of the drag alone, where the force's scale and lengthscale are known: by quadrature.

With the force's parameters unknown too, how often posteriors cover one and the same truth depends on how far their
prior pulls. Here nothing else is unknown, and a flat prior hardly pulls beside 120 distances, so that they cover it
about as often as they say if the filter's likelihood is right.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments.ballistic import problem
from lfm_ppl.experiments.study import blocks

REACH, POINTS = 1.5, 121
"""Of the grid about the true log alpha: a dozen posterior standard deviations wide, of a tenth of one a cell."""
BLOCK = 50
"""Targets that are computed in one go, and stored in one file."""
_TOGETHER = 11
"""Points that are computed at a time."""


def tasks(settings: Any) -> list[Task]:
    """Return one task for each block of targets."""
    return [Task(f"known/{first:04d}-{last:04d}", settings.seed,
                 {"experiment": "ballistic", "what": "known", "first": first, "last": last})
            for first, last in blocks(settings.runs, BLOCK)]


def compute(task: Task) -> Result:
    """Return ``below`` (N,), the posterior probability of less than the true log alpha, for a flat prior of it."""
    targets = range(task.settings["first"], task.settings["last"] + 1)
    return {"below": np.array([below(problem.target(index, task.seed)) for index in targets])}


def below(target: problem.Target) -> float:
    """Return the posterior probability that log alpha is less than it is; by the trapezoidal rule.

    Raises:
        ValueError: no drag on the grid has a finite likelihood.
    """
    alphas = target.z[0] + REACH * np.linspace(-1.0, 1.0, POINTS)
    points = np.stack([alphas, np.full(POINTS, target.z[1]), np.full(POINTS, target.z[2])], axis=1)
    log_likelihood, _ = problem.posterior().log_densities_of(points, target.y, _TOGETHER)
    density = np.where(np.isfinite(log_likelihood), np.exp(log_likelihood - np.nanmax(log_likelihood)), 0.0)
    if not np.isfinite(log_likelihood).any():
        raise ValueError("the filter breaks down at every drag on the grid.")
    total = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    return float(np.interp(target.z[0], alphas, total / total[-1]))
