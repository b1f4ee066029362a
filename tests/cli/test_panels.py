"""Several series of one file, fitted together."""

import numpy as np
import pandas as pd
import pytest

import lfm_ppl as lfm
from lfm_ppl.io import loading

MODEL = '''"""Decays about a common rate."""
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

OUTPUTS = ("x",)


def model(times, y=None):
    common = numpyro.sample("common", dist.Normal(-0.5, 0.3))
    with numpyro.plate("patient", len(times)):
        rate = numpyro.sample("rate", dist.LogNormal(common, 0.3))
        numpyro.sample("y", lfm.panel(lambda rate: lfm.LatentForceModel(
            lambda x, u, t: u - rate * x, {"u": lfm.Matern(0.3, 1.0)},
            lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.05])),
            lfm.Gaussian(jnp.ones(1), 0.1 * jnp.eye(1)), output_names=OUTPUTS), rate, times), obs=y)
'''

DATA = "time,x,who\n0,1.1,Bo\n0.5,0.9,Ann\n1,0.8,Bo\n2,,Ann\n3,0.3,Bo\n4,0.4,Ann\n5,0.1,Bo\n"
"""Bo has four rows, Ann three."""


@pytest.fixture
def files(tmp_path):
    (tmp_path / "decays.py").write_text(MODEL)
    (tmp_path / "all.csv").write_text(DATA)
    return tmp_path


def test_a_model_file_that_calls_panel_is_found_without_running_it(files):
    assert loading.is_panel(str(files / "decays.py"))
    (files / "other.py").write_text('"""No lfm.panel(...) here."""\nraise SystemExit\n')
    assert not loading.is_panel(str(files / "other.py")) and not loading.is_panel("spring")


@pytest.mark.parametrize("text", ["--data all.csv", "--data all.csv --series who --jobs 2",
                                  "--data all.csv --series whom"])
def test_what_is_missing_is_one_line(run, files, text):
    status, _, err = run(f"fit decays.py --sampler map {text}")
    assert status == 2 and "series" in err and len(err.splitlines()) == 1


@pytest.mark.slow
def test_a_panel_is_fitted_checked_and_forecast(run, files):
    status, out, err = run("fit decays.py --data all.csv --series who --sampler map --samples 20 --until 6 --out fit")
    assert status == 0 and "2 series of up to 4 rows of x" in out, err
    result = lfm.load(files / "fit")
    assert result["posterior"]["rate"].dims == ("chain", "draw", "patient")
    assert result["posterior"]["patient"].values.tolist() == ["Bo", "Ann"]
    ann = lfm.select_series(result, "Ann")["data"]
    np.testing.assert_array_equal(ann["time"], [0.5, 2.0, 4.0])
    assert (files / "fit" / "report.html").is_file() and (files / "fit" / "fit.png").is_file()
    assert run("check fit --draws 8")[0] == 0
    status, _, err = run("forecast fit --at 6,7 --draws 10 --out ahead")
    assert status == 0, err
    table = pd.read_csv(files / "ahead" / "forecast.csv")
    assert table["patient"].tolist() == ["Bo", "Bo", "Ann", "Ann"] and table["time"].tolist() == [6.0, 7.0] * 2
    assert "--series who" in lfm.load(files / "fit").attrs["command_line"]
