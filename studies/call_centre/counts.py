"""Counts of calls, read from a file or simulated, and the queue that follows from them.

1. Read counts of five minutes from a CSV file, and check that each day has all counts from 7:00 to 21:00 (`read`).
2. Without a file, simulate Poisson counts. Their log rate is a daily profile plus harmonics whose amplitudes follow a
   first-order autoregression from week to week (`simulate`).
3. Integrate the fluid approximation of a queue with one server, dL/dt = -Omega L / (1 + L) + zeta, by classical
   Runge-Kutta steps within each count (`queue`).

Source of the equation: Reece and others (2014), JMLR 15, section 8.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lfm_ppl.utils import checks

FILE = "bank_calls.csv.gz"
WEEKDAYS = ("Monday", "Tuesday", "Wednesday", "Thursday", "Friday")
BIN = 5.0
"""Length of a count (min)."""

COUNTS_PER_DAY = 168
"""Number of counts in a day, from 7:00 to 21:00. The count of the five minutes after closing is dropped."""

DAY = BIN * COUNTS_PER_DAY
"""Length of a day (min). Days are concatenated without the nights."""

_STEPS_PER_COUNT = 200
"""Runge-Kutta steps in one count; the error of the queue is below 1e-6 customers at a service rate of 15 per minute."""

OVERLOAD_HOURS = 2.0
"""Duration of overload (h), more arrivals than service, above which a warning is issued."""


class OverloadWarning(UserWarning):
    """More customers arrive than are served, for hours."""


@dataclass(frozen=True)
class CallCounts:
    """Days of the call centre.

    Attributes:
        dates: increasing dates (N,), datetime64[D].
        calls: number of calls (N, `COUNTS_PER_DAY`) in each five minutes.
    """

    dates: np.ndarray
    calls: np.ndarray

    def select_weekday(self, weekday: str) -> CallCounts:
        """Return the days of one weekday in `WEEKDAYS`; ValueError for another name."""
        checks.one_of("weekday", weekday, WEEKDAYS)
        # Days count from 1 January 1970, a Thursday.
        selection = (self.dates.astype(int) + 3) % 7 == WEEKDAYS.index(weekday)
        return CallCounts(self.dates[selection], self.calls[selection])


def read(path: str | Path) -> CallCounts:
    """Read five-minute counts of complete days.

    Args:
        path: CSV file, optionally gzipped, with the columns DateTime (as 2003-03-03T07:00:00Z) and Calls, or a folder
            with such a file, named `FILE`.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: a column is missing, a count is negative or not a number, a time cannot be read or is not later than
            the previous one, or a day lacks counts between 7:00 and 21:00. The message names the row of the file.
    """
    path = Path(path, FILE) if Path(path).is_dir() else Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}; give the folder of {FILE} (--data), or leave it out for "
                                "simulated counts.")
    table = pd.read_csv(path, dtype=str)
    for name in ("DateTime", "Calls"):
        if name not in table:
            raise ValueError(f"{path} has no column {name!r}; its columns are {', '.join(map(str, table.columns))}.")
    times = pd.to_datetime(table["DateTime"], errors="coerce", utc=True).dt.tz_localize(None).to_numpy()
    calls = pd.to_numeric(table["Calls"], errors="coerce").to_numpy(float)
    unordered = np.append(False, np.diff(times) <= np.timedelta64(0, "ns"))
    for column, is_invalid, expected in (
            ("DateTime", np.isnat(times), "a time such as 2003-03-03T07:00:00Z"),
            ("Calls", ~(np.isfinite(calls) & (calls >= 0)), "a number of calls, zero or more"),
            ("DateTime", unordered, "a later time than before")):
        if is_invalid.any():
            index = int(np.argmax(is_invalid))
            raise ValueError(f"{path}, row {index + 2}, column {column!r}: expected {expected}, got "
                             f"{table[column][index]!r}.")
    days = times.astype("datetime64[D]")
    slots = (times - days) / np.timedelta64(1, "m") / BIN - 7 * 60 / BIN
    is_open = (slots >= 0) & (slots < COUNTS_PER_DAY)
    dates, sizes = np.unique(days[is_open], return_counts=True)
    is_incomplete, is_off_grid = sizes != COUNTS_PER_DAY, slots[is_open] != np.round(slots[is_open])
    if is_incomplete.any() or is_off_grid.any() or not len(dates):
        reason = "some are at other times or missing"
        if is_incomplete.any():
            reason = f"{dates[is_incomplete][0]} has {sizes[is_incomplete][0]}"
        raise ValueError(f"{path}: every day needs {COUNTS_PER_DAY} counts, one for each five minutes from 7:00 to "
                         f"21:00; {reason}.")
    return CallCounts(dates, calls[is_open].reshape(len(dates), COUNTS_PER_DAY))


def simulate(days: int, seed: int = 0) -> CallCounts:
    """Simulate Thursdays of a bank: Poisson counts about a daily profile that varies from week to week."""
    checks.positive_integer("days", days)
    generator = np.random.default_rng(seed)
    hours = 7.0 + BIN / 60.0 * (np.arange(COUNTS_PER_DAY) + 0.5)
    profile = 14.0 + 42.0 / (1.0 + np.exp(-2.5 * (hours - 8.2))) / (1.0 + np.exp(0.8 * (hours - 17.0)))
    phases = np.arange(1, 5)[:, None] * 2 * np.pi * np.arange(COUNTS_PER_DAY) / COUNTS_PER_DAY
    harmonics = np.concatenate([np.ones((1, COUNTS_PER_DAY)), np.sin(phases), np.cos(phases)])
    amplitudes, log_changes = np.zeros(len(harmonics)), []
    for _ in range(days):  # an autoregression from week to week, with the coefficient 0.8
        amplitudes = 0.8 * amplitudes + 0.6 * 0.03 * generator.normal(size=len(harmonics))
        log_changes.append(amplitudes @ harmonics)
    calls = generator.poisson(BIN * profile * np.exp(np.array(log_changes)))
    return CallCounts(np.datetime64("2003-03-06") + 7 * np.arange(days), calls.astype(float))


def overload(arrivals: np.ndarray, service: np.ndarray) -> float:
    """Return the time (h) during which more customers arrive than are served."""
    return BIN / 60.0 * float((arrivals > service).sum())


def queue(arrivals: Any, service: Any, start: float = 0.0) -> np.ndarray:
    """Return the true mean number of customers (N + 1,), at the start and at the ends of N counts.

    The queue L solves dL/dt = -Omega L / (1 + L) + zeta, with arrivals zeta (N,) and the service rate Omega, a number
    or (N,), both in customers/min and constant within a count. Classical Runge-Kutta steps integrate the equation.
    Negative rates raise a ValueError, and overload for more than `OVERLOAD_HOURS` in total causes an `OverloadWarning`.

    Example:
        >>> f"{queue(np.full(60, 5.0), 10.0)[-1]:.4f}"
        '1.0000'
    """
    zeta = np.asarray(arrivals, float)
    omega = np.broadcast_to(np.asarray(service, float), zeta.shape)
    for name, values in (("arrivals", zeta), ("the service rate", omega), ("start", np.asarray(start, float))):
        checks.finite(name, values)
        if np.min(values, initial=0.0) < 0:
            raise ValueError(f"{name} must not be negative, got {np.min(values):g}.")
    if (hours := overload(zeta, omega)) > OVERLOAD_HOURS:
        warnings.warn(f"more customers come than are served for {hours:.1f} h; the queue grows meanwhile.",
                      OverloadWarning, stacklevel=2)
    h, path = BIN / _STEPS_PER_COUNT, [float(start)]
    length = path[0]
    for a, b in zip(zeta.tolist(), omega.tolist(), strict=True):
        for _ in range(_STEPS_PER_COUNT):
            k1 = a - b * length / (1.0 + length)
            x = length + 0.5 * h * k1
            k2 = a - b * x / (1.0 + x)
            x = length + 0.5 * h * k2
            k3 = a - b * x / (1.0 + x)
            x = length + h * k3
            length += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + a - b * x / (1.0 + x))
        path.append(length)
    return np.array(path)
