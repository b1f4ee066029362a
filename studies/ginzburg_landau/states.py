"""Filtering and smoothing at the true parameters by every method.

1. Gaussian methods filter and smooth on the fine times, with missing observations between the data.
2. The grid discretises the state by finite volumes. Forward and backward passes with its transition matrix give the
   exact densities, up to the error of discretisation.
3. Particles filter with steps of strong order 1.5, and smooth by drawing trajectories.
4. All results become means, 95% bands, RMSE and coverage; the grid adds densities at three times.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import lfm_ppl as lfm
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.fokker_planck_grid import grid_filter
from lfm_ppl.fokker_planck_grid.finite_volume import Grid
from lfm_ppl.model.state_space import state_space
from lfm_ppl.parallel.task import Result, Task

from .. import scores
from ..timing import time_call, time_compiled_call
from . import problem

MARKS, APART = (11.8, 31.0), 2.0
"""Times of the stored densities, from the source's figure of another path, and the smallest distance from them of a
third time, at which the filtering density is most bimodal."""

PARTICLE_STEPS = {"steps": 2, "smoother_steps": 4}
"""Steps of the particles between two fine times: of strong order 1.5 in the filter, Euler's in the smoother."""

build_grid = functools.partial(Grid, -12.0, 12.0)
"""Grid with a given number of cells. At the truth, paths of 50 units of time stay between -7.5 and 7.5. Against 1600
cells on (-16, 16), the log likelihood of 26 observations with 400 cells has an error of 0.002 at the truth, and of less
than 0.06 wherever a conditional posterior has mass."""

_LEVELS = (0.025, 0.975)


def compute(task: Task) -> Result:
    """Filter and smooth a realisation on the fine times by one method.

    Returns:
        ``filter_mean``, ``filter_low``, ``filter_high`` and the same for the smoother, (K,) each; their scores, see
        `score_path`; ``log_likelihood``; CPU ``seconds`` of filter and smoother together, without compilation. The grid
        adds both densities (3, N) at its cell centres ``x`` and the times ``marks`` (3,).
    """
    data = problem.realisation(task.settings["index"], task.seed)
    estimates = (_run_particles if task.settings["method"] == problem.PARTICLES else _solve)(task, data)
    return estimates | score_path("filter", estimates, data.path) | score_path("smoother", estimates, data.path)


def score_path(prefix: str, estimates: Result, path: np.ndarray) -> Result:
    """Return ``{prefix}_rmse`` and ``{prefix}_coverage`` of an estimated path, see `scores.score_path`."""
    mean, low, high = (estimates[f"{prefix}_{name}"] for name in ("mean", "low", "high"))
    return scores.score_path(prefix, mean, (low, high), path)


def band(prefix: str, mean: Any, sd: Any) -> Result:
    """Return mean and 95% band of a Gaussian as entries of a result."""
    low, high = scores.interval(mean, sd)
    return {f"{prefix}_mean": np.asarray(mean), f"{prefix}_low": low, f"{prefix}_high": high}


def solver_size(settings: Any, data: problem.Realisation) -> int:
    """Return the number of grid cells, or of integration steps between two fine times."""
    return settings.get("cells") or max(1, round(settings["steps"] * (len(data.times) - 1) / (len(data.fine) - 1)))


@functools.cache
def _compile_solver(method: str, size: int, fine: tuple[float, ...]) -> Callable:
    """Compile filter and smoother at the true parameters once for all realisations."""
    run = functools.partial(solve, method, jnp.asarray(problem.TRUTH), fine=np.array(fine), size=size)
    return jax.jit(run).lower(np.zeros((len(fine), 1))).compile()


def solve(method: str, theta: jax.Array, sparse: jax.Array, fine: np.ndarray, size: int) -> tuple:
    """Filter and smooth observations on the fine times (K, 1) by a Gaussian method or on the grid; for compiled code.

    Returns:
        The log likelihood; mean and variance, (K,) each, of the filter, and of the smoother; on the grid the masses of
        the cells, (K, N), of both.
    """
    system = problem.system(theta)
    if method in problem.GAUSSIAN:
        filtered = lfm.filter(system, fine, sparse, problem.GAUSSIAN[method], size)
        smoothed = lfm.smooth(system, fine, sparse, problem.GAUSSIAN[method], size, iterations=0)
        return (smoothed.log_likelihood.sum(), (filtered.filtered_mean[:, 0], filtered.filtered_covariance[:, 0, 0]),
                (smoothed.mean[:, 0], smoothed.covariance[:, 0, 0]), ())
    ssm, cells = state_space(system), build_grid(size)
    time_grid = build_time_grid(ssm, fine, 1)
    transition = grid_filter.build_transition(grid_filter.on_grid(ssm, time_grid, cells), time_grid, 1)
    forward = grid_filter.forward(transition, time_grid, sparse[None], keep_masses=True)
    masses = forward.filtered[:, 0], grid_filter.backward(transition, time_grid, forward)[:, 0]
    means = [mass @ cells.centres for mass in masses]
    variances = [(mass * (cells.centres - mean[:, None]) ** 2).sum(axis=1)
                 for mass, mean in zip(masses, means, strict=True)]
    return forward.log_likelihood.sum(), *zip(means, variances, strict=True), masses


def _solve(task: Task, data: problem.Realisation) -> Result:
    method, size = task.settings["method"], solver_size(task.settings, data)
    solver = _compile_solver(method, size, tuple(data.fine))
    seconds, (log_likelihood, *moments, masses) = time_call(solver, data.sparse)
    result: Result = {"log_likelihood": float(log_likelihood), "seconds": seconds}
    for prefix, (mean, variance) in zip(("filter", "smoother"), moments, strict=True):
        result |= band(prefix, mean, np.sqrt(variance))
    if method == problem.GRID:
        cells, filtered = build_grid(size), np.asarray(masses[0])
        is_distant = np.abs(data.fine[:, None] - np.asarray(MARKS)).min(axis=1) > APART
        bimodal_index = np.flatnonzero(is_distant)[most_bimodal_index(filtered[is_distant])]
        mark_indices = np.append(np.searchsorted(data.fine, np.asarray(MARKS) - 1e-9), bimodal_index)
        result |= {"x": cells.centres, "marks": data.fine[mark_indices]}
        for prefix, mass in zip(("filter", "smoother"), map(np.asarray, masses), strict=True):
            low, high = scores.density_quantiles(cells.centres, cells.width, mass, _LEVELS)
            density = mass[mark_indices] / cells.width
            result |= {f"{prefix}_low": low, f"{prefix}_high": high, f"{prefix}_density": density}
    return result


def most_bimodal_index(densities: np.ndarray) -> int:
    """Return the index of the density (K, N) whose two highest modes have the deepest valley between them.

    The depth is the difference between the lower mode and the valley, relative to the higher mode.

    Example:
        >>> x = np.linspace(-4.0, 4.0, 81)
        >>> hill = lambda mode: np.exp(-2.0 * (x - mode) ** 2)
        >>> most_bimodal_index(np.stack([hill(0.0), hill(-2.0) + 0.5 * hill(2.0), hill(-2.0) + hill(2.0)]))
        2
    """
    # Largest density on each side of every cell; a valley lies below the smaller of the two.
    left_maximum = np.maximum.accumulate(densities, axis=1)
    right_maximum = np.maximum.accumulate(densities[:, ::-1], axis=1)[:, ::-1]
    depth = (np.minimum(left_maximum, right_maximum) - densities).max(axis=1) / densities.max(axis=1)
    return int(np.argmax(depth))


def _run_particles(task: Task, data: problem.Realisation) -> Result:
    settings, keys = task.settings, jax.random.split(task.key)
    inputs = problem.true_system(), data.fine, data.sparse
    filtering = functools.partial(lfm.particle_filter, keys[0], *inputs, particles=settings["particles"],
                                  steps=settings["steps"])
    smoothing = functools.partial(lfm.particle_smoother, keys[1], *inputs, particles=settings["smoother_particles"],
                                  draws=settings["smoother_draws"], steps=settings["smoother_steps"])
    filter_s, filtered = time_compiled_call(f"double well, {filtering.keywords}", filtering)
    smoother_s, smoothed = time_compiled_call(f"double well, {smoothing.keywords}", smoothing)
    draws = np.asarray(smoothed.draws)[:, :, 0]
    low, high = np.quantile(draws, _LEVELS, axis=0)
    return {**band("filter", filtered.mean[:, 0], np.sqrt(filtered.covariance[:, 0, 0])),
            "smoother_mean": draws.mean(0), "smoother_low": low, "smoother_high": high,
            "log_likelihood": float(np.sum(filtered.log_likelihood)), "seconds": filter_s + smoother_s}
