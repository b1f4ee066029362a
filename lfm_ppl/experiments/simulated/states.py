"""States and forces at the true parameters: Gaussian filters and smoothers, and particles.

Particle paths are traced through their ancestors. Backward simulation, the usual remedy where traced paths meet in few
particles, is none for a smooth force: the state of a Matern-5/2 force hardly has noise over a short step, so that a
particle's own ancestor is nearly the only one that it can have.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments.scores import interval, rmse, score_path
from lfm_ppl.experiments.simulated.problem import Problem, default, record, true_likelihood
from lfm_ppl.experiments.tasks import dataset_indices, stack_results
from lfm_ppl.experiments.timing import time_compiled_call
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.linearisation.sigma_points import Cubature, GaussHermite
from lfm_ppl.linearisation.taylor import Taylor
from lfm_ppl.particles.particle_filter import particle_filter
from lfm_ppl.particles.particle_smoother import TRACING, ParticleSmootherResult, particle_smoother

RULES: dict[str, Rule] = {"cubature": Cubature(), "Taylor": Taylor(), "Gauss-Hermite (5)": GaussHermite(5),
                          "cubature, whole state": Cubature(full_state=True)}
"""Ways to linearise dynamics, that of most models first."""

REPORTED = next(iter(RULES))


def gaussian(problem: Problem, task: Task) -> Result:
    """Return what a rule finds of every data set of a task, see `_judged`, and ``mean`` and ``sd`` of the first."""
    rule = task.settings["method"]
    filtering, smoothing = _programs(problem, rule)
    rows = [_judged(problem, task, index, rule, filtering, smoothing)[0] for index in dataset_indices(task)]
    return stack_results(rows, first_only=("mean", "sd"))


@functools.cache
def _programs(problem: Problem, rule: str) -> tuple[Callable, Callable]:
    """Return filter and smoother with the likelihood's steps, iterations and sites, compiled for all data sets."""
    given = copy.copy(true_likelihood(problem))
    given.rule = RULES[rule]

    def filtering(y: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = given.filter(y)
        return found.filtered_mean, found.log_likelihood

    return jax.jit(filtering), jax.jit(lambda y: paths_of(problem, given.smooth(y)))


def particles(problem: Problem, task: Task) -> Result:
    """Return what particles find of one data set, see `_judged`, and how many ``distinct`` ones (T,) the paths pass."""
    given, times = true_likelihood(problem).model, default(problem).times
    filter_key, smoother_key = jax.random.split(task.key)
    options = {"particles": task.settings["particles"], "steps": task.settings["steps"]}

    def filtering(y: np.ndarray) -> tuple[jax.Array, jax.Array]:
        found = particle_filter(filter_key, given, times, y, **options)
        return found.mean, found.log_likelihood

    def smoothing(y: np.ndarray) -> ParticleSmootherResult:
        return particle_smoother(smoother_key, given, times, y, draws=task.settings["draws"], method=TRACING, **options)

    result, found = _judged(problem, task, task.settings["index"], str(options), filtering, smoothing,
                            functools.partial(paths_of, problem))
    return result | {"distinct": np.asarray(found.distinct)}


def paths_of(problem: Problem, found: Any) -> tuple[jax.Array, jax.Array]:
    """Return means and standard deviations (K, T) of the problem's paths from the result of a smoother."""
    states = true_likelihood(problem).model.state_names
    paths = [found.state(name) if name in states else found.force(name) for name in problem.paths]
    return jnp.stack([path.mean for path in paths]), jnp.stack([path.sd for path in paths])


def _judged(problem: Problem, task: Task, index: int, label: str, filtering: Callable, smoothing: Callable,
            paths: Callable[[Any], tuple] = lambda found: found) -> tuple[Result, Any]:
    """Filter and smooth a data set; what is compiled in the first call with this label takes no time.

    Returns:
        ``filter_rmse``, ``smoother_rmse`` and ``smoother_coverage`` (K,), the filter's ``log_likelihood``, CPU times
        ``filter_seconds`` and ``smoother_seconds``, which has its own filter's in it, ``mean`` and ``sd`` (K, T) of the
        problem's paths; and the result of ``smoothing``, from which ``paths`` takes these.
    """
    one, label = record(problem, index, task.seed), f"{problem}, {label}"
    filter_s, (joint, log_likelihood) = time_compiled_call(f"{label}, filter", lambda: filtering(one.y))
    smoother_s, found = time_compiled_call(f"{label}, smoother", lambda: smoothing(one.y))
    mean, sd = map(np.asarray, paths(found))
    return {"filter_rmse": rmse(_filtered(problem, joint), one.paths), "log_likelihood": float(log_likelihood.sum()),
            **score_path("smoother", mean, interval(mean, sd), one.paths), "mean": mean, "sd": sd,
            "filter_seconds": filter_s, "smoother_seconds": smoother_s}, found


def _filtered(problem: Problem, joint: jax.Array) -> jax.Array:
    """Return filtered means (K, T) of the problem's paths from those (T, n) of the joint state."""
    given = true_likelihood(problem)
    names = (*given.model.state_names, *given.model.force_names)
    inputs = jax.vmap(given.ssm.inputs)(jnp.asarray(joint), jnp.asarray(default(problem).times))
    return inputs.T[np.array([names.index(name) for name in problem.paths])]
