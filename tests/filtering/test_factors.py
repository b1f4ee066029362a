"""The factor engine against dense Gaussian algebra, importance sampling and differences."""

import itertools
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from references import matern
from scipy import special, stats

import lfm_ppl as lfm
from lfm_ppl.filtering.ep.importance import importance_weights
from lfm_ppl.filtering.ep.settings import FactorSettings
from lfm_ppl.filtering.moments import Moments
from lfm_ppl.filtering.update import Factors, LinearisedObservation, multiply_by_factors

TIMES = np.linspace(0.0, 8.0, 20)
THETA = jnp.array([0.1, 0.05, -0.1])
DRAWS = 100_000


def force(x, u, t):
    return u


def process(observation, scale=1.0, lengthscale=1.3):
    """A Matern-3/2 process that is observed itself."""
    return lfm.LatentForceModel(lambda x, u, t: jnp.zeros(0), {"u": lfm.Matern(scale, lengthscale)}, observation,
                                lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))


def covariance(theta):
    kernel = matern(np.exp(theta[0]), 1.3 * np.exp(theta[1]), 1)
    return kernel(TIMES[:, None], TIMES)


# Name -> (observation of theta, log p(y | f, theta), data given the process).
FAMILIES: dict[str, Any] = {
    "Poisson": (lambda th: lfm.PoissonObservation(lambda x, u, t: u + th[2]),
                lambda y, f, th: stats.poisson.logpmf(y, np.exp(f + th[2])),
                lambda rng, f: rng.poisson(np.exp(f))),
    "negative binomial": (lambda th: lfm.NegativeBinomialObservation(force, 2.0 * jnp.exp(th[2])),
                          lambda y, f, th: stats.nbinom.logpmf(y, 2 * np.exp(th[2]), 1 / (
                              1 + np.exp(f) / 2 / np.exp(th[2]))),
                          lambda rng, f: rng.poisson(np.exp(f) * rng.gamma(2.0, 0.5, f.size))),
    "Bernoulli": (lambda th: lfm.BernoulliObservation(lambda x, u, t: 2.0 * u + th[2]),
                  lambda y, f, th: -np.logaddexp(0.0, -(2 * y - 1) * (2.0 * f + th[2])),
                  lambda rng, f: rng.uniform(size=f.size) < 1 / (1 + np.exp(-2 * f))),
    "Student-t": (lambda th: lfm.StudentTObservation(force, 4.0, 0.2 * jnp.exp(th[2])),
                  lambda y, f, th: stats.t.logpdf(y, 4.0, f, 0.2 * np.exp(th[2])),
                  lambda rng, f: f + 0.2 * rng.standard_t(4, f.size) + 4.0 * (np.arange(f.size) % 7 == 3)),
}


def data(name):
    rng = np.random.default_rng(1)
    f = np.linalg.cholesky(covariance(np.zeros(3)) + 1e-12 * np.eye(TIMES.size)) @ rng.normal(size=TIMES.size)
    return FAMILIES[name][2](rng, f).astype(float)[:, None]


def likelihood(name, theta, factors=None):
    model = process(FAMILIES[name][0](theta), jnp.exp(theta[0]), 1.3 * jnp.exp(theta[1]))
    return lfm.MarginalLikelihood(model, TIMES, factors=factors)


def importance(name, y, mean, cov, draws=DRAWS):
    """Log evidence, its standard error, and posterior means and sds, by draws of Student's t near the posterior.

    With 8 degrees of freedom: beside gross errors the posterior has tails, or a second mode, beyond a Gaussian's.
    """
    theta, k, size = np.asarray(THETA), covariance(np.asarray(THETA)), TIMES.size
    prior = np.linalg.inv(k + 1e-12 * np.eye(size))
    proposal = stats.multivariate_t(mean, cov, df=8, seed=np.random.default_rng(2))
    result, log_weight = [], []
    for _ in range(0, draws, DRAWS):
        f = proposal.rvs(DRAWS)
        result.append(f)
        log_weight.append(FAMILIES[name][1](y.T, f, theta).sum(1) - 0.5 * np.einsum("ij,jk,ik->i", f, prior, f)
                          + 0.5 * np.linalg.slogdet(prior)[1] - 0.5 * size * np.log(2 * np.pi) - proposal.logpdf(f))
    f, log_weight = np.concatenate(result), np.concatenate(log_weight)
    weight = np.exp(log_weight - log_weight.max())
    error = weight.std() / weight.mean() / np.sqrt(len(f))
    share = weight / weight.sum()
    first = share @ f
    return log_weight.max() + np.log(weight.mean()), error, first, np.sqrt(share @ (f - first) ** 2)


def exact_moments(y, chains=200, sweeps=3000, burn_in=300):
    """Posterior means and sds under Student-t errors, good to 0.002: a Gibbs sampler of their scale mixture of normals.

    Averaged are the moments given the scales.
    """
    theta, y = np.asarray(THETA), y.ravel()
    prior, df = np.linalg.inv(covariance(theta) + 1e-12 * np.eye(y.size)), 4.0
    variance, rng = (0.2 * np.exp(theta[2])) ** 2, np.random.default_rng(0)
    weight, first, second = rng.gamma(df / 2, 2 / df, (chains, y.size)), 0.0, 0.0
    for sweep in range(burn_in + sweeps):
        cov = np.linalg.inv(prior + weight[:, :, None] * np.eye(y.size) / variance)
        mean = np.einsum("cij,cj->ci", cov, weight * y / variance)
        root = np.linalg.cholesky(0.5 * (cov + cov.transpose(0, 2, 1)))
        f = mean + np.einsum("cij,cj->ci", root, rng.normal(size=mean.shape))
        weight = rng.gamma((df + 1) / 2, 2.0, mean.shape) / (df + (y - f) ** 2 / variance)
        if sweep >= burn_in:
            first = first + mean.mean(0)
            second = second + (mean**2 + np.einsum("cii->ci", cov)).mean(0)
    first = first / sweeps
    return first, np.sqrt(second / sweeps - first**2)


@partial(jax.jit, static_argnums=0)
def evidence_and_moments(name, y):
    """Log evidence, means and sds at the rows, and the covariance of draws between them."""
    distribution = likelihood(name, THETA)
    result = distribution.smooth(y)
    draws = result.sample(jax.random.key(0), 4000).forces["u"]
    return distribution.log_prob(y), *result.force("u"), jnp.cov(draws.T)


@pytest.mark.thorough
def test_evidence_and_posterior_against_importance_sampling():
    """The proposal is dense algebra with the smoothed marginals' own precisions; its weights correct it."""
    y = data("Poisson")
    log_evidence, mean, sd, cov = map(np.asarray, evidence_and_moments("Poisson", jnp.asarray(y)))
    log_z, error, first, spread = importance("Poisson", y, mean, cov * 1.1)
    assert error < 0.02
    assert abs(log_evidence - log_z) < 0.05 + 4 * error
    assert np.abs(mean - first).max() < 0.05 * np.min(spread) + 4 * error * spread.max()
    assert np.abs(sd / spread - 1).max() < 0.03 + 4 * error


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Bernoulli", "Student-t"])
def test_evidence_and_moments_of_many_records(name):
    """For the table in docs/observations.md, of sixteen records. Student-t data have three gross errors of 20 sds."""
    k, records, computed = covariance(np.asarray(THETA)), 4, []
    for seed in range(records):
        rng = np.random.default_rng(seed)
        y = FAMILIES[name][2](rng, np.linalg.cholesky(k + 1e-12 * np.eye(len(k))) @ rng.normal(size=len(k)))
        log_evidence, mean, sd, cov = map(
            np.asarray, evidence_and_moments(name, jnp.asarray(y, float)[:, None]))
        log_z, error, first, spread = importance(name, y.astype(float)[:, None], mean, 1.25 * cov, 500_000)
        if name == "Student-t":  # two modes are too much for the weights
            first, spread = exact_moments(y)
        computed.append([abs(log_evidence - log_z), np.max(np.abs(mean - first) / spread),
                      np.max(np.abs(sd / spread - 1.0)), error])
    errors = np.array(computed)
    print(f"{name}: log evidence, means, sds, error of the reference: median {np.median(errors, 0).round(3)}, "
          f"largest {errors.max(0).round(3)}")
    errors = errors[errors[:, 3] < 0.02]
    assert len(errors) == records and errors[:, 0].max() < 0.2 and errors[:, 1].max() < 0.05
    assert errors[:, 2].max() < {"Student-t": 0.16, "Bernoulli": 0.025}[name]


def differences(value, theta, h=1e-3):
    """Derivatives by differences of fourth order."""
    return [(8 * (value(theta + h * e) - value(theta - h * e)) - value(theta + 2 * h * e) + value(theta - 2 * h * e))
            / (12 * h) for e in np.eye(theta.size)]


@pytest.mark.thorough
@pytest.mark.parametrize("name, factors", [
    ("Student-t", None),
    *(pytest.param("Poisson", factors, marks=pytest.mark.slow)
      for factors in (FactorSettings(power=0.5), FactorSettings("variational"), FactorSettings("laplace"))),
])
def test_gradient_is_that_of_the_value(name, factors):
    """By differences of fourth order; the factors are held fixed, and what the family's parameters do is not."""
    y = data(name)
    value = jax.jit(lambda theta: likelihood(name, theta, factors).log_prob(y))
    gradient = np.asarray(jax.jit(jax.grad(lambda theta: likelihood(name, theta, factors).log_prob(y)))(THETA))
    np.testing.assert_allclose(gradient, differences(value, THETA), atol=2e-7)


@pytest.mark.slow
def test_with_gaussian_factors_it_is_the_gaussian_filter():
    """Value and gradient, two outputs of which one also mixes the forces, missing entries."""
    rng = np.random.default_rng(0)
    y = rng.normal(size=(TIMES.size, 2))
    y[3, 0] = y[7] = np.nan

    def log_prob(theta, wrap):
        gaussian = lfm.GaussianObservation(lambda x, u, t: jnp.concatenate([u, 2.0 * x - u]),
                                           jnp.array([0.04, 0.3]) * jnp.exp(theta[2]))
        model = lfm.LatentForceModel(
            lambda x, u, t: u - theta[1] * x, {"u": lfm.Matern(jnp.exp(theta[0]), 1.3)}, wrap(gaussian),
            lfm.Gaussian(jnp.ones(1), 0.5 * jnp.eye(1)))
        return lfm.MarginalLikelihood(model, TIMES).log_prob(y)

    expected, gradient = jax.jit(jax.value_and_grad(lambda th: log_prob(th, lambda g: g)))(THETA)
    result, of_factors = jax.jit(jax.value_and_grad(lambda th: log_prob(th, lfm.Observations)))(THETA)
    assert result == pytest.approx(float(expected), rel=1e-12)
    np.testing.assert_allclose(of_factors, gradient, rtol=1e-12, atol=1e-11)


def test_update_in_natural_parameters_against_dense_algebra():
    """Three entries, a negative precision and one of zero, and what a linearisation leaves out."""
    rng = np.random.default_rng(0)
    root, h = rng.normal(size=(4, 4)), rng.normal(size=(3, 4))
    p, omega = root @ root.T, np.diag([0.1, 0.0, 0.2])
    m, value, centre, nu = rng.normal(size=4), rng.normal(size=3), rng.normal(size=3), rng.normal(size=3)
    tau = np.array([2.0, -0.02, 0.0])
    # The joint state (s, e) has the precision of the prior and of the factors.
    prior = np.zeros((7, 7))
    prior[:4, :4], prior[4:, 4:] = p, omega + 1e-13 * np.eye(3)
    observation_matrix = np.concatenate([h, np.eye(3)], axis=1)
    precision = np.linalg.inv(prior) + observation_matrix.T @ np.diag(tau) @ observation_matrix
    posterior = np.linalg.inv(precision)
    shift = observation_matrix.T @ (nu - tau * (value - centre))
    result = multiply_by_factors(LinearisedObservation(jnp.asarray(value), jnp.asarray(h), jnp.asarray(omega)),
                              Factors(*map(jnp.asarray, (centre, nu, tau))), Moments(jnp.asarray(m), jnp.asarray(p)))
    np.testing.assert_allclose(result.moments.mean, m + (posterior @ shift)[:4], rtol=1e-8)
    np.testing.assert_allclose(result.moments.covariance, posterior[:4, :4], rtol=1e-8)
    residual = value - centre
    integral = (nu @ residual - 0.5 * residual @ (tau * residual) + 0.5 * shift @ posterior @ shift
                - 0.5 * np.linalg.slogdet(prior)[1] - 0.5 * np.linalg.slogdet(precision)[1])
    assert result.log_likelihood == pytest.approx(integral, rel=1e-6)


@pytest.mark.slow
def test_leave_one_out_terms_are_differences_of_evidences():
    """EP's own approximation of both; and one-step-ahead terms add up to nearly the evidence."""
    y = data("Poisson")
    distribution = likelihood("Poisson", THETA)
    without = y.copy()
    without[5] = np.nan
    log_prob = jax.jit(lambda y: distribution.log_prob(y))
    result = distribution.smooth(y)
    assert result.leave_one_out[5] == pytest.approx(float(log_prob(y) - log_prob(without)), abs=0.02)
    assert distribution.log_prob_per_observation(y).sum() == pytest.approx(float(log_prob(y)), abs=0.2)


@pytest.mark.slow
def test_factors_that_do_not_converge_are_minus_infinity_with_a_finite_gradient_and_a_warning():
    y = data("Student-t")
    short = FactorSettings(sweeps=2)
    with pytest.warns(lfm.FilterWarning):
        assert likelihood("Student-t", THETA, short).log_prob(y) == -np.inf
    value, gradient = jax.jit(jax.value_and_grad(lambda th: likelihood("Student-t", th, short).log_prob(y)))(THETA)
    assert value == -np.inf and np.all(gradient == 0.0)


INVERSE_LINKS = {"exp": np.log, "softplus": lambda rate: rate + np.log(-np.expm1(-rate)), "identity": lambda rate: rate}
LOG_RATES = {"exp": lambda f: f, "softplus": lambda f: np.log(np.logaddexp(0.0, f)),
             "identity": lambda f: np.log(np.maximum(f, 1e-300))}


def log_evidence_of_a_count(link, y, mean, sd):
    """Return log int N(f; mean, sd^2) Poisson(y; g(f)) df by Gauss-Legendre panels about the largest integrand."""

    def log_integrand(f):
        log_ratio = LOG_RATES[link](f) - np.log(max(y, 1.0))
        constant = -special.gammaln(y + 1.0) if y < 100 else -0.5 * np.log(2 * np.pi * y) - 1 / (12 * y) + 1 / (
            360 * y**3)
        count = (y * log_ratio + y * np.log(max(y, 1.0)) - np.exp(LOG_RATES[link](f)) if y < 100
                 else y * (log_ratio - np.expm1(log_ratio)))
        return np.where((f > 0) | (link != "identity"), constant + count, -np.inf) + stats.norm.logpdf(f, mean, sd)

    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        guess = INVERSE_LINKS[link](max(y, 0.7))
        low, high = min(mean, guess) - 40 * sd, max(mean, guess) + 40 * sd
        for _ in range(40):  # to where the integrand is not negligible
            grid = np.linspace(low, high, 2001)
            values = log_integrand(grid)
            rows = np.flatnonzero(values > values.max() - 50)
            low, high = grid[max(rows[0] - 1, 0)], grid[min(rows[-1] + 1, 2000)]
        edges = np.linspace(low, high, 2001)
        nodes, weights = np.polynomial.legendre.leggauss(8)
        half = 0.5 * np.diff(edges)[:, None]
        values = log_integrand(edges[:-1, None] + half * (1 + nodes))
        return values.max() + np.log((np.exp(values - values.max()) * weights * half).sum())


@pytest.mark.thorough
@pytest.mark.parametrize("link", INVERSE_LINKS)
def test_evidence_of_counts_of_any_size(link):
    """One count whose predictor has a prior near it or far off: value, and gradient by differences of the reference."""

    def log_prob(mean, sd, y):
        model = lfm.LatentForceModel(lambda x, u, t: 0.0 * x, {}, lfm.PoissonObservation(lambda x, u, t: x, link),
                                     lfm.Gaussian(mean[None], sd[None, None] ** 2))
        return lfm.MarginalLikelihood(model, np.zeros(1)).log_prob(y[None, None])

    cases = []
    # A predictor that may be negative has no density under the identity link.
    for y in (0.0, 3.0, 40.0, 3e7, 1e8, 1e12)[2 if link == "identity" else 0:]:
        centre, width = INVERSE_LINKS[link](max(y, 0.7)), 1.0 if link == "exp" else np.sqrt(max(y, 1.0))
        cases += [(centre - 0.5 * sd * width, sd * width, y) for sd in (1e-3, 0.3, 1.0)]
    cases += [(0.0, 3.0, 1e8), (17.92068, 1.0, 1e8), (60.0, 10.0, 1e8)] if link == "exp" else [(2e8, 3e7, 1e8)]
    mean, sd, y = map(jnp.asarray, np.transpose(cases))
    value, slope = jax.jit(jax.vmap(jax.value_and_grad(log_prob)))(mean, sd, y)
    step = 1e-4
    below, expected, above = (np.array([log_evidence_of_a_count(link, y, m + move * s, s) for m, s, y in cases])
                              for move in (-step, 0.0, step))
    # The quadrature of no counts, a step, is less accurate.
    np.testing.assert_array_less(np.abs(value - expected), np.where(y > 0, 3e-8, 1e-6))
    np.testing.assert_allclose(slope * sd, (above - below) / (2 * step), rtol=1e-5, atol=1e-5)


@pytest.mark.thorough
def test_a_series_of_large_counts():
    """Two scales of counts of one force: the evidence of 1e8 counts is that of Gaussian logarithms, to O(1e-8)."""
    times, rng = np.linspace(0.0, 3.0, 8), np.random.default_rng(0)
    y = rng.poisson(1e8 * np.exp(np.sin(times)))[:, None].astype(float)

    def likelihood(observation):
        model = lfm.LatentForceModel(lambda x, u, t: jnp.zeros(0), {"u": lfm.Matern(1.0, 1.0)}, observation,
                                     lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))
        return lfm.MarginalLikelihood(model, times)

    counts = likelihood(lfm.PoissonObservation(lambda x, u, t: u + np.log(1e8))).log_prob(y)
    gaussian = likelihood(lfm.GaussianObservation(lambda x, u, t: u, 1.0 / y[:, :, None])).log_prob(np.log(y / 1e8))
    np.testing.assert_allclose(counts, gaussian - np.log(y).sum(), atol=1e-5)


def test_settings_of_the_factors_are_checked():
    for settings, name in (("expectation", "expectation"), (FactorSettings(power=0.0), "power"),
                           (FactorSettings("laplace", power=0.5), "power")):
        with pytest.raises(ValueError, match=name):
            likelihood("Poisson", THETA, settings)
    with pytest.raises(ValueError, match="factors"):
        lfm.MarginalLikelihood(process(lfm.GaussianObservation(force, jnp.ones(1))), TIMES, factors="ep")


def pushed(theta):
    """Counts of a state whose production is softplus of a force."""
    return lfm.LatentForceModel(
        lambda x, u, t: jnp.exp(theta[1]) * (jax.nn.softplus(u) - 0.5 * x), {"u": lfm.Matern(jnp.exp(theta[0]), 2.0)},
        lfm.PoissonObservation(lambda x, u, t: x, "softplus", exposure=jnp.exp(theta[2])),
        lfm.Gaussian(jnp.ones(1), 0.1 * jnp.eye(1)))


AT_ONCE, ONE_AFTER_ANOTHER = (np.repeat(np.arange(1.0, 3.0), 2) + np.tile([0.0, lag], 2) for lag in (0.0, 1e-9))
COUNTS = np.array([1.0, 2.0, 0.0, 3.0])[:, None]


@pytest.mark.slow
def test_replicates_with_steps_that_follow_a_tolerance():
    """Smoothed moments equal the moments of counts that follow each other at once."""
    result, expected = (lfm.smooth(pushed(THETA), times, COUNTS, lfm.Taylor(), tolerance=1e-2)
                       for times in (AT_ONCE, ONE_AFTER_ANOTHER))
    np.testing.assert_allclose(result.input_mean, expected.input_mean, rtol=1e-6)
    np.testing.assert_allclose(result.input_covariance, expected.input_covariance, rtol=1e-6)


HOPELESS = FactorSettings(sweeps=1, relinearisations=2)
"""With which factors do not converge."""


@pytest.mark.slow
def test_factors_that_do_not_converge_leave_assumed_density_filtering_to_a_model_that_is_not_linear():
    """Value and gradient."""
    theta, y = jnp.array([0.0, 0.0, 1.5]), np.array([[3.0], [5.0], [4.0], [np.nan], [1.0], [2.0]])

    def distribution(th):
        return lfm.MarginalLikelihood(pushed(th), TIMES[:6], steps=1, factors=HOPELESS)

    evaluate = jax.jit(jax.value_and_grad(lambda th: distribution(th).log_prob(y)))
    value, gradient = evaluate(theta)
    assert value == pytest.approx(float(distribution(theta).log_prob_per_observation(y).sum()), abs=1e-10)
    np.testing.assert_allclose(gradient, differences(lambda th: evaluate(th)[0], theta), atol=1e-6)


@pytest.mark.slow
def test_factors_that_do_not_converge_are_told_and_leave_nearly_the_same_force():
    theta = jnp.array([0.0, 0.0, 1.5])
    y = lfm.simulate(jax.random.key(1), pushed(theta), TIMES).y
    with pytest.warns(lfm.FilterWarning):
        smoothed = lfm.smooth(pushed(theta), TIMES, y, steps=2, factors=HOPELESS)
    assert not smoothed.converged
    assert np.linalg.eigvalsh(smoothed.covariance).min() > -1e-12
    np.testing.assert_array_equal(smoothed.leave_one_out, smoothed.log_likelihood)
    right = lfm.smooth(pushed(theta), TIMES, y, steps=2)
    assert right.converged
    deviation = np.abs(np.asarray(smoothed.force("u").mean - right.force("u").mean)) / np.asarray(right.force("u").sd)
    assert deviation.max() < 0.5


@pytest.mark.slow
def test_assumed_density_filtering_is_a_density_of_several_entries_a_row():
    """Of two rows of two correlated answers the probabilities of all sixteen add up to one."""
    model = process(lfm.BernoulliObservation(lambda x, u, t: jnp.concatenate([2.0 * u, 0.5 - 3.0 * u])))
    distribution = lfm.MarginalLikelihood(model, np.array([0.0, 0.7]))
    records = np.array(list(itertools.product([0.0, 1.0], repeat=4))).reshape(16, 2, 2)
    log_prob = jax.vmap(lambda y: distribution.log_prob_per_observation(y).sum())(records)
    assert float(jnp.exp(log_prob).sum()) == pytest.approx(1.0, abs=1e-7)


def test_assumed_density_filtering_of_gaussian_entries_is_the_kalman_filter():
    """Entries one after the other are all entries at once, with a missing one, too."""
    y = np.random.default_rng(0).normal(size=(TIMES.size, 2))
    y[3, 0] = y[7] = np.nan
    gaussian = lfm.GaussianObservation(lambda x, u, t: jnp.concatenate([u, 0.3 - 2.0 * u]), jnp.array([0.04, 0.3]))
    exact, assumed = (lfm.filter(process(observation), TIMES, y)
                      for observation in (gaussian, lfm.Observations(gaussian)))
    np.testing.assert_allclose(assumed.log_likelihood, exact.log_likelihood, atol=1e-8)
    # The residuals are normal quantiles of these probabilities, and lose digits beyond four standard deviations.
    probabilities = (stats.norm.cdf(result.whitened_innovation[:, 0]) for result in (assumed, exact))
    np.testing.assert_allclose(*probabilities, atol=1e-8)
    np.testing.assert_allclose(assumed.filtered_mean, exact.filtered_mean, atol=1e-8)
    np.testing.assert_allclose(assumed.filtered_covariance, exact.filtered_covariance, atol=1e-8)


@pytest.mark.slow
def test_non_linear_dynamics_against_particles_and_differences():
    theta = jnp.array([0.0, 0.0, 1.5])
    y = lfm.simulate(jax.random.key(1), pushed(theta), TIMES).y
    log_prob = jax.jit(lambda th: lfm.MarginalLikelihood(pushed(th), TIMES, steps=4).log_prob(y))
    gradient = jax.jit(jax.grad(lambda th: lfm.MarginalLikelihood(pushed(th), TIMES, steps=4).log_prob(y)))(theta)
    np.testing.assert_allclose(gradient, differences(log_prob, theta), atol=1e-6)
    runs = [float(lfm.particle_filter(jax.random.key(k), pushed(theta), TIMES, y, particles=20_000, steps=8
                                      ).log_likelihood.sum()) for k in range(8)]
    assert abs(float(log_prob(theta)) - np.mean(runs)) < 0.2 + 4 * np.std(runs) / np.sqrt(8)


@pytest.mark.slow
def test_weighted_draws_of_the_smoother_estimate_the_evidence():
    """Against importance sampling by dense algebra, to five standard errors of both; also with negative precisions."""
    y = data("Student-t")
    distribution = likelihood("Student-t", THETA)
    run = jax.jit(lambda key: importance_weights(distribution.problem, jnp.asarray(y), key, 20_000, FactorSettings()))
    log_weights = np.asarray(run(jax.random.key(0)))
    result = distribution.smooth(y)
    cov = np.cov(np.asarray(result.sample(jax.random.key(0), 4000).forces["u"]).T) * 1.1
    log_z, error, *_ = importance("Student-t", y, np.asarray(result.force("u").mean), cov)
    weight = np.exp(log_weights - log_weights.max())
    relative_error = weight.std() / weight.mean() / np.sqrt(weight.size)
    assert relative_error < 0.02
    assert abs(log_weights.max() + np.log(weight.mean()) - log_z) < 5 * np.hypot(relative_error, error)


@pytest.mark.slow
def test_a_gap_leaves_the_gradient_of_a_bounded_law_alone():
    times, y = np.arange(4.0), np.array([[0.4], [np.nan], [0.7], [0.2]])

    def evidence(level):
        observation = lfm.DistributionObservation(lambda x, u, t: u + level, lambda f: dist.TransformedDistribution(
            dist.Normal(f, 0.7), dist.transforms.SigmoidTransform()))  # no density at 1
        return lfm.MarginalLikelihood(process(observation), times).log_prob(y)

    evaluate = jax.jit(jax.value_and_grad(evidence))
    step = 1e-5
    slope = (evaluate(step)[0] - evaluate(-step)[0]) / (2 * step)
    assert float(evaluate(0.0)[1]) == pytest.approx(float(slope), rel=1e-6)


@pytest.mark.slow
def test_residuals_are_standard_normal_and_white_where_the_model_holds():
    family = FAMILIES["negative binomial"][0](THETA)
    times = np.linspace(0.0, 300.0, 750)
    scale, lengthscale = np.exp(THETA[:2]) * np.array([1.0, 1.3])
    kernel = matern(scale, lengthscale, 1)(times[:, None], times)
    f = np.linalg.cholesky(kernel + 1e-10 * np.eye(750)) @ np.random.default_rng(3).normal(size=750)
    y = family.sample(jax.random.key(0), jnp.asarray(f))[:, None]
    residual = np.asarray(lfm.filter(process(family, scale, lengthscale), times, y).whitened_innovation)[:, 0]
    assert stats.kstest(residual, "norm").pvalue > 0.01
    assert abs(residual.var() - 1) < 3 * np.sqrt(2 / residual.size)
    assert abs(np.mean(residual[1:] * residual[:-1])) < 3 / np.sqrt(residual.size)


@pytest.mark.slow
def test_the_gradient_where_points_of_linearisation_depend_on_factors_of_data_that_are_far_off():
    """Half of the nodes in the sweeps that choose the points made it wrong by one in a hundred."""
    rng = np.random.default_rng(0)
    times = np.sort(np.r_[0.0, 0.0, np.linspace(0.0, 8.0, 18), 3.0, 3.0])
    y = np.c_[rng.poisson(2.0, times.size).astype(float), rng.normal(size=times.size)]
    y[3, 0] = y[5, 0] = y[5, 1] = y[7, 1] = np.nan
    y[10, 1] = 25.0
    pushed = lfm.Input(np.linspace(0.0, 8.0, 30), np.sin(np.linspace(0.0, 8.0, 30)), "linear")

    def evidence(theta):
        observation = lfm.Observations(lfm.PoissonObservation(lambda x, u, t: u + theta[2]),
                                       lfm.StudentTObservation(lambda x, u, t: x[:1], 3.0, 0.2 * jnp.exp(theta[2])))
        model = lfm.LatentForceModel(
            lambda x, u, t: jnp.exp(u) * jnp.exp(theta[2]) - 0.7 * x - 0.2 * x**3 + pushed(t),
            {"u": lfm.Matern(jnp.exp(theta[0]), 1.3 * jnp.exp(theta[1]))}, observation,
            lfm.Gaussian(jnp.zeros(1), jnp.array([[0.5]])))
        return lfm.MarginalLikelihood(model, times, steps=2).log_prob(y)

    evaluate, step = jax.jit(jax.value_and_grad(evidence)), 2e-4
    slopes = [(evaluate(THETA + step * unit)[0] - evaluate(THETA - step * unit)[0]) / (2 * step) for unit in np.eye(3)]
    # The quadrature leaves 1.2e-4; with twice as many nodes it is 1e-8.
    np.testing.assert_allclose(evaluate(THETA)[1], slopes, rtol=0.0, atol=2e-4 * np.abs(slopes).max())
