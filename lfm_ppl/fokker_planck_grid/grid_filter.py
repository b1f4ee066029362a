"""Filter and smoother for the masses of a one-dimensional state on a grid: a hidden Markov model on its cells."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.time_grid import Intervals, TimeGrid, as_arrays, with_observations
from lfm_ppl.fokker_planck_grid.finite_volume import Chain, Grid, propagate, transition
from lfm_ppl.fokker_planck_grid.grid_model import WEIGHTS, Cells, on_grid
from lfm_ppl.gaussian_residuals import log_density, masked, wrapped
from lfm_ppl.linalg import cholesky, solve_lower
from lfm_ppl.model.state_space import StateSpaceModel

_LARGEST_TABLE = 2**25
"""Most entries of the tabulated transition matrices, 256 MiB; beyond it the masses are propagated row by row."""

_MATRIX_COST = 6.0
"""A transition matrix takes about as long as this many propagations of one vector of masses."""


class Densities(NamedTuple):
    """What a forward pass leaves; one entry a row, None where it was not asked for.

    Attributes:
        log_likelihood: (rows, B), zero where nothing is observed.
        predicted, filtered: (rows, B, N) masses before and after the observation.
        reach: (N,) the largest mass of each cell that was propagated, predicted or filtered.
    """

    log_likelihood: jax.Array
    predicted: Any
    filtered: Any
    reach: jax.Array


def _log_likelihood_of_cells(cells: Cells, index: jax.Array, y: jax.Array) -> jax.Array:
    """Return (B, N): the log of the likelihood of y (B, D), averaged over each cell; zero where all is missing."""
    index = jnp.maximum(index, 0)
    value, noise = (a[jnp.where(a.shape[0] > 1, index, 0)] for a in (cells.value, cells.noise))
    present = jnp.isfinite(y)[:, None, None, :]
    residual = jnp.where(present, y[:, None, None, :], 0.0) - value
    residual = jnp.where(cells.angular, wrapped(residual), residual)
    log = jnp.vectorize(_log_density, signature="(d),(d,d),(d)->()")(residual, noise, present)
    return jax.scipy.special.logsumexp(log + np.log(0.5 * WEIGHTS), axis=-1)


def _log_density(residual: jax.Array, noise: jax.Array, present: jax.Array) -> jax.Array:
    """Return the log density of the present entries of a residual (D,); NaN where the noise has none."""
    residual, noise = masked(residual, noise, present)
    factor = cholesky(noise)
    value = log_density(solve_lower(factor.chol, residual), factor.chol, present)
    return jnp.where(factor.degenerate.any(), jnp.nan, value)


class Moves(NamedTuple):
    """How masses cross a row: a table of transition matrices, or the chain itself where that is None."""

    cells: Cells
    table: Any

    def across(self, masses: jax.Array, row: Intervals, walk: Chain | None, adjoint: bool = False) -> jax.Array:
        """Move masses (B, N) over a row and its jump, or a function of the cell back over them."""
        if adjoint:
            masses = self._jump(masses, row.jump, True)
        if self.table is not None:
            matrix = self.table[row.length_index]
            masses = masses @ (matrix if adjoint else matrix.T)
        elif walk is None:
            masses = propagate(self.cells.chain, row.length, masses, adjoint)
        else:
            part = row.length / walk.up.shape[0]
            step = lambda m, one: (propagate(one, part, m, adjoint), None)  # noqa: E731
            masses, _ = jax.lax.scan(step, masses, walk, reverse=adjoint)
        return masses if adjoint else self._jump(masses, row.jump, False)

    def _jump(self, masses: jax.Array, index: jax.Array, adjoint: bool) -> jax.Array:
        if self.cells.jumps is None:
            return masses
        matrix = self.cells.jumps[jnp.maximum(index, 0)]
        return jnp.where(index >= 0, masses @ (matrix if adjoint else matrix.T), masses)


def moves(cells: Cells, time_grid: TimeGrid, batch: int) -> Moves:
    """Tabulate the transition matrices where that pays."""
    size = cells.initial.shape[0]
    if time_grid.lengths is None or cells.chain.up.ndim > 1:
        return Moves(cells, None)
    count, rows = np.shape(time_grid.lengths)[0], np.shape(time_grid.intervals.length)[0]
    if count * size**2 > _LARGEST_TABLE or count * _MATRIX_COST > rows * (1.0 + batch / 4.0):
        return Moves(cells, None)
    return Moves(cells, jax.lax.map(lambda length: transition(cells.chain, length), jnp.asarray(time_grid.lengths)))


def forward(moving: Moves, time_grid: TimeGrid, y: jax.Array, keep: bool = False) -> Densities:
    """Run the filter.

    Args:
        moving: the model on the grid.
        time_grid: the time grid.
        y: (B, T, D), NaN where missing; all B data sets have the same times.
        keep: whether to keep the masses.
    """
    cells = moving.cells
    rows, by_row = with_observations(time_grid.intervals, jnp.moveaxis(y, 1, 0))
    walks = cells.chain if cells.chain.up.ndim > 1 else None
    start = jnp.broadcast_to(cells.initial, (y.shape[0], cells.initial.shape[0]))

    def step(carry: tuple, inputs: tuple) -> tuple[tuple, tuple]:
        masses, reach = carry
        row, walk, observed = inputs
        predicted = moving.across(masses, row, walk)
        with_observation = jnp.log(predicted) + _log_likelihood_of_cells(cells, row.observation, observed)
        total = jax.scipy.special.logsumexp(with_observation, axis=-1)
        # An observation that no cell can explain leaves nothing to normalise.
        possible = jnp.where(jnp.isneginf(total), jnp.nan, total)
        any_present = jnp.isfinite(observed).any(-1)
        filtered = jnp.where(any_present[:, None], jnp.exp(with_observation - possible[:, None]), predicted)
        moved = (row.length > 0) | (row.jump >= 0)
        reach = jnp.maximum(reach, jnp.where(moved, jnp.maximum(masses, predicted).max(0), 0.0))
        out = (jnp.where(any_present, total, 0.0), *((predicted, filtered) if keep else (None, None)))
        return (filtered, jnp.maximum(reach, filtered.max(0))), out

    carry = start, jnp.zeros(start.shape[1])
    (_, reach), (log, predicted, filtered) = jax.lax.scan(step, carry, (rows, walks, by_row))
    return Densities(log, predicted, filtered, reach)


def backward(moving: Moves, time_grid: TimeGrid, passed: Densities) -> jax.Array:
    """Run the smoother; return masses (rows, B, N) at the rows' ends.

        s_k-1(i) = f_k-1(i) sum_j P(i -> j) s_k(j) / p_k(j)

    with the filtered masses f and the predicted ones p.
    """
    cells, rows = moving.cells, as_arrays(time_grid.intervals)
    walks = cells.chain if cells.chain.up.ndim > 1 else None
    start = jnp.broadcast_to(cells.initial, passed.filtered.shape[1:])[None]
    before = jnp.concatenate([start, passed.filtered[:-1]])

    def step(later: jax.Array, inputs: tuple) -> tuple[jax.Array, jax.Array]:
        row, walk, predicted, at_start = inputs
        live = predicted > 1e-290
        ratio = jnp.where(live, later / jnp.where(live, predicted, 1.0), 0.0)
        smoothed = at_start * moving.across(ratio, row, walk, adjoint=True)
        smoothed = smoothed / smoothed.sum(-1, keepdims=True)
        return smoothed, later

    _, ends = jax.lax.scan(step, passed.filtered[-1], (rows, walks, passed.predicted, before), reverse=True)
    return ends


def log_likelihood(ssm: StateSpaceModel, time_grid: TimeGrid, y: jax.Array, grid: Grid) -> jax.Array:
    """Return the log likelihood on the grid; for compiled code.

    The transition matrices are computed once for all data sets. A failure is minus infinity. Derivatives are to be
    had in forward mode (`jax.jacfwd`), not in reverse mode.

    Args:
        ssm: the state-space model, of state dimension one; it may hold traced parameters, also under `jax.vmap`.
        time_grid: from `lfm_ppl.filtering.time_grid.build_time_grid(ssm, times, steps)`; its ``steps`` matter only
            where drift or dispersion depend on time: the generator is frozen at the middle of each of them.
        y: (T, D), or (B, T, D) for B data sets with the same times; NaN where missing.
        grid: the cells, from `choose_grid`.

    Returns:
        log p(y), a scalar or (B,).

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> from lfm_ppl.filtering.time_grid import build_time_grid
        >>> ssm = lfm.state_space(lfm.LatentForceModel(
        ...     lambda x, u, t: x - x**3, {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
        ...     lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.eye(1)))
        >>> time_grid = build_time_grid(ssm, [0.0, 1.0, 2.0], 1)
        >>> log_likelihood(ssm, time_grid, jnp.ones((5, 3, 1)), Grid(-6.0, 6.0, 100)).shape
        (5,)
    """
    y = jnp.asarray(y, float)
    sets = y if y.ndim == 3 else y[None]
    total = total_log_likelihood(on_grid(ssm, time_grid, grid), time_grid, sets)
    return total if y.ndim == 3 else total[0]


def total_log_likelihood(cells: Cells, time_grid: TimeGrid, y: jax.Array) -> jax.Array:
    """Return log p(y) (B,) of data sets y (B, T, D) for a model that is on the grid already."""
    return total_and_reach(cells, time_grid, y)[0]


def total_and_reach(cells: Cells, time_grid: TimeGrid, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return besides the largest mass (N,) that any cell had; see `Densities`."""
    passed = forward(moves(cells, time_grid, y.shape[0]), time_grid, y)
    total = passed.log_likelihood.sum(0)
    return jnp.where(jnp.isfinite(total), total, -jnp.inf), passed.reach
