"""The unit of time of a data file, of its model and of the result."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from lfm_ppl.cli.data_file import read_data
from lfm_ppl.cli.fit import _print_data, observed_data
from lfm_ppl.cli.fit_arguments import TIME_UNIT
from lfm_ppl.cli.forecast import _held_out_data
from lfm_ppl.cli.options import Columns, DataOptions, FitArguments, ForecastOptions
from lfm_ppl.cli.stored_fit import StoredFit
from lfm_ppl.io.data_set import Data
from lfm_ppl.io.loading import load
from lfm_ppl.results import arviz_data

ROOM = str(Path(__file__).resolve().parents[2] / "docs" / "examples" / "room.py")
HOURS = np.array([0.0, 12.0, 36.0])


def table(times, name="time"):
    rows = [f"{time},{15 + k},{k % 2},{k}" for k, time in enumerate(times)]
    return "\n".join([f"{name},temperature,heater,outside", *rows, ""])


@pytest.fixture
def write(tmp_path):
    """Write a file."""

    def write_file(text, name="room.csv"):
        (tmp_path / name).write_text(text)
        return str(tmp_path / name)

    return write_file


@pytest.mark.parametrize(("text", "unit"), [
    (table(HOURS), None), (table(HOURS), "h"), (table(HOURS / 24), "d"), (table(HOURS / 24, "time_d"), None),
    (table(HOURS * 60, "time_min"), "min"), (table(HOURS * 3600), "seconds"),
    (table(["2026-01-05", "2026-01-05T12:00", "2026-01-06T12:00"]), "d"),
    (table(["2026-01-05", "2026-01-05T12:00", "2026-01-06T12:00"]), None),
    (table(["2026010500", "2026010512", "2026010612"]), "d"),
])
def test_observations_and_inputs_of_a_file_are_in_the_unit_of_the_model(write, text, unit):
    observed = observed_data(DataOptions(data=write(text), time_unit=unit), load(ROOM), {})
    assert observed.units["time"] == "h"
    np.testing.assert_allclose(observed.times, HOURS, rtol=1e-14)
    for known_input in observed.inputs.values():
        np.testing.assert_allclose(known_input.times, HOURS, rtol=1e-14)


def test_a_conversion_is_printed(write, capsys):
    options = FitArguments(data=DataOptions(data=write(table(HOURS / 24)), time_unit="d"))
    model = load(ROOM)
    _print_data(options, model, observed_data(options.data, model, {}), {})
    assert "time     in h, the unit of the model" in capsys.readouterr().out
    for text, words in ((table(HOURS / 24, "time_d"), "converted from d"), (table(HOURS, "time_h"), ""),
                        (table(HOURS), ""), (table(HOURS * 60, "time_min"), "converted from min")):
        options = FitArguments(data=DataOptions(data=write(text)))
        _print_data(options, model, observed_data(options.data, model, {}), {})
        assert (words or "data ") in (output := capsys.readouterr().out) and ("converted" in output) == bool(words)


@pytest.mark.parametrize(("name", "unit"), [("time", "d"), ("time_h", None)])
def test_a_unit_that_cannot_be_converted_is_refused(write, tmp_path, name, unit):
    model = tmp_path / "ice.py"
    model.write_text('UNITS = {"time": "kyr"}\ndef model(times, y=None):\n    pass\n')
    path = write(f"{name},x\n0,1\n1,2\n")
    with pytest.raises(ValueError, match="'kyr'.*cannot be converted"):
        read_data(path, load(str(model)), DataOptions(data=path, time_unit=unit))
    path = write("time,x\n0,1\n1,2\n")
    assert read_data(path, load(str(model)), DataOptions(data=path)).times.tolist() == [0.0, 1.0]


def fitted(unit_of_file, origin=None):
    observed = Data(HOURS, np.zeros((3, 1)), ("temperature",), {"time": "h"}, origin=origin, inputs={
        name: (HOURS, np.zeros(3), way) for name, way in (("heater", "previous"), ("outside", "linear"))})
    attributes = {TIME_UNIT: unit_of_file} if unit_of_file else {}
    posterior = arviz_data.build({"posterior": xr.Dataset({"loss": (("chain", "draw"), np.ones((1, 2)))})}, attributes)
    file = load(ROOM)
    return StoredFit(posterior, "room", file.model, {}, observed, file)


@pytest.mark.parametrize(("text", "unit_of_fit", "unit"), [
    (table([48, 60]), None, None), (table([2, 2.5]), "d", None), (table([2, 2.5]), None, "d"),
    (table([48, 60]), "d", "h"), (table([2, 2.5], "time_d"), None, None), (table([48, 60], "time_h"), "d", None),
    (table([2, 2.5], "time_d"), "h", None),
])
def test_held_out_data_have_the_unit_of_the_file_that_was_fitted(write, text, unit_of_fit, unit):
    read = _held_out_data(write(text), ForecastOptions(time_unit=unit), fitted(unit_of_fit))
    np.testing.assert_allclose(read.times, [48.0, 60.0])
    np.testing.assert_allclose(read.inputs["heater"].times, [48.0, 60.0])


def test_held_out_dates_are_counted_from_the_origin_of_the_fit(write):
    task = fitted("d", "2026-01-05T00:00:00")
    for dates in (["2026-01-07", "2026-01-07T12:00"], ["2026010700", "2026010712"]):
        read = _held_out_data(write(table(dates)), ForecastOptions(columns=Columns(time_column="time")), task)
        np.testing.assert_allclose(read.times, [48.0, 60.0])


def test_held_out_doses_to_several_states_have_the_name_of_the_fit(write):
    observed = Data(HOURS, np.zeros((3, 1)), ("concentration",), {"time": "h"},
                    inputs={"dose": ([0.0], [4.0], "dose:gut,central")})
    task = dataclasses.replace(fitted(None), observed=observed, file=load("pharmacokinetics"))
    path = write("time,concentration,AMT,CMT\n48,.,7,2\n60,1,.,.\n")
    for events in ("AMT:gut,central", "AMT:gut,other"):
        read = _held_out_data(path, ForecastOptions(columns=Columns(events=events)), task)
        assert read.inputs["dose"].compartments.tolist() == [1]
    with pytest.raises(ValueError, match="unknown known input of the result 'AMT'.*Known: dose"):
        _held_out_data(path, ForecastOptions(columns=Columns(events="AMT:liver,gut")), task)


def test_rows_of_doses_are_no_missing_values(capsys):
    data = Data([0.0, 1.0, 2.0, 3.0], [[np.nan], [1.0], [np.nan], [2.0]], ("x",),
                inputs={"AMT": ([0.0], [4.0], "dose:gut"), "heat": ([0.0, 2.0], [1.0, 2.0])})
    _print_data(FitArguments(), load("spring"), data, {})
    assert "4 rows of x; 1 values missing" in capsys.readouterr().out
    infused = data.inputs["AMT"]._replace(durations=np.array([2.0]))
    _print_data(FitArguments(), load("spring"), dataclasses.replace(data, inputs={"AMT": infused}), {})
    assert "AMT (dose:gut, 1 dose of 4 in all, 1 by infusion)" in capsys.readouterr().out
    panel = Data([[0.0, 1.0], [0.0, 1.0]], [[[np.nan], [1.0]], [[np.nan], [2.0]]], ("x",), series=("a", "b"),
                 inputs={"AMT of series b": ([0.0], [4.0], "dose:gut")})
    _print_data(FitArguments(), load("spring"), panel, {})
    assert "2 series of up to 2 rows of x; 1 values missing" in capsys.readouterr().out
