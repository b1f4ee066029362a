"""Tables for the terminal, Markdown, HTML and CSV.

1. `format_number` gives numbers with a fixed number of significant digits.
2. `text_table` breaks wide tables into blocks that fit the terminal.
3. Files are written atomically.
"""

from __future__ import annotations

import html
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lfm_ppl.results import arviz_data
from lfm_ppl.utils.atomic_files import atomic_write

# How a column of the summary table reads best; others get significant digits.
_FORMATS = {"r_hat": "{:.3f}", "ess_bulk": "{:.0f}", "ess_tail": "{:.0f}"}
_DIGITS = {"mcse_mean": 2}

_LONG_TEXT = 50
"""Characters of a cell from which on it is broken into lines."""


def format_number(value: Any, digits: int = 3) -> str:
    """Return ``value`` with ``digits`` significant digits, in plain notation where that is short.

    Args:
        value: a number, or anything else, which is turned into text.
        digits: significant digits; whole parts are never rounded away below a million.

    Example:
        >>> [format_number(x) for x in (0.80123, 1234.5, 2.5e-7, 3, float("nan"))]
        ['0.801', '1234', '2.50e-07', '3', '-']
    """
    if value is None or (isinstance(value, (float, np.floating)) and math.isnan(value)):
        return "-"
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.number)):
        return str(value)
    if isinstance(value, (int, np.integer)):
        return str(value)
    value = float(value)
    if not math.isfinite(value):
        return "inf" if value > 0 else "-inf"
    if value == 0.0:
        return "0"
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    # Rounding first: 9.999 has its leading digit before, 10.0 after.
    exponent = math.floor(math.log10(abs(float(f"{value:.{digits - 1}e}"))))
    return f"{value:.{max(digits - 1 - exponent, 0)}f}"


def text_table(frame: pd.DataFrame, width: int = 80, digits: int = 3) -> str:
    """Return ``frame`` as aligned text that fits a terminal.

    Numbers are aligned right, text left. A table that is too wide first breaks its column names
    at underscores, then goes on below with the remaining columns, each block with the row names.

    Args:
        frame: the table.
        width: characters per line.
        digits: significant digits of numbers.

    Returns:
        Lines joined by newlines, without trailing blanks.
    """
    body = _formatted(frame, digits)
    names = [str(name) for name in frame.index]
    columns = {name: [str(name)] for name in frame.columns}
    split = {name: _broken(str(name), body[name]) for name in frame.columns}
    label = max([len(name) for name in names], default=0)
    # Two spaces are easier to read than one; either is better than a second block.
    for headers, gap in ((columns, 2), (split, 2), (split, 1)):
        widths = {name: gap + max(map(len, [*headers[name], *body[name]])) for name in body}
        if label + sum(widths.values()) <= width:
            break
    height = max([len(header) for header in headers.values()], default=1)
    cells = {}
    for name, header in headers.items():
        padded = [""] * (height - len(header)) + header
        cells[name] = _aligned(frame[name], padded, body[name], widths[name])
    row_labels = [row.ljust(label) for row in [""] * height + names]
    return "\n\n".join(
        "\n".join(
            (first + "".join(cells[name][row] for name in block)).rstrip()
            for row, first in enumerate(row_labels)
        )
        for block in _blocks(widths, width - label)
    )


def markdown_table(frame: pd.DataFrame, digits: int = 3) -> str:
    """Return ``frame`` as a Markdown table, numbers aligned right.

    Example:
        >>> print(markdown_table(pd.DataFrame({"mean": [0.5]}, index=["decay"])))
        |       | mean  |
        | :---- | ----: |
        | decay | 0.500 |
    """
    body = _formatted(frame, digits)
    columns = [["", *(_escaped(str(name)) for name in frame.index)]]
    columns += [[_escaped(str(name)), *map(_escaped, body[name])] for name in frame.columns]
    right = [False, *(pd.api.types.is_numeric_dtype(frame[name]) for name in frame.columns)]
    sizes = [max(4, *map(len, column)) for column in columns]
    lines: list[str] = []
    for row in zip(*columns, strict=True):
        cells = [
            cell.rjust(size) if number and lines else cell.ljust(size)
            for cell, size, number in zip(row, sizes, right, strict=True)
        ]
        lines.append(f"| {' | '.join(cells)} |")
        if len(lines) == 1:
            rules = [
                "-" * (size - 1) + ":" if number else ":" + "-" * (size - 1)
                for size, number in zip(sizes, right, strict=True)
            ]
            lines.append(f"| {' | '.join(rules)} |")
    return "\n".join(lines)


def html_table(frame: pd.DataFrame, digits: int = 3, index_label: str = "") -> str:
    """Return ``frame`` as an HTML table, in a box that scrolls where the page is narrower; all text is escaped.

    Args:
        frame: the table.
        digits: significant digits of numbers, which get the class ``n``; text of more than a few words gets ``t``.
        index_label: header of the first column, which holds the row names.

    Example:
        >>> print(html_table(pd.DataFrame({"mean": [0.5]}, index=["k<1"])))
        <div class="scroll"><table>
        <thead><tr><th scope="col"></th><th scope="col" class="n">mean</th></tr></thead>
        <tbody>
        <tr><th scope="row">k&lt;1</th><td class="n">0.500</td></tr>
        </tbody>
        </table></div>
    """
    body = _formatted(frame, digits)
    kind = {}
    for name, column in body.items():
        wide = ' class="t"' if max(map(len, column), default=0) > _LONG_TEXT else ""
        kind[name] = ' class="n"' if pd.api.types.is_numeric_dtype(frame[name]) else wide
    header = "".join(f'<th scope="col"{kind[name]}>{_breakable(str(name))}</th>' for name in body)
    lines = ['<div class="scroll"><table>',
             f'<thead><tr><th scope="col">{html.escape(index_label)}</th>{header}</tr></thead>', "<tbody>"]
    for row, label in enumerate(frame.index):
        cells = "".join(f"<td{kind[name]}>{html.escape(column[row])}</td>" for name, column in body.items())
        lines.append(f'<tr><th scope="row">{html.escape(str(label))}</th>{cells}</tr>')
    return "\n".join([*lines, "</tbody>", "</table></div>"])


def annotated(table: pd.DataFrame, result: Any) -> pd.DataFrame:
    """Return a summary with two more columns: what a parameter is, and what is wrong with its draws.

    Args:
        table: `lfm_ppl.results.arviz_data.summary` of the result.
        result: an ArviZ object.

    Returns:
        The table with ``kind`` ("sampled", "derived" from sampled ones, or "fixed") and ``warnings`` (text, empty where
        there are none; what concerns all parameters, such as divergences, stands in each row).
    """
    posterior = arviz_data.group(result, "posterior")
    derived = {str(name) for name, variable in posterior.data_vars.items() if variable.attrs.get("derived")}
    kinds, indices = [], []
    for label in table.index:
        fixed = "fixed" if table.loc[label, "sd"] == 0.0 else "sampled"
        kinds.append("derived" if label.partition("[")[0] in derived else fixed)
        indices.append(" ".join(arviz_data.convergence_warnings(result, table.loc[[label]])))
    return table.assign(kind=kinds, warnings=indices)


def write_csv(
    frame: pd.DataFrame, path: str | Path, overwrite: bool = False, index_label: str = "parameter"
) -> Path:
    """Write ``frame`` to a CSV file at full precision, through a temporary name.

    Args:
        frame: the table.
        path: the file.
        overwrite: replace a file that exists.
        index_label: header of the first column, which holds the row names.

    Returns:
        ``path`` as a Path.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is False.
    """
    with atomic_write(path, overwrite) as temporary:
        frame.to_csv(temporary, index_label=index_label)
    return Path(path)


def write_markdown(
    frame: pd.DataFrame, path: str | Path, overwrite: bool = False, digits: int = 3
) -> Path:
    """Write ``frame`` to a Markdown file, through a temporary name; see ``markdown_table``."""
    with atomic_write(path, overwrite) as temporary:
        temporary.write_text(markdown_table(frame, digits) + "\n", encoding="utf-8")
    return Path(path)


def _formatted(frame: pd.DataFrame, digits: int) -> dict[Any, list[str]]:
    columns = {}
    for name in frame.columns:
        form = _FORMATS.get(str(name))
        columns[name] = [
            form.format(value)
            if form and isinstance(value, (float, int, np.number)) and math.isfinite(value)
            else format_number(value, min(digits, _DIGITS.get(str(name), digits)))
            for value in frame[name].tolist()
        ]
    return columns


def _broken(header: str, cells: list[str]) -> list[str]:
    """Break a header at its last underscore where it is wider than what stands below it."""
    head, _, tail = header.rpartition("_")
    too_wide = len(header) > max(map(len, cells), default=0)
    return [head, tail] if head and tail and too_wide else [header]


def _aligned(column: pd.Series, header: list[str], cells: list[str], size: int) -> list[str]:
    if pd.api.types.is_numeric_dtype(column):
        return [cell.rjust(size) for cell in header + cells]
    gap = size - max(map(len, header + cells))
    return [" " * gap + cell.ljust(size - gap) for cell in header + cells]


def _blocks(widths: dict[Any, int], room: int) -> list[list[Any]]:
    """Share columns out over lines of ``room`` characters, at least one to a line."""
    blocks: list[list[Any]] = [[]]
    used = 0
    for name, size in widths.items():
        if blocks[-1] and used + size > room:
            blocks.append([])
            used = 0
        blocks[-1].append(name)
        used += size
    return blocks


def _breakable(header: str) -> str:
    """Return a header as HTML that may be broken at its underscores."""
    return html.escape(header).replace("_", "_<wbr>")


def _escaped(cell: str) -> str:
    return cell.replace("|", "\\|")
