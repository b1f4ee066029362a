"""Known inputs from a table to the model, the result, and back; and tables of other libraries."""

import pathlib

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pandas as pd
import pytest
import xarray as xr

import lfm_ppl as lfm
from lfm_ppl.cli import main
from lfm_ppl.cli.data_file import read_data
from lfm_ppl.cli.fit import observed_data
from lfm_ppl.cli.options import Columns, DataOptions
from lfm_ppl.io import loading
from lfm_ppl.io.data import write_csv
from lfm_ppl.io.data_set import Data, InputTable
from lfm_ppl.results import arviz_data, rebuilding
from lfm_ppl.results.inputs import FORECAST, inputs_of

HOUSE = """date,indoor,heater,outside
2026-01-05 06:00,18.0,0,5
2026-01-05 07:00,,2,
2026-01-05 08:00,19.5,2,4
2026-01-05 09:00,20.1,0,6
"""
HALF_HOURS = HOUSE.replace("07:00", "06:30").replace("08:00", "07:00").rpartition("2026-")[0]
MODEL = '''"""A house."""
import jax.numpy as jnp, numpyro, numpyro.distributions as dist, lfm_ppl as lfm
OUTPUTS = ("T",)
INPUTS = {"power": "previous", "weather": "linear"}
def model(times, y=None, inputs=None):
    rate = numpyro.sample("rate", dist.LogNormal(0.0, 1.0))
'''


@pytest.fixture
def folder(tmp_path):
    """Return a folder with data and a model of them."""
    (tmp_path / "house.csv").write_text(HOUSE)
    (tmp_path / "house.py").write_text(MODEL)
    return tmp_path


def arguments(folder, **changed):
    settings = {"data": str(folder / "house.csv"), "outputs": "indoor", "inputs": "heater,outside:linear"} | changed
    columns = Columns(outputs=settings.pop("outputs"), inputs=settings.pop("inputs"))
    return DataOptions(columns=columns, **settings)


def test_inputs_hold_or_are_joined_and_skip_empty_cells(folder):
    with pytest.warns(UserWarning, match="'outside': 1 of 4 values .* a line joins .*--inputs outside:zero"):
        data = lfm.read_csv(folder / "house.csv", ["indoor"], inputs={"heater": "previous", "outside": "linear"})
    known = data.known_inputs()
    assert [float(known["heater"](t)) for t in (6.0, 6.9, 7.0, 8.5, 9.0)] == [0, 0, 2, 2, 0]
    assert [float(known["outside"](t)) for t in (6.0, 7.0, 8.5)] == [5.0, 4.5, 5.0]


DOSES = "time,conc,dose_rate\n0,,100\n1,8.1,\n2,6.6,.\n4,4.5,50\n4,4.4,\n8,2.0,\n"


def test_blank_doses_are_told_and_may_be_zero(folder, recwarn):
    path = folder / "doses.csv"
    path.write_text(DOSES)

    def rates(inputs):
        rate = lfm.read_csv(path, ["conc"], inputs=inputs).known_inputs()["dose_rate"]
        return [float(rate(t)) for t in (0.0, 0.5, 1.0, 3.9, 4.0, 7.9, 8.0)]

    # The cell at t = 4 beside one with a dose is no blank.
    with pytest.warns(UserWarning, match=r"'dose_rate': 3 of 6 values .*--inputs dose_rate:zero"):
        assert rates(["dose_rate"]) == [100, 100, 100, 100, 50, 50, 50]
    recwarn.clear()
    assert rates({"dose_rate": "zero"}) == [100, 100, 0, 0, 50, 50, 0]
    path.write_text(DOSES.replace("100", ""))
    assert rates({"dose_rate": "zero"}) == [0, 0, 0, 0, 50, 50, 0]
    assert not recwarn
    with pytest.raises(ValueError, match=r"no value at the first time; .*--inputs dose_rate:zero"):
        rates(["dose_rate"])


def test_the_command_line_reads_blank_cells_as_zero(folder, recwarn):
    (folder / "doses.csv").write_text(DOSES)
    (folder / "house.py").write_text(MODEL.replace('"power": "previous", "weather": "linear"', '"power": "zero"'))
    model = loading.load(str(folder / "house.py"))
    for inputs in ("dose_rate", "dose_rate:zero"):
        data = read_data(str(folder / "doses.csv"), model, arguments(folder, outputs="conc", inputs=inputs))
        assert data.inputs["power"].values.tolist() == [100, 0, 0, 50, 0]
        assert data.inputs["power"].interpolation == "previous"
    assert not recwarn
    with pytest.warns(UserWarning, match="blank"):
        read_data(str(folder / "doses.csv"), model, arguments(folder, outputs="conc", inputs="dose_rate:previous"))
    with pytest.raises(ValueError, match="zeros"):
        read_data(str(folder / "doses.csv"), model, arguments(folder, outputs="conc", inputs="dose_rate:zeros"))


def test_the_command_line_maps_columns_to_the_model_s_names(folder):
    model = loading.load(str(folder / "house.py"))
    data = observed_data(arguments(folder), model, {})
    assert data.outputs == ("T",)
    assert {name: table.interpolation for name, table in data.inputs.items()} == {
        "power": "previous", "weather": "linear"}
    assert isinstance(model.keywords(data, {})["inputs"]["weather"], lfm.Input)


def test_dates_are_counted_in_the_model_s_unit_of_time_unless_the_user_says_another(folder):
    (folder / "house.csv").write_text(HALF_HOURS)
    (folder / "house.py").write_text('UNITS = {"time": "h"}\n' + MODEL)
    model = loading.load(str(folder / "house.py"))
    data = observed_data(arguments(folder), model, {})
    np.testing.assert_allclose(data.times, [6.0, 6.5, 7.0], rtol=1e-15)
    np.testing.assert_array_equal(data.inputs["power"].times, data.times)
    assert data.units["time"] == "h"
    said = observed_data(arguments(folder, time_unit="min"), model, {})
    assert said.times.tolist() == [360.0, 390.0, 420.0] and said.units["time"] == "min"


def test_a_model_of_known_inputs_is_described_without_data(capsys):
    assert main(["models", str(pathlib.Path(__file__).parent.parent / "docs" / "examples" / "room.py")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "heat Matern (K/h)" in printed and "likelihood: exact: the model is linear" in printed


@pytest.mark.parametrize(("changed", "message"), [
    ({"inputs": "heater"}, r"takes 2 known inputs \(power, weather\); --inputs names 1"),
    ({"inputs": "heater,heater"}, "each of them once"),
    ({"inputs": "heater,outsid"}, "unknown input column 'outsid'. Did you mean 'outside'"),
    ({"inputs": "heater,outside:cubic"}, "unknown interpolation of outside 'cubic'"),
    ({"inputs": "heater,indoor"}, "as an output or an input; got .*'indoor'"),
    ({"inputs": None}, "unknown input column 'power'"),
    ({"data": None}, "--outputs is about a data file"),
    ({"data": None, "outputs": None}, "--inputs is about a data file"),
])
def test_wrong_inputs_are_named(folder, changed, message):
    with pytest.raises(ValueError, match=message):
        observed_data(arguments(folder, **changed), loading.load(str(folder / "house.py")), {})


@pytest.mark.parametrize(("text", "message"), [
    ("date,x,h\n2026-01-05,1,\n2026-01-06,2,1\n", "row 2, column 'h': the known input has no value at the first time"),
    ("date,x,h\n2026-01-05,1,1\n2026-01-05,2,3\n", "row 3, column 'h': the known input has another value"),
    ("date,x,h\n2026-01-05,1,1\n2026-01-32,2,3\n", "row 3, column 'date': expected a date, year .* got '2026-01-32'"),
    ("date,x,h\n2026-01-05,1,1\n2026-01-06T00:00Z,2,3\n", "row 3, column 'date': .* without an offset from UTC"),
    ("date,x,h\n2026-01-05,1,1\n,2,3\n", "row 3, column 'date': the time is missing"),
    ("date,x,h\n2026-10-25 02:30,1,1\n2026-10-25 02:15,2,3\n", "row 3: the time goes back .* offsets from UTC"),
    ("a,b,x,h\n2026-01-05,2026-01-05,1,1\n", "several time columns: a, b"),
    ("a,x,h\n1,1,1\n", "has no time column; expected `time`, `t`, `time_h`, or one of dates"),
    ("time_h,x,h\n1,1,1\n", "the column 'time_h' says that its unit is h, and --time-unit"),
])
def test_wrong_tables_are_named_with_the_row(tmp_path, text, message):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        lfm.read_csv(path, ["x"], inputs=["h"], time_unit="min")


def frames():
    times = pd.date_range("2026-01-05", periods=4, freq="30min")
    columns = {"x": [1.0, np.nan, 3.0, 4.0], "heater": [0.0, 1.0, 1.0, 0.0]}
    frame = pd.DataFrame(columns, index=times)
    yield "index of dates", frame
    yield "named column", frame.rename_axis("date").reset_index()
    yield "nullable", frame.convert_dtypes()
    yield "time zone", frame.tz_localize("Europe/Berlin")
    yield "xarray", xr.Dataset({name: ("time", values) for name, values in columns.items()}, {"time": times})
    yield "mapping", {"time_min": [0, 30, 60, 90], **columns}
    try:
        import polars
    except ImportError:
        return
    yield "polars", polars.DataFrame({"when": times.to_pydatetime().tolist(), **columns})


@pytest.mark.parametrize("frame", [pytest.param(frame, id=name) for name, frame in frames()])
def test_tables_of_other_libraries_are_read(frame):
    data = lfm.read_table(frame, inputs=["heater"])
    np.testing.assert_array_equal(data.times, [0, 30, 60, 90])
    assert data.units == {"time": "min"}
    np.testing.assert_array_equal(data.y, [[1], [np.nan], [3], [4]])
    np.testing.assert_array_equal(data.inputs["heater"].values, [0, 1, 1, 0])


@pytest.mark.parametrize(("frame", "error", "message"), [
    ([1, 2], TypeError, "expected a pandas or polars DataFrame.*got list"),
    ({}, ValueError, "no rows"),
    ({"t": [0, 1], "x": [1]}, ValueError, "columns of 1 and 2 rows"),
    (pd.DataFrame([[1, 2]], columns=["x", "x"]), ValueError, "the column name 'x' stands 2 times"),
    (xr.Dataset({"x": (("time", "gene"), np.ones((2, 2)))}), ValueError, "expected the time alone"),
])
def test_tables_that_cannot_be_read_are_named(frame, error, message):
    with pytest.raises(error, match=message):
        lfm.read_table(frame)


def test_what_is_written_is_read_back(tmp_path):
    times = np.array([0.0, 1.5, 3.0])
    data = Data(times, np.array([[1.0], [np.nan], [2.0]]), ("x",), units={"time": "h"},
                inputs={"u": InputTable(times, np.array([3.0, 4.0, 5.0]))})
    path = pathlib.Path(tmp_path) / "written.csv"
    write_csv(data, path)
    again = lfm.read_csv(path, inputs=["u"])
    np.testing.assert_array_equal(again.y, data.y)
    np.testing.assert_array_equal(again.inputs["u"].values, data.inputs["u"].values)


def heated(times, y=None, inputs=None):
    rate = numpyro.sample("rate", dist.LogNormal(-2.0, 0.5))
    room = lfm.LatentForceModel(lambda x, u, t: u - rate * (x - inputs["outside"](t)), {"sun": lfm.Matern(1.0, 2.0)},
                                lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
                                lfm.Gaussian(jnp.array([18.0]), jnp.eye(1)))
    numpyro.sample("y", lfm.MarginalLikelihood(room, times, steps=1), obs=y)


def test_a_fit_takes_a_table_and_its_result_remembers_inputs_and_dates(tmp_path):
    hours = pd.date_range("2026-01-05", periods=6, freq="h")
    frame = pd.DataFrame({"room": 18.0 + np.arange(6.0), "outside": np.linspace(5.0, 7.0, 6)}, index=hours)
    data = lfm.read_table(frame, inputs={"outside": "linear"})
    result = lfm.fit(heated, data, sampler="map", samples=10, trajectory_draws=5, progress=False)
    path = arviz_data.save(result, tmp_path / "posterior.nc")
    again = arviz_data.load(path)
    np.testing.assert_array_equal(inputs_of(again)["outside"].values, data.inputs["outside"].values)
    assert inputs_of(again)["outside"].interpolation == "linear"
    attributes = arviz_data.attributes(again)
    assert attributes["time_origin"] == "2026-01-05T00:00:00"
    assert arviz_data.group(again, "observed_data")["time"].attrs["units"] == "h"
    # The model is bound again with the inputs that the result holds, and gives the densities that it records.
    whole = rebuilding.problem(again, heated)
    assert np.isfinite(whole.bound.log_density(np.zeros(whole.bound.size)))
    from lfm_ppl.results.plots import plot_fit
    figure = plot_fit(again)
    assert "Jan 2026" in figure.axes[0].get_xlabel()
    # A forecast remembers the inputs that it goes on with, and a warning names times as the data do.
    longer = lfm.Input(np.arange(12.0), 5.0 + 0.4 * np.arange(12.0), "linear")
    ahead = lfm.forecast(again, heated, [8.0, 11.0], inputs={"outside": longer}, progress=False)
    np.testing.assert_array_equal(inputs_of(ahead, FORECAST)["outside"].values, longer.values)
    with pytest.warns(UserWarning, match="from 2026-01-05T00:00 to 2026-01-05T11:00, is read at time 2026-01-05T13:00"):
        lfm.forecast(again, heated, [13.0], inputs={"outside": longer}, progress=False)
    assert "Gaussian (sd 0.316)" in attributes["assumptions"]
    with pytest.raises(TypeError, match="without y the data must be"):
        lfm.fit(heated, np.arange(6.0))
