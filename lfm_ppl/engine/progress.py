"""How far a run of tasks is."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import TextIO

from lfm_ppl.utils.progress import Clock, bar, duration, on_terminal


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
        return Bar(total, stored, file) if on_terminal(file) and stored < total else Progress(total, stored, self)


class Progress:
    """Lines such as ``12/40 state/EKF/003, 2 min left``: for the first task and the last, and every 30 s between.

    Args:
        total: number of tasks.
        stored: those that are there already.
        report: what to do with a line; None: nothing.
    """

    def __init__(self, total: int, stored: int, report: Callable[[str], None] | None) -> None:
        self.total, self.missing, self.report = total, total - stored, report
        self.finished, self.started, self._clock = 0, time.perf_counter(), Clock(at_once=True)
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
        if not self._clock.due() and self.finished < self.missing:
            return
        left = (time.perf_counter() - self.started) / self.finished * (self.missing - self.finished)
        count = self.total - self.missing + self.finished
        self.say(f"{count}/{self.total} {name}" + (f", {duration(left)} left" if self.finished < self.missing else ""))

    def close(self) -> None:
        """End it."""


class Bar(Progress):
    """The same as a bar of tqdm."""

    def __init__(self, total: int, stored: int, file: TextIO) -> None:
        self.bar = bar(total, stored, file, unit="task", dynamic_ncols=True)
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
