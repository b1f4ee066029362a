"""Filtering and smoothing at the true parameters, by every method."""

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
from lfm_ppl.experiments.timing import timed
from lfm_ppl.filtering.filter import filter as gaussian_filter
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.particles.particle_filter import particle_filter
from lfm_ppl.particles.particle_smoother import particle_smoother

MARKS = (11.8, 31.0)
"""Times whose densities are kept: those of the source's figure, though its path is another one. After them comes the
time elsewhere at which the filtering density is most bimodal."""

_APART = 2.0
"""Least distance of that third time from the other two."""

LEVELS = (0.025, 0.975)
_FILTER_STEPS, _SMOOTHER_STEPS = 2, 4
"""Steps of the particles between two fine times: of strong order 1.5 in the filter, Euler's in the smoother."""

_Z = 1.959963984540054
"""97.5% quantile of the standard normal distribution."""


def tasks(settings: Any) -> list[Task]:
    """Return one task for each method and realisation."""
    common = {"experiment": "ginzburg-landau", "what": "state"}
    own: dict[str, dict[str, Any]] = {name: {"steps": problem.STEPS} for name in problem.GAUSSIAN}
    own[problem.PARTICLES] = {"particles": settings.particles, "smoother_particles": settings.smoother_particles,
                              "smoother_draws": settings.smoother_draws, "steps": _FILTER_STEPS,
                              "smoother_steps": _SMOOTHER_STEPS}
    own[problem.GRID] = {"cells": settings.cells, "marks": list(MARKS), "apart": _APART}
    return [Task(f"state/{problem.slug(method)}/{index:03d}", settings.seed,
                 {**common, "method": method, "index": index, **own[method]})
            for method in problem.METHODS for index in range(settings.realisations)]


def compute(task: Task) -> Result:
    """Return filtered and smoothed mean and 95% band on the fine times, their scores, and the CPU seconds taken."""
    method = task.settings["method"]
    data = problem.realisation(task.settings["index"], task.seed)
    found = estimate(method, data, task.settings, task.key)
    return found | _scores(found, data.path)


def estimate(method: str, data: problem.Realisation, settings: Any, key: jax.Array) -> Result:
    """Return filtered and smoothed moments and 95% bands of a realisation at the true parameters.

    Args:
        method: one of `problem.METHODS`.
        data: the realisation.
        settings: of the task.
        key: a JAX random key.

    Returns:
        ``filter_mean``, ``filter_low``, ``filter_high`` and the same of the smoother, each (K,); ``log_likelihood``;
        CPU ``seconds`` of filter and smoother together, without compilation.
    """
    if method in problem.GAUSSIAN:
        return _gaussian(method, data, settings["steps"])
    if method == problem.GRID:
        return _grid(data, settings["cells"])
    return _particles(data, settings, key)


def _gaussian(method: str, data: problem.Realisation, steps: int) -> Result:
    run = _gaussian_program(method, steps_between(data, steps), tuple(data.fine))
    seconds, (filtered, smoothed, log_likelihood) = timed(run, jnp.asarray(data.sparse))
    return {**band("filter", *filtered), **band("smoother", *smoothed), "log_likelihood": float(log_likelihood),
            "seconds": seconds}


def steps_between(data: problem.Realisation, steps: int) -> int:
    """Return the integration steps between two fine times that make ``steps`` between two observations."""
    return max(1, round(steps * (len(data.times) - 1) / (len(data.fine) - 1)))


@functools.cache
def _gaussian_program(method: str, steps: int, fine: tuple[float, ...]) -> Callable:
    """Compile filter and smoother once for all realisations."""
    model, rule = problem.true_system(), problem.GAUSSIAN[method]

    def run(sparse: jax.Array) -> tuple:
        filtered = gaussian_filter(model, np.array(fine), sparse, rule, steps)
        smoothed = smooth(model, np.array(fine), sparse, rule, steps)
        return ((filtered.filtered_mean[:, 0], jnp.sqrt(filtered.filtered_covariance[:, 0, 0])),
                (smoothed.mean[:, 0], jnp.sqrt(smoothed.covariance[:, 0, 0])), smoothed.log_likelihood.sum())

    return jax.jit(run).lower(jax.ShapeDtypeStruct((len(fine), 1), float)).compile()


def _grid(data: problem.Realisation, cells: int) -> Result:
    run = grid.densities_program(cells, tuple(data.fine))
    seconds, (log_likelihood, *masses) = timed(run, jnp.asarray(data.sparse))
    cell = grid.cells_of(cells)
    result: Result = {"seconds": seconds, "log_likelihood": float(log_likelihood), "x": cell.centres}
    both = [np.asarray(mass) for mass in masses]
    apart = np.abs(data.fine[:, None] - np.asarray(MARKS)).min(axis=1) > _APART
    third = np.flatnonzero(apart)[most_bimodal(both[0][apart])]
    kept = np.append(np.searchsorted(data.fine, np.asarray(MARKS) - 1e-9), third)
    result["marks"] = data.fine[kept]
    for what, mass in zip(("filter", "smoother"), both, strict=True):
        low, high = scores.density_quantiles(cell.centres, cell.width, mass, LEVELS)
        result |= {f"{what}_mean": mass @ cell.centres, f"{what}_low": low, f"{what}_high": high,
                   f"{what}_density": mass[kept] / cell.width}
    return result


def most_bimodal(densities: np.ndarray) -> int:
    """Return the index of the density (K, N) whose two highest modes have the deepest valley between them.

    The depth is that of the valley under the lower mode, as a share of the higher one.

    Example:
        >>> x = np.linspace(-4.0, 4.0, 81)
        >>> hill = lambda at: np.exp(-2.0 * (x - at) ** 2)
        >>> most_bimodal(np.stack([hill(0.0), hill(-2.0) + 0.5 * hill(2.0), hill(-2.0) + hill(2.0)]))
        2
    """
    # Seen from a place, the higher sides' tops; a valley lies under the lower of the two.
    left = np.maximum.accumulate(densities, axis=1)
    right = np.maximum.accumulate(densities[:, ::-1], axis=1)[:, ::-1]
    depth = (np.minimum(left, right) - densities).max(axis=1) / densities.max(axis=1)
    return int(np.argmax(depth))


def _particles(data: problem.Realisation, settings: Any, key: jax.Array) -> Result:
    model = problem.true_system()
    keys = jax.random.split(key)
    filter_s, filtered = timed(_warm("particle filter", lambda: particle_filter(
        keys[0], model, data.fine, data.sparse, particles=settings["particles"], steps=settings["steps"])))
    smoother_s, smoothed = timed(_warm("particle smoother", lambda: particle_smoother(
        keys[1], model, data.fine, data.sparse, particles=settings["smoother_particles"],
        draws=settings["smoother_draws"], steps=settings["smoother_steps"])))
    sd = np.sqrt(np.asarray(filtered.covariance)[:, 0, 0])
    draws = np.asarray(smoothed.draws)[:, :, 0]
    low, high = np.quantile(draws, LEVELS, axis=0)
    return {**band("filter", np.asarray(filtered.mean)[:, 0], sd), "smoother_mean": draws.mean(0),
            "smoother_low": low, "smoother_high": high,
            "log_likelihood": float(np.sum(filtered.log_likelihood)), "seconds": filter_s + smoother_s}


def band(what: str, mean: Any, sd: Any) -> Result:
    """Return mean and 95% band of a Gaussian as entries of a result."""
    mean, sd = np.asarray(mean), np.asarray(sd)
    return {f"{what}_mean": mean, f"{what}_low": mean - _Z * sd, f"{what}_high": mean + _Z * sd}


def _scores(found: Result, path: np.ndarray) -> Result:
    return {f"{what}_{score}": value for what in ("filter", "smoother") for score, value in (
        ("rmse", scores.rmse(found[f"{what}_mean"], path)),
        ("coverage", scores.covered(found[f"{what}_low"], found[f"{what}_high"], path)))}


_warmed: set[str] = set()


def _warm(label: str, run: Callable[[], Any]) -> Callable[[], Any]:
    """Run a function once before it is timed, the first time in this process, so that it is compiled."""
    if label not in _warmed:
        jax.block_until_ready(jax.tree_util.tree_leaves(run()))
        _warmed.add(label)
    return run
