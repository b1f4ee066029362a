"""A table of cells, from a CSV file, pandas, polars, xarray, or a mapping of columns.

1. `from_csv` reads the cells as text, with the row numbers of the file.
2. `from_frame` reads the columns of a data frame, a dataset or a mapping, without importing its library.
3. Names of columns must be unique and not empty.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Table:
    """Columns of cells, and what a complaint calls them.

    Attributes:
        label: the file, or the kind of table.
        columns: name -> cells: text, numbers, dates, or None.
        rows: what the user calls each row.
    """

    label: str
    columns: Mapping[str, Sequence[Any]]
    rows: Sequence[Any]

    def cell_location(self, row: int, column: str) -> str:
        """Return where a cell is."""
        return f"{self.label}, row {self.rows[row]}, column {column!r}"

    def part(self, rows: Sequence[int], without: str) -> Table:
        """Return some of the rows, without a column."""
        columns = {name: [cells[row] for row in rows] for name, cells in self.columns.items() if name != without}
        return Table(self.label, columns, [self.rows[row] for row in rows])


def from_csv(path: str | Path) -> Table:
    """Read a comma-separated file; rows are numbered as an editor counts them.

    Raises:
        ValueError: it is empty, not comma-separated text, has rows of different lengths or repeated names.
        FileNotFoundError: there is no such file.
    """
    if not str(path).strip():
        raise ValueError("the name of the data file is empty.")
    path = Path(path)
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
    if header[0].startswith("<"):
        raise ValueError(f"{path} is HTML or XML, beginning with {header[0][:40]!r}; expected comma-separated text. "
                         "Export it as CSV.")
    for separator, name in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars"), (" ", "spaces")):
        if len(header) == 1 and separator in header[0]:
            raise ValueError(f"{path} is separated by {name}; expected commas between columns and a point in decimals. "
                             "Export it as comma-separated CSV.")
    if all(_is_number(cell) for cell in header):
        raise ValueError(f"{path}, row {first}: expected a header with the name of each column, got the numbers "
                         f"{', '.join(header[:3])}{', ...' if len(header) > 3 else ''}. Write one above them.")
    _check_names(f"{path}, row {first}", header)
    if len(lines) == 1:
        raise ValueError(f"{path} has a header and no rows; expected one row per time.")
    for line, row in lines[1:]:
        if len(row) != len(header):
            raise ValueError(f"{path}, row {line}: {len(row)} cells, but the header has {len(header)} columns. "
                             "Leave a missing value empty, and write decimals with a point.")
    cells = zip(*(row for _, row in lines[1:]), strict=True)
    return Table(str(path), dict(zip(header, cells, strict=True)), [line for line, _ in lines[1:]])


def is_table(value: Any) -> bool:
    """Whether `from_frame` reads it."""
    return isinstance(value, Mapping) or _kind(value) is not None


def from_frame(frame: Any) -> Table:
    """Read a pandas DataFrame or Series, a polars DataFrame, an xarray Dataset or DataArray, or a mapping of columns.

    An index or coordinate that has a name, or holds dates, is a column like the others; rows are numbered from 0.

    Raises:
        TypeError: another kind of object.
        ValueError: it has no rows, or repeated names.
    """
    kind = _kind(frame)
    label = {None: "the table", "pandas": "the DataFrame", "polars": "the DataFrame", "xarray": "the Dataset"}[kind]
    if kind is None and not isinstance(frame, Mapping):
        raise TypeError("expected a pandas or polars DataFrame, an xarray Dataset or a mapping of columns, got "
                        f"{type(frame).__name__}. For a file: lfm.read_csv.")
    if kind == "xarray":
        frame = frame.to_dataframe(name=frame.name or "y") if hasattr(frame, "name") else frame.to_dataframe()
        if getattr(frame.index, "nlevels", 1) > 1:
            raise ValueError(f"the Dataset has the dimensions {', '.join(map(str, frame.index.names))}; expected the "
                             "time alone. Give each series a variable of its own: array.to_dataset(dim=...).")
    if kind == "polars":
        if hasattr(frame, "collect"):  # a lazy frame
            frame = frame.collect()
        header, columns = list(frame.columns), [column.to_list() for column in frame.get_columns()]
    elif kind is None:
        header, columns = [str(name) for name in frame], [_cells(column) for column in frame.values()]
    else:
        frame = frame.to_frame() if frame.ndim == 1 else frame
        if frame.index.name is not None or frame.index.dtype.kind == "M":
            frame = frame.reset_index(names=str(frame.index.name or "time"))
        header = [str(name) for name in frame.columns]
        columns = [list(frame.iloc[:, k]) for k in range(len(header))]
    _check_names(label, header)
    lengths = {len(column) for column in columns}
    if lengths in (set(), {0}) or len(lengths) > 1:
        raise ValueError(f"{label} has columns of {' and '.join(map(str, sorted(lengths))) or 0} rows; expected the "
                         "same number in each, and one row per time.")
    return Table(label, dict(zip(header, columns, strict=True)), range(lengths.pop()))


def _cells(column: Any) -> list[Any]:
    """Return the entries of a column; masked ones are None or NaT, which are missing."""
    array = np.asanyarray(column)
    if array.dtype.kind not in "mM":
        return array.tolist()
    # As numbers nanoseconds would lose their unit.
    return list(np.where(np.ma.getmaskarray(array), np.array("NaT", array.dtype), np.ma.getdata(array)))


def _kind(value: Any) -> str | None:
    """Return the library that a table comes from, without importing it."""
    library = type(value).__module__.partition(".")[0]
    expected = {"pandas": "iloc", "polars": "columns", "xarray": "to_dataframe"}
    return library if library in expected and hasattr(value, expected[library]) else None


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _check_names(where: str, header: Sequence[str]) -> None:
    repeated = sorted({name for name in header if list(header).count(name) > 1})
    if repeated:
        positions = [i + 1 for i, name in enumerate(header) if name == repeated[0]]
        raise ValueError(f"{where}: the column name {repeated[0]!r} stands {len(positions)} times (columns "
                         f"{', '.join(map(str, positions))}). Give each column its own name.")
