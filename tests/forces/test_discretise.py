"""The generic discretisation against exact solutions and high-precision arithmetic."""

from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from numpy.testing import assert_allclose, assert_array_equal

from lfm_ppl.forces.discretise import discretise, discretise_dispersion

step = jax.jit(discretise, static_argnums=3)


def chain(n):
    """n integrators in a row, driven by one Brownian motion: nilpotent."""
    return np.diag(np.ones(n - 1), 1), np.eye(n)[:, -1:]


@pytest.mark.parametrize("n", [1, 2, 3, 5, 8])
@pytest.mark.parametrize("dt", [1e-8, 0.3, 1.0, 1e6])
def test_chain_of_integrators(n, dt):
    feedback, column = chain(n)
    transition, noise = step(feedback, column @ column.T, dt)
    back = np.arange(n)[::-1]
    weight = np.array([factorial(k) for k in back])
    power = back[:, None] + back + 1
    expected = dt ** power.astype(float) / power / np.outer(weight, weight)
    assert_allclose(noise, expected, rtol=1e-13)
    order = np.arange(n)[None, :] - np.arange(n)[:, None]
    entries = [[dt**k / factorial(k) if k >= 0 else 0.0 for k in row] for row in order.tolist()]
    assert_allclose(transition, entries, rtol=1e-13)


SYSTEMS = {
    "repeated root": np.array([[-2.0, 1.0, 0.0], [0.0, -2.0, 1.0], [0.0, 0.0, -2.0]]),
    "undamped": np.array([[0.0, 1.0], [-9.0, 0.0]]),
    "unstable": np.array([[0.5, 1.0], [0.2, 0.3]]),
    "zero": np.zeros((2, 2)),
    "units apart": np.array([[0.0, 1e6], [-1e-6, -0.5]]),
    "physical state and force": np.array([[-0.4, 0.7, 0.0], [0.0, 0.0, 1.7], [0.0, -1.7, -3.4]]),
}


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("dt", [1e-6, 0.1, 1.0, 4.0])
def test_equals_the_taylor_series_in_high_precision(name, dt, exact_step):
    feedback = SYSTEMS[name]
    column = np.linspace(1.0, 0.0, len(feedback))[::-1, None]
    expected_transition, expected = exact_step(feedback, column, dt)
    sd = np.sqrt(np.diag(expected))
    unit = np.outer(sd, sd) if sd.all() else 1.0
    for transition, noise in (
        step(feedback, column @ column.T, dt),
        discretise_dispersion(feedback, column, dt),
    ):
        assert_allclose(transition, expected_transition, rtol=1e-12, atol=1e-14)
        assert_allclose(noise / unit, expected / unit, atol=3e-14)


def test_more_states_than_are_unrolled(exact_step):
    rng = np.random.default_rng(0)
    feedback = rng.normal(size=(10, 10)) - 3.0 * np.eye(10)
    column = rng.normal(size=(10, 3))
    transition, noise = step(feedback, column @ column.T, 0.7)
    expected_transition, expected = exact_step(feedback, column, 0.7)
    assert_allclose(transition, expected_transition, rtol=1e-12, atol=1e-13)
    assert_allclose(noise, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("size", [1e2, 1e5, 1e8])
def test_stable_systems_forget_without_overflow(size):
    feedback = np.array([[-1.0, 3.0], [0.0, -1.5]])
    diffusion = np.array([[2.0, 0.3], [0.3, 1.0]])
    transition, noise = step(feedback, diffusion, size)
    assert_allclose(transition, 0.0, atol=1e-30)
    assert_allclose(feedback @ noise + noise @ feedback.T, -diffusion, atol=1e-13)


def test_slow_and_fast_modes_together():
    transition, noise = step(np.diag([-1e8, -1e-3]), np.eye(2), 1.0)
    assert_allclose(transition, np.diag([0.0, np.exp(-1e-3)]), atol=1e-7)
    assert_allclose(noise, np.diag([0.5e-8, -np.expm1(-2e-3) / 2e-3]), rtol=1e-7)


def test_no_time():
    transition, noise = step(SYSTEMS["repeated root"], np.eye(3), 0.0)
    assert_array_equal(transition, np.eye(3))
    assert_array_equal(noise, np.zeros((3, 3)))


def test_too_long_a_step_is_nan_and_not_a_wrong_number():
    transition, noise = step(-np.eye(2), np.eye(2), 1e3, 5)
    assert np.isnan(transition).all() and np.isnan(noise).all()


def test_no_states():
    transition, noise = discretise(np.zeros((0, 0)), np.zeros((0, 0)), 1.0)
    assert transition.shape == noise.shape == (0, 0)


@pytest.mark.parametrize("name", ["repeated root", "undamped", "unstable", "zero"])
def test_gradients(name):
    column = jnp.ones((len(SYSTEMS[name]), 1))

    @jax.jit
    def flow(feedback, column, dt):
        return jnp.stack(discretise(feedback, column @ column.T, dt, 8))

    for dt in (0.0, 1e-9, 0.3, 3.0):
        arguments = (jnp.asarray(SYSTEMS[name]), column, dt)
        check_grads(flow, arguments, order=1, modes=("fwd", "rev"), eps=1e-5, rtol=1e-6, atol=1e-7)


def test_gradient_of_a_long_stable_step_is_finite():
    def total(rate, dt):
        feedback = rate * jnp.array([[0.0, 1.0], [-1.0, -2.0]])
        transition, noise = discretise(feedback, jnp.diag(jnp.array([0.0, 1.0])), dt)
        return transition.sum() + noise.sum()

    for mode in (jax.jacfwd, jax.jacrev):
        assert np.isfinite(jax.jit(mode(total, (0, 1)))(1.0, 1e8)).all()


def test_vmap_equals_loop():
    dts = jnp.array([0.0, 0.1, 30.0])
    rates = jnp.array([1.0, 20.0, 0.1])

    def one(rate, dt):
        return discretise(rate * SYSTEMS["repeated root"], jnp.eye(3), dt)

    batch = jax.jit(jax.vmap(one))(rates, dts)
    for i in range(3):
        for got, expected in zip(batch, one(rates[i], dts[i]), strict=True):
            assert_allclose(got[i], expected, rtol=1e-13, atol=1e-15)


def test_single_precision_stays_single():
    results = discretise(jnp.float32([[-1.0]]), jnp.float32([[2.0]]), jnp.float32(0.3))
    assert all(result.dtype == jnp.float32 for result in results)
