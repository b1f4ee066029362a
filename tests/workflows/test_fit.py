import functools
import json
import warnings
from unittest.mock import Mock

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import xarray as xr
from numpyro.infer import init_to_uniform
from scipy import stats
from scipy.interpolate import CubicSpline

import lfm_ppl as lfm
from lfm_ppl.results import arviz_data, rebuilding
from lfm_ppl.results.labels import Labels
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.results.true_values import checked_truth, unplaced
from lfm_ppl.workflows import fit_starts
from lfm_ppl.workflows.data_binding import warn_of_named_settings
from lfm_ppl.workflows.fit_options import FitOptions
from tests.inference import linear_motif as motif

TIMES = motif.TIMES
FORECAST = np.array([0.0, 0.7, 2.5, 3.2, 4.6, 6.0])
NEAR = 1e-7
"""Relative width of priors that make the parameters all but known."""


@pytest.fixture(scope="module")
def y():
    return motif.data()


def quiet_fit(*arguments, **keywords):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lfm.ConvergenceWarning)
        return lfm.fit(*arguments, progress=False, **keywords)


@pytest.fixture(scope="module")
def nuts(y):
    """Two short chains of NUTS, with one element of a vector fixed."""
    return quiet_fit(motif.model, TIMES, y, sampler="nuts", chains=2, warmup=60, samples=40, trajectory_draws=10,
                     at=FORECAST, fixed={"decay[b]": 1.2}, chain_method="vectorized", name="motif",
                     truth={"times": TIMES, "forces": {"drive": np.sin(TIMES)}, "state": np.ones((len(TIMES), 2)),
                            "parameters": motif.THETA})


@pytest.fixture(scope="module")
def known_fit(y):
    """Independent draws for parameters that are all but known."""
    return quiet_fit(motif.model, TIMES, y, sampler="map", samples=2000, trajectory_draws=2000, at=FORECAST, seed=3,
                     truth={"times": TIMES, "deterministics": {"rate": np.cos(TIMES)}},
                     model_kwargs={"spread": NEAR})


def group(result, name):
    return ResultView.of(result).group(name)


# Groups, dimensions, coordinates, units and attributes


def test_groups_and_dimensions(nuts):
    expected = {
        "posterior": {"decay": ("chain", "draw", "output"), "lengthscale": ("chain", "draw"),
                      "noise_sd": ("chain", "draw")},
        "log_likelihood": {"y": ("chain", "draw", "observation")},
        "log_prior": {name: ("chain", "draw") for name in ("decay", "lengthscale", "noise_sd")},
        "one_step_ahead": {"log_density": ("chain", "draw", "time"), "residual": ("chain", "draw", "time", "output")},
        "posterior_predictive": {"y": ("chain", "draw", "observation")},
        "trajectories": {"forces": ("chain", "draw", "time", "force"), "states": ("chain", "draw", "time", "state"),
                         "outputs": ("chain", "draw", "time", "output"),
                         "deterministics": ("chain", "draw", "time", "deterministic"),
                         "deterministics_summary": ("statistic", "time", "deterministic"),
                         "forces_summary": ("statistic", "time", "force"),
                         "states_summary": ("statistic", "time", "state"),
                         "outputs_summary": ("statistic", "time", "output"),
                         "new_data_summary": ("statistic", "time", "output")},
        "predictions": {"y": ("chain", "draw", "time", "output"), "y_mean": ("chain", "draw", "time", "output"),
                        "y_sd": ("chain", "draw", "time", "output"), "outputs_sd": ("chain", "draw", "time", "output"),
                        "outputs": ("chain", "draw", "time", "output"), "forces": ("chain", "draw", "time", "force"),
                        "states": ("chain", "draw", "time", "state"),
                        "deterministics": ("chain", "draw", "time", "deterministic")},
        "data": {"y": ("time", "output")}, "observed_data": {"y": ("observation",)},
        "truth": {"forces": ("time", "force"), "states": ("time", "state"), "decay": ("output",),
                  "lengthscale": (), "noise_sd": (), "outputs": ("time", "output"),
                  "deterministics": ("time", "deterministic")},
    }
    assert set(ResultView.of(nuts).groups) == {*expected, "sample_stats"}
    for name, variables in expected.items():
        dataset = group(nuts, name)
        assert {variable: dataset[variable].dims for variable in dataset.data_vars} == variables


@pytest.mark.thorough
def test_coordinates_carry_names_times_and_units(nuts, known_fit, y):
    posterior, paths, observed = (group(nuts, name) for name in ("posterior", "trajectories", "data"))
    assert posterior["output"].values.tolist() == ["a", "b"]
    assert (paths["force"].values.tolist(), paths["state"].values.tolist()) == (["drive"], ["x0", "x1"])
    assert (posterior.sizes["draw"], paths.sizes["draw"]) == (40, 5)
    assert set(paths["draw"].values) <= set(posterior["draw"].values)
    np.testing.assert_array_equal(paths["time"], FORECAST)
    np.testing.assert_array_equal(observed["y"], y)
    rows, outputs = np.nonzero(np.isfinite(y))
    for name, times in (("data", TIMES), ("one_step_ahead", TIMES), ("log_likelihood", TIMES[rows]),
                        ("posterior_predictive", TIMES[rows]), ("observed_data", TIMES[rows])):
        np.testing.assert_array_equal(group(nuts, name)["time"], times)
        assert group(nuts, name)["time"].attrs["units"] == "h"
    assert group(nuts, "posterior_predictive")["output"].values.tolist() == np.array(["a", "b"])[outputs].tolist()
    np.testing.assert_array_equal(group(nuts, "observed_data")["y"], y[rows, outputs])
    assert (paths["forces"].attrs["units"], observed["y"].attrs["units"]) == ("1/h", "nM")
    np.testing.assert_array_equal(group(nuts, "truth")["outputs"], np.ones((len(TIMES), 2)))  # the states themselves
    truth = group(known_fit, "truth")
    assert set(truth.data_vars) == {"deterministics"}
    np.testing.assert_array_equal(truth["deterministics"].sel(deterministic="rate"), np.cos(TIMES))


def test_entries_of_a_truth_that_the_model_does_not_have_are_named(y):
    bound = lfm.bind(motif.model, TIMES, y)
    truth = {"times": TIMES, "forces": {"drvie": TIMES}, "state": np.ones((len(TIMES), 3)),
             "parameters": {**motif.THETA, "dacay": 1.0}, "deterministics": {"rate": TIMES}}
    messages = unplaced(bound, truth, Labels.of(bound))
    assert all(name in message for name, message in zip(("'drvie'", "'dacay'", "3 states"), messages, strict=True))
    with pytest.warns(UserWarning, match="'state_'"):
        assert checked_truth(bound, {"state_": 0, "parameters": {}}, Labels.of(bound)) == {"parameters": {}}
    with pytest.raises(ValueError, match="times"):
        checked_truth(bound, {"times": 3.0}, Labels.of(bound))


def test_attributes_say_how_it_was_made(nuts):
    attrs = ResultView.of(nuts).attrs
    assert (attrs["model"], attrs["sampler"], attrs["rule"], attrs["steps"]) == ("motif", "nuts", "Cubature()", 10)
    assert (attrs["seed"], attrs["chains"], attrs["warmup"], attrs["samples"]) == (0, 2, 60, 40)
    assert json.loads(attrs["fixed"]) == {"decay[b]": 1.2}
    assert set(json.loads(attrs["versions"])) >= {"lfm_ppl", "jax", "numpyro", "arviz", "python"}
    assert attrs["wall_time_s"] > 0 and attrs["created_at"].startswith("20")
    statistics = group(nuts, "sample_stats")
    assert set(statistics.data_vars) == {"diverging", "acceptance_rate", "n_steps", "tree_depth", "energy", "step_size",
                                         "lp"}
    assert (statistics["n_steps"] <= 2 ** statistics["tree_depth"] - 1).all()
    # H = U + K, with K >= 0
    assert (statistics["energy"] >= -statistics["lp"] - 1e-9).all()
    decay = group(nuts, "posterior")["decay"]
    np.testing.assert_allclose(decay.sel(output="b"), 1.2, rtol=1e-12)
    assert np.ptp(decay.sel(output="a").values) > 0


def test_file_round_trip(nuts, tmp_path):
    loaded = arviz_data.load(arviz_data.save(nuts, tmp_path / "result.nc"))
    assert ResultView.of(loaded).attrs == ResultView.of(nuts).attrs
    assert set(ResultView.of(loaded).groups) == set(ResultView.of(nuts).groups)
    for name in ResultView.of(nuts).groups:
        xr.testing.assert_identical(group(loaded, name), group(nuts, name))


# Predictive densities


def test_conditionals_equal_the_exact_ones_at_every_draw(nuts, y):
    residual = group(nuts, "one_step_ahead")["residual"].values
    np.testing.assert_array_equal(np.isnan(residual).all((0, 1)), np.isnan(y))
    posterior, conditional = group(nuts, "posterior"), group(nuts, "log_likelihood")["y"]
    one_step_densities = group(nuts, "one_step_ahead")["log_density"]
    for chain, draw in ((0, 0), (1, 17), (1, 39)):
        theta = {name: posterior[name].values[chain, draw] for name in motif.THETA}
        joint_density = motif.log_density(y, **theta)
        np.testing.assert_allclose(one_step_densities.values[chain, draw].sum(), joint_density, rtol=1e-8)
        for index, entry in enumerate(zip(*np.nonzero(np.isfinite(y)), strict=True)):
            without = y.copy()
            without[entry] = np.nan
            exact = joint_density - motif.log_density(without, **theta)
            np.testing.assert_allclose(conditional.values[chain, draw, index], exact, rtol=1e-8, atol=1e-9)
        for row in range(len(TIMES)):
            y_before = y.copy()
            y_before[row:] = np.nan
            until = y.copy()
            until[row + 1 :] = np.nan
            step = motif.log_density(until, **theta) - motif.log_density(y_before, **theta)
            np.testing.assert_allclose(one_step_densities.values[chain, draw, row], step, rtol=1e-8, atol=1e-9)


def one_parameter(times, y=None):
    """The motif with its first decay unknown; a posterior on a line can be integrated exactly."""
    decay = numpyro.sample("decay", dist.LogNormal(np.log(0.5), 0.5))
    system = motif.build(jnp.stack([decay, jnp.asarray(1.2)]), 1.5, 0.2)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)


@pytest.fixture(scope="module")
def line(y):
    return quiet_fit(one_parameter, TIMES, y, sampler="ram", chains=4, warmup=500, samples=1000, trajectory_draws=0,
                     chain_method="vectorized")


@pytest.fixture(scope="module")
def density():
    """The standardised log decay on a grid, log prior densities there, and the log likelihood of any y there."""
    nodes = np.linspace(-4.5, 4.5, 91)
    covariances = [motif.observation_covariance(TIMES, np.array([0.5 * np.exp(0.5 * z), 1.2]), 1.5, 0.2) for z in nodes]

    def log_likelihood(y):
        present = np.isfinite(y).ravel()
        normal = [stats.multivariate_normal(cov=c[np.ix_(present, present)]) for c in covariances]
        return np.array([law.logpdf(y.ravel()[present]) for law in normal])

    return nodes, stats.norm.logpdf(nodes), log_likelihood


@pytest.mark.slow
def test_loo_equals_refitting_without_each_observation(line, y, density):
    # p(y_k | y_-k) = Z(y) / Z(y_-k), with evidences Z by quadrature: exact refits
    nodes, prior, log_likelihood = density

    def evidence(y):
        return np.log(np.diff(nodes)[0]) + np.logaddexp.reduce(prior + log_likelihood(y))

    entries = list(zip(*np.nonzero(np.isfinite(y)), strict=True))
    exact = np.empty(len(entries))
    for index, entry in enumerate(entries):
        without = y.copy()
        without[entry] = np.nan
        exact[index] = evidence(y) - evidence(without)
    import arviz as az

    result = az.loo(line, pointwise=True)
    pointwise = np.asarray(result.loo_i if hasattr(result, "loo_i") else result.elpd_i)
    # Standard error of the log of an importance-sampling mean of 1 / p(y_k | y_-k, theta), at the effective sample size
    inverse = np.exp(-group(line, "log_likelihood")["y"].values.reshape(4000, -1))
    size = arviz_data.summary(line).loc["decay", "ess_bulk"]
    error = inverse.std(0) / inverse.mean(0) / np.sqrt(size)
    np.testing.assert_array_less(np.abs(pointwise - exact), 4.5 * error + 1e-6)
    total = float(result.elpd_loo if hasattr(result, "elpd_loo") else result.elpd)
    assert abs(total - exact.sum()) < 4.5 * error.sum()
    assert error.sum() < 0.2


@pytest.mark.slow
def test_ram_posterior_on_a_line(line, y, density):
    nodes, prior, log_likelihood = density
    # The density of the unconstrained parameter log(decay) = log(0.5) + z / 2
    values = prior + log_likelihood(y) - np.log(0.5)
    weights = np.exp(values - values.max())
    weights /= weights.sum()
    mean, size = weights @ nodes, arviz_data.summary(line).loc["decay", "ess_bulk"]
    sd = np.sqrt(weights @ (nodes - mean) ** 2)
    scaled_draws = (np.log(group(line, "posterior")["decay"].values) - np.log(0.5)) / 0.5
    assert abs(scaled_draws.mean() - mean) < 4.5 * sd / np.sqrt(size)
    assert abs(scaled_draws.std() / sd - 1) < 4.5 / np.sqrt(size)
    statistics = group(line, "sample_stats")
    assert set(statistics.data_vars) == {"acceptance_rate", "accepted", "lp"}
    assert 0.3 < float(statistics["accepted"].mean()) < 0.6  # towards 0.44 in one dimension
    expected_lp = CubicSpline(nodes, values)(scaled_draws[0, :20])
    np.testing.assert_allclose(statistics["lp"].values[0, :20], expected_lp, atol=1e-5)


# Trajectories


@pytest.fixture(scope="module")
def exact(y):
    """Means and covariance of x(TIMES), u(FORECAST), x(FORECAST) given the data, parameters known."""
    return motif.posterior(y, FORECAST, **motif.THETA)


def assert_moments(draws, mean, covariance):
    """Draws (n, d) against a Gaussian: whitened, they are independent standard normals."""
    count = len(draws)
    values, vectors = np.linalg.eigh(covariance)
    is_positive = values > 1e-9 * values.max()
    white = (draws - mean) @ vectors[:, is_positive] / np.sqrt(values[is_positive])
    assert np.abs(white.mean(0)).max() < 4.5 / np.sqrt(count)
    error = np.abs(white.T @ white / count - np.eye(is_positive.sum()))
    assert error.max() < 4.5 * np.sqrt(2.0 / count)


def test_trajectories_have_the_exact_joint_distribution(known_fit, exact):
    paths = group(known_fit, "trajectories")
    mean, covariance = exact
    start = 2 * len(TIMES)
    forces = paths["forces"].values[0, :, :, 0]
    states = paths["states"].values[0].reshape(len(forces), -1)
    assert_moments(np.concatenate([forces, states], axis=1), mean[start:], covariance[start:, start:])
    sd = np.sqrt(np.diag(covariance)[start:start + len(FORECAST)])
    assert sd[-1] > sd[-2] > sd[-3]  # a forecast widens towards the prior
    np.testing.assert_array_equal(paths["outputs"], paths["states"])
    forecast, forecast_part = group(known_fit, "predictions"), slice(start + len(FORECAST), None)
    np.testing.assert_array_equal(forecast["outputs"], paths["outputs"])
    np.testing.assert_allclose(forecast["y_mean"].values[0, 0].ravel(), mean[forecast_part], atol=2e-6)


def test_posterior_predictive_is_the_smoothed_state_and_noise(known_fit, exact, y):
    replicated = group(known_fit, "posterior_predictive")["y"].values[0]
    mean, covariance = exact
    seen = np.flatnonzero(np.isfinite(y))
    noise = motif.THETA["noise_sd"] ** 2 * np.eye(len(seen))
    assert_moments(replicated, mean[seen], covariance[np.ix_(seen, seen)] + noise)


def test_bands_are_the_quantiles_of_the_mixture_over_the_draws(nuts, y):
    """Against the exact posterior of the force at every draw of the parameters, by dense algebra."""
    paths = group(nuts, "trajectories")
    parameters = group(nuts, "posterior").sel(draw=paths["draw"])
    means, sds = [], []
    for chain in range(2):
        for draw in range(paths.sizes["draw"]):
            values = {name: value.isel(chain=chain, draw=draw).values for name, value in parameters.items()}
            mean, covariance = motif.posterior(y, FORECAST, **{name: values[name] for name in motif.THETA})
            start = 2 * len(TIMES)
            means.append(mean[start:start + len(FORECAST)])
            sds.append(np.sqrt(np.diag(covariance)[start:start + len(FORECAST)]))
    result = paths["forces_summary"].sel(force="drive")
    np.testing.assert_allclose(result.sel(statistic="mean"), np.mean(means, axis=0), rtol=1e-6, atol=1e-8)
    for p, name in ((0.025, "q2.5"), (0.975, "q97.5")):
        share = stats.norm.cdf(result.sel(statistic=name).values, means, sds).mean(axis=0)
        np.testing.assert_allclose(share, p, atol=1e-4)


def test_deterministics_follow_the_path_and_have_its_bands(known_fit, y):
    paths = group(known_fit, "trajectories")
    rate = paths["deterministics"].sel(deterministic="rate")
    np.testing.assert_allclose(rate, np.exp(paths["forces"].sel(force="drive")), rtol=1e-12)
    assert rate.attrs["units"] == "1/h"
    # Its distribution is log-normal: quantiles of the logarithm, with the error of 8 points a draw.
    smoothed = lfm.smooth(motif.build(**motif.THETA), TIMES, y, at=FORECAST)
    mean, sd = (np.asarray(part) for part in smoothed.force("drive"))
    result = np.log(paths["deterministics_summary"].sel(deterministic="rate"))
    error = np.sqrt(0.025 * 0.975 / (8 * paths.sizes["draw"])) / stats.norm.pdf(stats.norm.ppf(0.025))
    for p, name in ((0.025, "q2.5"), (0.975, "q97.5")):
        assert np.abs((result.sel(statistic=name) - mean) / sd - stats.norm.ppf(p)).max() < 4.5 * error
    expected = np.exp(mean + sd**2 / 2)
    error = expected * np.sqrt(np.expm1(sd**2) / (8 * paths.sizes["draw"]))
    assert (np.abs(np.exp(result.sel(statistic="mean")) - expected) < 4.5 * error).all()


def test_mode_of_known_parameters(known_fit):
    attrs = ResultView.of(known_fit).attrs
    assert (attrs["sampler"], attrs["chains"], attrs["warmup"]) == ("map", 1, 0)
    assert attrs["map_converged"] == 1
    assert "sample_stats" not in ResultView.of(known_fit).groups
    posterior = group(known_fit, "posterior")
    np.testing.assert_allclose(posterior["noise_sd"], motif.THETA["noise_sd"], rtol=10 * NEAR)
    # With known parameters the evidence is the likelihood
    np.testing.assert_allclose(attrs["log_evidence"], motif.log_density(motif.data(), **motif.THETA), atol=1e-4)
    # Independent draws have no chains: nothing to diagnose, and no trace to look at.
    table = arviz_data.summary(known_fit)
    assert list(table) == ["mode", "mean", "sd", "q2.5", "q97.5"]
    expected = [*motif.THETA["decay"], motif.THETA["noise_sd"]]
    np.testing.assert_allclose(table.loc[["decay[a]", "decay[b]", "noise_sd"], "mode"], expected, rtol=10 * NEAR)


# Panels


def shared(times, y=None):
    """Two series with decays of their own and one noise level."""
    noise_sd = numpyro.sample("noise_sd", dist.LogNormal(-1.5, 0.3))
    with numpyro.plate("series", 2):
        decay = numpyro.sample("decay", dist.LogNormal(0.0, 0.3))

        def build(p):
            return motif.build(p[None], 1.5, noise_sd)

        numpyro.sample("y", lfm.panel(build, decay, times), obs=y)


@pytest.mark.slow
def test_panel():
    times = TIMES[:4]
    y = np.stack([motif.data(seed=s, missing=False)[:4, :1] for s in (1, 2)])
    y[1, 3] = np.nan
    result = quiet_fit(shared, times, y, sampler="ram", chains=2, warmup=20, samples=10, trajectory_draws=4,
                       at=[0.0, 2.0], chain_method="vectorized", sampler_options={"adapt": "throughout"})
    sizes = {name: dict(group(result, name).sizes) for name in ResultView.of(result).groups}
    assert sizes["posterior"] == {"chain": 2, "draw": 10, "series": 2}
    assert sizes["log_likelihood"] == {"chain": 2, "draw": 10, "observation": 7}
    assert sizes["one_step_ahead"] == {"chain": 2, "draw": 10, "series": 2, "time": 4, "output": 1}
    assert sizes["posterior_predictive"] == {"chain": 2, "draw": 10, "observation": 7}
    assert sizes["trajectories"] == {"chain": 2, "draw": 2, "series": 2, "time": 2, "force": 1, "state": 1, "output": 1,
                                     "deterministic": 1, "statistic": 3}
    assert sizes["data"] == {"series": 2, "time": 4, "output": 1} and sizes["observed_data"] == {"observation": 7}
    posterior, one_step_densities = group(result, "posterior"), group(result, "one_step_ahead")["log_density"].values
    for series in range(2):
        theta = (posterior["decay"].values[1, 9, series, None], 1.5, posterior["noise_sd"].values[1, 9])
        exact = motif.log_density(y[series], *theta, times=times)
        np.testing.assert_allclose(one_step_densities[1, 9, series].sum(), exact, rtol=1e-8)
    with pytest.raises(ValueError, match=r"\(2, 4, 1\)"):
        lfm.fit(shared, times, y[:, :3])


# Reproducibility and warnings


@pytest.mark.thorough
def test_the_same_seed_gives_the_same_result(y):
    settings = {"sampler": "ram", "chains": 1, "warmup": 5, "samples": 5, "trajectory_draws": 2, "at": FORECAST,
                "init": init_to_uniform, "fixed": {"decay[b]": 1.2}}
    with pytest.warns(lfm.ConvergenceWarning) as warned:
        first = lfm.fit(motif.model, TIMES, y, progress=False, **settings)
    messages = " ".join(str(w.message) for w in warned)
    assert "R-hat" in messages and "decay" in messages
    repetition = quiet_fit(motif.model, TIMES, y, **settings)
    other_seed = quiet_fit(motif.model, TIMES, y, **settings, seed=1)
    for name in ("posterior", "trajectories", "posterior_predictive", "log_likelihood"):
        xr.testing.assert_identical(group(repetition, name), group(first, name))
        assert not group(other_seed, name).equals(group(first, name))
    attrs = ResultView.of(first).attrs
    assert (attrs["model"], attrs["thin"]) == ("model", 15)  # five steps for each of three parameters


@pytest.mark.thorough
@pytest.mark.parametrize("options", [{}, {"initial_covariance": 0.04 * np.eye(1)}])
def test_a_random_walk_from_the_mode_searches_it_once(monkeypatch, y, options):
    search = Mock(side_effect=fit_starts.mode_of)
    monkeypatch.setattr(fit_starts, "mode_of", search)
    bound = lfm.bind(one_parameter, TIMES, y)
    start = fit_starts.find_start(bound, FitOptions("ram", 2, 5, 5, 1, 0, {}, None, 0, "map", options, "vectorized"),
                                  None)
    assert search.call_count == 1
    np.testing.assert_allclose(bound.log_density_gradient(start.points[0])[1], 0.0, atol=1e-3)
    np.testing.assert_array_equal(start.points[0], start.points[1])
    assert (start.mode is None) == bool(options)


def converted(times, y=None, start=None, max_step=None):
    """One decay; the model turns its times into a JAX array, and may say when the prior holds."""
    decay = numpyro.sample("decay", dist.LogNormal(np.log(0.5), 0.5))
    system = lfm.LatentForceModel(
        lambda x, u, t: u - decay * x, {"u": lfm.Matern(1.0, 1.5)},
        lfm.GaussianObservation(lambda x, u, t: x, 0.04 * jnp.ones(1)), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)),
        initial_time=start)
    times = times if max_step else jnp.asarray(times)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, max_step=max_step), obs=y)


@pytest.mark.slow
def test_times_are_known_to_everything_after_sampling(y):
    keywords = {"start": -1.0, "max_step": 0.1}
    result = quiet_fit(converted, TIMES, y[:, :1], sampler="map", samples=4, trajectory_draws=2, at=[0.5, 9.0],
                       model_kwargs=keywords)
    assert set(ResultView.of(result).groups) >= {"trajectories", "log_likelihood", "posterior_predictive"}
    assert group(result, "trajectories")["forces"].sizes["time"] == 2
    decay = float(group(result, "posterior")["decay"][0, 3])
    values = {"decay": jnp.asarray(decay)}
    with numpyro.handlers.seed(rng_seed=0), numpyro.handlers.substitute(data=values):
        trace = numpyro.handlers.trace(converted).get_trace(TIMES, y[:, :1], **keywords)
    joint_density = trace["y"]["fn"].log_prob(y[:, :1])
    np.testing.assert_allclose(group(result, "one_step_ahead")["log_density"][0, 3].sum(), joint_density, rtol=1e-9)


@pytest.mark.thorough
def test_what_fails_after_sampling_does_not_cost_the_draws(y, monkeypatch):
    def broken(*arguments, **keywords):
        raise TypeError("no such thing")

    monkeypatch.setattr("lfm_ppl.workflows.fit_results.scores", broken)
    with pytest.warns(UserWarning, match="scores.*no such thing"):
        result = lfm.fit(motif.model, TIMES, y, sampler="map", samples=5, trajectory_draws=0)
    assert group(result, "posterior")["decay"].shape == (1, 5, 2)
    assert "log_likelihood" not in ResultView.of(result).groups


# Errors


@pytest.mark.parametrize(("change", "error", "name"), [
    ({"sampler": "nut"}, ValueError, "'nut'"), ({"chains": 0}, ValueError, "chains"),
    ({"samples": 2.5}, TypeError, "samples"), ({"thin": 0}, ValueError, "thin"), ({"warmup": -1}, ValueError, "warmup"),
    ({"trajectory_draws": -3}, ValueError, "trajectory_draws"), ({"init": "mode"}, ValueError, "'mode'"),
    ({"init": 3}, TypeError, "init"), ({"sampler": "map", "init": {"rates": 1.0}}, ValueError, "'rates'"),
    ({"chain_method": "threads"}, ValueError, "'threads'"), ({"fixed": {"decay[c]": 1.0}}, ValueError, "'c'"),
    ({"fixed": {"decay": 0.5, "lengthscale": 1.0, "noise_sd": 0.1}}, ValueError, "no parameters"),
    ({"at": [-1.0]}, ValueError, "initial time"), ({"model_kwargs": {"width": 2}}, TypeError, "width"),
    ({"y": np.zeros((7, 2))}, ValueError, r"\(8, 2\)"), ({"y": np.full((8, 2), np.inf)}, ValueError, r"y\[0, 0\]"),
    ({"times": TIMES[::-1]}, ValueError, "times"),
])
def test_wrong_arguments_are_named(y, change, error, name):
    with pytest.raises(error, match=name):
        lfm.fit(motif.model, **{"times": TIMES, "y": y, "progress": False, **change})


def test_a_model_needs_exactly_one_likelihood_site(y):
    def without(times, y=None):
        numpyro.sample("y", dist.Normal(numpyro.sample("level", dist.Normal()), 1.0).expand(np.shape(y)), obs=y)

    def twice(times, y=None):
        motif.model(times, y)
        numpyro.sample("z", lfm.MarginalLikelihood(motif.build(**motif.THETA), times), obs=y)

    for model, name in ((without, "none"), (twice, "y, z")):
        with pytest.raises(ValueError, match=f"site.*{name}"):
            lfm.fit(model, TIMES, y)


def steep(times, y=None):
    """A cubic force far too strong for ten steps between observations."""
    strength = numpyro.sample("strength", dist.LogNormal(10.0, 0.1))
    model = lfm.LatentForceModel(
        lambda x, u, t: u - strength * x**3, {"u": lfm.Matern(1.0, 1.0)},
        lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])), lfm.Gaussian(jnp.ones(1), jnp.eye(1)))
    numpyro.sample("y", lfm.MarginalLikelihood(model, times, iterations=0), obs=y)


@pytest.mark.slow
def test_nowhere_to_start_from_is_explained():
    with pytest.raises(ValueError, match="row 1"):
        lfm.fit(steep, np.arange(3.0), np.ones((3, 1)), sampler="map", progress=False)


def decaying_counts(times, y=None, fault=None):
    """Counts of a deterministic state, with a fault in one part of the density."""
    rate = numpyro.sample("rate", dist.LogNormal(jnp.log(0.3), 0.5))
    if fault == "prior":
        numpyro.sample("level", dist.Normal(0.0, jnp.inf))
    if fault == "factor":
        numpyro.factor("bound", -jnp.inf)
    slope = jnp.linalg.norm(0.0 * rate) if fault == "gradient" else 0.0

    def predictor(x, u, t):
        return x + jnp.log(jnp.where(t > 3.5, -1.0, 1.0)) if fault == "function" else x

    observation = (lfm.PoissonObservation(predictor, "identity") if fault == "law"
                   else lfm.PoissonObservation(predictor))
    model = lfm.LatentForceModel(lambda x, u, t: slope - rate + 0 * x, {}, observation,
                                 lfm.Gaussian(jnp.array([np.log(100.0)]), jnp.zeros((1, 1))))
    settings = {"factors": lfm.FactorSettings(sweeps=1)} if fault == "factors" else {}
    if fault == "factors":
        model = lfm.LatentForceModel(lambda x, u, t: u - rate * x, {"u": lfm.Matern(1.0, 1.0)}, observation,
                                     lfm.Gaussian(jnp.array([np.log(100.0)]), jnp.zeros((1, 1))))
    numpyro.sample("y", lfm.MarginalLikelihood(model, times, **settings), obs=y)


DECAYING = np.array([98.0, 80, 50, 44, 28, 25])[:, None]


@pytest.mark.slow
def test_a_deterministic_state_is_fitted():
    """Against the posterior on a grid."""
    result = lfm.fit(decaying_counts, np.arange(6.0), DECAYING, chains=1, warmup=100, samples=400, progress=False)
    rate = np.linspace(0.15, 0.45, 2001)
    level = np.log(100.0) - rate[:, None] * np.arange(6.0)
    log_density = (DECAYING[:, 0] * level - np.exp(level)).sum(1) - 0.5 * (np.log(rate / 0.3) / 0.5) ** 2 - np.log(rate)
    weight = np.exp(log_density - log_density.max())
    mean = (weight * rate).sum() / weight.sum()
    sd = np.sqrt((weight * (rate - mean) ** 2).sum() / weight.sum())
    draws = np.asarray(result["posterior"]["rate"])
    assert abs(draws.mean() - mean) < 0.4 * sd and 0.7 < draws.std() / sd < 1.4


@pytest.mark.thorough
@pytest.mark.parametrize("fault, reason", [
    ("factor", "'bound'"), ("function", "row 4"), *(pytest.param(*case, marks=pytest.mark.slow) for case in (
        ("prior", "'level'"), ("gradient", "'rate'"), ("law", "y"), ("factors", "1 sweeps")))])
def test_the_part_that_fails_is_named_where_there_is_nowhere_to_start(fault, reason):
    times = 10.0 * np.arange(6.0) if fault == "law" else np.arange(6.0)
    with pytest.raises(ValueError, match=f"finite density.*{reason}") as error:
        lfm.fit(functools.partial(decaying_counts, fault=fault), times, DECAYING, progress=False, chains=1,
                sampler="nuts" if fault == "gradient" else "map")
    assert "\n" not in str(error.value)


@pytest.mark.thorough
def test_settings_that_the_model_leaves_open():
    def model(times, y=None, steps=None):
        rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.3))
        system = lfm.LatentForceModel(
            lambda x, u, t: u - rate * x**3, {"u": lfm.Matern(1.0, 1.0)},
            lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=steps), obs=y)

    y = np.sin(TIMES)[:, None]
    settings = {"rule": lfm.GaussHermite(3), "steps": 2, "iterations": 1, "method": "exponential"}
    fit = functools.partial(quiet_fit, model, TIMES, y, sampler="map", samples=10, trajectory_draws=0)
    result = fit(**settings)
    attributes = ResultView.of(result).attrs
    assert (attributes["rule"], attributes["steps"], attributes["iterations"], attributes["method"]) == (
        settings["rule"].name, 2, 1, "exponential")
    assert "rule=rule, steps=2, iterations=1, method='exponential'" in attributes["call"]
    rebuilt = rebuilding.problem(result, model).bound.site.example.settings
    assert (rebuilt.rule, rebuilt.steps, rebuilt.iterations, rebuilt.method) == tuple(settings.values())
    with pytest.warns(UserWarning, match=r"steps=2 .* 'y'.*steps=5 has no effect.*lfm\.approximate"):
        named = fit(model_kwargs={"steps": 2}, **settings | {"steps": 5})
    assert ResultView.of(named).attrs["steps"] == 2
    with pytest.warns(UserWarning, match=r"filter_steps=3 .* 'y'.*steps=5 holds for simulations only"):
        warn_of_named_settings(lfm.bind(lfm.approximate(model, steps=5, filter_steps=3), TIMES, y), {"steps": 5})
    np.testing.assert_allclose(group(named, "posterior")["rate"], group(result, "posterior")["rate"], rtol=1e-6)
