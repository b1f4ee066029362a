"""Whether data can tell the SDE of a squared exponential force from the process that it approximates."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np

from lfm_ppl.forces.sde import ApproximationWarning
from lfm_ppl.forces.squared_exponential import SquaredExponential
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.linear_response import (
    LEAST_NOISE,
    TOLERANCE,
    ForceTerm,
    LinearModel,
    error_bound,
    exact_covariance,
    force_terms,
    linearize,
    observed_times,
    output_responses,
)
from lfm_ppl.model.truncation import truncation_message, truncations

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
    """Warn of forces whose approximation is too coarse for the data.

    These are squared exponential forces of too low an order (`resolutions`), and periodic forces of too few functions
    (`truncations`). Nothing happens inside compiled code, or where a parameter is traced.

    Args:
        model: the latent force model.
        times: (T,).
        y: (T, D), NaN where missing; times at which nothing is observed do not count.

    Warns:
        ApproximationWarning: the estimated error of the log likelihood exceeds 0.1.
    """
    for message in resolution_messages(model, times, y):
        warnings.warn(message, ApproximationWarning, stacklevel=4)


def resolution_messages(model: LatentForceModel, times: Any, y: Any) -> list[str]:
    """Return the messages of `check_resolution`, one for each force that is too coarse; arguments as there."""
    return [_message(resolution) for resolution in resolutions(model, times, y) if resolution.error > TOLERANCE] + [
        truncation_message(truncation) for truncation in truncations(model, times, y) if truncation.error > TOLERANCE]


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
    terms = force_terms(model)
    # Only now is anything computed: other models pass at no cost.
    if not any(isinstance(term.force, SquaredExponential) for term in terms):
        return []
    observed = observed_times(model, times, y)
    linear = None if observed is None else linearize(model, observed[0])
    if observed is None or linear is None:
        return []
    found = []
    for index, (name, column, force) in enumerate(terms):
        if isinstance(force, SquaredExponential) and np.ndim(force.lengthscale) == np.ndim(force.scale) == 0:
            others = [other for position, other in enumerate(terms) if position != index]
            with np.errstate(all="ignore"):
                result = _estimate(linear, observed, force, column, others)
            if result is not None:
                found.append(Resolution(name, force, *result))
    return found


def _estimate(linear: LinearModel, times: np.ndarray, force: SquaredExponential, column: int,
              others: list[ForceTerm]) -> tuple[float, float] | None:
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
    response, initial = output_responses(linear, grid, substeps)

    def mapped(kernel: np.ndarray, source: int) -> np.ndarray:
        return response[:, :, source] @ kernel @ response[:, :, source].T

    true, of_sde = force.covariances(grid[:, None] - grid)
    signal = mapped(true, column)
    noise = np.kron(np.eye(points), linear.noise * (points / count))
    exact = signal + noise + initial @ initial.T
    for other in others:
        exact = exact + mapped(exact_covariance(other.force, grid), other.column)
    exact = exact + LEAST_NOISE * signal.diagonal().max() * np.eye(len(exact))
    try:
        factor, approximate = (np.linalg.cholesky(m) for m in (exact, exact + mapped(of_sde - true, column)))
        ratio = np.linalg.solve(approximate, factor)
        values = np.linalg.eigvalsh(ratio.T @ ratio)
    except np.linalg.LinAlgError:
        return None
    error = error_bound(values, pieces)
    variances = signal.diagonal() / np.tile(linear.noise.diagonal(), points)
    return (error, float(np.nanmax(variances))) if np.isfinite(error) else None


def _message(found: Resolution) -> str:
    force = found.force
    better = [order for order in force.orders if order > force.order]
    remedy = f"Take order={better[-1]}, " if better else "Take "
    return (f"the data can tell the SDE of order {force.order} from the squared exponential process that the force "
            f"{found.name!r} stands for: with lengthscale {float(force.lengthscale):.4g}, scale "
            f"{float(force.scale):.4g} and a signal-to-noise ratio of {found.signal_to_noise:.2g} in variance, the "
            f"error of the log likelihood is estimated at {found.error:.2g}, above {TOLERANCE:g}. {remedy}a Matern "
            "force (exact), or a larger observation noise if the data have more than the model says.")
