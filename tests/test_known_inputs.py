"""Known inputs from a table to the model, the result, and back; and tables of other libraries."""

import pathlib
import warnings

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pandas as pd
import pytest
import xarray as xr

import lfm_ppl as lfm
from lfm_ppl.cli import main
from lfm_ppl.io.data import write_csv
from lfm_ppl.plots import plot_fit
from lfm_ppl.results import arviz_data, rebuilding
from lfm_ppl.results.result_view import ResultView

HOUSE = """date,indoor,heater,outside
2026-01-05 06:00,18.0,0,5
2026-01-05 06:30,,2,
2026-01-05 07:00,19.5,2,4
2026-01-05 08:00,20.1,,6
"""
MODEL = '''"""A house."""
import jax.numpy as jnp, numpyro, numpyro.distributions as dist, lfm_ppl as lfm
OUTPUTS = ("T",)
UNITS = {"time": "h"}
INPUTS = {"power": "zero", "weather": "linear"}
def model(times, y=None, inputs=None):
    rate = numpyro.sample("rate", dist.LogNormal(0.0, 1.0))
    house = lfm.LatentForceModel(
        lambda x, u, t: inputs["power"](t) - rate * (x - inputs["weather"](t)), {},
        lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])), lfm.Gaussian([18.0], [1.0]))
    numpyro.sample("y", lfm.MarginalLikelihood(house, times, steps=1), obs=y)
'''
DOSES = "time,conc,dose_rate\n0,,100\n1,8.1,\n2,6.6,.\n4,4.5,50\n4,4.4,\n8,2.0,\n"


def test_blank_cells_are_joined_held_or_zero(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text(HOUSE)
    with pytest.warns(UserWarning, match="'outside'"):
        inputs = lfm.read_csv(path, ["indoor"], inputs={"heater": "zero", "outside": "linear"}).known_inputs()
    assert [float(inputs["heater"](t)) for t in (360.0, 375.0, 390.0, 479.0, 480.0)] == [0, 0, 2, 2, 0]
    assert [float(inputs["outside"](t)) for t in (360.0, 390.0, 450.0)] == [5.0, 4.5, 5.0]

    def rates(inputs):
        rate = lfm.read_csv(path, ["conc"], inputs=inputs).known_inputs()["dose_rate"]
        return [float(rate(t)) for t in (0.0, 0.5, 1.0, 3.9, 4.0, 7.9, 8.0)]

    path.write_text(DOSES)
    with pytest.warns(UserWarning, match="'dose_rate': 3 of 6"):  # the cell at t = 4 beside one with a dose is no blank
        assert rates(["dose_rate"]) == [100, 100, 100, 100, 50, 50, 50]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert rates({"dose_rate": "zero"}) == [100, 100, 0, 0, 50, 50, 0]
        path.write_text(DOSES.replace("100", ""))
        assert rates({"dose_rate": "zero"}) == [0, 0, 0, 0, 50, 50, 0]
        with pytest.raises(ValueError, match="dose_rate"):
            rates(["dose_rate"])


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")
def test_the_command_line_maps_columns_to_the_model_s_names_and_unit(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "house.csv").write_text(HOUSE)
    (tmp_path / "house.py").write_text(MODEL)
    assert main(["fit", "house.py", "--data", "house.csv", "--outputs", "indoor", "--inputs", "heater,outside:linear",
                 "--sampler", "map", "--samples", "10", "--out", "out", "--quiet"]) == 0
    result = lfm.load("out")
    assert {name: table.interpolation for name, table in ResultView.of(result).inputs.items()} == {
        "power": "previous", "weather": "linear"}
    assert ResultView.of(result).inputs["power"].values.tolist() == [0.0, 2.0, 2.0, 0.0]
    observed = ResultView.of(result).group("data")
    np.testing.assert_allclose(observed["time"], [6.0, 6.5, 7.0, 8.0], rtol=1e-15)
    assert observed["output"].values.tolist() == ["T"]
    room = pathlib.Path(__file__).parent.parent / "docs" / "examples" / "room.py"
    assert main(["models", str(room)]) == 0


@pytest.mark.parametrize(("text", "parts"), [
    ("date,x,h\n2026-01-05,1,1\n2026-01-05,2,3\n", ("row 3", "'h'")),
    ("date,x,h\n2026-10-25 02:30,1,1\n2026-10-25 02:15,2,3\n", ("row 3", "UTC")),
    ("a,b,x,h\n2026-01-05,2026-01-05,1,1\n", ("a, b",)),
    ("time_h,x,h\n1,1,1\n", ("'time_h'",)),
])
def test_wrong_tables_are_named_with_the_row(tmp_path, text, parts):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(ValueError) as raised:
        lfm.read_csv(path, ["x"], inputs=["h"], time_unit="min")
    assert [part for part in parts if part not in str(raised.value)] == []


def test_tables_of_other_libraries_are_read():
    times = pd.date_range("2026-01-05", periods=4, freq="30min")
    columns = {"x": [1.0, np.nan, 3.0, 4.0], "heater": [0.0, 1.0, 1.0, 0.0]}
    frame = pd.DataFrame(columns, index=times)
    frames = [frame, frame.rename_axis("date").reset_index(), frame.convert_dtypes(),
              frame.tz_localize("Europe/Berlin"),
              xr.Dataset({name: ("time", values) for name, values in columns.items()}, {"time": times}),
              {"time_min": [0, 30, 60, 90], **columns}]
    for frame in frames:
        data = lfm.read_table(frame, inputs=["heater"])
        np.testing.assert_array_equal(data.times, [0, 30, 60, 90])
        assert data.units == {"time": "min"}
        np.testing.assert_array_equal(data.y, [[1], [np.nan], [3], [4]])
        np.testing.assert_array_equal(data.inputs["heater"].values, [0, 1, 1, 0])


def test_what_is_written_is_read_back(tmp_path):
    times = np.array([0.0, 1.5, 3.0])
    data = lfm.Data(times, np.array([[1.0], [np.nan], [2.0]]), ("x",), units={"time": "h"},
                    inputs={"u": (times, np.array([3.0, 4.0, 5.0]))})
    write_csv(data, tmp_path / "written.csv")
    loaded = lfm.read_csv(tmp_path / "written.csv", inputs=["u"])
    np.testing.assert_array_equal(loaded.y, data.y)
    np.testing.assert_array_equal(loaded.inputs["u"].values, data.inputs["u"].values)


def heated(times, y=None, inputs=None):
    rate = numpyro.sample("rate", dist.LogNormal(-2.0, 0.5))
    room = lfm.LatentForceModel(lambda x, u, t: u - rate * (x - inputs["outside"](t)), {"sun": lfm.Matern(1.0, 2.0)},
                                lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
                                lfm.Gaussian(jnp.array([18.0]), jnp.eye(1)))
    numpyro.sample("y", lfm.MarginalLikelihood(room, times, steps=1), obs=y)


@pytest.mark.slow
def test_a_fit_takes_a_table_and_its_result_remembers_inputs_and_dates(tmp_path):
    hours = pd.date_range("2026-01-05", periods=6, freq="h")
    frame = pd.DataFrame({"room": 18.0 + np.arange(6.0), "outside": np.linspace(5.0, 7.0, 6)}, index=hours)
    data = lfm.read_table(frame, inputs={"outside": "linear"})
    result = lfm.fit(heated, data, sampler="map", samples=10, trajectory_draws=5, progress=False)
    loaded = arviz_data.load(arviz_data.save(result, tmp_path / "posterior.nc"))
    np.testing.assert_array_equal(ResultView.of(loaded).inputs["outside"].values, data.inputs["outside"].values)
    assert ResultView.of(loaded).inputs["outside"].interpolation == "linear"
    assert ResultView.of(loaded).attrs["time_origin"] == "2026-01-05T00:00:00"
    assert ResultView.of(loaded).group("data")["time"].attrs["units"] == "h"
    # The model is bound again with the inputs that the result holds, and gives the densities that it records.
    rebuilt = rebuilding.problem(loaded, heated)
    assert np.isfinite(rebuilt.bound.log_density(np.zeros(rebuilt.bound.size)))
    assert "Jan 2026" in plot_fit(loaded).axes[0].get_xlabel()
    # A forecast remembers the inputs that it goes on with, and a warning names times as the data do.
    longer = lfm.Input(np.arange(12.0), 5.0 + 0.4 * np.arange(12.0), "linear")
    with pytest.warns(UserWarning, match="2026-01-05T13:00"):
        forecast = lfm.forecast(loaded, heated, [8.0, 13.0], inputs={"outside": longer}, progress=False)
    np.testing.assert_array_equal(ResultView.of(forecast).forecast_inputs["outside"].values, longer.values)
