"""Altitude, speed and acceleration at the true parameters: Gaussian filters and smoothers, and particles.

Particle paths are traced through their ancestors. Backward simulation, the usual remedy where traced paths meet in few
particles, is none here: the state of a Matern-5/2 force hardly has noise over a short step, so that a particle's own
ancestor is nearly the only one that it can have.
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
from lfm_ppl.experiments.study import stacked
from lfm_ppl.experiments.timing import timed, timed_again
from lfm_ppl.filtering.filter import filter as gaussian_filter
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.linearisation.sigma_points import Cubature, GaussHermite
from lfm_ppl.linearisation.taylor import Taylor
from lfm_ppl.particles.particle_filter import particle_filter
from lfm_ppl.particles.particle_smoother import TRACING, particle_smoother

RULES: dict[str, Rule] = {"cubature": Cubature(), "Taylor": Taylor(), "Gauss-Hermite (5)": GaussHermite(5),
                          "cubature, whole state": Cubature(full_state=True)}
"""The model's own first; the last one is the source's."""

REPORTED = next(iter(RULES))


def gaussian(task: Task) -> Result:
    """Return errors, coverage and CPU times of every target of a task; the smoother's times are with its filter."""
    filtering, smoothing = _programs(task.settings["method"])
    filtering(problem.target(0, task.seed).y), smoothing(problem.target(0, task.seed).y)  # touch the memory once
    rows: list[Result] = []
    for index in range(task.settings["first"], task.settings["last"] + 1):
        target = problem.target(index, task.seed)
        filter_s, (filtered, log_likelihood) = timed(filtering, target.y)
        smoother_s, (mean, sd) = timed(smoothing, target.y)
        rows.append({"filter_rmse": rmse(filtered, target), "log_likelihood": float(log_likelihood), "mean": mean,
                     "sd": sd, "filter_seconds": filter_s, "smoother_seconds": smoother_s,
                     **judged("smoother", mean, sd, target)})
    return stacked(rows, shown=("mean", "sd"))


@functools.cache
def _programs(name: str) -> tuple[Callable, Callable]:
    """Compile filter and smoother once for all targets."""
    given, times = problem.true_likelihood(), problem.target(0).times
    options: dict[str, Any] = {"rule": RULES[name], "steps": given.steps, "max_step": given.max_step}

    def filtering(y: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = gaussian_filter(given.model, times, y, **options)
        # A Matern force is the first entry of its own state, which follows altitude and speed.
        return found.filtered_mean[:, :3].T, found.log_likelihood.sum()

    def smoothing(y: jax.Array) -> tuple[jax.Array, jax.Array]:
        return problem.paths_of(smooth(given.model, times, y, **options))

    shape = jax.ShapeDtypeStruct((len(times), 1), float)
    return jax.jit(filtering).lower(shape).compile(), jax.jit(smoothing).lower(shape).compile()


def particles(task: Task) -> Result:
    """Return the same of one target by particles, and through how many ``distinct`` ones the traced paths pass."""
    target, given = problem.target(task.settings["index"], task.seed), problem.true_likelihood().model
    options = {"particles": task.settings["particles"], "steps": task.settings["steps"]}
    keys, common = jax.random.split(task.key), (given, target.times, target.y)
    filter_s, filtered = timed_again(f"ballistic filter, {options}", lambda: particle_filter(
        keys[0], *common, **options))
    smoother_s, smoothed = timed_again(f"ballistic smoother, {options}", lambda: particle_smoother(
        keys[1], *common, draws=task.settings["draws"], method=TRACING, **options))
    paths = [smoothed.state("altitude"), smoothed.state("speed"), smoothed.force("u")]
    mean, sd = np.stack([path.mean for path in paths]), np.stack([path.sd for path in paths])
    return {"filter_rmse": rmse(np.asarray(filtered.mean)[:, :3].T, target),
            "log_likelihood": float(jnp.sum(filtered.log_likelihood)), "filter_seconds": filter_s,
            "smoother_seconds": smoother_s, "distinct": np.asarray(smoothed.distinct), "mean": mean, "sd": sd,
            **judged("smoother", mean, sd, target)}


def judged(what: str, mean: Any, sd: Any, target: problem.Target) -> Result:
    """Return ``{what}_rmse`` and ``{what}_coverage`` (3,) of means and standard deviations (3, T)."""
    within = np.abs(np.asarray(mean) - target.paths) <= scores.Z * np.asarray(sd)
    return {f"{what}_rmse": rmse(mean, target), f"{what}_coverage": within.mean(axis=1)}


def rmse(mean: Any, target: problem.Target) -> np.ndarray:
    """Return the root mean squared errors (3,) of means (3, T) over the measurement times."""
    return np.array([scores.rmse(path, truth) for path, truth in zip(np.asarray(mean), target.paths, strict=True)])
