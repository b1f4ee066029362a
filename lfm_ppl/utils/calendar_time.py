"""Calendar time: dates and times of day as numbers of a unit since an origin, and back.

1. The origin is the midnight before the first time, on the clock of the data, so that the phase of a force with a daily
   or weekly period is the time of day.
2. Differences refer to absolute time: with an offset from UTC in every row, changes to and from summer time are counted
   correctly.
3. Inside `in_messages`, messages show times as dates.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from datetime import UTC, date, datetime, time, timedelta, timezone
from typing import Any

import numpy as np

_LENGTHS = {
    ("ms",): 1e-3, ("s", "sec", "second", "seconds"): 1.0, ("min", "minute", "minutes"): 60.0,
    ("h", "hr", "hour", "hours"): 3600.0, ("d", "day", "days"): 86400.0, ("week", "weeks"): 604800.0,
    ("yr", "year", "years"): 31557600.0,
}

USUAL = tuple(names[0] for names in _LENGTHS)
"""Of several names of a unit the first one."""

SECONDS = {name: length for names, length in _LENGTHS.items() for name in names}
"""Unit of time -> its length in seconds; a year is 365.25 days."""

_INFERRED = (("years", 300 * 86400.0), ("d", 86400.0), ("h", 3600.0), ("min", 60.0), ("s", 1.0))
"""Unit -> the median gap, in seconds, from which on it is chosen."""


def is_date(cell: Any) -> bool:
    """Whether a cell of a table holds a date or a time of a calendar, and not a number."""
    # Periods of pandas; its tables and columns have `to_timestamp`, too.
    if isinstance(cell, (date, np.datetime64)) or hasattr(cell, "to_timestamp") and hasattr(cell, "ordinal"):
        return True
    if not isinstance(cell, str) or not any(mark in cell for mark in "-:"):
        return False  # 20190412 is a number
    try:
        parse(cell)
    except ValueError:
        return False
    return True


def parse(cell: Any) -> datetime:
    """Return the time that a cell stands for: ISO 8601 text, a date, a `datetime`, or NumPy's or pandas' of these.

    Raises:
        ValueError: it stands for none.
    """
    if hasattr(cell, "to_timestamp"):  # a period of pandas
        cell = cell.to_timestamp()
    if hasattr(cell, "to_pydatetime"):  # pandas
        cell = cell.to_pydatetime(warn=False)
    if isinstance(cell, np.datetime64):
        cell = cell.astype("datetime64[us]").item()
    if isinstance(cell, datetime):
        return cell
    if isinstance(cell, date):
        return datetime.combine(cell, time())
    if not isinstance(cell, str):
        raise ValueError(f"{cell!r} is no date")
    return datetime.fromisoformat(cell.strip())


def holds_dates(values: Any) -> bool:
    """Whether an array, an index, a sequence or a scalar holds dates or times of a calendar.

    Example:
        >>> holds_dates(np.array(["2026-01-05"], "M8[D]")), holds_dates(["2026-01-05"]), holds_dates([20260105])
        (True, True, False)
    """
    return is_date(_first_cell(values))


def holds_durations(values: Any) -> bool:
    """Whether an array, an index, a sequence or a scalar holds differences of dates."""
    return isinstance(_first_cell(values), (timedelta, np.timedelta64))


def _first_cell(values: Any) -> Any:
    """Return the first entry of an array or a sequence, None where it has none or is an array of numbers."""
    while isinstance(values, (list, tuple)):
        if not values:
            return None
        values = values[0]
    if not hasattr(values, "dtype") or isinstance(values, (np.datetime64, np.timedelta64)):
        return values
    # Arrays of numbers, tracers among them, are left alone; dtypes of polars have no kind.
    kind = getattr(values.dtype, "kind", "O" if hasattr(values, "to_numpy") else "")
    if kind not in tuple("MmOU"):
        return None
    array = np.asarray(values)
    return array.flat[0] if array.size else None


def dates_of(name: str, values: Any) -> tuple[list[datetime], tuple[int, ...]]:
    """Return the dates in an array, an index or a sequence in C order, and its shape.

    Args:
        name: of the argument, for messages.
        values: for which `holds_dates` is true.

    Raises:
        ValueError: an entry is missing or no date; some dates have an offset from UTC and others have none.
    """
    if isinstance(values, np.ma.MaskedArray):
        values = np.where(np.ma.getmaskarray(values), np.array("NaT", values.dtype), np.ma.getdata(values))
    array = np.asarray(values)
    # NumPy returns numbers for nanoseconds, where datetime has none.
    cells = (array.astype("M8[us]") if array.dtype.kind == "M" else array).ravel().tolist()
    stamps = []
    for index, cell in enumerate(cells):
        location = f"{name}[{index}]" if array.ndim else name
        if cell is None or cell != cell:  # NaT
            raise ValueError(f"{location} is missing (NaT); leave out the rows without a time.")
        try:
            stamps.append(parse(cell))
        except ValueError:
            raise ValueError(f"{location} must be a date, year first, as the first entry is, got {cell!r}.") from None
        if (stamps[-1].tzinfo is None) != (stamps[0].tzinfo is None):
            raise ValueError(f"{name} must have an offset from UTC in all of its dates or in none; {location} is "
                             f"{cell!s}, and the first is {cells[0]!s}.")
    return stamps, array.shape


def numbers_of(name: str, values: Any, unit: str | None = None) -> tuple[np.ndarray, str, str]:
    """Return dates as numbers since the midnight before the first of them, in an array of their shape.

    Args:
        name: of the argument, for messages.
        values: for which `holds_dates` is true.
        unit: as in `since_midnight`.

    Returns:
        times, the origin as ISO 8601 text, and the unit.

    Raises:
        ValueError: as `dates_of`.

    Example:
        >>> numbers_of("times", np.array(["2026-01-05T06", "2026-01-05T07"], "M8[h]"))
        (array([6., 7.]), '2026-01-05T00:00:00', 'h')
    """
    stamps, shape = dates_of(name, values)
    times, origin, unit = since_midnight(stamps, unit)
    return times.reshape(shape), origin, unit


def positions(name: str, values: Any, origin: str | None, unit: str) -> Any:
    """Return dates as numbers on the axis of times; values that are no dates as they are.

    Args:
        name: of the argument, for messages.
        values: an array, an index or a sequence of dates or of numbers.
        origin: of the axis, as `since_midnight` gives it; None: its times are plain numbers.
        unit: of the axis.

    Raises:
        ValueError: dates where the times are plain numbers or have an unknown unit; as `dates_of`; or only one of dates
            and origin has an offset from UTC, as in `position`.

    Example:
        >>> positions("at", ["2026-01-06", "2026-01-06T12:00"], "2026-01-05T00:00:00", "h")
        array([24., 36.])
    """
    if not holds_dates(values):
        return values
    stamps, shape = dates_of(name, values)
    if origin is None or unit not in SECONDS:
        kind = "plain numbers" if origin is None else f"numbers of {unit or 'an unknown unit'}"
        raise ValueError(f"{name} must be numbers, because the times of the data are {kind}; got the date "
                         f"{stamps[0].isoformat()}.")
    start = datetime.fromisoformat(origin)
    try:
        seconds = [_seconds_since(start, stamp) for stamp in stamps]
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    return np.array(seconds).reshape(shape) / SECONDS[unit]


def _seconds_since(start: datetime, stamp: datetime) -> float:
    """Return the seconds from an origin to a date, which is read on the clock of the origin if it has no offset."""
    if stamp.tzinfo is None:
        stamp = stamp.replace(tzinfo=start.tzinfo)
    elif start.tzinfo is None:
        raise ValueError(f"{stamp.isoformat()!r} has an offset from UTC and the times of the data have none; leave it "
                         "out.")
    return (stamp - start).total_seconds()


def since_midnight(stamps: Sequence[datetime], unit: str | None = None) -> tuple[np.ndarray, str, str]:
    """Return times as numbers since the midnight before the first of them.

    Args:
        stamps: all with an offset from UTC, or all without.
        unit: one of `SECONDS`; None: the largest of years, d, h, min and s that is at most the median gap.

    Returns:
        times (T,), the origin as ISO 8601 text, and the unit.

    Example:
        >>> stamps = [datetime.fromisoformat(text) for text in ("2019-12-23 06:00", "2019-12-23 07:30")]
        >>> since_midnight(stamps)
        (array([6. , 7.5]), '2019-12-23T00:00:00', 'h')
    """
    first = min(stamps)
    origin = datetime.combine(first.date(), time(), first.tzinfo)
    offset = origin.utcoffset()
    if offset is not None:  # times that share a time zone are subtracted as its clocks show them, change of hour or not
        origin = origin.replace(tzinfo=timezone(offset))
        stamps = [stamp.astimezone(UTC) for stamp in stamps]
    seconds = np.array([(stamp - origin).total_seconds() for stamp in stamps])
    if unit is None:
        gaps = np.diff(seconds)
        gap = float(np.median(gaps[gaps > 0])) if np.any(gaps > 0) else 1.0
        unit = next((name for name, least in _INFERRED if gap >= least), "s")
    return seconds / SECONDS[unit], origin.isoformat(), unit


def position(text: str, origin: str | None, unit: str) -> float:
    """Return where a date, or a number written as text, lies on the axis of times.

    Args:
        text: a number, or ISO 8601.
        origin: of the axis, as `since_midnight` gives it; None: its times are plain numbers.
        unit: of the axis.

    Raises:
        ValueError: text that is neither, or a date where the times are plain numbers; or only one of text and origin
            has an offset from UTC.

    Example:
        >>> position("2019-12-24T12:00", "2019-12-23T00:00:00", "h"), position("3.5", None, "h")
        (36.0, 3.5)
    """
    try:
        number = float(text)
    except ValueError:
        pass
    else:
        if origin is not None and len(text) == 8 and text.isdigit():
            raise ValueError(f"is {text} a number or a date? Write a date as 2026-03-31, and a number as {text}.0.")
        return number
    try:
        stamp = parse(text)
    except ValueError:
        raise ValueError("expected a number or a date, year first, such as 2026-03-31 or 2026-03-31T18:00, got "
                         f"{text!r}.") from None
    if origin is None:
        raise ValueError(f"the times of the data are plain numbers, so the date {text!r} means nothing; give a number.")
    return _seconds_since(datetime.fromisoformat(origin), stamp) / SECONDS[unit]


def clock(time: float, origin: str, unit: str, sep: str = " ", digits: int = 0) -> str:
    """Return a time as a date, on the clock of the origin, to so many digits of a second.

    Example:
        >>> clock(36.0, "2019-12-23T00:00:00", "h")
        '2019-12-24 12:00'
    """
    stamp = datetime.fromisoformat(origin) + timedelta(seconds=round(float(time) * SECONDS[unit], digits))
    return stamp.isoformat(sep=sep, timespec="auto" if stamp.second or stamp.microsecond else "minutes")


_CLOCK: ContextVar[tuple[str, str] | None] = ContextVar("clock", default=None)


@contextlib.contextmanager
def in_messages(origin: str | None, unit: str) -> Iterator[None]:
    """Let messages name times as the data do: as dates, where their origin is known.

    Args:
        origin: None where the times are plain numbers.
        unit: that they count.
    """
    token = _CLOCK.set((origin, unit) if origin and unit in SECONDS else None)
    try:
        yield
    finally:
        _CLOCK.reset(token)


def named(time: float) -> str:
    """Return a time for a message, see `in_messages`.

    Example:
        >>> with in_messages("2019-12-23T00:00:00", "h"):
        ...     named(36.0)
        '2019-12-24T12:00'
        >>> named(36.0)
        '36'
    """
    origin_and_unit = _CLOCK.get()
    return f"{time:g}" if origin_and_unit is None else clock(time, *origin_and_unit, sep="T")


def days_of(times: Any, origin: str, unit: str) -> np.ndarray:
    """Return times as days since 1970-01-01, on the clock of the origin: what Matplotlib draws dates by."""
    start = datetime.fromisoformat(origin).replace(tzinfo=UTC)
    epoch = datetime(1970, 1, 1, tzinfo=UTC)
    return (start - epoch) / timedelta(days=1) + np.asarray(times, float) * (SECONDS[unit] / SECONDS["d"])
