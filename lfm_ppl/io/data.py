"""Observations and known inputs of a CSV file, of a table of another library, or of the series of one file."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lfm_ppl.io import table as tables
from lfm_ppl.io.data_set import DOSE, INTERPOLATIONS, Data, InputTable, fill_blanks
from lfm_ppl.io.data_set import stack_series as stack_series
from lfm_ppl.io.missing_codes import warn_of_codes
from lfm_ppl.io.table import Table, is_missing
from lfm_ppl.utils import calendar_time, checks, date_warnings


def read_csv(path: str | Path, outputs: Sequence[str] | None = None, time_column: str | None = None,
             inputs: Sequence[str] | Mapping[str, str] = (), time_unit: str | None = None, *,
             usual_unit: str | None = None, observed: bool = True) -> Data:
    r"""Read observations and known inputs from a comma-separated file.

    Args:
        path: the file. Lines that start with ``#`` and blank lines are skipped.
        outputs: the columns to read, in this order. None: every column but the time, the inputs,
            ``replicate`` and numbers of rows without a name (``Unnamed: 0``).
        time_column: the name of the time column. None: ``time``, ``t`` or ``time_UNIT``, as in ``time_h``, which also
            sets the unit of time; else ``date``, ``datetime``, ``timestamp``, or the only column that begins with a
            date.
        inputs: columns of known inputs; or a mapping column -> "previous" (a value holds until the next, the default)
            or "linear" (values are joined by lines), which interpolate over empty cells and warn of them; or "zero",
            which is "previous" with empty cells read as zero; or "dose:STATE", doses to a state in the rows with a
            number (see `lfm_ppl.Dose`). A row at the time of another row that has a value counts as filled.
        time_unit: unit of the times (ms, s, min, h, d, weeks, years). Dates are counted in it, by default in that of
            the time between rows. Numbers are in it; whole numbers that are all dates YYYYMMDD, YYYYMMDDHH or
            YYYYMMDDHHMM are read as dates if it is given, or if the name of the column is that of a date.
        usual_unit: the default of ``time_unit``, the unit of a model.
        observed: whether a file without any value of the outputs is an error; known inputs of the future have none.

    Returns:
        The observations; empty cells (and NA, NaN, a single point) are NaN. Dates (ISO 8601, with an offset from UTC in
        each row, or in none) become numbers since the midnight before the first of them, which is the `Data.origin`.

    Raises:
        ValueError: the file is no comma-separated text, a column is missing, ambiguous or repeated, or a cell has no
            number or no date, a time goes back, or a column seems to identify several series.

    Warns:
        UserWarning: a number such as -9999 seems to stand for a missing value; a known input has empty cells; numbers
            seem to be dates; dates without offset from UTC seem to repeat or skip an hour of a change of the clock.

    Example:
        >>> import pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "expression.csv"
        >>> _ = path.write_text("time_h,replicate,a,b\n0,1,0.5,\n0,2,0.6,1.5\n2,1,0.9,1.9\n")
        >>> data = read_csv(path)
        >>> data.outputs, data.units, data.times.tolist()
        (('a', 'b'), {'time': 'h'}, [0.0, 0.0, 2.0])
        >>> _ = path.write_text("date,T,heater\n2026-01-05 06:00,18.1,0\n2026-01-05 07:00,18.4,1\n")
        >>> data = read_csv(path, inputs=["heater"])
        >>> data.times.tolist(), data.units, data.origin, float(data.known_inputs()["heater"](7.5))
        ([6.0, 7.0], {'time': 'h'}, '2026-01-05T00:00:00', 1.0)
    """
    return _read(tables.read_file(path), outputs, time_column, inputs, time_unit, usual_unit, observed=observed)


def read_table(frame: Any, outputs: Sequence[str] | None = None, time_column: str | None = None,
               inputs: Sequence[str] | Mapping[str, str] = (), time_unit: str | None = None) -> Data:
    """Read observations and known inputs from a table in memory.

    Args:
        frame: a pandas DataFrame or Series (an index of dates, or one with a name, is a column), a polars DataFrame,
            an xarray Dataset or DataArray along time, or a mapping of column names to values.
        outputs: as in `read_csv`, and so are the others.
        time_column: the name of the time column.
        inputs: columns of known inputs.
        time_unit: unit of times that are dates.

    Returns:
        The observations.

    Raises:
        ValueError: as for `read_csv`; rows are counted from 0.
        TypeError: no such table.

    Example:
        >>> import pandas as pd
        >>> hours = pd.date_range("2026-01-05", periods=3, freq="h")
        >>> read_table(pd.DataFrame({"T": [18.1, None, 18.4]}, index=hours)).y.ravel()
        array([18.1,  nan, 18.4])
    """
    return _read(tables.from_frame(frame), outputs, time_column, inputs, time_unit)


def as_data(data: Any) -> Data:
    """Return data, or the data of a table (`read_table`) whose every column is the time or an output."""
    if isinstance(data, Data):
        return data
    if tables.is_table(data):
        return read_table(data)
    raise TypeError("without y the data must be lfm.Data, a DataFrame or an xarray Dataset, got "
                    f"{type(data).__name__}. Pass times and y.")


def read_series(path: str | Path, column: str, outputs: Sequence[str] | None = None, time_column: str | None = None,
                inputs: Sequence[str] | Mapping[str, str] = (), time_unit: str | None = None,
                usual_unit: str | None = None) -> dict[str, Data]:
    """Read the series of one comma-separated file: identifier -> observations, in the order of the file.

    The text in ``column``, as in ``patient``, identifies the series of each row; other arguments: see `read_csv`.
    Rows of a series need not stand together, but their times must not go back.
    """
    table = tables.read_file(path)
    if column not in table.frame:
        raise ValueError(f"{table.label}: {checks.unknown('column of series', column, list(table.frame))}")
    if (rows := np.flatnonzero(table.frame[column] == "")).size:
        raise ValueError(f"{table.location(rows[0], column)}: the identifier of the series is missing.")
    return {name: _read(Table(table.label, rows.drop(columns=column)), outputs, time_column, inputs, time_unit,
                        usual_unit, f" of series {name!r}") for name, rows in table.frame.groupby(column, sort=False)}


def write_csv(data: Data, path: str | Path) -> None:
    """Write observations so that `read_csv` reads the same numbers back.

    Known inputs follow the outputs, with their values at the times of the rows; NaN becomes an empty cell.
    """
    import pandas as pd

    unit = data.units.get("time", "")
    functions = data.known_inputs()
    inputs = [functions[name](data.times) if name in functions else _doses_in_rows(name, table, data.times)
              for name, table in data.inputs.items()]
    header = [f"time_{unit}" if unit in calendar_time.SECONDS else "time", *data.outputs, *data.inputs]
    pd.DataFrame(np.column_stack([data.times, data.y, *inputs]), columns=header).to_csv(path, index=False)


def _doses_in_rows(name: str, table: InputTable, times: np.ndarray) -> np.ndarray:
    """Return doses (T,) in the first row of their times, NaN elsewhere."""
    rows = np.searchsorted(times, table.times)
    if not np.isin(table.times, times).all():
        raise ValueError(f"the doses {name!r} need rows at their times; add rows of missing observations there.")
    values = np.full(len(times), np.nan)
    values[rows] = table.values
    return values


def _read(table: Table, outputs: Sequence[str] | None, time_column: str | None,
          inputs: Sequence[str] | Mapping[str, str], time_unit: str | None, usual_unit: str | None = None,
          part: str = "", observed: bool = True) -> Data:
    """Return the observations in a table; ``part`` names a series of a file in errors, see `read_csv`."""
    if time_unit is not None:
        checks.one_of("time_unit", time_unit, calendar_time.SECONDS)
    for argument, value in (("outputs", outputs), ("inputs", inputs)):
        if isinstance(value, str):
            raise TypeError(f"{argument} must be a sequence of column names, such as [{value!r}], got {value!r}.")
    interpolations = dict(inputs) if isinstance(inputs, Mapping) else dict.fromkeys(inputs, "previous")
    time_name = _time_column(table, time_column)
    columns = [name for name in table.frame if name != time_name]
    names = list(outputs) if outputs is not None else [
        name for name in columns if name not in interpolations and not _ROW_NAMES.fullmatch(name)]
    for kind, requested in (("output", names), ("input", interpolations)):
        for name in requested:
            if name not in columns:
                unknown = checks.unknown(f"{kind} column", name, columns)
                raise ValueError(f"{table.label}: {unknown} Name the columns with --{kind}s ({kind}s=).")
    if not names or len({*names, *interpolations}) < len(names) + len(interpolations):
        raise ValueError(f"{table.label}: expected at least one output column beside the time {time_name!r}, and each "
                         f"column once, as an output or an input; got the outputs {names} and the inputs "
                         f"{list(interpolations)}.")
    used = {*interpolations, *(names if outputs is not None or len(names) == 1 else ())}
    free = [] if part else [name for name in columns if name not in used]
    _check_clock(table, time_name, {*interpolations, *(outputs or ())})
    times, unit, origin = _times(table, time_name, time_unit, usual_unit)
    _check_order(table, time_name, times, free, outputs is not None)
    y = np.column_stack([table.numbers(name) for name in names])
    if observed and np.isnan(y).all():
        raise ValueError(f"{table.label}: every value of {', '.join(names)}{part} is missing; expected a number.")
    for name, column in zip(names, y.T, strict=True):
        warn_of_codes(table, name, column)
    return Data(times, y, tuple(names), units={"time": unit} if unit else {}, origin=origin, inputs={
        name: _input(table, name, interpolation, times) for name, interpolation in interpolations.items()})


def _time_column(table: Table, time_column: str | None) -> str:
    header = list(table.frame)
    if time_column is not None and time_column not in header:
        unknown = checks.unknown("time column", time_column, header, checks.ABBREVIATIONS)
        raise ValueError(f"{table.label}: {unknown}")
    first_cells = {name: next((cell for cell in table.frame[name] if not is_missing(cell)), None) for name in header}
    candidates = ([name for name in header if name == time_column]
                  or [name for name in header if name.lower() == "time" or name == "t" or _unit_of(name)]
                  or [name for name in header if name.lower() in ("date", "datetime", "timestamp")]
                  or [name for name in header if calendar_time.is_date(first_cells[name])]
                  or [name for name in header if _names_dates(name)
                      and calendar_time.compact_dates(table.frame[name]) is not None])
    if len(candidates) != 1:
        problem = f"several time columns: {', '.join(candidates)}" if candidates else (
            f"no time column; expected `time`, `t`, `time_h`, or one of dates, got the columns {', '.join(header)}"
            + (", which are numbers: a first row of names may be missing" if all(map(_is_number, header)) else ""))
        raise ValueError(f"{table.label} has {problem}. Name it with --time-column (time_column=).")
    return candidates[0]


def _unit_of(time_name: str) -> str | None:
    """Return h for ``time_h``, None where the name has no unit."""
    stem, _, unit = time_name.partition("_")
    return calendar_time.UNITS.get(unit) if stem.lower() == "time" else None


def _names_dates(time_name: str) -> bool:
    """Return whether the name of a column says that it holds dates."""
    return bool(_words(time_name) & _DATES)


def _times(table: Table, name: str, unit: str | None,
           usual: str | None) -> tuple[np.ndarray, str | None, str | None]:
    """Return times (T,), their unit and their origin, None where the table does not say, see `read_csv`."""
    cells = table.frame[name].to_numpy()
    if (rows := np.flatnonzero([is_missing(cell) for cell in cells])).size:
        raise ValueError(f"{table.location(rows[0], name)}: the time is missing.")
    named_unit, origin = _unit_of(name), None
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


def _check_clock(table: Table, time_name: str, used: Collection[str]) -> None:
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
        numbers = map(_as_number, table.frame[name]) if _words(name) & _HOURS else [None]
        return all(number is not None and 0 <= number <= 24 for number in numbers) and has_evidence()

    def repeats_days() -> bool:
        return table.frame[time_name].nunique() < len(table.frame)

    def goes_back() -> bool:
        return bool((np.diff(table.frame[time_name].astype(float)) < 0).any())

    others = [name for name in table.frame if name != time_name and name not in used]
    pair = None
    if holds_hours(time_name, goes_back):
        pair = next(((name, time_name) for name in others if holds_days(name)), None)
    elif holds_days(time_name):
        pair = next(((time_name, name) for name in others if holds_hours(name, repeats_days)), None)
    if pair is not None:
        date, hour = (table.frame[name].iloc[0] for name in pair)
        raise ValueError(f"{table.label}: the date stands in the column {pair[0]!r} ({date}) and the time of day in "
                         f"{pair[1]!r} ({hour}); write them in one column, such as 2026-03-31T18:00.")


def _check_order(table: Table, time_name: str, times: np.ndarray, free: Sequence[str], is_unused: bool) -> None:
    """Raise ValueError where the time goes back, or where several series seem to stand in one table.

    ``free`` are the columns that may hold identifiers of series; ``is_unused``: see `_merged_series_column`.
    """
    cells = table.frame[time_name].to_numpy()
    rows = np.flatnonzero(np.diff(times) < 0)
    series = _series_column(table, times, free) if rows.size else _merged_series_column(
        table, times, free, is_unused)
    if series is not None:
        labels = table.frame[series].astype(str).to_numpy()
        row = (rows if rows.size else np.flatnonzero(labels[1:] != labels[:-1]))[0] + 1
        change = f"the column {series!r} changes from {labels[row - 1]} to {labels[row]}"
        if rows.size:
            change = f"the time goes back from {cells[row - 1]} to {cells[row]}, where {change}"
        otherwise = "" if rows.size else (" If it names outputs, give each of them a column; else leave the column "
                                          "out of the file or table.")
        raise ValueError(f"{table.label}, row {table.frame.index[row]}: {change}. If "
                         f"it names several series, fit them separately: --series {series} (lfm.data.read_series("
                         f"path, {series!r}), or lfm.read_table of each part of a DataFrame).{otherwise}")
    if rows.size:
        row = rows[0] + 1
        raise ValueError(f"{table.label}, row {table.frame.index[row]}: the time goes back from {cells[row - 1]} to "
                         f"{cells[row]}. Sort the rows by time; replicates are rows with the same time. A clock that "
                         "is set back for winter needs offsets from UTC.")


def _input(table: Table, name: str, interpolation: str, times: np.ndarray) -> InputTable:
    """Return the column of a known input without its empty cells."""
    is_dose = interpolation.startswith(DOSE)
    if not is_dose:
        checks.one_of(f"interpolation of {name}", interpolation, INTERPOLATIONS)
    values = table.numbers(name)
    remedy = f"--inputs {name}:zero (inputs={{{name!r}: 'zero'}})"
    if not is_dose and interpolation != "zero" and np.isnan(values[times == times[0]]).all():
        raise ValueError(f"{table.location(0, name)}: the known input has no value at the first time; fill the cell, "
                         f"or read empty cells as zero: {remedy}.")
    warn_of_codes(table, name, values)
    values = fill_blanks(f"{table.label}, column {name!r}", remedy, times, values, interpolation)
    rows = np.flatnonzero(np.isfinite(values) & ~(is_dose & (values == 0)))
    unique_times, first, inverse = np.unique(times[rows], return_index=True, return_inverse=True)
    first_values = values[rows[first]]
    if is_dose and (repeated := np.setdiff1d(np.arange(len(rows)), first)).size:
        raise ValueError(f"{table.location(rows[repeated[0]], name)}: there are two doses at one time; write their sum "
                         "in one row.")
    if (other_rows := rows[values[rows] != first_values[inverse]]).size:
        raise ValueError(f"{table.location(other_rows[0], name)}: the known input has another value at the same time.")
    return InputTable(unique_times, first_values, "previous" if interpolation == "zero" else interpolation)


_DATES = frozenset(("date", "dates", "datetime", "timestamp", "yyyymmdd", "yyyymmddhh", "yyyymmddhhmm", "ymd", "datum"))
"""Words in the names of columns of dates."""

_ROW_NAMES = re.compile(r"|Unnamed: \d+(\.\d+)*|row\W?names|replicate", re.IGNORECASE)
"""Names of columns that pandas, R and spreadsheets give to numbers of rows, and of replicates: no outputs."""

_HOURS = frozenset(("time", "hour", "hours", "hh", "hr", "clock"))
"""Words in the names of columns of times of day."""

_DAY = re.compile(r"(\d{4}[-/.]\d\d?[-/.]\d\d?|\d\d?[-/.]\d\d?[-/.]\d{2,4})( 00:00:00)?")
_COMPACT_DAY = re.compile(r"\d{8}")
_TIME_OF_DAY = re.compile(r"\d\d?:\d\d(:\d\d(\.\d*)?)?( ?[AaPp][Mm])?")

_IDENTIFIERS = frozenset((
    "id", "ids", "subject", "subj", "subjid", "subjectid", "usubjid", "patient", "patientid", "participant", "person",
    "volunteer", "individual", "indiv", "animal", "animalid", "series", "group", "name", "who"))
"""Words in the names of columns that identify the series of a row."""

_SUBJECTS = _IDENTIFIERS | frozenset((
    "mouse", "rat", "dog", "pig", "rabbit", "monkey", "sheep", "cow", "fish", "bird", "plant", "tree", "child",
    "household", "customer", "cage", "plot", "tank", "well"))
"""These, and words that also name measurements, such as the number of sheep."""

_REPLICATES = frozenset(("replicate", "replicates", "replication", "rep", "reps", "repl", "repeat", "duplicate",
                         "triplicate", "technical"))
"""Words in the names of columns that number the measurements of one time."""


def _words(name: str) -> set[str]:
    """Return the words of a column's name, ``{"patient", "id"}`` for ``PatientID``; none of ``rat2``, a series."""
    if re.search(r"\d", name):
        return set()
    return set(re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()))


def _series_column(table: Table, times: np.ndarray, free: Sequence[str]) -> str | None:
    """Return the column that seems to hold identifiers of series where the time goes back, None where there is none.

    Its cells are filled, and the time does not go back among the rows that share a value. Unless its name is that of an
    identifier, these rows stand together, and a value has two of them or more on average.
    """
    candidates = []
    for name in free:
        labels, index = np.unique(table.frame[name].astype(str), return_inverse=True)
        order = np.argsort(index, kind="stable")
        goes_back = (np.diff(times[order]) < 0) & (np.diff(index[order]) == 0)
        # Replicates that stand one below the other are one series, to be sorted.
        if _words(name) & _REPLICATES or len(labels) == 1 or goes_back.any() or any(
                map(is_missing, table.frame[name])):
            continue
        if _words(name) & (_IDENTIFIERS | {"unit"}):
            return name
        if 1 + np.count_nonzero(np.diff(index)) == len(labels) <= len(index) / 2:
            candidates.append(name)
    return candidates[0] if candidates else None


def _merged_series_column(table: Table, times: np.ndarray, free: Sequence[str], is_unused: bool) -> str | None:
    """Return the column that seems to hold identifiers of series where the time never goes back.

    Its cells are texts or whole numbers, all filled. Either its name is that of an identifier, and half of the rows or
    more share their value with another row: a number of the row, or of an animal that is measured once, identifies no
    series. Or its values tell rows of equal times apart, each of them at several times. A factor such as the weather
    does not, as it is equal in rows of one time. Measurements that are whole numbers may tell rows apart, too, but not
    with the same numbers at all times.

    Args:
        table: the table.
        times: (T,).
        free: the columns that may hold identifiers.
        is_unused: whether these columns are known to be no outputs.
    """
    _, instant = np.unique(times, return_inverse=True)
    for name in free:
        words, cells = _words(name), table.frame[name]
        kind = None if words & _REPLICATES else _kind_of_labels(cells)
        if kind is None or any(map(is_missing, cells)):
            continue
        labels, index, counts = np.unique(cells.astype(str), return_inverse=True, return_counts=True)
        if len(labels) == 1:
            continue
        identifiers = _SUBJECTS if is_unused or kind is str else _IDENTIFIERS
        if words & identifiers and counts[counts > 1].sum() >= len(index) / 2:
            return name
        rows = np.zeros((instant.max() + 1, len(labels)), int)
        np.add.at(rows, (instant, index), 1)
        is_shared = np.count_nonzero(rows, axis=1) > 1
        if rows.max() == 1 and is_shared.sum() > 1 and counts.min() > 1 and (kind is str or rows.all()):
            return name
    return None


def _kind_of_labels(cells: Any) -> type | None:
    """Return str or int where all cells of a column are texts or whole numbers, else None."""
    if all(_as_number(cell) is None for cell in cells):
        return str
    numbers = map(_as_number, cells)
    return int if all(number is not None and number == int(number) for number in numbers) else None


def _is_number(cell: Any) -> bool:
    return _as_number(cell) is not None


def _as_number(cell: Any) -> float | None:
    try:
        return float(cell) if np.isfinite(float(cell)) else None
    except (TypeError, ValueError):
        return None
