"""Counts through what follows a fit: forecast, scores, intervals, checks, correction, comparison, figures."""

import json
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import xarray as xr
from scipy import special, stats

import lfm_ppl as lfm
from lfm_ppl.filtering.ep.settings import FactorSettings
from lfm_ppl.inference.factor_failures import factor_failures
from lfm_ppl.plots.saving import pages_of
from lfm_ppl.results import arviz_data
from lfm_ppl.results.family_scores import log_densities
from lfm_ppl.results.predictions import summary
from lfm_ppl.results.result_view import ResultView

TIMES = np.arange(14.0)
COUNTS = np.array([2, 0, 1, 3, 5, 4, 7, 3, 2, 1, 0, 0, 1, 2], float)[:, None]
AHEAD, HELD_OUT = np.array([14.0, 16.0]), np.array([[1.0], [4.0]])


def system(level, scale):
    return lfm.LatentForceModel(
        lambda x, u, t: jnp.zeros(0), {"u": lfm.Matern(scale, 3.0)},
        lfm.PoissonObservation(lambda x, u, t: level + u, exposure=1.5), lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))),
        output_names=("events",))


def counts(times, y=None, factors=None):
    level = numpyro.sample("level", dist.Normal(0.0, 1.0))
    scale = numpyro.sample("scale", dist.LogNormal(-0.5, 0.3))
    numpyro.sample("y", lfm.MarginalLikelihood(system(level, scale), times, factors=factors), obs=y)


@pytest.fixture(scope="module")
def result():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lfm.ConvergenceWarning)  # it is short
        return lfm.fit(counts, TIMES, COUNTS, sampler="ram", chains=2, warmup=50, samples=60, thin=3,
                       trajectory_draws=40, chain_method="vectorized", progress=False,
                       sampler_options={"initial_covariance": np.diag([0.15, 0.08])})


@pytest.fixture(scope="module")
def forecast(result):
    return lfm.forecast(result, counts, AHEAD, draws=100)


@pytest.mark.slow
def test_new_counts_are_counts_and_so_are_their_intervals(result, forecast):
    predicted = ResultView.of(forecast).group("predictions")
    replicated = ResultView.of(result).group("posterior_predictive")["y"].values
    for new_counts in (predicted["y"].values, replicated):
        assert np.all(new_counts == np.round(new_counts)) and np.all(new_counts >= 0)
    table = summary(predicted)
    bounds = table[["q2.5", "q97.5"]].to_numpy()
    assert np.all(bounds == np.round(bounds)) and np.all(bounds[:, 0] < bounds[:, 1])


@pytest.mark.thorough
def test_counts_have_residuals(result):
    residual = ResultView.of(result).group("one_step_ahead")["residual"]
    assert np.all(np.isfinite(residual))
    # The first count, given nothing before it, at the first draw: by quadrature over the force's prior.
    level, scale = (float(ResultView.of(result).posterior[name][0, 0]) for name in ("level", "scale"))
    nodes, weights = np.polynomial.hermite_e.hermegauss(80)
    rate = 1.5 * np.exp(level + scale * nodes)
    below, up_to = (weights @ stats.poisson.cdf(count, rate) / weights.sum() for count in (1.0, 2.0))
    assert stats.norm.ppf(below) < float(residual[0, 0, 0, 0]) < stats.norm.ppf(up_to)
    assert "residuals" in {name for name, *_ in pages_of(result, "column")}


@pytest.mark.thorough
def test_log_score_is_that_of_the_family_along_the_paths(forecast):
    """Against SciPy: the mean over the draws of the Poisson probability at each path's own rate."""
    predicted, posterior = (ResultView.of(forecast).group(name) for name in ("predictions", "posterior"))
    level = posterior["level"].values[:, predicted["draw"].values]
    rate = 1.5 * np.exp(level[..., None] + predicted["forces"].values[..., 0]).reshape(-1, 2)
    log_p = special.logsumexp(stats.poisson.logpmf(HELD_OUT[:, 0], rate), axis=0) - np.log(len(rate))
    result = lfm.score(forecast, HELD_OUT, numpyro_model=counts).loc["events"]
    assert result["log_score"] == pytest.approx(log_p.mean(), abs=1e-12)
    new_counts = predicted["y"].values.reshape(len(rate), 2)
    far = np.abs(new_counts - HELD_OUT[:, 0]).mean(0) - 0.5 * np.abs(new_counts[:, None] - new_counts).sum((0, 1)) / (
        len(rate) * (len(rate) - 1))
    assert result["crps"] == pytest.approx(far.mean(), rel=1e-12)
    assert np.isnan(lfm.score(forecast, HELD_OUT).loc["events", "log_score"])
    with pytest.raises(ValueError, match="dataset"):
        lfm.score(ResultView.of(forecast).group("predictions"), HELD_OUT, numpyro_model=counts)


def test_densities_are_those_of_the_times_that_are_asked_for():
    """Two blocks of times with one shape, and a rate that grows with time."""

    def growing(times, y=None):
        level = numpyro.sample("level", dist.Normal(0.0, 1.0))
        model = lfm.LatentForceModel(
            lambda x, u, t: jnp.zeros(0), {"u": lfm.Matern(1.0, 3.0)},
            lfm.PoissonObservation(lambda x, u, t: level + 0.1 * t + u), lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))
        numpyro.sample("y", lfm.MarginalLikelihood(model, times), obs=y)

    bound = lfm.bind(growing, TIMES, COUNTS)
    rng = np.random.default_rng(0)
    level, force = rng.normal(size=3), rng.normal(size=(1, 3, 2, 1))
    for times in (np.array([14.0, 16.0]), np.array([20.0, 29.0])):
        predicted = xr.Dataset({"forces": (("chain", "draw", "time", "force"), force)}, {"time": times})
        result = log_densities(bound, {"level": level}, predicted, HELD_OUT)
        rate = np.exp(level[:, None] + 0.1 * times + force[0, ..., 0])
        np.testing.assert_allclose(result[..., 0], stats.poisson.logpmf(HELD_OUT[:, 0], rate), rtol=1e-12)


@pytest.mark.slow
def test_check_by_importance_sampling_and_correction(result):
    """One state: draws of the smoother are exact but for their noise, and EP is within 0.15 of the log evidence."""
    report = lfm.check_accuracy(result, counts, draws=120, particles=400, replicates=3, progress=False)
    assert "importance sampling, 3 runs of 400 draws" in report.reference
    ratio = (report.dataset["log_likelihood_reference"] - report.dataset["log_likelihood"]).values
    assert np.abs(ratio).max() < 0.15 + 5 * report.dataset["noise_sd"].values.max()
    assert report.k < report.threshold
    corrected = lfm.correct_posterior(result, counts, trajectory_draws=10)
    new_counts = ResultView.of(corrected).group("posterior_predictive")["y"].values
    assert np.all(new_counts == np.round(new_counts))
    with pytest.raises(ValueError, match="log likelihoods"):
        lfm.check_accuracy(result, lambda times, y=None: counts(times, y, FactorSettings()), TIMES, COUNTS + 1.0,
                           draws=4, particles=10, replicates=2, progress=False)


@pytest.mark.thorough
def test_unconverged_factors_are_counted_and_named(result):
    """With few sweeps allowed they converge at some points and not at others."""
    stored = json.loads(ResultView.of(result).attrs["factor_failures"])
    assert stored == [100, 0, 0] and not any("factors" in text for text in arviz_data.convergence_warnings(result))
    bound = lfm.bind(counts, TIMES, COUNTS, model_kwargs={"factors": FactorSettings(sweeps=9)})
    computed = factor_failures(bound, 2.0 * np.random.default_rng(0).normal(size=(1, 50, 2)))
    assert 0 < computed.unconverged < computed.points and computed.unconverged <= computed.impossible
    for impossible in (9, 0):
        result.attrs["factor_failures"] = json.dumps([100, 7, impossible])
        message = arviz_data.convergence_warnings(result)[-1]
        assert "7 of 100" in message and ("9 of the 100" in message) == bool(impossible)
    result.attrs["factor_failures"] = json.dumps(stored)


@pytest.mark.slow
def test_a_panel_of_counts_is_a_loop_over_its_series():
    """One of the series is all missing, the other has a gap."""
    y = np.stack([COUNTS, np.full_like(COUNTS, np.nan)])
    y[0, 3] = np.nan
    panel = lfm.panel(lambda level: system(level, 0.6), jnp.array([0.3, 0.8]), TIMES)
    result = panel.log_prob(y)
    assert result[0] == pytest.approx(float(lfm.MarginalLikelihood(system(0.3, 0.6), TIMES).log_prob(y[0])), abs=1e-9)
    assert result[1] == pytest.approx(0.0, abs=1e-12)


def driven(times, y=None):
    """Counts of a state that softplus of a force produces: no Gaussian moments are exact."""
    level = numpyro.sample("level", dist.Normal(0.5, 0.5))
    model = lfm.LatentForceModel(
        lambda x, u, t: jax.nn.softplus(u) - 0.7 * x, {"u": lfm.Matern(1.0, 3.0)},
        lfm.PoissonObservation(lambda x, u, t: level + x), lfm.Gaussian(jnp.ones(1), 0.1 * jnp.eye(1)))
    numpyro.sample("y", lfm.MarginalLikelihood(model, times, steps=3), obs=y)


@pytest.mark.slow
def test_particles_check_and_correct_counts_of_dynamics_that_are_not_linear():
    """pmmh draws from the exact posterior; NUTS with EP comes near, and the check says by how much."""
    filtered, exact = (lfm.fit(driven, TIMES, COUNTS, sampler=sampler, chains=2, warmup=200, samples=300,
                               trajectory_draws=20, progress=False) for sampler in ("nuts", "pmmh"))
    report = lfm.check_accuracy(filtered, driven, draws=40, particles=2000, replicates=3, progress=False)
    assert "particle filter" in report.reference and report.k < report.threshold
    means = [float(ResultView.of(source).posterior["level"].mean()) for source in (filtered, exact)]
    sd = float(ResultView.of(exact).posterior["level"].std())
    assert abs(means[0] - means[1]) < 0.4 * sd
    new_counts = ResultView.of(lfm.forecast(exact, driven, AHEAD, draws=20)).group("predictions")["y"].values
    assert np.all(new_counts == np.round(new_counts))
