"""Dates as numbers of a unit of time since an origin, and back.

The origin is the midnight before the first date on the clock of the data: the phase of a daily force is time of day.
Dates with an offset from UTC are subtracted in UTC, so that changes to and from summer time count elapsed time.
"""

import contextlib
import re
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from datetime import date, datetime, time, timedelta, timezone
from typing import Any

import numpy as np

_SPELLINGS = {"ms": (1e-3, ""), "s": (1.0, "sec second seconds"), "min": (60.0, "minute minutes"),
              "h": (3600.0, "hr hour hours"), "d": (86400.0, "day days"), "weeks": (604800.0, "week"),
              "years": (31557600.0, "yr year")}  # a year has 365.25 days
USUAL = tuple(_SPELLINGS)  # the spellings that the library prints
UNITS = {spelling: unit for unit, (_, more) in _SPELLINGS.items() for spelling in (unit, *more.split())}
SECONDS = {spelling: _SPELLINGS[unit][0] for spelling, unit in UNITS.items()}
_SMALLEST_GAPS = {"years": 300 * 86400.0, "d": 86400.0, "h": 3600.0, "min": 60.0, "s": 0.0}  # in seconds
_ISO_DATE = re.compile(r"\s*(?=.*[-:])\d{4}-?\d\d-?\d\d([\sT][\d:.]*)?\s*(?P<offset>Z|[+-]\d\d:?(\d\d)?)?\s*")
_COMPACT_DATE = re.compile(r"(?P<year>(1[7-9]|2[01])\d\d)(?P<month>0[1-9]|1[0-2])(?P<day>0[1-9]|[12]\d|3[01])"
                           r"((?P<hour>[01]\d|2[0-3]|24(?=$|00$))(?P<minute>[0-5]\d)?)?")
_CLOCK: ContextVar[tuple[str, str] | None] = ContextVar("clock", default=None)


def is_date(cell: Any) -> bool:
    """Return whether a cell of a table is a date: ISO 8601 text such as 2026-03-31, not 20260331, or an object."""
    if isinstance(cell, str) and _ISO_DATE.fullmatch(cell):
        import pandas as pd  # here, because `lfm-ppl --help` and arrays of numbers do not need it

        return not pd.isna(pd.to_datetime(cell.strip(), format="ISO8601", errors="coerce"))
    return isinstance(cell, (date, np.datetime64)) or type(cell).__name__ == "Period"


def compact_dates(cells: Any) -> list[datetime] | None:
    """Return the dates in whole numbers or texts YYYYMMDD, YYYYMMDDHH or YYYYMMDDHHMM; None unless all cells are dates.

    Hour 24 is hour 0 of the next day. The years are 1700 to 2199.
    """
    dates: list[datetime] = []
    length = None
    for cell in np.asarray(cells, object).flat:
        match = _COMPACT_DATE.fullmatch(cell.strip() if isinstance(cell, str) else _digits(cell))
        length = length or match and len(match[0])
        if match is None or len(match[0]) != length:
            return None
        year, month, day, hour, minute = (
            int(match[part] or 0) for part in ("year", "month", "day", "hour", "minute"))
        try:
            dates.append(datetime(year, month, day) + timedelta(hours=hour, minutes=minute))
        except ValueError:  # no such day
            return None
    return dates or None


def _digits(cell: Any) -> str:
    is_whole = isinstance(cell, (int, float, np.integer, np.floating)) and np.isfinite(cell) and cell == int(cell)
    return str(int(cell)) if is_whole else ""


def holds_dates(values: Any) -> bool:
    """Return whether the first entry of an array, an index, a sequence or a scalar is a date."""
    return is_date(_first_cell(values))


def holds_durations(values: Any) -> bool:
    """Return whether the first entry of an array, an index, a sequence or a scalar is a difference of dates."""
    return isinstance(_first_cell(values), (timedelta, np.timedelta64))


def _first_cell(values: Any) -> Any:
    while isinstance(values, (list, tuple)) and values:
        values = values[0]
    if not hasattr(values, "dtype"):
        return values
    # Arrays of numbers, tracers among them, are not converted; dtypes of polars have no kind.
    kind = getattr(values.dtype, "kind", "O" if hasattr(values, "to_numpy") else "")
    return next(iter(np.asarray(values).flat), None) if kind in tuple("MmOU") else None


def _read(name: str, values: Any, location: Callable[[int], str] | None = None) -> tuple[np.ndarray, Any]:
    """Return the cells and their dates, a DatetimeIndex in UTC where they have offsets, else without a time zone."""
    import pandas as pd

    cells = np.asarray(np.ma.filled(values, np.datetime64("NaT", "s")))
    cells = cells.astype(object) if cells.dtype.kind == "U" else cells  # pandas 2 reads no text of NumPy
    matches = [_ISO_DATE.fullmatch(cell) if isinstance(cell, str) else None for cell in cells.flat]
    # pandas also reads "now", and numbers as nanoseconds.
    dates = [match[0].strip() if match else cell if is_date(cell) else None
             for cell, match in zip(cells.flat, matches, strict=True)]
    has_offset = np.array([bool(match["offset"]) if match else getattr(cell, "tzinfo", None) is not None
                           for cell, match in zip(cells.flat, matches, strict=True)])
    utc = pd.to_datetime(pd.Series(dates, dtype=object), format="ISO8601", errors="coerce", utc=True)
    index = pd.DatetimeIndex(utc).as_unit("us")
    if (rows := np.flatnonzero(index.isna() | (has_offset != has_offset[0]))).size:
        row = rows[0]
        label = location(row) if location else f"{name}[{row}]" if cells.ndim else name
        offset = "with" if has_offset[0] else "without"
        raise ValueError(f"{label}: expected a date, year first, such as 2026-03-31T18:00, {offset} an offset from UTC "
                         f"as the first date, got {str(cells.flat[row])!r}.")
    return cells, index if has_offset[0] else index.tz_localize(None)


def numbers_of(name: str, values: Any, unit: str | None = None,
               location: Callable[[int], str] | None = None) -> tuple[np.ndarray, str, str]:
    """Return dates as numbers since the midnight before the first of them, the origin as ISO 8601 text, and the unit.

    ``location`` names an entry of ``values`` in errors, None by its index. The unit is by default the largest of years,
    d, h, min and s that is at most the median gap. Raises ValueError where an entry is no date.
    """
    cells, dates = _read(name, values, location)
    first = dates.min() if dates.tz is None else type(dates[0])(cells.flat[dates.argmin()])  # on its own clock
    midnight = datetime.combine(first.date(), time(), first.tzinfo)
    if (offset := midnight.utcoffset()) is not None:  # the origin is text, which holds no name of a time zone
        midnight = midnight.replace(tzinfo=timezone(offset))
    seconds = (dates - midnight).total_seconds().to_numpy()
    gaps = np.diff(seconds)
    gap = np.median(gaps[gaps > 0]) if (gaps > 0).any() else 0.0
    unit = UNITS[unit] if unit else next(name for name, smallest in _SMALLEST_GAPS.items() if gap >= smallest)
    return (seconds / SECONDS[unit]).reshape(cells.shape), midnight.isoformat(), unit


def check_offsets(origins: Mapping[str, str | None]) -> None:
    """Raise ValueError where the clocks of some origins, by name, have an offset from UTC and others have none."""
    has_offset = {name: datetime.fromisoformat(origin).tzinfo is not None for name, origin in origins.items() if origin}
    if len(set(has_offset.values())) > 1:
        with_offset, without = (next(name for name, value in has_offset.items() if value is offset)
                                for offset in (True, False))
        raise ValueError(f"the times of {with_offset!r} have an offset from UTC, and the times of {without!r} have "
                         "none; give an offset in all of them, or in none.")


def positions(name: str, values: Any, origin: str | None, unit: str) -> Any:
    """Return dates as numbers on an axis with this origin (None: plain numbers) and unit; other values are unchanged.

    Dates without an offset from UTC are on the clock of the origin. Raises ValueError for dates of another axis.
    """
    if not holds_dates(values):
        return values
    cells, dates = _read(name, values)
    start = datetime.fromisoformat(origin) if origin and unit in SECONDS else None
    if start is None:
        kind = f"numbers of {unit or 'an unknown unit'}" if origin else "plain numbers"
        raise ValueError(f"{name} must be numbers, as the times of the data are {kind}, got {str(cells.flat[0])!r}.")
    if dates.tz is not None and start.tzinfo is None:
        raise ValueError(f"{name}: {cells.flat[0]} has an offset from UTC, and the times of the data have none.")
    seconds = (dates - (start if dates.tz else start.replace(tzinfo=None))).total_seconds().to_numpy()
    return seconds.reshape(cells.shape) / SECONDS[unit]


def position(text: str, origin: str | None, unit: str) -> float:
    """Return a number in a text, or the position of a date as `positions` does."""
    if is_date(text):
        return float(positions("times", text, origin, unit))
    if origin is None or not re.fullmatch(r"\d{8}", text):  # 20260331 may be meant as a date
        with contextlib.suppress(ValueError):
            return float(text)
    raise ValueError(f"expected a number or a date, year first, such as 2026-03-31T18:00, got {text!r}.")


def clock(time: float, origin: str, unit: str, sep: str = " ", digits: int = 0) -> str:
    """Return a time as a date, on the clock of the origin, to so many digits of a second."""
    stamp = datetime.fromisoformat(origin) + timedelta(seconds=round(float(time) * SECONDS[unit], digits))
    return stamp.isoformat(sep=sep, timespec="auto" if stamp.second or stamp.microsecond else "minutes")


@contextlib.contextmanager
def in_messages(origin: str | None, unit: str) -> Iterator[None]:
    """Show times in messages as dates while the context is active; origin None: times are plain numbers."""
    token = _CLOCK.set((origin, unit) if origin and unit in SECONDS else None)
    try:
        yield
    finally:
        _CLOCK.reset(token)


def named(time: float) -> str:
    """Return a time for a message, as a date inside of `in_messages`."""
    return f"{time:g}" if (axis := _CLOCK.get()) is None else clock(time, *axis, sep="T")


def days_of(times: Any, origin: str, unit: str) -> np.ndarray:
    """Return times as days since 1970-01-01, on the clock of the origin: Matplotlib's dates."""
    midnight = np.datetime64(datetime.fromisoformat(origin).replace(tzinfo=None))
    days = (midnight - np.datetime64("1970-01-01")) / np.timedelta64(1, "D")
    return days + np.asarray(times) * (SECONDS[unit] / SECONDS["d"])
