"""Observations as a user has them: a CSV file, a table of another library, or a simulated data set with its truth.

A table has a header, a time column, one column per output, and one per known input. Empty cells are missing values,
repeated times are replicates; times are numbers, or dates. Every complaint names the file, the row as an editor counts
it (the header is row 1), and the column.
"""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lfm_ppl.io import table
from lfm_ppl.io.table import Table
from lfm_ppl.utils import calendar_time, checks

if TYPE_CHECKING:
    from lfm_ppl.model.inputs import Input

MISSING = ("", ".", "na", "nan", "n/a", "null", "nat", "none")
INTERPOLATIONS = ("previous", "linear", "zero")
"""How known inputs are read; "zero" is "previous" with blank cells read as zero."""

_DATE_NAMES = ("date", "datetime", "timestamp")


class InputTable(NamedTuple):
    """A known input as it was measured.

    Attributes:
        times: (K,), increasing.
        values: (K,).
        interpolation: "previous" or "linear".
    """

    times: np.ndarray
    values: np.ndarray
    interpolation: str = "previous"


@dataclass(frozen=True)
class Data:
    """Observations y_k at times t_k of named outputs, and the truth where it is known.

    Attributes:
        times: t_k, shape (T,), non-decreasing; equal times are replicates.
        y: observations, shape (T, D); NaN is a missing value.
        outputs: the names of the D outputs.
        units: name -> unit, for ``time``, outputs, states, forces and known inputs; incomplete is fine.
        truth: for simulated data, a mapping with any of ``times`` (K,), ``forces`` (name -> (K,)),
            ``deterministics`` (name -> (K,)), ``state`` (K, M) and ``parameters`` (name -> array).
        note: what was done to the numbers, to be printed with the results.
        inputs: known inputs: name -> (times, values) or (times, values, "linear"), or an `lfm.Input`; kept as
            `InputTable`. `known_inputs` gives them as functions of time. Missing values are left out, or with "zero"
            read as zero.
        origin: the calendar time of t = 0 as ISO 8601 text, where the times were dates.

    Times may be dates (``datetime64``, a DatetimeIndex, ...), also those of inputs. They become numbers since the
    origin, by default the midnight before the first of them, in the unit of ``units["time"]``, by default that of the
    time between rows.

    Raises:
        ValueError: if the shapes do not fit together or the times go back.

    Example:
        >>> data = Data(times=[0.0, 1.0], y=[[1.0], [float("nan")]], outputs=("x",))
        >>> data.y.shape
        (2, 1)
    """

    times: np.ndarray
    y: np.ndarray
    outputs: tuple[str, ...]
    units: Mapping[str, str] = field(default_factory=dict)
    truth: Mapping[str, Any] | None = None
    note: str = ""
    inputs: Mapping[str, Any] = field(default_factory=dict)
    origin: str | None = None

    def __post_init__(self) -> None:
        """Convert to arrays and check that the shapes fit together."""
        if calendar_time.holds_dates(self.times):
            self._read_dates()
        checks.refuse_durations("times", self.times)
        object.__setattr__(self, "times", np.asarray(checks.unmask(self.times), dtype=float))
        object.__setattr__(self, "y", np.asarray(checks.unmask(self.y), dtype=float))
        object.__setattr__(self, "outputs", tuple(self.outputs))
        object.__setattr__(self, "inputs", {name: self._table_of(name, table) for name, table in self.inputs.items()})
        expected = (len(self.times), len(self.outputs))
        if self.times.ndim != 1 or self.y.shape != expected:
            raise ValueError(
                f"y must have shape (times, outputs) = {expected}, got {self.y.shape} for times "
                f"of shape {self.times.shape} and outputs {self.outputs}."
            )
        checks.finite("times", self.times)
        if np.any(np.diff(self.times) < 0):
            index = int(np.argmax(np.diff(self.times) < 0)) + 1
            raise ValueError(
                f"times must not go back, got {self.times[index]:g} after "
                f"{self.times[index - 1]:g} at index {index}. Sort the observations by time."
            )

    def _read_dates(self) -> None:
        """Convert times that are dates, and note their origin and unit."""
        unit = self.units.get("time")
        if unit is not None:
            checks.one_of('units["time"]', unit, calendar_time.SECONDS)
        times, origin, unit = calendar_time.numbers_of("times", self.times, unit)
        if self.origin is not None:
            times, origin = calendar_time.positions("times", self.times, self.origin, unit), self.origin
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "origin", origin)
        object.__setattr__(self, "units", {**self.units, "time": unit})

    def _table_of(self, name: str, value: Any) -> InputTable:
        """Return a known input as it is kept.

        Raises:
            TypeError: neither a tuple of times and values nor an `lfm.Input`.
        """
        if all(hasattr(value, part) for part in InputTable._fields):  # an Input
            value = tuple(getattr(value, part) for part in InputTable._fields)
        if not (isinstance(value, tuple) and 2 <= len(value) <= 3):
            raise TypeError(f"the known input {name!r} must be (times, values), (times, values, interpolation) or an "
                            f"lfm.Input, got {type(value).__name__}.")
        times, values, *way = value
        label = f"times of the known input {name!r}"
        checks.refuse_durations(label, times)
        times = calendar_time.positions(label, times, self.origin, self.units.get("time", ""))
        times, values = (np.asarray(checks.unmask(part), float) for part in (times, values))
        interpolation = way[0] if way else "previous"
        if times.shape == values.shape and times.ndim == 1 and np.isnan(values).any():
            if interpolation != "zero" and np.isnan(values).all():
                raise ValueError(f"every value of the known input {name!r} is missing; expected at least one number.")
            values = _read_blanks(f"the known input {name!r}", f"{name!r}: (times, values, 'zero')", times, values,
                                  interpolation)
            times, values = times[~np.isnan(values)], values[~np.isnan(values)]
        return InputTable(times, values, _kept_interpolation(interpolation))

    def known_inputs(self) -> dict[str, Input]:
        """Return the known inputs as functions of time, for the ``inputs`` argument of a model."""
        return as_inputs(self.inputs)


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


def as_inputs(tables: Mapping[str, InputTable]) -> dict[str, Input]:
    """Return known inputs as functions of time."""
    # Here and not before: arrays made before float64 is enabled stay in float32.
    from lfm_ppl.model.inputs import Input

    return {name: Input(*table, name=name) for name, table in tables.items()}


def model_keywords(tables: Mapping[str, InputTable], model_kwargs: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the keyword arguments of a model: those given, and ``inputs`` where there are known inputs."""
    return {**({"inputs": as_inputs(tables)} if tables else {}), **(model_kwargs or {})}


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


def on_clock_of(data: Data, reference: Data) -> Data:
    """Return data with their times counted from the origin of other data, in their unit.

    Raises:
        ValueError: the times of one are dates and of the other plain numbers, or only one has an offset from UTC.
    """
    if data.origin is None and reference.origin is None:
        return data
    if data.origin is None or reference.origin is None:
        dated, plain = ("first", "others") if data.origin else ("others", "first")
        raise ValueError(f"the times of two tables cannot be compared: those of the {dated} are dates, those of the "
                         f"{plain} plain numbers.")
    return at_origin(data, reference.origin, reference.units["time"])


def at_origin(data: Data, origin: str, unit: str) -> Data:
    """Return data, whose times were dates, with their times counted from another origin, in another unit.

    Raises:
        ValueError: only one of the origins has an offset from UTC.
    """
    assert data.origin is not None
    ratio = calendar_time.SECONDS[data.units["time"]] / calendar_time.SECONDS[unit]
    shift = calendar_time.position(data.origin, origin, unit)
    truth = data.truth
    if truth is not None and truth.get("times") is not None:
        truth = {**truth, "times": np.asarray(truth["times"], float) * ratio + shift}
    return replace(data, times=data.times * ratio + shift, truth=truth, origin=origin,
                   units={**data.units, "time": unit},
                   inputs={name: table._replace(times=table.times * ratio + shift)
                           for name, table in data.inputs.items()})


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


def write_truth(data: Data, path: str | Path) -> None:
    """Write the truth of a simulated data set as JSON, for :func:`read_truth`."""
    if data.truth is None:
        raise ValueError("this data set has no truth to write; only simulated data has one.")
    text = json.dumps(data.truth, default=lambda array: np.asarray(array).tolist(), indent=1)
    Path(path).write_text(text + "\n", encoding="utf-8")


def read_truth(path: str | Path) -> dict[str, Any]:
    """Read the truth in the form of :attr:`Data.truth`, as :func:`write_truth` writes it.

    Raises:
        ValueError: the file is not JSON, or holds something else, see :func:`check_truth`.
    """
    try:
        raw = json.loads(Path(path).read_text(encoding="utf-8"))
        if not isinstance(raw, dict):
            raise ValueError(f"it holds a {type(raw).__name__}, not a mapping of names to values")
    except ValueError as error:  # of JSON or of UTF-8
        reason = str(error).rstrip(".")
        raise ValueError(f"{path} is not a truth file, JSON such as `lfm-ppl simulate` writes: {reason}.") from None
    try:
        check_truth(raw)
    except ValueError as error:
        raise ValueError(f"{path} is not a truth file: {error}") from None
    return {key: {k: np.array(v, float) for k, v in value.items()} if isinstance(value, dict) else
            np.array(value, float) for key, value in raw.items() if value is not None}


_TRUE_PATHS = ("forces", "deterministics")
TRUTH = ("times", *_TRUE_PATHS, "state", "parameters")
"""What may be known of the truth."""


def check_truth(truth: Mapping[str, Any]) -> None:
    """Raise ValueError where a truth, in the form of :attr:`Data.truth`, does not fit together.

    Its names are those of a model, which is not asked here.
    """
    for name in truth:
        checks.one_of("entry", name, TRUTH)
    entries = {name: value for name, value in truth.items() if value is not None}
    for kind in (*_TRUE_PATHS, "parameters"):
        if not isinstance(entries.get(kind, {}), Mapping):
            raise ValueError(f'"{kind}" must be a mapping of names to values, got a {type(entries[kind]).__name__}.')
    paths = {f'"{name}" of "{kind}"': value for kind in _TRUE_PATHS for name, value in entries.get(kind, {}).items()}
    paths |= {'"state"': entries["state"]} if "state" in entries else {}
    if paths and "times" not in entries:
        raise ValueError(f'{next(iter(paths))} needs "times", at which it was.')
    times = _numbers('"times"', entries.get("times", []))
    if times.ndim != 1 or not np.all(np.isfinite(times)):
        raise ValueError(f'"times" must be finite numbers, one after the other, got shape {times.shape}.')
    for name, value in paths.items():
        size, state = _numbers(name, value).shape, name == '"state"'
        if size[:1] != times.shape or len(size) != 1 + state:
            raise ValueError(f'{name} must hold {len(times)} {"rows of states" if state else "values"}, one for each '
                             f'of "times", got shape {size}.')
    for name, value in entries.get("parameters", {}).items():
        _numbers(f'"{name}" of "parameters"', value)


def _numbers(name: str, value: Any) -> np.ndarray:
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be numbers, in rows of one length.") from None


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
    y = np.array([[_value(source, row, name) for name in names] for row in range(len(times))])
    if observed and np.all(np.isnan(y)):
        raise ValueError(f"{source.label}: every value of {', '.join(names)}{part} is missing; expected at least one "
                         "number.")
    for name, column in zip(names, y.T, strict=True):
        _warn_of_codes(source, name, column)
    return Data(times, y, tuple(names), units={"time": unit} if unit else {}, origin=origin,
                inputs={name: _input(source, name, way, times) for name, way in options.items()})


_INTEGER_LIMITS = tuple(float(sign * (2**bits - shift)) for bits in (15, 16, 31, 32, 63) for sign in (1, -1)
                        for shift in (0, 1))
"""Smallest and largest whole numbers of computers, and their neighbours."""

_FAR_RANGES = 5.0
"""Ranges of the other values from which on a code is far from them, however they are spread."""

_FAR_GAPS = 5.0
"""Largest gaps within the other values from which on a code that lies a range away, too, is far from them."""


def _looks_like_code(value: float) -> bool:
    """Whether a number is of the kind that stands for a missing value: -9, 99, -999.9, -999.25, 7777, 1e30, -32768."""
    if abs(value) >= 1e30 or value in _INTEGER_LIMITS:
        return True
    for digits in (7, 15):  # those of single and of double precision
        mantissa, _, exponent = f"{abs(value):.{digits}g}".partition("e")
        if exponent and int(exponent) < 0:
            return False
        if mantissa == "1" and int(exponent or 0) >= 10:
            return True
        integer_part, _, decimals = mantissa.partition(".")
        figures = set(integer_part + decimals)
        # 9 and 9.9 are too usual as measurements; -9 and 9.99 are codes of fixed-width formats.
        if figures == {"9"} and (value < 0 or len(integer_part) > 1 or len(decimals) > 1):
            return True
        if figures in ({"7"}, {"8"}) and len(integer_part) > (1 if value < 0 else 2):
            return True
        if integer_part in ("999", "9999", "99999") and decimals == "25":  # of well logs
            return True
    return False


def _codes(column: np.ndarray) -> list[float]:
    """Return the codes of missing values in a column (T,): numbers that look like one and lie far from all others.

    Several codes may stand in one column. A number that looks like a code and lies near the others is one of them.
    """
    values = np.unique(column[np.isfinite(column)])
    first, last = 0, len(values)
    while first < last and _looks_like_code(values[first]):
        first += 1
    while first < last and _looks_like_code(values[last - 1]):
        last -= 1
    is_candidate = np.ones(len(values), bool)
    is_candidate[first:last] = False
    with np.errstate(over="ignore"):  # differences of the largest numbers
        while is_candidate.any() and not is_candidate.all():
            other_values = values[~is_candidate]
            reach, gap = np.ptp(other_values), np.diff(other_values).max(initial=0.0)
            distance = np.maximum(other_values[0] - values, values - other_values[-1])
            is_far = (distance > _FAR_RANGES * reach) | ((distance > reach) & (distance > _FAR_GAPS * gap))
            # -999 among flows of 0 to 5,000 is less than their range away from them, but negative.
            is_far |= (values <= -99) & (other_values[0] >= 0) & (distance > gap)
            if not (is_candidate & ~is_far).any():
                return values[is_candidate].tolist()
            is_candidate &= is_far
    return []


def _warn_of_codes(source: Table, name: str, column: np.ndarray) -> None:
    """Warn of numbers in a column (T,) that seem to stand for missing values."""
    for code in _codes(column):
        if np.isfinite(column).sum() - np.sum(column == code) < 2:
            continue
        location, count = source.cell_location(int(np.argmax(column == code)), name), int((column == code).sum())
        checks.warn(f"{location}: {code:g}, far from all other values of the column, is taken as a measurement "
                    f"({count} of them). If it stands for a missing value, leave the cell empty.")


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
        lambda name: calendar_time.is_date(next((cell for cell in source.columns[name] if not _missing(cell)), None)),
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
    if missing := [row for row, cell in enumerate(cells) if _missing(cell)]:
        raise ValueError(f"{source.cell_location(missing[0], name)}: the time is missing.")
    if not calendar_time.is_date(cells[0]):
        requirement = "expected a number, or a date, year first, such as 2026-03-31 in every row, got {}."
        times = np.array([_value(source, row, name, requirement) for row in range(len(cells))])
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
    values = np.array([_value(source, row, name) for row in range(len(times))])
    finite_rows = np.flatnonzero(np.isfinite(values))
    if interpolation != "zero" and (not finite_rows.size or times[finite_rows[0]] > times[0]):
        raise ValueError(f"{source.cell_location(0, name)}: the known input has no value at the first time; fill the "
                         f"cell, or read empty cells as zero: {_zero_option(name)}.")
    _warn_of_codes(source, name, values)
    values = _read_blanks(f"{source.label}, column {name!r}", _zero_option(name), times, values, interpolation)
    finite_rows = np.flatnonzero(np.isfinite(values))
    unique_times, first = np.unique(times[finite_rows], return_index=True)
    for row in map(int, finite_rows):
        previous_value = values[finite_rows[first[np.searchsorted(unique_times, times[row])]]]
        if values[row] != previous_value:
            raise ValueError(f"{source.cell_location(row, name)}: the known input is {values[row]:g} here and "
                             f"{previous_value:g} in another row of the same time.")
    return InputTable(unique_times, values[finite_rows[first]], _kept_interpolation(interpolation))


def _zero_option(name: str) -> str:
    """Return how to say that empty cells of a column are zero."""
    return f"--inputs {name}:zero (inputs={{{name!r}: 'zero'}})"


def _kept_interpolation(interpolation: str) -> str:
    """Return how a known input is interpolated once its empty cells have been read."""
    return "previous" if interpolation == "zero" else interpolation


def _read_blanks(label: str, option: str, times: np.ndarray, values: np.ndarray, interpolation: str) -> np.ndarray:
    """Return the values (K,) of a known input, with zeros for blank ones where that is how they are read.

    Args:
        label: of the input, for messages.
        option: how to say that blank values are zero.
        times: (K,).
        values: (K,), NaN where blank. A blank value at the time of another row that has one says nothing.
        interpolation: one of `INTERPOLATIONS`.

    Warns:
        UserWarning: of blank values over which the input is interpolated.
    """
    is_blank = np.isnan(values) & ~np.isin(times, times[np.isfinite(values)])
    if interpolation == "zero":
        return np.where(is_blank, 0.0, values)
    if is_blank.any():
        reading = "a line joins the values beside them" if interpolation == "linear" else "the last value holds there"
        checks.warn(f"{label}: {int(is_blank.sum())} of {len(values)} values of the known input are blank, and "
                    f"{reading}. If blank means zero, as for a dose, say so: {option}.")
    return values


def _missing(cell: Any) -> bool:
    if cell is None or isinstance(cell, str):
        return cell is None or cell.strip().lower() in MISSING
    return bool(cell != cell)  # NaN, and pandas' NaT


_WANTED = ("expected a number or an empty cell, got {}. If the model does not take this column, name those it takes: "
           "outputs and inputs.")


def _value(source: Table, row: int, name: str, requirement: str = _WANTED) -> float:
    """Return the number in a cell; ``wanted`` is what to say, with the place of the cell, of one that holds none."""
    cell = source.columns[name][row]
    try:
        if _missing(cell):
            return math.nan
        if isinstance(cell, np.timedelta64):
            raise TypeError("a duration has no unit as a number")
        value = float(cell)
    except (TypeError, ValueError):  # a TypeError is pandas' NA, or a cell that is no scalar
        if type(cell).__name__ == "NAType":
            return math.nan
        location = source.cell_location(row, name)
        raise ValueError(f"{location}: {requirement.format(_quote_cell(cell))}{_meant(cell)}") from None
    if not math.isfinite(value):
        raise ValueError(f"{source.cell_location(row, name)}: expected a finite number, got {_quote_cell(cell)}. "
                         "Leave the cell of a missing value empty.")
    return value


def _meant(cell: Any) -> str:
    """Return what to write in place of a number that is written otherwise."""
    text = str(cell).strip()
    if re.fullmatch(r"[+-]?\d+,\d+", text):
        return f" A decimal point is a point, {text.replace(',', '.')}; thousands are not marked."
    if re.fullmatch(r"[<>]=?\s*[\d.]+", text):
        return (" A value beyond a limit is written as the limit, a number; lfm.CensoredObservation(left=, right=) "
                "knows what it means.")
    return ""


def _quote_cell(cell: Any) -> str:
    """Return a cell as messages show it."""
    text = repr(cell)
    return text if len(text) <= 60 else f"{text[:50]}... ({len(text)} characters)"


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
                         f"names several series, fit each by itself: --series {column} (lfm.data.read_series(path, "
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
        if name.lower() == "replicate" or any(_missing(cell) for cell in cells):
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
