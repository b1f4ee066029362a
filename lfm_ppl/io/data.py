"""Observations and known inputs of a CSV file, of a table of another library, or of the series of one file."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lfm_ppl.io import dosing, time_columns
from lfm_ppl.io import table as tables
from lfm_ppl.io.data_set import Data
from lfm_ppl.io.data_set import stack_series as stack_series
from lfm_ppl.io.input_table import DOSE, INTERPOLATIONS, InputTable, fill_blanks
from lfm_ppl.io.missing_codes import warn_of_codes
from lfm_ppl.io.series_columns import IDENTIFIERS, check_order
from lfm_ppl.io.table import Table, words_of
from lfm_ppl.utils import calendar_time, checks

_ROW_NAMES = re.compile(r"|Unnamed: \d+(\.\d+)*|row\W?names|replicate", re.IGNORECASE)
"""Names of columns that pandas, R and spreadsheets give to numbers of rows, and of replicates: no outputs."""


def read_csv(path: str | Path, outputs: Sequence[str] | None = None, time_column: str | None = None,
             inputs: Sequence[str] | Mapping[str, str] = (), time_unit: str | None = None, *,
             usual_unit: str | None = None, default_unit: str | None = None, observed: bool = True) -> Data:
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
            number (see `lfm_ppl.Dose`), "dose:STATE,STATE" to the states that CMT numbers, "dose:STATE:once" one dose
            that the column repeats. With doses, columns named EVID, MDV, ADDL, II, CMT, RATE, DUR and SS, in any case,
            have the meaning of `lfm_ppl.io.dosing`; "CMT" and so on give a column of another name this meaning. A row
            at the time of another row that has a value counts as filled.
        time_unit: unit of the times (ms, s, min, h, d, weeks, years). Dates are counted in it, by default in that of
            the time between rows. Numbers are in it; whole numbers that are all dates YYYYMMDD, YYYYMMDDHH or
            YYYYMMDDHHMM are read as dates if it is given, or if the name of the column is that of a date.
        usual_unit: the unit of dates where ``time_unit`` and the name of the time column say none, that of a model.
        default_unit: ``time_unit`` where the name of the time column says none, that of an earlier file.
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
    table = tables.read_file(path)
    if time_unit is None and time_columns.unit_of(time_columns.find_time_column(table, time_column)) is None:
        time_unit = default_unit
    return _read(table, outputs, time_column, inputs, time_unit, usual_unit, observed=observed)


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
    r"""Read the series of several subjects, devices or places from one comma-separated file.

    Args:
        path: the file, as in `read_csv`.
        column: the column whose text identifies the series of a row, as in ``patient``. Rows of a series need not
            stand together, but their times must not go back.
        outputs: as in `read_csv`; None: also without ``column``.
        time_column: as in `read_csv`.
        inputs: as in `read_csv`; each series has its own rows of them.
        time_unit: unit of the times, as in `read_csv`.
        usual_unit: as in `read_csv`.

    Returns:
        Identifier -> observations, in the order of the file. Dates of each series are counted from the midnight before
        its own first date. `lfm_ppl.stack_series` makes a panel of them, `lfm_ppl.fit_many` fits each alone.

    Raises:
        ValueError: there is no such column, or a row without an identifier; and as `read_csv`, with the name of the
            series.

    Warns:
        UserWarning: as `read_csv`.

    Example:
        >>> import pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "patients.csv"
        >>> _ = path.write_text("patient,time_h,blood\nAnn,0,9.1\nBo,0,7.9\nAnn,2,5.0\nBo,3,\n")
        >>> series = read_series(path, "patient")
        >>> list(series), series["Ann"].y.ravel().tolist(), series["Bo"].times.tolist(), series["Bo"].units
        (['Ann', 'Bo'], [9.1, 5.0], [0.0, 3.0], {'time': 'h'})
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
    has_other_states = table.compartments is not None and table.compartments.any()
    if (has_other_states or table.durations is not None or table.resets is not None
            or len(np.unique(table.times)) < len(table.times)):
        raise ValueError(f"the doses {name!r} have several states, infusions, resets or two doses at one time, which "
                         "one column of amounts does not hold; keep the file that they come from.")
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
    has_doses = any(way.startswith(DOSE) for way in interpolations.values())
    events = dosing.event_columns(table, interpolations, outputs or ()) if has_doses or outputs else {}
    interpolations = {name: way for name, way in interpolations.items() if way.upper() not in dosing.ROLES}
    time_name = time_columns.find_time_column(table, time_column)
    columns = [name for name in table.frame if name != time_name]
    # A column whose role another column is given is none of the outputs, either.
    event_names = {name for name in columns if name in events.values() or name.upper() in events} - set(outputs or ())
    names = list(outputs) if outputs is not None else [
        name for name in columns if name not in interpolations and not _ROW_NAMES.fullmatch(name)
        and name not in event_names and not (has_doses and words_of(name) & IDENTIFIERS)]
    for kind, requested in (("output", names), ("input", interpolations)):
        for name in requested:
            if name not in columns:
                unknown = checks.unknown(f"{kind} column", name, columns)
                remedy = f"Name the columns with --{kind}s ({kind}s=)."
                if kind == "input" and interpolations[name].startswith(DOSE):
                    way = interpolations[name]
                    remedy = (f"Name the column of the doses: --events COLUMN:{way.removeprefix(DOSE)} "
                              f"(inputs={{'COLUMN': {way!r}}}).")
                raise ValueError(f"{table.label}: {unknown} {remedy}")
    if not names or len({*names, *interpolations}) < len(names) + len(interpolations):
        raise ValueError(f"{table.label}: expected at least one output column beside the time {time_name!r}, and each "
                         f"column once, as an output or an input; got the outputs {names} and the inputs "
                         f"{list(interpolations)}.")
    used = {*interpolations, *event_names, *(names if outputs is not None or len(names) == 1 else ())}
    free = [] if part else [name for name in columns if name not in used]
    time_columns.check_clock(table, time_name, {*interpolations, *event_names, *(outputs or ())})
    times, unit, origin = time_columns.read_times(table, time_name, time_unit, usual_unit)
    is_dosed = dosing.has_amount(table, interpolations)
    is_unobserved = dosing.is_unobserved(table, events, is_dosed)
    is_blank = np.all([[tables.is_missing(cell) for cell in table.frame[name]] for name in names], axis=0)
    check_order(table, time_name, times, free, outputs is not None, ~(is_unobserved | is_blank & is_dosed))
    y = np.column_stack([table.numbers(name) for name in names])
    y[is_unobserved] = np.nan
    if observed and np.isnan(y).all():
        raise ValueError(f"{table.label}: every value of {', '.join(names)}{part} is missing; expected a number.")
    for name, column in zip(names, y.T, strict=True):
        warn_of_codes(table, name, column)
    if has_doses or outputs:
        dosing.check_outputs(table, events, names, y, is_dosed, {*interpolations, *names})
    if has_doses and origin is not None and not (time_unit or usual_unit or time_columns.unit_of(time_name)):
        dosing.check_unit(table, events, time_name)
    if not has_doses:
        dosing.warn_of_unread_doses(table, events)
    doses = {name: way for name, way in interpolations.items() if way.startswith(DOSE)}
    dose_tables = dosing.read_doses(table, doses, times, events, part) if doses else {}
    return Data(times, y, tuple(names), units={"time": unit} if unit else {}, origin=origin, inputs={
        name: dose_tables[name] if name in doses else _input(table, name, interpolation, times)
        for name, interpolation in interpolations.items()})


def _input(table: Table, name: str, interpolation: str, times: np.ndarray) -> InputTable:
    """Return the column of a known input without its empty cells."""
    checks.one_of(f"interpolation of {name}", interpolation, INTERPOLATIONS)
    values = table.numbers(name)
    remedy = f"--inputs {name}:zero (inputs={{{name!r}: 'zero'}})"
    if interpolation != "zero" and np.isnan(values[times == times[0]]).all():
        raise ValueError(f"{table.location(0, name)}: the known input has no value at the first time; fill the cell, "
                         f"or read empty cells as zero: {remedy}.")
    warn_of_codes(table, name, values)
    values = fill_blanks(f"{table.label}, column {name!r}", remedy, times, values, interpolation)
    rows = np.flatnonzero(np.isfinite(values))
    unique_times, first, inverse = np.unique(times[rows], return_index=True, return_inverse=True)
    first_values = values[rows[first]]
    if (other_rows := rows[values[rows] != first_values[inverse]]).size:
        raise ValueError(f"{table.location(other_rows[0], name)}: the known input has another value at the same time.")
    return InputTable(unique_times, first_values, "previous" if interpolation == "zero" else interpolation)
