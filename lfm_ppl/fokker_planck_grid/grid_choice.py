"""Ends and resolution of a grid, from the densities that it has to hold."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.time_grid import TimeGrid
from lfm_ppl.fokker_planck_grid.finite_volume import Grid
from lfm_ppl.fokker_planck_grid.grid_filter import total_and_reach
from lfm_ppl.fokker_planck_grid.grid_model import Cells, drift_and_diffusion, on_grid
from lfm_ppl.gaussian_residuals import wrapped
from lfm_ppl.model.state_space import StateSpaceModel

_SCOUT = 256
"""Cells of the grids with which the ends are found."""

_AT_THE_ENDS = 1e-10
"""Largest mass of a density in the three cells next to an end."""

_OUTSIDE = 1e-11
"""Mass that may be cut off when the ends move in; below `_AT_THE_ENDS`, so that they do not move out again."""

_LADDER = (128, 192, 256, 384, 512, 768, 1024, 1536, 2048)
"""Numbers of cells to choose from; few, and with halves among them, so that few programs are compiled."""

ROOM = _LADDER[-1]
"""Cells for which the functions of a model are evaluated outside compiled code; see `on_grid`."""

_ATTEMPTS = 60


class GridProblem(NamedTuple):
    """A model with the rows of its scan."""

    ssm: StateSpaceModel
    time_grid: TimeGrid

    def cells(self, grid: Grid) -> Cells:
        """Put the model on a grid; not compiled, so that another model compiles nothing new.

        Raises:
            ValueError: drift or dispersion are not finite on the grid, or the dispersion is zero all over it.
        """
        cells = on_grid(self.ssm, self.time_grid, grid, room=ROOM)
        fine = np.isfinite(np.asarray(cells.chain.up + cells.chain.down))
        if not fine.all():
            place = grid.centres[int(np.argwhere(~fine)[0][-1])]
            raise ValueError(f"drift or dispersion are not finite near x = {place:g}, on a grid from {grid.low:g} to "
                             f"{grid.high:g}. Give bounds within which they are, such as bounds=(0.0, 10.0).")
        return cells

    def total(self, y: jax.Array, grid: Grid) -> np.ndarray:
        """Return log p(y) (B,) of data sets (B, T, D)."""
        return np.asarray(_run(self.cells(grid), self.time_grid, y)[0])

    def reach(self, y: jax.Array, grid: Grid) -> np.ndarray:
        """Return the largest mass (N,) that any cell has."""
        return np.asarray(_run(self.cells(grid), self.time_grid, y)[1])


_run = eqx.filter_jit(total_and_reach)


def choose(problems: Sequence[GridProblem], y: jax.Array, bounds: tuple[float, float] | None, cells: int | None,
           tolerance: float) -> Grid:
    """Return a grid that serves all problems and data sets y (B, T, D); see `choose_grid`."""
    _check_dispersion(problems, bounds)
    low, high = _find_bounds(problems, y) if bounds is None else bounds
    if bounds is not None:
        _check_bounds(problems, Grid(low, high, _SCOUT))
    if cells is not None:
        return Grid(low, high, cells)
    count = _on_ladder(_first_cells(problems, y, Grid(low, high, _SCOUT)))
    while True:
        grid = Grid(low, high, count)
        error = _discretisation_error(problems, y, grid)
        if error <= tolerance:
            return grid
        if count == _LADDER[-1]:
            warnings.warn(f"with {count} cells on [{low:g}, {high:g}] the estimated error of the log likelihood is "
                          f"still {error:.2g}, above the tolerance {tolerance:g}. Narrow the grid with bounds=, ask "
                          "for more cells= (time grows with their cube), or raise the tolerance.", stacklevel=3)
            return grid
        growth = 1.05 * np.sqrt(error / tolerance) if np.isfinite(error) else 2.0
        count = _on_ladder(count * float(np.clip(growth, 1.25, 4.0)))


def half_grid(grid: Grid) -> Grid:
    """Return the same grid with half the cells."""
    return grid._replace(cells=max(grid.cells // 2, 4))


def second_order_error(change: np.ndarray, grid: Grid, half: Grid) -> float:
    """Return the largest error of values that changed by so much from the half grid to the grid; inf for failures."""
    largest = np.nan_to_num(np.abs(change), nan=np.inf).max()
    return float(largest / ((grid.cells / half.cells) ** 2 - 1.0))


def _discretisation_error(problems: Sequence[GridProblem], y: jax.Array, grid: Grid) -> float:
    half = half_grid(grid)
    with np.errstate(invalid="ignore"):
        return max(second_order_error(one.total(y, grid) - one.total(y, half), grid, half) for one in problems)


def _on_ladder(count: float) -> int:
    return next((cells for cells in _LADDER if cells >= count), _LADDER[-1])


def _find_bounds(problems: Sequence[GridProblem], y: jax.Array) -> tuple[float, float]:
    low, high = _first_bounds(problems)
    growth, cuts = 0.5, 0
    for _ in range(_ATTEMPTS):
        grid = Grid(low, high, _SCOUT)
        reach = _largest_reach(problems, y, grid)
        at_ends = reach[:3].sum() > _AT_THE_ENDS, reach[-3:].sum() > _AT_THE_ENDS
        if any(at_ends):
            span = growth * (high - low)
            low, high = low - span * bool(at_ends[0]), high + span * bool(at_ends[1])
            continue
        first = int(np.argmax(np.cumsum(reach) > _OUTSIDE))
        last = _SCOUT - int(np.argmax(np.cumsum(reach[::-1]) > _OUTSIDE))
        inner = grid.edges[max(first - 4, 0)], grid.edges[min(last + 4, _SCOUT)]
        if cuts == 4 or inner[1] - inner[0] > 0.9 * (high - low):
            return low, high
        low, high, growth, cuts = float(inner[0]), float(inner[1]), 0.1, cuts + 1
    raise ValueError(f"no bounds hold the density: after {_ATTEMPTS} attempts it still reaches the ends of "
                     f"[{low:g}, {high:g}]. Does the drift let the state run away? If not, give bounds=(low, high).")


def _first_bounds(problems: Sequence[GridProblem]) -> tuple[float, float]:
    """The initial distribution, widened by what the noise adds in the longest interval."""
    ends = []
    for ssm, time_grid in problems:
        mean, covariance = (np.asarray(moment) for moment in ssm.initial())
        _, diffusion = drift_and_diffusion(ssm, jnp.asarray(mean[0]), jnp.asarray(time_grid.initial_time, float))
        longest = np.max(time_grid.intervals.length)
        reach = 8.0 * np.sqrt(covariance[0, 0]) + 6.0 * np.sqrt(2.0 * float(diffusion) * longest)
        reach = reach if np.isfinite(reach) and reach > 0 else max(1.0, abs(mean[0]))
        ends.append((float(mean[0] - reach), float(mean[0] + reach)))
    return min(low for low, _ in ends), max(high for _, high in ends)


def _largest_reach(problems: Sequence[GridProblem], y: jax.Array, grid: Grid) -> np.ndarray:
    reach = np.zeros(grid.cells)
    for problem in problems:
        one = problem.reach(y, grid)
        if not np.isfinite(one).all():
            raise ValueError(f"the filter failed on a grid from {grid.low:g} to {grid.high:g}: an observation has no "
                             "likelihood anywhere on it. Is the observation function or covariance finite there? If "
                             "so, give bounds=(low, high).")
        reach = np.maximum(reach, one)
    return reach


def _first_cells(problems: Sequence[GridProblem], y: jax.Array, grid: Grid) -> float:
    """Cells as wide as two standard deviations of the sharpest likelihood, as a function of the state."""
    sharpest = 0.0
    for problem in problems:
        cells = problem.cells(grid)
        change = np.asarray(cells.value[..., -1, :] - cells.value[..., 0, :])
        change = np.asarray(wrapped(jnp.asarray(change))) if np.any(cells.angular) else change
        noise = np.broadcast_to(np.asarray(cells.noise)[:, :, 0], (*np.shape(cells.noise)[:2], *cells.noise.shape[-2:]))
        held = problem.reach(y, grid) > 1e-6
        noise = noise[:, held] if noise.shape[1] > 1 else noise
        change = change[:, held]
        information = (change * np.linalg.solve(noise, change[..., None])[..., 0]).sum(-1)
        sharpest = max(sharpest, float(np.max(information)))
    # The outermost of the five nodes are 0.906 of a cell's width apart.
    return 0.5 * grid.cells * float(np.sqrt(sharpest)) / 0.906


def _check_dispersion(problems: Sequence[GridProblem], bounds: tuple[float, float] | None) -> None:
    low, high = _first_bounds(problems) if bounds is None else bounds
    places = jnp.linspace(low, high, 11)
    for ssm, time_grid in problems:
        t = jnp.asarray(time_grid.initial_time, float)
        diffusion = jax.vmap(lambda s, ssm=ssm, t=t: drift_and_diffusion(ssm, s, t)[1])(places)
        if np.all(np.asarray(diffusion) == 0):
            raise ValueError(f"the process noise is zero everywhere between {low:g} and {high:g}: without noise the "
                             "state has no density that could spread over a grid. Use lfm.filter.")


def _check_bounds(problems: Sequence[GridProblem], grid: Grid) -> None:
    for problem in problems:
        held = float(problem.cells(grid).initial.sum())
        if held < 0.5:
            raise ValueError(f"bounds=({grid.low:g}, {grid.high:g}) hold only {held:.2g} of the initial probability, "
                             f"whose mean is {float(problem.ssm.initial()[0][0]):g}. Widen them.")
