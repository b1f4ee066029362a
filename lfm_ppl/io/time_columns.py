"""The time column of a table: its name, its dates or numbers, and their unit."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection

import numpy as np

from lfm_ppl.io.table import Table, as_number, is_missing, is_number, words_of
from lfm_ppl.utils import calendar_time, checks, date_warnings

_DATES = frozenset(("date", "dates", "datetime", "timestamp", "yyyymmdd", "yyyymmddhh", "yyyymmddhhmm", "ymd", "datum"))
"""Words in the names of columns of dates."""

_HOURS = frozenset(("time", "hour", "hours", "hh", "hr", "clock"))
"""Words in the names of columns of times of day."""

_DAY = re.compile(r"(\d{4}[-/.]\d\d?[-/.]\d\d?|\d\d?[-/.]\d\d?[-/.]\d{2,4})( 00:00:00)?")
_COMPACT_DAY = re.compile(r"\d{8}")
_TIME_OF_DAY = re.compile(r"\d\d?:\d\d(:\d\d(\.\d*)?)?( ?[AaPp][Mm])?")


def find_time_column(table: Table, time_column: str | None) -> str:
    """Return the name of the time column; ``time_column`` names it, None where its name or its dates tell."""
    header = list(table.frame)
    if time_column is not None and time_column not in header:
        unknown = checks.unknown("time column", time_column, header, checks.ABBREVIATIONS)
        raise ValueError(f"{table.label}: {unknown}")
    first_cells = {name: next((cell for cell in table.frame[name] if not is_missing(cell)), None) for name in header}
    candidates = ([name for name in header if name == time_column]
                  or [name for name in header if name.lower() == "time" or name == "t" or unit_of(name)]
                  or [name for name in header if name.lower() in ("date", "datetime", "timestamp")]
                  or [name for name in header if calendar_time.is_date(first_cells[name])]
                  or [name for name in header if _names_dates(name)
                      and calendar_time.compact_dates(table.frame[name]) is not None])
    if len(candidates) != 1:
        problem = f"several time columns: {', '.join(candidates)}" if candidates else (
            f"no time column; expected `time`, `t`, `time_h`, or one of dates, got the columns {', '.join(header)}"
            + (", which are numbers: a first row of names may be missing" if all(map(is_number, header)) else ""))
        raise ValueError(f"{table.label} has {problem}. Name it with --time-column (time_column=).")
    return candidates[0]


def unit_of(time_name: str) -> str | None:
    """Return h for ``time_h``, None where the name has no unit."""
    stem, _, unit = time_name.partition("_")
    return calendar_time.UNITS.get(unit) if stem.lower() == "time" else None


def _names_dates(time_name: str) -> bool:
    """Return whether the name of a column says that it holds dates."""
    return bool(words_of(time_name) & _DATES)


def read_times(table: Table, name: str, unit: str | None,
           usual: str | None) -> tuple[np.ndarray, str | None, str | None]:
    """Return times (T,), their unit and their origin, None where the table does not say, see `read_csv`."""
    cells = table.frame[name].to_numpy()
    if (rows := np.flatnonzero([is_missing(cell) for cell in cells])).size:
        raise ValueError(f"{table.location(rows[0], name)}: the time is missing.")
    named_unit, origin = unit_of(name), None
    if (dates := calendar_time.compact_dates(cells)) is not None:
        if unit or _names_dates(name):
            cells = np.array(dates, object)
        else:
            date_warnings.warn_of_compact_dates(table.location(0, name), cells[0], dates[0])
    if calendar_time.is_date(cells[0]):
        def location(row: int) -> str:
            return table.location(row, name)

        times, origin, unit = calendar_time.numbers_of(name, cells, unit or named_unit or usual, location)
        date_warnings.warn_of_changed_clock(location, times, origin, unit)
    else:
        times = table.numbers(name, "expected a finite number, or a date as 2026-03-31 in every row, got {}.")
        if named_unit and unit and calendar_time.UNITS[unit] != named_unit:
            raise ValueError(f"{table.label}: the column {name!r} says that its unit is {named_unit}, and --time-unit "
                             f"(time_unit=) says {unit}.")
        unit = named_unit or unit
        if unit is None and dates is None and _names_dates(name):
            date_warnings.warn_of_serial_dates(table.location(0, name), times)
    return times, unit, origin


def check_clock(table: Table, time_name: str, used: Collection[str]) -> None:
    """Raise ValueError where date and time of day stand in two columns.

    The time of day is a text such as 06:30, or a number in a column of hours, where dates repeat or the hours go back.
    It stands beside dates without it. ``used`` are the outputs and inputs, which hold no time.
    """
    def matches(pattern: re.Pattern, name: str) -> bool:
        return all(pattern.fullmatch(str(cell).strip()) for cell in table.frame[name])

    def holds_days(name: str) -> bool:
        return matches(_DAY, name) or _names_dates(name) and matches(_COMPACT_DAY, name)

    def holds_hours(name: str, has_evidence: Callable[[], bool]) -> bool:
        if matches(_TIME_OF_DAY, name):
            return True
        numbers = map(as_number, table.frame[name]) if words_of(name) & _HOURS else [None]
        return all(number is not None and 0 <= number <= 24 for number in numbers) and has_evidence()

    def repeats_days() -> bool:
        return table.frame[time_name].nunique() < len(table.frame)

    def goes_back() -> bool:
        return bool((np.diff(table.frame[time_name].astype(float)) < 0).any())

    unused = [name for name in table.frame if name != time_name and name not in used]
    pair = None
    if holds_hours(time_name, goes_back):
        pair = next(((name, time_name) for name in unused if holds_days(name)), None)
    elif holds_days(time_name):
        pair = next(((time_name, name) for name in unused if holds_hours(name, repeats_days)), None)
    if pair is not None:
        date, hour = (table.frame[name].iloc[0] for name in pair)
        raise ValueError(f"{table.label}: the date stands in the column {pair[0]!r} ({date}) and the time of day in "
                         f"{pair[1]!r} ({hour}); write them in one column, such as 2026-03-31T18:00.")
