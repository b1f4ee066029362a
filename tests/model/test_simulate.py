"""Simulations against exact moments, within their Monte Carlo error."""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from references import LinearLFM, matern
from scipy.integrate import quad
from systems import Linear, double_well, motif, softplus, whole_state

import lfm_ppl as lfm

TIMES = np.array([0.5, 0.5, 1.5, 3.0])
DRAWS = 4000


@pytest.fixture(scope="module")
def linear():
    model = lfm.LatentForceModel(
        Linear(-0.7 * jnp.eye(1), jnp.ones((1, 1)), 0.2), {"u": lfm.Matern(1.2, 1.3, 1, mean=0.5)},
        lfm.GaussianObservation(whole_state, jnp.array([0.09])), lfm.Gaussian(jnp.array([0.3]), jnp.array([0.2])),
        process_noise=jnp.array([[0.3]]), initial_time=0.0)
    process = LinearLFM(-0.7 * np.eye(1), np.ones((1, 1)), [matern(1.2, 1.3, 1)], 0.0, np.array([0.3]),
                        np.array([[0.2]]), [lambda t: np.full_like(t, 0.5)], lambda t: np.array([0.2]),
                        np.array([[0.3]]))
    draw = jax.jit(jax.vmap(lambda key: lfm.simulate(key, model, TIMES, steps=40)))
    return draw(jax.random.split(jax.random.key(0), DRAWS)), process.moments(TIMES)


def within_monte_carlo_error(sample, mean, covariance):
    sd = np.sqrt(np.diag(covariance))
    assert np.abs((sample.mean(0) - mean) / sd * np.sqrt(len(sample))).max() < 4.5
    error = np.sqrt((covariance**2 + np.outer(sd, sd) ** 2) / len(sample))
    assert np.abs((np.cov(sample.T) - covariance) / error).max() < 4.5


@pytest.mark.thorough
def test_linear_model_has_its_exact_moments(linear):
    """State and force at all times, and y, which adds independent noise to replicates."""
    result, (mean, cov) = linear
    keep = [0, 2, 3]
    sample = np.concatenate([result.state[:, keep, 0], result.forces["u"][:, keep]], axis=1)
    order = [(k, w) for w in (0, 1) for k in keep]
    covariance = np.array([[cov[a, b, v, w] for b, w in order] for a, v in order])
    within_monte_carlo_error(sample, np.array([mean[k, w] for k, w in order]), covariance)
    within_monte_carlo_error(np.asarray(result.y[:, :, 0]), mean[:, 0], cov[:, :, 0, 0] + 0.09 * np.eye(4))
    assert np.array_equal(result.state[:, 0], result.state[:, 1]) and not np.array_equal(result.y[:, 0], result.y[:, 1])


def test_noise_free_motion_converges_with_the_steps():
    """Constant force: Heun's method is of order two."""
    model = lfm.LatentForceModel(
        lambda x, u, t: jnp.sin(t) - x**3, {}, lfm.GaussianObservation(whole_state, jnp.zeros(1)),
        lfm.Gaussian(jnp.ones(1), jnp.zeros((1, 1))), initial_time=0.0)
    end = {n: float(lfm.simulate(jax.random.key(0), model, [2.0], steps=n).state[0, 0]) for n in (20, 40, 2000)}
    order = np.log2(abs(end[20] - end[2000]) / abs(end[40] - end[2000]))
    assert 3.7 < order < 4.3
    assert float(lfm.simulate(jax.random.key(0), model, [2.0]).y[0, 0]) == pytest.approx(end[2000], abs=1e-3)


@pytest.mark.thorough
def test_double_well_settles_into_its_stationary_density():
    """p(x) ~ exp(2 (x^2 / 2 - x^4 / 4) / s^2), by quadrature."""
    s = 1.2

    def density(x, k):
        return x**k * np.exp(2 / s**2 * (x**2 / 2 - x**4 / 4))

    moment = {k: quad(density, -6, 6, args=(k,))[0] / quad(density, -6, 6, args=(0,))[0] for k in (2, 4, 8)}
    model = double_well(mean=0.0, variance=0.8, dispersion=s)
    draw = jax.jit(jax.vmap(lambda key: lfm.simulate(key, model, [8.0], steps=800).state[0, 0]))
    x = np.asarray(draw(jax.random.split(jax.random.key(1), DRAWS)))
    assert abs(x.mean()) < 4.5 * np.sqrt(moment[2] / DRAWS)
    assert abs((x**2).mean() - moment[2]) < 4.5 * np.sqrt((moment[4] - moment[2] ** 2) / DRAWS)
    assert abs((x**4).mean() - moment[4]) < 4.5 * np.sqrt((moment[8] - moment[4] ** 2) / DRAWS)


def test_state_dependent_dispersion_is_ito():
    """dx = 0.5 x dB is a martingale with E x^2 = x0^2 exp(t / 4)."""
    model = lfm.LatentForceModel(
        lambda x, u, t: 0.0 * x, {}, lfm.GaussianObservation(whole_state, jnp.zeros(1)),
        lfm.Gaussian(jnp.ones(1), jnp.zeros((1, 1))), process_noise=lambda x, u, t: 0.5 * x[:, None], initial_time=0.0)
    draw = jax.jit(jax.vmap(lambda key: lfm.simulate(key, model, [1.0], steps=100).state[0, 0]))
    x = np.asarray(draw(jax.random.split(jax.random.key(2), DRAWS)))
    second, fourth = np.exp(0.25), np.exp(1.5)
    assert abs(x.mean() - 1.0) < 4.5 * np.sqrt((second - 1) / DRAWS)
    assert abs((x**2).mean() - second) < 4.5 * np.sqrt((fourth - second**2) / DRAWS)


@pytest.mark.thorough
def test_starts_at_the_initial_time_and_covers_equal_times():
    result = lfm.simulate(jax.random.key(0), motif(softplus, variance=0.0), [0.0, 0.0, 1.0])
    assert np.allclose(result.state[0], 0.3 / (0.8 * np.array([1.0, 1.5]))) and np.array_equal(*result.state[:2])
    assert result.y.shape == (3, 2) and result.forces["u"].shape == (3,)


def test_a_jump_at_a_row_is_never_lost():
    """Rows whose end is not the sum of their steps to the last bit; each change point makes the force anew."""
    times = np.arange(40) * 0.1
    force = lfm.forces.SQM(1e-2, tuple(times[1:]))
    model = lfm.LatentForceModel(lambda x, u, t: x, {"u": force}, lfm.GaussianObservation(
        lambda x, u, t: u, jnp.array([0.1])), lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))
    force_path = lfm.simulate(jax.random.key(0), model, times, steps=3).forces["u"]
    assert len(np.unique(force_path)) == 40


@pytest.mark.thorough
def test_a_fast_rate_between_sparse_times():
    """The explicit step between two times would be 36 time constants long."""
    gut = lfm.LatentForceModel(
        lambda x, u, t: jnp.stack([-jnp.exp(u[0]) * x[0]]), {"log_rate": lfm.Matern(0.01, 4.0, mean=5.7)},
        lfm.GaussianObservation(whole_state, jnp.array([0.01])), lfm.Gaussian(jnp.array([100.0]), jnp.zeros((1, 1))),
        initial_time=0.0)
    saturable = lfm.LatentForceModel(
        lambda x, u, t: -50 * x / (2 + x), {}, lfm.GaussianObservation(whole_state, jnp.array([0.01])),
        lfm.Gaussian(jnp.array([40.0]), jnp.zeros((1, 1))), initial_time=0.0)
    for model in (gut, saturable):
        state = lfm.simulate(jax.random.key(0), model, np.array([2.0, 12.0])).state[:, 0]
        np.testing.assert_allclose(state, 0.0, atol=1e-8)
    y = lfm.MarginalLikelihood(saturable, np.array([2.0, 12.0])).sample(jax.random.key(0))
    assert np.abs(y).max() < 0.6


@pytest.mark.thorough
def test_a_rate_that_no_step_resolves():
    """Within a lag of 1e-7 of its equilibrium, by exponential steps."""
    model = lfm.LatentForceModel(
        lambda x, u, t: -1e7 * (x**3 + x - 2 - jnp.sin(t)), {}, lfm.GaussianObservation(whole_state, jnp.ones(1)),
        lfm.Gaussian(jnp.array([1.0]), jnp.zeros((1, 1))), initial_time=0.0)
    x = float(lfm.simulate(jax.random.key(0), model, np.array([20.0])).state[0, 0])
    assert x**3 + x - 2 - np.sin(20.0) == pytest.approx(0.0, abs=1e-4)


@pytest.mark.thorough
def test_the_law_does_not_depend_on_the_requested_times():
    """Stationary variances of a fast linear SDE, G^2 / (2 rate), with one key for many draws."""
    model = lfm.LatentForceModel(
        lambda x, u, t: -200 * (x - 1), {}, lfm.GaussianObservation(whole_state, jnp.ones(1)),
        lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))), process_noise=jnp.array([[2.0]]), initial_time=0.0)
    keys = jax.random.split(jax.random.key(1), 2000)
    for times in ([1.0], [0.5, 0.9, 1.0]):
        draw = jax.jit(jax.vmap(lambda key, times=times: lfm.simulate(key, model, np.array(times), steps=5).state[-1]))
        within_monte_carlo_error(np.asarray(draw(keys)), np.ones(1), np.array([[0.01]]))


@pytest.mark.thorough
def test_what_is_not_finite_is_said():
    model = lfm.LatentForceModel(lambda x, u, t: x**2, {}, lfm.GaussianObservation(whole_state, jnp.ones(1)),
                                 lfm.Gaussian(jnp.ones(1), jnp.zeros((1, 1))), state_names=("x",), initial_time=0.0)
    times, key = np.array([0.5, 2.0]), jax.random.key(0)
    with pytest.warns(UserWarning, match="'x' is not finite from time 2"):
        lfm.simulate(key, model, times)
    likelihood = lfm.MarginalLikelihood(model, times)
    with pytest.warns(UserWarning, match="'x' is not finite from time 2 on, in 1 of 1 paths"):
        likelihood.sample(key)
    with pytest.warns(UserWarning, match="in 6 of 6 paths"):
        likelihood.sample(key, (2, 3))
    with pytest.warns(UserWarning, match="in 2 of 2 paths"):
        lfm.Switching({"a": model, "b": model}, [[0.0, 1.0], [1.0, 0.0]], times).sample(key, (2,))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.jit(likelihood.sample)(key)
        lfm.MarginalLikelihood(model, times[:1]).sample(key)
