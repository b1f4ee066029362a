"""How far a run of tasks is."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any, TextIO

from lfm_ppl import checks

EVERY_S = 30.0
"""Seconds between two lines of progress."""


class Console:
    """Progress on standard error: a bar with the time left in a terminal, a line every 30 s elsewhere.

    Args:
        file: another stream.
    """

    def __init__(self, file: TextIO | None = None) -> None:
        self.file = file

    def __call__(self, line: str) -> None:
        """Write a line."""
        print(line, file=self.file or sys.stderr, flush=True)

    def begin(self, total: int, stored: int) -> Progress:
        """Return the progress of a run."""
        file = self.file or sys.stderr
        return Bar(total, stored, file) if file.isatty() and stored < total else Progress(total, stored, self)


class Progress:
    """Lines such as ``12/40 state/EKF/003, 2 min left``: for the first task and the last, and every 30 s between.

    Args:
        total: number of tasks.
        stored: those that are there already.
        report: what to do with a line; None: nothing.
    """

    def __init__(self, total: int, stored: int, report: Callable[[str], None] | None) -> None:
        self.total, self.missing, self.report = total, total - stored, report
        self.finished, self.started, self.last = 0, time.perf_counter(), -float("inf")
        if stored:
            self.say(f"{stored} of {total} tasks are stored already")

    def say(self, line: str) -> None:
        """Report what is no progress, such as a task that failed."""
        if self.report is not None:
            self.report(line)

    def begin(self) -> None:
        """Count the time from now: what computes is ready."""
        self.started = time.perf_counter()

    def done(self, name: str) -> None:
        """Count a task that ended."""
        self.finished += 1
        now = time.perf_counter()
        if now - self.last < EVERY_S and self.finished < self.missing:
            return
        self.last = now
        left = (now - self.started) / self.finished * (self.missing - self.finished)
        count = self.total - self.missing + self.finished
        self.say(f"{count}/{self.total} {name}" + (f", {duration(left)} left" if self.finished < self.missing else ""))

    def close(self) -> None:
        """End it."""


class Bar(Progress):
    """The same as a bar of tqdm."""

    def __init__(self, total: int, stored: int, file: TextIO) -> None:
        from tqdm import tqdm

        self.bar: Any = tqdm(total=total, initial=stored, file=file, unit="task", dynamic_ncols=True)
        super().__init__(total, stored, lambda line: self.bar.write(line, file=file))

    def begin(self) -> None:
        """Count the time from now."""
        self.bar.unpause()

    def done(self, name: str) -> None:
        """Count a task that ended."""
        self.bar.set_postfix_str(name, refresh=False)
        self.bar.update()

    def close(self) -> None:
        """Leave the bar where it is."""
        self.bar.close()


def duration(seconds: float) -> str:
    """Return a length of time in the words of a person.

    Example:
        >>> [duration(s) for s in (0.4, 42.0, 400.0, 8000.0)]
        ['0.4 s', '42 s', '7 min', '2.2 h']
    """
    checks.finite("seconds", seconds)
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
