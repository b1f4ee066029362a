"""Dates as numbers: units, origins, offsets from UTC, and the way back."""

from datetime import datetime, timedelta

import numpy as np
import pandas as pd
import pytest

from lfm_ppl import calendar_time
from lfm_ppl.data import read_csv
from lfm_ppl.results.plots import style


@pytest.mark.parametrize(("gap", "unit"), [
    ({"milliseconds": 20}, "s"), ({"seconds": 10}, "s"), ({"minutes": 5}, "min"), ({"hours": 1}, "h"),
    ({"hours": 30}, "d"), ({"days": 31}, "d"), ({"days": 365}, "years"),
])
def test_the_unit_follows_the_time_between_rows(gap, unit):
    stamps = [datetime(2020, 2, 3, 5) + k * timedelta(**gap) for k in range(4)]
    times, origin, found = calendar_time.since_midnight(stamps)
    assert (found, origin) == (unit, "2020-02-03T00:00:00")
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
    times, origin, unit = calendar_time.since_midnight([datetime(2026, 1, 5, 6), datetime(2026, 1, 6, 7, 30)], "h")
    assert times.tolist() == [6.0, 31.5]
    assert calendar_time.position("2026-01-06T07:30", origin, unit) == 31.5
    assert calendar_time.position("12.5", origin, unit) == 12.5
    utc = origin + "+00:00"
    assert calendar_time.position("2026-01-05T06:00+02:00", utc, unit) == 4.0
    assert calendar_time.position("2026-01-05T06:00", utc, unit) == 6.0  # on the clock of the data
    days = calendar_time.days_of(times, origin, unit)
    expected = pd.to_datetime(["2026-01-05T06:00", "2026-01-06T07:30"]).to_julian_date() - 2440587.5
    np.testing.assert_allclose(days, expected, atol=1e-8)


@pytest.mark.parametrize(("text", "origin", "message"), [
    ("tomorrow", "2026-01-05T00:00:00", "a number or a date, year first, such as 2026-03-31"),
    ("2026-01-06", None, "the times of the data are plain numbers"),
    ("2026-01-06T00:00+01:00", "2026-01-05T00:00:00", "has an offset from UTC and the times of the data have none"),
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
    shown = [tick.get_text() for tick in axes.get_xticklabels()]
    assert common in axes.get_xlabel()
    assert set(labels) <= set(shown), shown
    assert len(shown) <= 7


@pytest.mark.parametrize("start", ["2026-03-28 22:00", "2026-10-24 22:00"])
def test_a_time_zone_with_summer_time_counts_elapsed_hours(start):
    # datetime subtracts times of one zone as its clocks show them.
    hours = pd.date_range(start, periods=8, freq="h", tz="Europe/Berlin")
    times, _, unit = calendar_time.since_midnight([hour.to_pydatetime() for hour in hours])
    np.testing.assert_array_equal(times, np.arange(22.0, 30.0))
    assert unit == "h"


def test_a_date_without_marks_is_asked_about():
    with pytest.raises(ValueError, match="a number or a date"):
        calendar_time.position("20260107", "2026-01-05T00:00:00", "h")
    assert calendar_time.position("20260107", None, "h") == 20260107.0


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("last", [59.0, 179.0, 3595.0, 9300.0, 10790.0, 36e3, 216600.0, 259000.0, 6e6, 79e6, 94e6])
def test_every_span_has_a_few_dates_and_no_complaint(last):
    ticks = style.DateTicks(style.Dates("2026-01-05T00:00:00", "s"), 6)
    shown = [tick for tick in ticks.tick_values(0.0, last) if 0.0 <= tick <= last]
    assert 2 <= len(shown) <= 7, shown
