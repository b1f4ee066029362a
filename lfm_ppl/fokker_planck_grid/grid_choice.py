"""Choice of the bounds and the number of cells of a grid.

1. Start from bounds around the initial distribution, widened by the noise of the longest interval.
2. Filter on a coarse grid, and record the largest mass of each cell (the reach). While the cells next to a bound hold
   more than 1e-10, move this bound outwards.
3. Move the bounds inwards to the cells with mass, and repeat step 2, at most four times.
4. Start with cells two standard deviations of the sharpest likelihood wide.
5. Estimate the error of the log likelihood by comparison with half the cells, at second order. Raise the number of
   cells, in fixed steps so that few programs are compiled, until the error is below the tolerance.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.intervals import TimeGrid
from lfm_ppl.fokker_planck_grid.finite_volume import Grid
from lfm_ppl.fokker_planck_grid.grid_filter import log_likelihood_and_reach
from lfm_ppl.fokker_planck_grid.grid_model import Cells, drift_and_diffusion, on_grid
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.utils.gaussian_residuals import wrapped
from lfm_ppl.utils.programs import shared_jit

_COARSE_CELLS = 256
"""Number of cells of the grids on which the bounds are chosen."""

_MASS_AT_BOUND = 1e-10
"""Largest mass of a density in the three cells next to a bound."""

_MASS_CUT_OFF = 1e-11
"""Mass that may be cut off when the bounds move inwards; below `_MASS_AT_BOUND`, so that they do not move out again."""

_CELL_NUMBERS = (128, 192, 256, 384, 512, 768, 1024, 1536, 2048)
"""Numbers of cells to choose from: few, and often half of another one, so that few programs are compiled."""

PADDED_CELLS = _CELL_NUMBERS[-1]
"""Number of cells to which grids are padded outside compiled code; see `on_grid`."""

_ATTEMPTS = 60
"""Largest number of grids on which the bounds are tried."""


class GridProblem(eqx.Module):
    """A model and the time grid of its scan."""

    ssm: StateSpaceModel
    time_grid: TimeGrid

    def cells(self, grid: Grid) -> Cells:
        """Evaluate the model on a grid; not compiled, so that another model compiles nothing new.

        Raises:
            ValueError: drift or dispersion are not finite on the grid.
        """
        cells = on_grid(self.ssm, self.time_grid, grid, padded_cells=PADDED_CELLS)
        is_finite = np.isfinite(np.asarray(cells.process.up + cells.process.down))
        if not is_finite.all():
            x = grid.centres[int(np.argwhere(~is_finite)[0][-1])]
            raise ValueError(f"drift or dispersion are not finite near x = {x:g}, on a grid from {grid.low:g} to "
                             f"{grid.high:g}. Give bounds within which they are, such as bounds=(0.0, 10.0).")
        return cells

    def log_likelihood(self, y: jax.Array, grid: Grid) -> np.ndarray:
        """Return log p(y) (B,) of data sets (B, T, D)."""
        return np.asarray(_log_likelihood_and_reach(self.cells(grid), self.time_grid, y)[0])

    def reach(self, y: jax.Array, grid: Grid) -> np.ndarray:
        """Return the largest mass (N,) of each cell over all rows and data sets."""
        return np.asarray(_log_likelihood_and_reach(self.cells(grid), self.time_grid, y)[1])


_log_likelihood_and_reach = shared_jit(log_likelihood_and_reach)


def choose(problems: Sequence[GridProblem], y: jax.Array, bounds: tuple[float, float] | None, cells: int | None,
           tolerance: float) -> Grid:
    """Return one grid for all problems and data sets y (B, T, D); see `choose_grid`."""
    _check_dispersion(problems, bounds)
    low, high = _find_bounds(problems, y) if bounds is None else bounds
    if bounds is not None:
        _check_bounds(problems, Grid(low, high, _COARSE_CELLS))
    if cells is not None:
        return Grid(low, high, cells)
    count = _round_up(_initial_cells(problems, y, Grid(low, high, _COARSE_CELLS)))
    while True:
        grid = Grid(low, high, count)
        error = _discretisation_error(problems, y, grid)
        if error <= tolerance:
            return grid
        if count == _CELL_NUMBERS[-1]:
            warnings.warn(f"with {count} cells on [{low:g}, {high:g}] the estimated error of the log likelihood is "
                          f"still {error:.2g}, above the tolerance {tolerance:g}. Narrow the grid with bounds=, ask "
                          "for more cells= (time grows with their cube), or raise the tolerance.", stacklevel=3)
            return grid
        growth = 1.05 * np.sqrt(error / tolerance) if np.isfinite(error) else 2.0
        count = _round_up(count * float(np.clip(growth, 1.25, 4.0)))


def half_grid(grid: Grid) -> Grid:
    """Return the same grid with half the cells."""
    return grid._replace(cells=max(grid.cells // 2, 4))


def second_order_error(change: np.ndarray, grid: Grid, half: Grid) -> float:
    """Return the error on the grid of values that changed by ``change`` from half the cells to the grid.

    It is the largest of all values, and infinite if one is NaN.
    """
    largest = np.nan_to_num(np.abs(change), nan=np.inf).max()
    return float(largest / ((grid.cells / half.cells) ** 2 - 1.0))


def _discretisation_error(problems: Sequence[GridProblem], y: jax.Array, grid: Grid) -> float:
    half = half_grid(grid)
    with np.errstate(invalid="ignore"):
        return max(second_order_error(problem.log_likelihood(y, grid) - problem.log_likelihood(y, half), grid, half)
                   for problem in problems)


def _round_up(count: float) -> int:
    """Return the next larger of `_CELL_NUMBERS`, or the largest."""
    return next((cells for cells in _CELL_NUMBERS if cells >= count), _CELL_NUMBERS[-1])


def _find_bounds(problems: Sequence[GridProblem], y: jax.Array) -> tuple[float, float]:
    """Return bounds such that all densities of all problems are small next to them."""
    low, high = _initial_bounds(problems)
    growth, cuts = 0.5, 0
    for _ in range(_ATTEMPTS):
        grid = Grid(low, high, _COARSE_CELLS)
        reach = _largest_reach(problems, y, grid)
        is_low_reached, is_high_reached = reach[:3].sum() > _MASS_AT_BOUND, reach[-3:].sum() > _MASS_AT_BOUND
        if is_low_reached or is_high_reached:
            span = growth * (high - low)
            low, high = low - span * bool(is_low_reached), high + span * bool(is_high_reached)
            continue
        first = int(np.argmax(np.cumsum(reach) > _MASS_CUT_OFF))
        last = _COARSE_CELLS - int(np.argmax(np.cumsum(reach[::-1]) > _MASS_CUT_OFF))
        inner = grid.edges[max(first - 4, 0)], grid.edges[min(last + 4, _COARSE_CELLS)]
        if cuts == 4 or inner[1] - inner[0] > 0.9 * (high - low):
            return low, high
        low, high, growth, cuts = float(inner[0]), float(inner[1]), 0.1, cuts + 1
    raise ValueError(f"no bounds hold the density: after {_ATTEMPTS} attempts it still reaches the ends of "
                     f"[{low:g}, {high:g}]. Does the drift let the state run away? If not, give bounds=(low, high).")


def _initial_bounds(problems: Sequence[GridProblem]) -> tuple[float, float]:
    """Return the range of the initial distributions, widened by the noise of the longest interval."""
    bounds = []
    for problem in problems:
        ssm, time_grid = problem.ssm, problem.time_grid
        mean, covariance = (np.asarray(moment) for moment in ssm.initial())
        _, diffusion = drift_and_diffusion(ssm, jnp.asarray(mean[0]), jnp.asarray(time_grid.initial_time, float))
        longest = np.max(time_grid.intervals.length)
        half_width = 8.0 * np.sqrt(covariance[0, 0]) + 6.0 * np.sqrt(2.0 * float(diffusion) * longest)
        half_width = half_width if np.isfinite(half_width) and half_width > 0 else max(1.0, abs(mean[0]))
        bounds.append((float(mean[0] - half_width), float(mean[0] + half_width)))
    return min(low for low, _ in bounds), max(high for _, high in bounds)


def _largest_reach(problems: Sequence[GridProblem], y: jax.Array, grid: Grid) -> np.ndarray:
    """Return the largest mass (N,) of each cell over all problems."""
    largest = np.zeros(grid.cells)
    for problem in problems:
        reach = problem.reach(y, grid)
        if not np.isfinite(reach).all():
            raise ValueError(f"the filter failed on a grid from {grid.low:g} to {grid.high:g}: the likelihood of an "
                             "observation is zero or not finite in all cells. Is the observation function or "
                             "covariance finite there? If so, give bounds=(low, high).")
        largest = np.maximum(largest, reach)
    return largest


def _initial_cells(problems: Sequence[GridProblem], y: jax.Array, grid: Grid) -> float:
    """Return the number of cells that are two standard deviations wide of the sharpest likelihood in the state."""
    sharpest = 0.0
    for problem in problems:
        cells = problem.cells(grid)
        change = np.asarray(cells.value[..., -1, :] - cells.value[..., 0, :])
        change = np.asarray(wrapped(jnp.asarray(change), cells.period)) if np.any(cells.angular) else change
        noise = np.broadcast_to(np.asarray(cells.noise)[:, :, 0], (*np.shape(cells.noise)[:2], *cells.noise.shape[-2:]))
        # Only cells that hold mass count.
        is_reached = problem.reach(y, grid) > 1e-6
        noise = noise[:, is_reached] if noise.shape[1] > 1 else noise
        change = change[:, is_reached]
        information = (change * np.linalg.solve(noise, change[..., None])[..., 0]).sum(-1)
        sharpest = max(sharpest, float(np.max(information)))
    # The outermost of the five nodes are 0.906 of a cell's width apart.
    return 0.5 * grid.cells * float(np.sqrt(sharpest)) / 0.906


def _check_dispersion(problems: Sequence[GridProblem], bounds: tuple[float, float] | None) -> None:
    """Raise ValueError if the dispersion of a model is zero between the bounds."""
    low, high = _initial_bounds(problems) if bounds is None else bounds
    points = jnp.linspace(low, high, 11)
    for problem in problems:
        t = jnp.asarray(problem.time_grid.initial_time, float)
        diffusion = jax.vmap(lambda s, ssm=problem.ssm, t=t: drift_and_diffusion(ssm, s, t)[1])(points)
        if np.all(np.asarray(diffusion) == 0):
            raise ValueError(f"the process noise is zero everywhere between {low:g} and {high:g}: without noise the "
                             "state has no density that could spread over a grid. Use lfm.filter.")


def _check_bounds(problems: Sequence[GridProblem], grid: Grid) -> None:
    """Raise ValueError if less than half of the initial probability of a model lies between the bounds."""
    for problem in problems:
        probability = float(problem.cells(grid).initial.sum())
        if probability < 0.5:
            raise ValueError(f"bounds=({grid.low:g}, {grid.high:g}) hold only {probability:.2g} of the initial "
                             f"probability, whose mean is {float(problem.ssm.initial()[0][0]):g}. Widen them.")
