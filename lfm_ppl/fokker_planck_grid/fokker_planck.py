"""The Fokker-Planck reference: exact filtering and smoothing densities of a one-dimensional state, on a grid.

1. Check that the joint state is one-dimensional and has noise.
2. Choose bounds and number of cells (`lfm_ppl.fokker_planck_grid.grid_choice`).
3. Discretise the Fokker-Planck equation into a Markov chain on the cells
   (`lfm_ppl.fokker_planck_grid.finite_volume`).
4. Run the forward and the backward pass of the hidden Markov model (`lfm_ppl.fokker_planck_grid.grid_filter`).
5. Estimate the error of the log likelihood by comparison with half the cells and twice the steps.

Source: Kitagawa (1987), J. Am. Stat. Assoc. 82; Jazwinski (1970), Stochastic Processes and Filtering Theory,
section 6.3.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from lfm_ppl.filtering.arguments import check_observations, warn_single_precision
from lfm_ppl.filtering.intervals import TimeGrid
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.fokker_planck_grid.finite_volume import Grid
from lfm_ppl.fokker_planck_grid.grid_choice import PADDED_CELLS, GridProblem, choose, half_grid, second_order_error
from lfm_ppl.fokker_planck_grid.grid_filter import backward, build_transition, forward, log_likelihood
from lfm_ppl.fokker_planck_grid.grid_model import Cells, on_grid, varies_with_time
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation_noise import check_noise, require_gaussian
from lfm_ppl.model.state_space import StateSpaceModel, state_space
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import safe_sqrt
from lfm_ppl.utils.programs import shared_jit

__all__ = ["FokkerPlanckResult", "Grid", "choose_grid", "fokker_planck", "log_likelihood"]

_FEWEST_CELLS = 8


class FokkerPlanckResult(eqx.Module):
    """Result of `fokker_planck`.

    The state is the physical state, or, in a model without one, the state of the only force (the force without its
    mean). Densities are averages over cells, per unit of the state; they sum to ``1 / width``. Moments treat the mass
    of a cell as concentrated at its centre.

    Attributes:
        times: (T,), observation times.
        x: (N,), centres of the cells.
        width: width of a cell.
        log_likelihood: (T,), log p(y_k | y_1:k-1) of the entries that are present.
        predicted: (T, N), densities before each observation. They lack the probability of the initial state outside of
            the grid. With automatic bounds this is not negligible only if the first observation is at the initial time
            and excludes this range.
        filtered: (T, N), densities after each observation.
        mean, sd: (T,), moments of the filtered densities.
        smoothed_times: (K,), requested times.
        smoothed: (K, N), densities given all observations.
        smoothed_mean, smoothed_sd: (K,), moments of the smoothed densities.
        error: estimate of the discretisation error of the total log likelihood, >= 0.
        grid: the cells.
    """

    times: jax.Array
    x: jax.Array
    width: jax.Array
    log_likelihood: jax.Array
    predicted: jax.Array
    filtered: jax.Array
    mean: jax.Array
    sd: jax.Array
    smoothed_times: jax.Array
    smoothed: jax.Array
    smoothed_mean: jax.Array
    smoothed_sd: jax.Array
    error: jax.Array
    grid: Grid = eqx.field(static=True)


def fokker_planck(model: LatentForceModel, times: ArrayLike, y: ArrayLike, *, at: ArrayLike | None = None,
                  cells: int | None = None, bounds: tuple[float, float] | None = None, steps: int = 1,
                  tolerance: float = 1e-3) -> FokkerPlanckResult:
    """Filter and smooth a one-dimensional state exactly, up to a grid's resolution.

    Between observations the density obeys the Fokker-Planck equation

        dp/dt = -d/dx [b p] + d^2/dx^2 [D p],    D = g^2 / 2    (Ito),

    It is discretised by finite volumes with exponentially fitted fluxes and reflecting bounds, and solved by the exact
    exponential of their generator. At an observation the density is multiplied with the likelihood, averaged over each
    cell. Errors are of second order in the width of a cell.

    Args:
        model: a model of state dimension one: one physical state with process noise, or one force with one state. Its
            functions are read once, as by `jax.jit`.
        times: (T,), non-decreasing.
        y: (T, D), NaN where missing.
        at: (K,) times of the smoothed densities, also after the last observation; by default the observation times.
        cells: number of cells; by default chosen by `choose_grid`.
        bounds: (low, high), the ends of the grid, where the state is reflected; by default chosen.
        steps: steps between two consecutive times. Drift and dispersion that depend on time are frozen at the middle
            of each step, with an error of second order; otherwise there is no effect.
        tolerance: tolerated error of the total log likelihood.

    Returns:
        Densities, moments, log likelihoods, and an estimate of the error by comparison with half the cells (and
        twice the steps). If it exceeds the tolerance there is a warning.

    Raises:
        ValueError, TypeError: a state of more dimensions; no process noise or no observation noise, so that densities
            or likelihoods do not exist; invalid bounds or cells; times and y as in `lfm_ppl.filter`.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: x - x**3, {}, lfm.GaussianObservation(lambda x, u, t: x, sd=0.3),
        ...     lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.eye(1))
        >>> result = fokker_planck(model, [0.0, 1.0], jnp.ones((2, 1)), cells=200)
        >>> result.filtered.shape, bool(result.error < 1e-3)
        ((2, 200), True)

    Source: Scharfetter and Gummel (1969), IEEE Trans. Electron Devices 16, for the fluxes; Jazwinski (1970),
    section 6.3, for the filter; Kitagawa (1987), J. Am. Stat. Assoc. 82, for both passes on a grid.
    """
    ssm = _checked_ssm(model)
    checks.positive("tolerance", tolerance)
    time_grid = build_time_grid(ssm, times, steps, requested_times=at)
    y = _observations(ssm, time_grid, y)
    grid = choose_grid(model, times, y, cells=cells, bounds=bounds, steps=steps, tolerance=tolerance)
    cells_on_grid = on_grid(ssm, time_grid, grid, padded_cells=PADDED_CELLS)
    result = _filter_and_smooth(cells_on_grid, time_grid, y[None], jnp.asarray(times, float), grid)
    total = np.asarray(result.log_likelihood.sum())
    error = _error(GridProblem(ssm, build_time_grid(ssm, times, steps)), build_time_grid(ssm, times, 2 * steps),
                   y[None], grid, total)
    if not error <= tolerance:
        warnings.warn(f"the estimated discretisation error of the log likelihood is {error:.2g}, above the tolerance "
                      f"{tolerance:g}, with {grid.cells} cells on [{grid.low:g}, {grid.high:g}] and steps={steps}. "
                      "Raise cells (and steps, where the model depends on time), or the tolerance.", stacklevel=2)
    return eqx.tree_at(lambda r: r.error, result, jnp.asarray(error))


def choose_grid(models: LatentForceModel | Sequence[LatentForceModel], times: ArrayLike, y: Any, *,
                cells: int | None = None, bounds: tuple[float, float] | None = None, steps: int = 1,
                tolerance: float = 1e-3) -> Grid:
    """Choose one grid for one model, or for several models, such as draws of the parameters.

    The bounds are moved until every predicted and filtered density has less than 1e-10 of its mass next to them. The
    number of cells is raised until the error of the log likelihood, estimated from half the cells at second order, is
    below the tolerance for every model and data set.

    Args:
        models: one model or a sequence; parameters must be known.
        times: (T,), non-decreasing.
        y: (T, D), or (B, T, D) for B data data_sets; NaN where missing.
        cells: fixed number of cells; by default chosen.
        bounds: fixed bounds (low, high); by default chosen.
        steps: as in `fokker_planck`.
        tolerance: tolerated error of the total log likelihood of each data set.

    Returns:
        The grid. If 2048 cells are not enough there is a warning.

    Raises:
        ValueError, TypeError: as `fokker_planck`; no bounds hold the densities.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: -x, {}, lfm.GaussianObservation(lambda x, u, t: x, sd=0.3),
        ...     lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.eye(1))
        >>> choose_grid(model, [0.0, 1.0], jnp.ones((2, 1)), bounds=(-8.0, 8.0), cells=100).width
        0.16
    """
    checks.positive("tolerance", tolerance)
    if cells is not None:
        checks.positive_integer("cells", cells, "It is the number of cells of the grid.")
        if cells < _FEWEST_CELLS:
            raise ValueError(f"cells must be at least {_FEWEST_CELLS} to hold a density, got {cells}.")
    if bounds is not None:
        bounds = _checked_bounds(bounds)
    model_list = [models] if isinstance(models, LatentForceModel) else list(models)
    if not model_list:
        raise ValueError("models must hold at least one model, got none.")
    problems = []
    for model in model_list:
        ssm = _checked_ssm(model)
        problems.append(GridProblem(ssm, build_time_grid(ssm, times, steps)))
        if problems[-1].time_grid.lengths is None and checks.concrete(problems[-1].time_grid.intervals.length) is None:
            raise ValueError("the grid is chosen before compilation: times, initial_time and the lag of a known "
                             "input must be concrete numbers, but are traced.")
    y = checks.unmask(y)
    y = jnp.asarray(y) if np.ndim(y) == 3 else y
    data_sets = [_observations(problems[0].ssm, problems[0].time_grid, data_set)
                 for data_set in (y if np.ndim(y) == 3 else [y])]
    if not data_sets:
        raise ValueError(f"y must hold at least one data set, got shape {np.shape(y)}.")
    for problem in problems:
        problem.ssm.model.check_at(problem.time_grid.initial_time, len(problem.time_grid.observed))
    warn_single_precision()
    return choose(problems, jnp.stack(data_sets), bounds, cells, tolerance)


def _checked_ssm(model: Any) -> StateSpaceModel:
    """Return the state-space form of a model after checking that it has a density on a grid."""
    if not isinstance(model, LatentForceModel):
        raise TypeError(f"model must be an lfm.LatentForceModel, got {type(model).__name__}.")
    if jnp.result_type(float) != jnp.float64:
        raise ValueError("the Fokker-Planck grid needs double precision. Call "
                         'jax.config.update("jax_enable_x64", True) before anything else.')
    ssm = state_space(model)
    if ssm.state_dim != 1:
        states, forces = (", ".join(names) or "none" for names in (model.state_names, model.force_names))
        raise ValueError(f"the Fokker-Planck grid holds a state of one dimension, but the joint state of this model "
                         f"has {ssm.state_dim}: {ssm.physical_dim} physical ({states}) and {ssm.force_dim} of forces "
                         f"({forces}). Use the particle filter, lfm.particle_filter, instead.")
    if checks.traced(model):
        raise ValueError("the parameters of the model must be known: the grid and its error are computed before "
                         "compilation. In compiled code use the log_likelihood of "
                         "lfm_ppl.fokker_planck_grid.fokker_planck, on a grid from choose_grid.")
    if model.events:
        raise ValueError("the Fokker-Planck grid does not support events. Use the particle filter, "
                         "lfm.particle_filter, instead.")
    noise = model.process_noise if ssm.physical_dim else ssm.stack.dispersion()
    if noise is None or (not callable(noise) and not np.any(np.asarray(noise))):
        reason = "process_noise is zero" if ssm.physical_dim else f"the force {model.force_names[0]!r} has no noise"
        raise ValueError(f"{reason}: without noise the state has no density that could spread over a grid. Give the "
                         "state process_noise, or use lfm.filter.")
    require_gaussian(ssm, "the Fokker-Planck grid", "the particle filter, lfm.particle_filter,")
    check_noise(ssm, 0.0)
    return ssm


def _checked_bounds(bounds: Any) -> tuple[float, float]:
    if np.shape(bounds) != (2,):
        raise ValueError(f"bounds must be two numbers, (low, high), got {bounds!r}.")
    checks.finite("bounds", bounds)
    low, high = (float(end) for end in bounds)
    if not low < high:
        raise ValueError(f"bounds must be (low, high) with low < high, got ({low:g}, {high:g}).")
    return low, high


def _observations(ssm: StateSpaceModel, time_grid: TimeGrid, y: Any) -> jax.Array:
    return check_observations(y, len(time_grid.observed), ssm.output_dim)


def _error(problem: GridProblem, finer: TimeGrid, y: jax.Array, grid: Grid, total: np.ndarray) -> float:
    """Return the error of the log likelihood ``total`` due to the cells, and to the frozen generator within a step.

    Args:
        problem: the model and its time grid.
        finer: the same time grid with twice the steps.
        y: (1, T, D).
        grid: the cells.
        total: log likelihood on the grid.
    """
    half = half_grid(grid)
    coarse = problem.log_likelihood(y, half)
    error = second_order_error(total - coarse, grid, half)
    if varies_with_time(problem.ssm):
        # Second order: twice the steps leave a quarter of the error.
        change = coarse - GridProblem(problem.ssm, finer).log_likelihood(y, half)
        error += float(np.abs(change).max()) * 4.0 / 3.0
    return error


@shared_jit
def _filter_and_smooth(cells: Cells, time_grid: TimeGrid, y: jax.Array, times: jax.Array,
                       grid: Grid) -> FokkerPlanckResult:
    """Return the result without its error, which is NaN."""
    transition = build_transition(cells, time_grid, 1)
    forward_pass = forward(transition, time_grid, y, keep_masses=True)
    smoothed = backward(transition, time_grid, forward_pass)[:, 0][jnp.asarray(time_grid.requested)]
    observed = jnp.asarray(time_grid.observed)
    predicted, filtered = forward_pass.predicted[observed, 0], forward_pass.filtered[observed, 0]
    centres = jnp.asarray(grid.centres)
    width = jnp.asarray(grid.width)
    return FokkerPlanckResult(
        times, centres, width, forward_pass.log_likelihood[observed, 0], predicted / width, filtered / width,
        *_moments(filtered, centres), jnp.asarray(time_grid.requested_times, float), smoothed / width,
        *_moments(smoothed, centres), jnp.asarray(jnp.nan), grid)


def _moments(masses: jax.Array, centres: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return means and standard deviations (rows,) of masses (rows, N)."""
    masses = masses / masses.sum(-1, keepdims=True)
    mean = (masses * centres).sum(-1)
    return mean, safe_sqrt((masses * (centres - mean[:, None]) ** 2).sum(-1))
