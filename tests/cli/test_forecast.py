"""``lfm-ppl forecast``, and ``fit --until`` and ``--at``: predictions in files and figures."""

import numpy as np
import pandas as pd
import pytest

import lfm_ppl as lfm
from lfm_ppl.results import arviz_data
from lfm_ppl.results.result_view import ResultView


def test_fit_until_and_at_stores_predictions_with_their_noise(original):
    result = ResultView.of(arviz_data.load(original)).group("predictions")
    assert {0.0, 5.0, 6.25, 8.0} <= set(result["time"].values.tolist())
    assert result["y"].dims == ("chain", "draw", "time", "output")
    np.testing.assert_allclose(result["y_sd"], np.hypot(0.25, result["outputs_sd"]))
    assert (result["outputs_sd"].sel(time=2.0) > 0.05).all()  # of the smoother, given the parameters
    assert (result["outputs_sd"].sel(time=[6.25, 8.0]) == 0).all()  # along each path, which is simulated there
    assert result["y"].values[..., -1, :].std() > result["outputs"].values[..., -1, :].std() > 0.3
    assert result.attrs["last_observation"] == 5.0


def test_a_forecast_writes_table_figures_group_and_scores(run, fitted, tmp_path):
    held_out = tmp_path / "later.csv"
    held_out.write_text("time,x\n6,-0.9\n7,\n7.5,-1.2\n")
    status, out, err = run(f"forecast {fitted} --held-out {held_out} --draws 30 --out ahead")
    assert status == 0, err
    folder = tmp_path / "ahead"
    assert {path.name for path in folder.iterdir()} == {
        "posterior.nc", "forecast.csv", "forecast.png", "forecast-states.png", "scores.csv", "report.html"}
    stored = arviz_data.load(folder)
    later = ResultView.of(stored).group("held_out_data")["y"]
    np.testing.assert_array_equal(later.sel(output="x"), [-0.9, np.nan, -1.2])
    table = pd.read_csv(folder / "forecast.csv")
    assert table["time"].tolist() == [6.0, 7.0, 7.5] and (table["q97.5"] > table["noise_free_q97.5"]).all()
    scores = pd.read_csv(folder / "scores.csv", index_col="output")
    expected = lfm.score(stored, lfm.Data([6.0, 7.0, 7.5], [[-0.9], [np.nan], [-1.2]], ("x",)))
    np.testing.assert_allclose(scores.to_numpy(float), expected.to_numpy(float))
    page = (folder / "report.html").read_text()
    assert f"lfm-ppl forecast {fitted} --held-out" in page and page.count("data:image/png;base64,") == 2
    assert run(f"forecast {folder} --until 8 --draws 30 --overwrite")[0] == 0
    assert pd.read_csv(folder / "forecast.csv")["time"].tolist() == [6.0, 7.0, 8.0]  # at the spacing of the data
    assert "held_out_data" not in ResultView.of(arviz_data.load(folder)).groups


@pytest.mark.thorough
def test_predictions_are_replaced_only_with_overwrite(run, fitted):
    stored_predictions = ResultView.of(arviz_data.load(fitted)).group("predictions")
    status, _, err = run(f"forecast {fitted} --at 9")
    assert status == 2 and "already holds predictions" in err and not (fitted / "forecast.csv").exists()
    assert ResultView.of(arviz_data.load(fitted)).group("predictions").equals(stored_predictions)
    status, _, err = run(f"forecast {fitted} --at 6,7,7.5 --overwrite --draws 30")
    assert status == 0, err
    replaced_result = arviz_data.load(fitted)
    assert ResultView.of(replaced_result).group("predictions")["time"].values.tolist() == [6.0, 7.0, 7.5]
    assert "trajectories" in ResultView.of(replaced_result).groups


@pytest.mark.slow
def test_a_forecast_of_a_partial_result_has_its_figure(run, fitted):
    result = arviz_data.load(fitted)
    partial = arviz_data.build({name: ResultView.of(result).group(name) for name in ("posterior", "data")},
                               {**ResultView.of(result).attrs, "partial": "60 of 90 draws a chain"})
    arviz_data.save(partial, fitted / "posterior.nc", overwrite=True)
    status, out, err = run(f"forecast {fitted} --until 8")
    assert status == 0 and f"wrote    {fitted / 'forecast.png'}" in out, err


@pytest.mark.parametrize(("flags", "words"), [
    ("", "no times to forecast"), ("--until 3", "--until"), ("--at soon", "--at"), ("--at 7,inf", "finite"),
    ("--at 7 --outputs x", "--outputs"), ("--held-out none.csv", "none.csv"), ("--at=-4", "initial time"),
])
def test_mistakes_are_one_line(run, original, tmp_path, flags, words):
    status, _, err = run(f"forecast {original} {flags} --out new")
    assert status == 2 and words in err and err.count("\n") == 1, err
    assert not (tmp_path / "new").exists()
