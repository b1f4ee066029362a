"""Dates as numbers: units, origins, offsets from UTC, and the way back."""

from datetime import datetime, timedelta

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pandas as pd
import pytest

import lfm_ppl as lfm
from lfm_ppl.io.data import read_csv
from lfm_ppl.io.data_set import Data, stack_series
from lfm_ppl.plots import style
from lfm_ppl.utils import calendar_time
from lfm_ppl.workflows.data_binding import bind_data


@pytest.mark.parametrize(("gap", "unit"), [
    ({"milliseconds": 20}, "s"), ({"seconds": 10}, "s"), ({"minutes": 5}, "min"), ({"hours": 1}, "h"),
    ({"hours": 30}, "d"), ({"days": 31}, "d"), ({"days": 365}, "years"),
])
def test_the_unit_follows_the_time_between_rows(gap, unit):
    stamps = [datetime(2020, 2, 3, 5) + k * timedelta(**gap) for k in range(4)]
    times, origin, result = calendar_time.numbers_of("times", stamps)
    assert (result, origin) == (unit, "2020-02-03T00:00:00")
    seconds = [(stamp - datetime(2020, 2, 3)).total_seconds() for stamp in stamps]
    np.testing.assert_allclose(times * calendar_time.SECONDS[unit], seconds, rtol=1e-15)


def test_summer_time_counts_elapsed_hours(tmp_path):
    # In Central Europe the clock went from 01:59 to 03:00 on that day, so these rows are an hour apart.
    path = tmp_path / "march.csv"
    path.write_text("time,x\n2026-03-29T01:00+01:00,1\n2026-03-29T03:00+02:00,2\n2026-03-29T04:00+02:00,3\n")
    data = read_csv(path)
    np.testing.assert_array_equal(data.times, [1.0, 2.0, 3.0])
    assert data.origin == "2026-03-29T00:00:00+01:00"


def test_a_date_is_found_again_on_the_axis():
    stamps = [datetime(2026, 1, 5, 6), datetime(2026, 1, 6, 7, 30)]
    times, origin, unit = calendar_time.numbers_of("times", stamps, "hours")
    assert (times.tolist(), unit) == ([6.0, 31.5], "h")
    assert calendar_time.clock(31.5, origin, unit) == "2026-01-06 07:30"
    with calendar_time.in_messages(origin, unit):
        assert calendar_time.named(31.5) == "2026-01-06T07:30"
    assert calendar_time.named(31.5) == "31.5"
    assert calendar_time.position("2026-01-06T07:30", origin, unit) == 31.5
    assert calendar_time.position("12.5", origin, unit) == 12.5
    assert calendar_time.position("20260107", None, "h") == 20260107.0
    utc = origin + "+00:00"
    assert calendar_time.position("2026-01-05T06:00+02:00", utc, unit) == 4.0
    assert calendar_time.position("2026-01-05T06:00", utc, unit) == 6.0  # on the clock of the data
    days = calendar_time.days_of(times, origin, unit)
    expected = pd.to_datetime(["2026-01-05T06:00", "2026-01-06T07:30"]).to_julian_date() - 2440587.5
    np.testing.assert_allclose(days, expected, atol=1e-8)


@pytest.mark.parametrize(("text", "origin", "message"), [
    ("tomorrow", "2026-01-05T00:00:00", "'tomorrow'"), ("2026-01-06", None, "plain numbers.*2026-01-06"),
    ("20260107", "2026-01-05T00:00:00", "a number or a date"),
    ("2026-01-06T00:00+01:00", "2026-01-05T00:00:00", "01:00 has an offset from UTC"),
])
def test_a_time_that_means_nothing_is_refused(text, origin, message):
    with pytest.raises(ValueError, match=message):
        calendar_time.position(text, origin, "h")


@pytest.mark.parametrize(("hours", "labels", "common"), [
    (20.0, ["06:00", "12:00", "18:00"], "(05 Jan 2026)"), (48.0, ["Jan-05", "12:00", "Jan-06"], "(Jan 2026)"),
    (24.0 * 20, ["08", "15", "22"], "(Jan 2026)"), (24.0 * 300, ["2026", "Mar", "Jul"], "(2026)"),
])
def test_figures_show_round_dates(hours, labels, common):
    figure, (axes,) = style.small_multiples("full", 1, 1.0)
    axes.plot([0.0, hours], [0.0, 1.0])
    style.label_time([axes], "h", "2026-01-05T00:00:00")
    figure.draw_without_rendering()
    tick_labels = [tick.get_text() for tick in axes.get_xticklabels()]
    assert common in axes.get_xlabel()
    assert set(labels) <= set(tick_labels), tick_labels
    assert len(tick_labels) <= 7


@pytest.mark.parametrize("start", ["2026-03-28 22:00", "2026-10-24 22:00"])
def test_a_time_zone_with_summer_time_counts_elapsed_hours(start):
    # datetime subtracts times of one zone as its clocks show them.
    hours = pd.date_range(start, periods=8, freq="h", tz="Europe/Berlin")
    for form in (hours, [hour.to_pydatetime() for hour in hours], [hour.isoformat() for hour in hours]):
        times, _, unit = calendar_time.numbers_of("times", form)
        np.testing.assert_array_equal(times, np.arange(22.0, 30.0))
        assert unit == "h"


def test_a_midnight_that_the_clock_skips_is_an_origin():
    hours = pd.date_range("2018-11-04 05:00", periods=2, freq="h", tz="America/Sao_Paulo")
    times, origin, _ = calendar_time.numbers_of("times", hours)
    assert (times.tolist(), origin) == ([4.0, 5.0], "2018-11-04T00:00:00-03:00")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("last", [59.0, 179.0, 3595.0, 9300.0, 10790.0, 36e3, 216600.0, 259000.0, 6e6, 79e6, 94e6])
def test_every_span_has_a_few_dates_and_no_complaint(last):
    ticks = style.DateTicks(style.Dates("2026-01-05T00:00:00", "s"), 6)
    visible_ticks = [tick for tick in ticks.tick_values(0.0, last) if 0.0 <= tick <= last]
    assert 2 <= len(visible_ticks) <= 7, visible_ticks


DATES = np.array(["2026-01-05T06:00", "2026-01-05T07:30", "2026-01-06T06:00"], "M8[m]")
FORMS = {
    "datetime64[m]": DATES, "datetime64[ns]": DATES.astype("M8[ns]"), "DatetimeIndex": pd.DatetimeIndex(DATES),
    "Series": pd.Series(DATES), "datetime": DATES.tolist(), "text": DATES.astype(str), "tuple of text":
    tuple(DATES.astype(str).tolist()), "Timestamp": list(pd.DatetimeIndex(DATES)), "periods":
    pd.PeriodIndex(DATES, freq="min"), "with a zone": pd.DatetimeIndex(DATES, tz="Asia/Tokyo"),
    "masked": np.ma.masked_array(DATES, mask=False),
}


@pytest.mark.parametrize("dates", FORMS.values(), ids=FORMS)
def test_dates_in_every_form_are_counted_from_midnight(dates):
    data = Data(dates, np.zeros((3, 1)), ("x",), units={"time": "h"})
    np.testing.assert_allclose(data.times, [6.0, 7.5, 30.0], rtol=1e-15)
    assert data.origin.startswith("2026-01-05T00:00:00")
    shifted = Data(dates, np.zeros((3, 1)), ("x",), {"time": "min"}, origin="2026-01-04T00:00:00" + data.origin[19:])
    np.testing.assert_allclose(shifted.times, 60 * (data.times + 24.0), rtol=1e-15)
    np.testing.assert_allclose(calendar_time.positions("at", dates, data.origin, "d"), data.times / 24, rtol=1e-15)


def test_inputs_of_data_share_their_clock():
    data = Data(DATES, np.zeros((3, 1)), ("x",), units={"time": "h"}, inputs={"heat": (DATES[:2], [1.0, 2.0])})
    assert data.inputs["heat"].times.tolist() == [6.0, 7.5]
    with pytest.raises(ValueError, match="times of the known input 'heat'"):
        Data(np.arange(3.0), np.zeros((3, 1)), ("x",), inputs={"heat": (DATES, np.zeros(3))})


@pytest.mark.parametrize(("dates", "message"), [
    (np.array(["2026-01-05", "NaT"], "M8[D]"), r"times\[1\].*'NaT'"),
    (np.ma.masked_array(DATES[:2], mask=[0, 1]), r"times\[1\].*'NaT'"),
    (["2026-01-05", "tomorrow"], r"times\[1\].*'tomorrow'"), (["2026-01-05", "now"], r"times\[1\].*'now'"),
    (["2026-01-05T00:00", "2026-01-06T00:00+01:00"], r"times\[1\].* without an offset from UTC"),
])
def test_dates_that_cannot_be_read_are_named(dates, message):
    with pytest.raises(ValueError, match=message):
        Data(dates, np.zeros((2, 1)), ("x",))


def system(rate=1.0, **options):
    return lfm.LatentForceModel(
        lambda x, u, t: u - rate * x, {"u": lfm.Matern(1.0, 3.0)},
        lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), **options)


def model(times, y=None, unit=None):
    rate = numpyro.sample("rate", dist.LogNormal(-1.0, 0.5))
    likelihood = lfm.MarginalLikelihood(system(rate, units={"time": unit} if unit else None), times)
    numpyro.sample("y", likelihood, obs=y)


OPTIONS = {"sampler": "map", "samples": 20, "trajectory_draws": 5, "progress": False}


@pytest.mark.thorough
def test_dates_as_times_are_fitted_as_a_table_of_dates():
    hours = pd.date_range("2026-01-05 06:00", periods=8, freq="h")
    y = np.sin(np.arange(8.0) / 5)[:, None]
    later = pd.date_range("2026-01-05 15:00", periods=2, freq="h")
    table = lfm.fit(model, pd.DataFrame(y, hours, ["x"]), at=later, **OPTIONS)
    computed = lfm.fit(model, hours, y, at=later.to_pydatetime(), **OPTIONS)
    plain = lfm.fit(model, np.arange(6.0, 14.0), y, at=[15.0, 16.0], **OPTIONS)
    for result in (table, computed):
        assert result.attrs["time_origin"] == "2026-01-05T00:00:00"
        assert result["data"]["time"].attrs["units"] == "h"
        for group, name in (("posterior", "rate"), ("predictions", "y"), ("data", "time")):
            np.testing.assert_array_equal(result[group][name], plain[group][name])
    forecast = lfm.forecast(computed, model, later, draws=5, progress=False)
    expected = lfm.forecast(plain, model, [15.0, 16.0], draws=5, progress=False)
    np.testing.assert_array_equal(forecast["predictions"]["y"], expected["predictions"]["y"])
    held_out = Data(later, [[0.5], [0.6]], ("y0",), {"time": "min"})  # on a clock of its own
    pd.testing.assert_frame_equal(lfm.score(forecast, held_out), lfm.score(expected, [[0.5], [0.6]]))
    for call in (lambda: lfm.forecast(plain, model, later, draws=5, progress=False),
                 lambda: lfm.fit(model, np.arange(6.0, 14.0), y, at=later, **OPTIONS)):
        with pytest.raises(ValueError, match="(times|at) .* plain numbers"):
            call()


@pytest.mark.thorough
def test_dates_are_counted_in_the_unit_that_the_model_names():
    hours, y = pd.date_range("2026-01-05 06:00", periods=8, freq="h"), np.sin(np.arange(8.0) / 5)[:, None]
    plain = lfm.fit(model, np.arange(6.0, 14.0) / 24, y, **OPTIONS)
    in_hours, numbers = Data(hours, y, ("x",), {"time": "h"}), Data(np.arange(6.0, 14.0), y, ("x",), {"time": "h"})
    for data, requested_times in (((hours, y), [13 / 24]), ((pd.DataFrame(y, hours, ["x"]),), hours[-1:]),
                                  ((in_hours,), [13.0]), ((numbers,), [13.0])):
        result = lfm.fit(model, *data, at=requested_times, model_kwargs={"unit": "d"}, **OPTIONS)
        np.testing.assert_allclose(result["data"]["time"], np.arange(6.0, 14.0) / 24, rtol=1e-15)
        np.testing.assert_allclose(result["posterior"]["rate"], plain["posterior"]["rate"], rtol=1e-8)
        assert result["trajectories"]["time"].attrs["units"] == "d"
        np.testing.assert_allclose(result["trajectories"]["time"], [13 / 24], rtol=1e-15)


@pytest.mark.thorough
def test_held_out_numbers_are_in_the_unit_of_the_result():
    y = np.sin(np.arange(8.0) / 5)[:, None]
    result = lfm.fit(model, Data(np.arange(6.0, 14.0), y, ("x",), {"time": "h"}), **OPTIONS)
    forecast = lfm.forecast(result, model, [15.0, 16.0], draws=5, progress=False)
    expected = lfm.score(forecast, [[0.5], [0.6]])
    held_out = Data([900.0, 960.0], [[0.5], [0.6]], ("x",), {"time": "min"})
    pd.testing.assert_frame_equal(lfm.score(forecast, held_out), expected)
    with pytest.raises(ValueError, match="held_out are dates"):
        lfm.score(forecast, Data(pd.date_range("2026-01-05", periods=2), [[0.5], [0.6]], ("x",)))


@pytest.mark.thorough
def test_known_inputs_have_the_unit_of_the_model_or_are_refused():
    data = Data([0.0, 1.0], np.zeros((2, 1)), ("x",), {"time": "d"}, inputs={"heat": ([0.0, 0.5], [1.0, 2.0])})

    def heated(times, y=None, inputs=None):
        numpyro.sample("rate", dist.LogNormal(-1.0, 0.5))
        numpyro.sample("y", lfm.MarginalLikelihood(system(units={"time": "hours"}), times), obs=y)

    bound, series, clock, _ = bind_data(heated, data, None, None)
    converted = series["y"].on_clock
    assert bound.times.tolist() == [0.0, 24.0] and clock == (None, "hours")
    assert converted.inputs["heat"].times.tolist() == [0.0, 12.0] and converted.units["time"] == "h"
    with pytest.raises(ValueError, match="times in d, and the model counts hours"):
        bind_data(heated, data, None, {"inputs": data.known_inputs()})
    with pytest.warns(UserWarning, match="converted from d to hours"):
        bind_data(heated, data, None, {"inputs": {"heat": lfm.Input([0.0, 30.0], [1.0, 2.0])}})


def two_sites(times, y=None):
    rate = numpyro.sample("rate", dist.LogNormal(-1.0, 0.5))
    for name in ("a", "b"):
        numpyro.sample(name, lfm.MarginalLikelihood(system(rate, units={"time": "h"}), times[name]), obs=y[name])


@pytest.mark.thorough
def test_sites_have_the_unit_of_the_model_and_one_kind_of_clock():
    y = np.zeros((3, 1))
    sites = {"a": Data([0.0, 1.0, 2.0], y, ("x",), {"time": "d"}), "b": ([0.0, 5.0, 9.0], y)}
    bound, data, _, _ = bind_data(two_sites, sites, None, None)
    assert bound.site_models["a"].times.tolist() == [0.0, 24.0, 48.0] == data["a"].on_clock.times.tolist()
    assert bound.site_models["b"].times.tolist() == [0.0, 5.0, 9.0]
    for zone in ("UTC", "Asia/Tokyo"):
        mixed = {"a": (pd.DatetimeIndex(DATES), y), "b": (pd.DatetimeIndex(DATES, tz=zone), y)}
        for order in (["a", "b"], ["b", "a"]):
            with pytest.raises(ValueError, match="'b' have an offset from UTC, and the times of 'a' have none"):
                bind_data(two_sites, {name: mixed[name] for name in order}, None, None)


def test_series_with_and_without_an_offset_are_not_stacked():
    series = {zone or "none": Data(pd.DatetimeIndex(DATES, tz=zone), np.zeros((3, 1)), ("x",), {"time": "h"})
              for zone in ("UTC", None)}
    with pytest.raises(ValueError, match="'UTC' have an offset"):
        stack_series(series)


def test_compact_dates_in_an_array_are_named():
    with pytest.warns(UserWarning, match="20260130 .*plain numbers"):
        bind_data(model, np.array([20260130, 20260131, 20260201]), np.zeros((3, 1)), None)
    for cells in ([20260130, 20260231], [20260130, 2026013106], ["20260130", ""], [20260130.5], []):
        assert calendar_time.compact_dates(cells) is None
    assert calendar_time.compact_dates([20260130.0, "20260131"])[1].day == 31


REFUSALS = {
    "bind": lambda times: lfm.bind(model, times, np.zeros((3, 1))),
    "filter": lambda times: lfm.filter(system(), times, np.zeros((3, 1))),
    "smooth": lambda times: lfm.smooth(system(), times, np.zeros((3, 1))),
    "smooth at": lambda times: lfm.smooth(system(), np.arange(3.0), np.zeros((3, 1)), at=times),
    "MarginalLikelihood": lambda times: lfm.MarginalLikelihood(system(), times),
    "panel": lambda times: lfm.panel(lambda level: system(), np.zeros(2), times),
    "simulate": lambda times: lfm.simulate(jax.random.key(0), system(), times),
    "Input": lambda times: lfm.Input(times, np.zeros(3)),
    "full_information": lambda times: lfm.full_information(system(), times, np.zeros((3, 1)), lower={"u": 0.0}),
    "moving_horizon": lambda times: lfm.MovingHorizon(system(), 3, lower={"u": 0.0}).estimate(times, np.zeros((3, 1))),
    "backtest": lambda times: lfm.backtest(model, times, np.zeros((3, 1)), horizon=1),
    "fit_many": lambda times: lfm.fit_many(model, {"a": (times, np.zeros((3, 1)))}),
    "initial time": lambda times: system(initial_time=times[0]),
}


@pytest.mark.parametrize("use", REFUSALS.values(), ids=REFUSALS)
def test_dates_and_durations_are_refused_where_no_unit_is_known(use):
    for times, kind in ((pd.DatetimeIndex(DATES), "dates"), (DATES - DATES[0], "durations")):
        with pytest.raises(TypeError, match=rf"(time|at).* must be numbers in .*, got {kind}") as raised:
            use(times)
        assert "\n" not in str(raised.value)


def test_durations_are_no_times_of_a_fit():
    for use in (lambda times: lfm.fit(model, times, np.zeros((3, 1)), **OPTIONS),
                lambda times: Data(times, np.zeros((3, 1)), ("x",))):
        with pytest.raises(TypeError, match="got durations"):
            use(DATES - DATES[0])


def test_a_mapping_of_columns_keeps_its_dates():
    for dates in (DATES.astype("M8[ns]"), pd.DatetimeIndex(DATES), np.ma.masked_array(DATES, mask=False)):
        data = lfm.read_table({"time": dates, "x": np.arange(3.0)}, time_unit="h")
        np.testing.assert_allclose(data.times, [6.0, 7.5, 30.0], rtol=1e-15)
    with pytest.raises(ValueError, match="row 1, column 'time'"):
        lfm.read_table({"time": np.ma.masked_array(DATES, mask=[0, 1, 0]), "x": np.arange(3.0)})
    with pytest.raises(ValueError, match="row 0, column 'time'"):
        lfm.read_table({"time": (DATES - DATES[0]).astype("m8[ns]"), "x": np.arange(3.0)})
