"""Later known inputs and doses continue the inputs and doses of a fit."""

import numpy as np
import pytest
import xarray as xr

import lfm_ppl as lfm
from lfm_ppl.io.input_table import InputTable
from lfm_ppl.results import arviz_data
from lfm_ppl.results.inputs import GROUP, to_dataset
from lfm_ppl.results.rebuilding import continued_tables, keywords
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.workflows.forecast import _inputs_by_name

HEATER = InputTable(np.array([0.0, 2.0]), np.array([0.5, 0.0]))
OUTSIDE = InputTable(np.array([0.0, 5.0]), np.array([1.0, 6.0]), "linear")
DOSES = InputTable(np.array([0.0, 3.0]), np.array([4.0, 8.0]), "dose:gut", np.array([0.0, 4.0]))
"""The second dose is an infusion, of which half has entered at the last observation."""


def result(tables, labels=(), origin=None):
    """Return a result with observations at times 0 to 5 hours, of one series or of a panel."""
    lead, shape = (("patient",), (len(labels),)) if labels else ((), ())
    y = xr.Dataset({"y": ((*lead, "time", "output"), np.zeros((*shape, 6, 1)))},
                   {"time": ("time", np.arange(6.0), {"units": "h"}), "output": ["x"]})
    posterior = xr.Dataset({"rate": (("chain", "draw"), np.ones((1, 2)))})
    y = y.assign_coords(patient=list(labels)) if labels else y
    return arviz_data.build({"posterior": posterior, "data": y,
                             GROUP: to_dataset(tables)}, {} if origin is None else {"time_origin": origin})


FITTED = result({"heater": HEATER, "outside": OUTSIDE, "dose": DOSES})


@pytest.mark.parametrize(("table", "times"), [
    (([6.0, 8.0], [1.0, 2.0]), [0.0, 2.0, 6.0, 8.0]), (lfm.Input([5.0], [1.0]), [0.0, 2.0, 5.0]),
    (([0.0, 2.0, 7.0], [0.5, 0.0, 3.0], "previous"), [0.0, 2.0, 7.0]), (([3.0, 6.0], [0.0, 3.0]), [0.0, 2.0, 3.0, 6.0]),
])
def test_a_later_input_follows_that_of_the_fit(table, times):
    assert continued_tables(FITTED, {"heater": table})["heater"].times.tolist() == times
    function = keywords(FITTED, {"heater": table}, None)["inputs"]["heater"]
    assert (float(function(1.0)), float(function(4.0))) == (0.5, 0.0)


@pytest.mark.parametrize(("name", "table", "words"), [
    ("heater", ([3.0, 6.0], [2.0, 3.0]), "'heater' of the forecast is 2 at time 3, .* the fit is 0"),
    ("heater", ([0.0, 1.0], [1.0, 0.0]), "is 1 at time 0"), ("heater", ([6.0], [1.0], "linear"), "one manner"),
    ("outside", ([4.0, 8.0], [4.0, 9.0]), "'outside' .* is 4 at time 4"),
    ("heater", ([6.0], [1.0], "dose:gut"), "manner"),
    ("dose", ([0.0, 12.0], [4.0, 4.0], "dose:gut"), "at time 3 are none, .* the fit has 4 to gut"),
    ("dose", ([2.0, 12.0], [1.0, 4.0], "dose:gut"), "at time 2 are 1 to gut, .* has none"),
    ("dose", ([0.0, 3.0], [4.0, 4.0], "dose:blood"), "to blood|to gut"), ("heater", ([6.0, 7.0], [1.0]), "one value"),
])
def test_an_input_that_differs_before_the_last_observation_is_refused(name, table, words):
    with pytest.raises(ValueError, match=words) as error:
        continued_tables(FITTED, {name: table})
    assert "\n" not in str(error.value)


def test_later_doses_follow_and_later_resets_end_infusions():
    joined = continued_tables(FITTED, {"dose": ([12.0], [5.0])})["dose"]
    assert joined.times.tolist() == [0.0, 3.0, 12.0] and joined.durations.tolist() == [0.0, 4.0, 0.0]
    later = InputTable(np.array([12.0]), np.array([5.0]), "dose:gut", None, None, np.array([6.0]))
    joined = continued_tables(FITTED, {"dose": later})["dose"]
    assert joined.durations.tolist() == [0.0, 3.0, 0.0] and joined.values.tolist() == [4.0, 6.0, 5.0]
    events = keywords(FITTED, {"dose": later}, None)["events"]
    assert [type(event).__name__ for event in events] == ["Reset", "Dose", "Infusion"]
    # A reset before the last observation would have changed the fit.
    with pytest.raises(ValueError, match="at time 3 are 2 to gut"):
        continued_tables(FITTED, {"dose": later._replace(resets=np.array([4.0]))})


def test_each_series_of_a_panel_has_its_own_table():
    panel = result({"dose of series Ann": DOSES, "dose of series Bo": DOSES, "heater of series Ann": HEATER,
                    "heater of series Bo": HEATER}, ("Ann", "Bo"))
    arguments = keywords(panel, {"dose of series Bo": ([12.0], [5.0]), "heater of series Ann": ([9.0], [3.0])}, None)
    dose, infusion = arguments["events"]
    assert dose.values.tolist() == [[4.0, 0.0], [4.0, 5.0]] and infusion.values.tolist() == [[8.0], [8.0]]
    assert np.asarray(arguments["inputs"]["heater"].values)[:, -1].tolist() == [3.0, 0.0]
    with pytest.raises(ValueError, match="'dose'.*dose of series Ann.*Each series"):
        _inputs_by_name(ResultView.of(panel), {"dose": ([12.0], [5.0])}, lambda times, y=None, inputs=None: None)
    with pytest.raises(ValueError, match="'heatr'.*heater"):
        _inputs_by_name(ResultView.of(FITTED), {"heatr": ([12.0], [5.0])}, lambda times, y=None, inputs=None: None)


def test_later_data_are_converted_to_the_clock_of_the_fit():
    def model(times, y=None, inputs=None):
        return None

    def later(times, unit):
        return lfm.Data(times, [[np.nan]] * 2, ("x",), {"time": unit}, inputs={"heater": (times, [1.0, 2.0])})

    view = ResultView.of(FITTED)
    minutes = _inputs_by_name(view, later([360.0, 420.0], "min"), model)
    assert minutes["heater"].times.tolist() == [6.0, 7.0]
    with pytest.raises(ValueError, match="inputs: .* kyr, .* unit of the result, h"):
        _inputs_by_name(view, later([360.0, 420.0], "kyr"), model)
    with pytest.raises(ValueError, match="inputs: its times are dates, the times of the result plain numbers"):
        _inputs_by_name(view, later(np.array(["2026-01-01", "2026-01-02"], "datetime64[s]"), "h"), model)
    dated = result({"heater": HEATER}, origin="2026-01-01T00:00:00")
    dates = np.array(["2026-01-01T06", "2026-01-01T12"], "datetime64[s]")
    assert continued_tables(dated, {"heater": (dates, [1.0, 2.0])})["heater"].times.tolist() == [0.0, 2.0, 6.0, 12.0]
    with pytest.raises(ValueError, match="at time 2026-01-01T03:00.* at time 2026-01-01T05:00"):
        continued_tables(dated, {"heater": (np.array(["2026-01-01T03", "2026-01-01T12"], "datetime64[s]"), [1.0, 2.0])})
