"""One satellite: fit, choose, predict, by the deterministic model and by the latent force model."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import orbits
from lfm_ppl.experiments.gps import problem
from lfm_ppl.experiments.gps.problem import CANDIDATES, NOISE, Arcs, Magnitudes
from lfm_ppl.experiments.scores import Z
from lfm_ppl.filtering.filter import filter
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.linearisation.taylor import Taylor
from lfm_ppl.model.observation import Gaussian

_LATEST = 6.0
"""Hours before the end of training that determine the latest state."""


class Arc(NamedTuple):
    """A satellite and the part of its positions that may be learnt from.

    Attributes:
        environment: Earth, Moon and Sun.
        times: (T,) hours, equally spaced.
        positions: (T, 3) km; NaN where missing.
        train: number of epochs to learn from.
    """

    environment: orbits.Environment
    times: np.ndarray
    positions: np.ndarray
    train: int

    def learnt(self, count: int | None = None) -> np.ndarray:
        """Return the positions (T, 3), NaN after the first ``count`` epochs, by default those of training."""
        return np.where((np.arange(len(self.times)) < (self.train if count is None else count))[:, None],
                        self.positions, np.nan)


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


def deterministic(one: Arc) -> Deterministic:
    """Fit an orbit to the training, and another to its last six hours with the same amplitude of the sunlight."""
    orbit = orbits.fit_orbit(one.environment, one.times[:one.train], one.positions[:one.train])
    fitted = orbits.propagate(one.environment, orbit, one.times)
    first, path = _from_latest(one, one.train, orbit.solar)
    latest = np.full_like(fitted, np.nan)
    latest[first:] = path
    return Deterministic(orbit, fitted, latest)


def _from_latest(one: Arc, end: int, solar: float) -> tuple[int, np.ndarray]:
    """Fit the last six hours before the epoch ``end``; return their first epoch and the path from it on."""
    first = end - int(round(_LATEST / (one.times[1] - one.times[0])))
    last = orbits.fit_orbit(one.environment, one.times[first:end], one.positions[first:end], solar)
    return first, orbits.propagate(one.environment, last, one.times[first:])


class Validation(NamedTuple):
    """What each candidate says of positions that it has not seen; each (C,).

    Attributes:
        score: mean log predictive density of a held-out position.
        rmse: root mean square distance from these (km).
        likelihood: log marginal likelihood of the positions that were seen.
    """

    score: np.ndarray
    rmse: np.ndarray
    likelihood: np.ndarray


def validate(one: Arc, orbit: orbits.Orbit, axes: str, candidates: tuple[Magnitudes, ...] = CANDIDATES) -> Validation:
    """Learn from the first third of the training, and judge every candidate by the other two.

    What is held out is longer than what is learnt from, as it is in the prediction that follows. A shorter time
    would not tell forces that stay from forces that wander.
    """
    seen = one.train // 3
    held = one.positions[:one.train]
    y = np.where((np.arange(one.train) < seen)[:, None], held, np.nan)
    magnitudes = Magnitudes(*jnp.asarray(candidates, float).T)
    steps = steps_of(one)
    found = _validate(one.environment, orbits.wide_start(orbit.state), jnp.asarray(y), jnp.asarray(held), magnitudes,
                      (tuple(one.times[:one.train]), axes, steps, seen))
    score, rmse, likelihood = map(np.asarray, found)
    return Validation(_or_never(score), rmse, _or_never(likelihood))


def _or_never(score: np.ndarray) -> np.ndarray:
    """Return scores, minus infinity where the filter broke down, so that such a candidate is not chosen."""
    return np.where(np.isfinite(score), score, -np.inf)


@functools.partial(jax.jit, static_argnums=(5,))
def _validate(environment: orbits.Environment, start: Gaussian, y: jax.Array, held: jax.Array,
              magnitudes: Magnitudes, fixed: tuple) -> tuple[jax.Array, jax.Array, jax.Array]:
    known_times, axes, steps, seen = fixed

    def judge(one: Magnitudes) -> tuple[jax.Array, jax.Array, jax.Array]:
        system = problem.model(environment, start, one, axes)
        passed = filter(system, np.array(known_times), y, rule=Taylor(), steps=steps)
        error = held[seen:] - passed.predicted_mean[seen:, :3]
        there = jnp.isfinite(error).all(axis=1)
        error = jnp.where(there[:, None], error, 0.0)
        covariance = passed.predicted_covariance[seen:, :3, :3] + NOISE**2 * jnp.eye(3)
        chol = jnp.linalg.cholesky(covariance)
        white = jax.vmap(lambda a, b: jax.scipy.linalg.solve_triangular(a, b, lower=True))(chol, error)
        density = (-0.5 * (white**2).sum(1) - jnp.log(jnp.diagonal(chol, axis1=1, axis2=2)).sum(1)
                   - 1.5 * jnp.log(2 * jnp.pi))
        count = jnp.maximum(there.sum(), 1)
        return (jnp.where(there, density, 0.0).sum() / count, jnp.sqrt((error**2).sum() / count),
                passed.log_likelihood.sum())

    return jax.lax.map(judge, magnitudes)


def likelihoods(one: Arc, orbit: orbits.Orbit, axes: str, candidates: tuple[Magnitudes, ...] = CANDIDATES
                ) -> np.ndarray:
    """Return the log marginal likelihood (C,) of all positions of training, for every candidate."""
    return _or_never(np.asarray(_likelihoods(
        one.environment, orbits.wide_start(orbit.state), jnp.asarray(one.positions[:one.train]),
        Magnitudes(*jnp.asarray(candidates, float).T), (tuple(one.times[:one.train]), axes, steps_of(one)))))


@functools.partial(jax.jit, static_argnums=(4,))
def _likelihoods(environment: orbits.Environment, start: Gaussian, y: jax.Array, magnitudes: Magnitudes,
                 fixed: tuple) -> jax.Array:
    times, axes, steps = fixed

    def score(one: Magnitudes) -> jax.Array:
        system = problem.model(environment, start, one, axes)
        return filter(system, np.array(times), y, rule=Taylor(), steps=steps).log_likelihood.sum()

    return jax.lax.map(score, magnitudes)


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
    """What the latent force model says at all times, given the positions of training.

    Attributes:
        state: (T, 6) mean, smoothed in training and predicted after it.
        covariance: (T, 3, 3) of the position.
        forces: (T, R) mean, in nm/s^2.
        forces_sd: (T, R).
        log_likelihood: of the training.
    """

    state: np.ndarray
    covariance: np.ndarray
    forces: np.ndarray
    forces_sd: np.ndarray
    log_likelihood: float


def predict(one: Arc, orbit: orbits.Orbit, magnitudes: Magnitudes, axes: str, y: np.ndarray | None = None
            ) -> Prediction:
    """Smooth the positions of training, and predict all others.

    Args:
        one: the satellite.
        orbit: that was fitted to it.
        magnitudes: of its small forces.
        axes: of these.
        y: (T, 3) positions to learn from; None: those of training.
    """
    y = one.learnt() if y is None else y
    found = _predict(one.environment, orbits.wide_start(orbit.state), jnp.asarray(y),
                     Magnitudes(*map(jnp.asarray, magnitudes)), (tuple(one.times), axes, steps_of(one)))
    mean, covariance, likelihood = map(np.asarray, found)
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return Prediction(mean[:, :6], covariance[:, :3, :3], mean[:, 6:], sd[:, 6:], float(likelihood))


@functools.partial(jax.jit, static_argnums=(4,))
def _predict(environment: orbits.Environment, start: Gaussian, y: jax.Array, magnitudes: Magnitudes,
             fixed: tuple) -> tuple[jax.Array, jax.Array, jax.Array]:
    times, axes, steps = fixed
    found = smooth(problem.model(environment, start, magnitudes, axes), np.array(times), y, rule=Taylor(), steps=steps)
    return found.input_mean, found.input_covariance, found.log_likelihood.sum()


def online(one: Arc, orbit: orbits.Orbit, magnitudes: Magnitudes, axes: str, windows: Any) -> tuple[np.ndarray, ...]:
    """Predict as positions come in: in training, and in windows after it.

    Args:
        one: the satellite.
        orbit: that was fitted to it.
        magnitudes: of its small forces.
        axes: of these.
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
    mean, covariance = _online(one.environment, orbits.wide_start(orbit.state), jnp.asarray(y),
                               Magnitudes(*map(jnp.asarray, magnitudes)), (tuple(one.times), axes, steps_of(one)))
    restarted = np.full((len(days), 6), np.nan)
    for end in ends:
        first, path = _from_latest(one, end, orbit.solar)
        restarted[first:] = path
    variances = np.diagonal(np.asarray(covariance), axis1=1, axis2=2)
    return np.asarray(mean), variances, observed, restarted


@functools.partial(jax.jit, static_argnums=(4,))
def _online(environment: orbits.Environment, start: Gaussian, y: jax.Array, magnitudes: Magnitudes,
            fixed: tuple) -> tuple[jax.Array, jax.Array]:
    times, axes, steps = fixed
    found = filter(problem.model(environment, start, magnitudes, axes), np.array(times), y, rule=Taylor(), steps=steps)
    return found.predicted_mean[:, :3], found.predicted_covariance[:, :3, :3]


def steps_of(one: Arc) -> int:
    """Return integration steps per interval: of 30 s at most."""
    return int(np.ceil((one.times[1] - one.times[0]) * problem.STEPS_AN_HOUR - 1e-9))
