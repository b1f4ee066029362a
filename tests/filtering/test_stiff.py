"""Exponential steps for stiff dynamics, against exact solutions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

import lfm_ppl as lfm


def robertson_rates(x, u=None, t=None):
    rate = 0.04 * x[0] - 1e4 * x[1] * x[2]
    return -rate, rate - 3e7 * x[1] ** 2, 3e7 * x[1] ** 2


ROBERTSON_TIMES = np.array([0.0, 0.4, 4.0, 40.0])
ROBERTSON = lfm.LatentForceModel(
    lambda x, u, t: jnp.stack(robertson_rates(x)), {},
    lfm.GaussianObservation(lambda x, u, t: x[jnp.array([0, 2])], 1e-4 * jnp.ones(2)),
    lfm.Gaussian(jnp.array([1.0, 0, 0]), jnp.zeros((3, 3))))


def robertson_solution():
    return scipy.integrate.solve_ivp(lambda t, x: robertson_rates(x), (0, 40), [1.0, 0, 0], t_eval=ROBERTSON_TIMES,
                                     rtol=1e-10, atol=1e-12, method="LSODA").y.T[:, [0, 2]]


@pytest.mark.parametrize("options", [{"steps": 200}, {"steps": 100, "tolerance": 1e-3}], ids=["steps", "tolerance"])
def test_robertson(options):
    y = robertson_solution()
    likelihood = lfm.MarginalLikelihood(ROBERTSON, ROBERTSON_TIMES, method="exponential", **options)
    np.testing.assert_allclose(likelihood.log_prob(y), 8 * np.log(1 / (0.01 * np.sqrt(2 * np.pi))), atol=1e-4)


@pytest.mark.thorough
def test_a_breakdown_names_the_method_for_stiff_dynamics():
    for options in ({}, {"tolerance": 1e-3}):
        with pytest.warns(lfm.FilterWarning, match='method="exponential" for stiff'):
            lfm.filter(ROBERTSON, ROBERTSON_TIMES, robertson_solution(), **options)


RATES = np.array([[-1000.0, 999.0], [0.5, -1.0]])
FORCE_TIMES = np.array([0.0, 0.5, 1.7, 2.0])


def stiff_linear(extra=None):
    """A stiff linear system under a force; ``extra`` times a product of states hides that it is linear."""
    return lfm.LatentForceModel(
        lambda x, u, t: RATES @ x + jnp.array([0.0, 1.0]) * (u[0] if extra is None else u[0] + extra * x[0] * x[1]),
        {"u": lfm.Matern(1.0, 0.7)}, lfm.GaussianObservation(lambda x, u, t: x, 0.01 * jnp.ones(2)),
        lfm.Gaussian(jnp.array([1.0, -1.0]), 0.3 * jnp.eye(2)), process_noise=jnp.array([[3.0], [0.2]]))


@pytest.mark.thorough
@pytest.mark.parametrize("rule", [
    lfm.Taylor(), pytest.param(lfm.Cubature(), marks=pytest.mark.thorough),
    pytest.param(lfm.Unscented(full_state=True), marks=pytest.mark.thorough)], ids=str)
def test_a_stiff_linear_system_is_exact(rule):
    model, y = stiff_linear(), np.array([[0.9, -0.8], [0.1, 0.2], [0.4, np.nan], [0.3, 0.1]])
    exact = lfm.smooth(model, FORCE_TIMES, y)
    steps = lfm.smooth(stiff_linear(jnp.zeros(())), FORCE_TIMES, y, rule, steps=2, iterations=2, method="exponential")
    np.testing.assert_allclose(steps.log_likelihood, exact.log_likelihood, rtol=1e-8)
    np.testing.assert_allclose(steps.mean, exact.mean, atol=1e-8)
    np.testing.assert_allclose(steps.covariance, exact.covariance, atol=1e-8)
    # The first prediction once more, with the matrix exponential of SciPy.
    decay = np.sqrt(3) / 0.7
    feedback = np.block([[RATES, np.array([[0, 0], [1, 0]])], [np.zeros((1, 3)), 1.0],
                         [np.zeros((1, 2)), -decay**2, -2 * decay]])
    diffusion = scipy.linalg.block_diag(np.outer([3.0, 0.2], [3.0, 0.2]), 0.0, 4 * decay**3)
    units = np.array([1.0, 1.0, 1.0, decay])
    joint = scipy.linalg.expm(0.5 * np.block([[-feedback, diffusion], [np.zeros((4, 4)), feedback.T]]) / 64)
    phi, noise = joint[4:, 4:].T, joint[4:, 4:].T @ joint[:4, 4:]
    covariance = lfm.filter(model, FORCE_TIMES[:1], y[:1]).state.covariance * np.outer(units, units)
    for _ in range(64):
        covariance = phi @ covariance @ phi.T + noise
    predicted = lfm.filter(stiff_linear(jnp.zeros(())), FORCE_TIMES, y, rule, steps=1, method="exponential")
    np.testing.assert_allclose(predicted.predicted_covariance[1] * np.outer(units, units), covariance, rtol=1e-7,
                               atol=1e-10)


def test_a_stiff_linear_system_with_a_known_input():
    pulse = lfm.Input(jnp.array([0.0, 0.3, 1.0]), jnp.array([0.0, 1.0, 0.5]), "linear")
    model = lfm.LatentForceModel(
        lambda x, u, t: 1e4 * (pulse(t) - x), {}, lfm.GaussianObservation(lambda x, u, t: x, 1e-4 * jnp.ones(1)),
        lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))))
    times = np.array([0.0, 0.1, 0.2, 0.6, 1.0])
    predicted = lfm.filter(model, times, np.zeros((5, 1)), steps=1, method="exponential").predicted_mean[:, 0]
    slope = np.where(times <= 0.3, 1 / 0.3, -0.5 / 0.7)
    lag = np.where(times > 0, slope * 1e-4, 0.0)
    np.testing.assert_allclose(predicted, np.interp(times, [0, 0.3, 1], [0, 1, 0.5]) - lag, atol=1e-10)


@pytest.mark.parametrize("options", [{"steps": 100}, {"steps": 100, "tolerance": 1e-3}], ids=["steps", "tolerance"])
def test_a_known_stiff_state_far_from_equilibrium(options):
    model = lfm.LatentForceModel(
        lambda x, u, t: 1e7 * (1 - x**3), {}, lfm.GaussianObservation(lambda x, u, t: x, 1e-4 * jnp.ones(1)),
        lfm.Gaussian(jnp.array([0.1]), jnp.zeros((1, 1))), events=[lfm.Dose([1.0], 4.0, "x0")])
    result = lfm.filter(model, np.array([0.0, 1.0, 2.0]), np.ones((3, 1)), method="exponential", **options)
    np.testing.assert_allclose(result.predicted_mean[1:], 1.0, rtol=1e-10)
    np.testing.assert_allclose(result.predicted_covariance[1:], 0.0, atol=1e-10)


def van_der_pol(mu=1.0, noise=0.3, start=1.0):
    return lfm.LatentForceModel(
        lambda x, u, t: jnp.stack([x[1], mu * (1 - x[0] ** 2) * x[1] - x[0] + jnp.sin(u[0])]),
        {"u": lfm.Matern(1.0, 1.0)}, lfm.GaussianObservation(lambda x, u, t: x, 0.01 * jnp.ones(2)),
        lfm.Gaussian(jnp.array([start, 0.5]), 0.05 * jnp.eye(2)), process_noise=noise * jnp.eye(2), initial_time=0.0)


@pytest.mark.thorough
@pytest.mark.parametrize("rule", [lfm.Taylor(), lfm.Cubature()], ids=["taylor", "cubature"])
def test_order_of_convergence(rule):
    times, y = np.array([0.0, 1.0, 2.0]), np.array([[1.0, 0.4], [1.3, 0.1], [1.2, -0.4]])

    def moments(steps, method):
        result = lfm.filter(van_der_pol(), times, y, rule, steps=steps, method=method)
        return np.concatenate([result.predicted_mean.ravel(), result.predicted_covariance.ravel()])

    exact = moments(800, "runge-kutta")
    errors = [np.abs(moments(steps, "exponential") - exact).max() for steps in (10, 20, 40)]
    assert errors[0] < 1e-2
    assert np.log2(errors[0] / errors[1]) > 2.7 and np.log2(errors[1] / errors[2]) > 2.7, errors


@pytest.mark.thorough
def test_covariances_of_a_stiff_oscillator_are_semidefinite():
    y = np.full((7, 2), np.nan)
    y[0] = 2.0, 0.0
    for steps in (1, 5):
        result = lfm.filter(van_der_pol(1e3, start=2.0), np.linspace(0.0, 3.0, 7), y, steps=steps, method="exponential")
        assert np.isfinite(result.predicted_mean).all()
        for covariance in result.predicted_covariance:
            assert np.linalg.eigvalsh(covariance).min() >= -1e-12 * np.abs(covariance).max()


@pytest.mark.thorough
@pytest.mark.parametrize("options", [
    {"steps": 5}, pytest.param({"steps": 30, "tolerance": 1e-2}, marks=pytest.mark.slow)], ids=["steps", "tolerance"])
def test_gradients(options):
    times, y = np.array([0.0, 1.0, 2.0]), np.array([[0.1], [0.9], [0.8]])

    @jax.jit
    @jax.value_and_grad
    def log_prob(parameters):
        rate, noise = parameters
        model = lfm.LatentForceModel(
            lambda x, u, t: rate * (1 - x**3), {}, lfm.GaussianObservation(lambda x, u, t: x, 0.01 * jnp.ones(1)),
            lfm.Gaussian(jnp.array([0.1]), 0.01 * jnp.eye(1)), process_noise=noise * jnp.eye(1))
        return lfm.MarginalLikelihood(model, times, lfm.Taylor(), method="exponential", iterations=0,
                                      **options).log_prob(y)

    theta = jnp.array([200.0, 3.0])
    gradient = log_prob(theta)[1]
    assert np.isfinite(gradient).all()
    if "tolerance" not in options:  # whose number of steps jumps with the parameters
        differences = [(log_prob(theta + d)[0] - log_prob(theta - d)[0]) / (2 * d.sum())
                       for d in jnp.diag(1e-5 * theta)]
        np.testing.assert_allclose(gradient, differences, rtol=1e-5)


def test_an_unknown_method_is_refused():
    with pytest.raises(ValueError, match="method"):
        lfm.MarginalLikelihood(ROBERTSON, ROBERTSON_TIMES, method="implicit")


def follower(rate, weather):
    return lfm.LatentForceModel(
        lambda x, u, t: rate * (weather(t) - x), {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.ones(1)),
        lfm.Gaussian(jnp.array([weather(0.0)]), jnp.zeros((1, 1))), initial_time=0.0)


@pytest.mark.thorough
@pytest.mark.parametrize("rate", [10.0, 1e6])
def test_a_tolerance_for_a_fast_state_that_follows_an_input(rate):
    """x' = r (10 + 5 sin(t / 3.8) - x), and the same with a table of the input that is linear between hours."""
    times, frequency = np.arange(1.0, 13.0), 1 / 3.8

    def lagged(t):
        return 10 + 5 * rate * (rate * np.sin(frequency * t) - frequency * np.cos(frequency * t)) / (
            rate**2 + frequency**2)

    exact = lagged(times) + (10.0 - lagged(0.0)) * np.exp(-rate * times)
    smooth_input = follower(rate, lambda t: 10 + 5 * jnp.sin(frequency * t))
    result = lfm.filter(smooth_input, times, np.zeros((12, 1)), method="exponential", tolerance=1e-3)
    np.testing.assert_allclose(result.predicted_mean[:, 0], exact, rtol=2e-5)

    hours = np.arange(14.0)
    table = 10 + 5 * np.sin(frequency * hours)
    x, exact = table[0], []
    for start, end in zip(table[:12], table[1:13], strict=True):
        lag = (end - start) / rate
        x = end - lag + (x - start + lag) * np.exp(-rate)
        exact.append(x)
    linear_input = follower(rate, lfm.Input(hours, table, "linear", "hold"))
    result = lfm.filter(linear_input, times, np.zeros((12, 1)), method="exponential", tolerance=1e-3)
    np.testing.assert_allclose(result.predicted_mean[:, 0], exact, rtol=1e-8)
