"""Warnings of numbers that may be dates, and of dates on a clock that changes to or from summer time."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from lfm_ppl.utils import calendar_time, checks

_FIRST_SERIAL, _LAST_SERIAL = 20000.0, 73050.0
"""Serial dates of 1954 and of 2099 in a spreadsheet."""

_MONTHS_OF_CHANGES = (3, 4, 9, 10, 11)
"""Months in which clocks change to or from summer time, on Sundays."""


def warn_of_compact_dates(label: str, number: Any, date: datetime) -> None:
    """Warn of whole numbers that are all compact dates and are read as numbers; the first one is given."""
    text = number if isinstance(number, str) else f"{int(number)}"
    checks.warn(f"{label}: {text} and all other times are dates YYYYMMDD, with or without HH or HHMM, and are read as "
                "plain numbers. If they are dates, name the column `date` or give --time-unit d (time_unit='d'); in "
                f"arrays, write np.datetime64('{date.isoformat(timespec='minutes')}').")


def warn_of_serial_dates(label: str, times: np.ndarray) -> None:
    """Warn of numbers (T,) that may be days since 1899-12-30, as spreadsheets count them."""
    if _FIRST_SERIAL <= times.min() and times.max() <= _LAST_SERIAL:
        date = datetime(1899, 12, 30) + timedelta(days=float(times[0]))
        checks.warn(f"{label}: {times[0]:g} is read as a plain number. In a spreadsheet it is a date, "
                    f"{date.isoformat(sep=' ', timespec='minutes')}: save the column in the form 2026-03-31 18:00; or "
                    "give the unit of the numbers, --time-unit d (time_unit='d').")


def warn_of_changed_clock(location: Callable[[int], str], times: np.ndarray, origin: str, unit: str) -> None:
    """Warn of an hour that occurs twice, or not at all, as on a clock that changes to or from summer time.

    The hour lies in the night of a Sunday, and the rows around it are equally far apart, at most one hour. Dates with
    an offset from UTC leave no doubt.

    Args:
        location: name of a row in the message.
        times: (T,), dates as numbers; for the series of a panel nothing is checked.
        origin: the calendar time of t = 0.
        unit: unit of the times.
    """
    midnight = datetime.fromisoformat(origin)
    if midnight.tzinfo is not None or np.ndim(times) != 1:
        return
    seconds = np.round(times * calendar_time.SECONDS[unit], 3)
    stamps = np.datetime64(midnight, "ms") + (1000 * seconds).astype("m8[ms]")
    instants, counts = np.unique(stamps, return_counts=True)
    gaps = np.diff(instants) / np.timedelta64(1, "s")
    if len(gaps) < 2 or (step := np.median(gaps)) > 3600:
        return
    hours = instants.astype("M8[h]")
    repeated_hours = np.unique(hours[counts > 1])
    is_rare = counts.max() == 2 and 2 * np.count_nonzero(counts == 2) < len(counts)
    for hour in repeated_hours[:2] if is_rare else ():
        if _may_change(hour) and (counts[hours == hour] == 2).all():
            text = str(hour.astype("M8[m]"))
            label = location(int(np.argmax(stamps.astype("M8[h]") == hour)))
            checks.warn(f"{label}: the hour from {text} occurs twice, and its rows are read as replicates. If the "
                        "clock was set back there, they are an hour apart: give all times their offset, such as "
                        f"{text}+02:00 and {text}+01:00.")
            return
    for index in np.flatnonzero(np.isclose(gaps, step + 3600)):
        earlier, later = instants[index:index + 2].astype("M8[m]")
        hour = (earlier + np.timedelta64(round(step), "s")).astype("M8[h]")
        neighbours = np.append(gaps[max(index - 1, 0):index], gaps[index + 1:index + 2])
        if _may_change(hour) and earlier < hour and np.allclose(neighbours, step):
            label = location(int(np.argmax(stamps == instants[index + 1])))
            checks.warn(f"{label}: the hour from {hour.astype('M8[m]')} is skipped, and {earlier} and {later} are read "
                        f"as {gaps[index] / 60:g} min apart. If the clock was set forward there, they are "
                        f"{step / 60:g} min apart: give all times their offset from UTC, such as {earlier}+01:00 and "
                        f"{later}+02:00.")
            return


def _may_change(hour: np.datetime64) -> bool:
    """Return whether clocks may change to or from summer time in an hour."""
    stamp = hour.astype(datetime)
    return stamp.weekday() == 6 and stamp.month in _MONTHS_OF_CHANGES and stamp.hour <= 3
