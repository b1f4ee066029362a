r"""Whether data can tell a periodic force of a few functions from the whole periodic kernel.

The covariance of the force is k_J(t, s) = sum_{j <= J} mu_j phi_j(t) phi_j(s) k_evolution(t, s), in the place of
k(t, s) = k_periodic(t, s) k_evolution(t, s). The share of the variance that is left out says little: a weight that
stays the same for many cycles is seen through the noise of all of them. What counts is the error of the log likelihood:

1. The model is linearised at its prior mean, y = sum_r G_r u_r + G_0 x(t0) + e, see `linear_response`.
2. Of a long record some rows, taken at random, stand for all: the noise stays as it is, and the variance of the
   periodic force is multiplied by the number of rows for which one stands, so that as much is known of each weight.
3. A record much longer than the correlation time of the weights is made of independent pieces. Where the dynamics see
   the force, and the grid of a piece would be too long, it is shortened to a few cycles, in which the weights change
   as much faster.
4. With K, the covariance of the rows, and L L' = K, the matrix W = L^-1 (K - K_J) L^-T has the eigenvalues w_i, and
   K_J^-1 K has e_i = 1 / (1 - w_i). `error_bound` gives the error.
5. L serves all J, so that the least J that keeps the error within the tolerance is found by bisection.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.linalg import solve_triangular

from lfm_ppl.forces.basis import Eigenfunctions, fourier_coefficients
from lfm_ppl.forces.quasi_periodic import QuasiPeriodic
from lfm_ppl.forces.sde import Force
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.linear_response import (
    LEAST_NOISE,
    TOLERANCE,
    ForceTerm,
    LinearModel,
    error_bound,
    force_terms,
    linearize,
    observed_times,
    output_responses,
)

_VALUES = 480
"""Observed values that are looked at, at most."""
_GRID = 2000
"""Grid points at which the forces are evaluated, at most."""
_LEAST_ROWS = 8
_WINDOW = 10.0
"""Correlation times of the weights after which another, independent piece of the record begins."""
_CYCLES = 6.0
"""Cycles of such a piece, at least."""
_POINTS_PER_WAVE = 8
"""Grid points in a period of the first harmonic that is left out, where the dynamics see the force."""
_CORRELATION = 0.6
"""Correlation of the weights after a correlation time: about that of a squared exponential at one lengthscale."""
_HARMONICS = 256
"""Harmonics of a stationary kernel that are looked at, at most."""
_LARGEST = 1.0 - 1e-15
"""Largest w_i; without it a singular K_J would give an infinite error."""


class Truncation(NamedTuple):
    """What the number of functions of a periodic force does to the log likelihood.

    Attributes:
        name: of the force in the model.
        force: the periodic force, a term of a sum perhaps.
        error: of the log likelihood, estimated: |mean| + 2 standard deviations over data sets from the whole kernel;
            where a bound on it is within the tolerance, that bound.
        functions: least number of functions with an error within the tolerance; None where it is beyond those that
            the estimate can tell apart.
    """

    name: str
    force: QuasiPeriodic
    error: float
    functions: int | None


class _Rows(NamedTuple):
    """Rows that stand for a record.

    Attributes:
        times: (N,) of the rows, which give the phases.
        speed: c, how much faster the evolution goes.
        weight: rows of the record for which each of them stands.
        pieces: independent pieces of the record, for one of which they stand.
        substeps: steps between rows.
    """

    times: np.ndarray
    speed: float
    weight: float
    pieces: float
    substeps: int


def truncations(model: LatentForceModel, times: Any, y: Any = None) -> list[Truncation]:
    """Estimate what the number of functions of each periodic force does to the log likelihood of data at ``times``.

    Args:
        model: the latent force model.
        times: (T,).
        y: (T, D), NaN where missing; everything is observed by default.

    Returns:
        One entry for each `Periodic` or `QuasiPeriodic` force, also in sums. None where something is traced, where
        fewer than two times are observed, for an observation family or process noise, and for a force that was made
        with ``explained_variance=0``: there the functions are the model.
    """
    terms = force_terms(model)
    if not any(_is_checked(term.force) for term in terms):
        return []
    observed = observed_times(model, times, y)
    linear = None if observed is None else linearize(model, observed[0])
    if observed is None or linear is None:
        return []
    initial_time = observed[0] if model.initial_time is None else float(model.initial_time)
    found = []
    for index, (name, column, force) in enumerate(terms):
        if isinstance(force, QuasiPeriodic) and _is_checked(force):
            others = [other for position, other in enumerate(terms) if position != index]
            with np.errstate(all="ignore"):
                result = _estimate(linear, observed, force, column, others, initial_time)
            if result is not None:
                found.append(Truncation(name, force, *result))
    return found


def truncation_message(truncation: Truncation) -> str:
    """Return what the warning says."""
    force = truncation.force
    remedy = (f"Take functions={truncation.functions}" if truncation.functions is not None else
              "Take many more functions, or a smoother kernel")
    return (f"the data can tell the {force.functions} functions of the periodic force {truncation.name!r} from the "
            f"whole kernel {force.kernel.name}: the error of the log likelihood is estimated at "
            f"{truncation.error:.2g}, above {TOLERANCE:g}. {remedy}, or explained_variance=0 if the {force.functions} "
            "functions are the model that you mean.")


def _is_checked(force: Force) -> bool:
    return isinstance(force, QuasiPeriodic) and force.explained_variance > 0.0 and np.ndim(force.period) == 0


def _estimate(linear: LinearModel, times: np.ndarray, force: QuasiPeriodic, column: int, others: list[ForceTerm],
              initial_time: float) -> tuple[float, int | None] | None:
    """Return the error and the number of functions that suffices; None where the numbers overflow."""
    is_direct = not (np.any(linear.c) and np.any(linear.b))
    if is_direct and (bound := _trace_bound(linear, times, force, column, initial_time)) <= TOLERANCE:
        return bound, force.functions
    rows = _representative_rows(times, force, initial_time, len(linear.c), is_direct)
    if rows is None:
        return None
    grid = _refined(rows.times, rows.substeps)
    response, initial = output_responses(linear, grid, rows.substeps)

    def mapped(kernel: np.ndarray, source: int) -> np.ndarray:
        if is_direct:
            return np.kron(kernel, np.outer(linear.d[:, source], linear.d[:, source]))
        return response[:, :, source] @ kernel @ response[:, :, source].T

    slow = grid[0] + rows.speed * (grid - grid[0])
    evolution = rows.weight * _covariance(force.evolution, slow, initial_time)
    periodic = np.asarray(force.kernel(jnp.asarray(grid)[:, None], jnp.asarray(grid)[None, :]))
    features = _features(force, grid)
    signal = mapped(periodic * evolution, column)
    exact = signal + np.kron(np.eye(rows.times.size), linear.noise) + initial @ initial.T
    for other in others:
        exact = exact + mapped(_covariance(other.force, grid, initial_time), other.column)
    exact = exact + LEAST_NOISE * signal.diagonal().max() * np.eye(len(exact))
    if not np.all(np.isfinite(exact)):
        return None
    try:
        factor = np.linalg.cholesky(exact)
    except np.linalg.LinAlgError:
        return None

    def whitened(functions: int) -> np.ndarray:
        """Return W."""
        left_out = (periodic - features[:, :functions] @ features[:, :functions].T) * evolution
        half = solve_triangular(factor, mapped(left_out, column), lower=True)
        return solve_triangular(factor, half.T, lower=True)

    def second_order_error(functions: int) -> float:
        return _second_order_error(rows.pieces * float((whitened(functions) ** 2).sum()))

    error = second_order_error(force.functions)
    if not np.isfinite(error):
        return None
    if error <= TOLERANCE:
        return error, force.functions
    values = np.minimum(np.linalg.eigvalsh(whitened(force.functions)), _LARGEST)
    return (error_bound(1.0 / (1.0 - values), rows.pieces),
            _least_functions(lambda functions: second_order_error(functions) <= TOLERANCE, force, features.shape[1]))


def _second_order_error(square: float) -> float:
    """Return the error for small w_i from the sum of their squares: eigenvalues take much more time."""
    return 0.25 * square + 2.0 * float(np.sqrt(0.5 * square))


def _trace_bound(linear: LinearModel, times: np.ndarray, force: QuasiPeriodic, column: int,
                 initial_time: float) -> float:
    """Return a bound on the error of a force that is observed itself, at no cost; infinite where there is none.

    K is at least the noise, so that sum_i |w_i| is at most the trace of what is left out, relative to the noise.
    """
    if not force.kernel.stationary:
        return np.inf
    start = force.kernel.start
    left_out = max(float(force.kernel(start, start)) - float(force.eigenvalues().sum()), 0.0)
    ends = _covariance(force.evolution, times[[0, -1]], initial_time).diagonal()
    gain = linear.d[:, column]
    try:
        signal_to_noise = float(gain @ np.linalg.solve(linear.noise, gain))
    except np.linalg.LinAlgError:
        return np.inf
    trace = times.size * left_out * ends.max() * signal_to_noise
    return _second_order_error(trace**2) if np.isfinite(trace) else np.inf


def _least_functions(is_enough: Callable[[int], bool], force: QuasiPeriodic, most: int) -> int | None:
    """Return the least number of functions above that of the force that is enough, None above ``most``."""
    stride = 2 if force.kernel.stationary else 1
    low, high = 0, 1  # multiples of the stride beyond the functions of the force
    while not is_enough(min(force.functions + stride * high, most)):
        if force.functions + stride * high >= most:
            return None
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if is_enough(force.functions + stride * middle) else (middle, high)
    return force.functions + stride * high


def _representative_rows(times: np.ndarray, force: QuasiPeriodic, initial_time: float, outputs: int,
                         is_direct: bool) -> _Rows | None:
    """Choose the rows; None where the period is not a positive number."""
    period, count = float(force.period), times.size
    if not (np.isfinite(period) and period > 0.0):
        return None
    cycles = max(np.ptp(times) / period, 1e-9)
    waves = 0.0 if is_direct else _POINTS_PER_WAVE * (force.functions // 2 + 1.0)  # grid points in a cycle
    values = max(_LEAST_ROWS, _VALUES // outputs)
    if count <= values and waves * cycles <= _GRID:
        return _Rows(times, 1.0, 1.0, 1.0, max(1, int(np.ceil(waves * cycles / count))))
    correlated = _correlation_time(force, times, initial_time) / period
    window = min(cycles, max(_WINDOW * correlated, _CYCLES))
    kept_cycles = window if is_direct else min(window, _GRID / waves)
    rows = times[:max(_LEAST_ROWS, int(np.ceil(count * kept_cycles / cycles)))]
    substeps = max(1, int(np.ceil(waves * kept_cycles / min(values, rows.size))))
    most = max(_LEAST_ROWS, min(values, _GRID // substeps))
    if rows.size > most:
        # One row of each block, at random: rows at equal distances could all lie in the same few phases.
        edges = np.linspace(0, rows.size, most + 1).astype(int)
        rows = rows[np.random.default_rng(0).integers(edges[:-1], edges[1:])]
    pieces = cycles / window
    return _Rows(rows, window / kept_cycles, count / (rows.size * pieces), pieces, substeps)


def _correlation_time(force: QuasiPeriodic, times: np.ndarray, initial_time: float) -> float:
    """Return the longest lag over which the weights keep a correlation of 0.6, counted from the first time."""
    lags = np.concatenate([[0.0], np.geomspace(0.01 * float(force.period), max(np.ptp(times), 1e-300), 60)])
    at = times[0] + lags
    covariance = _covariance(force.evolution, at, initial_time)
    deviations = np.sqrt(covariance.diagonal())
    correlation = covariance[0] / (deviations[0] * deviations)
    alike = np.flatnonzero(correlation >= _CORRELATION)
    return float(lags[alike.max()]) if alike.size else 0.0


def _refined(times: np.ndarray, substeps: int) -> np.ndarray:
    """Return the times with ``substeps`` equal steps from each to the next."""
    shares = np.arange(substeps) / substeps
    inner = times[:-1, None] + np.diff(times)[:, None] * shares
    return np.append(inner.ravel(), times[-1])


def _covariance(force: Force, grid: np.ndarray, initial_time: float) -> np.ndarray:
    """Return the covariance (J, J) in a model that starts at ``initial_time``, zero where none is known."""
    try:
        return np.asarray(force.covariance_in_model(grid[:, None], grid[None, :], initial_time))
    except NotImplementedError:
        return np.zeros((grid.size, grid.size))


def _features(force: QuasiPeriodic, grid: np.ndarray) -> np.ndarray:
    """Return sqrt(mu_j) phi_j on a grid, (J, functions), falling, for as many functions as can be told apart."""
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
