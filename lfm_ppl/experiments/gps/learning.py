"""Learning the magnitudes of the small forces from the positions of training alone.

Published positions are smoothed by a dynamic model, so that they scatter far less than they are wrong, and the
marginal likelihood of positions has the forces explain what is left. What counts here is how well held-out positions
are predicted: from the first third of the training its other two, and from two thirds the last one. Magnitudes weigh
by exp(WEIGHT * their mean log predictive density) times a prior, whose mode and curvature are found. The prior is what
satellites have in common: each is learnt by itself first, then again with the mean and scatter of all of them.

All this runs on departures from an orbit, `lfm_ppl.orbits.departure`: a filter of the training takes some hundredths
of a second.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

from lfm_ppl import orbits
from lfm_ppl.experiments.gps import magnitudes
from lfm_ppl.experiments.gps.magnitudes import Prior
from lfm_ppl.experiments.gps.problem import NOISE, Arc
from lfm_ppl.filtering.filter import filter
from lfm_ppl.linalg import solve_lower
from lfm_ppl.linearisation.taylor import Taylor

WEIGHT = 30.0
"""How many positions a fold counts for: neighbours in time are wrong together."""
DRAWS = 16
"""Magnitudes over which a prediction is averaged."""
_EVALUATIONS = 40
_DIFFERENCE = 1e-4
_LONGEST = 0.5
"""Hours from one position to the next in learning; closer ones say the same."""
_STEP = 0.25
"""Longest integration step of a departure (h): its error is 3e-3 of the departure after two days, a quarter of the
step one of 3e-6."""


class Target(NamedTuple):
    """What is known of the magnitudes: a log density of their logarithms, up to a constant.

    Attributes:
        evidence: from logarithms (d,) to what the positions say, and its gradient (d,).
        prior: of the logarithms.
    """

    evidence: Callable[[np.ndarray], tuple[float, np.ndarray]]
    prior: Prior

    def mode(self, start: np.ndarray | None = None) -> np.ndarray:
        """Return its mode (d,), searched from ``start`` (d,) or from the prior's mean.

        Raises:
            ValueError: the density there is not finite.
        """
        highest = -np.inf

        def descent(point: np.ndarray) -> tuple[float, np.ndarray]:
            nonlocal highest
            value, gradient = self.negative(point)
            if not (np.isfinite(value) and np.isfinite(gradient).all()):  # a wall, from which the search turns back
                return highest + 1e3, np.zeros_like(point)
            highest = max(highest, value)
            return value, gradient

        first = self.prior.mean if start is None else start
        found = scipy.optimize.minimize(descent, first, jac=True, method="L-BFGS-B",
                                        options={"maxfun": _EVALUATIONS}).x
        if highest == -np.inf:  # not one value was finite: the search ends where it begins
            raise ValueError(f"positions have no density at the first magnitudes of the search, {np.exp(first)}.")
        return found

    def negative(self, point: np.ndarray) -> tuple[float, np.ndarray]:
        """Return minus the log density, and its gradient (d,)."""
        value, gradient = self.evidence(point)
        away = (point - self.prior.mean) / self.prior.sd
        return 0.5 * float(away @ away) - value, away / self.prior.sd - gradient

    def draws(self, mode: np.ndarray, count: int) -> np.ndarray:
        """Return vectors (count, d) about the mode, normal with the curvature there; the same at every call.

        Raises:
            ValueError: the curvature is not finite.
        """
        mean, sd = self.prior
        here = self.negative(mode)[1]
        # One-sided: the error of a second derivative is the step times a third, which is nothing beside a Laplace
        # approximation's own.
        columns = np.stack([(self.negative(mode + _DIFFERENCE * unit)[1] - here) / _DIFFERENCE
                            for unit in np.eye(len(mode))])
        hessian = 0.5 * (columns + columns.T)
        if not np.isfinite(hessian).all():
            raise ValueError(f"positions have no finite curvature at the magnitudes {np.exp(mode)}.")
        # In units of the prior the curvature is at least one: positions may say nothing, but never less than that.
        values, vectors = np.linalg.eigh(hessian * np.outer(sd, sd))
        root = sd[:, None] * vectors / np.sqrt(np.maximum(values, 1.0))
        return mode + np.random.default_rng(0).normal(size=(count, len(mode))) @ root.T


class Training(NamedTuple):
    """The training as departures from an orbit.

    Attributes:
        near: the orbit, at these times.
        times: (T,) hours.
        y: (T, 3) km, NaN where missing.
        axes: of the small forces.
    """

    near: orbits.Neighbourhood
    times: np.ndarray
    y: np.ndarray
    axes: str

    @property
    def fixed(self) -> tuple:
        """What compilation depends on."""
        return tuple(self.times), self.axes


def training(one: Arc, orbit: orbits.Orbit, axes: str) -> Training:
    """Return the training of a satellite, thinned to half an hour from one position to the next."""
    interval = float(one.times[1] - one.times[0])
    thin = max(1, int(_LONGEST / interval + 1e-9))
    times = one.times[:one.train:thin]
    near = orbits.Neighbourhood.of(one.environment, orbit, times, axes, nodes=2 * steps_of(times))
    return Training(near, times, one.positions[:one.train:thin] - np.asarray(near.path[:, :3]), axes)


def steps_of(times: np.ndarray, step: float = _STEP) -> int:
    """Return integration steps between two times."""
    return max(1, int(np.ceil((times[1] - times[0]) / step - 1e-9)))


def held_out(data: Training, prior: Prior) -> Target:
    """Return how well held-out positions are predicted, as a target."""
    count = len(data.times)
    folds = jnp.asarray([count // 3, 2 * count // 3])

    def objective(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = _held_out(jnp.asarray(logarithms), data.near, jnp.asarray(data.y), folds, data.fixed)
        return WEIGHT * float(value), WEIGHT * np.asarray(gradient)

    return Target(objective, prior)


@functools.partial(jax.jit, static_argnums=(4,))
@jax.value_and_grad
def _held_out(logarithms: jax.Array, near: orbits.Neighbourhood, y: jax.Array, folds: jax.Array, fixed: tuple
              ) -> jax.Array:
    times, axes = fixed
    system = departing(logarithms, near, axes)
    known = jnp.isfinite(y).all(axis=1)
    clean = jnp.where(known[:, None], y, 0.0)

    def score(seen: jax.Array) -> jax.Array:
        early = jnp.arange(len(times)) < seen
        passed = filter(system, np.array(times), jnp.where(early[:, None], y, jnp.nan), rule=Taylor(),
                        steps=steps_of(np.array(times)))
        density = log_density(clean - passed.predicted_mean[:, :3], passed.predicted_covariance[:, :3, :3])
        judged = known & ~early
        return jnp.where(judged, density, 0.0).sum() / jnp.maximum(judged.sum(), 1)

    return jax.lax.map(score, folds).sum()


def departing(logarithms: jax.Array, near: orbits.Neighbourhood, axes: str) -> Any:
    """Return the model of departures with these magnitudes."""
    forces, white = magnitudes.forces(logarithms, axes)
    return orbits.departure(near, forces, white, NOISE)


def log_density(error: jax.Array, covariance: jax.Array) -> jax.Array:
    """Return the log density (T,) of errors (T, 3) whose covariance is (T, 3, 3) and that of the positions."""
    chol = jnp.linalg.cholesky(covariance + NOISE**2 * jnp.eye(3))
    white = jax.vmap(solve_lower)(chol, error)
    return (-0.5 * (white**2).sum(1) - jnp.log(jnp.diagonal(chol, axis1=1, axis2=2)).sum(1)
            - 1.5 * jnp.log(2 * jnp.pi))
