"""Altitude, speed and acceleration at the true parameters, by Gaussian filters and smoothers."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.ballistic import problem
from lfm_ppl.experiments.study import blocks, stacked
from lfm_ppl.experiments.timing import timed
from lfm_ppl.filtering.filter import filter as gaussian_filter
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.linearisation.sigma_points import Cubature, GaussHermite
from lfm_ppl.linearisation.taylor import Taylor

RULES: dict[str, Rule] = {"cubature": Cubature(), "Taylor": Taylor(), "Gauss-Hermite (5)": GaussHermite(5),
                          "cubature, whole state": Cubature(full_state=True)}
"""The model's own first; the last one is the source's."""

REPORTED = next(iter(RULES))
BLOCK = 50
"""Targets that are computed in one go, and stored in one file."""


def tasks(settings: Any) -> list[Task]:
    """Return one task for each rule and block of targets."""
    return [Task(f"tracking/{slug(rule)}/{first:04d}-{last:04d}", settings.seed,
                 {"experiment": "ballistic", "what": "tracking", "method": rule, "first": first, "last": last})
            for rule in settings.rules for first, last in blocks(settings.runs, BLOCK)]


def compute(task: Task) -> Result:
    """Return errors, coverage and times of every target of the task.

    Returns:
        ``filter_rmse`` (N, 3), and with ``smoother_`` ``rmse`` and ``coverage`` (N, 3) of altitude, speed and u over
        the measurement times; ``log_likelihood``, and CPU ``filter_seconds`` and ``smoother_seconds`` (N,), the
        smoother's with its filter. ``mean`` and ``sd`` (3, T) of the first target, for a figure.
    """
    filtering, smoothing = _programs(task.settings["method"])
    filtering(problem.target(0, task.seed).y), smoothing(problem.target(0, task.seed).y)  # touch the memory once
    rows: list[Result] = []
    first: Result = {}
    for index in range(task.settings["first"], task.settings["last"] + 1):
        target = problem.target(index, task.seed)
        filter_s, (filtered, log_likelihood) = timed(filtering, target.y)
        smoother_s, (mean, sd) = timed(smoothing, target.y)
        rows.append({"filter_rmse": rmse(filtered, target), "log_likelihood": float(log_likelihood),
                     "filter_seconds": filter_s, "smoother_seconds": smoother_s,
                     **judged("smoother", mean, sd, target)})
        first = first or {"mean": np.asarray(mean), "sd": np.asarray(sd)}
    return stacked(rows) | first


def judged(what: str, mean: Any, sd: Any, target: problem.Target) -> Result:
    """Return ``{what}_rmse`` and ``{what}_coverage`` (3,) of means and standard deviations (3, T)."""
    mean, sd = np.asarray(mean), np.asarray(sd)
    within = np.abs(mean - target.paths) <= scores.Z * sd
    return {f"{what}_rmse": rmse(mean, target), f"{what}_coverage": within.mean(axis=1)}


def rmse(mean: Any, target: problem.Target) -> np.ndarray:
    """Return the root mean squared errors (3,) of means (3, T) over the measurement times."""
    return np.array([scores.rmse(one, truth) for one, truth in zip(np.asarray(mean), target.paths, strict=True)])


@functools.cache
def _programs(name: str) -> tuple[Callable, Callable]:
    """Compile filter and smoother once for all targets."""
    rule = RULES[name]
    given = problem.true_likelihood()
    options: dict[str, Any] = {"rule": rule, "steps": given.steps, "max_step": given.max_step}
    times = problem.target(0).times

    def filtering(y: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = gaussian_filter(given.model, times, y, **options)
        # A Matern force is the first entry of its own state, which follows altitude and speed.
        return found.filtered_mean[:, :3].T, found.log_likelihood.sum()

    def smoothing(y: jax.Array) -> tuple[jax.Array, jax.Array]:
        return problem.paths_of(smooth(given.model, times, y, **options))

    shape = jax.ShapeDtypeStruct((len(times), 1), float)
    return jax.jit(filtering).lower(shape).compile(), jax.jit(smoothing).lower(shape).compile()


def slug(label: str) -> str:
    """Return a label as part of the name of a task."""
    return "".join(one for one in label.replace(" ", "-") if one not in "(),")
