"""Filtering and smoothing at the true parameters, by every method; the exact solution on a grid."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.ginzburg_landau import problem
from lfm_ppl.experiments.timing import time_call, time_compiled_call
from lfm_ppl.filtering.filter import filter as gaussian_filter
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.fokker_planck_grid import grid_filter
from lfm_ppl.fokker_planck_grid.finite_volume import Grid
from lfm_ppl.model.state_space import state_space
from lfm_ppl.particles.particle_filter import particle_filter
from lfm_ppl.particles.particle_smoother import particle_smoother

MARKS, APART = (11.8, 31.0), 2.0
"""Times whose densities are kept: those of the source's figure, though its path is another one. After them comes the
time at least so far apart from these at which the filtering density is most bimodal."""

PARTICLE_STEPS = {"steps": 2, "smoother_steps": 4}
"""Steps of the particles between two fine times: of strong order 1.5 in the filter, Euler's in the smoother."""

cells_of = functools.partial(Grid, -12.0, 12.0)
"""The grid with so many cells; at the truth, paths of 50 units of time stay within -7.5 and 7.5. With 400 cells the log
likelihood of 26 observations is 0.002 off at the truth, against 1600 cells on (-16, 16), and less than 0.06 anywhere
where a conditional posterior has mass."""

_LEVELS = (0.025, 0.975)


def compute(task: Task) -> Result:
    """Return what a method finds of a realisation on the fine times.

    Returns:
        ``filter_mean``, ``filter_low``, ``filter_high`` and the same of the smoother, (K,) each; their scores, see
        `judged`; ``log_likelihood``; CPU ``seconds`` of filter and smoother together, without compilation. Of the grid
        also the densities of both (3, N) at its centres ``x``, at the times ``marks`` (3,).
    """
    data = problem.realisation(task.settings["index"], task.seed)
    found = (_particles if task.settings["method"] == problem.PARTICLES else _by_program)(task, data)
    return found | judged("filter", found, data.path) | judged("smoother", found, data.path)


def judged(what: str, found: Result, path: np.ndarray) -> Result:
    """Return ``{what}_rmse``, and ``{what}_coverage``, the share of the path that lies in the 95% band."""
    return scores.score_path(what, found[f"{what}_mean"], (found[f"{what}_low"], found[f"{what}_high"]), path)


def band(what: str, mean: Any, sd: Any) -> Result:
    """Return mean and 95% band of a Gaussian as entries of a result."""
    low, high = scores.interval(mean, sd)
    return {f"{what}_mean": np.asarray(mean), f"{what}_low": low, f"{what}_high": high}


def size_of(settings: Any, data: problem.Realisation) -> int:
    """Return the cells of the grid, or the steps between two fine times that make ``steps`` between observations."""
    return settings.get("cells") or max(1, round(settings["steps"] * (len(data.times) - 1) / (len(data.fine) - 1)))


@functools.cache
def _program(method: str, size: int, fine: tuple[float, ...]) -> Callable:
    """Compile filter and smoother at the true parameters once for all realisations."""
    run = functools.partial(solved, method, jnp.asarray(problem.TRUTH), fine=np.array(fine), size=size)
    return jax.jit(run).lower(np.zeros((len(fine), 1))).compile()


def solved(method: str, theta: jax.Array, sparse: jax.Array, fine: np.ndarray, size: int) -> tuple:
    """Filter and smooth observations on the fine times (K, 1) by a Gaussian method or on the grid; for compiled code.

    Returns:
        The log likelihood; mean and variance, (K,) each, of the filter, and of the smoother; on the grid the masses of
        the cells, (K, N), of both.
    """
    system = problem.system(theta)
    if method in problem.GAUSSIAN:
        filtered = gaussian_filter(system, fine, sparse, problem.GAUSSIAN[method], size)
        smoothed = smooth(system, fine, sparse, problem.GAUSSIAN[method], size)
        return (smoothed.log_likelihood.sum(), (filtered.filtered_mean[:, 0], filtered.filtered_covariance[:, 0, 0]),
                (smoothed.mean[:, 0], smoothed.covariance[:, 0, 0]), ())
    ssm, cells = state_space(system), cells_of(size)
    time_grid = build_time_grid(ssm, fine, 1)
    transition = grid_filter.build_transition(grid_filter.on_grid(ssm, time_grid, cells), time_grid, 1)
    passed = grid_filter.forward(transition, time_grid, sparse[None], keep_masses=True)
    masses = passed.filtered[:, 0], grid_filter.backward(transition, time_grid, passed)[:, 0]
    means = [mass @ cells.centres for mass in masses]
    variances = [(mass * (cells.centres - mean[:, None]) ** 2).sum(axis=1)
                 for mass, mean in zip(masses, means, strict=True)]
    return passed.log_likelihood.sum(), *zip(means, variances, strict=True), masses


def _by_program(task: Task, data: problem.Realisation) -> Result:
    method, size = task.settings["method"], size_of(task.settings, data)
    seconds, (log_likelihood, *moments, masses) = time_call(_program(method, size, tuple(data.fine)), data.sparse)
    result: Result = {"log_likelihood": float(log_likelihood), "seconds": seconds}
    for what, (mean, variance) in zip(("filter", "smoother"), moments, strict=True):
        result |= band(what, mean, np.sqrt(variance))
    if method == problem.GRID:
        cells, filtered = cells_of(size), np.asarray(masses[0])
        apart = np.abs(data.fine[:, None] - np.asarray(MARKS)).min(axis=1) > APART
        third = np.flatnonzero(apart)[most_bimodal(filtered[apart])]
        shown = np.append(np.searchsorted(data.fine, np.asarray(MARKS) - 1e-9), third)
        result |= {"x": cells.centres, "marks": data.fine[shown]}
        for what, mass in zip(("filter", "smoother"), map(np.asarray, masses), strict=True):
            low, high = scores.density_quantiles(cells.centres, cells.width, mass, _LEVELS)
            result |= {f"{what}_low": low, f"{what}_high": high, f"{what}_density": mass[shown] / cells.width}
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


def _particles(task: Task, data: problem.Realisation) -> Result:
    settings, keys, given = task.settings, jax.random.split(task.key), (problem.true_system(), data.fine, data.sparse)
    filtering = functools.partial(particle_filter, keys[0], *given, particles=settings["particles"],
                                  steps=settings["steps"])
    smoothing = functools.partial(particle_smoother, keys[1], *given, particles=settings["smoother_particles"],
                                  draws=settings["smoother_draws"], steps=settings["smoother_steps"])
    filter_s, filtered = time_compiled_call(f"double well, {filtering.keywords}", filtering)
    smoother_s, smoothed = time_compiled_call(f"double well, {smoothing.keywords}", smoothing)
    draws = np.asarray(smoothed.draws)[:, :, 0]
    low, high = np.quantile(draws, _LEVELS, axis=0)
    return {**band("filter", filtered.mean[:, 0], np.sqrt(filtered.covariance[:, 0, 0])),
            "smoother_mean": draws.mean(0), "smoother_low": low, "smoother_high": high,
            "log_likelihood": float(np.sum(filtered.log_likelihood)), "seconds": filter_s + smoother_s}
