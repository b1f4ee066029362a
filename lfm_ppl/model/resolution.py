"""Whether data can tell the SDE of a squared exponential force from the process that it approximates."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import expm

from lfm_ppl import checks
from lfm_ppl.forces.sde import ApproximationWarning, Force, Sum
from lfm_ppl.forces.squared_exponential import SquaredExponential
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observations.family import ObservationFamily

TOLERANCE = 0.1
"""Error of the log likelihood above which there is a warning."""

_WINDOW = 20.0
"""Lengthscales that are looked at; errors of longer records grow as if their pieces were independent."""
_FINEST = 0.2
"""Spacing, in lengthscales, below which more observations are as good as fewer with less noise."""
_APART = 10.0
"""Spacing, in lengthscales, beyond which observations are independent."""
_ROWS = 150
"""Number of observed values that are looked at, at most; of more, as many with less noise stand for all."""
_COARSEST = 0.25
"""Longest step, in lengthscales, over which a force is taken to be linear in time."""
_LEAST_NOISE = 1e-10
"""Observation noise that is assumed at least, relative to the variance of the signal; K is singular without."""


class Resolution(NamedTuple):
    """How well data resolve the approximation of one force.

    Attributes:
        name: of the force in the model.
        force: the squared exponential force, a term of a sum perhaps.
        error: of the log likelihood, estimated: |mean| + 2 standard deviations over data sets from the exact process.
        signal_to_noise: variance of the outputs due to the force over that of the observation noise, the largest.
    """

    name: str
    force: SquaredExponential
    error: float
    signal_to_noise: float


def check_resolution(model: LatentForceModel, times: Any, y: Any) -> None:
    """Warn of squared exponential forces whose order is too low for the data.

    It does nothing inside compiled code, or where a parameter is traced. See `resolutions` for what is computed.

    Args:
        model: the latent force model.
        times: (T,).
        y: (T, D), NaN where missing; times at which nothing is observed do not count.

    Warns:
        ApproximationWarning: the estimated error of the log likelihood exceeds 0.1.
    """
    for found in resolutions(model, times, y):
        if found.error > TOLERANCE:
            warnings.warn(_message(found), ApproximationWarning, stacklevel=4)


def resolutions(model: LatentForceModel, times: Any, y: Any = None) -> list[Resolution]:
    r"""Estimate what the order of each squared exponential force does to the log likelihood of data at ``times``.

    For data y ~ N(0, K) from the exact process, whose covariance is K_n under the SDE, the error of the log likelihood
    has the moments, with the eigenvalues e_i of K_n^-1 K,

        mean = -sum_i (e_i - 1 - log e_i) / 2,    variance = sum_i (e_i - 1)^2 / 2.

    K is that of the model linearised at its prior mean, with the noise, the initial state and the other forces in it,
    for observations that are evenly spread. Of records of more than 20 lengthscales the first 20 are taken, and the
    mean and the variance scaled to the whole.

    Args:
        model: the latent force model.
        times: (T,).
        y: (T, D), NaN where missing; everything is observed by default.

    Returns:
        One entry for each squared exponential force, also in sums; none where something is traced, where fewer than two
        times are observed, and for a model with process noise, which hides what the estimate does not know.
    """
    terms = [(name, column, term) for column, (name, force) in enumerate(zip(model.force_names, model.force_list,
                                                                             strict=True)) for term in _terms(force)]
    # Only now is anything computed: other models pass at no cost. In compiled code every new array is traced.
    if not any(isinstance(term, SquaredExponential) for *_, term in terms):
        return []
    if isinstance(model.observation, ObservationFamily):
        return []
    if model.process_noise is not None or checks.traced((model, times, y, jnp.zeros(()))):
        return []
    known = np.asarray(times, float)
    if y is not None and known.ndim == 1 and np.shape(y)[:1] == known.shape:
        known = known[np.isfinite(np.asarray(y, float)).reshape(known.size, -1).any(axis=1)]
    if known.size < 2:
        return []
    linear = _linearised(model, known[0])
    if linear is None or known.ndim != 1 or not np.all(np.isfinite(known)):
        return []
    found = []
    for index, (name, column, term) in enumerate(terms):
        if isinstance(term, SquaredExponential) and np.ndim(term.lengthscale) == np.ndim(term.scale) == 0:
            rest = [(other[1], other[2]) for position, other in enumerate(terms) if position != index]
            with np.errstate(all="ignore"):
                result = _estimate(linear, known, term, column, rest)
            if result is not None:
                found.append(Resolution(name, term, *result))
    return found


class _Linear(NamedTuple):
    """dx/dt = A x + B u, y = C x + D u + e, e ~ N(0, R), x(t0) ~ N(., P0)."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray
    noise: np.ndarray
    initial: np.ndarray


def _terms(force: Force) -> tuple[Force, ...]:
    return force.forces if isinstance(force, Sum) else (force,)


def _linearised(model: LatentForceModel, time: float) -> _Linear | None:
    """The model at the prior mean; None where that is traced or not finite."""
    t = jnp.asarray(time, float)
    x = model.initial_state.mean
    u = jnp.asarray([force.mean_at(t) for force in model.force_list], float)
    slopes: list[Any] = []
    for function in (model.dynamics, model.observation.function):
        differentiate: Callable[..., Any] = jax.jacfwd(lambda x, u, f=function: jnp.asarray(f(x, u, t), float), (0, 1))
        slopes.extend(differentiate(x, u))
    covariance = model.observation.covariance
    noise = (jnp.median(jnp.asarray(covariance), axis=0) if np.ndim(covariance) == 3
             else model.observation.covariance_at(x, u, t, jnp.asarray(0)))
    parts = (*slopes, noise, model.initial_state.covariance)
    if checks.traced(parts):
        return None
    linear = _Linear(*(np.asarray(part, float) for part in parts))
    return linear if all(np.all(np.isfinite(part)) for part in linear) else None


def _estimate(linear: _Linear, times: np.ndarray, force: SquaredExponential, column: int,
              rest: list[tuple[int, Force]]) -> tuple[float, float] | None:
    """Return the error and the ratio of signal to noise; None where the numbers overflow."""
    lengthscale, outputs = float(force.lengthscale), len(linear.c)
    spacing = min(np.ptp(times) / max(times.size - 1, 1), _APART * lengthscale)
    most = max(4, _ROWS // outputs)
    window = min(_WINDOW, most * _FINEST) * lengthscale
    count = min(times.size, 1.0 + max(window, 3.0 * spacing) / spacing) if spacing > 0.0 else times.size
    pieces = times.size / count
    points = int(np.ceil(min(count, most)))
    window = spacing * (count - 1.0)
    substeps = 1 if points == 1 else max(1, int(np.ceil(window / (points - 1) / (_COARSEST * lengthscale))))
    grid = np.linspace(0.0, window, (points - 1) * substeps + 1)
    response, initial = _responses(linear, grid, substeps)

    def mapped(kernel: np.ndarray, source: int) -> np.ndarray:
        return response[:, :, source] @ kernel @ response[:, :, source].T

    true, of_sde = force.covariances(grid[:, None] - grid)
    signal = mapped(true, column)
    noise = np.kron(np.eye(points), linear.noise * (points / count))
    exact = signal + noise + initial @ initial.T
    for source, other in rest:
        exact = exact + mapped(_covariance(other, grid), source)
    exact = exact + _LEAST_NOISE * signal.diagonal().max() * np.eye(len(exact))
    try:
        factor, approximate = (np.linalg.cholesky(m) for m in (exact, exact + mapped(of_sde - true, column)))
        ratio = np.linalg.solve(approximate, factor)
        values = np.linalg.eigvalsh(ratio.T @ ratio)
    except np.linalg.LinAlgError:
        return None
    mean, variance = 0.5 * (values - 1.0 - np.log(values)).sum(), 0.5 * ((values - 1.0) ** 2).sum()
    error = pieces * mean + 2.0 * np.sqrt(pieces * variance)
    variances = signal.diagonal() / np.tile(linear.noise.diagonal(), points)
    return (float(error), float(np.nanmax(variances))) if np.isfinite(error) else None


def _responses(linear: _Linear, grid: np.ndarray, substeps: int) -> tuple[np.ndarray, np.ndarray]:
    """Linear maps from the forces on the grid, (points D, J, R), and from a standard normal, (points D, M), to y."""
    size, sources = linear.b.shape
    step = grid[1] if grid.size > 1 else 0.0
    block = np.zeros((size + sources, size + sources))
    block[:size, :size], block[:size, size:] = linear.a * step, linear.b * step
    transition = expm(block)
    values, vectors = np.linalg.eigh(linear.initial)
    start = vectors * np.sqrt(np.maximum(values, 0.0))
    state = np.zeros((size, grid.size, sources))
    response, initial = [], []
    for index in range(grid.size):
        if index:
            # u is taken as the mean of both ends of the step.
            state = np.einsum("ij,jkr->ikr", transition[:size, :size], state)
            state[:, index - 1: index + 1] += 0.5 * transition[:size, None, size:]
            start = transition[:size, :size] @ start
        if index % substeps == 0:
            output = np.einsum("ij,jkr->ikr", linear.c, state)
            output[:, index] += linear.d
            response.append(output)
            initial.append(linear.c @ start)
    return np.concatenate(response), np.concatenate(initial)


def _covariance(force: Force, grid: np.ndarray) -> np.ndarray:
    """The exact covariance on the grid, zero where there is no closed form."""
    try:
        return np.asarray(force.covariance(grid[:, None], grid))
    except NotImplementedError:
        return np.zeros((grid.size, grid.size))


def _message(found: Resolution) -> str:
    force = found.force
    better = [order for order in force.orders if order > force.order]
    remedy = f"Take order={better[-1]}, " if better else "Take "
    return (f"the data can tell the SDE of order {force.order} from the squared exponential process that the force "
            f"{found.name!r} stands for: with lengthscale {float(force.lengthscale):.4g}, scale "
            f"{float(force.scale):.4g} and a signal-to-noise ratio of {found.signal_to_noise:.2g} in variance, the "
            f"error of the log likelihood is estimated at {found.error:.2g}, above {TOLERANCE:g}. {remedy}a Matern "
            "force (exact), or a larger observation noise if the data have more than the model says.")
