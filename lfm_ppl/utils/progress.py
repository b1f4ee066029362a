"""Progress of chains, draws and tasks: one display for all.

1. A `Console` shows a bar of tqdm on a terminal or in a notebook. Elsewhere it gets a line every 30 s.
2. While a program compiles, which cannot report its progress, the line is repeated with the time so far.
3. The time left is extrapolated from the pace of the last minute, since the steps of a warm-up may cost much more or
   less than later ones. For tasks on several workers it follows from the median duration of the tasks that have ended.
"""

from __future__ import annotations

import contextlib
import statistics
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, Self, TextIO

from lfm_ppl.utils import checks

EVERY_S = 30.0
"""Seconds between two lines, where no terminal redraws one."""

_SHORTEST_S = 1.0
"""Least time between two lines of a thread, whatever `EVERY_S` is set to."""

_PACE_S = 60.0
"""Seconds over which the pace is measured."""

_LEAST_STEPS = 2
"""Fewest steps, draws or tasks whose pace is extrapolated: the first one may compile."""


class Console:
    """Standard error as the target of a `Progress`.

    Args:
        file: another stream.
    """

    def __init__(self, file: TextIO | None = None) -> None:
        self.file = file

    def __call__(self, line: str) -> None:
        """Write a line."""
        print(line, file=self.file or sys.stderr, flush=True)

    @property
    def is_terminal(self) -> bool:
        """Whether a line can be redrawn: on a terminal, or in a notebook."""
        return (self.file or sys.stderr).isatty() or (self.file is None and "ipykernel" in sys.modules)


Reporter = Callable[[str], None] | Console
"""Function that is called with each line of progress. A `Console` shows a bar on a terminal."""


class Progress:
    """Display of a number that grows to a total; a context manager.

    Args:
        report: target of the lines; None: nothing is shown.
        total: number of steps, draws or tasks.
        unit: plural of what is counted.
        label: name of the computation.
        done: number that an earlier run finished.
    """

    def __init__(self, report: Reporter | None, total: int, unit: str, label: str, done: int = 0) -> None:
        self._report, self._total, self._unit, self._label, self._done = report, total, unit, label, done
        self._records: deque[tuple[float, int]] = deque()
        self._includes_compilation = False
        self._last_line = -float("inf")
        self._compilation: _RepeatedLine | None = None
        self._bar: Any = None
        if isinstance(report, Console) and report.is_terminal and done < total:
            from tqdm.auto import tqdm

            # Without the time left of tqdm, which follows the last steps alone.
            self._bar = tqdm(total=total, initial=done, desc=label, file=report.file or sys.stderr, dynamic_ncols=True,
                             bar_format="{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}{postfix}]")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        if self._compilation is not None:
            self._compilation.stop()
        if self._bar is not None:
            self._bar.close()

    def start(self) -> None:
        """Measure the pace from now."""
        self._records.append((time.perf_counter(), self._done))

    def compile(self, text: str) -> None:
        """Show that a program is being compiled, until the next call of `advance`."""
        self._includes_compilation = True
        if self._bar is not None:
            self._bar.set_postfix_str("compiling")
        elif isinstance(self._report, Console):
            self._compilation = _RepeatedLine(f"{self._label}: {text}", self._report)

    def advance(self, done: int, text: str = "", qualifier: str = "") -> None:
        """Show the number that is done.

        Args:
            done: the number.
            text: state of the computation.
            qualifier: added to the time left.
        """
        if self._compilation is not None:
            self._compilation.stop()
        self._records.append((time.perf_counter(), done))
        while len(self._records) > 2 and self._records[1][0] <= self._records[-1][0] - _PACE_S:
            self._records.popleft()
        seconds = self.seconds_left()
        if seconds:
            qualifier = " at most" if self._includes_compilation and len(self._records) > 1 else qualifier
            text += f"; about {duration(seconds)} left{qualifier}"
        if self._bar is not None:
            self._bar.set_postfix_str(text.removeprefix("; "), refresh=False)
            self._bar.update(done - self._done)
        elif self._report is not None and (self._is_due() or done == self._total):
            separator = ", " if text and not text.startswith(";") else ""
            self._report(f"{self._label}: {done:,} of {self._total:,} {self._unit}{separator}{text}")
        if self._includes_compilation:
            self._includes_compilation = False
            self._records = deque([self._records[-1]])
        self._done = done

    def write(self, line: str) -> None:
        """Write a line that is not about progress, such as a task that failed."""
        if self._bar is not None:
            self._bar.write(line, file=self._bar.fp)
        elif self._report is not None:
            self._report(line)

    def seconds_left(self) -> float | None:
        """Return the seconds left; None before the pace of `_LEAST_STEPS` is measured."""
        if len(self._records) < 2 or self._records[-1][1] < self._records[0][1] + _LEAST_STEPS:
            return None
        (first_time, first_done), (last_time, last_done) = self._records[0], self._records[-1]
        return (last_time - first_time) / (last_done - first_done) * (self._total - last_done)

    def _is_due(self) -> bool:
        clock_time = time.perf_counter()
        if clock_time - self._last_line < EVERY_S:
            return False
        self._last_line = clock_time
        return True


class TaskProgress(Progress):
    """Display of tasks that several workers compute.

    The time left follows from the median duration of the tasks that have ended. The first tasks compile and take
    longer: the median forgets them, where a mean would jump.
    """

    def __init__(self, report: Reporter | None, total: int, done: int) -> None:
        super().__init__(report, total, "tasks", "computed", done)
        self._durations: list[float] = []
        self._workers = 1

    def end_task(self, name: str, seconds: float | None, workers: int) -> None:
        """Count a task that has ended.

        Args:
            name: name of the task.
            seconds: its duration; None after a failure.
            workers: number of workers.
        """
        self._durations += [] if seconds is None else [seconds]
        self._workers = workers
        self.advance(self._done + 1, name)

    def seconds_left(self) -> float | None:
        """Return the seconds left; None until as many tasks as workers have ended, and two."""
        if len(self._durations) < max(self._workers, _LEAST_STEPS):
            return None
        return statistics.median_low(self._durations) * (self._total - self._records[-1][1]) / self._workers


class _RepeatedLine:
    """A line that is written again every `EVERY_S`, with the time so far, until it is stopped."""

    def __init__(self, text: str, report: Reporter) -> None:
        self._stopped, start_time = threading.Event(), time.perf_counter()

        def repeat() -> None:
            while not self._stopped.wait(max(EVERY_S, _SHORTEST_S)):
                report(f"{text} ({duration(time.perf_counter() - start_time)} so far)")

        threading.Thread(target=repeat, daemon=True).start()

    def stop(self) -> None:
        """Write nothing more."""
        self._stopped.set()


@contextlib.contextmanager
def waiting(text: str, is_shown: bool) -> Iterator[None]:
    """Write a line, and repeat it with the time so far until the block ends."""
    if not is_shown:
        yield
        return
    console = Console()
    console(text)
    line = _RepeatedLine(text, console)
    try:
        yield
    finally:
        line.stop()


def duration(seconds: float) -> str:
    """Return a duration as text.

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
