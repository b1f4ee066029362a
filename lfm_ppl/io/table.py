"""Tables of cells as pandas DataFrames, from a CSV file, pandas, polars, xarray or a mapping of columns."""

from __future__ import annotations

import csv
import itertools
import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lfm_ppl.utils import checks

if TYPE_CHECKING:  # imported where a table is read: `lfm-ppl --help` does not need pandas
    import pandas as pd

_NUMBER = ("expected a finite number, got {}. Leave an empty cell where a value is missing; if the model does not take "
           "this column, name those it takes: outputs and inputs.")


@dataclass(frozen=True)
class Table:
    """Cells, and the names of the table and of its rows in errors.

    Attributes:
        label: the file, or the kind of table.
        frame: columns of text, numbers or dates; its index has the row numbers that a user sees.
    """

    label: str
    frame: pd.DataFrame

    def location(self, row: int, column: str) -> str:
        """Return the location of a cell."""
        return f"{self.label}, row {self.frame.index[row]}, column {column!r}"

    def numbers(self, column: str, requirement: str = _NUMBER) -> np.ndarray:
        """Return the numbers (T,) of a column, NaN where they are missing; ValueError for a cell without a number."""
        values = np.array([_number(cell) for cell in self.frame[column]])
        if np.isinf(values).any():
            row = int(np.argmax(np.isinf(values)))
            cell = self.frame[column].iloc[row]
            text = repr(cell) if len(repr(cell)) <= 60 else f"{repr(cell)[:50]}... ({len(repr(cell))} characters)"
            remedy = _remedy(str(cell))
            if row == 0 and not remedy and len(values) > 1 and np.isfinite(values[1:]).any():
                remedy = " If it is a row of units, delete it, or begin it with #."
            raise ValueError(f"{self.location(row, column)}: {requirement.format(text)}{remedy}")
        return values


def is_missing(cell: Any) -> bool:
    """Return whether a cell is a missing value."""
    if isinstance(cell, str):
        return cell.strip().lower() in ("", ".", "na", "nan", "n/a", "null", "nat", "none")
    return cell is None or type(cell).__name__ == "NAType" or bool(cell != cell)  # NaN, and pandas' NaT


def words_of(name: str) -> set[str]:
    """Return the words of a column's name, ``{"patient", "id"}`` for ``PatientID``; none of ``rat2``, a series."""
    if re.search(r"\d", name):
        return set()
    return set(re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()))


def is_number(cell: Any) -> bool:
    """Return whether a cell is a finite number, or the text of one."""
    return as_number(cell) is not None


def as_number(cell: Any) -> float | None:
    """Return the finite number in a cell, None where there is none."""
    try:
        return float(cell) if np.isfinite(float(cell)) else None
    except (TypeError, ValueError):
        return None


def _number(cell: Any) -> float:
    """Return the number in a cell, NaN where it is missing and infinity where there is none."""
    try:
        return math.nan if is_missing(cell) else float(cell)
    except (TypeError, ValueError):
        return math.inf


def _remedy(cell: str) -> str:
    if re.fullmatch(r"[+-]?\d{1,3}(,\d{3})+(\.\d*)?", cell):
        return f" If commas mark thousands, leave them out, {cell.replace(',', '')}; a decimal comma is to be a point."
    if re.fullmatch(r"[+-]?\d{1,3}(\.\d{3})+,\d+", cell):
        return f" Write {cell.replace('.', '').replace(',', '.')}: thousands are not marked, and decimals have a point."
    if re.fullmatch(r"[+-]?\d+,\d+", cell):
        return f" A decimal point is a point, {cell.replace(',', '.')}; thousands are not marked."
    if re.fullmatch(r"[+-]?[\d.]+([eE][+-]?\d+)?\s*[^\d\s.][^\d]*", cell):
        return " Write the unit in the name of the column, and the number alone in the cell."
    if re.fullmatch(r"[<>]=?\s*[\d.]+", cell):
        return " Write a value beyond a limit as the limit; lfm.CensoredObservation(left=, right=) knows what it means."
    return ""


def read_file(path: str | Path, most_rows: int | None = None) -> Table:
    """Read a comma-separated file; rows are numbered as an editor counts them.

    With ``most_rows`` nothing is read beyond that many rows that are no comments, the header included.
    """
    import pandas as pd

    try:
        # pandas.read_csv fills short rows, cuts a cell at a comment character, and does not report lines.
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, strict=True)
            numbered = ((reader.line_num, [cell.strip() for cell in row]) for row in reader)
            rows = dict(itertools.islice(((line, cells) for line, cells in numbered
                                          if any(cells) and not cells[0].startswith("#")), most_rows))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is not a comma-separated text file (UTF-8): {error}. Save it as CSV in UTF-8."
                         ) from None
    first_cells = next(iter(rows.values()), [])
    if any("\0" in cell for cell in first_cells):
        raise ValueError(f"{path} is not a comma-separated text file (UTF-8): it has zero bytes, as UTF-16 has. Save "
                         "it as CSV in UTF-8.")
    if first_cells and first_cells[0].lower() == "sep=" and not any(first_cells[1:]):  # written for a spreadsheet
        del rows[next(iter(rows))]
    if len(rows) < 2:
        raise ValueError(f"{path} {'has a header and no rows' if rows else 'is empty'}; expected a header row and one "
                         "row per time.")
    first, header = next(iter(rows.items()))
    if len(header) < 2 or header[0].startswith("<"):
        raise ValueError(f"{path}, row {first}: expected the names of columns, with commas between them, got "
                         f"{','.join(header)[:40]!r}. Export it as comma-separated CSV, with a point in decimals.")
    # Empty columns at the right, which a spreadsheet leaves.
    width = max(1 + max((k for k, cell in enumerate(cells) if cell), default=0) for cells in rows.values())
    rows = {line: cells[:width] for line, cells in rows.items()}
    header = header[:width]
    for line, cells in rows.items():
        if len(cells) != len(header):
            raise ValueError(f"{path}, row {line}: {len(cells)} cells, but the header has {len(header)} columns. Leave "
                             "a missing value empty, and write decimals with a point.")
    del rows[first]
    return _checked(str(path), pd.DataFrame(list(rows.values()), list(rows), header, dtype=object))


def from_frame(value: Any) -> Table:
    """Read a pandas DataFrame or Series, a polars DataFrame, an xarray Dataset or DataArray, or a mapping of columns.

    An index or coordinate that has a name, or holds dates, is a column like the others; rows are numbered from 0.
    """
    import pandas as pd

    library = _library(value)
    label = {None: "the table", "xarray": "the Dataset"}.get(library, "the DataFrame")
    if not is_table(value):
        raise TypeError("expected a pandas or polars DataFrame, an xarray Dataset or a mapping of columns, got "
                        f"{type(value).__name__}. For a file: lfm.read_csv.")
    if library in (None, "polars"):
        value = value.collect() if hasattr(value, "collect") else value  # a lazy frame
        columns = {str(name): _cells(value[name]) for name in (value.columns if library else value)}
        lengths = sorted({len(cells) for cells in columns.values()})
        if len(lengths) > 1:
            raise ValueError(f"{label} has columns of {' and '.join(map(str, lengths))} rows; expected equal numbers.")
        return _checked(label, pd.DataFrame(columns, dtype=object))
    if library == "xarray":
        value = (value if hasattr(value, "data_vars") else value.to_dataset(name=value.name or "y")).to_dataframe()
        if value.index.nlevels > 1:
            raise ValueError(f"the Dataset has the dimensions {', '.join(map(str, value.index.names))}; expected the "
                             "time alone. Give each series a variable of its own: array.to_dataset(dim=...).")
    frame = value.to_frame() if value.ndim == 1 else value
    is_column = frame.index.name is not None or frame.index.dtype.kind == "M"
    frame = frame.reset_index(drop=not is_column, names=str(frame.index.name or "time") if is_column else None)
    return _checked(label, frame.astype(object).set_axis(frame.columns.map(str), axis=1))


def is_table(value: Any) -> bool:
    """Return whether `from_frame` reads a value."""
    return isinstance(value, Mapping) or _library(value) is not None


def _library(value: Any) -> str | None:
    """Return the library that a table comes from, without importing it."""
    library = type(value).__module__.partition(".")[0]
    attribute = {"pandas": "iloc", "polars": "columns", "xarray": "to_dataframe"}.get(library)
    return library if attribute and hasattr(value, attribute) else None


def _cells(column: Any) -> list[Any]:
    import pandas as pd

    if hasattr(column, "to_list"):  # of pandas and polars; NumPy would drop a time zone
        return column.to_list()
    array = np.asanyarray(checks.unmask(column))
    return pd.Series(array).to_list() if array.dtype.kind in "mM" else array.tolist()


def _checked(label: str, frame: pd.DataFrame) -> Table:
    if repeated := [name for name, count in Counter(frame).items() if count > 1]:
        positions = [str(number) for number, name in enumerate(frame, 1) if name == repeated[0]]
        raise ValueError(f"{label}: the column name {repeated[0]!r} stands {len(positions)} times (columns "
                         f"{', '.join(positions)}). Give each column its own name.")
    if frame.empty:
        raise ValueError(f"{label} has no rows; expected names of columns, and one row per time.")
    return Table(label, frame)
