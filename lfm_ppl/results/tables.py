"""Tables for the terminal, Markdown and CSV.

1. `format_cells` turns a table into text, with a fixed number of significant digits.
2. `text_table` breaks wide tables into blocks that fit the terminal.
3. Files are written atomically.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lfm_ppl.results import arviz_data
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.utils.atomic_files import atomic_write

_FORMATS = {"r_hat": "{:.3f}", "ess_bulk": "{:.0f}", "ess_tail": "{:.0f}"}
"""Formats of columns of a summary; other columns get significant digits."""

_DIGITS = {"mcse_mean": 2}


def format_number(value: Any, digits: int = 3) -> str:
    """Return a number with some significant digits, in plain notation where that is short; other values as text.

    Args:
        value: a number, or anything else.
        digits: significant digits; whole parts are never rounded away below a million.

    Example:
        >>> [format_number(x) for x in (0.80123, 1234.5, 2.5e-7, 3, float("nan"))]
        ['0.801', '1234', '2.50e-07', '3', '-']
    """
    if value is None or (isinstance(value, (float, np.floating)) and math.isnan(value)):
        return "-"
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (float, np.floating)) or not math.isfinite(value):
        return str(value)
    number = float(value)
    if number == 0.0:
        return "0"
    scientific = f"{number:.{digits - 1}e}"
    if not 1e-4 <= abs(number) < 1e6:
        return scientific
    # 9.999 has its leading digit at 1 before it is rounded, and at 10 afterwards.
    exponent = int(scientific.partition("e")[2])
    return f"{number:.{max(digits - 1 - exponent, 0)}f}"


def format_cells(frame: pd.DataFrame, digits: int = 3) -> pd.DataFrame:
    """Return a table of text, with numbers as `format_number` gives them."""
    def cell(name: str, value: Any) -> str:
        is_finite = isinstance(value, (float, int, np.number)) and math.isfinite(value)
        if is_finite and name in _FORMATS:
            return _FORMATS[name].format(value)
        return format_number(value, min(digits, _DIGITS.get(name, digits)))

    columns = [[cell(str(name), value) for value in frame[name].tolist()] for name in frame.columns]
    return pd.DataFrame(dict(enumerate(columns)), frame.index.map(str), dtype=object).set_axis(
        frame.columns.map(str), axis=1)


def text_table(frame: pd.DataFrame, width: int = 80, digits: int = 3) -> str:
    """Return a table as aligned text that fits a terminal.

    Numbers are aligned right, text left. The names of the columns of a wide table are broken at underscores. A table
    that is still too wide continues below with the remaining columns, each block with the names of the rows.

    Args:
        frame: the table.
        width: characters per line.
        digits: significant digits of numbers.

    Returns:
        Lines joined by newlines, without trailing blanks.
    """
    cells = format_cells(frame, digits)
    # A gap of two spaces is easier to read than a gap of one, which is better than a second block.
    for is_split, gap in ((False, "  "), (True, "  "), (True, " ")):
        names = _padded(["", "", *cells.index], str.ljust)
        columns = [_column(str(name), cells[str(name)].tolist(), gap, is_split,
                           pd.api.types.is_numeric_dtype(frame[name])) for name in frame.columns]
        if sum(len(column[0]) for column in (names, *columns)) <= width:
            break
    blocks = [[names]]
    for column in columns:
        if len(blocks[-1]) > 1 and sum(len(part[0]) for part in (*blocks[-1], column)) > width:
            blocks.append([names])
        blocks[-1].append(column)
    return "\n\n".join(_joined(block) for block in blocks)


def _column(name: str, cells: list[str], gap: str, is_split: bool, is_numeric: bool) -> list[str]:
    """Return the two lines of a header and the cells below it, padded to one width."""
    head, _, tail = name.rpartition("_")
    is_split = is_split and bool(head and tail) and len(name) > max(map(len, cells), default=0)
    header = [head, tail] if is_split else ["", name]
    return [gap + line for line in _padded([*header, *cells], str.rjust if is_numeric else str.ljust)]


def _padded(lines: list[str], justify: Callable[[str, int], str]) -> list[str]:
    size = max(map(len, lines))
    return [justify(line, size) for line in lines]


def _joined(columns: list[list[str]]) -> str:
    """Return columns side by side, without the first line of the header where it is empty."""
    lines = ["".join(row).rstrip() for row in zip(*columns, strict=True)]
    return "\n".join(lines if lines[0] else lines[1:])


def markdown_table(frame: pd.DataFrame, digits: int = 3) -> str:
    """Return a table as Markdown, numbers aligned right.

    Example:
        >>> print(markdown_table(pd.DataFrame({"mean": [0.5]}, index=["decay"])))
        |       | mean  |
        | :---- | ----: |
        | decay | 0.500 |
    """
    cells = format_cells(frame, digits)
    columns = []
    for name, is_numeric in [("", False), *((name, pd.api.types.is_numeric_dtype(frame[name])) for name in frame)]:
        texts = [text.replace("|", "\\|") for text in (str(name), *(cells[str(name)] if name else cells.index))]
        size = max(4, *map(len, texts))
        header, *texts = texts
        rule = "-" * (size - 1) + ":" if is_numeric else ":" + "-" * (size - 1)
        columns.append([header.ljust(size), rule, *(text.rjust(size) if is_numeric else text.ljust(size)
                                                    for text in texts)])
    return "\n".join(f"| {' | '.join(row)} |" for row in zip(*columns, strict=True))


def annotate(table: pd.DataFrame, result: Any) -> pd.DataFrame:
    """Return a summary with the kind of each parameter, and the warnings on its draws.

    Args:
        table: `lfm_ppl.results.arviz_data.summary` of the result.
        result: an ArviZ object.

    Returns:
        The table with ``kind`` ("sampled", "derived" from sampled ones, or "fixed") and ``warnings`` (text, empty where
        there are none; warnings on all parameters, such as divergences, stand in each row).
    """
    view = ResultView.of(result)
    derived = {str(name) for name, variable in view.posterior.data_vars.items() if variable.attrs.get("derived")}
    kinds = ["derived" if label.partition("[")[0] in derived else "fixed" if sd == 0.0 else "sampled"
             for label, sd in table["sd"].items()]
    messages = [" ".join(arviz_data.convergence_warnings(view, table.loc[[label]])) for label in table.index]
    return table.assign(kind=kinds, warnings=messages)


def write_csv(frame: pd.DataFrame, path: str | Path, overwrite: bool = False, index_label: str = "parameter") -> Path:
    """Write a table to a CSV file at full precision, atomically, and return the path.

    ``index_label`` is the header of the first column, which holds the names of the rows.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is False.
    """
    with atomic_write(path, overwrite) as temporary:
        frame.to_csv(temporary, index_label=index_label)
    return Path(path)


def write_markdown(frame: pd.DataFrame, path: str | Path, overwrite: bool = False, digits: int = 3) -> Path:
    """Write a table to a Markdown file, atomically, as `markdown_table` gives it, and return the path."""
    with atomic_write(path, overwrite) as temporary:
        temporary.write_text(markdown_table(frame, digits) + "\n", encoding="utf-8")
    return Path(path)
