"""Counts of calls: read from a file or simulated, and the queue that they make."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from lfm_ppl import checks

FILE = "bank_calls.csv.gz"
WEEKDAYS = ("Monday", "Tuesday", "Wednesday", "Thursday", "Friday")
BIN = 5.0
"""Minutes of one count."""

OPEN = 168
"""Counts of a day: 7:00 to 21:00. A last count, of the five minutes after closing, is left out."""

DAY = BIN * OPEN
"""Minutes of a day: opening hours, joined to those of the day before."""

_STEPS = 200
"""Runge-Kutta steps for one count: the queue is right to 1e-6 customers at a service rate of 15 per minute."""

WARNED = 2.0
"""Hours for which more customers may come than are served before a warning says so."""


class OverloadWarning(UserWarning):
    """More customers come than are served, for hours."""


class Counts(NamedTuple):
    """Days of the call centre: ``dates`` (N,) datetime64[D], increasing, and ``calls`` (N, `OPEN`) by five minutes."""

    dates: np.ndarray
    calls: np.ndarray

    def on(self, weekday: str) -> Counts:
        """Return the days that are a certain weekday, one of `WEEKDAYS`; ValueError for another."""
        checks.one_of("weekday", weekday, WEEKDAYS)
        # 1 January 1970 was a Thursday.
        chosen = (self.dates.astype(int) + 3) % 7 == WEEKDAYS.index(weekday)
        return Counts(self.dates[chosen], self.calls[chosen])


def read(path: str | Path) -> Counts:
    """Read five-minute counts of whole days.

    Args:
        path: a CSV file, perhaps gzipped, with the columns DateTime (as 2003-03-03T07:00:00Z) and Calls; or a folder
            with one of the name `FILE`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a column is missing, a count is not a number or negative, a time cannot be read or is not in order,
            or a day does not have the counts of 7:00 to 21:00; with the row as an editor counts it.
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
    for column, wrong, expected in (("DateTime", np.isnat(times), "a time such as 2003-03-03T07:00:00Z"),
                                    ("Calls", ~(np.isfinite(calls) & (calls >= 0)), "a number of calls, zero or more"),
                                    ("DateTime", unordered, "a later time than before")):
        if wrong.any():
            index = int(np.argmax(wrong))
            raise ValueError(f"{path}, row {index + 2}, column {column!r}: expected {expected}, got "
                             f"{table[column][index]!r}.")
    days = times.astype("datetime64[D]")
    place = (times - days) / np.timedelta64(1, "m") / BIN - 7 * 60 / BIN
    opened = (place >= 0) & (place < OPEN)
    dates, sizes = np.unique(days[opened], return_counts=True)
    short, between = sizes != OPEN, place[opened] != np.round(place[opened])
    if short.any() or between.any() or not len(dates):
        what = f"{dates[short][0]} has {sizes[short][0]}" if short.any() else "some are at other times or missing"
        raise ValueError(f"{path}: every day needs {OPEN} counts, one for each five minutes from 7:00 to 21:00; "
                         f"{what}.")
    return Counts(dates, calls[opened].reshape(len(dates), OPEN))


def simulated(days: int, seed: int = 0) -> Counts:
    """Simulate Thursdays that look like those of a bank: Poisson counts about a profile that wanders."""
    checks.positive_integer("days", days)
    generator = np.random.default_rng(seed)
    hours = 7.0 + BIN / 60.0 * (np.arange(OPEN) + 0.5)
    shape = 14.0 + 42.0 / (1.0 + np.exp(-2.5 * (hours - 8.2))) / (1.0 + np.exp(0.8 * (hours - 17.0)))
    harmonics = np.arange(1, 5)[:, None] * 2 * np.pi * np.arange(OPEN) / OPEN
    waves = np.concatenate([np.ones((1, OPEN)), np.sin(harmonics), np.cos(harmonics)])
    wander, change = np.zeros(len(waves)), []
    for _ in range(days):  # a shape that keeps eight tenths of what it was a week before
        wander = 0.8 * wander + 0.6 * 0.03 * generator.normal(size=len(waves))
        change.append(wander @ waves)
    calls = generator.poisson(BIN * shape * np.exp(np.array(change)))
    return Counts(np.datetime64("2003-03-06") + 7 * np.arange(days), calls.astype(float))


def overload(arrivals: np.ndarray, service: np.ndarray) -> float:
    """Return the hours in which more customers come than are served."""
    return BIN / 60.0 * float((arrivals > service).sum())


def queue(arrivals: Any, service: Any, start: float = 0.0) -> np.ndarray:
    """Return the mean number of customers (N + 1,), the truth: at the start and at the ends of N counts.

    The equation dL/dt = -Omega L / (1 + L) + zeta is integrated finely, with arrivals zeta (N,) and the service rate
    Omega, a number or (N,), in customers/min, both constant within a count. Negative rates are refused (ValueError);
    an `OverloadWarning` says that more customers come than are served for over two hours, all in all.

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
    if (over := overload(zeta, omega)) > WARNED:
        warnings.warn(f"more customers come than are served for {over:.1f} h; the queue grows meanwhile.",
                      OverloadWarning, stacklevel=2)
    h, path = BIN / _STEPS, [float(start)]
    length = path[0]
    for a, b in zip(zeta.tolist(), omega.tolist(), strict=True):
        for _ in range(_STEPS):
            k1 = a - b * length / (1.0 + length)
            x = length + 0.5 * h * k1
            k2 = a - b * x / (1.0 + x)
            x = length + 0.5 * h * k2
            k3 = a - b * x / (1.0 + x)
            x = length + h * k3
            length += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + a - b * x / (1.0 + x))
        path.append(length)
    return np.array(path)
