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
import numpy as np

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments.ballistic import problem
from lfm_ppl.experiments.scores import interval, judged, rmse
from lfm_ppl.experiments.tasks import indices, stacked
from lfm_ppl.experiments.timing import timed_again
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
    """Return what a rule finds of every target of a task, see `_judged`, and ``mean`` and ``sd`` of the first."""
    rule = task.settings["method"]
    return stacked([_judged(problem.target(index, task.seed), f"ballistic, {rule}", *_programs(rule))
                    for index in indices(task)], shown=("mean", "sd"))


@functools.cache
def _programs(rule: str) -> tuple[Callable, Callable]:
    """Return filter and smoother, compiled once for all targets."""
    given, times = problem.true_likelihood(), problem.target(0).times
    options: dict[str, Any] = {"rule": RULES[rule], "steps": given.steps, "max_step": given.max_step}

    def filtering(y: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = gaussian_filter(given.model, times, y, **options)
        return found.filtered_mean, found.log_likelihood

    return jax.jit(filtering), jax.jit(lambda y: problem.paths_of(smooth(given.model, times, y, **options)))


def particles(task: Task) -> Result:
    """Return the same of one target by particles, and through how many ``distinct`` ones the traced paths pass."""
    given, (filter_key, smoother_key) = problem.true_likelihood().model, jax.random.split(task.key)
    target = problem.target(task.settings["index"], task.seed)
    options = {"particles": task.settings["particles"], "steps": task.settings["steps"]}

    def filtering(y: np.ndarray) -> tuple[jax.Array, jax.Array]:
        found = particle_filter(filter_key, given, target.times, y, **options)
        return found.mean, found.log_likelihood

    def smoothing(y: np.ndarray) -> tuple[np.ndarray, np.ndarray, jax.Array]:
        found = particle_smoother(smoother_key, given, target.times, y, draws=task.settings["draws"], method=TRACING,
                                  **options)
        paths = [found.state("altitude"), found.state("speed"), found.force("u")]
        return np.stack([path.mean for path in paths]), np.stack([path.sd for path in paths]), found.distinct

    return _judged(target, f"ballistic, {options}", filtering, smoothing)


def _judged(target: problem.Target, label: str, filtering: Callable, smoothing: Callable) -> Result:
    """Return errors of filter and smoother of a target, coverage, and CPU times; the smoother's is with its filter."""
    filter_s, (filtered, log_likelihood) = timed_again(f"{label}, filter", lambda: filtering(target.y))
    smoother_s, (mean, sd, *distinct) = timed_again(f"{label}, smoother", lambda: smoothing(target.y))
    # A Matern force is the first entry of its own state, which follows altitude and speed.
    return {"filter_rmse": rmse(filtered[:, :3].T, target.paths), "log_likelihood": float(log_likelihood.sum()),
            **judged("smoother", mean, interval(mean, sd), target.paths), "mean": np.asarray(mean),
            "sd": np.asarray(sd), "filter_seconds": filter_s, "smoother_seconds": smoother_s,
            **({"distinct": np.asarray(*distinct)} if distinct else {})}
