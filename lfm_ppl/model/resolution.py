"""Warnings that an approximation of a force is too coarse for the data.

A squared exponential force is approximated by an SDE, a periodic force by some of its functions
(`lfm_ppl.model.truncation`), and a force of which the model is an even function is not seen at all
(`lfm_ppl.model.even_forces`). For each squared exponential force of a model:

1. Linearise the model at its prior mean (`lfm_ppl.model.linear_response`).
2. At each frequency, compute the precision with which an evenly spaced record of the outputs determines the force: the
   frequency response G of the outputs, against their noise and the spectral densities of the other forces.
3. `SquaredExponential.approximation_error` gives the error of the log likelihood by frequency.

For records of many lengthscales this is the error of the covariances of the data. For records shorter than a
lengthscale it is too large: a signal-to-noise ratio of 1e6 in variance then gives a warning too early.

Source: Whittle (1953), Arkiv för Matematik 2.
"""

from __future__ import annotations

import contextlib
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from lfm_ppl.forces.sde import ApproximationWarning, Force
from lfm_ppl.forces.squared_exponential import SquaredExponential
from lfm_ppl.model.even_forces import even_force_message, even_forces
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.linear_response import LEAST_NOISE, TOLERANCE, LinearisedTerm, LinearModel, linearised_terms
from lfm_ppl.model.truncation import truncation_message, truncations

_SPACINGS = (1e-9, 10.0)
"""Least and largest spacing in lengthscales; beyond the largest one, observations are independent."""


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

    These are squared exponential forces of too low an order (`resolutions`), periodic forces of too few functions
    (`truncations`), and forces of which the model is an even function (`even_forces`). There is no check inside
    compiled code or for traced parameters.

    Args:
        model: the latent force model.
        times: (T,).
        y: (T, D), NaN where missing.

    Warns:
        ApproximationWarning: the estimated error of the log likelihood exceeds 0.1, or a force is not seen.
    """
    for message in resolution_messages(model, times, y):
        warnings.warn(message, ApproximationWarning, stacklevel=4)


def resolution_messages(model: LatentForceModel, times: Any, y: Any) -> list[str]:
    """Return the warnings of `check_resolution`, one for each force that is too coarse; arguments as there."""
    return [*(_message(resolution) for resolution in resolutions(model, times, y) if resolution.error > TOLERANCE),
            *(truncation_message(item) for item in truncations(model, times, y) if item.error > TOLERANCE),
            *(even_force_message(name) for name in even_forces(model, times))]


def resolutions(model: LatentForceModel, times: Any, y: Any = None) -> list[Resolution]:
    """Estimate the error of the log likelihood of data due to each squared exponential force.

    Args:
        model: the latent force model.
        times: (T,).
        y: (T, D), NaN where missing; None: all entries are observed.

    Returns:
        One entry for each squared exponential force, where `linearised_terms` describes the model.
    """
    results = []
    for linearised in linearised_terms(model, times, y, _is_checked):
        with np.errstate(all="ignore"), contextlib.suppress(np.linalg.LinAlgError):
            results.append(_estimate(linearised))
    return [result for result in results if np.isfinite(result.error)]


def _is_checked(force: Force) -> bool:
    return isinstance(force, SquaredExponential) and np.ndim(force.lengthscale) == np.ndim(force.scale) == 0


def _estimate(linearised: LinearisedTerm) -> Resolution:
    """Return the effect of a force; the error is not finite where numbers overflow."""
    (name, column, force), other_terms, linear, times = linearised
    assert isinstance(force, SquaredExponential)
    lengthscale = float(force.lengthscale)
    spacing = lengthscale * float(np.clip(np.ptp(times) / (times.size - 1) / lengthscale, *_SPACINGS))
    omega = np.linspace(0.0, 10.0 / lengthscale, 1001)[1:]
    gain = np.abs(_frequency_response(linear, omega)[:, :, column]) ** 2
    variances = gain.T @ np.asarray(force.spectral_density(omega)) * omega[0] / np.pi
    factor = np.linalg.cholesky(linear.noise + LEAST_NOISE * variances.max() * np.eye(len(variances)))

    def precision(omega: np.ndarray) -> np.ndarray:
        """Return G' (R spacing + sum_o G_o S_o G_o')^-1 G of the force, by the matrix inversion lemma."""
        white = np.linalg.solve(factor, _frequency_response(linear, omega))
        gram = np.swapaxes(white.conj(), -1, -2) @ white / spacing
        densities = np.zeros((*omega.shape, gram.shape[-1]))
        for _, other_column, other_force in other_terms:
            densities[..., other_column] += _spectral_density(other_force, omega)
        information = np.linalg.solve(np.eye(gram.shape[-1]) + gram * densities[..., None, :], gram)
        return information[..., column, column].real

    error = force.approximation_error(precision, spacing, times.size)
    return Resolution(name, force, error, float(np.nanmax(variances / linear.noise.diagonal())))


def _frequency_response(linear: LinearModel, omega: np.ndarray) -> np.ndarray:
    """Return C (i omega - A)^-1 B + D, of shape (*omega.shape, D, R)."""
    resolvent = 1j * omega[..., None, None] * np.eye(len(linear.a)) - linear.a
    return linear.c @ np.linalg.solve(resolvent, np.broadcast_to(linear.b, (*omega.shape, *linear.b.shape))) + linear.d


def _spectral_density(force: Force, omega: np.ndarray) -> np.ndarray:
    """Return the spectral density of a force, zero if there is no closed form."""
    try:
        return np.asarray(force.spectral_density(omega))
    except NotImplementedError:
        return np.zeros(omega.shape)


def _message(resolution: Resolution) -> str:
    force = resolution.force
    higher_orders = [order for order in force.orders if order > force.order]
    remedy = f"Use order={higher_orders[-1]}, " if higher_orders else "Use "
    return (f"the data can distinguish the SDE of order {force.order} of the force {resolution.name!r} from the exact "
            f"squared exponential process: with lengthscale {float(force.lengthscale):.4g}, scale "
            f"{float(force.scale):.4g} and a signal-to-noise ratio of {resolution.signal_to_noise:.2g} in variance, "
            f"the error of the log likelihood is estimated at {resolution.error:.2g}, above {TOLERANCE:g}. {remedy}a "
            "Matern force (exact), or a larger observation noise if the data are noisier than the model assumes.")
