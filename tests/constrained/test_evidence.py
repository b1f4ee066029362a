"""The evidence under constraints against probabilities of boxes under a dense normal distribution (scipy)."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
from references import LinearLFM, Regression, matern
from scipy.stats import multivariate_normal
from systems import Linear, whole_state

import lfm_ppl as lfm

NOISE = 0.08**2


def model(lengthscale=1.0, observe=whole_state):
    return lfm.LatentForceModel(
        Linear(jnp.array([[-0.6]]), jnp.array([[0.25]])), {"factor": lfm.Matern(1.0, lengthscale)},
        lfm.GaussianObservation(observe, jnp.array([NOISE])), lfm.Gaussian(jnp.zeros(1), 0.01 * jnp.eye(1)),
        process_noise=0.05 * jnp.eye(1), initial_time=0.0, state_names=("x",))


def log_probability(mean, covariance, low, high):
    """log P(low <= (x, u) <= high at all rows), each of them (2,)."""
    size = mean.size
    low, high = (np.tile(bound, len(mean)) for bound in (low, high))
    used = np.isfinite(low) | np.isfinite(high)
    covariance = covariance.transpose(0, 2, 1, 3).reshape(size, size)[np.ix_(used, used)]
    sd, mean = np.sqrt(np.diag(covariance)), mean.ravel()[used]
    return np.log(multivariate_normal.cdf(
        (high[used] - mean) / sd, np.zeros(len(sd)), covariance / np.outer(sd, sd), allow_singular=True,
        lower_limit=(low[used] - mean) / sd, maxpts=200_000, abseps=1e-8, releps=1e-4, rng=np.random.default_rng(0)))


def reference(times, y, low, high, lengthscale=1.0):
    """log p(y) + log P(box | y) - log P(box)."""
    process = LinearLFM(np.array([[-0.6]]), np.array([[0.25]]), [matern(1.0, lengthscale, 1)], 0.0, np.zeros(1),
                        np.array([[0.01]]), dispersion=np.array([[0.05]]))
    dense = Regression(process, np.array([[1.0, 0.0]]), np.array([NOISE]))
    return (dense.log_likelihood(times, y) + log_probability(*dense.posterior(times, y, times), low, high)
            - log_probability(*process.moments(times), low, high))


def data(count, span):
    times = np.linspace(0.0, span, count)
    return times, (0.15 * np.sin(times) + 0.08 * np.random.default_rng(3).normal(size=count))[:, None]


CASES = {
    "one": (8, 5.0, {"factor": 0.0}, {}),
    "two": (8, 5.0, {"factor": 0.0}, {"factor": 1.2}),
    "state and force": (6, 5.0, {"x": 0.0, "factor": 0.0}, {"factor": 1.2}),
}


def evidence(case, draws):
    count, span, lower, upper = CASES[case]
    times, y = data(count, span)
    bounds_by_side = [np.array([bounds.get(name, none) for name in ("x", "factor")])
                      for bounds, none in ((lower, -np.inf), (upper, np.inf))]
    likelihood = lfm.ConstrainedLikelihood(model(), times, lower=lower, upper=upper, grid=times, draws=draws)
    return float(jax.jit(likelihood.log_prob)(y)), reference(times, y, *bounds_by_side)


@pytest.mark.thorough
@pytest.mark.parametrize("case", [
    "state and force", *(pytest.param(case, marks=pytest.mark.slow) for case in CASES if case != "state and force")])
def test_the_evidence_is_that_of_a_dense_normal_distribution(case):
    value, expected = evidence(case, 1024)
    assert abs(value - expected) < 0.05


@pytest.mark.slow
def test_expectation_propagation_alone_serves_two_bounds_on_a_coarse_grid():
    value, expected = evidence("two", 0)
    assert abs(value - expected) < 0.002


@pytest.mark.slow
def test_a_constraint_that_says_nothing_new_changes_nothing():
    times, y = data(4, 3.0)
    values = [float(jax.jit(lfm.ConstrainedLikelihood(model(), times, lower={"factor": 0.0}, constraints=more,
                                                      grid=times, draws=1024).log_prob)(y))
              for more in ((), lambda x, u, t: u[0] + 0.5, lambda x, u, t: 2.0 * u[0])]
    np.testing.assert_allclose(values[1:], values[0], atol=0.03)


@functools.cache
def small():
    times, y = data(5, 4.0)

    @jax.jit
    def log_prob(y, lengthscale, low):
        return lfm.ConstrainedLikelihood(model(lengthscale), times, lower={"factor": low}, upper={"factor": 1.0},
                                      grid=times, draws=64).log_prob(y)

    return log_prob, y


@pytest.mark.slow
def test_nothing_observed_has_probability_one():
    log_prob, y = small()
    assert abs(float(log_prob(np.full_like(y, np.nan), 1.0, 0.0))) < 1e-12


@pytest.mark.slow
def test_the_derivative_is_that_of_differences():
    """Factors are held fixed in it; the random numbers' part of their dependence is all that is left out."""
    log_prob, y = small()
    gradient = jax.jit(jax.grad(log_prob, argnums=(1, 2)))(y, 0.8, 0.1)
    for index, step in enumerate(np.eye(2) * 1e-4):
        difference = (log_prob(y, 0.8 + step[0], 0.1 + step[1]) - log_prob(y, 0.8 - step[0], 0.1 - step[1])) / 2e-4
        np.testing.assert_allclose(gradient[index], difference, rtol=0.02, atol=0.02)


@pytest.mark.slow
def test_what_cannot_be_is_minus_infinity_with_finite_derivatives():
    log_prob, y = small()
    value, slope = jax.jit(jax.value_and_grad(log_prob, argnums=1))(y, jnp.nan, 0.0)
    assert value == -jnp.inf and np.isfinite(slope)


def test_settings_that_constraints_do_not_take():
    times = np.arange(3.0)
    for settings, name in (
            ({"draws": 3}, "draws"), ({"draws": -2}, "draws"), ({"lower": {"fcator": 0.0}}, "'factor'"),
            ({"upper": {"factor": -1.0}}, "factor"), ({"constraints": lambda x, u, t: u[0] ** 2 - 1.0}, "linear"),
            ({"grid": [0.0, -1.0]}, "grid"), ({"lower": None}, "lower")):
        with pytest.raises(ValueError, match=name):
            lfm.ConstrainedLikelihood(model(), times, **{"lower": {"factor": 0.0}, **settings})
    for settings in ({"lower": {"factor": 0.0}}, {"grid": times, "draws": 2}):
        with pytest.raises(TypeError, match="ConstrainedLikelihood"):
            lfm.MarginalLikelihood(model(), times, **settings)
    with pytest.raises(TypeError, match="factor"):
        lfm.MarginalLikelihood(model(), times, factor=0.0)

    def unconstrained(times, y=None):
        numpyro.sample("y", lfm.MarginalLikelihood(model(), times), obs=y)

    for settings, name in (({"iterations": 2}, "iterations"), ({"max_step": 0.1}, "steps"),
                           ({"tolerance": 0.1}, "steps"), ({"method": "exponential"}, "method")):
        constrained = lfm.approximate(unconstrained, lower={"factor": 0.0}, **settings)
        with pytest.raises(ValueError, match=name):
            numpyro.handlers.trace(numpyro.handlers.seed(constrained, jax.random.key(0))).get_trace(times)
    counts = lfm.LatentForceModel(Linear(jnp.array([[-0.6]]), jnp.array([[0.25]])), {"u": lfm.Matern(1.0, 1.0)},
                                  lfm.PoissonObservation(whole_state), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
    with pytest.raises(TypeError, match="GaussianObservation"):
        lfm.ConstrainedLikelihood(counts, times, lower={"u": 0.0})
