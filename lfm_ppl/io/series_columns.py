"""Columns that identify the series of each row of a table, and the order of its times."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lfm_ppl.io.table import Table, as_number, is_missing, words_of

IDENTIFIERS = frozenset((
    "id", "ids", "subject", "subj", "subjid", "subjectid", "usubjid", "patient", "patientid", "participant", "person",
    "volunteer", "individual", "indiv", "animal", "animalid", "series", "group", "name", "who"))
"""Words in the names of columns that identify the series of a row."""

_SUBJECTS = IDENTIFIERS | frozenset((
    "mouse", "rat", "dog", "pig", "rabbit", "monkey", "sheep", "cow", "fish", "bird", "plant", "tree", "child",
    "household", "customer", "cage", "plot", "tank", "well"))
"""These, and words that also name measurements, such as the number of sheep."""

_FACTORS = frozenset(("group", "name", "who"))
"""Words that name factors and remarks, too, where the outputs are named."""

_REPLICATES = frozenset(("replicate", "replicates", "replication", "rep", "reps", "repl", "repeat", "duplicate",
                         "triplicate", "technical"))
"""Words in the names of columns that number the measurements of one time."""


def check_order(table: Table, time_name: str, times: np.ndarray, free: Sequence[str], is_unused: bool,
                is_observed: np.ndarray) -> None:
    """Raise ValueError where the time goes back, or where several series seem to stand in one table.

    Args:
        table: the table.
        time_name: the column of times.
        times: (T,).
        free: the columns that may hold identifiers of series.
        is_unused: see `_merged_series_column`.
        is_observed: (T,), rows that are no rows of doses, in which such a column may be blank or a code.
    """
    cells = table.frame[time_name].to_numpy()
    rows = np.flatnonzero(np.diff(times) < 0)
    if rows.size:
        series = _series_column(table, times, free)
    else:
        table, times = Table(table.label, table.frame[is_observed]), times[is_observed]
        series = _merged_series_column(table, times, free, is_unused) if len(times) else None
    if series is not None:
        labels = table.frame[series].astype(str).to_numpy()
        row = (rows if rows.size else np.flatnonzero(labels[1:] != labels[:-1]))[0] + 1
        change = f"the column {series!r} changes from {labels[row - 1]} to {labels[row]}"
        if rows.size:
            change = f"the time goes back from {cells[row - 1]} to {cells[row]}, where {change}"
        otherwise = "" if rows.size else (" If it names outputs, give each of them a column; else leave the column "
                                          "out of the file or table.")
        raise ValueError(f"{table.label}, row {table.frame.index[row]}: {change}. If "
                         f"it names several series, fit them separately: --series {series} (lfm.read_series("
                         f"path, {series!r}), or lfm.read_table of each part of a DataFrame).{otherwise}")
    if rows.size:
        row = rows[0] + 1
        raise ValueError(f"{table.label}, row {table.frame.index[row]}: the time goes back from {cells[row - 1]} to "
                         f"{cells[row]}. Sort the rows by time; replicates are rows with the same time. A clock that "
                         "is set back for winter needs offsets from UTC.")


def _series_column(table: Table, times: np.ndarray, free: Sequence[str]) -> str | None:
    """Return the column that seems to hold identifiers of series where the time goes back, None where there is none.

    Its cells are filled, and the time does not go back among the rows that share a value. Unless its name is that of an
    identifier, these rows stand together, and a value has two of them or more on average.
    """
    candidates = []
    for name in free:
        labels, index = np.unique(table.frame[name].astype(str), return_inverse=True)
        order = np.argsort(index, kind="stable")
        goes_back = (np.diff(times[order]) < 0) & (np.diff(index[order]) == 0)
        # Replicates that stand one below the other are one series, to be sorted.
        if words_of(name) & _REPLICATES or len(labels) == 1 or goes_back.any() or any(
                map(is_missing, table.frame[name])):
            continue
        if words_of(name) & (IDENTIFIERS | {"unit"}):
            return name
        if 1 + np.count_nonzero(np.diff(index)) == len(labels) <= len(index) / 2:
            candidates.append(name)
    return candidates[0] if candidates else None


def _merged_series_column(table: Table, times: np.ndarray, free: Sequence[str], is_unused: bool) -> str | None:
    """Return the column that seems to hold identifiers of series where the time never goes back.

    Its cells are texts or whole numbers, all filled. Either its name is that of an identifier, and half of the rows or
    more share their value with another row: a number of the row, or of an animal that is measured once, identifies no
    series. Or its values tell rows of equal times apart, each of them at several times. A factor such as the weather
    does not, as it is equal in rows of one time. Measurements that are whole numbers may tell rows apart, too, but not
    with the same numbers at all times.

    Args:
        table: the table.
        times: (T,).
        free: the columns that may hold identifiers.
        is_unused: whether these columns are known to be no outputs.
    """
    _, instant = np.unique(times, return_inverse=True)
    for name in free:
        words, cells = words_of(name), table.frame[name]
        kind = None if words & _REPLICATES else _kind_of_labels(cells)
        if kind is None or any(map(is_missing, cells)):
            continue
        labels, index, counts = np.unique(cells.astype(str), return_inverse=True, return_counts=True)
        if len(labels) == 1:
            continue
        identifiers = _SUBJECTS if is_unused or kind is str else IDENTIFIERS
        if is_unused:
            identifiers -= _FACTORS
        if words & identifiers and counts[counts > 1].sum() >= len(index) / 2:
            return name
        rows = np.zeros((instant.max() + 1, len(labels)), int)
        np.add.at(rows, (instant, index), 1)
        is_shared = np.count_nonzero(rows, axis=1) > 1
        if rows.max() == 1 and is_shared.sum() > 1 and counts.min() > 1 and (kind is str or rows.all()):
            return name
    return None


def _kind_of_labels(cells: Any) -> type | None:
    """Return str or int where all cells of a column are texts or whole numbers, else None."""
    if all(as_number(cell) is None for cell in cells):
        return str
    numbers = map(as_number, cells)
    return int if all(number is not None and number == int(number) for number in numbers) else None
