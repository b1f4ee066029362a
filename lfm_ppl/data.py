"""Observations as a user has them: a CSV file, or a simulated data set with its truth.

A file has a header, a time column, and one column per output. Empty cells are missing values,
repeated times are replicates. Every complaint names the file, the row as an editor counts it (the
header is row 1), and the column.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lfm_ppl import checks

TIME_UNITS = ("ms", "s", "min", "h", "hr", "hours", "d", "days", "weeks", "yr", "years")
MISSING = ("", "na", "nan", "n/a", "null")


@dataclass(frozen=True)
class Data:
    """Observations y_k at times t_k of named outputs, and the truth where it is known.

    Attributes:
        times: t_k, shape (T,), non-decreasing; equal times are replicates.
        y: observations, shape (T, D); NaN is a missing value.
        outputs: the names of the D outputs.
        units: name -> unit, for ``time``, outputs, states and forces; incomplete is fine.
        truth: for simulated data, a mapping with any of ``times`` (K,), ``forces`` (name -> (K,)),
            ``state`` (K, M) and ``parameters`` (name -> array).
        note: what was done to the numbers, to be printed with the results.

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

    def __post_init__(self) -> None:
        """Convert to arrays and check that the shapes fit together."""
        object.__setattr__(self, "times", np.asarray(self.times, dtype=float))
        object.__setattr__(self, "y", np.asarray(self.y, dtype=float))
        object.__setattr__(self, "outputs", tuple(self.outputs))
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


def read_csv(
    path: str | Path, outputs: Sequence[str] | None = None, time_column: str | None = None
) -> Data:
    r"""Read observations from a comma-separated file.

    Args:
        path: the file. Lines that start with ``#`` and blank lines are skipped.
        outputs: the columns to read, in this order. None: every column but the time and
            ``replicate``.
        time_column: the name of the time column. None: ``time``, ``t`` or ``time_UNIT``, as in
            ``time_h``, which also sets the unit of time.

    Returns:
        The observations; empty cells (and NA, NaN) are NaN.

    Raises:
        ValueError: with file, row and column, for a file that is empty or not comma-separated
            text, a missing, ambiguous or repeated column, text in a number column, a time that is
            empty, not finite or goes back, and a file without any value.
        FileNotFoundError: if there is no such file.

    Example:
        >>> import pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "expression.csv"
        >>> _ = path.write_text("time_h,replicate,a,b\n0,1,0.5,\n0,2,0.6,1.5\n2,1,0.9,1.9\n")
        >>> data = read_csv(path)
        >>> data.outputs, data.units, data.times.tolist()
        (('a', 'b'), {'time': 'h'}, [0.0, 0.0, 2.0])
    """
    path = Path(path)
    return _data_of(path, *_read_table(path), outputs, time_column)


def _data_of(path: Path, header: list[str], rows: list[tuple[int, list[str]]], outputs: Sequence[str] | None,
             time_column: str | None, where: str = "") -> Data:
    """Return the observations in rows of a file."""
    time_name = _find_time(path, header, time_column)
    names = _find_outputs(path, header, time_name, outputs)
    columns = {name: header.index(name) for name in (time_name, *names)}
    times = np.array([_time(path, line, time_name, row[columns[time_name]]) for line, row in rows])
    _check_order(path, [line for line, _ in rows], times)
    y = np.array(
        [[_value(path, line, name, row[columns[name]]) for name in names] for line, row in rows]
    )
    if np.all(np.isnan(y)):
        raise ValueError(f"{path}: every value of {', '.join(names)}{where} is missing.")
    unit = _unit_of(time_name)
    return Data(times, y, tuple(names), units={"time": unit} if unit else {})


def read_series(path: str | Path, column: str, outputs: Sequence[str] | None = None,
                time_column: str | None = None) -> dict[str, Data]:
    r"""Read several series from one comma-separated file, in which a column says which series a row belongs to.

    Args:
        path: the file, as for :func:`read_csv`.
        column: the column of identifiers, such as ``patient``; its cells are taken as text.
        outputs: as for :func:`read_csv`; None leaves out ``column``, too.
        time_column: as for :func:`read_csv`.

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
    path = Path(path)
    header, rows = _read_table(path)
    if column not in header:
        raise ValueError(f"{path}: {checks.unknown('column of series', column, header)}")
    place = header.index(column)
    parts: dict[str, list[tuple[int, list[str]]]] = {}
    for line, row in rows:
        if not row[place]:
            raise ValueError(f"{path}, row {line}, column {column!r}: the identifier of the series is missing.")
        parts.setdefault(row[place], []).append((line, row[:place] + row[place + 1:]))
    names = header[:place] + header[place + 1:]
    return {name: _data_of(path, names, own, outputs, time_column, f" of series {name!r}")
            for name, own in parts.items()}


def write_csv(data: Data, path: str | Path) -> None:
    """Write observations so that :func:`read_csv` reads the same numbers back.

    Args:
        data: the observations; a NaN becomes an empty cell.
        path: the file, which is replaced if it exists.
    """
    unit = data.units.get("time", "")
    time_name = f"time_{unit}" if unit in TIME_UNITS else "time"
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([time_name, *data.outputs])
        for time, row in zip(data.times, data.y, strict=True):
            cells = ["" if math.isnan(value) else repr(float(value)) for value in row]
            writer.writerow([repr(float(time)), *cells])


def write_truth(data: Data, path: str | Path) -> None:
    """Write the truth of a simulated data set as JSON, for :func:`read_truth`."""
    if data.truth is None:
        raise ValueError("this data set has no truth to write; only simulated data has one.")
    text = json.dumps(data.truth, default=lambda array: np.asarray(array).tolist(), indent=1)
    Path(path).write_text(text + "\n", encoding="utf-8")


def read_truth(path: str | Path) -> dict[str, Any]:
    """Read what :func:`write_truth` wrote: the truth in the form of :attr:`Data.truth`."""
    try:
        raw = json.loads(Path(path).read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not a truth file written by `simulate`: {error}") from None
    truth: dict[str, Any] = {}
    for key, value in raw.items():
        nested = isinstance(value, dict)
        truth[key] = {k: np.array(v) for k, v in value.items()} if nested else np.array(value)
    return truth


def _read_table(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the header and the numbered rows, all of the header's length."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, strict=True)
            lines = [
                (reader.line_num, [cell.strip() for cell in row])
                for row in reader
                if any(cell.strip() for cell in row) and not row[0].lstrip().startswith("#")
            ]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is not a comma-separated text file (UTF-8): {error}.") from None
    except IsADirectoryError:
        raise ValueError(f"{path} is a folder, not a CSV file.") from None
    if not lines:
        raise ValueError(f"{path} is empty; expected a header row and one row per time.")
    first, header = lines[0]
    _check_header(path, first, header)
    if len(lines) == 1:
        raise ValueError(f"{path} has a header and no rows; expected one row per time.")
    for line, row in lines[1:]:
        if len(row) != len(header):
            raise ValueError(
                f"{path}, row {line}: {len(row)} cells, but the header has {len(header)} columns. "
                "Leave a missing value empty, and write decimals with a point."
            )
    return header, lines[1:]


def _check_header(path: Path, line: int, header: list[str]) -> None:
    for separator, name in ((";", "semicolons"), ("\t", "tabs")):
        if len(header) == 1 and separator in header[0]:
            raise ValueError(
                f"{path} is separated by {name}; expected commas between columns and a point in "
                "decimals. Export it as comma-separated CSV."
            )
    repeated = sorted({name for name in header if header.count(name) > 1})
    if repeated:
        where = [i + 1 for i, name in enumerate(header) if name == repeated[0]]
        raise ValueError(
            f"{path}, row {line}: the column name {repeated[0]!r} stands {len(where)} times "
            f"(columns {', '.join(map(str, where))}). Give each column its own name."
        )


def _find_time(path: Path, header: list[str], time_column: str | None) -> str:
    if time_column is not None:
        if time_column not in header:
            raise ValueError(f"{path}: {checks.unknown('time column', time_column, header)}")
        return time_column
    found = [name for name in header if name.lower() == "time" or name == "t" or _unit_of(name)]
    if not found:
        raise ValueError(
            f"{path} has no time column; expected `time`, `t` or `time_h`, got the columns "
            f"{', '.join(header)}. Name it with --time-column (time_column=)."
        )
    if len(found) > 1:
        raise ValueError(
            f"{path} has several time columns: {', '.join(found)}. Name one with --time-column "
            "(time_column=)."
        )
    return found[0]


def _find_outputs(
    path: Path, header: list[str], time_name: str, outputs: Sequence[str] | None
) -> list[str]:
    others = [name for name in header if name != time_name]
    if outputs is None:
        names = [name for name in others if name and name.lower() != "replicate"]
        if not names:
            raise ValueError(f"{path} has no column beside the time {time_name!r}.")
        return names
    if isinstance(outputs, str):
        raise TypeError(f"outputs must be a sequence of column names, such as [{outputs!r}], got the text {outputs!r}.")
    if not len(outputs) or len(set(outputs)) < len(outputs):
        raise ValueError(f"outputs must name at least one column, and each of them once; got {list(outputs)}.")
    for name in outputs:
        if name not in others:
            raise ValueError(f"{path}: {checks.unknown('output column', name, others)}")
    return list(outputs)


def _unit_of(time_name: str) -> str | None:
    """Return h for ``time_h``; None where the name carries no unit."""
    stem, _, unit = time_name.partition("_")
    return unit if stem.lower() == "time" and unit in TIME_UNITS else None


def _time(path: Path, line: int, name: str, cell: str) -> float:
    value = _value(path, line, name, cell)
    if math.isnan(value):
        raise ValueError(f"{path}, row {line}, column {name!r}: the time is missing.")
    return value


def _value(path: Path, line: int, name: str, cell: str) -> float:
    if cell.lower() in MISSING:
        return math.nan
    try:
        value = float(cell)
    except ValueError:
        raise ValueError(
            f"{path}, row {line}, column {name!r}: expected a number or an empty cell, got "
            f"{cell!r}. If the column is not an output, name the outputs."
        ) from None
    if not math.isfinite(value):
        raise ValueError(
            f"{path}, row {line}, column {name!r}: expected a finite number, got {cell!r}."
        )
    return value


def _check_order(path: Path, lines: list[int], times: np.ndarray) -> None:
    back = np.flatnonzero(np.diff(times) < 0)
    if back.size:
        k = int(back[0]) + 1
        raise ValueError(
            f"{path}, row {lines[k]}: the time goes back from {times[k - 1]:g} to {times[k]:g}. "
            "Sort the rows by time; replicates are rows with the same time."
        )
