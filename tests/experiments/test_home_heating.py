"""Home heating study: data, small runs of every part, tables and figures."""

import dataclasses
import os
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy import stats

from lfm_ppl.experiments import scores
from lfm_ppl.experiments.home_heating import experiment, figures, prediction, problem
from lfm_ppl.experiments.home_heating.problem import Model

REAL = problem.data_folder()
SMALL = experiment.HomeHeatingSettings(homes=2, methods=("SQM", "none", "matern"), stores=("one store",), functions=3,
                                       particles=50)


@pytest.fixture(scope="module")
def window():
    """A simulated home."""
    return problem.home(0, "one store")


@pytest.mark.slow
def test_simulated_home_follows_its_thermostat(window):
    assert window.y.shape == (120, 3) and window.fine.shape == (149, 3) and problem.FINE.shape == (149,)
    points = window.set_points[problem.FINE.astype(int)]
    difference = window.fine[:, 0] - points
    # Measurements have an error of 0.05 K.
    assert (window.fine[difference < -0.3, 2] == 1.0).all() and (window.fine[difference > 0.3, 2] == 0.0).all()
    assert (window.set_points[:24] != window.set_points[96:]).any(), "the last day has other set points"
    np.testing.assert_array_equal(window.set_points[:24], window.set_points[72:96])
    shares = window.fine[5:, 2].reshape(-1, 6).mean(axis=1)
    np.testing.assert_allclose(shares, window.y[96:, 2])
    assert set(window.outdoor) == set(problem.OUTDOOR)


@pytest.mark.skipif(REAL is None, reason="needs ../shared/data/house")
def test_the_real_house_has_29_windows():
    windows = problem.house(str(REAL))
    assert len(windows) == 29
    np.testing.assert_array_equal(windows[0].y[24:], windows[1].y[:96])
    assert all(np.isfinite(window.y).all() and window.set_points is None for window in windows)
    assert 0.5 < max(window.y[:, 2].max() for window in windows) < 2.0


@pytest.mark.parametrize(("text", "message"), [
    (",Ti,Ta\n2020-01-01 00:00,1,1\n", "no column 'Ph'"),
    (",Ti,Ta,Ph\n2020-01-01 00:00,1,1,1\n2020-01-01 02:00,1,1,1\n", "a row an hour"),
    (",Ti,Ta,Ph\n2020-01-01 00:00,1,1,1\n2020-01-01 01:00,1,1,1\n", "five whole days")])
def test_invalid_files(tmp_path, text, message):
    (tmp_path / problem.FILE).write_text(text)
    with pytest.raises(ValueError, match=message):
        problem.house(str(tmp_path))


def test_without_data_there_are_simulated_homes_only(tmp_path, monkeypatch):
    monkeypatch.setenv("LFM_DATA", str(tmp_path))
    assert problem.data_folder() is None
    assert all(task.name.startswith("homes/") for task in experiment.tasks(SMALL))
    with pytest.raises(FileNotFoundError, match="leave --data out"):
        problem.data_folder(str(tmp_path))


def test_a_window_without_set_points_cannot_be_predicted_under_a_thermostat():
    window = problem.Window(np.zeros((120, 3)), {})
    with pytest.raises(ValueError, match="needs a set point"):
        prediction.predict_under_thermostat(Model("SQM", "one store", 3), window, np.zeros(6), 10, jax.random.key(0))


def test_mask_of_the_fifth_day():
    y = np.ones((120, 3))
    hidden = np.isnan(prediction.mask_fifth_day(y))
    assert hidden[96:, 0].all() and hidden.sum() == 24
    is_hidden = np.isnan(prediction.mask_fifth_day(y, tracked=True))[:, 0]
    assert (np.flatnonzero(~is_hidden[96:]) == [3, 6, 9, 12, 15, 18, 21]).all() and not is_hidden[:96].any()
    assert np.isnan(prediction.mask_fifth_day(y, weather=False))[96:, :2].all()


def test_gaussian_scores_against_scipy():
    generator = np.random.default_rng(0)
    mean, sd, truth = generator.normal(size=24), generator.uniform(0.5, 2.0, 24), generator.normal(size=24)
    result = prediction.gaussian_scores(mean, sd**2, truth)
    low, high = stats.norm(mean, sd).interval(0.95)
    assert result["ell"] == pytest.approx(stats.norm(mean, sd).logpdf(truth).sum())
    assert result["rmse"] == pytest.approx(np.sqrt(np.mean((mean - truth) ** 2)))
    assert result["inside"] == np.mean((low <= truth) & (truth <= high))


@pytest.mark.slow
def test_the_most_likely_parameters(window):
    """No residual: the search ends where nothing near is better."""
    model = Model("none", "one store", 3)
    z, density = prediction.find_mode(model, window)
    objective = prediction._log_posterior(model).objective(window.learnt)
    value, gradient = objective.value_and_gradient(z)
    assert density == pytest.approx(-value)
    np.testing.assert_allclose(gradient, 0.0, atol=1e-2)
    assert model.names == ("alpha", "beta", "noise_sd")
    for step in 0.05 * np.eye(3):
        assert min(objective.value(z + step), objective.value(z - step)) > value


@pytest.mark.slow
def test_both_predictions(window):
    model = Model("none", "one store", 3)
    z, _ = prediction.find_mode(model, window)
    tracked = prediction.predict_with_known_heater(model, window, z)
    assert tracked["ahead_rmse"] < 1.5 and tracked["mean"].shape == (24,)
    result, forecast = prediction.predict_under_thermostat(model, window, z, 200, jax.random.key(0))
    assert result["rmse"] < 1.5 and result["mean"].shape == result["on"].shape == (144,)
    truth = window.fine[prediction.SCORED, 0]
    density = forecast.observed.log_density(window.fine[:, :2])[prediction.SCORED, 0]
    assert result["ell"] == pytest.approx(float(density.sum()))
    assert result["rmse"] == pytest.approx(scores.rmse(result["mean"], truth))
    assert ((result["on"] >= 0) & (result["on"] <= 1 + 1e-12)).all()


def synthetic_results(settings):
    """Results of every task."""
    generator, results = np.random.default_rng(0), {}
    for index, task in enumerate(experiment.tasks(settings)):
        kind = task.name.split("/")[0]
        if kind == "homes":
            rmse = 0.5 + 0.1 * index + 0.01 * np.arange(settings.homes)
            result = {"rmse": rmse, "ell": -100 * rmse, "inside": np.full(settings.homes, 0.9),
                      "mean": np.full((settings.homes, 144), 18.0), "on": generator.uniform(size=(settings.homes, 144)),
                      "quantiles": 18.0 + np.linspace(-1, 1, 5)[:, None] * np.ones(144)}
        elif kind == "house":
            count = task.settings["windows"]
            rmse = 0.3 + 0.1 * index + 0.01 * np.arange(count)
            result = {f"{prediction_kind}_{name}": value for prediction_kind in ("ahead", "track", "blind")
                      for name, value in (("rmse", rmse), ("ell", -20 * rmse), ("inside", np.full(count, 0.95)))}
            result |= {"mean": np.full((count, 24), 19.0), "sd": np.ones((count, 24)),
                       "residual": generator.normal(size=120), "residual_sd": np.ones(120)}
        else:
            result = {"ell": np.array([-4.0, -8.0]), "point_ell": np.array([-5.0, -11.0]), "rmse": np.ones(2),
                      "point_rmse": np.ones(2), "r_hat": np.full(2, 1.01), "ess": np.full(2, 300.0),
                      "mean": np.full((2, 6), 0.1 if task.settings["sampler"] == "NUTS" else 0.0),
                      "sd": np.full((2, 6), 0.5), "divergences": np.ones(2), "seconds": np.full(2, 7.0)}
        results[task.name] = {**result, "cpu_s": 2.0}
    return results


def test_tables_of_simulated_homes(window):
    data = experiment.STUDY.collect(SMALL, synthetic_results(SMALL))
    tables = experiment.tables(SMALL, data)
    assert [name for name, table in tables.items() if table.stored] == ["homes-one-store"]
    table = tables["homes-one-store"].frame
    assert list(table.index) == ["SQM", "none", "matern"]
    assert table.loc["SQM", "RMSE ahead (K)"] == pytest.approx(0.505)
    assert table.loc["SQM", "published RMSE ahead (K)"] == 1.0
    assert table.loc["SQM", "RMSE below none (K)"] == pytest.approx(0.1)
    assert table.loc["SQM", "ELL above matern"] == pytest.approx(20.0)
    all_figures = figures.draw(SMALL, data)
    assert set(all_figures) == {"homes-ahead", "scores"}
    assert "means over 2 homes" in tables["homes-one-store"].title


@pytest.mark.skipif(REAL is None, reason="needs ../shared/data/house")
def test_tables_and_figures_with_the_real_house(window, tmp_path):
    settings = experiment.HomeHeatingSettings(data=str(REAL), homes=2, windows=3, methods=SMALL.methods, every=2)
    results = experiment.STUDY.tabulate(settings, synthetic_results(settings))
    assert list(results.tables) == ["house-one-store", "homes-one-store", "posterior", "house-envelope",
                                    "homes-envelope"]
    integrated = results.tables["posterior"].loc["integrated out by NUTS"]
    assert integrated["gain in ELL"] == pytest.approx(2.0) and integrated["divergences"] == 2
    assert integrated["means from RAM (sd)"] == pytest.approx(0.2)
    table, envelope = results.tables["house-one-store"], results.tables["house-envelope"]
    assert table.loc["none", "published ELL tracked"] == 31 and envelope.loc["SQM", "published RMSE ahead (K)"] == 0.22
    assert np.isnan(envelope.loc["matern", "published RMSE ahead (K)"])
    assert scores.readable(table).loc["none", "RMSE below none (K)"] == "0"
    swapped = dataclasses.replace(settings, stores=("envelope", "one store"))
    swapped_table = experiment.STUDY.tabulate(swapped, synthetic_results(swapped)).tables["house-one-store"]
    assert swapped_table.loc["none", "published ELL tracked"] == 31
    written = {path.name for path in experiment.STUDY.save(results, tmp_path)}
    assert {"house-ahead.png", "homes-ahead.png", "residual.png", "scores.png", "house-envelope.md"} <= written
    assert "2 windows" in results.study_tables["posterior"].title
    assert "3 windows" in results.study_tables["house-envelope"].title


def test_the_integrated_residual_must_be_a_method():
    with pytest.raises(ValueError, match="--integrated must be one of --methods"):
        experiment.HomeHeatingSettings(integrated="WQM", methods=("SQM",))


def test_a_residual_that_is_not_in_the_published_figure_is_drawn():
    settings = dataclasses.replace(SMALL, methods=("WQM",), integrated="WQM")
    data = experiment.STUDY.collect(settings, synthetic_results(settings))
    assert set(figures.draw(settings, data)) == {"homes-ahead", "scores"}


@pytest.mark.slow
def test_quick_version_resumes(tmp_path):
    settings = experiment.HomeHeatingSettings.quick(
        data=None if REAL is None else str(REAL), methods=("SQM", "none"), homes=1)
    first = experiment.STUDY.run(settings, tmp_path)
    lines: list[str] = []
    resumed = experiment.STUDY.run(settings, tmp_path, report=lines.append)
    assert "stored already" in lines[0]
    for name, table in first.tables.items():
        assert table.equals(resumed.tables[name])
    assert os.listdir(tmp_path / "tasks") and Path(tmp_path).is_dir()


@pytest.mark.slow
def test_nuts_and_ram_have_the_same_posterior(window):
    model = Model("none", "one store", 3)
    z, _ = prediction.find_mode(model, window)
    nuts = prediction.posterior("NUTS", model, window, z, jax.random.key(0), (2, 300, 700))
    ram = prediction.posterior("RAM", model, window, z, jax.random.key(1), (4, 1000, 4000))
    assert nuts["divergences"] == 0 and max(nuts["r_hat"].max(), ram["r_hat"].max()) < 1.03
    error = np.sqrt(1 / nuts["ess"] + 1 / ram["ess"])
    assert (np.abs(nuts["mean"] - ram["mean"]) < 4 * error * nuts["sd"]).all()
    np.testing.assert_allclose(nuts["sd"], ram["sd"], rtol=4 * error.max())
