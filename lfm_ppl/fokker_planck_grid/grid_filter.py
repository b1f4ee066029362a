"""Filter and smoother for the masses of a one-dimensional state on a grid: a hidden Markov model on its cells.

1. Put the model on the cells: rates, jump matrices, initial masses, likelihood nodes (`on_grid`).
2. Tabulate the transition matrix of each distinct interval length, if that is cheaper than to propagate the masses row
   by row (`build_transition`).
3. Forward, row by row: propagate the masses over the row and its jump, multiply them with the likelihood averaged over
   each cell, and normalise. The logarithm of the normalising constant is log p(y_k | y_1:k-1).
4. Backward, row by row, with the filtered masses f and the predicted masses p:

       s_k-1(i) = f_k-1(i) sum_j P(i -> j) s_k(j) / p_k(j).

Source: Kitagawa (1987), J. Am. Stat. Assoc. 82.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.intervals import Intervals, TimeGrid, as_arrays, with_observations
from lfm_ppl.fokker_planck_grid.finite_volume import BirthDeathProcess, Grid, propagate, transition
from lfm_ppl.fokker_planck_grid.grid_model import WEIGHTS, Cells, on_grid
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.utils.gaussian_residuals import log_density, masked, wrapped
from lfm_ppl.utils.linalg import cholesky, solve_lower

_LARGEST_TABLE = 2**25
"""Largest number of entries of the tabulated transition matrices (256 MiB); without a table, the masses are propagated
row by row."""

_MATRIX_COST = 6.0
"""Cost of a transition matrix in units of the propagation of one vector of masses."""


class FilteredMasses(eqx.Module):
    """Result of a forward pass.

    Attributes:
        log_likelihood: (rows, B), zero without an observation.
        predicted, filtered: (rows, B, N), masses before and after the observation; None unless kept.
        reach: (N,), largest mass of each cell among all initial, predicted and filtered masses.
    """

    log_likelihood: jax.Array
    predicted: Any
    filtered: Any
    reach: jax.Array


def _log_likelihood_of_cells(cells: Cells, index: jax.Array, y: jax.Array) -> jax.Array:
    """Return the logarithm (B, N) of the likelihood of y (B, D), averaged over each cell; zero if y is missing."""
    index = jnp.maximum(index, 0)
    value, noise = (a[jnp.where(a.shape[0] > 1, index, 0)] for a in (cells.value, cells.noise))
    present = jnp.isfinite(y)[:, None, None, :]
    residual = jnp.where(present, y[:, None, None, :], 0.0) - value
    residual = jnp.where(cells.angular, wrapped(residual, cells.period), residual)
    log = jnp.vectorize(_log_density, signature="(d),(d,d),(d)->()")(residual, noise, present)
    return jax.scipy.special.logsumexp(log + np.log(0.5 * WEIGHTS), axis=-1)


def _log_density(residual: jax.Array, noise: jax.Array, present: jax.Array) -> jax.Array:
    """Return the log density of the present entries of a residual (D,); NaN for singular noise."""
    residual, noise = masked(residual, noise, present)
    factor = cholesky(noise)
    value = log_density(solve_lower(factor.chol, residual), factor.chol, present)
    return jnp.where(factor.degenerate.any(), jnp.nan, value)


class GridTransition(eqx.Module):
    """Transition of masses over the rows of a time grid.

    Attributes:
        cells: the model on the grid.
        table: (lengths, N, N), transition matrices of the distinct interval lengths; None: propagate the masses.
    """

    cells: Cells
    table: Any

    def move(self, masses: jax.Array, interval: Intervals, process: BirthDeathProcess | None,
             adjoint: bool = False) -> jax.Array:
        """Move masses (B, N) over a row and the jump at its end, or a function of the cell back over both.

        Args:
            masses: (B, N).
            interval: the row.
            process: rates (steps, N) of the row if they depend on time; else None.
            adjoint: move backwards.
        """
        if adjoint:
            masses = self._jump(masses, interval.jump, True)
        if self.table is not None:
            matrix = self.table[interval.length_index]
            masses = masses @ (matrix if adjoint else matrix.T)
        elif process is None:
            masses = propagate(self.cells.process, interval.length, masses, adjoint)
        else:
            step_size = interval.length / process.up.shape[0]

            def step(masses: jax.Array, step_process: BirthDeathProcess) -> tuple[jax.Array, None]:
                return propagate(step_process, step_size, masses, adjoint), None

            masses, _ = jax.lax.scan(step, masses, process, reverse=adjoint)
        return masses if adjoint else self._jump(masses, interval.jump, False)

    def _jump(self, masses: jax.Array, index: jax.Array, adjoint: bool) -> jax.Array:
        if self.cells.jumps is None:
            return masses
        matrix = self.cells.jumps[jnp.maximum(index, 0)]
        return jnp.where(index >= 0, masses @ (matrix if adjoint else matrix.T), masses)


def build_transition(cells: Cells, time_grid: TimeGrid, batch: int) -> GridTransition:
    """Return the transition for ``batch`` data sets, with a table of matrices if it is the cheaper form."""
    size = cells.initial.shape[0]
    if time_grid.lengths is None or cells.process.up.ndim > 1:
        return GridTransition(cells, None)
    count, rows = np.shape(time_grid.lengths)[0], np.shape(time_grid.intervals.length)[0]
    if count * size**2 > _LARGEST_TABLE or count * _MATRIX_COST > rows * (1.0 + batch / 4.0):
        return GridTransition(cells, None)
    table = jax.lax.map(lambda length: transition(cells.process, length), jnp.asarray(time_grid.lengths))
    return GridTransition(cells, table)


def forward(transition: GridTransition, time_grid: TimeGrid, y: jax.Array, keep_masses: bool = False) -> FilteredMasses:
    """Run the filter.

    Args:
        transition: of the model on the grid.
        time_grid: the time grid.
        y: (B, T, D), NaN where missing; all B data sets have the same times.
        keep_masses: whether the result holds the masses of all rows.
    """
    cells = transition.cells
    rows, y_rows = with_observations(time_grid.intervals, jnp.moveaxis(y, 1, 0))
    processes = cells.process if cells.process.up.ndim > 1 else None
    start = jnp.broadcast_to(cells.initial, (y.shape[0], cells.initial.shape[0]))

    def step(carry: tuple, inputs: tuple) -> tuple[tuple, tuple]:
        masses, reach = carry
        interval, process, y_row = inputs
        predicted = transition.move(masses, interval, process)
        log_joint = jnp.log(predicted) + _log_likelihood_of_cells(cells, interval.observation, y_row)
        total = jax.scipy.special.logsumexp(log_joint, axis=-1)
        # An observation with likelihood zero in all cells leaves no mass to normalise: NaN marks the failure.
        normaliser = jnp.where(jnp.isneginf(total), jnp.nan, total)
        is_observed = jnp.isfinite(y_row).any(-1)
        filtered = jnp.where(is_observed[:, None], jnp.exp(log_joint - normaliser[:, None]), predicted)
        has_moved = (interval.length > 0) | (interval.jump >= 0)
        reach = jnp.maximum(reach, jnp.where(has_moved, jnp.maximum(masses, predicted).max(0), 0.0))
        out = (jnp.where(is_observed, total, 0.0), *((predicted, filtered) if keep_masses else (None, None)))
        return (filtered, jnp.maximum(reach, filtered.max(0))), out

    carry = start, jnp.zeros(start.shape[1])
    (_, reach), (log_likelihood, predicted, filtered) = jax.lax.scan(step, carry, (rows, processes, y_rows))
    return FilteredMasses(log_likelihood, predicted, filtered, reach)


def backward(transition: GridTransition, time_grid: TimeGrid, forward_pass: FilteredMasses) -> jax.Array:
    """Run the smoother on a forward pass with its masses; return masses (rows, B, N) at the rows' ends."""
    cells, rows = transition.cells, as_arrays(time_grid.intervals)
    processes = cells.process if cells.process.up.ndim > 1 else None
    start = jnp.broadcast_to(cells.initial, forward_pass.filtered.shape[1:])[None]
    filtered_at_start = jnp.concatenate([start, forward_pass.filtered[:-1]])

    def step(smoothed_at_end: jax.Array, inputs: tuple) -> tuple[jax.Array, jax.Array]:
        interval, process, predicted, filtered = inputs
        # Smaller masses would overflow the ratio.
        is_positive = predicted > 1e-290
        ratio = jnp.where(is_positive, smoothed_at_end / jnp.where(is_positive, predicted, 1.0), 0.0)
        smoothed = filtered * transition.move(ratio, interval, process, adjoint=True)
        smoothed = smoothed / smoothed.sum(-1, keepdims=True)
        return smoothed, smoothed_at_end

    _, smoothed = jax.lax.scan(step, forward_pass.filtered[-1],
                               (rows, processes, forward_pass.predicted, filtered_at_start), reverse=True)
    return smoothed


def log_likelihood(ssm: StateSpaceModel, time_grid: TimeGrid, y: jax.Array, grid: Grid) -> jax.Array:
    """Return the log likelihood on the grid; for compiled code.

    The transition matrices are computed once for all data sets. A failure is minus infinity. Derivatives exist in
    forward mode (`jax.jacfwd`) only.

    Args:
        ssm: the state-space model, of state dimension one; it may hold traced parameters, also under `jax.vmap`.
        time_grid: from `lfm_ppl.filtering.time_grid.build_time_grid(ssm, times, steps)`. Its ``steps`` matter only if
            drift or dispersion depend on time: the generator is frozen at the middle of each step.
        y: (T, D), or (B, T, D) for B data sets with the same times; NaN where missing.
        grid: the cells, from `choose_grid`.

    Returns:
        log p(y), a scalar or (B,).

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> from lfm_ppl.filtering.time_grid import build_time_grid
        >>> from lfm_ppl.model.state_space import state_space
        >>> ssm = state_space(lfm.LatentForceModel(
        ...     lambda x, u, t: x - x**3, {}, lfm.GaussianObservation(lambda x, u, t: x, sd=0.3),
        ...     lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.eye(1)))
        >>> time_grid = build_time_grid(ssm, [0.0, 1.0, 2.0], 1)
        >>> log_likelihood(ssm, time_grid, jnp.ones((5, 3, 1)), Grid(-6.0, 6.0, 100)).shape
        (5,)
    """
    y = jnp.asarray(y, float)
    data_sets = y if y.ndim == 3 else y[None]
    total, _ = log_likelihood_and_reach(on_grid(ssm, time_grid, grid), time_grid, data_sets)
    return total if y.ndim == 3 else total[0]


def log_likelihood_and_reach(cells: Cells, time_grid: TimeGrid, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return log p(y) (B,) of data sets y (B, T, D), and the largest mass (N,) of each cell, `FilteredMasses.reach`."""
    forward_pass = forward(build_transition(cells, time_grid, y.shape[0]), time_grid, y)
    total = forward_pass.log_likelihood.sum(0)
    return jnp.where(jnp.isfinite(total), total, -jnp.inf), forward_pass.reach
