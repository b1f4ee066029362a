"""States and forces at the true parameters: Gaussian filters and smoothers, and particles.

The particle smoother traces ancestors. Backward simulation, the usual remedy where traced paths meet in few particles,
does not help with a smooth force: the state of a Matern-5/2 force has almost no noise over a short step, so that only a
particle's ancestor has a transition density to it that is not negligible.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import lfm_ppl as lfm
from lfm_ppl.parallel.task import Result, Task
from lfm_ppl.particles.particle_smoother import TRACING, ParticleSmootherResult

from ..scores import interval, rmse, score_path
from ..tasks import dataset_indices, stack_results
from ..timing import time_compiled_call
from .problem import default_data, simulate_target, true_likelihood

RULES: dict[str, lfm.Rule] = {
    "cubature": lfm.Cubature(), "Taylor": lfm.Taylor(), "Gauss-Hermite (5)": lfm.GaussHermite(5),
    "cubature, whole state": lfm.Cubature(full_state=True)}
"""Linearisation rules by name; the first is the default of most models."""

DEFAULT_RULE = next(iter(RULES))


def run_gaussian(task: Task) -> Result:
    """Return the scores of a rule on every target of a task, see `_score`, and ``mean`` and ``sd`` of the first."""
    rule = task.settings["method"]
    filtering, smoothing = _gaussian_programs(rule)
    rows = [_score(task, index, rule, filtering, smoothing)[0] for index in dataset_indices(task)]
    return stack_results(rows, first_only=("mean", "sd"))


@functools.cache
def _gaussian_programs(rule: str) -> tuple[Callable, Callable]:
    """Return filter and smoother with the likelihood's steps, iterations and factors, compiled for all targets."""
    likelihood = true_likelihood().with_settings(rule=RULES[rule])

    def filtering(y: jax.Array) -> tuple[jax.Array, jax.Array]:
        result = likelihood.filter(y)
        return result.filtered_mean, result.log_likelihood

    return jax.jit(filtering), jax.jit(lambda y: smoothed_paths(likelihood.smooth(y)))


def run_particles(task: Task) -> Result:
    """Return the scores of particles on one target, see `_score`.

    ``distinct`` (T,) is the number of distinct particles on the smoothed paths.
    """
    model, times = true_likelihood().model, default_data().times
    filter_key, smoother_key = jax.random.split(task.key)
    options = {"particles": task.settings["particles"], "steps": task.settings["steps"]}

    def filtering(y: np.ndarray) -> tuple[jax.Array, jax.Array]:
        result = lfm.particle_filter(filter_key, model, times, y, **options)
        return result.mean, result.log_likelihood

    def smoothing(y: np.ndarray) -> ParticleSmootherResult:
        return lfm.particle_smoother(smoother_key, model, times, y, draws=task.settings["draws"], method=TRACING,
                                     **options)

    scores, smoothed = _score(task, task.settings["index"], str(options), filtering, smoothing, smoothed_paths)
    return scores | {"distinct": np.asarray(smoothed.distinct)}


def smoothed_paths(result: Any) -> tuple[jax.Array, jax.Array]:
    """Return means and standard deviations (3, T) of the paths from a smoother's result."""
    paths = result.state("altitude"), result.state("speed"), result.force("u")
    return jnp.stack([path.mean for path in paths]), jnp.stack([path.sd for path in paths])


def _score(task: Task, index: int, label: str, filtering: Callable, smoothing: Callable,
           paths: Callable[[Any], tuple] = tuple) -> tuple[Result, Any]:
    """Filter and smooth a target; CPU times exclude compilation, which the first call with a label takes.

    Args:
        task: task with the seed of the data.
        index: index of the target.
        label: label of the compiled programs.
        filtering: map from data to means of the joint state and terms of the log likelihood.
        smoothing: map from data to a smoother's result.
        paths: map from this result to means and standard deviations (3, T) of the paths.

    Returns:
        A result and the smoother's result. The first has ``filter_rmse``, ``smoother_rmse`` and ``smoother_coverage``
        (3,), the filter's ``log_likelihood``, the CPU times ``filter_seconds`` and ``smoother_seconds`` (which includes
        the filter pass of the smoother), and ``mean`` and ``sd`` (3, T) of the paths.
    """
    target = simulate_target(index, task.seed)
    filter_s, (joint, log_likelihood) = time_compiled_call(f"ballistic, {label}, filter", lambda: filtering(target.y))
    smoother_s, smoothed = time_compiled_call(f"ballistic, {label}, smoother", lambda: smoothing(target.y))
    mean, sd = map(np.asarray, paths(smoothed))
    return {"filter_rmse": rmse(_filtered_paths(joint), target.paths),
            "log_likelihood": float(log_likelihood.sum()),
            **score_path("smoother", mean, interval(mean, sd), target.paths), "mean": mean, "sd": sd,
            "filter_seconds": filter_s, "smoother_seconds": smoother_s}, smoothed


def _filtered_paths(joint: jax.Array) -> jax.Array:
    """Return filtered means (3, T) of the paths from means (T, n) of the joint state."""
    return jax.vmap(true_likelihood().ssm.inputs)(jnp.asarray(joint), jnp.asarray(default_data().times)).T
