"""Drag, scale and lengthscale from the distances alone: the most likely values, and the posterior of each target.

The posterior is that of the model with its priors and the Gaussian filter's likelihood, in the logarithms z of the
parameters. Draws of a multivariate t distribution at its mode are weighted by it; their weighted moments give a second
one, whose draws, weighted, stand for the posterior. The Pareto index of the weights says whether that is good enough.
`chains` compares it with NUTS and RAM.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.ballistic import problem
from lfm_ppl.experiments.ballistic.tracking import judged
from lfm_ppl.experiments.study import blocks, stacked
from lfm_ppl.experiments.timing import timed
from lfm_ppl.experiments.weighting import Weighted, moments, weighted
from lfm_ppl.inference.optimise import Minimum, newton, quasi_newton
from lfm_ppl.results import importance

START = np.log([5e-4, 30.0, 5.0])
"""Where every search starts: the prior medians."""

LEVELS = (0.5, 0.8, 0.95)
FURTHEST = 3.0
"""A most likely value further than this from `START`, in logarithms, lies at the edge: the likelihood has no maximum
among plausible values."""

_TOGETHER = 10
"""Paths that are smoothed at a time."""

BLOCK = 10
"""Targets that are computed in one go, and stored in one file."""


def tasks(settings: Any) -> list[Task]:
    """Return one task for each block of targets."""
    return _tasks("parameters", settings.runs, settings)


def drawn_tasks(settings: Any) -> list[Task]:
    """Return one task for each block of targets whose parameters are drawn from the prior."""
    return _tasks("drawn", settings.drawn_runs, settings)


def _tasks(what: str, count: int, settings: Any) -> list[Task]:
    return [Task(f"{what}/{first:04d}-{last:04d}", settings.seed,
                 {"experiment": "ballistic", "what": what, "first": first, "last": last,
                  "draws": settings.draws, "paths": settings.paths})
            for first, last in blocks(count, BLOCK)]


def compute(task: Task) -> Result:
    """Return what is found of every target of the task, (N, ...).

    Returns:
        ``likely`` (3,), the most likely z, and whether it ``exists``; of the posterior of z ``posterior_mean``,
        ``posterior_sd`` and ``below`` (3,), the probability of less than the true value; ``k``, the Pareto index, and
        ``ess`` of the weights; RMSE and coverage (3,) of the smoothed paths with the most likely parameters
        (``likely_``) and with the parameters integrated out (``posterior_``); CPU ``seconds`` of searches and weights.
        ``draws`` (3, D) of the first target, for a figure.
    """
    _warm(task.settings["draws"], task.settings["paths"])
    given = problem.drawn_target if task.settings["what"] == "drawn" else problem.target
    rows: list[Result] = []
    first: Result = {}
    for index in range(task.settings["first"], task.settings["last"] + 1):
        target = given(index, task.seed)
        seed = int(jax.random.bits(jax.random.fold_in(task.key, index)))
        found = estimate(target, task.settings["draws"], task.settings["paths"], seed)
        drawn = found.pop("draws")
        first = first or {"draws": drawn}
        rows.append(found)
    return stacked(rows) | first


def estimate(target: problem.Target, count: int, paths: int, seed: int) -> Result:
    """Return what is found of a target, see `compute`.

    Args:
        target: the target.
        count: draws that are weighted.
        paths: draws over which the smoothed paths are averaged.
        seed: of the draws.
    """
    (one_path, smoothing), posterior = _paths(), problem.posterior()
    y = jnp.asarray(target.y)

    def search() -> tuple[Minimum, Weighted]:
        objectives = [posterior.objective(y, prior) for prior in (1.0, 0.0)]
        mode, likely = (newton(each, quasi_newton(each, START, 200).point) for each in objectives)
        return likely, weighted(lambda draws: np.sum(posterior.log_densities_of(draws, y), axis=0), [mode], count, seed)

    seconds, (likely, (draws, weights, _)) = timed(search)
    weight = np.exp(weights.log_weight[0])
    mean, sd = moments(draws, weight)[0], np.sqrt(np.diag(moments(draws, weight)[1]))
    chosen = draws[importance.resample(weights.log_weight, paths, seed)]
    plain = one_path(jnp.asarray(likely.point), y)
    means, sds = map(np.asarray, smoothing(jnp.asarray(chosen), y))
    total = [scores.total_moments(means[:, row], sds[:, row] ** 2) for row in range(len(problem.PATHS))]
    inside = bool(np.all(np.abs(likely.point - START) < FURTHEST))
    exists = likely.curvature is not None and likely.curvature.definite and inside
    return {
        "likely": likely.point, "exists": exists, "posterior_mean": mean, "posterior_sd": sd,
        "below": weight @ (draws < target.z), "k": weights.k, "ess": weights.ess, "seconds": seconds,
        "draws": draws[importance.resample(weights.log_weight, count, seed)].T,
        **judged("likely", plain[0], plain[1], target),
        **judged("posterior", np.stack([one[0] for one in total]), np.stack([one[1] for one in total]), target)}


@functools.cache
def _paths() -> tuple[Callable, Callable]:
    """Return smoothed paths for one and for several z, compiled once for all targets."""
    def one(z: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        return problem.paths_of(problem.posterior().likelihood(z).smooth(y))

    return jax.jit(one), jax.jit(lambda all_, y: jax.lax.map(lambda z: one(z, y), all_, batch_size=_TOGETHER))


@functools.cache
def _warm(count: int, paths: int) -> None:
    """Compile everything before it is timed."""
    estimate(problem.target(0), count, paths, 0)
