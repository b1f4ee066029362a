"""Progress of chains and of computations at their draws, on standard error.

1. On a terminal or in a notebook a bar or one line is redrawn; elsewhere a line appears every 30 s.
2. The time left is extrapolated from the pace of the last minute, since steps of the warm-up may cost much more or less
   than later ones. The first block does not count: it includes the compilation.
3. A long warm-up prints advice once.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from lfm_ppl.inference.schedule import Schedule
from lfm_ppl.utils.progress import Clock, Waiting, bar, duration, on_terminal

SURE_S = 60.0
"""Seconds of sampling before a warm-up counts as slow: the length of its first steps is not tuned yet."""

LONG_S = 1200.0
"""Remaining seconds from which on a slow warm-up prints advice."""

RECENT_S = 60.0
"""Seconds over which the pace is measured."""


class ChainProgress:
    """Display of the steps of chains; a context manager.

    Args:
        schedule: of each chain.
        done: number of steps of an earlier run.
        is_shown: whether anything is printed.
        slow_warmup_hint: advice during a warm-up with more than `LONG_S` left; empty: none.
    """

    def __init__(self, schedule: Schedule, done: int, is_shown: bool, slow_warmup_hint: str = "") -> None:
        self._schedule, self._done, self._is_shown = schedule, done, is_shown
        self._slow_warmup_hint = slow_warmup_hint
        self._bar: Any = None
        self._first_block_end: float | None = None
        self._pace = _Pace(schedule.steps)
        self._clock = Clock()
        self._compilation: Waiting | None = None

    def __enter__(self) -> ChainProgress:
        if self._is_shown and on_terminal():
            self._bar = bar(self._schedule.steps, self._done)
            self._bar.set_postfix_str("compiling")
        elif self._is_shown:
            self._compilation = Waiting("compiling the sampler, and its first step")
        return self

    def __exit__(self, *error: Any) -> None:
        if self._bar is not None:
            self._bar.close()
        if self._compilation is not None:
            self._compilation.stop()

    def advance(self, done: int, describe: Callable[[], str]) -> None:
        """Show the number of finished steps; ``describe`` returns the state of the sampler and runs only if shown."""
        clock_time = time.perf_counter()
        self._pace.add(clock_time, done)
        is_warmup = done < self._schedule.warmup
        if self._compilation is not None:
            self._compilation.stop()
        if self._bar is not None:
            self._bar.set_postfix_str(("warm-up, " if is_warmup else "") + describe(), refresh=False)
            self._bar.update(done - self._done)
        elif self._is_shown and self._clock.due():
            time_left = self._pace.time_left(" at the pace of the warm-up so far" if is_warmup else "")
            print(f"sampling {done:,} of {self._schedule.steps:,} steps, {self._schedule.draws_after(done):,} of "
                  f"{self._schedule.samples:,} draws a chain, {describe()}{time_left}", file=sys.stderr, flush=True)
        self._done = done
        if self._first_block_end is None:
            self._first_block_end = clock_time
        elif self._is_shown and is_warmup and clock_time - self._first_block_end > SURE_S:
            self._advise()

    def _advise(self) -> None:
        seconds_left = self._pace.seconds_left()
        if not self._slow_warmup_hint or seconds_left is None or seconds_left < LONG_S:
            return
        text, self._slow_warmup_hint = f"note     {self._slow_warmup_hint}", ""
        if self._bar is None:
            print(text, file=sys.stderr, flush=True)
        else:
            self._bar.write(text, file=sys.stderr)


class _Pace:
    """Extrapolation of the time left from the last `RECENT_S`.

    Args:
        total: number of steps or draws.
    """

    def __init__(self, total: int) -> None:
        self._total, self._records = total, deque[tuple[float, int]]()

    def add(self, clock_time: float, done: int) -> None:
        """Record the number that is done; the first record is the start of the measurement."""
        self._records.append((clock_time, done))
        while len(self._records) > 2 and self._records[1][0] <= clock_time - RECENT_S:
            self._records.popleft()

    def seconds_left(self) -> float | None:
        """Return the seconds left; None before two records."""
        if len(self._records) < 2 or self._records[-1][1] <= self._records[0][1]:
            return None
        (first_time, first_done), (last_time, last_done) = self._records[0], self._records[-1]
        return (last_time - first_time) / (last_done - first_done) * (self._total - last_done)

    def time_left(self, qualifier: str = "") -> str:
        """Return the time left as the end of a line; empty where it is unknown."""
        seconds = self.seconds_left()
        return "" if seconds is None else f"; about {duration(seconds)} left{qualifier}"


class Counter:
    """Display of the number of finished draws: ``counter(done, count)``.

    Args:
        label: name of the computation.
        is_shown: whether anything is printed.
        at_once: whether the first line is due at once, before a long compilation.
    """

    def __init__(self, label: str = "", is_shown: bool = True, at_once: bool = False) -> None:
        self._label, self._is_shown = label, is_shown
        self._clock = Clock(at_once)
        self._pace: _Pace | None = None
        self._pace_with_compilation: _Pace | None = None
        self._compilation: Waiting | None = None

    def restart(self, label: str) -> Counter:
        """Return the counter, started anew for another computation."""
        self._label, self._pace, self._pace_with_compilation = label, None, None
        return self

    def __call__(self, done: int, count: int) -> None:
        """Show that ``done`` of ``count`` draws are finished."""
        if not self._is_shown:
            return
        text = f"{self._label}: {done:,} of {count:,} draws{self._time_left(done, count)}"
        self._show_compilation(f"{self._label}: compiling, and the first of {count:,} draws" if not done else "")
        if on_terminal():
            print(f"\r{text:<70}\r", end="", file=sys.stderr, flush=True)
        elif self._clock.due():
            print(text, file=sys.stderr, flush=True)

    def _time_left(self, done: int, count: int) -> str:
        clock_time = time.perf_counter()
        if not done:
            self._pace_with_compilation = _Pace(count)
            self._pace_with_compilation.add(clock_time, done)
            return ""
        if self._pace is None:  # the first batch includes the compilation
            self._pace = _Pace(count)
            self._pace.add(clock_time, done)
            if self._pace_with_compilation is None:
                return ""
            self._pace_with_compilation.add(clock_time, done)
            return self._pace_with_compilation.time_left(" at most") if done < count else ""
        self._pace.add(clock_time, done)
        return self._pace.time_left()

    def _show_compilation(self, text: str) -> None:
        """Repeat a text until the next call, where no terminal redraws a line; empty: stop."""
        if self._compilation is not None:
            self._compilation.stop()
        self._compilation = Waiting(text) if text and not on_terminal() else None

    def close(self) -> None:
        """Clear the line on a terminal."""
        self._show_compilation("")
        if self._is_shown and on_terminal():
            print(f"\r{'':<70}\r", end="", file=sys.stderr, flush=True)
