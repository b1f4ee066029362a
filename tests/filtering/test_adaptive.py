"""Steps whose length follows a tolerance, against many equal steps."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems

import lfm_ppl as lfm

TIMES = np.arange(0.0, 9.0, 2.0)
Y = np.array([[1.5], [np.nan], [-1.8], [1.1], [4.0]])


def double_well(parameters, rule=None, tolerance=None, steps=60):
    alpha, beta, sigma = parameters
    model = lfm.LatentForceModel(
        systems.DoubleWell(alpha, beta), {}, lfm.GaussianObservation(systems.whole_state, 0.01 * jnp.ones(1)),
        lfm.Gaussian([0.0], [10.0]), process_noise=sigma * jnp.ones((1, 1)))
    return lfm.MarginalLikelihood(model, TIMES, rule, steps=steps, iterations=0, tolerance=tolerance)


def expression(parameters=(0.4, 0.8, 1.0), tolerance=None, steps=400, start=0.0, link=jax.nn.softplus, times=TIMES):
    decay, sensitivity, lengthscale = parameters
    model = lfm.LatentForceModel(
        systems.Motif(jnp.array([1.0, 0.5]) * decay, jnp.array([0.5, 1.0]) * sensitivity, 0.1, link),
        {"u": lfm.Matern(1.0, lengthscale)}, lfm.GaussianObservation(systems.whole_state, 0.01 * jnp.ones(2)),
        lfm.Gaussian([0.2, 0.3], [start, start]), initial_time=0.0)
    return lfm.MarginalLikelihood(model, times, steps=steps, iterations=0, tolerance=tolerance)


SLOW_TO_STIFF = jnp.array([[-1.0, 0.1, 2.0], [-0.2, 0.05, 0.7], [-4.0, 0.5, 4.0], [-12.0, 1.2, 5.5]])


def test_slow_and_stiff_models_are_integrated_to_the_tolerance():
    def log_prob(tolerance, steps):
        return jax.jit(lambda all_: jax.lax.map(
            lambda p: double_well(p, lfm.Cubature(), tolerance, steps).log_prob(Y), all_))(SLOW_TO_STIFF)

    exact = log_prob(None, 4000)
    assert np.abs(log_prob(None, 20) - exact).max() > 0.1, "twenty equal steps do not do"
    loose, tight = (np.abs(log_prob(tolerance, 300) - exact) for tolerance in (1e-2, 1e-4))
    assert np.isfinite(exact).all()
    assert np.all(loose < 0.1)
    assert np.all(tight < 3e-3)
    assert np.all(tight < loose), "a smaller tolerance is more accurate for every model"


@pytest.mark.slow
def test_a_rejected_step_does_not_spoil_the_derivative():
    """A first step of an eighth of the interval would overflow."""
    theta = jnp.array([-3.0, 40.0, 5.0])
    result = jax.jit(jax.value_and_grad(lambda p: double_well(p, tolerance=1e-3, steps=1000).log_prob(Y)))(theta)
    assert np.isfinite(result[0])
    assert np.isfinite(result[1]).all()


class Explicit(eqx.Module):
    """(x - 0.1 x^3)(1 + 0.3 sin t) + input(t)."""

    input: Any = None

    def __call__(self, x, u, t):
        value = (x - 0.1 * x**3) * (1.0 + 0.3 * jnp.sin(t))
        return value if self.input is None else value + self.input(t)


def explicit(input_=None, tolerance=None, steps=2000, force=None, initial_time=0.0, dispersion=None):
    forces = {} if force is None else {"u": force}
    drift = Explicit(input_)
    dynamics = drift if force is None else (lambda x, u, t: drift(x, u, t) + jnp.tanh(u))
    model = lfm.LatentForceModel(
        dynamics, forces, lfm.GaussianObservation(systems.whole_state, 0.1 * jnp.ones(1)), lfm.Gaussian([0.0], [1.0]),
        process_noise=jnp.ones((1, 1)) if dispersion is None else dispersion, initial_time=initial_time)
    return lfm.MarginalLikelihood(model, TIMES, steps=steps, iterations=0, tolerance=tolerance)


WITHIN = lfm.Input(jnp.array([0.0, 1.3, 4.7]), jnp.array([1.0, -2.0, 3.0]))


@pytest.mark.slow
@pytest.mark.parametrize("keywords", [
    {"input_": WITHIN}, {"force": lfm.Matern(1.0, 2.0, mean=lambda t: jnp.cos(t))},
    {"force": systems.Kicked(0.3, (3.0, 5.0), 1.0, 2.0)},
    {"dispersion": lambda x, u, t: (1.0 + 0.2 * jnp.sin(t) + 0.1 * jnp.tanh(x))[:, None]},
], ids=["input within rows", "mean function", "jumps", "state-dependent noise"])
def test_dynamics_that_depend_on_time(keywords):
    exact, adaptive = jax.jit(lambda y: (explicit(**keywords).log_prob(y), explicit(
        **keywords, tolerance=1e-6, steps=400).log_prob(y)))(Y)
    np.testing.assert_allclose(adaptive, exact, atol=2e-3)


@pytest.mark.slow
def test_derivatives_with_respect_to_times():
    def log_prob(t, tolerance, steps):
        return explicit(initial_time=t, tolerance=tolerance, steps=steps).log_prob(Y)

    def derivative(mode, *settings):
        return jax.jit(mode(lambda t: log_prob(t, *settings)))(-0.7)

    exact = derivative(jax.jacfwd, None, 400)
    np.testing.assert_allclose(derivative(jax.grad, 1e-6, 100), exact, rtol=1e-3)
    np.testing.assert_allclose(derivative(jax.jacfwd, 1e-6, 100), exact, rtol=1e-3)


@pytest.mark.slow
def test_smoother_draws_and_requested_times():
    y = np.array([[0.2, 0.4], [0.9, 1.0], [np.nan, 1.3], [0.8, 0.9], [0.7, np.nan]])
    grid = np.array([0.0, 0.7, 2.0, 5.1, 9.5])
    exact, result = expression().smooth(y, at=grid), expression(tolerance=1e-7, steps=60).smooth(y, at=grid)
    np.testing.assert_allclose(result.mean, exact.mean, atol=1e-4)
    np.testing.assert_allclose(result.covariance, exact.covariance, atol=1e-4)
    np.testing.assert_allclose(result.leave_one_out, exact.leave_one_out, atol=1e-3)
    draws = result.sample(jax.random.key(0), 4000)
    sd = np.sqrt(np.diagonal(result.covariance, axis1=1, axis2=2))
    np.testing.assert_allclose(draws.state.std(0)[1:], sd[1:, :2], rtol=0.05)
    np.testing.assert_allclose(draws.forces["u"].std(0), result.force("u").sd, rtol=0.05)


@pytest.mark.slow
def test_replicates_gaps_and_a_row_of_its_own_for_each_call():
    times = np.array([0.0, 0.0, 2.0, 2.0, 40.0])
    y = np.full((5, 2), 0.7)
    exact = expression(times=times, steps=2000).log_prob(y)
    np.testing.assert_allclose(expression(times=times, tolerance=1e-6, steps=200).log_prob(y), exact, atol=1e-3)
    full_result = lfm.filter(expression().model, TIMES, y, tolerance=1e-4, steps=60)
    first = lfm.filter(expression().model, TIMES[:3], y[:3], tolerance=1e-4, steps=60)
    second = lfm.filter(expression().model, TIMES[3:], y[3:], tolerance=1e-4, steps=60, start=first.state)
    np.testing.assert_allclose(second.log_likelihood, full_result.log_likelihood[3:], rtol=1e-10)


@pytest.mark.slow
def test_too_few_steps_are_a_log_likelihood_of_minus_infinity_that_is_explained():
    with pytest.warns(lfm.FilterWarning, match="row 1.*tolerance"):
        result = lfm.filter(double_well(SLOW_TO_STIFF[3]).model, TIMES, Y, steps=1, tolerance=1e-9)
    assert np.isneginf(np.asarray(result.log_likelihood).sum())


def test_what_a_tolerance_cannot_be():
    model = double_well(SLOW_TO_STIFF[0]).model
    for wrong in (lambda: double_well(SLOW_TO_STIFF[0], tolerance=0.0),
                  lambda: lfm.MarginalLikelihood(model, TIMES, iterations=3, tolerance=1e-3),
                  lambda: lfm.smooth(model, TIMES, Y, iterations=3, tolerance=1e-3)):
        with pytest.raises(ValueError, match="tolerance"):
            wrong()


class Cascade(eqx.Module):
    """Each state drives the next; ``units`` are the units of the states."""

    units: Any

    def __call__(self, x, u, t):
        x = x / self.units
        production = jnp.concatenate([jax.nn.softplus(u), x[:-1] / (1.0 + x[:-1] ** 2)])
        return (production - 0.5 * x) * self.units


class Last(eqx.Module):
    """The last state, in its unit."""

    units: Any

    def __call__(self, x, u, t):
        return x[-1:] / self.units[-1]


@pytest.mark.thorough
@pytest.mark.parametrize("units", [
    pytest.param(np.array([1e-3, 1e3, 1.0, 30.0]), id="mixed units")])
def test_a_cascade_from_a_known_zero_in_any_units(units):
    def log_prob(tolerance, steps):
        model = lfm.LatentForceModel(
            Cascade(jnp.asarray(units)), {"u": lfm.Matern(1.0, 2.0)},
            lfm.GaussianObservation(Last(jnp.asarray(units)), 0.01 * jnp.ones(1)),
            lfm.Gaussian(np.zeros(4), np.zeros(4)), initial_time=-2.0)
        return lfm.MarginalLikelihood(model, TIMES, steps=steps, iterations=0, tolerance=tolerance).log_prob(Y)

    exact = log_prob(None, 400)
    np.testing.assert_allclose(log_prob(1e-3, 30), exact, rtol=2e-2)
    np.testing.assert_allclose(log_prob(1e-5, 100), exact, rtol=1e-3)



@pytest.mark.slow
def test_side_by_side_as_one_by_one():
    alone = [double_well(p, tolerance=1e-3).log_prob(Y) for p in SLOW_TO_STIFF]
    together = jax.jit(jax.vmap(lambda p: double_well(p, tolerance=1e-3).log_prob(Y)))(SLOW_TO_STIFF)
    np.testing.assert_allclose(together, alone, rtol=1e-9)
    panel = lfm.panel(lambda p: double_well(p).model, SLOW_TO_STIFF, TIMES, steps=60, tolerance=1e-3)
    np.testing.assert_allclose(panel.log_prob(np.broadcast_to(Y, (4, *Y.shape))), alone, rtol=1e-9)
