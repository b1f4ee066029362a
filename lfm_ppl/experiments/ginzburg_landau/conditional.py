"""Posteriors of one parameter given the others at the truth: does the central 99% interval hold the truth?"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.ginzburg_landau import grid, problem
from lfm_ppl.experiments.study import blocks
from lfm_ppl.experiments.timing import timed
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood
from lfm_ppl.model.state_space import state_space
from lfm_ppl.particles import particle_filter

INTERVALS = {"alpha": (-2.0, 1.5), "beta": (0.04, 1.5), "sigma": (1.0, 16.0)}
"""Where the flat priors lie."""

OUTSIDE = 0.01
"""The truth is outside of the central 99% interval."""

_CHUNK = 10
"""Realisations of one task."""

_PARTICLE_STEPS = 20
"""Steps of the particle filter between two observations."""


def nodes(name: str, count: int) -> np.ndarray:
    """Return the values of a parameter at which the likelihood is computed: denser where the parameter is smaller.

    Example:
        >>> [round(float(v), 3) for v in nodes("sigma", 3)]
        [1.0, 4.0, 16.0]
    """
    low, high = INTERVALS[name]
    return np.linspace(low, high, count) if low <= 0 else np.geomspace(low, high, count)


def thetas(count: int) -> np.ndarray:
    """Return the parameters (3 count, 3) of all nodes of alpha, then beta, then sigma."""
    rows = np.tile(np.asarray(problem.TRUTH), (3, count, 1))
    for index, name in enumerate(problem.NAMES):
        rows[index, :, index] = nodes(name, count)
    return rows.reshape(-1, 3)


def _as_lists() -> dict[str, list[float]]:
    return {name: list(ends) for name, ends in INTERVALS.items()}


def tasks(settings: Any) -> list[Task]:
    """Return one task for each method and ten realisations."""
    found = []
    for method in problem.METHODS:
        own: dict[str, Any] = {"steps": problem.STEPS}
        if method == problem.PARTICLES:
            own = {"particles": settings.conditional_particles, "steps": _PARTICLE_STEPS}
        elif method == problem.GRID:
            own = {"cells": settings.cells}
        for first, last in blocks(settings.conditional, _CHUNK):
            found.append(Task(
                f"conditional/{problem.slug(method)}/{first:03d}-{last:03d}", settings.seed,
                {"experiment": "ginzburg-landau", "what": "conditional", "method": method, "first": first,
                 "last": last, "nodes": settings.nodes, "intervals": _as_lists(), **own}))
    return found


def figure_task(settings: Any) -> Task:
    """Return the task of the particle filter on the realisation of the figure, with as many particles as the source."""
    return Task(
        "conditional-figure/particle-filter", settings.seed,
        {"experiment": "ginzburg-landau", "what": "conditional", "method": problem.PARTICLES,
         "first": settings.figure, "last": settings.figure, "nodes": settings.nodes, "intervals": _as_lists(),
         "particles": settings.particles, "steps": _PARTICLE_STEPS})


def compute(task: Task) -> Result:
    """Return ``log_likelihood`` (realisations, 3, nodes) and the CPU seconds taken, compilation apart."""
    settings = task.settings
    indices = range(settings["first"], settings["last"] + 1)
    data = [problem.realisation(index, task.seed) for index in indices]
    y = np.stack([one.y for one in data])
    method, count = settings["method"], settings["nodes"]
    times = tuple(data[0].times)
    if method in problem.GAUSSIAN:
        run = _gaussian_program(method, settings["steps"], times, y.shape, count)
        arguments: tuple = (jnp.asarray(y),)
    elif method == problem.GRID:
        run = _grid_program(settings["cells"], times, y.shape, count)
        arguments = (jnp.asarray(y),)
    else:
        run = _particle_program(settings["particles"], settings["steps"], times, y.shape, count)
        arguments = (jnp.asarray(y), jax.vmap(lambda k: jax.random.fold_in(jax.random.key(task.seed), k))(
            jnp.asarray(indices)))
    seconds, values = timed(run, *arguments)
    return {"log_likelihood": np.asarray(values).reshape(len(y), 3, count), "seconds": seconds}


@functools.cache
def _gaussian_program(method: str, steps: int, times: tuple[float, ...], shape: tuple[int, ...],
                      count: int) -> Callable:
    rule = problem.GAUSSIAN[method]

    def one(theta: jax.Array, y: jax.Array) -> jax.Array:
        return MarginalLikelihood(problem.system(theta), np.array(times), rule=rule, steps=steps).log_prob(y)

    def run(y: jax.Array) -> jax.Array:
        # All parameter values side by side, one realisation after another, is faster than all at once.
        points = jnp.asarray(thetas(count))
        return jax.lax.map(lambda row: jax.vmap(one, in_axes=(0, None))(points, row), y)

    return _compiled(run, shape)


@functools.cache
def _grid_program(cells: int, times: tuple[float, ...], shape: tuple[int, ...], count: int) -> Callable:
    return _compiled(lambda y: grid.log_likelihoods(thetas(count), y, np.array(times), cells), shape)


@functools.cache
def _particle_program(particles: int, steps: int, times: tuple[float, ...], shape: tuple[int, ...],
                      count: int) -> Callable:
    def run(y: jax.Array, keys: jax.Array) -> jax.Array:
        def one(theta: jax.Array, row: jax.Array, key: jax.Array) -> jax.Array:
            ssm = state_space(problem.system(theta))
            time_grid = build_time_grid(ssm, np.array(times), steps)
            settings = particle_filter.check_settings(ssm, particle_filter.ParticleSettings(particles))
            return particle_filter.log_likelihood(ssm, time_grid, row, key, settings)

        points = jnp.asarray(thetas(count))

        def each(pair: tuple[jax.Array, jax.Array]) -> jax.Array:
            row, key = pair
            # The same random numbers at every parameter value: a posterior feels only differences between them.
            return jax.lax.map(lambda theta: one(theta, row, key), points)

        return jax.lax.map(each, (y, keys))

    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), shape[0]))
    return _compiled(run, shape, keys)


def _compiled(run: Callable, shape: tuple[int, ...], *others: Any) -> Callable:
    return jax.jit(run).lower(jax.ShapeDtypeStruct(shape, float), *others).compile()


def posterior(log_likelihood: Any, name: str) -> scores.GridPosterior:
    """Return the conditional posterior of a parameter from a row (nodes,) of what `compute` found."""
    return scores.GridPosterior(nodes(name, len(log_likelihood)), log_likelihood)


def outcomes(results: dict[str, Result]) -> dict[str, dict[str, np.ndarray]]:
    """Judge the conditional posteriors of every method.

    Args:
        results: of the tasks, by name.

    Returns:
        Method -> ``below`` (realisations, 3), the posterior probability of a value below the truth; ``outside``,
        whether the truth lies outside the central 99% interval; ``cut``, whether an end of the flat prior's interval
        cuts the posterior off; ``seconds`` (1,), of CPU time, for all realisations together.
    """
    found: dict[str, dict[str, np.ndarray]] = {}
    for method in problem.METHODS:
        prefix = f"conditional/{problem.slug(method)}/"
        own = [results[name] for name in sorted(results) if name.startswith(prefix)]
        if not own:
            continue
        rows = np.concatenate([result["log_likelihood"] for result in own])
        below, cut = np.empty(rows.shape[:2]), np.empty(rows.shape[:2], bool)
        for index in np.ndindex(rows.shape[:2]):
            name = problem.NAMES[index[1]]
            one = posterior(rows[index], name)
            below[index], cut[index] = one.below(problem.TRUTH[index[1]]), one.cut()
        found[method] = {"below": below, "cut": cut, "seconds": np.array([sum(r["seconds"] for r in own)]),
                         "outside": (below < OUTSIDE / 2) | (below > 1 - OUTSIDE / 2)}
    return found
