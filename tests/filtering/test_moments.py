"""Predicted moments of non-linear systems against the rules' own moment equations, by DOP853."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from references import (
    Points,
    central_difference,
    cubature,
    gauss_hermite,
    moments,
    unscented,
)
from systems import double_well, padded, whole_state

import lfm_ppl as lfm

# Name -> (rule, the same rule's points in n dimensions, None for the Taylor expansion).
RULES: dict[str, Any] = {
    "Taylor": (lfm.Taylor(), None),
    "Cubature": (lfm.Cubature(), cubature),
    "Unscented": (lfm.Unscented(), lambda n: unscented(n, 1.0, 2.0)),
    "Unscented(0.5, 2, 1)": (lfm.Unscented(0.5, 2.0, 1.0), lambda n: unscented(n, 0.5, 1.0)),
    "GaussHermite(3)": (lfm.GaussHermite(3), lambda n: gauss_hermite(n, 3)),
    "GaussHermite(7)": (lfm.GaussHermite(7), lambda n: gauss_hermite(n, 7)),
    "CentralDifference": (lfm.CentralDifference(), lambda n: central_difference(n, np.sqrt(3.0))),
    "CentralDifference(1.5)": (lfm.CentralDifference(1.5), lambda n: central_difference(n, 1.5)),
    # The points of this rule are random: only their use is tested here, their moments in tests/linearisation.
    "MonteCarlo": (lfm.MonteCarlo(40, seed=3), lambda n: Points(*lfm.MonteCarlo(40, seed=3).points(n)[:2])),
}
ROWS, END = 100, 1.0
OBSERVATION = np.r_[np.full(ROWS - 1, np.nan), 0.8][:, None]


def predicted(model, rule, count):
    result = lfm.filter(model, padded(count, END, ROWS), OBSERVATION, rule=rule, steps=1)
    return np.append(result.predicted_mean[-1], result.predicted_covariance[-1].ravel())


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "variance"), [
    *((name, variance) for name in ("Taylor", "GaussHermite(3)") for variance in (0.2, 0.0)),
    *(pytest.param(name, 0.2, marks=pytest.mark.slow) for name in RULES if name not in ("Taylor", "GaussHermite(3)"))])
def test_double_well(name, variance):
    rule, make = RULES[name]
    model = double_well(variance=variance)

    def drift(x, t):
        return x - x**3

    mean, covariance = moments(drift, lambda x, t: np.array([[0.49]]), make and make(1), [0.5], [[variance]],
                               (0.0, END), lambda x, t: np.array([1 - 3 * x**2]).reshape(1, 1),
                               average_jacobian=name == "MonteCarlo")
    expected = np.append(mean, covariance)
    error = {n: np.abs(predicted(model, rule, n) - expected).max() for n in (10, 20, 40, 100)}
    assert error[100] < 1e-6
    orders = np.log2([error[10] / error[20], error[20] / error[40]])
    assert 3.7 < orders.min() and orders.max() < 4.5, orders


class Pushed(eqx.Module):
    """A pendulum with a force whose effect depends on the angle; the state's noise depends on the state."""

    strength: Any = 1.0

    def __call__(self, x, u, t):
        return jnp.stack([x[1], -2.0 * jnp.sin(x[0]) - 0.4 * x[1] * x[0] ** 2
                          + self.strength * jnp.cos(x[0]) * u[0] + 0.1 * jnp.cos(t)])


def state_dependent(x, u, t):
    return jnp.stack([jnp.stack([0.1 + 0.0 * x[0], 0.0 * x[0]]), jnp.stack([0.0 * x[0], 0.3 * x[0] + 0.1 * u[0]])])


LAM = np.sqrt(3.0) / 0.9


def joint_drift(s, t):
    return np.array([s[1], -2.0 * np.sin(s[0]) - 0.4 * s[1] * s[0] ** 2 + np.cos(s[0]) * s[2] + 0.1 * np.cos(t),
                     LAM * s[3], -LAM * s[2] - 2 * LAM * s[3]])


def joint_jacobian(s, t):
    return np.array([[0, 1, 0, 0],
                     [-2.0 * np.cos(s[0]) - 0.8 * s[1] * s[0] - np.sin(s[0]) * s[2], -0.4 * s[0] ** 2, np.cos(s[0]), 0],
                     [0, 0, 0, LAM], [0, 0, -LAM, -2 * LAM]])


def joint_diffusion(s, t):
    return np.diag([0.01, (0.3 * s[0] + 0.1 * s[2]) ** 2, 0.0, 4.0 * 0.8**2 * LAM])


@pytest.mark.slow
@pytest.mark.parametrize("name, rule, points", [
    ("Taylor", lfm.Taylor(), None), ("Cubature", lfm.Cubature(full_state=True), cubature(4))])
def test_pendulum_with_force_and_state_dependent_noise(name, rule, points):
    model = lfm.LatentForceModel(
        Pushed(), {"u": lfm.Matern(0.8, 0.9, 1)}, lfm.GaussianObservation(whole_state, 0.1 * jnp.ones(2)),
        lfm.Gaussian(jnp.array([0.6, -0.2]), 0.05 * jnp.eye(2)), process_noise=state_dependent, initial_time=0.0)
    y = np.repeat(OBSERVATION, 2, axis=1)
    start = np.diag([0.05, 0.05, 0.64, 0.64])
    mean, covariance = moments(joint_drift, joint_diffusion, points, [0.6, -0.2, 0.0, 0.0], start, (0.0, END),
                               joint_jacobian)
    errors = []
    for count in (20, 40, 100):
        result = lfm.filter(model, padded(count, END, ROWS), y, rule=rule, steps=1)
        errors.append(max(np.abs(result.predicted_mean[-1] - mean).max(),
                          np.abs(result.predicted_covariance[-1] - covariance).max()))
    assert errors[2] < 1e-6
    assert 3.7 < np.log2(errors[0] / errors[1]) < 4.5, errors


class Entangled(eqx.Module):
    """State and force inside one non-linear function: the points lie in both."""

    rate: Any = 1.0

    def __call__(self, x, u, t):
        return -self.rate * x + 2.0 * jnp.sin(x + 2.0 * u)


class TimeVarying(eqx.Module):
    """Linear with coefficients that depend on time: no input is non-linear, nothing is constant."""

    rate: Any = 1.0

    def __call__(self, x, u, t):
        return -self.rate * (1.0 + 0.5 * jnp.sin(3.0 * t)) * x + jnp.cos(2.0 * t) * u


@pytest.mark.slow
@pytest.mark.parametrize("rule", [lfm.Taylor(), lfm.Cubature(full_state=True)], ids=lambda rule: rule.name)
def test_linear_with_coefficients_that_depend_on_time(rule):
    lam = 1.0 / 0.7

    def matrix(t):
        return np.array([[-(1.0 + 0.5 * np.sin(3 * t)), np.cos(2 * t)], [0.0, -lam]])

    mean, covariance = moments(lambda s, t: matrix(t) @ s, lambda s, t: np.diag([0.0, 2 * lam]), None, [1.0, 0.0],
                               np.diag([0.0, 1.0]), (0.0, END), lambda s, t: matrix(t))
    model = lfm.LatentForceModel(
        TimeVarying(), {"u": lfm.Matern(1.0, 0.7, 0)}, lfm.GaussianObservation(whole_state, jnp.array([0.1])),
        lfm.Gaussian(jnp.ones(1), jnp.zeros((1, 1))), initial_time=0.0)
    errors = []
    for count in (10, 20, 100):
        result = lfm.filter(model, padded(count, END, ROWS), OBSERVATION, rule=rule, steps=1)
        errors.append(max(np.abs(result.predicted_mean[-1] - mean).max(),
                          np.abs(result.predicted_covariance[-1] - covariance).max()))
    assert errors[2] < 1e-8
    assert 3.7 < np.log2(errors[0] / errors[1]) < 4.7, errors


@pytest.mark.slow
def test_random_points_with_a_known_state():
    """A regression on random points would divide their sampling error by a standard deviation of zero."""
    model = lfm.LatentForceModel(
        Entangled(), {"u": lfm.Matern(1.0, 1.0, 1)}, lfm.GaussianObservation(whole_state, jnp.array([0.01])),
        lfm.Gaussian(jnp.array([0.3]), jnp.zeros((1, 1))), process_noise=jnp.array([[0.3]]), initial_time=0.0)
    exact, random = (lfm.filter(model, [0.5], [[0.5]], rule=rule).predicted_covariance[0, 0, 0]
                     for rule in (lfm.GaussHermite(9), lfm.MonteCarlo(1000)))
    # The average over 500 pairs of a Jacobian of size 2 is off by some 2 / sqrt(500) at a time.
    assert abs(random / exact - 1) < 0.3


@pytest.mark.slow
def test_steps_are_rows():
    """The same steps inside one row, where the smoother asks for the flow too."""
    model = double_well()
    many = predicted(model, lfm.Cubature(), 10)
    result = lfm.filter(model, [END], [[0.8]], steps=10)
    single_row = np.append(result.predicted_mean, result.predicted_covariance)
    assert np.abs(many - single_row).max() < 1e-13
