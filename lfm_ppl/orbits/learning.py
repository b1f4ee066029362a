"""Learning the magnitudes of the small forces from the positions of training.

1. Published positions come from a dynamic model, so that they scatter much less than their error. The marginal
   likelihood would therefore let the forces explain the errors.
2. The criterion is the prediction of held-out positions: from the first third of the training the rest, and from two
   thirds the last third.
3. Magnitudes have the weight exp(WEIGHT * mean log predictive density) times a prior; its mode and curvature are
   computed.
4. Each satellite is learnt with a wide prior first, then again with the mean and scatter of all satellites as prior.
5. All this runs on departures from an orbit, as a linear regression (`training`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.filter import filter
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.forces import Matern
from lfm_ppl.inference.optimise import Objective, quasi_newton
from lfm_ppl.linearisation.taylor import Taylor
from lfm_ppl.model.gaussian import Gaussian
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation import GaussianObservation
from lfm_ppl.orbits import magnitudes
from lfm_ppl.orbits.arc import NOISE
from lfm_ppl.orbits.deviations import Neighbourhood, departure
from lfm_ppl.orbits.magnitudes import Prior
from lfm_ppl.orbits.satellite import SOLAR_PRESSURE, small_forces
from lfm_ppl.orbits.training import Training, slope_of_held_out, slope_of_log_likelihood, steps_of

WEIGHT = 3.0
"""How many positions a fold counts for: neighbours in time are wrong together, most of all along the track.

Chosen from 3, 10 and 30 by the errors of the GPS satellites; the errors of Galileo and GLONASS confirmed it."""
DRAWS = 16
"""Magnitudes over which a prediction is averaged."""
_EVALUATIONS = 40
_DIFFERENCE = 1e-4
_SCALE, _LENGTHSCALE = 2.0, 3.0
"""Of the Matern model that smooths the forces: nm/s^2, hours."""
_APART = 1.0
"""Hours between the values of a smoothed force that count: neighbours say much the same."""


@dataclass(frozen=True)
class Target:
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
        first = self.prior.mean if start is None else start
        lowest = quasi_newton(Objective(self.negative), first, options={"maxfun": _EVALUATIONS})
        if not np.isfinite(lowest.value):
            raise ValueError(f"positions have no density at the first magnitudes of the search, {np.exp(first)}.")
        return lowest.point

    def negative(self, point: Any) -> tuple[float, np.ndarray]:
        """Return minus the log density, and its gradient (d,)."""
        point = np.asarray(point)
        value, gradient = self.evidence(point)
        standardised = (point - self.prior.mean) / self.prior.sd
        return 0.5 * float(standardised @ standardised) - value, standardised / self.prior.sd - gradient

    def draws(self, mode: np.ndarray, count: int) -> np.ndarray:
        """Return vectors (count, d) about the mode, normal with the curvature there; the same at every call.

        Raises:
            ValueError: the curvature is not finite.
        """
        mean, sd = self.prior
        gradient = self.negative(mode)[1]
        # One-sided: the error of a second derivative is the step times a third, which is nothing beside a Laplace
        # approximation's own.
        columns = np.stack([(self.negative(mode + _DIFFERENCE * unit)[1] - gradient) / _DIFFERENCE
                            for unit in np.eye(len(mode))])
        hessian = 0.5 * (columns + columns.T)
        if not np.isfinite(hessian).all():
            raise ValueError(f"positions have no finite curvature at the magnitudes {np.exp(mode)}.")
        # In units of the prior the curvature is at least one: positions may say nothing, but never less than that.
        values, vectors = np.linalg.eigh(hessian * np.outer(sd, sd))
        root = sd[:, None] * vectors / np.sqrt(np.maximum(values, 1.0))
        return mode + np.random.default_rng(0).normal(size=(count, len(mode))) @ root.T


def held_out(data: Training, prior: Prior) -> Target:
    """Return how well held-out positions are predicted, as a target."""
    return _target(slope_of_held_out, WEIGHT, data, prior)


def likelihood(data: Training, prior: Prior) -> Target:
    """Return the log marginal likelihood of all positions of training, as a target."""
    return _target(slope_of_log_likelihood, 1.0, data, prior)


def _target(value_and_slope: Callable, weight: float, data: Training, prior: Prior) -> Target:
    regression = data.regression

    def evidence(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = value_and_slope(jnp.asarray(logarithms), regression, data.axes)
        return weight * float(value), weight * np.asarray(slope)

    return Target(evidence, prior)


def smoothed_forces(data: Training, prior: Prior) -> Target:
    """Return the log likelihood where forces that a Matern model smooths are the data, as in the source: a target."""
    thin = max(1, int(round(_APART / (data.times[1] - data.times[0]))))
    mean, sd = _smooth_forces(data.neighbourhood, jnp.asarray(data.y), (tuple(data.times), data.axes))
    fixed = tuple(data.times[::thin]), data.axes

    def evidence(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = _score_forces(
            jnp.asarray(logarithms), mean[::thin], sd[::thin], data.neighbourhood.period, fixed
        )
        return float(value), np.asarray(gradient)

    return Target(evidence, prior)


@functools.partial(jax.jit, static_argnums=(2,))
def _smooth_forces(neighbourhood: Neighbourhood, y: jax.Array, fixed: tuple) -> tuple[jax.Array, jax.Array]:
    times, axes = np.array(fixed[0]), fixed[1]
    forces = {name: Matern(_SCALE, _LENGTHSCALE, mean=SOLAR_PRESSURE if name == "solar" else 0.0)
              for name in small_forces(axes)}
    smoothed = smooth(departure(neighbourhood, forces, noise_sd=NOISE), times, y, rule=Taylor(), steps=steps_of(times))
    return smoothed.input_mean[:, 6:], jnp.sqrt(jnp.diagonal(smoothed.input_covariance, axis1=1, axis2=2)[:, 6:])


@functools.partial(jax.jit, static_argnums=(4,))
@jax.value_and_grad
def _score_forces(logarithms: jax.Array, mean: jax.Array, sd: jax.Array, period: Any, fixed: tuple) -> jax.Array:
    times, axes = np.array(fixed[0]), fixed[1]
    forces, white = magnitudes.forces(logarithms, axes, period)
    # A value stands for some time, over which white noise averages.
    covariance = jax.vmap(jnp.diag)(sd**2 + white**2 / _APART)
    system = LatentForceModel(
        lambda x, u, t: jnp.zeros(1), forces, GaussianObservation(lambda x, u, t: u, covariance=covariance),
        Gaussian(jnp.zeros(1), jnp.zeros((1, 1))))
    return filter(system, times, mean, steps=1).log_likelihood.sum()
