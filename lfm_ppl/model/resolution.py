"""Estimates of the error of the log likelihood due to the SDE of a squared exponential force.

The SDE of order n has the covariance k_n instead of k. For each squared exponential force of a model:

1. Linearise the model at its prior mean (`lfm_ppl.model.linear_response`).
2. Replace the observation times by evenly spaced times over a window of at most 20 lengthscales and 150 observed
   values. Fewer rows with less noise represent dense data; long records consist of independent pieces.
3. Compute the exact covariance K of the outputs, with noise, initial state and other forces, and the covariance K_n
   under the SDE.
4. The eigenvalues of K_n^-1 K give the mean and variance of the error of the log likelihood (`error_bound`).
5. `check_resolution` warns where the error exceeds `TOLERANCE`, also for truncated periodic forces
   (`lfm_ppl.model.truncation`).

Source: Whittle (1953), Arkiv för Matematik 2.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

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
"""Length of the window in lengthscales; the pieces of longer records are treated as independent."""
_FINEST_SPACING = 0.2
"""Spacing in lengthscales below which several observations are equivalent to one observation with less noise."""
_INDEPENDENT_SPACING = 10.0
"""Spacing in lengthscales beyond which observations are independent."""
_MOST_VALUES = 150
"""Largest number of observed values in the window; a larger number is represented by these, with less noise."""
_LONGEST_STEP = 0.25
"""Longest step in lengthscales over which a force is taken as linear in time."""


@dataclass(frozen=True)
class Resolution:
    """The effect of the approximation of one squared exponential force.

    Attributes:
        name: name of the force in the model.
        force: the squared exponential force, perhaps a term of a sum.
        error: estimated error of the log likelihood: |mean| + 2 standard deviations over data sets from the exact
            process.
        signal_to_noise: largest ratio of the variance of an output due to the force to its noise variance.
    """

    name: str
    force: SquaredExponential
    error: float
    signal_to_noise: float


def check_resolution(model: LatentForceModel, times: Any, y: Any) -> None:
    """Warn of forces whose approximation is too coarse for the data.

    These are squared exponential forces of too low an order (`resolutions`) and periodic forces of too few functions
    (`truncations`). There is no check inside compiled code or for traced parameters.

    Args:
        model: the latent force model.
        times: (T,).
        y: (T, D), NaN where missing.

    Warns:
        ApproximationWarning: the estimated error of the log likelihood exceeds 0.1.
    """
    for message in resolution_messages(model, times, y):
        warnings.warn(message, ApproximationWarning, stacklevel=4)


def resolution_messages(model: LatentForceModel, times: Any, y: Any) -> list[str]:
    """Return the warnings of `check_resolution`, one for each force that is too coarse; arguments as there."""
    return [_message(resolution) for resolution in resolutions(model, times, y) if resolution.error > TOLERANCE] + [
        truncation_message(truncation) for truncation in truncations(model, times, y) if truncation.error > TOLERANCE]


def resolutions(model: LatentForceModel, times: Any, y: Any = None) -> list[Resolution]:
    r"""Estimate the error of the log likelihood of data at ``times`` due to each squared exponential force.

    For data y ~ N(0, K) from the exact process, whose covariance is K_n under the SDE, the error of the log likelihood
    has the moments, with the eigenvalues e_i of K_n^-1 K,

        mean = -sum_i (e_i - 1 - log e_i) / 2,    variance = sum_i (e_i - 1)^2 / 2.

    K belongs to the model linearised at its prior mean, including noise, initial state and other forces, for evenly
    spaced observations. For records longer than 20 lengthscales, mean and variance are computed over 20 lengthscales
    and scaled to the full record.

    Args:
        model: the latent force model.
        times: (T,).
        y: (T, D), NaN where missing; None: all entries are observed.

    Returns:
        One entry for each squared exponential force, also in sums. The list is empty if a value is traced, if fewer
        than two times are observed, and for a model with process noise, which the estimate does not include.
    """
    terms = force_terms(model)
    if not any(isinstance(force, SquaredExponential) for _, _, force in terms):
        return []
    observed = observed_times(model, times, y)
    linear = None if observed is None else linearize(model, observed[0])
    if observed is None or linear is None:
        return []
    results = []
    for index, (name, column, force) in enumerate(terms):
        if isinstance(force, SquaredExponential) and np.ndim(force.lengthscale) == np.ndim(force.scale) == 0:
            other_terms = terms[:index] + terms[index + 1:]
            with np.errstate(all="ignore"):
                estimate = _estimate(linear, observed, force, column, other_terms)
            if estimate is not None:
                results.append(Resolution(name, force, *estimate))
    return results


def _estimate(linear: LinearModel, times: np.ndarray, force: SquaredExponential, column: int,
              other_terms: list[ForceTerm]) -> tuple[float, float] | None:
    """Return the error and the signal-to-noise ratio; None if the numbers overflow."""
    lengthscale, outputs = float(force.lengthscale), len(linear.c)
    spacing = min(np.ptp(times) / max(times.size - 1, 1), _INDEPENDENT_SPACING * lengthscale)
    most_rows = max(4, _MOST_VALUES // outputs)
    window = min(_WINDOW, most_rows * _FINEST_SPACING) * lengthscale
    count = min(times.size, 1.0 + max(window, 3.0 * spacing) / spacing) if spacing > 0.0 else times.size
    pieces = times.size / count
    points = int(np.ceil(min(count, most_rows)))
    window = spacing * (count - 1.0)
    substeps = 1 if points == 1 else max(1, int(np.ceil(window / (points - 1) / (_LONGEST_STEP * lengthscale))))
    grid = np.linspace(0.0, window, (points - 1) * substeps + 1)
    response, initial = output_responses(linear, grid, substeps)

    def output_covariance(kernel: np.ndarray, source: int) -> np.ndarray:
        return response[:, :, source] @ kernel @ response[:, :, source].T

    exact_kernel, sde_kernel = force.covariances(grid[:, None] - grid)
    signal = output_covariance(exact_kernel, column)
    noise = np.kron(np.eye(points), linear.noise * (points / count))
    exact = signal + noise + initial @ initial.T
    for _, other_column, other_force in other_terms:
        exact = exact + output_covariance(exact_covariance(other_force, grid), other_column)
    exact = exact + LEAST_NOISE * signal.diagonal().max() * np.eye(len(exact))
    try:
        difference = output_covariance(sde_kernel - exact_kernel, column)
        factor, approximate = (np.linalg.cholesky(m) for m in (exact, exact + difference))
        ratio = np.linalg.solve(approximate, factor)
        values = np.linalg.eigvalsh(ratio.T @ ratio)
    except np.linalg.LinAlgError:
        return None
    error = error_bound(values, pieces)
    variances = signal.diagonal() / np.tile(linear.noise.diagonal(), points)
    return (error, float(np.nanmax(variances))) if np.isfinite(error) else None


def _message(resolution: Resolution) -> str:
    force = resolution.force
    higher_orders = [order for order in force.orders if order > force.order]
    remedy = f"Use order={higher_orders[-1]}, " if higher_orders else "Use "
    return (f"the data can distinguish the SDE of order {force.order} of the force {resolution.name!r} from the exact "
            f"squared exponential process: with lengthscale {float(force.lengthscale):.4g}, scale "
            f"{float(force.scale):.4g} and a signal-to-noise ratio of {resolution.signal_to_noise:.2g} in variance, "
            f"the error of the log likelihood is estimated at {resolution.error:.2g}, above {TOLERANCE:g}. {remedy}a "
            "Matern force (exact), or a larger observation noise if the data are noisier than the model assumes.")
