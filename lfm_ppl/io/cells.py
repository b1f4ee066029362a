"""Cells of tables: numbers, missing values, and numbers that look like codes of missing values."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any

import numpy as np

from lfm_ppl.io.table import Table
from lfm_ppl.utils import checks

if TYPE_CHECKING:
    pass


MISSING = ("", ".", "na", "nan", "n/a", "null", "nat", "none")


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
    for digits in (7, 15):  # digits of single and of double precision
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


def warn_of_codes(source: Table, name: str, column: np.ndarray) -> None:
    """Warn of numbers in a column (T,) that seem to stand for missing values."""
    for code in _codes(column):
        if np.isfinite(column).sum() - np.sum(column == code) < 2:
            continue
        location, count = source.cell_location(int(np.argmax(column == code)), name), int((column == code).sum())
        checks.warn(f"{location}: {code:g}, far from all other values of the column, is taken as a measurement "
                    f"({count} of them). If it stands for a missing value, leave the cell empty.")


def is_missing(cell: Any) -> bool:
    """Return whether a cell is a missing value."""
    if cell is None or isinstance(cell, str):
        return cell is None or cell.strip().lower() in MISSING
    return bool(cell != cell)  # NaN, and pandas' NaT


_WANTED = ("expected a number or an empty cell, got {}. If the model does not take this column, name those it takes: "
           "outputs and inputs.")


def parse_number(source: Table, row: int, name: str, requirement: str = _WANTED) -> float:
    """Return the number in a cell; ``wanted`` is what to say, with the place of the cell, of one that holds none."""
    cell = source.columns[name][row]
    try:
        if is_missing(cell):
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
