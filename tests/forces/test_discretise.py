"""The generic discretisation against exact solutions and high-precision arithmetic."""

from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from jax.test_util import check_grads
from numpy.testing import assert_allclose, assert_array_equal

from lfm_ppl.forces.discretise import discretise, discretise_dispersion, discretise_steps
from lfm_ppl.forces.phi_functions import phi_functions, scalar_phi_functions

step = jax.jit(discretise, static_argnums=3)
DTS = np.array([1e-6, 0.1, 1.0, 4.0])
SYSTEMS = {
    "repeated root": np.array([[-2.0, 1.0, 0.0], [0.0, -2.0, 1.0], [0.0, 0.0, -2.0]]),
    "undamped": np.array([[0.0, 1.0], [-9.0, 0.0]]),
    "unstable": np.array([[0.5, 1.0], [0.2, 0.3]]),
    "zero": np.zeros((2, 2)),
    "units apart": np.array([[0.0, 1e6], [-1e-6, -0.5]]),
    "physical state and force": np.array([[-0.4, 0.7, 0.0], [0.0, 0.0, 1.7], [0.0, -1.7, -3.4]]),
}


@pytest.mark.parametrize("n", [1, 3, 8])
def test_chain_of_integrators(n):
    """Nilpotent; the last of n integrators in a row is driven by Brownian motion."""
    feedback, column = np.diag(np.ones(n - 1), 1), np.eye(n)[:, -1:]
    exponents, order = np.arange(n)[::-1], np.arange(n)[None, :] - np.arange(n)[:, None]
    weight = np.array([factorial(k) for k in exponents])
    power = exponents[:, None] + exponents + 1
    for dt in (1e-8, 0.3, 1.0, 1e6):
        transition, noise = step(feedback, column @ column.T, dt)
        assert_allclose(noise, dt ** power.astype(float) / power / np.outer(weight, weight), rtol=1e-13)
        entries = [[dt**k / factorial(k) if k >= 0 else 0.0 for k in row] for row in order.tolist()]
        assert_allclose(transition, entries, rtol=1e-13)


@jax.jit
def discretise_both(feedback, column):
    return jax.vmap(lambda dt: (discretise(feedback, column @ column.T, dt),
                                discretise_dispersion(feedback, column, dt)))(DTS)


@pytest.mark.parametrize("name", SYSTEMS)
def test_equals_the_taylor_series_in_high_precision(name, exact_step):
    feedback = SYSTEMS[name]
    column = np.linspace(1.0, 0.0, len(feedback))[::-1, None]
    for transitions, noises in discretise_both(feedback, column):
        for dt, transition, noise in zip(DTS, transitions, noises, strict=True):
            expected_transition, expected = exact_step(feedback, column, dt)
            sd = np.sqrt(np.diag(expected))
            unit = np.outer(sd, sd) if sd.all() else 1.0
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


def test_stable_systems_forget_without_overflow():
    feedback, diffusion = np.array([[-1.0, 3.0], [0.0, -1.5]]), np.array([[2.0, 0.3], [0.3, 1.0]])
    for dt in (1e2, 1e5, 1e8):
        transition, noise = step(feedback, diffusion, dt)
        assert_allclose(transition, 0.0, atol=1e-30)
        assert_allclose(feedback @ noise + noise @ feedback.T, -diffusion, atol=1e-13)
    transition, noise = step(np.diag([-1e8, -1e-3]), np.eye(2), 1.0)  # slow and fast modes together
    assert_allclose(transition, np.diag([0.0, np.exp(-1e-3)]), atol=1e-7)
    assert_allclose(noise, np.diag([0.5e-8, -np.expm1(-2e-3) / 2e-3]), rtol=1e-7)


def test_edges():
    """No time, no states, single precision; too long a step is NaN and not a wrong number."""
    transition, noise = step(SYSTEMS["repeated root"], np.eye(3), 0.0)
    assert_array_equal(transition, np.eye(3))
    assert_array_equal(noise, np.zeros((3, 3)))
    assert [result.shape for result in discretise(np.zeros((0, 0)), np.zeros((0, 0)), 1.0)] == [(0, 0), (0, 0)]
    single = step(jnp.float32([[-1.0]]), jnp.float32([[2.0]]), jnp.float32(0.3))
    assert all(result.dtype == jnp.float32 for result in single)
    assert np.isnan(step(-np.eye(2), np.eye(2), 1e3, 5)).all()


@pytest.mark.parametrize("name", ["repeated root", "undamped"])
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
    dts, rates = np.array([0.0, 0.1, 30.0]), np.array([1.0, 20.0, 0.1])
    feedback = rates[:, None, None] * SYSTEMS["repeated root"]
    batch = jax.jit(jax.vmap(discretise, (0, None, 0)))(feedback, np.eye(3), dts)
    for i in range(3):
        for result, expected in zip(batch, step(feedback[i], np.eye(3), dts[i]), strict=True):
            assert_allclose(result[i], expected, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("name", [*SYSTEMS, "nine states"])
def test_many_steps_equal_single_steps(name):
    feedback = -np.eye(9) if name == "nine states" else SYSTEMS[name]
    diffusion = np.diag(np.arange(1.0, 1.0 + len(feedback)))
    dts = np.append(DTS, 0.0)
    many = jax.jit(discretise_steps)(feedback, diffusion, dts)
    single = jax.jit(jax.vmap(discretise, (None, None, 0)))(feedback, diffusion, dts)
    for result, expected in zip(many, single, strict=True):
        assert_allclose(result, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("name", ["undamped", "units apart", "nine states"])
def test_steps_without_noise_have_the_same_transitions(name):
    feedback = -np.eye(9) if name == "nine states" else SYSTEMS[name]
    transition, noise = jax.jit(lambda feedback: discretise_steps(feedback, None, jnp.asarray(DTS)))(feedback)
    expected, _ = jax.jit(discretise_steps)(feedback, np.eye(len(feedback)), DTS)
    assert_allclose(transition, expected, rtol=1e-14)
    assert_array_equal(noise, np.zeros_like(transition))


def test_gradients_of_many_steps():
    def flow(feedback, diffusion, dts):
        return jnp.stack(discretise_steps(feedback, diffusion @ diffusion.T, dts, 8))

    arguments = (jnp.asarray(SYSTEMS["repeated root"]), jnp.eye(3), jnp.array([0.0, 1e-9, 0.3, 3.0]))
    check_grads(jax.jit(flow), arguments, order=1, modes=("fwd", "rev"), eps=1e-5, rtol=1e-6, atol=1e-7)


def test_steps_of_any_length():
    """Rates times steps far above 2^32, alone, among many lengths, and with the derivatives."""
    feedback, diffusion = jnp.array([[-1.0, 3.0], [0.0, -1.5]]), jnp.diag(jnp.array([2.0, 1.0]))
    lengths = jnp.array([0.5, 1e8, 1e12, 1e30])

    @jax.jit
    def results(rate):
        return [*jax.vmap(lambda dt: discretise(rate * feedback, rate * diffusion, dt))(lengths),
                *discretise_steps(rate * feedback, rate * diffusion, lengths)]

    phi, noise, phi_steps, noise_steps = results(1.0)
    assert_allclose(phi_steps, phi, atol=1e-14)
    assert_allclose(noise_steps, noise, rtol=1e-13)
    assert_allclose(phi[1:], 0.0, atol=1e-30)
    balance = feedback @ noise[1:] + noise[1:] @ feedback.T
    assert_allclose(balance, np.tile(-diffusion, (3, 1, 1)), atol=1e-12)
    for differentiate in (jax.jacfwd, jax.jacrev):
        derivatives = jax.jit(differentiate(results))(1.0)
        assert all(np.isfinite(derivative).all() for derivative in derivatives)
        assert_allclose(derivatives[1][1:], 0.0, atol=1e-9)  # rate and noise grow together


@pytest.mark.parametrize("name", SYSTEMS)
def test_phi_functions_equal_the_augmented_exponential(name):
    size = len(SYSTEMS[name])
    for scale in (1e-6, 0.3, 4.0):
        matrix = scale * SYSTEMS[name]
        augmented = np.kron(np.diag(np.ones(3), 1), np.eye(size))
        augmented[:size, :size] = matrix
        expected = scipy.linalg.expm(augmented)[:size].reshape(size, 4, size).swapaxes(0, 1)
        unit = np.abs(expected).max(axis=(1, 2), keepdims=True)
        assert_allclose(phi(matrix) / unit, expected / unit, atol=2e-13)


phi = jax.jit(phi_functions)


@pytest.mark.thorough
def test_phi_functions_of_fast_decays():
    """They tend to 1/z, 1/z and 1/(2 z); the derivatives equal differences."""
    rates = np.array([1e4, 1e9, 1e15, 1e30])
    values = jax.jit(jax.vmap(phi_functions))(-rates[:, None, None])[:, :, 0, 0]
    expected = np.stack([0 * rates, 1 / rates, (1 - 1 / rates) / rates, (0.5 - (1 - 1 / rates) / rates) / rates], 1)
    assert_allclose(values, expected, rtol=1e-12)
    numbers = jnp.array([-1e30, -50.0, -1.01, -0.99, -1e-3, 0.0, 1e-9, 0.9, 1.1, 20.0])
    of_number = jax.vmap(lambda z: (scalar_phi_functions(z), jax.jacfwd(scalar_phi_functions)(z)))
    values, slopes = jax.jit(of_number)(numbers)
    matrices = numbers[:, None, None]
    expected, expected_slopes = jax.jit(jax.vmap(lambda z: (phi_functions(z), jax.jacfwd(phi_functions)(z))))(matrices)
    assert_allclose(values, expected[:, :, 0, 0], rtol=1e-13)
    assert_allclose(slopes, expected_slopes[:, :, 0, 0, 0, 0], rtol=1e-11, atol=1e-30)
    check_grads(phi_functions, (jnp.array([[-3.0, 1.0], [0.2, -8.0]]),), order=1, modes=("fwd", "rev"), rtol=1e-6)
