"""Doses in data files, in the columns of NONMEM's event records.

1. A column of amounts is read as doses to one or several states, "dose:STATE,STATE". Columns named EVID, MDV, ADDL, II,
   CMT, RATE, DUR and SS, in any case, or given these roles, describe the doses of each row. A column rate, dur, ss or
   ii in lower case is one of them beside EVID, MDV, ADDL, CMT or AMT.
2. EVID 0 is an observation, 1 a dose, 2 neither, 3 a reset of all states to zero, 4 a reset and a dose. Without EVID
   every row with an amount is a dose.
3. The output of a row is not observed where EVID or MDV is not 0. Without them a row with an amount is not observed
   where the file has CMT, ADDL, II or RATE.
4. ADDL is the number of additional doses, at distances of II, in the unit of the times. RATE or DUR make an infusion of
   a dose, which ends at a reset. CMT is the number of the state, in the order given, or its name.
5. What has no meaning here, or another one, is refused: SS, a RATE of -1 or -2, EVID 2 with a dose.

Source: Beal, Sheiner, Boeckmann and Bauer (2009), NONMEM User's Guides, part VI, chapter V.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from lfm_ppl.io.input_table import DOSE, ONCE, InputTable, end_at_resets
from lfm_ppl.io.missing_codes import warn_of_codes
from lfm_ppl.io.table import Table, as_number, is_missing
from lfm_ppl.utils import checks

ROLES = ("EVID", "MDV", "ADDL", "II", "CMT", "RATE", "DUR", "SS")
"""Names of the columns that describe events."""

_UNAMBIGUOUS = ("EVID", "MDV", "ADDL", "CMT", "AMT")
"""Names of columns that no measurement has, in any case."""

_FEWEST_REPEATED = 3
"""Number of rows from which equal doses in all of them are suspect."""


def event_columns(table: Table, interpolations: Mapping[str, str], outputs: Collection[str]) -> dict[str, str]:
    """Return the columns that describe events: role -> column.

    A column such as rate, in lower case, may be a measurement. It has a role only beside another column of dosing.

    Args:
        table: the data.
        interpolations: columns of known inputs -> how they are read, or their role, in any case.
        outputs: columns that are outputs, which have no role by their name.

    Raises:
        ValueError: a column that is given a role is not in the table, or two columns are given the same role.
    """
    by_option: dict[str, str] = {}
    for name, role in ((name, role.upper()) for name, role in interpolations.items() if role.upper() in ROLES):
        if name not in table.frame:
            raise ValueError(f"{table.label}: {checks.unknown(f'column of {role}', name, list(table.frame))}")
        if role in by_option:
            raise ValueError(f"{table.label}: the columns {by_option[role]!r} and {name!r} are both given the role "
                             f"{role}; give it to one of them.")
        by_option[role] = name
    has_dosing = by_option or any(name.upper() in _UNAMBIGUOUS for name in table.frame)
    by_name = {name.upper(): name for name in table.frame
               if name.upper() in ROLES and name not in interpolations and name not in outputs
               and (name.isupper() or name.upper() in _UNAMBIGUOUS or has_dosing)}
    return {**by_name, **by_option}


def has_amount(table: Table, interpolations: Mapping[str, str]) -> np.ndarray:
    """Return whether a row has an amount that is given in this row, and not a repeated one, (T,)."""
    columns = [name for name, way in interpolations.items() if way.startswith(DOSE) and not way.endswith(ONCE)]
    return np.any([np.nan_to_num(table.numbers(name)) != 0 for name in columns] or [np.zeros(len(table.frame), bool)],
                  axis=0)


def is_unobserved(table: Table, columns: Mapping[str, str], is_dosed: np.ndarray) -> np.ndarray:
    """Return whether the outputs of a row are no observations, (T,).

    Without EVID and MDV a row with an amount is none where the file has another column of NONMEM's, as in NM-TRAN.
    ``is_dosed`` (T,) are the rows with an amount.
    """
    if not {"EVID", "MDV"} & set(columns):
        return is_dosed if {"CMT", "ADDL", "II", "RATE"} & set(columns) else np.zeros(len(is_dosed), bool)
    numbers = _numbers(table, {role: columns[role] for role in ("EVID", "MDV") if role in columns})
    return (numbers["EVID"] != 0) | (numbers["MDV"] != 0)


def check_outputs(table: Table, columns: Mapping[str, str], names: Sequence[str], y: np.ndarray,
                  is_dosed: np.ndarray, used: Collection[str]) -> None:
    """Raise ValueError where CMT or DVID tells the observations in one column apart.

    Warn where the outputs are zero in all rows with a dose, which may stand for no observation.

    Args:
        table: the data.
        columns: role -> column, from `event_columns`.
        names: the D outputs.
        y: (T, D), NaN where a row is no observation.
        is_dosed: (T,), rows with an amount, whose CMT is that of the dose.
        used: columns that are outputs or inputs.
    """
    labelling = [name for name in table.frame if name == columns.get("CMT") or name.upper() == "DVID"]
    for column in (name for name in labelling if name not in used):
        for name, values in zip(names, y.T, strict=True):
            cells = table.frame[column]
            rows = [row for row in np.flatnonzero(np.isfinite(values) & ~is_dosed).tolist()
                    if not is_missing(cells.iloc[row])]
            labels = [_label(cells.iloc[row]) for row in rows]
            if len(set(labels)) > 1:
                row = next(row for row, label in zip(rows, labels, strict=True) if label != labels[0])
                raise ValueError(f"{table.location(row, column)}: the column has {len(set(labels))} values in rows "
                                 f"with an observation of {name}, so that it tells outputs apart; give each output a "
                                 "column, with blank cells in the rows of the others.")
    if {"EVID", "MDV"} & set(columns) or is_dosed.all() or not is_dosed.any():
        return
    for name, values in zip(names, y.T, strict=True):
        if (values[is_dosed] == 0).all():
            checks.warn(f"{table.label}, column {name!r}: the output is 0 in all rows with a dose. If it was not "
                        "measured there, leave the cells blank, or write MDV 1 in these rows.")


def _label(cell: Any) -> str:
    """Return a cell as text, the same for 1 and 1.0."""
    number = as_number(cell)
    return str(cell).strip() if number is None else f"{number:g}"


def warn_of_unread_doses(table: Table, columns: Mapping[str, str]) -> None:
    """Warn where the columns of events mark doses, and no column of amounts is read."""
    if not {"EVID", "ADDL", "AMT"} & {name.upper() for name in table.frame}:
        return  # SS alone may be a sum of squares
    numbers = _numbers(table, {role: column for role, column in columns.items() if role in ("EVID", "ADDL", "SS")})
    marks = {"EVID": np.isin(numbers["EVID"], (1, 3, 4)), "ADDL": numbers["ADDL"] != 0, "SS": numbers["SS"] != 0}
    for role, is_marked in marks.items():
        if is_marked.any():
            amount = next((name for name in table.frame if name.upper() in ("AMT", "DOSE")), "COLUMN")
            checks.warn(f"{table.label}, column {columns[role]!r}: the file marks doses or resets, and none is read; "
                        f"name the column of amounts: --events {amount}:STATE (inputs={{{amount!r}: "
                        f"'{DOSE}STATE'}}).")
            return


def check_unit(table: Table, columns: Mapping[str, str], time_name: str) -> None:
    """Raise ValueError for II, DUR or RATE beside dates whose unit of time nothing names."""
    for role, column in columns.items():
        if role in ("II", "DUR", "RATE") and (rows := np.flatnonzero(np.nan_to_num(table.numbers(column)) > 0)).size:
            raise ValueError(f"{table.location(rows[0], column)}: the times in {time_name!r} are dates, so that the "
                             f"unit of time of {role} is not known; name it: --time-unit h (time_unit='h').")


def read_doses(table: Table, interpolations: Mapping[str, str], times: np.ndarray, columns: Mapping[str, str],
               part: str = "") -> dict[str, InputTable]:
    """Return the doses by their column of amounts. Resets belong to the first column.

    Args:
        table: the data.
        interpolations: columns of amounts -> "dose:STATE,...".
        times: (T,), of the rows.
        columns: role -> column, from `event_columns`.
        part: name of the series in messages.

    Raises:
        ValueError: a row says something that is not read, or contradicts itself; the message names it.
    """
    cells = {name: table.numbers(name) for name in interpolations}
    for name, numbers in cells.items():
        warn_of_codes(table, name, numbers)
    amounts = {name: np.nan_to_num(numbers) for name, numbers in cells.items()}
    if "CMT" in columns and len(interpolations) > 1:
        raise ValueError(f"{table.label}: the column {columns['CMT']!r} says which state receives a dose, and there "
                         f"are doses in several columns, {', '.join(interpolations)}. Give the states of one column: "
                         f"{next(iter(interpolations))}:STATE,STATE.")
    rows = _numbers(table, {role: column for role, column in columns.items() if role != "CMT"})
    is_dosed = np.any([values != 0 for values in amounts.values()], axis=0)
    _check_amounts(table, amounts)
    if "EVID" not in columns:
        rows["EVID"] = np.where(is_dosed, 1.0, 0.0)
    _check_events(table, columns, rows, is_dosed)
    resets = np.unique(times[np.isin(rows["EVID"], (3, 4))])
    tables = {}
    for index, (name, way) in enumerate(interpolations.items()):
        doses = _doses_of_column(table, name, way, times, columns, {**rows, "AMT": amounts[name]}, resets, part)
        tables[name] = doses._replace(resets=resets) if index == 0 and resets.size else doses
    return tables


def _numbers(table: Table, columns: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Return the numbers (T,) of each role, zero where a cell is blank or there is no column."""
    zeros = np.zeros(len(table.frame))
    return {role: np.nan_to_num(table.numbers(columns[role])) if role in columns else zeros for role in ROLES}


def _check_amounts(table: Table, amounts: Mapping[str, np.ndarray]) -> None:
    for name, values in amounts.items():
        if (wrong := np.flatnonzero(values < 0)).size:
            raise ValueError(f"{table.location(wrong[0], name)}: the dose {values[wrong[0]]:g} is negative; write an "
                             "amount above zero, or leave the cell blank where there is no dose.")


def _check_events(table: Table, columns: Mapping[str, str], rows: Mapping[str, np.ndarray],
                  has_amount: np.ndarray) -> None:
    """Raise ValueError for the first row with an event that is not read."""
    evid, is_dose = rows["EVID"], np.isin(rows["EVID"], (1, 4))
    rate, duration, additional = rows["RATE"], rows["DUR"], rows["ADDL"]
    is_infused = (rate != 0) | (duration != 0)
    problems = {
        "EVID": [(~np.isin(evid, range(5)), "EVID must be 0 (observation), 1 (dose), 2 (neither), 3 (reset) or 4 "
                                            "(reset and dose)"),
                 ((evid == 2) & (has_amount | is_infused), "EVID 2 with a dose has another meaning here; write EVID 1 "
                                                           "for a dose"),
                 (np.isin(evid, (0, 3)) & has_amount, "this EVID has no dose, and the row has one; write EVID 1 (a "
                                                      "dose) or 4 (a reset and a dose)"),
                 (is_dose & ~has_amount, "this EVID is a dose, and the row has no amount")],
        "SS": [(is_dose & (rows["SS"] != 0), "doses in a steady state (SS) are not read; write the earlier doses as "
                                             "rows, with ADDL and II, so long before that the state forgets its "
                                             "start")],
        "RATE": [(is_dose & np.isin(rate, (-1, -2)), "a RATE of -1 or -2 is a rate or duration to be estimated; build "
                                                     "lfm.Infusion(times, amounts, state, rate=...) in the model"),
                 (is_dose & (rate < 0), "the rate of an infusion must be above zero")],
        "DUR": [(is_dose & (duration < 0), "the duration of an infusion must be above zero"),
                (is_dose & (duration > 0) & (rate > 0), "RATE and DUR both give the length of the infusion; leave one "
                                                        "blank")],
        "ADDL": [(is_dose & ((additional < 0) | (additional % 1 != 0)), "ADDL must be the number of additional "
                                                                                  "doses"),
                 (is_dose & (additional > 0) & (rows["II"] <= 0), "ADDL needs the time between the doses in II")],
    }
    for role, cases in problems.items():
        for is_wrong, message in cases:
            if (wrong := np.flatnonzero(is_wrong)).size and role in columns:
                raise ValueError(f"{table.location(wrong[0], columns[role])}: {message}, got {rows[role][wrong[0]]:g}.")


def _doses_of_column(table: Table, name: str, way: str, times: np.ndarray, columns: Mapping[str, str],
                     rows: Mapping[str, np.ndarray], resets: np.ndarray, part: str) -> InputTable:
    """Return the doses in one column of amounts, with additional doses (ADDL) and lengths of infusions."""
    amounts = rows["AMT"]
    is_once = way.endswith(ONCE)
    way = way.removesuffix(ONCE)
    index = np.flatnonzero(amounts > 0)
    if is_once:
        if len(np.unique(amounts[index])) > 1:
            raise ValueError(f"{table.label}, column {name!r}{part}: it holds several amounts, so that it is not one "
                             f"dose that repeats; read it as {way.removeprefix(DOSE)!r} without {ONCE!r}.")
        index = index[:1]
    elif "EVID" not in columns and len(index) == len(amounts) >= _FEWEST_REPEATED and np.ptp(amounts) == 0:
        checks.warn(f"{table.label}, column {name!r}{part}: all {len(index)} rows hold the same dose, so that "
                    f"{len(index)} doses of {amounts[0]:g} are given, {amounts.sum():g} in all. If the column repeats "
                    f"one dose, given at the first time, say so: --events {name}:{way.removeprefix(DOSE)}{ONCE} "
                    f"(inputs={{{name!r}: '{way}{ONCE}'}}).")
    states = way.removeprefix(DOSE).split(",")
    compartment = _compartments(table, columns.get("CMT"), name, states, index)
    duration = np.where(rows["RATE"] > 0, amounts / np.where(rows["RATE"] > 0, rows["RATE"], 1.0), rows["DUR"])
    # A dose at once and an infusion, or infusions of different lengths, are events of their own.
    _, first = np.unique([times[index], compartment, duration[index]], axis=1, return_index=True)
    if "EVID" not in columns and len(first) < len(index):
        row = index[np.setdiff1d(np.arange(len(index)), first)[0]]
        raise ValueError(f"{table.location(row, name)}: there are two doses at one time; write their sum in one row.")
    count = rows["ADDL"][index].astype(int) + 1
    source = np.repeat(index, count)
    repetition = np.arange(len(source)) - np.repeat(np.cumsum(count) - count, count)
    dose_times = times[source] + repetition * rows["II"][source]
    order = np.argsort(dose_times, kind="stable")
    source, dose_times, compartment = source[order], dose_times[order], np.repeat(compartment, count)[order]
    values, durations = amounts[source], duration[source]
    values, durations = end_at_resets(dose_times, values, durations, resets)
    return InputTable(dose_times, values, way, durations if durations.any() else None,
                      compartment if len(states) > 1 else None)


def _compartments(table: Table, column: str | None, name: str, states: list[str], index: np.ndarray) -> np.ndarray:
    """Return the indices in ``states`` of the states that receive the doses in rows ``index``; blank is the first."""
    compartments = np.zeros(len(index), int)
    if column is None:
        return compartments
    for position, row in enumerate(index):
        cell = table.frame[column].iloc[row]
        if is_missing(cell):
            continue
        text = str(cell).strip()
        if text in states:
            compartments[position] = states.index(text)
            continue
        try:
            number = float(text)
        except ValueError:
            number = np.nan
        if number % 1 != 0 or not 0 <= number <= len(states):
            raise ValueError(f"{table.location(row, column)}: the compartment {text} is none of the {len(states)} "
                             f"states that receive doses, {', '.join(states)}. Name the states in the order of their "
                             f"numbers: --events {name}:STATE,STATE (inputs={{{name!r}: '{DOSE}STATE,STATE'}}).")
        compartments[position] = max(int(number) - 1, 0)
    return compartments
