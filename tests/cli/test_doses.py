"""Doses in a column of a data file, from the file to the forecast."""

from __future__ import annotations

import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl.io.data import write_csv
from lfm_ppl.io.loading import load
from lfm_ppl.results import arviz_data
from lfm_ppl.results.result_view import ResultView

MODEL = '''"""A drug in the blood."""
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist
import lfm_ppl as lfm

OUTPUTS = ("blood",)


def model(times, y=None, events=()):
    ke = numpyro.sample("ke", dist.LogNormal(-1.0, 0.5))
    system = lfm.LatentForceModel(
        lambda x, u, t: jnp.stack([-1.3 * x[0], 1.3 * x[0] - ke * x[1]]), {},
        lfm.GaussianObservation(lambda x, u, t: x[1:], jnp.array([0.01])),
        lfm.Gaussian(jnp.zeros(2), jnp.zeros((2, 2))), state_names=("gut", "blood"), output_names=OUTPUTS,
        events=events)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)
'''

ROWS = "time,AMT,blood\n0,4,\n1,,1.8\n2,,2.4\n4,0,1.9\n8,4,0.9\n10,,2.6\n"


@pytest.fixture
def files(tmp_path):
    (tmp_path / "drug.py").write_text(MODEL)
    (tmp_path / "drug.csv").write_text(ROWS)
    (tmp_path / "later.csv").write_text("time,AMT,blood\n12,4,\n14,,\n")
    return tmp_path


def test_doses_are_the_rows_with_an_amount(files):
    data = lfm.read_csv(files / "drug.csv", ["blood"], inputs={"AMT": "dose:gut"})
    (dose,) = data.doses()
    assert dose.times.tolist() == [0.0, 8.0] and dose.values.tolist() == [4.0, 4.0] and dose.state == "gut"
    assert data.known_inputs() == {}
    write_csv(data, files / "copy.csv")
    copy = lfm.read_csv(files / "copy.csv", ["blood"], inputs={"AMT": "dose:gut"})
    assert copy.inputs["AMT"].times.tolist() == [0.0, 8.0]
    keywords = load(str(files / "drug.py")).keywords(data, {})
    assert [event.state for event in keywords["events"]] == ["gut"]


def test_two_doses_at_one_time_are_refused(files):
    (files / "drug.csv").write_text("time,AMT,blood\n0,4,\n0,4,\n1,,1.8\n")
    with pytest.raises(ValueError, match="their sum"):
        lfm.read_csv(files / "drug.csv", ["blood"], inputs={"AMT": "dose:gut"})


@pytest.mark.thorough
def test_doses_of_a_file_reach_the_fit_and_the_forecast(files, run):
    status, _, errors = run(f"fit {files}/drug.py --data {files}/drug.csv --events AMT:gut --out out --sampler map "
                            "--samples 50")
    assert status == 0, errors
    # The rows after the data repeat the doses of the last interval, so that the forecast must rise after the dose.
    status, _, errors = run(f"forecast out --held-out {files}/later.csv --events AMT:gut --out ahead --draws 20")
    assert status == 0, errors
    stored = ResultView.of(arviz_data.load("ahead")).group("predictions")["y"].mean(("chain", "draw", "output"))
    assert stored.sel(time=14.0) > 2.0 > stored.sel(time=12.0)
    assert "forecast-inputs.png" in {path.name for path in (files / "ahead").iterdir()}


def test_a_column_without_a_state_is_refused(files, run):
    status, _, errors = run(f"fit {files}/drug.py --data {files}/drug.csv --events AMT")
    assert status == 2 and "--events takes COLUMN:STATE" in errors


@pytest.mark.parametrize("name", ["pharmacokinetics", "drug.py"])
def test_a_state_that_does_not_exist_is_named(files, run, name):
    model = name if name == "pharmacokinetics" else files / name
    status, _, errors = run(f"fit {model} --data {files}/drug.csv --outputs blood --events AMT:gutt --sampler map")
    assert status == 2 and "'gutt'" in errors and "gut, blood" in errors and errors.count("\n") == 1, errors


PANEL = MODEL.replace("""    ke = numpyro.sample("ke", dist.LogNormal(-1.0, 0.5))
    system = lfm""", """    def build(p):
      ke = p["ke"]
      return lfm""").replace("""        events=events)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)
""", """        events=p["events"])

    with numpyro.plate("subject", len(times)):
        ke = numpyro.sample("ke", dist.LogNormal(-1.0, 0.5))
        numpyro.sample("y", lfm.panel(build, {"ke": ke, "events": events}, times), obs=y)
""")


@pytest.mark.thorough
def test_subjects_of_a_file_are_fitted_together_with_their_doses(files, run):
    (files / "panel.py").write_text(PANEL)
    rows = [f"{subject},{row}" for subject, shift in (("Ann", 0), ("Bo", 2)) for row in ROWS.splitlines()[1 + shift:]]
    rows[4] = rows[4].replace(",8,4,", ",8,,")  # Ann has one dose
    (files / "panel.csv").write_text("\n".join(["subject,time,AMT,blood", *rows, ""]))
    status, _, errors = run(f"fit {files}/panel.py --data {files}/panel.csv --series subject --events AMT:gut "
                            "--sampler map --samples 20 --out panel")
    assert status == 0, errors
    result = arviz_data.load("panel")
    doses = ResultView.of(result).group("constant_data")
    assert doses["AMT of series Ann"].values.tolist() == [4.0] and doses["AMT of series Bo"].values.tolist() == [4.0]
    assert "trajectories" in ResultView.of(result).groups
    assert list(ResultView.of(lfm.select_series(result, "Ann")).group("constant_data")) == ["AMT"]
    # Bo alone, whose rows begin later, with a further dose; the panel with the doses of both.
    lfm.save(lfm.select_series(result, "Bo"), files / "bo")
    status, _, errors = run(f"forecast bo --held-out {files}/later.csv --events AMT:gut --draws 10 --out ahead")
    assert status == 0, errors
    forecast = arviz_data.load("ahead")
    alone = ResultView.of(forecast).group("predictions")["outputs"][..., 0]
    assert alone.dims == ("chain", "draw", "time") and alone["time"].values.tolist() == [12.0, 14.0]
    assert ResultView.of(forecast).group("predictions_constant_data")["AMT"].values.tolist()[-2:] == [4.0, 4.0]
    python_forecast = lfm.forecast(lfm.select_series(result, "Bo"), load(str(files / "panel.py")).model, [12.0, 14.0],
                                   draws=10, inputs={"AMT": ([8.0, 12.0], [4.0, 4.0], "dose:gut")}, progress=False)
    np.testing.assert_allclose(ResultView.of(python_forecast).group("predictions")["outputs"][..., 0], alone)
    rate = float(ResultView.of(lfm.select_series(result, "Bo")).posterior["ke"][0, 0])
    expected = sum(4 * 1.3 / (1.3 - rate) * (np.exp(-rate * gap) - np.exp(-1.3 * gap)) for gap in (6.0, 2.0))
    assert float(alone[0, 0, 1]) == pytest.approx(expected, rel=1e-6)
