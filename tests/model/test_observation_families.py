"""Observation families: densities against SciPy, draws against densities, and errors of data and parameters."""

import math
from decimal import Decimal, localcontext

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from scipy import special, stats

import lfm_ppl as lfm
from lfm_ppl.model.observations.links import PROBABILITIES, RATES

PREDICTOR = np.array([0.3, -1.0, 0.9])
COUNTS = np.array([0.0, 3.0, 7.0])


def state(x, u, t):
    return x


def censored(y, f):
    """Left at 0, right at 5, noise 0.5."""
    return np.where(y <= 0.0, stats.norm.logcdf(0.0, f, 0.5),
                    np.where(y >= 5.0, stats.norm.logsf(5.0, f, 0.5), stats.norm.logpdf(y, f, 0.5)))


def binned(y, f):
    return np.log(stats.norm.cdf(y + 0.5, f, 0.5) - stats.norm.cdf(y - 0.5, f, 0.5))


CASES = {
    "Poisson": (lfm.PoissonObservation(state, exposure=2.0), COUNTS,
                lambda y, f: stats.poisson.logpmf(y, 2 * np.exp(f))),
    "Poisson, softplus": (lfm.PoissonObservation(state, "softplus"), COUNTS,
                          lambda y, f: stats.poisson.logpmf(y, np.log1p(np.exp(f)))),
    "negative binomial": (lfm.NegativeBinomialObservation(state, 2.5), COUNTS,
                          lambda y, f: stats.nbinom.logpmf(y, 2.5, 2.5 / (2.5 + np.exp(f)))),
    "binomial": (lfm.BinomialObservation(state, 9), COUNTS, lambda y, f: stats.binom.logpmf(y, 9, special.expit(f))),
    "Bernoulli": (lfm.BernoulliObservation(state), np.array([0.0, 1.0, 1.0]),
                  lambda y, f: stats.bernoulli.logpmf(y.astype(int), special.expit(f))),
    "Bernoulli, probit": (lfm.BernoulliObservation(state, "probit"), np.array([0.0, 1.0, 1.0]),
                          lambda y, f: stats.bernoulli.logpmf(y.astype(int), stats.norm.cdf(f))),
    "Student-t": (lfm.StudentTObservation(state, 4.0, 0.5), COUNTS, lambda y, f: stats.t.logpdf(y, 4.0, f, 0.5)),
    "censored": (lfm.CensoredObservation(state, 0.5, left=0.0, right=5.0), np.array([0.0, 0.8, 5.0]), censored),
    "binned": (lfm.CensoredObservation(state, 0.5, width=1.0), np.array([0.0, -1.0, 3.0]), binned),
    "any distribution": (lfm.DistributionObservation(state, lambda f: dist.Geometric(logits=f)), COUNTS,
                         lambda y, f: stats.geom.logpmf(y + 1, special.expit(f))),
}

VALUES = {
    "censored": (np.linspace(0.0, 5.0, 100_001), np.r_[1.0, np.full(99_999, 5.0 / 100_000), 1.0]),
}
"""Where the density of a case is summed, and what each value counts for, unless its data are whole numbers."""
WHOLE = np.arange(-10.0, 400.0), np.ones(410)


def test_every_public_family_is_among_the_cases():
    public = {name: getattr(lfm, name) for name in lfm.__all__}
    kinds = {name for name, cls in public.items() if isinstance(cls, type) and issubclass(cls, lfm.ObservationFamily)}
    missing = kinds - {type(family).__name__ for family, *_ in CASES.values()} - {"ObservationFamily", "Observations"}
    assert not missing, f"add a line to CASES in this file for {missing}"


@pytest.mark.parametrize("name", CASES)
def test_log_prob(name):
    family, y, expected = CASES[name]
    np.testing.assert_allclose(family.log_prob(jnp.asarray(PREDICTOR), jnp.asarray(y)), expected(y, PREDICTOR),
                               rtol=1e-11)


def log_factorial(n):
    """Return log n! of a large number, with sixty digits."""
    n = Decimal(n)
    return n * n.ln() - n + (2 * Decimal(f"{math.pi:.60f}") * n).ln() / 2 + 1 / (12 * n) - 1 / (360 * n**3)


@pytest.mark.parametrize("y", [3e7, 1e8, 1e12])
@pytest.mark.parametrize("distance", [-2.0, 0.0, 0.7])
def test_log_prob_of_large_counts(y, distance):
    """In exact arithmetic at a predictor some standard deviations from the count; it may be rounded by an ulp."""
    with localcontext(prec=60):
        count, concentration, trials = Decimal(y), Decimal(y / 4), Decimal(4 * y)
        f = np.log(y) + distance / np.sqrt(y)
        mean = Decimal(f).exp()
        poisson = count * Decimal(f) - mean - log_factorial(y)
        overdispersed = (log_factorial(y + y / 4 - 1) - log_factorial(y / 4 - 1) - log_factorial(y)
                         + concentration * (concentration / (concentration + mean)).ln()
                         + count * (mean / (concentration + mean)).ln())
        logit = np.log(1 / 3) + distance / np.sqrt(y)
        share = 1 / (1 + (-Decimal(logit)).exp())
        binomial = (log_factorial(4 * y) - log_factorial(y) - log_factorial(3 * y) + count * share.ln()
                    + (trials - count) * (1 - share).ln())
    rounding = 1e-11 + 4e-15 * np.log(y) * np.sqrt(y) * abs(distance)
    for family, predictor, expected in (
            (lfm.PoissonObservation(state), f, poisson), (lfm.PoissonObservation(state, "identity"), np.exp(f), None),
            (lfm.NegativeBinomialObservation(state, y / 4), f, overdispersed),
            (lfm.BinomialObservation(state, 4 * y), logit, binomial)):
        value = float(family.log_prob(jnp.array([predictor]), jnp.array([y]))[0])
        assert abs(value - float(expected or poisson)) < rounding, type(family).__name__


@pytest.mark.parametrize("name", [name for name in CASES if "Student" not in name])
def test_draws_have_these_densities(name):
    """Mean and variance of 20,000 draws against the moments of the density, to five standard errors."""
    family, _, log_prob = CASES[name]
    draws = np.asarray(jax.vmap(lambda key: family.sample(key, jnp.asarray(PREDICTOR)))(
        jax.random.split(jax.random.key(0), 20_000)))
    values, weight = VALUES.get(name, WHOLE)
    with np.errstate(divide="ignore"):
        probability = np.nan_to_num(np.exp(log_prob(values[:, None], PREDICTOR))) * weight[:, None]
    mean = (probability * values[:, None]).sum(0)
    if name not in ("censored", "binned"):
        np.testing.assert_allclose(family.mean(jnp.asarray(PREDICTOR)), mean, rtol=1e-6, atol=1e-9)
    central = [(probability * (values[:, None] - mean) ** power).sum(0) for power in (2, 4)]
    assert np.all(np.abs(draws.mean(0) - mean) < 5 * np.sqrt(central[0] / len(draws)))
    error = np.sqrt((central[1] - central[0] ** 2) / len(draws))
    assert np.all(np.abs(draws.var(0) - central[0]) < 5 * error + 1e-3 * central[0])


@pytest.mark.parametrize("name", [name for name in CASES if name != "any distribution"])
def test_cumulative_probabilities_are_sums_of_the_densities(name):
    family, y, log_prob = CASES[name]
    below, up_to = family.cumulative(jnp.asarray(PREDICTOR), jnp.asarray(y))
    if name == "Student-t":
        expected = stats.t.cdf(y, 4.0, PREDICTOR, 0.5)
        np.testing.assert_allclose([below, up_to], [expected, expected], rtol=1e-10)
        return
    values, weight = VALUES.get(name, WHOLE)
    with np.errstate(divide="ignore"):
        probability = np.nan_to_num(np.exp(log_prob(values[:, None], PREDICTOR))) * weight[:, None]
    tolerance = 1e-5 if name == "censored" else 1e-9  # of a Riemann sum
    np.testing.assert_allclose(below, (probability * (values[:, None] < y - 1e-9)).sum(0), atol=tolerance)
    np.testing.assert_allclose(up_to, (probability * (values[:, None] <= y + 1e-9)).sum(0), atol=tolerance)


def test_a_family_without_cumulative_probabilities_has_none():
    family = lfm.DistributionObservation(state, lambda f: dist.ZeroInflatedPoisson(0.5, jnp.exp(f)))
    assert np.isnan(family.cumulative(jnp.zeros(2), jnp.ones(2))).all()
    count = lfm.DistributionObservation(state, lambda f: dist.Poisson(jnp.exp(f))).cumulative(jnp.zeros(1), jnp.ones(1))
    np.testing.assert_allclose(np.ravel(count), stats.poisson.cdf([0, 1], 1.0))
    gamma = lfm.DistributionObservation(state, lambda f: dist.Gamma(2.0, jnp.exp(f)))
    size = gamma.cumulative(jnp.zeros(1), jnp.ones(1))
    np.testing.assert_allclose(np.ravel(size), stats.gamma.cdf([1, 1], 2.0))
    for concentration in (3e7, 3e8, 1e200):
        limit = lfm.NegativeBinomialObservation(state, concentration).cumulative(jnp.zeros(1), jnp.ones(1))
        np.testing.assert_allclose(np.ravel(limit), stats.poisson.cdf([0, 1], 1.0), rtol=1e-7)


@pytest.mark.parametrize("f", [-800.0, -40.0, 0.0, 40.0])
def test_links_neither_underflow_nor_lose_their_derivatives(f):
    for _, log_rate in (RATES["softplus"], RATES["exp"]):
        assert np.isfinite(log_rate(f)) and np.isfinite(jax.grad(log_rate)(f))
    for name in ("logit", "probit"):
        for log_probability in PROBABILITIES[name]:
            value = log_probability(jnp.asarray(f))
            assert np.isfinite(value) and value <= 0.0 and np.isfinite(jax.grad(log_probability)(f))


def model(observation, mean=0.0):
    return lfm.LatentForceModel(lambda x, u, t: -x, {}, observation, lfm.Gaussian(mean * jnp.ones(2), jnp.eye(2)))


GAUSSIAN = lfm.GaussianObservation(state, jnp.ones(2))
BOTH = lfm.Observations(GAUSSIAN, lfm.BernoulliObservation(state))


@pytest.mark.parametrize("family, row, message", [
    (lfm.PoissonObservation(state), [1.0, -1.0], r"y\[1, 1\] \(y1, row 2 of the data\) is -1, but Poisson.*y0, y1"),
    (lfm.NegativeBinomialObservation(state, 2.0), [1.0, 0.5], r"y\[1, 1\] .* is 0.5, but NegativeBinomial"),
    (lfm.BinomialObservation(state, 4), [1.0, 5.0], r"y\[1, 1\] .* is 5, but Binomial"),
    (lfm.BernoulliObservation(state), [1.0, 2.0], r"y\[1, 1\] .* is 2, but Bernoulli"),
    (lfm.DistributionObservation(state, lambda f: dist.Poisson(jnp.exp(f))), [1.0, -2.0],
     r"y\[1, 1\] .* is -2, but the dist"),
    (BOTH, [0.3, -2.0, 1.0, 0.5], r"y\[1, 3\] \(y3, row 2 of the data\) is 0.5, but Bernoulli"),
])
def test_impossible_data_are_errors_that_name_row_and_column(family, row, message):
    y = np.array([np.full(len(row), np.nan), row])
    for call in (lambda: lfm.filter(model(family), [0.0, 1.0], y),
                 lambda: lfm.MarginalLikelihood(model(family), [0.0, 1.0]).log_prob(y)):
        with pytest.raises(ValueError, match=message):
            call()


@pytest.mark.parametrize("make, message", [
    (lambda: lfm.StudentTObservation(state, 0.0, 1.0), "df must be"),
    (lambda: lfm.StudentTObservation(state, 4.0, -1.0), "scale must be"),
    (lambda: lfm.NegativeBinomialObservation(state, [1.0, -1.0]), "concentration must be"),
    (lambda: lfm.PoissonObservation(state, "log"), "unknown link 'log'.*Known: exp, softplus, identity"),
    (lambda: lfm.CensoredObservation(state, 1.0, left=2.0, right=1.0), "left must lie below right"),
    (lambda: model(lfm.PoissonObservation(state, exposure=np.ones(3))), r"exposure of PoissonObservation .*\(2,\)"),
    (lambda: lfm.filter(model(lfm.PoissonObservation(state, exposure=np.ones((3, 2)))), [0.0], [[1.0, 1.0]]),
     "exposure of PoissonObservation has 3 rows"),
    (lambda: model(lfm.PoissonObservation(lambda x, u, t: x[0])), "must return a vector"),
    (lambda: model(lfm.PoissonObservation(state), mean=800.0), "output 'y0' is not finite at the prior"),
    (lambda: model(lfm.DistributionObservation(state, lambda f: dist.Poisson(1.0))), r"batch shape \(2,\)"),
    (lambda: lfm.Observations(lfm.GaussianObservation(state, jnp.eye(2))), "Gaussian and needs sd"),
])
def test_errors(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.thorough
def test_simulation_draws_from_the_family():
    observations = lfm.Observations(lfm.PoissonObservation(lambda x, u, t: x[:1]),
                                    lfm.BernoulliObservation(lambda x, u, t: x))
    y = np.asarray(lfm.simulate(jax.random.key(0), model(observations), np.arange(4.0)).y)
    assert y.shape == (4, 3) and np.all(y == np.round(y)) and np.isin(y[:, 1:], (0.0, 1.0)).all()


def test_a_particle_filter_weighs_with_the_family():
    """One observation of a known predictor: the estimate is its probability."""
    known_model = lfm.LatentForceModel(lambda x, u, t: -x, {}, lfm.PoissonObservation(state),
                                       lfm.Gaussian(jnp.array([0.7]), jnp.zeros((1, 1))))
    result = lfm.particle_filter(jax.random.key(0), known_model, [0.0], [[3.0]], particles=10)
    assert result.log_likelihood[0] == pytest.approx(stats.poisson.logpmf(3, np.exp(0.7)), abs=1e-12)
    filtered = lfm.filter(known_model, [0.0], [[3.0]]).log_likelihood[0]
    assert filtered == pytest.approx(float(result.log_likelihood[0]), abs=1e-7)


def test_probabilities_outside_of_the_unit_interval_have_no_density():
    family = lfm.BernoulliObservation(lambda x, u, t: x, link="identity")
    result = family.log_prob(jnp.array([-3.0, 0.25, 1.5]), jnp.array([0.0, 1.0, 1.0]))
    np.testing.assert_allclose(result, [-np.inf, np.log(0.25), -np.inf])


@pytest.mark.parametrize(("family", "slope"), [
    (lfm.PoissonObservation(state, "identity", exposure=2.0), -2.0),
    (lfm.NegativeBinomialObservation(state, 3.0, "identity", exposure=2.0), -2.0)])
def test_at_rate_zero_the_count_is_zero(family, slope):
    f, y = jnp.array([0.0, 0.0, -0.1, -0.1]), jnp.array([0.0, 2.0, 0.0, 2.0])
    np.testing.assert_array_equal(family.log_prob(f, y), [0.0, -np.inf, -np.inf, -np.inf])
    gradient = jax.grad(lambda f: jnp.where(jnp.isfinite(family.log_prob(f, y)), family.log_prob(f, y), 0.0).sum())(f)
    np.testing.assert_allclose(gradient, [slope, 0.0, 0.0, 0.0])
    assert float(family.log_prob(jnp.array([1e-9]), jnp.zeros(1))[0]) == pytest.approx(-2e-9)


@pytest.mark.thorough
def test_limits_of_rounded_values_leave_nothing_out():
    family = lfm.CensoredObservation(lambda x, u, t: x, sd=1.0, left=0.0, width=1.0)
    values = jnp.arange(0.0, 12.0)
    total = jax.vmap(lambda y: family.log_prob(jnp.array([0.3]), y[None])[0])(values)
    assert float(jnp.exp(total).sum()) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("concentration", [3.0, 1e4, 1e12, 1e15])
def test_a_large_concentration_is_a_poisson(concentration):
    family = lfm.NegativeBinomialObservation(lambda x, u, t: x, concentration)
    result = float(family.log_prob(jnp.array([0.5]), jnp.array([3.0]))[0])
    mean = np.exp(0.5)
    expected = stats.nbinom.logpmf(3, concentration, concentration / (concentration + mean)) \
        if concentration < 1e6 else stats.poisson.logpmf(3, mean)
    assert result == pytest.approx(expected, abs=1e-8)


def test_a_panel_checks_the_data_of_a_family():
    def build(rate):
        return lfm.LatentForceModel(lambda x, u, t: u - rate * x, {"u": lfm.Matern(1.0, 1.0)},
                                    lfm.PoissonObservation(lambda x, u, t: x), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))

    panel = lfm.panel(build, jnp.array([1.0, 2.0]), np.arange(3.0))
    with pytest.raises(ValueError, match=r"series 1: y\[2, 0\] \(y0, row 3 of the data\) is -2.5"):
        panel.checked(np.array([[[1.0], [0.0], [2.0]], [[1.0], [np.nan], [-2.5]]]))
