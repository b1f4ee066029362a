"""Smoothed covariances of expectation propagation are those of its linear response, and near the exact ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from references import matern
from scipy import stats

import lfm_ppl as lfm
from lfm_ppl.filtering.linear_response import LARGEST_STATE
from lfm_ppl.filtering.quadrature import Marginal, tilted_shape

EP_ONLY = lfm.SiteSettings(linear_response=False)
TIMES = np.array([0.5, 1.0, 1.0, 2.0, 2.5, 3.5, 4.0, 5.0])  # replicates
AT = np.array([0.0, 0.7, 1.0, 3.0, 5.0, 6.0])  # the initial time, between the data, on them, a forecast


class Source(lfm.model.observations.family.ObservationFamily):
    """The factor exp(y f): a linear source of strength y."""

    def log_prob(self, predictor, y):
        return y * predictor

    def sample(self, key, predictor):
        return jnp.zeros_like(predictor)


def steady(x, u, t):
    return u - 0.8 * x


def varying(x, u, t):
    return u - (0.8 + 0.3 * jnp.sin(t)) * x


def parts():
    return (lfm.PoissonObservation(lambda x, u, t: 0.5 * u),
            lfm.StudentTObservation(lambda x, u, t: x + 0.2 * u, 4.0, 0.2))


def linear(observation, drift=steady):
    return lfm.LatentForceModel(drift, {"u": lfm.Matern(1.1, 1.4, order=1)}, observation,
                                lfm.Gaussian(jnp.array([0.3]), jnp.eye(1) * 0.2), initial_time=0.0)


def data(gross_error=4.0):
    rng = np.random.default_rng(0)
    y = np.stack([rng.poisson(1.5, TIMES.size), 0.5 * rng.normal(size=TIMES.size)], axis=1).astype(float)
    y[4, 1] += gross_error
    y[2, 0] = y[5, 1] = np.nan
    return y


def pulled(drift, at):
    """Smoothed means of (x, u) at the requested times, as a compiled function of the data and of sources (K, 2)."""
    both = np.concatenate([TIMES, at])
    order = np.argsort(both, kind="stable")
    rows = np.argsort(order)
    model = linear(lfm.Observations(*parts(), Source(lambda x, u, t: jnp.concatenate([x, u]))), drift)
    distribution = lfm.MarginalLikelihood(model, both[order])

    @jax.jit
    def means(y, source):
        whole = jnp.full((len(both), 4), jnp.nan).at[:, 2:].set(0.0).at[rows[:len(TIMES)], :2].set(y)
        whole = whole.at[rows[len(TIMES):], 2:].set(source)
        return distribution.smooth(whole).input_mean[rows[len(TIMES):]]

    return means


@pytest.mark.parametrize(("drift", "requested"), [
    (steady, True), *(pytest.param(varying, requested, marks=pytest.mark.slow) for requested in (True, False))])
def test_covariances_are_the_response_of_the_means_to_a_source(drift, requested):
    """A source at a state moves the smoothed means by its covariances: the engine's own fixed point, by differences."""
    at, model = AT if requested else TIMES, linear(lfm.Observations(*parts()), drift)
    means, h = pulled(drift, at), 1e-2
    smooth = jax.jit(lambda y, settings: lfm.smooth(model, TIMES, y, at=AT if requested else None, sites=settings),
                     static_argnums=1)
    for y in (data(0.0), data(4.0)):
        found, held = smooth(y, None), smooth(y, EP_ONLY)
        for k in range(len(at)):
            for c in range(2):
                e = np.zeros((len(at), 2))
                e[k, c] = h
                slope = (8 * (means(y, e) - means(y, -e)) - means(y, 2 * e) + means(y, -2 * e)) / (12 * h)
                np.testing.assert_allclose(found.input_covariance[k][:, c], slope[k], rtol=3e-5)
        np.testing.assert_allclose(found.input_mean, held.input_mean, atol=1e-12)
        assert np.abs(found.force("u").sd / held.force("u").sd - 1).max() > 0.005, "it is no small change"


@pytest.mark.slow
def test_draws_have_the_covariances_of_the_result():
    result = lfm.smooth(linear(lfm.Observations(*parts())), TIMES, data(), at=AT)
    drawn = np.asarray(result.sample_joint(jax.random.key(0), 40_000))
    for k in range(len(AT)):
        sd = np.sqrt(np.diag(result.covariance[k]))
        found = np.cov(drawn[:, k].T) / np.outer(sd, sd)
        np.testing.assert_allclose(found, result.covariance[k] / np.outer(sd, sd), atol=0.025)


@pytest.mark.slow
@pytest.mark.parametrize("settings", [lfm.SiteSettings(power=0.5), lfm.SiteSettings("variational")])
def test_it_is_of_expectation_propagation_of_any_power(settings):
    """Power EP responds as its own fixed point does; other methods keep the covariance of the Gaussian."""
    k = matern(1.1, 1.4, 1)(TIMES[:, None], TIMES)
    model = lfm.LatentForceModel(
        lambda x, u, t: jnp.zeros(0), {"u": lfm.Matern(1.1, 1.4)}, lfm.PoissonObservation(lambda x, u, t: u),
        lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))
    y = data()[:, :1]
    variances = [np.asarray(lfm.smooth(model, TIMES, y, sites=one).force("u").sd) ** 2
                 for one in (settings, settings._replace(linear_response=False))]
    if settings.method != "ep":
        np.testing.assert_array_equal(*variances)
        return
    # With 1/2 the tilted distribution is nearer a Gaussian, and errors of sites count twice: the exact one is near.
    white = np.random.default_rng(1).normal(size=(400_000, TIMES.size))
    u = white @ np.linalg.cholesky(k + 1e-10 * np.eye(len(k))).T
    log_weight = np.nansum(stats.poisson.logpmf(y[:, 0], np.exp(u)), axis=1)
    weight = np.exp(log_weight - log_weight.max())
    mean = weight @ u / weight.sum()
    exact = weight @ (u - mean) ** 2 / weight.sum()
    wrong = [np.sqrt(np.mean((v / exact - 1) ** 2)) for v in variances]
    assert wrong[0] < 0.01 < wrong[1]


@pytest.mark.slow
def test_gaussian_sites_do_not_respond():
    gaussian = lfm.GaussianObservation(lambda x, u, t: jnp.concatenate([x, u]), jnp.array([0.1, 0.2]))
    y = np.random.default_rng(0).normal(size=(TIMES.size, 2))
    plain = lfm.smooth(linear(gaussian), TIMES, y)
    wrapped = lfm.smooth(linear(lfm.Observations(gaussian)), TIMES, y)
    np.testing.assert_allclose(wrapped.covariance, plain.covariance, atol=1e-10)


@pytest.mark.slow
def test_sites_that_have_not_converged_have_no_response():
    model, sites = linear(lfm.Observations(*parts())), lfm.SiteSettings(sweeps=1)
    with pytest.warns(lfm.FilterWarning):
        found = lfm.smooth(model, TIMES, data(), sites=sites)
    with pytest.warns(lfm.FilterWarning):
        held = lfm.smooth(model, TIMES, data(), sites=sites._replace(linear_response=False))
    assert not found.converged
    np.testing.assert_allclose(found.covariance, held.covariance, rtol=1e-12)


@pytest.mark.parametrize("known", [0.0, pytest.param(1e-12, marks=pytest.mark.slow)])
def test_known_starts_stay_known(known):
    """States that follow one force from a known start: a nearly singular covariance, and a response all the same."""
    model = lfm.LatentForceModel(
        lambda x, u, t: u - jnp.array([0.4, 0.5, 0.6]) * x, {"u": lfm.Matern(1.0, 2.0, order=1)},
        lfm.StudentTObservation(lambda x, u, t: x, 4.0, 0.1), lfm.Gaussian(jnp.zeros(3), known * jnp.eye(3)),
        initial_time=0.0)
    y = 0.3 * np.sin(TIMES)[:, None] + 0.05 * np.random.default_rng(0).normal(size=(TIMES.size, 3))
    y[3, 1] += 1.0
    at = np.concatenate([[0.0, 0.01, 0.1], TIMES[[0, 3]], [3.0]])
    found, held = (lfm.smooth(model, TIMES, y, at=at, sites=one) for one in (None, EP_ONLY))
    assert np.abs(found.input_covariance[0, :3, :3]).max() <= 2 * known
    assert 0.5 < np.min(found.force("u").sd / held.force("u").sd) < 0.999
    drawn = found.sample(jax.random.key(0), 20_000)
    np.testing.assert_allclose(np.std(drawn.forces["u"], axis=0), found.force("u").sd, rtol=0.025)


@pytest.mark.slow
@pytest.mark.parametrize("count", [LARGEST_STATE // 2, LARGEST_STATE // 2 + 1])
def test_models_of_many_states_keep_the_covariance_of_the_gaussian(count):
    model = lfm.LatentForceModel(
        lambda x, u, t: jnp.zeros(0), {f"u{i}": lfm.Matern(1.0, 1.0 + i, order=1) for i in range(count)},
        lfm.PoissonObservation(lambda x, u, t: u.sum()[None]), lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))
    y = np.random.default_rng(0).poisson(1.0, (3, 1)).astype(float)
    found, held = (lfm.smooth(model, np.arange(3.0), y, sites=one) for one in (None, EP_ONLY))
    assert np.array_equal(found.covariance, held.covariance) == (lfm.state_space(model).state_dim > LARGEST_STATE)


@pytest.mark.slow
def test_a_row_with_two_modes_leaves_the_others_as_they_are():
    """A record whose variances would change by more than a factor of four, long after one that responds."""
    model = lfm.LatentForceModel(
        lambda x, u, t: jnp.zeros(0), {"u": lfm.Matern(1.0, 2.0, order=1)},
        lfm.StudentTObservation(lambda x, u, t: u, 2.0, 0.1), lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))
    good = np.array([0.1, 0.2, 0.9, 0.3, 0.2, 0.1])
    bad = np.array([0.081, 0.158, -0.47, 2.314, 1.071, -0.186])
    times = np.arange(6.0)
    alone = [lfm.smooth(model, times, good, sites=one).force("u").sd for one in (None, EP_ONLY)]
    both = [lfm.smooth(model, np.append(times, times + 200.0), np.append(good, bad), sites=one).force("u").sd
            for one in (None, EP_ONLY)]
    np.testing.assert_allclose(both[0][:6], alone[0], rtol=1e-5)
    assert np.abs(alone[0] / alone[1] - 1).max() > 0.002
    kept = np.asarray(both[0][6:] == both[1][6:])
    assert kept.any() and np.all((both[0] / both[1] > 0.5) & (both[0] / both[1] < 2.0))


def test_shape_of_a_tilted_distribution():
    """Gamma distributions of log-counts have known cumulants: the family exp(a f - e^f) times a flat cavity."""
    a = np.array([0.7, 3.0, 20.0])
    near = Marginal(jnp.asarray(stats.loggamma(a).mean()), jnp.asarray(stats.loggamma(a).var()))
    flat = Marginal(jnp.zeros(3), jnp.full(3, 1e12))
    skewness, kurtosis = tilted_shape(lambda f: a * f - jnp.exp(f), flat, near)
    wanted = [stats.loggamma.stats(one, moments="sk") for one in a]
    np.testing.assert_allclose(np.stack([skewness, kurtosis], axis=1), np.array(wanted, float), rtol=1e-5, atol=1e-6)
