"""Doses in data files, in the columns of NONMEM's event records.

1. A column of amounts is read as doses to one or several states, "dose:STATE,STATE". Columns named EVID, MDV, ADDL, II,
   CMT, RATE, DUR and SS, in any case, or given these roles, describe the doses of each row.
2. EVID 0 is an observation, 1 a dose, 2 neither, 3 a reset of all states to zero, 4 a reset and a dose. Without EVID
   every row with an amount is a dose.
3. The output of a row is not observed where EVID or MDV is not 0.
4. ADDL is the number of further doses, at distances of II. RATE or DUR make an infusion of a dose, which ends at a
   reset. CMT is the number of the state, in the order given, or its name.
5. What has no meaning here, or another one, is refused: SS, a RATE of -1 or -2, EVID 2 with a dose.

Source: Beal, Sheiner, Boeckmann and Bauer (2009), NONMEM User's Guides, part VI, chapter V.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from lfm_ppl.io.data_set import DOSE, ONCE, InputTable, end_at_resets
from lfm_ppl.io.missing_codes import warn_of_codes
from lfm_ppl.io.table import Table, is_missing
from lfm_ppl.utils import checks

ROLES = ("EVID", "MDV", "ADDL", "II", "CMT", "RATE", "DUR", "SS")
"""Names of the columns that describe events."""

_FEWEST_REPEATED = 3
"""Number of rows from which equal doses in all of them are suspect."""


def event_columns(table: Table, ways: Mapping[str, str], outputs: Collection[str]) -> dict[str, str]:
    """Return the columns that describe events: role -> column.

    Args:
        table: the data.
        ways: columns of known inputs -> how they are read, or their role.
        outputs: columns that are outputs, which have no role by their name.
    """
    by_way = {way: name for name, way in ways.items() if way in ROLES}
    by_name = {name.upper(): name for name in table.frame
             if name.upper() in ROLES and name not in ways and name not in outputs}
    return {**by_name, **by_way}


def is_unobserved(table: Table, columns: Mapping[str, str]) -> np.ndarray:
    """Return whether the outputs of a row are no observations, (T,)."""
    numbers = _numbers(table, {role: columns[role] for role in ("EVID", "MDV") if role in columns})
    return (numbers["EVID"] != 0) | (numbers["MDV"] != 0)


def read_doses(table: Table, ways: Mapping[str, str], times: np.ndarray, columns: Mapping[str, str],
               part: str = "") -> dict[str, InputTable]:
    """Return the doses by their column of amounts. Resets belong to the first column.

    Args:
        table: the data.
        ways: columns of amounts -> "dose:STATE,...".
        times: (T,), of the rows.
        columns: role -> column, from `event_columns`.
        part: name of the series in messages.

    Raises:
        ValueError: a row says something that is not read, or contradicts itself; the message names it.
    """
    cells = {name: table.numbers(name) for name in ways}
    for name, numbers in cells.items():
        warn_of_codes(table, name, numbers)
    amounts = {name: np.nan_to_num(numbers) for name, numbers in cells.items()}
    if "CMT" in columns and len(ways) > 1:
        raise ValueError(f"{table.label}: the column {columns['CMT']!r} says which state receives a dose, and there "
                         f"are doses in several columns, {', '.join(ways)}. Give the states of one column: "
                         f"{next(iter(ways))}:STATE,STATE.")
    rows = _numbers(table, {role: column for role, column in columns.items() if role != "CMT"})
    has_amount = np.any([values != 0 for values in amounts.values()], axis=0)
    _check_amounts(table, amounts)
    if "EVID" not in columns:
        rows["EVID"] = np.where(has_amount, 1.0, 0.0)
    _check_events(table, columns, rows, has_amount)
    resets = np.unique(times[np.isin(rows["EVID"], (3, 4))])
    tables = {}
    for index, (name, way) in enumerate(ways.items()):
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
    rate, duration, further = rows["RATE"], rows["DUR"], rows["ADDL"]
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
        "ADDL": [(is_dose & ((further < 0) | (further % 1 != 0)), "ADDL must be the number of further doses"),
                 (is_dose & (further > 0) & (rows["II"] <= 0), "ADDL needs the time between the doses in II")],
    }
    for role, cases in problems.items():
        for is_wrong, message in cases:
            if (wrong := np.flatnonzero(is_wrong)).size and role in columns:
                raise ValueError(f"{table.location(wrong[0], columns[role])}: {message}, got {rows[role][wrong[0]]:g}.")


def _doses_of_column(table: Table, name: str, way: str, times: np.ndarray, columns: Mapping[str, str],
                     rows: Mapping[str, np.ndarray], resets: np.ndarray, part: str) -> InputTable:
    """Return the doses in one column of amounts, with further doses (ADDL) and lengths of infusions."""
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
    is_repeated = (times[index[1:]] == times[index[:-1]]) & (compartment[1:] == compartment[:-1])
    if "EVID" not in columns and is_repeated.any():
        row = index[1:][is_repeated][0]
        raise ValueError(f"{table.location(row, name)}: there are two doses at one time; write their sum in one row.")
    count = rows["ADDL"][index].astype(int) + 1
    source = np.repeat(index, count)
    further = np.arange(len(source)) - np.repeat(np.cumsum(count) - count, count)
    dose_times = times[source] + further * rows["II"][source]
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
