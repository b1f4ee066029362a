"""Results do not depend on the units in which states, forces, time and observations are written."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm

TIMES = np.arange(1, 13) * 1.5


class Units(NamedTuple):
    """What one metre of altitude, one m/s of speed, one second and one metre of distance are in other units."""

    altitude: float = 1.0
    speed: float = 1.0
    time: float = 1.0
    distance: float = 1.0

    @property
    def state(self):
        return jnp.stack([jnp.asarray(self.altitude), jnp.asarray(self.speed)])

    @property
    def force(self):
        """Of an acceleration: speed by time, so that it adds to the derivative of the speed."""
        return self.speed / self.time


METRIC = Units()
OTHERS = {"km and hours": Units(1e-3, 3.6, 1 / 3600, 1e-3), "states ten orders apart": Units(1e-7, 1e3),
          "states ten orders apart, the other way": Units(1e5, 1e-5), "ages": Units(time=1e-9),
          "tiny distances": Units(distance=1e-8), "huge numbers": Units(1e9, 1e12, 1e6, 1e10)}


class Fall(eqx.Module):
    """A target that falls through air, as in the reentry problem."""

    units: Any

    def __call__(self, x, u, t):
        altitude, speed = x[0] / self.units.altitude, x[1] / self.units.speed
        derivative = jnp.stack([-speed, -4.49e-4 * jnp.exp(-1.49e-4 * altitude) * speed**2 + 9.8])
        pushed = jnp.stack([jnp.zeros(()), u[0]])
        return derivative * self.units.state / self.units.time + pushed


class Distance(eqx.Module):
    """From a radar aside."""

    units: Any

    def __call__(self, x, u, t):
        return self.units.distance * jnp.sqrt(30e3**2 + (30.0 - x[:1] / self.units.altitude) ** 2)


def target(units, is_known=False):
    """The target, in any units."""
    units = Units(*map(jnp.asarray, units))  # arrays: other units compile nothing new
    scale = units.state
    spread = np.zeros(2) if is_known else np.array([500.0, 100.0])
    return lfm.LatentForceModel(
        Fall(units), {"u": lfm.Matern(50.0 * units.force, 5.0 * units.time, order=2)},
        lfm.GaussianObservation(Distance(units), jnp.array([(30.0 * units.distance) ** 2])),
        lfm.Gaussian(jnp.array([65e3, 3e3]) * scale, jnp.diag((spread * scale) ** 2)),
        process_noise=jnp.diag(jnp.array([50.0, 10.0]) * scale / jnp.sqrt(units.time)), initial_time=0.0)


@functools.cache
def observations():
    """Distances in metres, one of them missing."""
    simulated = lfm.simulate(jax.random.key(0), target(METRIC, is_known=True), np.append(0.0, TIMES), steps=5)
    result = np.array(simulated.y)[1:]
    result[7] = np.nan
    return result


@functools.cache
def smoothed(units, is_known, iterations):
    """Means, covariances, leave-one-out and one-step-ahead densities in metres and seconds."""
    y, grid = observations(), np.linspace(0.0, 21.0, 30)
    result = lfm.smooth(target(units, is_known), TIMES * units.time, y * units.distance, steps=4, at=grid * units.time,
                       iterations=iterations)
    scale = np.append(units.state, units.force)
    unit = np.isfinite(y[:, 0]) * np.log(units.distance)
    return (np.asarray(result.input_mean) / scale, np.asarray(result.input_covariance) / np.outer(scale, scale),
            np.asarray(result.leave_one_out) + unit, np.asarray(result.log_likelihood) + unit)


@pytest.mark.thorough
@pytest.mark.parametrize(("units", "is_known", "iterations"), [
    *((units, True, 0) for units in OTHERS.values()),
    *(pytest.param(OTHERS[name], False, 2, marks=pytest.mark.slow) for name in ("ages", "huge numbers"))],
    ids=[*OTHERS, "ages, iterated", "huge numbers, iterated"])
def test_smoothed_moments_are_those_in_other_units(is_known, iterations, units):
    mean, covariance, *densities = smoothed(METRIC, is_known, iterations)
    other_mean, other_covariance, *other_densities = smoothed(units, is_known, iterations)
    sd = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    unit = np.where(sd > 0, sd, 1.0)
    assert np.max(np.abs(other_mean - mean) / unit) < 1e-8
    assert np.max(np.abs(other_covariance - covariance) / (unit[:, :, None] * unit[:, None, :])) < 1e-8
    np.testing.assert_allclose(other_densities, densities, atol=1e-8)


@jax.jit
def slope(factor, units):
    """Derivative of the log likelihood in a factor of the force's scale."""
    def total(factor):
        model = eqx.tree_at(lambda m: m.forces["u"].scale, target(units), 50.0 * units.force * factor)
        likelihood = lfm.MarginalLikelihood(model, TIMES * units.time, steps=4)
        return likelihood.log_prob(observations() * units.distance)

    return jax.grad(total)(factor)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["states ten orders apart", "huge numbers"])
def test_the_gradient_in_a_parameter_is_the_same(name):
    expected = slope(1.3, METRIC)
    assert abs(slope(1.3, OTHERS[name]) - expected) < 1e-7 * (1 + abs(expected))
