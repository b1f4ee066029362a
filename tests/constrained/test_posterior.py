"""Expectation propagation under constraints against draws from the exact truncated normal distribution."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from references import LinearLFM, Regression, matern
from scipy.integrate import quad
from scipy.stats import norm, truncnorm
from systems import Linear, whole_state

import lfm_ppl as lfm
from lfm_ppl.constrained.truncated import log_share, quantile, truncated_moments
from lfm_ppl.filtering.ep.quadrature import MeanVariance

TIMES = np.linspace(0.0, 5.0, 8)
Y = np.array([[0.0], [0.25], [0.13], [-0.03], [0.02], [-0.05], [0.21], [0.05]])
DRAWS = 400_000


def model(noise_sd=0.08):
    return lfm.LatentForceModel(
        Linear(jnp.array([[-0.6]]), jnp.array([[0.25]])), {"factor": lfm.Matern(1.0, 1.0)},
        lfm.GaussianObservation(whole_state, jnp.array([noise_sd**2])), lfm.Gaussian(jnp.zeros(1), 0.01 * jnp.eye(1)),
        process_noise=0.05 * jnp.eye(1), initial_time=0.0)


@pytest.fixture(scope="module")
def dense():
    process = LinearLFM(np.array([[-0.6]]), np.array([[0.25]]), [matern(1.0, 1.0, 1)], 0.0, np.zeros(1),
                        np.array([[0.01]]), dispersion=np.array([[0.05]]))
    return Regression(process, np.array([[1.0, 0.0]]), np.array([0.08**2]))


def accepted(mean, covariance, low, high):
    """Draws (N, 2 T) of (x, u) at all rows that respect ``low <= u <= high``."""
    covariance = covariance.transpose(0, 2, 1, 3).reshape(mean.size, mean.size)
    values, vectors = np.linalg.eigh(covariance)
    noise = np.random.default_rng(0).normal(size=(DRAWS, mean.size))
    draws = mean.ravel() + noise @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    return draws[((draws[:, 1::2] >= low) & (draws[:, 1::2] <= high)).all(axis=1)]


@pytest.mark.thorough
@pytest.mark.parametrize("upper", [
    pytest.param({}, id="one bound", marks=pytest.mark.slow), pytest.param({"factor": 1.2}, id="two bounds")])
def test_moments_bands_and_draws(dense, upper):
    posterior = lfm.constrained_posterior(model(), TIMES, Y, lower={"factor": 0.0}, upper=upper, grid=TIMES)
    assert posterior.converged
    high = upper.get("factor", np.inf)
    draws = accepted(*dense.posterior(TIMES, Y, TIMES), 0.0, high)
    u, x = draws[:, 1::2], draws[:, 0::2]
    assert len(u) > 1000
    # Monte Carlo error, plus what expectation propagation is off by.
    error = 4.0 / np.sqrt(len(u))
    np.testing.assert_allclose(posterior.force_mean[:, 0], u.mean(axis=0), atol=(0.03 + error) * u.std(axis=0).max())
    np.testing.assert_allclose(posterior.state_mean[:, 0], x.mean(axis=0), atol=(0.03 + error) * x.std(axis=0).max())
    np.testing.assert_allclose(posterior.force_sd[:, 0], u.std(axis=0), rtol=0.05 + error)
    low, top = posterior.interval("factor", 0.9)
    assert (low >= 0.0).all() and (top <= high).all()
    if not upper:
        covered = ((u >= np.asarray(low)) & (u <= np.asarray(top))).mean(axis=0)
        np.testing.assert_allclose(covered, 0.9, atol=0.02 + error)
    draws = posterior.sample(jax.random.key(0), 2000)
    ours_u, ours_x = np.asarray(draws.forces["factor"]), np.asarray(draws.state[..., 0])
    assert ours_u.min() >= 0.0 and ours_u.max() <= high
    error = 4.0 * np.sqrt(1 / 2000 + 1 / len(u))
    for ours, reference in ((ours_u, u), (ours_x, x)):
        assert (np.abs(ours.mean(axis=0) - reference.mean(axis=0)) < error * reference.std(axis=0)).all()
        np.testing.assert_allclose(ours.std(axis=0), reference.std(axis=0), rtol=error)
        np.testing.assert_allclose(np.corrcoef(ours.T), np.corrcoef(reference.T), atol=1.5 * error)


@pytest.mark.thorough
def test_without_active_constraints_it_is_the_smoother():
    posterior = lfm.constrained_posterior(model(), TIMES, Y, lower={"factor": -30.0}, grid=TIMES)
    smoothed = lfm.smooth(model(), TIMES, Y)
    np.testing.assert_allclose(posterior.force_mean[:, 0], smoothed.force("factor").mean, atol=1e-8)
    np.testing.assert_allclose(posterior.force_sd[:, 0], smoothed.force("factor").sd, atol=1e-8)
    for of_posterior, expected in ((posterior.force("factor"), smoothed.force("factor")),
                                   (posterior.state("x0"), smoothed.state("x0"))):
        assert type(of_posterior) is type(expected)
        np.testing.assert_allclose(of_posterior, expected, atol=1e-8)
    low, high = posterior.interval("x0")
    sd = smoothed.state("x0").sd
    np.testing.assert_allclose(low, smoothed.state("x0").mean + norm.ppf(0.025) * sd, atol=1e-8)
    np.testing.assert_allclose(high - low, 2 * norm.ppf(0.975) * sd, atol=1e-8)


def test_moments_of_a_truncated_normal():
    """From far above the bound to far below it, where one minus nearly one loses all digits."""
    mean = np.array([8.0, 1.0, 0.0, -3.0, -12.0, -29.9, -30.1, -200.0])
    tilted = truncated_moments(MeanVariance(jnp.asarray(2.0 * mean), jnp.full(8, 4.0)))
    np.testing.assert_allclose(tilted.log_partition, norm.logcdf(mean), rtol=1e-12, atol=1e-15)
    expected = truncnorm(-mean[:5], np.inf, 2.0 * mean[:5], 2.0)
    np.testing.assert_allclose(tilted.mean[:5], expected.mean(), rtol=1e-8)
    np.testing.assert_allclose(tilted.variance[:5], expected.var(), rtol=1e-6)
    for index in (5, 6, 7):
        a = -mean[index]
        # f = 2 s / a with density exp(-s - s^2 / (2 a^2)).
        moments = [quad(lambda s, k=k, a=a: s**k * np.exp(-s - 0.5 * (s / a) ** 2), 0.0, 60.0, epsabs=1e-14)[0]
                   for k in range(3)]
        first, second = moments[1] / moments[0], moments[2] / moments[0]
        np.testing.assert_allclose(tilted.mean[index], 2.0 * first / a, rtol=1e-7)
        np.testing.assert_allclose(tilted.variance[index], 4.0 * (second - first**2) / a**2, rtol=1e-6)


def test_observations_without_noise_of_their_own_are_refused():
    base = model()
    for covariance in (jnp.zeros(1), lambda x, u, t: jnp.ones(1)):
        noisy = lfm.LatentForceModel(
            base.dynamics, base.forces, lfm.GaussianObservation(whole_state, covariance), base.initial_state,
            initial_time=0.0)
        with pytest.raises(ValueError):
            lfm.constrained_posterior(noisy, TIMES, Y, lower={"factor": 0.0})


@pytest.mark.parametrize("mean, width", [(-30.0, 0.5), (30.5, 0.5), (0.3, 1e-4), (-2.0, 3.0), (-50.0, np.inf)])
def test_a_box_far_from_the_mean_and_a_narrow_one(mean, width):
    """Against quadrature: nothing cancels."""
    mode = float(np.clip(mean, 0.0, width))
    reach = min(width, 1.0 if abs(mean) > 10 else 12.0)
    low, high = max(mode - reach, 0.0), min(mode + reach, width)

    def integral(power, end):
        return quad(lambda f: (f - mode) ** power * np.exp(-0.5 * (f - mode) * (f + mode - 2 * mean)), low, end,
                    epsabs=0, epsrel=1e-12, limit=200)[0]

    total = integral(0, high)
    first, second = integral(1, high) / total, integral(2, high) / total
    cavity = MeanVariance(jnp.asarray(mean), jnp.asarray(1.0))
    tilted = truncated_moments(cavity, width)
    np.testing.assert_allclose(tilted.log_partition, np.log(total) + norm.logpdf(mode, mean), rtol=1e-9)
    np.testing.assert_allclose(tilted.mean, mode + first, rtol=1e-9)
    np.testing.assert_allclose(tilted.variance, second - first**2, rtol=1e-6)
    for share in (0.01, 0.5, 0.99):
        value = float(quantile(cavity, width, share))
        # Beyond 35 standard deviations the tail is taken for an exponential one. At 30 the first quantile is the
        # difference, 3e-4, of two numbers near 30, one of them a normal quantile, right to 1e-13.
        np.testing.assert_allclose(integral(0, value) / total, share, rtol=2e-3 if abs(mean) > 35 else 1e-7)


@pytest.mark.parametrize("mean", [0.5, 37.0, 39.0, 50.0])
def test_the_probability_far_inside_a_bound_has_a_derivative(mean):
    slope = jax.grad(lambda m: log_share(MeanVariance(m, jnp.asarray(1.0))))(mean)
    np.testing.assert_allclose(slope, np.exp(norm.logpdf(mean) - norm.logcdf(mean)), atol=1e-300)
