"""One satellite: fit, choose, predict, by the deterministic model and by the latent force model."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import orbits
from lfm_ppl.experiments.gps import magnitudes, training
from lfm_ppl.experiments.gps.problem import NOISE, Arc, Arcs
from lfm_ppl.experiments.scores import Z
from lfm_ppl.filtering.filter import FilterState, filter
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.linalg import congruence, matmul
from lfm_ppl.linearisation.taylor import Taylor
from lfm_ppl.model.gaussian import Gaussian
from lfm_ppl.model.state_space import state_space

_LATEST = 6.0
"""Hours before the end of training that determine the latest state."""
_STEP = 0.125
"""Longest integration step of a departure in predictions (h)."""


class Unusable(ValueError):
    """A satellite that cannot be predicted or judged; the message says why."""


def arc(data: Arcs, satellite: str, train_days: float) -> Arc:
    """Return the arc of a satellite, all epochs of the data.

    Raises:
        Unusable: too few positions to learn from, or none to judge by.
        ValueError: the training is longer than the data.
    """
    train = int(np.searchsorted(data.times, 24.0 * train_days - 1e-9))
    if 24.0 * train_days < 2 * _LATEST:
        raise ValueError(f"training takes {train_days:g} days; half a day is the least (--train-days).")
    if train >= len(data.times):
        raise ValueError(f"training takes {train_days:g} days, but the data have {_days(data.times):g}, the last "
                         f"position {data.times[-1] / 24.0:.6g} days after the first; take fewer (--train-days), so "
                         "that days are left to judge by.")
    positions = data.positions[satellite]
    known = np.isfinite(positions).all(axis=1)
    gaps = "" if data.published is None else "; ".join(map(str, data.published.gaps(satellite)))
    if known[:train].mean() < 0.9:
        raise Unusable(f"{satellite}: {known[:train].mean():.0%} of its positions in training are there, 90% are "
                       f"needed; missing {gaps}")
    if not known[train:].any():
        raise Unusable(f"{satellite}: there is no position after training to judge by; missing {gaps}")
    return Arc(data.environment, data.times, positions, train)


def _days(times: np.ndarray) -> float:
    return float(times[-1] - times[0] + np.median(np.diff(times))) / 24.0


class Deterministic(NamedTuple):
    """Paths (T, 6) without unknown forces, and how they were found.

    Attributes:
        orbit: fitted to the whole training.
        fitted: its path.
        latest: path from the state at the end of training on; NaN before.
    """

    orbit: orbits.Orbit
    fitted: np.ndarray
    latest: np.ndarray


def deterministic(one: Arc, orbit: orbits.Orbit) -> Deterministic:
    """Follow the orbit that was fitted to training, and another one that is fitted to its last six hours."""
    fitted = orbits.propagate(one.environment, orbit, one.times)
    first, path = _from_latest(one, one.train, orbit.solar)
    latest = np.full_like(fitted, np.nan)
    latest[first:] = path
    return Deterministic(orbit, fitted, latest)


def latest_orbit(one: Arc, end: int, solar: float) -> tuple[int, orbits.Orbit]:
    """Fit the last six hours before the epoch ``end``; return their first epoch and the orbit.

    Raises:
        ValueError: too few positions in them, or no orbit that fits.
    """
    first = end - int(round(_LATEST / (one.times[1] - one.times[0])))
    return first, orbits.fit_orbit(one.environment, one.times[first:end], one.positions[first:end], solar)


def _from_latest(one: Arc, end: int, solar: float) -> tuple[int, np.ndarray]:
    """Return the first epoch of the last six hours before ``end``, and the path from it on that they determine."""
    first, orbit = latest_orbit(one, end, solar)
    return first, orbits.propagate(one.environment, orbit, one.times[first:])


def judge(one: Arc, mean: np.ndarray, covariance: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return errors and their standard deviations along some axes, and how many lie within the 95% bands.

    Args:
        one: the satellite.
        mean: (T, 3) predicted positions.
        covariance: (T, 3, 3) of these.
        axes: (T, 3, 3), as columns.

    Returns:
        Errors (T, 3) and standard deviations (T, 3) in km, those of the published positions included, and the share of
        errors after training that are covered, (3,) by axis.
    """
    error = np.einsum("tji,tj->ti", axes, mean - one.positions)
    sd = np.sqrt(np.einsum("tji,tjk,tki->ti", axes, covariance, axes) + NOISE**2)
    known = np.isfinite(one.positions[one.train:]).all(axis=1)
    inside = np.abs(error[one.train:]) < Z * sd[one.train:]
    return error, sd, inside[known].mean(axis=0)


class Prediction(NamedTuple):
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


def predict(one: Arc, near: orbits.Neighbourhood, logarithms: np.ndarray, y: np.ndarray | None = None) -> Prediction:
    """Smooth the positions of training, and predict all others.

    Args:
        one: the satellite.
        near: the orbit that was fitted to it, at all times; see `surroundings`.
        logarithms: (K, d) of the magnitudes, over which the moments are averaged.
        y: (T, 3) positions to learn from; None: those of training.
    """
    y = (one.learnt() if y is None else y) - np.asarray(near.path[:, :3])
    known = np.flatnonzero(np.isfinite(y).any(axis=1))
    if not len(known):
        raise ValueError("every position is missing (NaN); there is nothing to learn from.")
    found = _predict(near, jnp.asarray(y), jnp.asarray(logarithms), (tuple(one.times), near.axes, int(known[-1]) + 1))
    mean, covariance = map(np.asarray, found)
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return Prediction(np.asarray(near.path) + mean[:, :6], covariance[:, :3, :3], mean[:, 6:], sd[:, 6:])


@functools.partial(jax.jit, static_argnums=(3,))
def _predict(near: orbits.Neighbourhood, y: jax.Array, logarithms: jax.Array, fixed: tuple
             ) -> tuple[jax.Array, jax.Array]:
    times, (axes, seen) = np.array(fixed[0]), fixed[1:]
    settings: dict[str, Any] = {"rule": Taylor(), "steps": training.steps_of(times, _STEP)}

    def one(vector: jax.Array) -> tuple[jax.Array, jax.Array]:
        system = training.departing(vector, near, axes)
        found = smooth(system, times[:seen], y[:seen], **settings)
        if seen == len(times):
            return found.input_mean, found.input_covariance
        # Beyond the last position nothing is to be smoothed, and the filter alone is six times as fast.
        last = FilterState(jnp.asarray(times[seen - 1]), found.mean[-1], found.covariance[-1])
        beyond = filter(system, times[seen:], y[seen:], start=last, **settings)
        matrix, offset = state_space(system).input_map(times[0])
        mean = matmul(beyond.filtered_mean, matrix.T) + offset
        covariance = congruence(matrix, beyond.filtered_covariance)
        return jnp.concatenate([found.input_mean, mean]), jnp.concatenate([found.input_covariance, covariance])

    means, covariances = jax.lax.map(one, logarithms)
    mean = means.mean(axis=0)
    away = means - mean
    return mean, covariances.mean(axis=0) + jnp.einsum("kti,ktj->tij", away, away) / len(away)


def surroundings(one: Arc, orbit: orbits.Orbit, axes: str) -> orbits.Neighbourhood:
    """Return the orbit and what is around it, at all times."""
    return orbits.Neighbourhood.of(one.environment, orbit, one.times, axes,
                                   nodes=2 * training.steps_of(one.times, _STEP))


def online(one: Arc, orbit: orbits.Orbit, logarithms: np.ndarray, axes: str, windows: Any) -> tuple[np.ndarray, ...]:
    """Predict as positions come in: in training, and in windows after it.

    Args:
        one: the satellite.
        orbit: that was fitted to it.
        logarithms: (d,) of the magnitudes.
        axes: of the small forces.
        windows: (begin, end) in days, in which positions are observed.

    Returns:
        One-step-ahead mean (T, 3) and variances (T, 3), the observed epochs (T,), and the path (T, 6) of the
        deterministic model that is started again from the latest state, after each window.
    """
    days = one.times / 24.0
    observed = np.arange(len(days)) < one.train
    ends = [one.train]
    for begin, end in windows:
        inside = (days >= begin) & (days < end)
        observed |= inside
        ends.append(int(np.flatnonzero(inside)[-1]) + 1)
    y = np.where(observed[:, None], one.positions, np.nan)
    mean, covariance = filter_positions(one, orbit, logarithms, axes, y)
    restarted = np.full((len(days), 6), np.nan)
    for end in ends:
        first, path = _from_latest(one, end, orbit.solar)
        restarted[first:] = path
    return mean, np.diagonal(covariance, axis1=1, axis2=2), observed, restarted


def filter_positions(one: Arc, orbit: orbits.Orbit, logarithms: np.ndarray, axes: str, y: np.ndarray
                     ) -> tuple[np.ndarray, np.ndarray]:
    """Return mean (T, 3) and covariance (T, 3, 3) of each position before it is seen, of the satellite itself.

    Nothing is taken to be small here: the filter follows the satellite in steps of 30 s.
    """
    found = _filter(one.environment, orbits.wide_start(orbit.state), jnp.asarray(y), jnp.asarray(logarithms),
                    orbits.period_of(orbit.state[None]), (tuple(one.times), axes))
    return np.asarray(found[0]), np.asarray(found[1])


@functools.partial(jax.jit, static_argnums=(5,))
def _filter(environment: orbits.Environment, start: Gaussian, y: jax.Array, logarithms: jax.Array, period: jax.Array,
            fixed: tuple) -> tuple[jax.Array, jax.Array]:
    times, axes = np.array(fixed[0]), fixed[1]
    forces, white = magnitudes.forces(logarithms, axes, period)
    system = orbits.satellite(environment, start, forces, axes, white, NOISE)
    found = filter(system, times, y, rule=Taylor(), steps=training.steps_of(times, orbits.STEP))
    return found.predicted_mean[:, :3], found.predicted_covariance[:, :3, :3]
