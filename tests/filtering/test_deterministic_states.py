"""Observation families of states without variance: log p(y | f) exactly, and the limit of small variances."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from jax.scipy import stats
from jax.scipy.special import gammaln

import lfm_ppl as lfm

TIMES = np.arange(6.0)
COUNTS = np.array([98.0, 80.0, 50.0, 44.0, 28.0, 25.0])
THETA = jnp.array([0.3, 4.6, 0.2])


def start(mean, variance=0.0):
    return lfm.Gaussian(jnp.reshape(mean, 1), jnp.reshape(variance, (1, 1)) * jnp.ones((1, 1)))


def decay(theta, observation, variance=0.0, forces=None):
    """A state x' = -theta_0 from x = theta_1, with a force that does not act on it."""
    return lfm.LatentForceModel(lambda x, u, t: -theta[0] + 0.0 * x, forces or {}, observation,
                                start(theta[1], variance))


def bent(theta, observation, variance=0.0):
    """The exponential of the same state, by non-linear dynamics."""
    return lfm.LatentForceModel(lambda x, u, t: -theta[0] * x**2 / x, {}, observation,
                                start(jnp.exp(theta[1]), variance * jnp.exp(2.0 * theta[1])))


@pytest.mark.slow
def test_second_derivatives_of_deterministic_rows():
    def log_prob(theta):
        observation = lfm.StudentTObservation(lambda x, u, t: x, 4.0, jnp.exp(theta[2]))
        return lfm.MarginalLikelihood(decay(theta, observation), TIMES).log_prob(jnp.log(COUNTS)[:, None])

    def exact(theta):
        return stats.t.logpdf(jnp.log(COUNTS), 4.0, theta[1] - theta[0] * TIMES, jnp.exp(theta[2])).sum()

    np.testing.assert_allclose(jax.jit(jax.hessian(log_prob))(THETA), jax.hessian(exact)(THETA), rtol=1e-9, atol=1e-9)


VARIANCES = [0.0, 1e-300, 1e-110, 1e-60, 1e-32, 1e-29, 1e-26, 1e-22, 1e-18, 1e-14, 1e-12, 1e-10]


@pytest.mark.parametrize("build, name", [
    (decay, "Poisson"), *(pytest.param(*case, marks=pytest.mark.slow) for case in (
        (bent, "Student-t"),))])
def test_small_variances_lead_to_the_deterministic_limit(build, name):
    """Value and gradient, against Gauss-Hermite quadrature over the start."""
    y = jnp.asarray(COUNTS if name == "Poisson" else np.log(COUNTS))
    nodes, weights = np.polynomial.hermite_e.hermegauss(20)
    log_weights = np.log(weights / weights.sum())

    def density(theta, f):
        return y * f - jnp.exp(f) - gammaln(y + 1.0) if name == "Poisson" else stats.t.logpdf(
            y, 4.0, f, jnp.exp(theta[2]))

    def exact(theta, variance):
        sd = jnp.sqrt(jnp.where(variance > 0, variance, 1.0)) * (variance > 0)
        starts = theta[1] + (sd * nodes if build is decay else jnp.log1p(sd * nodes))
        return jax.nn.logsumexp(log_weights + jax.vmap(
            lambda x: density(theta, x - theta[0] * TIMES).sum())(starts))

    def log_prob(theta, variance):
        def predictor(x, u, t):
            return x if build is decay else jnp.log(x)

        observation = (lfm.PoissonObservation(predictor) if name == "Poisson"
                       else lfm.StudentTObservation(predictor, 4.0, jnp.exp(theta[2])))
        return lfm.MarginalLikelihood(build(theta, observation, variance), TIMES, steps=40).log_prob(y[:, None])

    evaluate, reference = (jax.jit(jax.value_and_grad(function)) for function in (log_prob, exact))
    for variance in VARIANCES:
        value, gradient = evaluate(THETA, variance)
        expected, slope = reference(THETA, variance)
        assert float(value) == pytest.approx(float(expected), rel=1e-9)
        np.testing.assert_allclose(gradient, slope, rtol=2e-8, atol=1e-8)


@pytest.mark.slow
def test_deterministic_and_uncertain_outputs_side_by_side():
    """They share no state: densities add, in each row, and so do gradients."""
    y = np.stack([COUNTS, 0.5 * np.sin(TIMES)], axis=1)
    y[2, 1] = y[4, 0] = np.nan
    theta = jnp.array([0.3, 4.6, -0.5])
    forces = {"u": lfm.Matern(1.0, 1.3)}

    def errors(theta):
        return lfm.StudentTObservation(lambda x, u, t: u, 4.0, jnp.exp(theta[2]))

    def mixed_likelihood(theta):
        observation = lfm.Observations(lfm.PoissonObservation(lambda x, u, t: x), errors(theta))
        return lfm.MarginalLikelihood(decay(theta, observation, forces=forces), TIMES)

    def alone(theta):
        return lfm.MarginalLikelihood(decay(theta, errors(theta), forces=forces), TIMES)

    def counted(theta):
        f = theta[1] - theta[0] * TIMES
        return jnp.where(np.isnan(y[:, 0]), 0.0, jnp.nan_to_num(y[:, 0]) * f - jnp.exp(f)
                         - gammaln(jnp.nan_to_num(y[:, 0]) + 1.0))

    result = jax.jit(jax.value_and_grad(lambda theta: mixed_likelihood(theta).log_prob(y)))(theta)
    parts = jax.jit(jax.value_and_grad(lambda theta: alone(theta).log_prob(y[:, 1:]) + counted(theta).sum()))(theta)
    for value, expected in zip(result, parts, strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-9, atol=1e-9)
    smoothed, of_force = mixed_likelihood(theta).smooth(y), alone(theta).smooth(y[:, 1:])
    np.testing.assert_allclose(smoothed.leave_one_out, of_force.leave_one_out + counted(theta), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(smoothed.force("u").sd, of_force.force("u").sd, rtol=1e-9)


@pytest.mark.slow
def test_a_conserved_sum_of_uncertain_states_is_deterministic():
    """Its variance is a rounding error of either sign."""
    theta = jnp.array([0.7, 0.31])

    def log_prob(theta):
        flow = jnp.array([[-1.3, 0.9, 0.0], [1.3, -0.9 - theta[0], 0.2], [0.0, theta[0], -0.2]])
        spread = jnp.array([[1.0, -0.4, -0.6], [-0.4, 0.7, -0.3], [-0.6, -0.3, 0.9]])
        model = lfm.LatentForceModel(
            lambda x, u, t: flow @ x, {}, lfm.Observations(
                lfm.StudentTObservation(lambda x, u, t: jnp.stack([x.sum() / 7.0]), 4.0, 0.1),
                lfm.StudentTObservation(lambda x, u, t: x[:1], 4.0, 0.1)),
            lfm.Gaussian(jnp.array([1.1, 0.2, theta[1]]), spread))
        return lfm.MarginalLikelihood(model, TIMES)

    y = np.stack([0.23 + 0.1 * np.sin(3.0 * TIMES), np.cos(TIMES)], axis=1)
    result = jax.jit(jax.value_and_grad(lambda theta: log_prob(theta).log_prob(y)))(theta)
    only = np.where([True, False], np.nan, y)
    parts = jax.jit(jax.value_and_grad(lambda theta: log_prob(theta).log_prob(only) + stats.t.logpdf(
        y[:, 0], 4.0, (1.3 + theta[1]) / 7.0, 0.1).sum()))(theta)
    for value, expected in zip(result, parts, strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-9)


@pytest.mark.slow
def test_factors_converge_in_any_unit():
    """Precisions of 1e-24 to 1e24, and a predictor that is far from zero."""
    def log_prob(unit, level):
        model = lfm.LatentForceModel(
            lambda x, u, t: unit * (u - 0.3), {"u": lfm.Matern(0.3, 1.0)},
            lfm.StudentTObservation(lambda x, u, t: x, 4.0, 0.1 * unit), start((4.6 + level) * unit, 0.01 * unit**2))
        y = (jnp.log(COUNTS) + level)[:, None] * unit
        return lfm.MarginalLikelihood(model, TIMES).log_prob(y) + TIMES.size * jnp.log(unit)

    run = jax.jit(log_prob)
    for unit in (1e-12, 1e-4, 1e4, 1e12):
        assert float(run(unit, 0.0)) == pytest.approx(float(run(1.0, 0.0)), rel=1e-9)
    assert float(run(1.0, 1e9)) == pytest.approx(float(run(1.0, 0.0)), rel=1e-4)


ALL = np.stack([COUNTS, COUNTS + 3.0, [1.0, 0.0, 1.0, 1.0, 0.0, 1.0], [9.0, 7.0, 8.0, 5.0, 6.0, 4.0],
                [4.7, 4.2, 4.1, 4.0, 4.0, 4.0], [4.5, 4.4, 9.0, 3.6, 3.3, 3.2], [1.2, 0.8, 1.0, 2.0, 1.1, 0.4],
                [4.6, 4.2, 4.1, 3.8, 3.3, 3.2]], axis=1)


def without_warnings(run):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return run()


def all_families(theta):
    def state(x, u, t):
        return x

    noise = jnp.exp(theta[2]) / 4.0
    return lfm.Observations(
        lfm.PoissonObservation(state), lfm.NegativeBinomialObservation(state, 5.0 * noise),
        lfm.BernoulliObservation(lambda x, u, t: x - 4.0), lfm.BinomialObservation(lambda x, u, t: x - 4.0, 10.0),
        lfm.CensoredObservation(state, noise, left=4.0), lfm.StudentTObservation(state, 4.0, noise),
        lfm.DistributionObservation(lambda x, u, t: x - 4.0, lambda f: dist.Gamma(2.0, jnp.exp(f))),
        lfm.GaussianObservation(state, noise[None] ** 2))


def exact_rows(theta):
    filled = np.where(np.isnan(ALL), 1.0, ALL)
    rows = jax.vmap(lambda t, y: law_of_all(theta, theta[1] - theta[0] * t, y))(TIMES, filled)
    return jnp.where(np.isnan(ALL), 0.0, rows).sum(1)


def law_of_all(theta, f, y):
    """Return log p(y | f) of the same families, from their definitions."""
    noise, p, limit = jnp.exp(theta[2]) / 4.0, jax.nn.sigmoid(f - 4.0), 4.0
    mean, c = jnp.exp(f), 5.0 * noise
    return jnp.stack([
        y[0] * f - mean - gammaln(y[0] + 1.0),
        gammaln(y[1] + c) - gammaln(c) - gammaln(y[1] + 1.0) + c * jnp.log(c / (c + mean))
        + y[1] * jnp.log(mean / (c + mean)),
        jnp.log(jnp.where(y[2] > 0.5, p, 1.0 - p)),
        gammaln(11.0) - gammaln(y[3] + 1.0) - gammaln(11.0 - y[3]) + y[3] * jnp.log(p)
        + (10.0 - y[3]) * jnp.log(1.0 - p),
        jnp.where(y[4] <= limit, stats.norm.logcdf(limit, f, noise), stats.norm.logpdf(y[4], f, noise)),
        stats.t.logpdf(y[5], 4.0, f, noise),
        2.0 * (f - 4.0) + jnp.log(y[6]) - y[6] * jnp.exp(f - 4.0),
        stats.norm.logpdf(y[7], f, noise)])


@pytest.mark.thorough
def test_all_families_add_their_densities():
    def log_prob(theta):
        return lfm.MarginalLikelihood(decay(theta, all_families(theta)), TIMES).log_prob(ALL)

    assert without_warnings(lambda: float(log_prob(THETA))) == pytest.approx(float(exact_rows(THETA).sum()), rel=1e-12)
    gradient = jax.jit(jax.grad(log_prob))(THETA)
    np.testing.assert_allclose(gradient, jax.grad(lambda theta: exact_rows(theta).sum())(THETA), rtol=1e-10)
