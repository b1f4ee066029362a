"""Numbers that stand for missing values, such as -9, 99, -999.9, -999.25, 7777, 1e30 and -32768."""

from __future__ import annotations

import re
from itertools import takewhile

import numpy as np

from lfm_ppl.io.table import Table
from lfm_ppl.utils import checks

_INTEGER_LIMITS = tuple(float(sign * (2**bits - shift)) for bits in (15, 16, 31, 32, 63) for sign in (1, -1)
                        for shift in (0, 1))
# 9, 9.9 and 77 are too usual as measurements; -9 and 9.99 are codes of fixed-width formats, 999.25 of well logs.
_CODE = re.compile(r"-9(\.9)?|-?(99+(\.9+)?|9\.99+|9{3,5}\.25)|(-|7)77+(\.7+)?|(-|8)88+(\.8+)?")
_FAR_RANGES = 5.0  # ranges of the other values from which on a code is far from them, however they are spread
_FAR_GAPS = 5.0  # largest gaps within the other values from which on a code that is a range away is far from them


def _looks_like_code(value: float) -> bool:
    if abs(value) >= 1e30 or value in _INTEGER_LIMITS:
        return True
    texts = [f"{value:.{digits}g}".partition("e") for digits in (7, 15)]  # of single and of double precision
    return any(_CODE.fullmatch(mantissa) and not exponent.startswith("-") or
               mantissa.strip("-") == "1" and int(exponent or 0) >= 10 for mantissa, _, exponent in texts)


def _codes(column: np.ndarray) -> list[float]:
    """Return the numbers in a column (T,) that look like codes and are far from all other numbers.

    1. Candidates are the smallest and largest numbers, as long as they look like codes.
    2. Candidates that are not far from the usual values become usual, until all candidates are far.
    """
    values = np.unique(column[np.isfinite(column)])
    low, high = (sum(1 for _ in takewhile(_looks_like_code, side)) for side in (values, values[::-1]))
    is_candidate = (np.arange(len(values)) < low) | (np.arange(len(values))[::-1] < high)
    with np.errstate(over="ignore"):  # differences of the largest numbers
        while is_candidate.any() and not is_candidate.all():
            usual = values[~is_candidate]
            value_range, gap = np.ptp(usual), np.diff(usual).max(initial=0.0)
            distance = np.maximum(usual[0] - values, values - usual[-1])
            is_far = (distance > _FAR_RANGES * value_range) | (distance > max(value_range, _FAR_GAPS * gap))
            # -999 among flows of 0 to 5,000 is less than their range away from them, but negative.
            is_far |= (values <= -99) & (usual[0] >= 0) & (distance > gap)
            if is_far[is_candidate].all():
                return values[is_candidate].tolist()
            is_candidate &= is_far
    return []


def warn_of_codes(table: Table, name: str, column: np.ndarray) -> None:
    """Warn of numbers in a column (T,) that seem to stand for missing values."""
    for code in _codes(column):
        count = int(np.sum(column == code))
        if np.isfinite(column).sum() - count >= 2:
            location = table.location(int(np.argmax(column == code)), name)
            checks.warn(f"{location}: {code:g}, far from all other values of the column, is taken as a measurement "
                        f"({count} of them). If it stands for a missing value, leave the cell empty.")
