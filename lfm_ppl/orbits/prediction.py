"""One satellite, predicted by the deterministic model and by the latent force model.

1. Fit an orbit to the positions of training; its propagation is the deterministic prediction.
2. Smooth the departures from this orbit in training, and predict them afterwards, for each draw of the magnitudes.
3. The mean and covariance over the draws are the prediction of the latent force model.
4. Online: filter positions as they arrive, and restart the deterministic model from the latest state.

Source: Hartikainen, Seppänen and Särkkä (2012), section 6.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import norm

from lfm_ppl.filtering.filter import FilterState, filter
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.linearisation.taylor import Taylor
from lfm_ppl.model.gaussian import Gaussian
from lfm_ppl.model.state_space import state_space
from lfm_ppl.orbits import magnitudes, training
from lfm_ppl.orbits.arc import NOISE, Arc
from lfm_ppl.orbits.deterministic import STEP, Orbit, fit_orbit, propagate
from lfm_ppl.orbits.deviations import Neighbourhood
from lfm_ppl.orbits.environment import Environment
from lfm_ppl.orbits.satellite import period_of, satellite, wide_start
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import congruence, matmul

LATEST = 6.0
"""Hours before the end of training that determine the latest state."""
_STEP = 0.125
"""Longest integration step of a departure in predictions (h)."""
_Z = norm.ppf(0.975)


@dataclass(frozen=True)
class Deterministic:
    """Paths (T, 6) without unknown forces, and how they were found.

    Attributes:
        orbit: fitted to the whole training.
        fitted: its path.
        latest: path from the state at the end of training on; NaN before.
    """

    orbit: Orbit
    fitted: np.ndarray
    latest: np.ndarray


def deterministic(arc: Arc, orbit: Orbit) -> Deterministic:
    """Follow the orbit that was fitted to training, and another one that is fitted to its last six hours."""
    fitted = propagate(arc.environment, orbit, arc.times)
    first, path = _from_latest(arc, arc.train, orbit.solar)
    latest = np.full_like(fitted, np.nan)
    latest[first:] = path
    return Deterministic(orbit, fitted, latest)


def latest_orbit(arc: Arc, end: int, solar: float) -> tuple[int, Orbit]:
    """Fit the last six hours before the epoch ``end``; return their first epoch and the orbit.

    Raises:
        ValueError: too few positions in them, or no orbit that fits.
    """
    first = end - int(round(LATEST / (arc.times[1] - arc.times[0])))
    return first, fit_orbit(arc.environment, arc.times[first:end], arc.positions[first:end], solar)


def _from_latest(arc: Arc, end: int, solar: float) -> tuple[int, np.ndarray]:
    """Return the first epoch of the last six hours before ``end``, and the path from it on that they determine."""
    first, orbit = latest_orbit(arc, end, solar)
    return first, propagate(arc.environment, orbit, arc.times[first:])


@dataclass(frozen=True)
class OrbitPrediction:
    """What the latent force model says at all times, given some positions, averaged over magnitudes.

    Attributes:
        state: (T, 6) mean, smoothed where there are positions and predicted elsewhere.
        covariance: (T, 3, 3) of the position.
        forces: (T, R) mean, in nm/s^2.
        forces_sd: (T, R).
    """

    state: np.ndarray
    covariance: np.ndarray
    forces: np.ndarray
    forces_sd: np.ndarray


def predict(
    arc: Arc, neighbourhood: Neighbourhood, logarithms: np.ndarray, y: np.ndarray | None = None
) -> OrbitPrediction:
    """Smooth the positions of training, and predict all others.

    Args:
        arc: the satellite.
        neighbourhood: the orbit that was fitted to it, at all times; see `surroundings`.
        logarithms: (K, d) of the magnitudes, over which the moments are averaged.
        y: (T, 3) positions to learn from; None: the positions of training.
    """
    y = (arc.learnt() if y is None else checks.unmask(y)) - np.asarray(neighbourhood.path[:, :3])
    observed_rows = np.flatnonzero(np.isfinite(y).any(axis=1))
    if not len(observed_rows):
        raise ValueError("every position is missing (NaN); there is nothing to learn from.")
    moments = _predict(
        neighbourhood,
        jnp.asarray(y),
        jnp.asarray(logarithms),
        (tuple(arc.times), neighbourhood.axes, int(observed_rows[-1]) + 1),
    )
    mean, covariance = map(np.asarray, moments)
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return OrbitPrediction(np.asarray(neighbourhood.path) + mean[:, :6], covariance[:, :3, :3], mean[:, 6:], sd[:, 6:])


@functools.partial(jax.jit, static_argnums=(3,))
def _predict(
    neighbourhood: Neighbourhood, y: jax.Array, logarithms: jax.Array, fixed: tuple
) -> tuple[jax.Array, jax.Array]:
    times, (axes, seen) = np.array(fixed[0]), fixed[1:]
    settings: dict[str, Any] = {"rule": Taylor(), "steps": training.steps_of(times, _STEP)}

    def predict_one(vector: jax.Array) -> tuple[jax.Array, jax.Array]:
        system = training.departing(vector, neighbourhood, axes)
        smoothed = smooth(system, times[:seen], y[:seen], **settings)
        if seen == len(times):
            return smoothed.input_mean, smoothed.input_covariance
        # Beyond the last position nothing is to be smoothed, and the filter alone is six times as fast.
        last = FilterState(jnp.asarray(times[seen - 1]), smoothed.mean[-1], smoothed.covariance[-1])
        beyond = filter(system, times[seen:], y[seen:], start=last, **settings)
        matrix, offset = state_space(system).input_map(times[0])
        mean = matmul(beyond.filtered_mean, matrix.T) + offset
        covariance = congruence(matrix, beyond.filtered_covariance)
        return jnp.concatenate([smoothed.input_mean, mean]), jnp.concatenate([smoothed.input_covariance, covariance])

    means, covariances = jax.lax.map(predict_one, logarithms)
    mean = means.mean(axis=0)
    deviations = means - mean
    return mean, covariances.mean(axis=0) + jnp.einsum("kti,ktj->tij", deviations, deviations) / len(deviations)


def judge(arc: Arc, predicted: OrbitPrediction, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compare a prediction with the positions of all times, along the axes in the columns of (T, 3, 3).

    Returns:
        Errors (T, 3) and standard deviations (T, 3) in km, with the errors of published positions, and the share of
        errors after training that lie within the 95% bands, (3,) by axis.
    """
    error = errors(arc, predicted.state, axes)
    sd = np.sqrt(np.einsum("tji,tjk,tki->ti", axes, predicted.covariance, axes) + NOISE**2)
    predicted_rows = slice(arc.train, None)
    is_observed = np.isfinite(arc.positions[predicted_rows]).all(axis=1)
    return error, sd, (np.abs(error[predicted_rows]) < _Z * sd[predicted_rows])[is_observed].mean(axis=0)


def errors(arc: Arc, path: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the errors (T, 3) in km of the positions on a path (T, 6) along axes, the columns of (T, 3, 3)."""
    return np.einsum("tji,tj->ti", axes, path[:, :3] - arc.positions)


def surroundings(arc: Arc, orbit: Orbit, axes: str) -> Neighbourhood:
    """Return the orbit and what is around it, at all times."""
    return Neighbourhood.of(arc.environment, orbit, arc.times, axes, nodes=2 * training.steps_of(arc.times, _STEP))


def online(arc: Arc, orbit: Orbit, logarithms: np.ndarray, axes: str, windows: Any) -> tuple[np.ndarray, ...]:
    """Predict as positions come in: in training, and in windows after it.

    Args:
        arc: the satellite.
        orbit: that was fitted to it.
        logarithms: (d,) of the magnitudes.
        axes: of the small forces.
        windows: (begin, end) in days, in which positions are observed.

    Returns:
        One-step-ahead mean (T, 3) and variances (T, 3), the observed epochs (T,), and the path (T, 6) of the
        deterministic model that is started again from the latest state, after each window.
    """
    days = arc.times / 24.0
    observed = np.arange(len(days)) < arc.train
    window_ends = [arc.train]
    for begin, end in windows:
        is_in_window = (days >= begin) & (days < end)
        observed |= is_in_window
        window_ends.append(int(np.flatnonzero(is_in_window)[-1]) + 1)
    y = np.where(observed[:, None], arc.positions, np.nan)
    mean, covariance = filter_positions(arc, orbit, logarithms, axes, y)
    restarted = np.full((len(days), 6), np.nan)
    for end in window_ends:
        first, path = _from_latest(arc, end, orbit.solar)
        restarted[first:] = path
    return mean, np.diagonal(covariance, axis1=1, axis2=2), observed, restarted


def filter_positions(arc: Arc, orbit: Orbit, logarithms: np.ndarray, axes: str, y: np.ndarray
                     ) -> tuple[np.ndarray, np.ndarray]:
    """Return mean (T, 3) and covariance (T, 3, 3) of each position before it is seen, of the satellite itself.

    Nothing is taken to be small here: the filter follows the satellite in steps of 30 s.
    """
    predicted = _filter(arc.environment, wide_start(orbit.state), jnp.asarray(y), jnp.asarray(logarithms),
                    period_of(orbit.state[None]), (tuple(arc.times), axes))
    return np.asarray(predicted[0]), np.asarray(predicted[1])


@functools.partial(jax.jit, static_argnums=(5,))
def _filter(environment: Environment, start: Gaussian, y: jax.Array, logarithms: jax.Array, period: jax.Array,
            fixed: tuple) -> tuple[jax.Array, jax.Array]:
    times, axes = np.array(fixed[0]), fixed[1]
    forces, white = magnitudes.forces(logarithms, axes, period)
    system = satellite(environment, start, forces, axes, white, NOISE)
    filtered = filter(system, times, y, rule=Taylor(), steps=training.steps_of(times, STEP))
    return filtered.predicted_mean[:, :3], filtered.predicted_covariance[:, :3, :3]
