"""Reading of data: a CSV file, a table of another library, or the series of one file.

1. A table has a header, a time column, one column per output, and one per known input.
2. Times are numbers or dates, and must not decrease; repeated times are replicates.
3. Empty cells are missing values; a number that looks like a code of missing values raises a warning.
4. Errors name the file, the row as an editor counts it (the header is row 1), and the column.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lfm_ppl.io import table
from lfm_ppl.io.cells import is_missing, parse_number, warn_of_codes
from lfm_ppl.io.data_set import INTERPOLATIONS, Data, InputTable, fill_blanks, stored_interpolation, zero_option
from lfm_ppl.io.table import Table
from lfm_ppl.utils import calendar_time, checks

if TYPE_CHECKING:
    pass


_DATE_NAMES = ("date", "datetime", "timestamp")


def read_csv(
    path: str | Path,
    outputs: Sequence[str] | None = None,
    time_column: str | None = None,
    inputs: Sequence[str] | Mapping[str, str] = (),
    time_unit: str | None = None,
    *,
    usual_unit: str | None = None,
    observed: bool = True,
) -> Data:
    r"""Read observations and known inputs from a comma-separated file.

    Args:
        path: the file. Lines that start with ``#`` and blank lines are skipped.
        outputs: the columns to read, in this order. None: every column but the time, the inputs and
            ``replicate``.
        time_column: the name of the time column. None: ``time``, ``t`` or ``time_UNIT``, as in
            ``time_h``, which also sets the unit of time; else ``date``, ``datetime``, ``timestamp``, or the only
            column that begins with a date.
        inputs: columns of known inputs; or a mapping column -> "previous" (a value holds until the next, the default)
            or "linear" (values are joined by lines), which interpolate over empty cells and warn of them; or "zero",
            which is "previous" with empty cells read as zero, as for doses. A row at the time of another row that has
            a value counts as filled.
        time_unit: unit of times that are dates (ms, s, min, h, d, weeks, years). None: that of the time between rows.
        usual_unit: what None means instead, the unit of a model.
        observed: whether a file without any value of the outputs is an error; known inputs of the future have none.

    Returns:
        The observations; empty cells (and NA, NaN, a single point) are NaN. Dates (ISO 8601, with an offset from UTC in
        each row, or in none) become numbers since the midnight before the first of them, which is the `Data.origin`.

    Raises:
        ValueError: with file, row and column, for a file that is empty or not comma-separated
            text, a missing, ambiguous or repeated column, text in a number column, a time that is
            empty, not finite or goes back, and a file without any value.
        FileNotFoundError: if there is no such file.

    Warns:
        UserWarning: a number that looks like a code of missing values, such as -9999 or 1e30, lies far from all others
            of its column; empty cells of a known input.

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
    return _read(table.from_csv(path), outputs, time_column, inputs, time_unit, usual_unit, observed=observed)


def read_table(
    frame: Any,
    outputs: Sequence[str] | None = None,
    time_column: str | None = None,
    inputs: Sequence[str] | Mapping[str, str] = (),
    time_unit: str | None = None,
) -> Data:
    """Read observations and known inputs from a table in memory.

    Args:
        frame: a pandas DataFrame or Series (an index of dates, or one with a name, is a column), a polars DataFrame,
            an xarray Dataset or DataArray along time, or a mapping of column names to values.
        outputs: see `read_csv`; so are the others.
        time_column: its name.
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
    return _read(table.from_frame(frame), outputs, time_column, inputs, time_unit)


def as_data(data: Any) -> Data:
    """Return data as they are, or read from a table (`read_table`) whose every column is the time or an output.

    Raises:
        TypeError: neither.
    """
    if isinstance(data, Data):
        return data
    if table.is_table(data):
        return read_table(data)
    raise TypeError("without y the data must be lfm.Data, a DataFrame or an xarray Dataset, got "
                    f"{type(data).__name__}. Pass times and y.")


def read_series(path: str | Path, column: str, outputs: Sequence[str] | None = None, time_column: str | None = None,
                inputs: Sequence[str] | Mapping[str, str] = (), time_unit: str | None = None,
                usual_unit: str | None = None) -> dict[str, Data]:
    r"""Read several series from one comma-separated file, in which a column says which series a row belongs to.

    Args:
        path: the file, as for :func:`read_csv`.
        column: the column of identifiers, such as ``patient``; its cells are taken as text.
        outputs: as for :func:`read_csv`; None leaves out ``column``, too.
        time_column: as for :func:`read_csv`, and so are the others.
        inputs: columns of known inputs.
        time_unit: unit of times that are dates.
        usual_unit: what None means instead.

    Returns:
        Identifier -> observations, in the order in which the file has them. Rows of a series need not stand together,
        but their times must not go back.

    Raises:
        ValueError: as :func:`read_csv`, with the row; a row without an identifier; a series without any value.

    Example:
        >>> import pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "patients.csv"
        >>> _ = path.write_text("patient,time,dose\nA,0,1.5\nB,0,2.5\nA,1,1.0\n")
        >>> {name: one.y.ravel().tolist() for name, one in read_series(path, "patient").items()}
        {'A': [1.5, 1.0], 'B': [2.5]}
    """
    source = table.from_csv(path)
    if column not in source.columns:
        raise ValueError(f"{source.label}: {checks.unknown('column of series', column, source.columns)}")
    parts: dict[str, list[int]] = {}
    for row, name in enumerate(source.columns[column]):
        if not name:
            raise ValueError(f"{source.cell_location(row, column)}: the identifier of the series is missing.")
        parts.setdefault(name, []).append(row)
    return {name: _read(source.part(rows, without=column), outputs, time_column, inputs, time_unit,
                        usual_unit, f" of series {name!r}") for name, rows in parts.items()}


def write_csv(data: Data, path: str | Path) -> None:
    """Write observations so that :func:`read_csv` reads the same numbers back.

    Known inputs follow the outputs, with their values at the times of the rows.

    Args:
        data: the observations; a NaN becomes an empty cell.
        path: the file, which is replaced if it exists.
    """
    unit = data.units.get("time", "")
    time_name = f"time_{unit}" if unit in calendar_time.SECONDS else "time"
    values = [function(data.times) for function in data.known_inputs().values()]
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([time_name, *data.outputs, *data.inputs])
        for time, row in zip(data.times, np.column_stack([data.y, *values]), strict=True):
            cells = ["" if math.isnan(value) else repr(float(value)) for value in row]
            writer.writerow([repr(float(time)), *cells])


def _read(source: Table, outputs: Sequence[str] | None, time_column: str | None,
          inputs: Sequence[str] | Mapping[str, str], time_unit: str | None, usual_unit: str | None = None,
          part: str = "", observed: bool = True) -> Data:
    """Return the observations in a table; arguments as for `read_csv`, and what a part of a file is called."""
    if time_unit is not None:
        checks.one_of("time_unit", time_unit, calendar_time.SECONDS)
    if isinstance(inputs, str):
        raise TypeError(f"inputs must be a sequence of column names, such as [{inputs!r}], got the text {inputs!r}.")
    options = dict(inputs) if isinstance(inputs, Mapping) else dict.fromkeys(inputs, "previous")
    time_name = _find_time(source, time_column)
    columns = [name for name in source.columns if name != time_name]
    for name in options:
        if name not in columns:
            raise ValueError(f"{source.label}: {checks.unknown('input column', name, columns)} --inputs A,B "
                             "(inputs=) names the columns, in the order of the model's inputs.")
    names = _find_outputs(source, [name for name in columns if name not in options], time_name, outputs)
    if duplicates := sorted(set(names) & set(options)):
        raise ValueError(f"the column {duplicates[0]!r} is named as an output and as an input; it can be one of them.")
    free = [name for name in columns if name not in options and (outputs is None or name not in names)]
    times, unit, origin = _times(source, time_name, time_unit, usual_unit, () if part else free)
    y = np.array([[parse_number(source, row, name) for name in names] for row in range(len(times))])
    if observed and np.all(np.isnan(y)):
        raise ValueError(f"{source.label}: every value of {', '.join(names)}{part} is missing; expected at least one "
                         "number.")
    for name, column in zip(names, y.T, strict=True):
        warn_of_codes(source, name, column)
    return Data(times, y, tuple(names), units={"time": unit} if unit else {}, origin=origin,
                inputs={name: _input(source, name, way, times) for name, way in options.items()})


def _find_time(source: Table, time_column: str | None) -> str:
    header = list(source.columns)
    if time_column is not None:
        if time_column not in header:
            message = checks.unknown("time column", time_column, header, checks.ABBREVIATIONS)
            raise ValueError(f"{source.label}: {message}")
        return time_column
    for test in (
        lambda name: name.lower() == "time" or name == "t" or _unit_of(name),
        lambda name: name.lower() in _DATE_NAMES,
        lambda name: calendar_time.is_date(next((cell for cell in source.columns[name] if not is_missing(cell)), None)),
    ):
        candidates = [name for name in header if test(name)]
        if len(candidates) > 1:
            raise ValueError(f"{source.label} has several time columns: {', '.join(candidates)}. Name one with "
                             "--time-column (time_column=).")
        if candidates:
            return candidates[0]
    raise ValueError(f"{source.label} has no time column; expected `time`, `t`, `time_h`, or one of dates, got the "
                     f"columns {', '.join(header)}. Name it with --time-column (time_column=).")


def _find_outputs(source: Table, columns: Sequence[str], time_name: str, outputs: Sequence[str] | None) -> list[str]:
    if outputs is None:
        names = [name for name in columns if name and name.lower() != "replicate"]
        if not names:
            raise ValueError(f"{source.label} has no column beside the time {time_name!r}"
                             f"{' and the inputs' if len(source.columns) > len(columns) + 1 else ''}.")
        return names
    if isinstance(outputs, str):
        raise TypeError(f"outputs must be a sequence of column names, such as [{outputs!r}], got the text {outputs!r}.")
    if not len(outputs) or len(set(outputs)) < len(outputs):
        raise ValueError(f"outputs must name at least one column, and each of them once; got {list(outputs)}.")
    columns = [name for name in source.columns if name != time_name]
    for name in outputs:
        if name not in columns:
            raise ValueError(f"{source.label}: {checks.unknown('output column', name, columns)} Name the columns "
                             "with --outputs (outputs=); what was not measured is an empty column.")
    return list(outputs)


def _unit_of(time_name: str) -> str | None:
    """Return h for ``time_h``; None where the name carries no unit."""
    stem, _, unit = time_name.partition("_")
    return unit if stem.lower() == "time" and unit in calendar_time.SECONDS else None


def _times(source: Table, name: str, unit: str | None, usual: str | None,
           free: Sequence[str]) -> tuple[np.ndarray, str | None, str | None]:
    """Return times (T,), their unit and their origin, None where the table does not say.

    Args:
        source: the table.
        name: of the time column.
        unit: of times that are dates.
        usual: what None means instead.
        free: columns that may hold identifiers of series.
    """
    cells = source.columns[name]
    if missing := [row for row, cell in enumerate(cells) if is_missing(cell)]:
        raise ValueError(f"{source.cell_location(missing[0], name)}: the time is missing.")
    if not calendar_time.is_date(cells[0]):
        requirement = "expected a number, or a date, year first, such as 2026-03-31 in every row, got {}."
        times = np.array([parse_number(source, row, name, requirement) for row in range(len(cells))])
        _check_order(source, times, [f"{time:g}" for time in times], free)
        unit_in_name = _unit_of(name)
        if unit_in_name is not None and unit not in (None, unit_in_name):
            raise ValueError(f"{source.label}: the column {name!r} says that its unit is {unit_in_name}, and "
                             f"--time-unit (time_unit=) says {unit}.")
        return times, unit_in_name or unit, None
    stamps = []
    for row, cell in enumerate(cells):
        try:
            stamps.append(calendar_time.parse(cell))
        except ValueError:
            raise ValueError(f"{source.cell_location(row, name)}: expected a date, year first, such as 2026-03-31 or "
                             f"2026-03-31T18:00, got {cell!r}.") from None
        if (stamps[-1].tzinfo is None) != (stamps[0].tzinfo is None):
            raise ValueError(f"{source.cell_location(row, name)}: some dates have an offset from UTC and others have "
                             f"none: {cells[0]!s} and {cell!s}. Write it in all of them, or in none.")
    clock_hint = " A clock that is set back for winter needs offsets from UTC." if stamps[0].tzinfo is None else ""
    times, origin, unit = calendar_time.since_midnight(stamps, unit or _unit_of(name) or usual)
    _check_order(source, times, [str(cell) for cell in cells], free, clock_hint)
    return times, unit, origin


def _input(source: Table, name: str, interpolation: str, times: np.ndarray) -> InputTable:
    """Return the column of a known input without its empty cells.

    Raises:
        ValueError: it is empty, has no value at the first time, or two values at one time.
    """
    checks.one_of(f"interpolation of {name}", interpolation, INTERPOLATIONS)
    values = np.array([parse_number(source, row, name) for row in range(len(times))])
    finite_rows = np.flatnonzero(np.isfinite(values))
    if interpolation != "zero" and (not finite_rows.size or times[finite_rows[0]] > times[0]):
        raise ValueError(f"{source.cell_location(0, name)}: the known input has no value at the first time; fill the "
                         f"cell, or read empty cells as zero: {zero_option(name)}.")
    warn_of_codes(source, name, values)
    values = fill_blanks(f"{source.label}, column {name!r}", zero_option(name), times, values, interpolation)
    finite_rows = np.flatnonzero(np.isfinite(values))
    unique_times, first = np.unique(times[finite_rows], return_index=True)
    for row in map(int, finite_rows):
        previous_value = values[finite_rows[first[np.searchsorted(unique_times, times[row])]]]
        if values[row] != previous_value:
            raise ValueError(f"{source.cell_location(row, name)}: the known input is {values[row]:g} here and "
                             f"{previous_value:g} in another row of the same time.")
    return InputTable(unique_times, values[finite_rows[first]], stored_interpolation(interpolation))


def _check_order(source: Table, times: np.ndarray, time_texts: Sequence[str], free: Sequence[str],
                 more: str = "") -> None:
    """Raise ValueError where the time goes back, and name the column of series where there seems to be one.

    Args:
        source: the table.
        times: (T,).
        time_texts: (T,), the times as the user wrote them.
        free: columns that are neither the time nor named as outputs or inputs.
        more: further text of the message.
    """
    decreases = np.flatnonzero(np.diff(times) < 0)
    if not decreases.size:
        return
    k = int(decreases[0]) + 1
    location = f"{source.label}, row {source.rows[k]}: the time goes back from {time_texts[k - 1]} to {time_texts[k]}"
    if (column := _series_column(source, times, free)) is not None:
        cells = source.columns[column]
        raise ValueError(f"{location}, where the column {column!r} changes from {cells[k - 1]} to {cells[k]}. If it "
                         f"names several series, fit them separately: --series {column} (lfm.data.read_series(path, "
                         f"{column!r}), or lfm.read_table of each part of a DataFrame).")
    raise ValueError(f"{location}. Sort the rows by time; replicates are rows with the same time.{more}")


_SERIES_NAMES = ("id", "subject", "patient", "series", "individual", "animal", "unit", "group", "name")
"""Parts of the names of columns that often say which series a row belongs to."""


def _series_column(source: Table, times: np.ndarray, free: Sequence[str]) -> str | None:
    """Return the column that seems to hold identifiers of series, None where there is none.

    Its cells are filled, and the time does not go back among the rows that share a value. Unless its name is that of an
    identifier, these rows stand together, and a value has two of them or more on average.
    """
    fallback = None
    for name in free:
        cells = source.columns[name]
        # Replicates that stand one below the other are one series, to be sorted.
        if name.lower() == "replicate" or any(is_missing(cell) for cell in cells):
            continue
        labels, index = np.unique(np.array([str(cell) for cell in cells]), return_inverse=True)
        order = np.argsort(index, kind="stable")
        goes_back = (np.diff(times[order]) < 0) & (np.diff(index[order]) == 0)
        if len(labels) == 1 or goes_back.any():
            continue
        if any(part in _SERIES_NAMES for part in re.split(r"[^a-z]+", name.lower())):
            return name
        blocks = 1 + np.count_nonzero(np.diff(index))
        if fallback is None and blocks == len(labels) and 2 * len(labels) <= len(cells):
            fallback = name
    return fallback
