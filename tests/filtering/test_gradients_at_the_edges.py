"""Gradients of the log likelihood where covariances are singular, data scarce and roots repeated."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import DoubleWell, Motif, Oscillator, first_state, identity, softplus

import lfm_ppl as lfm

TIMES = np.array([0.3, 1.0, 1.6, 2.5])
Y = np.array([0.45, 0.6, 0.5, 0.8])[:, None]


def single(link):
    def build(theta):
        """theta: decay, lengthscale, noise sd, initial variance, scale."""
        return lfm.LatentForceModel(
            Motif(theta[0], 1.0, 0.3, link), {"u": lfm.Matern(theta[4], theta[1], 1)},
            lfm.GaussianObservation(first_state, theta[2] ** 2 * jnp.ones(1)),
            lfm.Gaussian(jnp.array([0.4]), theta[3] * jnp.eye(1)), initial_time=0.0)

    return build


def oscillator(theta):
    return lfm.LatentForceModel(
        Oscillator(theta[0], theta[1], theta[2]), {"u": lfm.Matern(1.0, theta[3], 1)},
        lfm.GaussianObservation(first_state, theta[4] ** 2 * jnp.ones(1)),
        lfm.Gaussian(jnp.array([0.4, 0.0]), theta[5] * jnp.eye(2)), initial_time=0.0)


def well(theta):
    """theta: linear and cubic coefficient of the drift, initial variance."""
    return lfm.LatentForceModel(
        DoubleWell(theta[0], theta[1]), {}, lfm.GaussianObservation(first_state, 0.01 * jnp.ones(1)),
        lfm.Gaussian(jnp.array([0.4]), theta[2] * jnp.eye(1)), process_noise=jnp.eye(1), initial_time=0.0)


BUILDERS = {"linear": single(identity), "softplus": single(softplus), "oscillator": oscillator, "well": well}


@pytest.fixture(scope="module")
def compiled():
    """Value, reverse-mode and forward-mode gradient as functions of (theta, y); compiled once a builder."""

    @functools.cache
    def get(name):
        def value(theta, y):
            return lfm.MarginalLikelihood(BUILDERS[name](theta), TIMES, lfm.GaussHermite(3), steps=4,
                                          iterations=None if name == "oscillator" else 0).log_prob(y)

        return jax.jit(value), jax.jit(lambda theta, y: (jax.grad(value)(theta, y), jax.jacfwd(value)(theta, y)))

    return get


RATE = np.sqrt(3.0) / 1.3
ONE = np.where(np.arange(4)[:, None] == 3, Y, np.nan)
EDGES = {
    "ordinary": ([0.8, 1.3, 0.1, 0.2, 1.0], Y),
    "known initial state": ([0.8, 1.3, 0.1, 0.0, 1.0], Y),
    "noise sd 1e-8": ([0.8, 1.3, 1e-8, 0.0, 1.0], Y),
    "a thousand lengthscales between rows": ([0.8, 6e-4, 0.1, 0.0, 30.0], Y),
    "all but one missing": ([0.8, 1.3, 0.1, 0.0, 1.0], ONE),
    "decay equal to the force's rate": ([RATE, 1.3, 0.1, 0.0, 1.0], Y),
    "no decay": ([0.0, 1.3, 0.1, 0.0, 1.0], Y),
}
OSCILLATORS = {
    "critical damping": ([1.0, 2.0, 0.0, 1.3, 0.1, 0.0], Y),
    "critical damping at the force's rate": ([RATE**2, 2 * RATE, 0.0, 1.3, 0.1, 0.0], Y),
    "no damping": ([2.0, 0.0, 0.0, 1.3, 0.1, 0.0], Y),
    "cubic, known state, tiny noise": ([1.0, 0.5, 0.7, 1.3, 1e-8, 0.0], Y),
    "free mass": ([0.0, 0.0, 0.0, 1.3, 0.1, 0.1], Y),
}
ALL = [*(("softplus", edge) for edge in EDGES), *(
    pytest.param(name, edge, marks=pytest.mark.slow) for name, edges in (("linear", EDGES), ("oscillator", OSCILLATORS))
    for edge in list(edges)[::3])]


@pytest.mark.thorough
@pytest.mark.parametrize("name, edge", ALL)
def test_gradient_equals_central_differences(compiled, name, edge):
    theta, y = (EDGES | OSCILLATORS)[edge]
    theta, y = np.array(theta), jnp.asarray(y)
    value, gradient = compiled(name)
    reverse, forward = (np.asarray(g) for g in gradient(jnp.asarray(theta), y))
    assert np.isfinite(value(theta, y)) and np.isfinite(reverse).all() and np.isfinite(forward).all()
    assert np.allclose(reverse, forward, rtol=1e-6, atol=1e-8 * np.abs(reverse).max())
    for index, direction in enumerate(np.eye(len(theta))):
        if name != "oscillator" and index == 3 and theta[3] == 0 or name == "oscillator" and index == 5:
            continue  # a variance of zero has no left neighbour
        # Relative steps, Richardson's extrapolation from two of them, and the rounding of the values.
        h = 1e-3 * (abs(theta[index]) if abs(theta[index]) > 1e-10 else 1.0)

        def value_at(k):
            return float(value(jnp.asarray(theta + k * h * direction), y))  # noqa: B023

        narrow, wide = (value_at(0.5) - value_at(-0.5)) / h, (value_at(1) - value_at(-1)) / (2 * h)
        difference = (4 * narrow - wide) / 3
        rounding = 1e-12 * max(1.0, abs(value_at(0))) / h
        assert abs(reverse[index] - difference) <= 1e-5 * abs(difference) + rounding, (
            index, reverse[index], difference)


@pytest.mark.thorough
@pytest.mark.parametrize("name, theta, regular", [
    ("well", [1.0, -1e6, 0.5], [1.0, 0.7, 0.5]),
    pytest.param("oscillator", [1.0, 0.5, -1e6, 1.3, 0.1, 0.5], [1.0, 0.5, 0.7, 1.3, 0.1, 0.5], marks=pytest.mark.slow),
])
def test_blow_up_is_minus_infinity_with_zero_gradient(compiled, name, theta, regular):
    """A negative cubic stiffness sends the state to infinity in finite time; its neighbour in a batch is untouched."""
    value, _ = compiled(name)
    values, gradients = jax.jit(jax.vmap(jax.value_and_grad(lambda p: value(p, jnp.asarray(Y)))))(
        jnp.array([theta, regular]))
    assert np.isneginf(values[0]) and np.isfinite(values[1])
    assert not gradients[0].any() and np.isfinite(gradients[1]).all() and gradients[1].any()


@pytest.mark.slow
def test_hessian_is_finite_and_symmetric(compiled):
    value, gradient = compiled("linear")
    theta = jnp.array([0.8, 1.3, 0.1, 0.0, 1.0])
    hessian = jax.jacfwd(lambda p: gradient(p, jnp.asarray(Y))[0])(theta)
    assert np.isfinite(hessian).all() and np.allclose(hessian, hessian.T, rtol=1e-7, atol=1e-7)
