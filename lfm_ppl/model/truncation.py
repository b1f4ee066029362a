r"""Estimates of the error of the log likelihood due to the truncation of a periodic kernel to J functions.

The force has the covariance k_J(t, s) = sum_{j <= J} mu_j phi_j(t) phi_j(s) k_evolution(t, s) instead of
k(t, s) = k_periodic(t, s) k_evolution(t, s). The lost share of the variance does not determine the error of the log
likelihood: data of many cycles together determine slowly changing weights precisely. For each periodic force:

1. Linearise the model at its prior mean, y = sum_r G_r u_r + G_0 x(t0) + e, see `linear_response`.
2. Represent a long record by some of its rows, chosen at random. The noise is unchanged, and the variance of the
   periodic force is multiplied by the number of rows that each of them represents, which keeps the information on
   each weight.
3. Treat a record much longer than the correlation time of the weights as independent pieces. If the force enters the
   dynamics and the time grid of a piece would be too long, shorten the piece to a few cycles, in which the weights
   change faster by the same factor.
4. With the covariance K = L L' of the rows, W = L^-1 (K - K_J) L^-T has the eigenvalues w_i, and K_J^-1 K has the
   eigenvalues e_i = 1 / (1 - w_i). `error_bound` gives the error.
5. L does not depend on J. Bisection finds the least J whose error is within the tolerance.

Source: Whittle (1953), Arkiv för Matematik 2, for the likelihood of an approximate covariance; Reece et al. (2014),
Journal of Machine Learning Research 15, for the truncated kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.linalg import cholesky, solve_triangular

from lfm_ppl.forces.basis import Eigenfunctions, fourier_coefficients
from lfm_ppl.forces.quasi_periodic import QuasiPeriodic
from lfm_ppl.forces.sde import Force
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.linear_response import (
    LEAST_NOISE,
    TOLERANCE,
    LinearisedTerm,
    error_bound,
    linearised_terms,
    output_responses,
)

_MOST_VALUES = 480
"""Largest number of observed values in the estimate."""
_MOST_GRID_POINTS = 2000
"""Largest number of grid points at which the forces are evaluated."""
_LEAST_ROWS = 8
"""Least number of rows in the estimate."""
_WINDOW = 10.0
"""Length of an independent piece of the record, in correlation times of the weights."""
_LEAST_CYCLES = 6.0
"""Least number of cycles in a piece."""
_POINTS_PER_WAVE = 8
"""Grid points per period of the first omitted harmonic, where the force enters the dynamics."""
_CORRELATION = 0.6
"""Correlation of the weights after a correlation time: about that of a squared exponential at one lengthscale."""
_HARMONICS = 256
"""Number of harmonics of a stationary kernel in the estimate."""
_LARGEST_EIGENVALUE = 1.0 - 1e-15
"""Bound on w_i, which keeps the error finite for a singular K_J."""


@dataclass(frozen=True)
class Truncation:
    """The effect of the truncation of one periodic force.

    Attributes:
        name: name of the force in the model.
        force: the periodic force, perhaps a term of a sum.
        error: estimated error of the log likelihood: |mean| + 2 standard deviations over data sets from the full
            kernel; or a bound on it that is within the tolerance.
        functions: least number of functions with an error within the tolerance; None if it is larger than the number
            of functions in the estimate.
    """

    name: str
    force: QuasiPeriodic
    error: float
    functions: int | None


@dataclass(frozen=True)
class RepresentativeRows:
    """A few rows that represent a record.

    Attributes:
        times: (N,), times of the rows, which determine the phases.
        speed: factor by which the evolution of the weights is accelerated.
        weight: number of rows of the record that each row represents.
        pieces: number of independent pieces of the record, one of which the rows represent.
        substeps: integration steps between rows.
    """

    times: np.ndarray
    speed: float
    weight: float
    pieces: float
    substeps: int


def truncations(model: LatentForceModel, times: Any, y: Any = None) -> list[Truncation]:
    """Estimate the error of the log likelihood of data at ``times`` due to the truncation of each periodic force.

    Args:
        model: the latent force model.
        times: (T,).
        y: (T, D), NaN where missing; None: all entries are observed.

    Returns:
        One entry for each `Periodic` or `QuasiPeriodic` force, except those with ``explained_variance=0``, whose
        functions are the model, where `linearised_terms` describes the model.
    """
    results = []
    for linearised in linearised_terms(model, times, y, _is_checked):
        initial_time = linearised.times[0] if model.initial_time is None else float(model.initial_time)
        with np.errstate(all="ignore"):
            estimate = _estimate(linearised, initial_time)
        if estimate is not None:
            results.append(estimate)
    return results


def truncation_message(truncation: Truncation) -> str:
    """Return the text of the warning."""
    force = truncation.force
    remedy = (f"Use functions={truncation.functions}" if truncation.functions is not None else
              "Use many more functions, or a smoother kernel")
    return (f"the data can distinguish the {force.functions} functions of the periodic force {truncation.name!r} from "
            f"the full kernel {force.kernel.name}: the error of the log likelihood is estimated at "
            f"{truncation.error:.2g}, above {TOLERANCE:g}. {remedy}, or explained_variance=0 if the {force.functions} "
            "functions are the intended model.")


def _is_checked(force: Force) -> bool:
    """Return whether a force is truncated by approximation, and not by definition of the model."""
    return isinstance(force, QuasiPeriodic) and force.explained_variance > 0.0 and np.ndim(force.period) == 0


def _estimate(linearised: LinearisedTerm, initial_time: float) -> Truncation | None:
    """Return the effect of a truncation; None if the numbers overflow."""
    (name, column, force), other_terms, linear, times = linearised
    assert isinstance(force, QuasiPeriodic)
    is_direct = not (np.any(linear.c) and np.any(linear.b))
    if is_direct and (bound := _trace_bound(linearised, initial_time)) <= TOLERANCE:
        return Truncation(name, force, bound, force.functions)
    rows = _representative_rows(times, force, initial_time, len(linear.c), is_direct)
    if rows is None:
        return None
    grid = _with_substeps(rows.times, rows.substeps)
    response, initial = output_responses(linear, grid, rows.substeps)

    def output_covariance(kernel: np.ndarray, source: int) -> np.ndarray:
        if is_direct:
            return np.kron(kernel, np.outer(linear.d[:, source], linear.d[:, source]))
        return response[:, :, source] @ kernel @ response[:, :, source].T

    evolution_times = grid[0] + rows.speed * (grid - grid[0])
    evolution = rows.weight * _covariance(force.evolution, evolution_times, initial_time)
    periodic = np.asarray(force.kernel(jnp.asarray(grid)[:, None], jnp.asarray(grid)[None, :]))
    features = _features(force, grid)
    signal = output_covariance(periodic * evolution, column)
    exact = signal + np.kron(np.eye(rows.times.size), linear.noise) + initial @ initial.T
    for _, other_column, other_force in other_terms:
        exact = exact + output_covariance(_covariance(other_force, grid, initial_time), other_column)
    exact = exact + LEAST_NOISE * signal.diagonal().max() * np.eye(len(exact))
    try:
        factor = cholesky(exact, lower=True)
    except (ValueError, np.linalg.LinAlgError):  # not finite, or not positive definite
        return None

    def whitened(functions: int) -> np.ndarray:
        """Return W."""
        omitted = (periodic - features[:, :functions] @ features[:, :functions].T) * evolution
        half = solve_triangular(factor, output_covariance(omitted, column), lower=True)
        return solve_triangular(factor, half.T, lower=True)

    def second_order_error(functions: int) -> float:
        return _second_order_error(rows.pieces * float((whitened(functions) ** 2).sum()))

    error = second_order_error(force.functions)
    if not np.isfinite(error):
        return None
    if error <= TOLERANCE:
        return Truncation(name, force, error, force.functions)
    values = np.minimum(np.linalg.eigvalsh(whitened(force.functions)), _LARGEST_EIGENVALUE)
    return Truncation(name, force, error_bound(1.0 / (1.0 - values), rows.pieces), _least_functions(
        lambda functions: second_order_error(functions) <= TOLERANCE, force, features.shape[1]))


def _second_order_error(square: float) -> float:
    """Return the error for small w_i from the sum of their squares, which is much cheaper than the eigenvalues."""
    return 0.25 * square + 2.0 * float(np.sqrt(0.5 * square))


def _trace_bound(linearised: LinearisedTerm, initial_time: float) -> float:
    """Return a bound on the error for a force that is observed directly; infinite if there is no bound.

    K is at least the noise covariance, so that sum_i |w_i| is at most the trace of K - K_J relative to the noise. The
    bound takes milliseconds, the estimate about half a second for a thousand rows.
    """
    (_, column, force), _, linear, times = linearised
    assert isinstance(force, QuasiPeriodic)
    if not force.kernel.stationary:
        return np.inf
    start = force.kernel.start
    omitted_variance = max(float(force.kernel(start, start)) - float(force.eigenvalues().sum()), 0.0)
    evolution_variances = _covariance(force.evolution, times[[0, -1]], initial_time).diagonal()
    gain = linear.d[:, column]
    try:
        signal_to_noise = float(gain @ np.linalg.solve(linear.noise, gain))
    except np.linalg.LinAlgError:
        return np.inf
    trace = times.size * omitted_variance * evolution_variances.max() * signal_to_noise
    return _second_order_error(trace**2) if np.isfinite(trace) else np.inf


def _least_functions(is_sufficient: Callable[[int], bool], force: QuasiPeriodic, most: int) -> int | None:
    """Return the least sufficient number of functions above that of the force, None above ``most``."""
    stride = 2 if force.kernel.stationary else 1
    low, high = 0, 1  # additional functions in units of the stride: insufficient, sufficient
    while not is_sufficient(min(force.functions + stride * high, most)):
        if force.functions + stride * high >= most:
            return None
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if is_sufficient(force.functions + stride * middle) else (middle, high)
    return force.functions + stride * high


def _representative_rows(times: np.ndarray, force: QuasiPeriodic, initial_time: float, outputs: int,
                         is_direct: bool) -> RepresentativeRows | None:
    """Return the rows of the estimate; None if the period is not a positive number."""
    period, count = float(force.period), times.size
    if not (np.isfinite(period) and period > 0.0):
        return None
    cycles = max(np.ptp(times) / period, 1e-9)
    waves = 0.0 if is_direct else _POINTS_PER_WAVE * (force.functions // 2 + 1.0)  # grid points in a cycle
    most_rows = max(_LEAST_ROWS, _MOST_VALUES // outputs)
    if count <= most_rows and waves * cycles <= _MOST_GRID_POINTS:
        return RepresentativeRows(times, 1.0, 1.0, 1.0, max(1, int(np.ceil(waves * cycles / count))))
    correlation_cycles = _correlation_time(force, times, initial_time) / period
    window = min(cycles, max(_WINDOW * correlation_cycles, _LEAST_CYCLES))
    grid_cycles = window if is_direct else min(window, _MOST_GRID_POINTS / waves)
    rows = times[:max(_LEAST_ROWS, int(np.ceil(count * grid_cycles / cycles)))]
    substeps = max(1, int(np.ceil(waves * grid_cycles / min(most_rows, rows.size))))
    most_rows = max(_LEAST_ROWS, min(most_rows, _MOST_GRID_POINTS // substeps))
    if rows.size > most_rows:
        # Choose one row of each block at random: equidistant rows could fall on a few phases only.
        edges = np.linspace(0, rows.size, most_rows + 1).astype(int)
        rows = rows[np.random.default_rng(0).integers(edges[:-1], edges[1:])]
    pieces = cycles / window
    return RepresentativeRows(rows, window / grid_cycles, count / (rows.size * pieces), pieces, substeps)


def _correlation_time(force: QuasiPeriodic, times: np.ndarray, initial_time: float) -> float:
    """Return the longest lag from the first time at which the weights have a correlation of at least 0.6."""
    lags = np.concatenate([[0.0], np.geomspace(0.01 * float(force.period), max(np.ptp(times), 1e-300), 60)])
    covariance = _covariance(force.evolution, times[0] + lags, initial_time)
    deviations = np.sqrt(covariance.diagonal())
    correlation = covariance[0] / (deviations[0] * deviations)
    correlated = np.flatnonzero(correlation >= _CORRELATION)
    return float(lags[correlated.max()]) if correlated.size else 0.0


def _with_substeps(times: np.ndarray, substeps: int) -> np.ndarray:
    """Return the times with ``substeps`` equal steps between neighbours."""
    fractions = np.arange(substeps) / substeps
    substep_times = times[:-1, None] + np.diff(times)[:, None] * fractions
    return np.append(substep_times.ravel(), times[-1])


def _covariance(force: Force, grid: np.ndarray, initial_time: float) -> np.ndarray:
    """Return the covariance (J, J) in a model that starts at ``initial_time``, zero if it has no closed form."""
    try:
        return np.asarray(force.covariance_in_model(grid[:, None], grid[None, :], initial_time))
    except NotImplementedError:
        return np.zeros((grid.size, grid.size))


def _features(force: QuasiPeriodic, grid: np.ndarray) -> np.ndarray:
    """Return sqrt(mu_j) phi_j on a grid, (points, functions), for all functions of the estimate, by falling mu_j."""
    kernel = force.kernel
    if kernel.stationary:
        harmonics = max(_HARMONICS, force.functions // 2)
        powers = np.sqrt(np.maximum(np.asarray(fourier_coefficients(kernel, harmonics)), 0.0))
        angle = 2.0 * np.pi / float(kernel.period) * grid[:, None] * np.arange(1, harmonics + 1)
        waves = np.stack([powers[1:] * np.cos(angle), powers[1:] * np.sin(angle)], axis=-1)
        return np.concatenate([np.full((grid.size, 1), powers[0]), waves.reshape(grid.size, -1)], axis=1)
    assert isinstance(force.basis, Eigenfunctions)
    points = force.basis.points
    gram = np.asarray(kernel(points[:, None], points[None, :]))
    values, vectors = np.linalg.eigh(0.5 * (gram + gram.T))
    positive = values > 1e-12 * values[-1]
    values, vectors = values[positive][::-1], vectors[:, positive][:, ::-1]
    return np.asarray(kernel(jnp.asarray(grid)[:, None], points[None, :])) @ vectors / np.sqrt(values)
