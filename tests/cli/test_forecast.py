"""``lfm-ppl forecast``, and ``fit --until`` and ``--at``: predictions in files and figures."""

import shlex
import shutil

import numpy as np
import pandas as pd
import pytest

import lfm_ppl as lfm
from lfm_ppl.cli import main
from lfm_ppl.results import arviz_data
from tests.cli.test_check import WELL


def run(line, capsys=None):
    try:
        code = main(shlex.split(line))
    except SystemExit as exit_:
        code = exit_.code
    captured = capsys.readouterr() if capsys else None
    return (code, captured.out, captured.err) if capsys else code


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A results folder that was made with --until, and its model file."""
    folder = tmp_path_factory.mktemp("forecast")
    (folder / "well.py").write_text(WELL)
    assert run(f"fit {folder / 'well.py'} --sampler map --samples 60 --quiet --steps 4 --until 8 --at 6.25 "
               f"--out {folder / 'result'}") == 0
    return folder


@pytest.fixture
def result(folder, tmp_path):
    return shutil.copytree(folder / "result", tmp_path / "result")


def test_fit_until_and_at_stores_predictions_with_their_noise(folder):
    result = arviz_data.group(arviz_data.load(folder / "result"), "predictions")
    times = result["time"].values
    assert {0.0, 5.0, 6.25, 8.0} <= set(times.tolist())
    assert result["y"].dims == ("chain", "draw", "time", "output")
    np.testing.assert_allclose(result["y_sd"], np.hypot(0.3, result["outputs_sd"]))
    assert (result["outputs_sd"].sel(time=2.0) > 0.05).all()  # of the smoother, given the parameters
    assert (result["outputs_sd"].sel(time=[6.25, 8.0]) == 0).all()  # along each path, which is simulated there
    assert result["y"].values[0, :, -1].std() > result["outputs"].values[0, :, -1].std() > 0.3
    assert result.attrs["last_observation"] == 5.0


def test_forecast_of_a_stored_result_writes_table_figure_group_and_scores(result, tmp_path, capsys):
    held_out = tmp_path / "later.csv"
    held_out.write_text("time,x\n6,-0.9\n7,\n7.5,-1.2\n")
    code, out, err = run(f"forecast {result} --held-out {held_out} --draws 30 --out {tmp_path / 'ahead'}",
                         capsys)
    assert code == 0, err
    ahead = tmp_path / "ahead"
    assert {path.name for path in ahead.iterdir()} == {
        "posterior.nc", "forecast.csv", "forecast.png", "forecast-states.png", "scores.csv", "report.html"}
    for path in ahead.iterdir():
        assert f"wrote    {path}" in out
    page = (ahead / "report.html").read_text()
    later = arviz_data.group(arviz_data.load(tmp_path / "ahead" / "posterior.nc"), "held_out_data")["y"]
    np.testing.assert_array_equal(later.sel(output="x"), [-0.9, np.nan, -1.2])
    assert "<h3>Scores on the held-out data</h3>" in page and f"\nlfm-ppl forecast {result} --held-out" in page
    assert "after the last observation" in page and page.count("data:image/png;base64,") == 2
    assert "Forecast of the states" in page
    table = pd.read_csv(ahead / "forecast.csv")
    assert set(table["output"]) == {"x"}
    assert table["time"].tolist() == [6.0, 7.0, 7.5]
    assert (table["q97.5"] > table["noise_free_q97.5"]).all()
    stored = arviz_data.load(ahead)
    scores = pd.read_csv(ahead / "scores.csv", index_col="output")
    expected = lfm.score(stored, lfm.Data([6.0, 7.0, 7.5], [[-0.9], [np.nan], [-1.2]], ("x",)))
    np.testing.assert_allclose(scores.to_numpy(float), expected.to_numpy(float))
    assert scores.loc["x", "n"] == 2
    assert len(arviz_data.group(arviz_data.load(result), "predictions")["time"]) > 200  # what was there is kept
    assert run(f"forecast {ahead} --until 8 --draws 30 --overwrite", capsys)[0] == 0
    assert "held_out_data" not in arviz_data.groups(arviz_data.load(ahead))


@pytest.mark.slow
def test_a_forecast_of_a_partial_result_has_its_figure(result, capsys):
    whole = arviz_data.load(result)
    partial = arviz_data.build({name: arviz_data.group(whole, name) for name in ("posterior", "observed_data")},
                               {**arviz_data.attributes(whole), "partial": "60 of 90 draws a chain"})
    arviz_data.save(partial, result / "posterior.nc", overwrite=True)
    code, out, err = run(f"forecast {result} --until 8", capsys)
    assert code == 0 and f"wrote    {result / 'forecast.png'}" in out, err


def test_predictions_that_exist_are_replaced_only_if_asked(result, capsys):
    before = arviz_data.group(arviz_data.load(result), "predictions")
    code, _, err = run(f"forecast {result} --at 9", capsys)
    assert code == 2
    assert "already holds predictions" in err
    assert arviz_data.group(arviz_data.load(result), "predictions").equals(before)
    assert not (result / "forecast.csv").exists()
    code, _, err = run(f"forecast {result} --at 6,7,7.5 --overwrite --draws 30", capsys)
    assert code == 0, err
    after = arviz_data.load(result)
    assert arviz_data.group(after, "predictions")["time"].values.tolist() == [6.0, 7.0, 7.5]
    assert arviz_data.has_group(after, "trajectories")


@pytest.mark.parametrize(("flags", "message"), [
    ("", "no times to forecast"), ("--until 3", "after the last observation, at 5"),
    ("--at soon", "Separate times by commas"), ("--at 7,inf", "finite times, separated by commas"),
    ("--at 7 --outputs x", "--outputs is about a data file"), ("--held-out none.csv", "none.csv"),
    ("--at -4", "initial time"),
])
def test_what_cannot_be_forecast(result, tmp_path, capsys, flags, message):
    code, _, err = run(f"forecast {result} {flags.replace('--at -4', '--at=-4')} --out {tmp_path / 'new'}", capsys)
    assert code == 2
    assert message in err and err.count("\n") == 1
    assert not (tmp_path / "new").exists()
