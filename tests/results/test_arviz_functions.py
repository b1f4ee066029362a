"""ArviZ's functions on results with missing entries, of panels, of several sites and of counts."""

import warnings

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

import lfm_ppl as lfm
from lfm_ppl.results.result_view import ResultView
from tests.arviz_checks import check_arviz

TIMES = np.tile(0.3 * np.arange(6.0), (3, 1))
Y = (np.exp(-TIMES) + 0.1 * np.random.default_rng(0).normal(size=TIMES.shape))[..., None]


def build(rate, gain=(1.0,)):
    gain = jnp.array(gain)
    return lfm.LatentForceModel(
        lambda x, u, t: u - rate * x, {"u": lfm.Matern(0.2, 1.0, order=0)},
        lfm.GaussianObservation(lambda x, u, t: gain * x[0], covariance=0.01 * jnp.eye(len(gain)) + 0.005),
        lfm.Gaussian(jnp.ones(1), 0.01 * jnp.eye(1)))


def panel(times, y=None):
    with numpyro.plate("subject", len(times)):
        rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.5))
        numpyro.sample("y", lfm.panel(build, rate, times), obs=y)


def single_and_panel(times, y):
    shared = numpyro.sample("shared", dist.LogNormal(0.0, 0.5))
    numpyro.sample("one", lfm.MarginalLikelihood(build(shared, (1.0, 2.0)), times["one"]), obs=y["one"])
    with numpyro.plate("subject", len(times["many"])):
        rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.5))
        numpyro.sample("many", lfm.panel(build, rate, times["many"]), obs=y["many"])


def counts(times, y=None):
    level = numpyro.sample("level", dist.Normal(1.0, 0.5))
    model = lfm.LatentForceModel(
        lambda x, u, t: jnp.zeros(0), {"u": lfm.Matern(0.4, 1.0, order=0)},
        lfm.PoissonObservation(lambda x, u, t: jnp.exp(level + u[0] + jnp.array([0.0, 1.0]))),
        lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))
    numpyro.sample("y", lfm.MarginalLikelihood(model, times), obs=y)


def converted(model, times, y, draws):
    """Return the result of random draws in place of posterior draws."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lfm.ConvergenceWarning)
        return lfm.to_arviz(draws, model, times, y, trajectory_draws=0)


def draws_of(*shape):
    return np.exp(0.1 * np.random.default_rng(1).normal(size=(2, 50, *shape)))


@pytest.mark.thorough
def test_a_panel_with_padded_rows_and_a_series_without_data():
    y = Y.copy()
    y[0, 4:], y[1, 2], y[2] = np.nan, np.nan, np.nan
    result = converted(panel, TIMES, y, {"rate": draws_of(3)})
    check_arviz(result, {"y": 9})
    for series, rows in ((0, [0, 1, 2, 3]), (1, [0, 1, 3, 4, 5])):
        view = lfm.select_series(result, series)
        check_arviz(view, {"y": len(rows)})
        np.testing.assert_array_equal(ResultView.of(view).group("observed_data")["time"], TIMES[0, rows])
        rate = ResultView.of(result).posterior["rate"].values[1, 7, series]
        alone = lfm.smooth(build(rate), TIMES[0, rows], y[series, rows])
        stored = ResultView.of(view).group("log_likelihood")["y"][1, 7]
        np.testing.assert_allclose(stored, alone.leave_one_out, rtol=1e-9)
    assert ResultView.of(lfm.select_series(result, 2)).group("observed_data")["y"].size == 0


@pytest.mark.thorough
def test_two_sites_of_several_outputs_and_series():
    times, y = {"one": TIMES[0], "many": TIMES[1:]}, {"one": Y[0] * np.array([1.0, 2.0]), "many": Y[1:].copy()}
    y["one"][[1, 3], [0, 1]], y["many"][1, 3:] = np.nan, np.nan
    result = converted(single_and_panel, times, y, {"shared": draws_of(), "rate": draws_of(2)})
    pointwise = check_arviz(result, {"one": 10, "many": 9})
    for site, terms in pointwise.items():
        view = lfm.select_series(result, site)
        np.testing.assert_array_equal(check_arviz(view, {"y": len(terms)})["y"], terms)
    # Correlated noise: an entry is left out, and the other one of its row is not.
    rate = ResultView.of(result).posterior["shared"].values[0, 3]
    likelihood, without = lfm.MarginalLikelihood(build(rate, (1.0, 2.0)), TIMES[0]), y["one"].copy()
    without[2, 0] = np.nan
    left_out = ResultView.of(lfm.select_series(result, "one")).group("log_likelihood")["y"][0, 3]
    is_entry = (left_out["time"] == TIMES[0, 2]).values & (left_out["output"] == left_out["output"][0]).values
    np.testing.assert_allclose(left_out.values[is_entry], likelihood.log_prob(y["one"]) - likelihood.log_prob(without),
                               atol=1e-9)


@pytest.mark.thorough
def test_counts_with_missing_entries():
    y = np.random.default_rng(2).poisson([3.0, 8.0], size=(8, 2)).astype(float)
    y[2], y[5, 1] = np.nan, np.nan
    result = converted(counts, np.arange(8.0), y, {"level": np.log(3.0) + np.log(draws_of())})
    check_arviz(result, {"y": 13})
    for name in ("observed_data", "posterior_predictive"):
        assert ResultView.of(result).group(name)["y"].dtype.kind == "i"
    # Each entry alone, also where the other one of its row is present: by quadrature of the evidence.
    level = ResultView.of(result).posterior["level"].values[0, 0]
    terms = ResultView.of(result).group("log_likelihood")["y"][0, 0]
    without = y.copy()
    without[4, 0] = np.nan

    def evidence(y):
        model = lfm.LatentForceModel(
            lambda x, u, t: jnp.zeros(0), {"u": lfm.Matern(0.4, 1.0, order=0)},
            lfm.PoissonObservation(lambda x, u, t: jnp.exp(level + u[0] + jnp.array([0.0, 1.0]))),
            lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))
        return float(lfm.MarginalLikelihood(model, np.arange(8.0)).log_prob(y))

    entry = np.flatnonzero((terms["time"] == 4.0).values)[0]
    assert float(terms[entry]) == pytest.approx(evidence(y) - evidence(without), abs=0.01)


@pytest.mark.slow
def test_replicates_of_a_linear_model_are_the_smoothed_state_and_noise():
    def single(times, y=None):
        numpyro.sample("y", lfm.MarginalLikelihood(
            build(numpyro.sample("rate", dist.LogNormal(0.0, 0.5)), (1.0, 2.0)), times), obs=y)

    y = Y[1] * np.array([1.0, 2.0])
    y[2], y[4, 0] = np.nan, np.nan
    result = converted(single, TIMES[1], y, {"rate": np.ones((2, 3000))})
    replicated = ResultView.of(result).group("posterior_predictive")["y"].values.reshape(6000, -1)
    smoothed, gain = lfm.smooth(build(1.0, (1.0, 2.0)), TIMES[1], y), np.array([1.0, 2.0])
    rows, outputs = np.nonzero(np.isfinite(y))
    mean = smoothed.input_mean[rows, 0] * gain[outputs]
    sd = np.sqrt(smoothed.input_covariance[rows, 0, 0] * gain[outputs] ** 2 + 0.015)
    np.testing.assert_array_less(np.abs(replicated.mean(0) - mean) / sd, 5 / np.sqrt(6000))
    np.testing.assert_allclose(replicated.std(0), sd, rtol=5 / np.sqrt(2 * 6000))
    # The two outputs of a row share state and noise.
    pair = replicated[:, rows == 3]
    expected = float(smoothed.input_covariance[3, 0, 0]) * 2 + 0.005
    assert np.cov(pair.T)[0, 1] == pytest.approx(expected, rel=0.15)
