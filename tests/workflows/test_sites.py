"""Fits of models with several likelihood sites: posterior, groups by site, forecasts, files."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pandas as pd
import pytest
import xarray as xr

import lfm_ppl as lfm
from lfm_ppl.inference.trajectories import trajectories
from lfm_ppl.plots import save_figures
from lfm_ppl.results import arviz_data
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.workflows.data_binding import data_by_site

TIMES = {"a": np.arange(6.0), "b": np.arange(0.0, 4.0, 0.5)}
Y = {"a": np.exp(-0.4 * TIMES["a"])[:, None],
     "b": np.exp(-0.4 * TIMES["b"])[:, None] * np.array([2.0, 6.0])}
GAIN = {"a": np.array([1.0]), "b": np.array([1.0, 3.0])}


def likelihood(name, rate, times, heat=None):
    gain = jnp.asarray(GAIN[name])
    system = lfm.LatentForceModel(
        lambda x, u, t: u - rate * x + (0.0 if heat is None else heat(t)), {"f": lfm.Matern(0.1, 2.0)},
        lfm.GaussianObservation(lambda x, u, t: gain * x[0], 0.01 * jnp.ones(len(gain))),
        lfm.Gaussian(jnp.array([float(Y[name][0, 0])]), 0.01 * jnp.eye(1)))
    return lfm.MarginalLikelihood(system, times)


def joint_model(times, y):
    rate = numpyro.sample("rate", dist.LogNormal(-1.0, 0.5))
    for name in ("a", "b"):
        numpyro.sample(name, likelihood(name, rate, times[name]), obs=y[name])


def cubic(rate, times):
    system = lfm.LatentForceModel(
        lambda x, u, t: u - rate * x**3, {"f": lfm.Matern(0.1, 2.0)},
        lfm.GaussianObservation(lambda x, u, t: x, 0.01 * jnp.ones(1)),
        lfm.Gaussian(jnp.ones(1), 0.01 * jnp.eye(1)))
    return lfm.MarginalLikelihood(system, times, lfm.Taylor(), max_step=0.4, iterations=0)


DATA = {"a": lfm.Data(TIMES["a"], Y["a"], ("level",), units={"time": "h"}), "b": (TIMES["b"], Y["b"])}


SETTINGS = {"sampler": "map", "samples": 40, "trajectory_draws": 20, "at": {"b": [1.0, 5.0]}, "progress": False}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("run")


@pytest.fixture(scope="module")
def fitted(folder):
    return lfm.fit(joint_model, DATA, checkpoint=folder, overwrite=True, **SETTINGS)


def posterior_mean():
    """Return mean and sd of the rate by quadrature over the product of the two likelihoods."""
    grid = np.linspace(0.2, 0.7, 400)
    density = jax.jit(jax.vmap(lambda rate: dist.LogNormal(-1.0, 0.5).log_prob(rate) + sum(
        likelihood(name, rate, TIMES[name]).log_prob(Y[name]) for name in Y)))(grid)
    weight = np.exp(density - density.max())
    weight /= weight.sum()
    mean = weight @ grid
    return mean, np.sqrt(weight @ (grid - mean) ** 2)


@pytest.mark.thorough
@pytest.mark.parametrize("sampler", [pytest.param("ram", marks=pytest.mark.thorough), "nuts"])
def test_samplers_have_the_posterior_of_the_product(sampler):
    result = lfm.fit(joint_model, DATA, sampler=sampler, chains=2, warmup=150, samples=500, trajectory_draws=0,
                     chain_method="vectorized", progress=False)
    mean, sd = posterior_mean()
    table = arviz_data.summary(result)
    assert abs(table.loc["rate", "mean"] - mean) < 4 * table.loc["rate", "mcse_mean"]
    assert table.loc["rate", "sd"] == pytest.approx(sd, rel=0.2)


def test_a_sampler_of_one_site_says_so():
    with pytest.raises(ValueError, match=r"'pmmh'.*a, b"):
        lfm.fit(joint_model, DATA, sampler="pmmh", progress=False)


@pytest.mark.thorough
def test_groups_by_site(fitted):
    observed = ResultView.of(fitted).group("observed_data")
    assert observed["a"].dims == ("a_observation",) and observed["b"].dims == ("b_observation",)
    assert set(observed["a_output"].values) == {"level"}
    for name in Y:
        np.testing.assert_array_equal(observed[name], Y[name][np.isfinite(Y[name])])
        np.testing.assert_array_equal(ResultView.of(fitted).group(f"data_{name}")[name], Y[name])
        count = np.isfinite(Y[name]).sum()
        for label in ("log_likelihood", "posterior_predictive"):
            assert ResultView.of(fitted).group(label)[name].shape == (1, 40, count)
        terms = ResultView.of(fitted).group(f"one_step_ahead_{name}")["log_density"]
        rates = ResultView.of(fitted).posterior["rate"].values.ravel()
        expected = [likelihood(name, rate, TIMES[name]).log_prob(Y[name]) for rate in rates[:3]]
        np.testing.assert_allclose(terms.sum("time").values.ravel()[:3], expected, atol=1e-10)
    assert "predictions_b" in ResultView.of(fitted).groups and "predictions_a" not in ResultView.of(fitted).groups
    with pytest.raises(ValueError, match="select_series"):
        ResultView.of(fitted).group("trajectories")


@pytest.mark.thorough
def test_a_selected_site_is_a_result_of_one_site(fitted, tmp_path):
    lfm.save(fitted, tmp_path / "fit.nc")
    for result in (fitted, lfm.load(tmp_path / "fit.nc")):
        site = lfm.select_series(result, "b")
        assert set(ResultView.of(site).groups) == {"posterior", "log_prior", "data", "observed_data", "log_likelihood",
                                                "one_step_ahead", "trajectories", "posterior_predictive",
                                                 "predictions", "data_a"}
        assert ResultView.of(site).group("data")["y"].dims == ("time", "output")
        np.testing.assert_array_equal(ResultView.of(site).group("log_likelihood")["time"],
                                      ResultView.of(site).group("observed_data")["time"])
        assert ResultView.of(site).group("predictions")["y"].sizes["time"] == 2
        assert ResultView.of(site).attrs["likelihood"].startswith("exact")
        assert lfm.plot_fit(site) is not None
    with pytest.raises(ValueError, match="'c'"):
        lfm.select_series(fitted, "c")


@pytest.mark.thorough
def test_forecast_and_score_by_site(fitted):
    forecast = lfm.forecast(fitted, joint_model, {"a": [6.0, 7.0]}, progress=False)
    assert ResultView.of(forecast).group("predictions_a")["a"].shape == (1, 40, 2, 1)
    expected = np.exp(-0.4 * np.array([[6.0], [7.0]]))
    table = lfm.score(lfm.select_series(forecast, "a"), expected)
    assert table.index.tolist() == ["level", "all"] and table.loc["all", "rmse"] < 0.3
    with pytest.raises(ValueError, match="'c'"):
        lfm.forecast(fitted, joint_model, {"c": [6.0]}, progress=False)


@pytest.mark.thorough
def test_a_forecast_of_a_selected_site_is_that_of_all_sites(fitted, tmp_path):
    for name, times in (("a", [6.0, 7.0]), ("b", [2.2, 5.0])):
        site = lfm.select_series(fitted, name)
        lfm.save(site, tmp_path / f"{name}.nc")
        alone = lfm.forecast(lfm.load(tmp_path / f"{name}.nc"), joint_model, times, progress=False)
        expected = lfm.select_series(lfm.forecast(fitted, joint_model, {name: times}, progress=False), name)
        xr.testing.assert_allclose(*(ResultView.of(forecast).group("predictions") for forecast in (alone, expected)))
        assert lfm.score(alone, np.zeros((2, len(GAIN[name])))).loc["all", "n"] == 2 * len(GAIN[name])


@pytest.mark.thorough
def test_paths_of_a_site_are_those_of_its_model_alone():
    times = {"a": np.arange(2.0, 6.0), "b": np.arange(5.0)}
    y = {"a": Y["a"][:4], "b": np.append(np.exp(-0.4 * times["b"][:-1]), np.nan)[:, None]}
    # Before the first time of the other site, and after the last observation.
    requested_times = np.array([0.5, 3.5, 4.0, 6.0])

    def two(times, y):
        rate = numpyro.sample("rate", dist.LogNormal(-1.0, 0.5))
        numpyro.sample("a", likelihood("a", rate, times["a"]), obs=y["a"])
        numpyro.sample("b", cubic(rate, times["b"]), obs=y["b"])

    def alone(times, y):
        numpyro.sample("y", cubic(numpyro.sample("rate", dist.LogNormal(-1.0, 0.5)), times), obs=y)

    paths, expected = (
        trajectories(jax.random.key(1), bound, {"rate": np.array([0.3, 0.5])}, requested_times)
        for bound in (lfm.bind(two, times, y).site_models["b"], lfm.bind(alone, times["b"], y["b"])))
    assert paths["state"].shape == (2, 4, 1)
    for name in ("state", "force", "output", "prediction", "log_likelihood"):
        np.testing.assert_allclose(paths[name], expected[name], atol=1e-9)


@pytest.mark.thorough
def test_the_check_adds_the_sites(fitted):
    report = lfm.check_accuracy(fitted, joint_model, draws=10, particles=500, replicates=2, reference="particles",
                                progress=False)
    rates = ResultView.of(fitted).posterior["rate"].sel(draw=report.dataset["draw"]).values.ravel()
    expected = [sum(likelihood(name, rate, TIMES[name]).log_prob(Y[name]) for name in Y) for rate in rates]
    np.testing.assert_allclose(report.dataset["log_likelihood"].values.ravel(), expected, atol=1e-10)
    noise = report.dataset["noise_sd"].values.ravel()
    assert np.all(np.abs(report.dataset["log_likelihood_reference"].values.ravel() - expected) < 6 * noise + 0.1)


@pytest.mark.thorough
def test_report_and_figures_of_a_site(fitted, tmp_path):
    site = lfm.select_series(fitted, "b")
    names = {path.name for path in save_figures(site, tmp_path)}
    assert {"fit.png", "forces.png", "residuals.png", "pairs.png"} <= names
    assert "y1" in lfm.save_report(site, tmp_path, figures=()).read_text()
    for draw in (lfm.plot_fit, lfm.plot_forces, lfm.plot_residuals, lambda result: save_figures(result, tmp_path),
                 lambda result: lfm.save_report(result, tmp_path / "page.html")):
        with pytest.raises(ValueError, match=r"sites a, b.*select_series\(result, 'a'\)"):
            draw(fitted)


@pytest.mark.thorough
def test_dates_of_all_sites_count_from_one_midnight():
    days = {name: pd.date_range(first, periods=len(Y[name]), freq="D")
            for name, first in (("a", "2026-01-02"), ("b", "2026-01-01"))}
    result = lfm.fit(joint_model, {name: (days[name], Y[name]) for name in Y}, sampler="map", samples=2,
                     trajectory_draws=0, progress=False)
    observed = ResultView.of(result).group("observed_data")
    assert observed["a_time"].values[0] == 1.0 and observed["b_time"].values[0] == 0.0
    assert ResultView.of(result).attrs["time_origin"].startswith("2026-01-01")


def heated(times, y, inputs):
    rate = numpyro.sample("rate", dist.LogNormal(-1.0, 0.5))
    for name in ("a", "b"):
        numpyro.sample(name, likelihood(name, rate, times[name], inputs[name].get("heat")), obs=y[name])


@pytest.mark.thorough
def test_known_inputs_reach_their_site():
    heat = (np.array([0.0, 2.0]), np.array([0.5, 0.0]))
    data = {"a": lfm.Data(TIMES["a"], Y["a"], ("level",), inputs={"heat": heat}), "b": DATA["b"]}
    result = lfm.fit(heated, data, sampler="map", samples=2, trajectory_draws=0, progress=False)
    rate = float(ResultView.of(result).posterior["rate"][0, 0])
    for name, known_input in (("a", lfm.Input(*heat)), ("b", None)):
        terms = ResultView.of(result).group(f"one_step_ahead_{name}")["log_density"][0, 0]
        assert float(terms.sum()) == pytest.approx(
            float(likelihood(name, rate, TIMES[name], known_input).log_prob(Y[name])), abs=1e-9)
    longer = lfm.Input(np.array([0.0, 2.0, 7.0]), np.array([0.5, 0.0, 1.0]))
    forecast = lfm.forecast(result, heated, {"a": [6.0, 7.0]}, inputs={"a": {"heat": longer}}, progress=False)
    assert {"predictions_a", "predictions_constant_data_a"} <= set(ResultView.of(forecast).groups)
    alone = lfm.forecast(lfm.select_series(result, "a"), heated, [6.0, 7.0], inputs={"heat": longer}, progress=False)
    assert "predictions_constant_data" in ResultView.of(alone).groups
    xr.testing.assert_allclose(*(ResultView.of(view).group("predictions")["y"]
                                 for view in (alone, lfm.select_series(forecast, "a"))))
    with pytest.raises(ValueError, match="inputs: unknown likelihood site 'heat'.*a, b"):
        lfm.forecast(result, heated, {"a": [6.0, 7.0]}, inputs={"heat": longer}, progress=False)


def test_data_by_site_are_told_from_columns():
    frame = pd.DataFrame({"time": TIMES["a"], "level": Y["a"][:, 0]})
    for pair in ((TIMES["b"], Y["b"]), [TIMES["b"], Y["b"]]):
        sites = data_by_site({"a": frame, "b": pair}, None)
        assert sites["a"].outputs == ("level",) and isinstance(sites["b"], tuple)
    for columns in ({"time": TIMES["a"], "level": Y["a"][:, 0]}, dict(frame), {"time": [0.0, 1.0], "level": (2.0, 3.0)},
                    frame.set_index("time").to_xarray()):
        assert data_by_site(columns, None) is None
    with pytest.raises(TypeError, match="site 'b'.*got ndarray"):
        lfm.fit(joint_model, {"a": DATA["a"], "b": Y["b"]}, progress=False)


@pytest.mark.thorough
def test_a_finished_fit_is_read_again(fitted, folder):
    resumed = lfm.fit(joint_model, DATA, checkpoint=folder, resume=True, **SETTINGS)
    np.testing.assert_array_equal(ResultView.of(resumed).posterior["rate"],
                                  ResultView.of(fitted).posterior["rate"])
    other_data = {**DATA, "b": (TIMES["b"], 2 * Y["b"])}
    with pytest.raises(ValueError, match="data"):
        lfm.fit(joint_model, other_data, checkpoint=folder, resume=True, **SETTINGS)


@pytest.mark.thorough
def test_draws_of_numpyro(fitted):
    draws = {"rate": ResultView.of(fitted).posterior["rate"].values}
    result = lfm.to_arviz(draws, joint_model, TIMES, Y, trajectory_draws=0)
    np.testing.assert_allclose(ResultView.of(result).group("log_likelihood")["b"],
                               ResultView.of(fitted).group("log_likelihood")["b"], atol=1e-10)
