"""How far chains are, and what is computed at their draws."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from lfm_ppl.progress import Clock, Waiting, bar, duration, on_terminal

SURE_S = 60.0
"""Seconds of sampling before a warm-up is called slow: its first steps, of an untuned length, say little."""

LONG_S = 1200.0
"""Seconds from which on a run is long enough for advice."""

RECENT_S = 60.0
"""Seconds of which the pace is taken: steps before them, of the warm-up above all, may have cost much more or less."""


class Stage(NamedTuple):
    """How far chains are.

    Attributes:
        draws: of each chain, so far.
        samples: of each chain, in the end.
        divergences: of all chains.
        words: of the sampler.
    """

    draws: int
    samples: int
    divergences: int
    words: str


class Progress:
    """Shows steps of chains.

    Args:
        total: number of steps.
        done: those of an earlier run.
        shown: whether anything is shown.
        warmup: how many of the steps are warm-up.
        if_slow: what to say, once, of a warm-up at whose pace the whole takes longer than `LONG_S`.
    """

    def __init__(self, total: int, done: int, shown: bool, warmup: int = 0, if_slow: str = "") -> None:
        self._total, self._done, self._shown = total, done, shown
        self._warmup, self._if_slow = warmup, if_slow
        self._bar: Any = None
        self._began: float | None = None
        self._pace = _Remaining(total)
        self._clock = Clock()
        self._compiling: Waiting | None = None

    def __enter__(self) -> Progress:
        if self._shown and on_terminal():
            self._bar = bar(self._total, self._done)
            self._bar.set_postfix_str("compiling")
        elif self._shown:
            self._compiling = Waiting("compiling the sampler, and its first step")
        return self

    def __exit__(self, *error: Any) -> None:
        if self._bar is not None:
            self._bar.close()
        if self._compiling is not None:
            self._compiling.stop()

    def advance(self, done: int, stage: Callable[[], Stage]) -> None:
        """Show that so many steps are done; ``stage`` is asked only where it is shown."""
        now = time.perf_counter()
        self._pace.add(now, done)
        tuning = done < self._warmup
        if self._compiling is not None:
            self._compiling.stop()
        if self._bar is not None:
            what = stage()
            words = ("warm-up, " if tuning else "") + _divergences(what, ", ") + what.words
            self._bar.set_postfix_str(words, refresh=False)
            self._bar.update(done - self._done)
        elif self._shown and self._clock.due():
            what = stage()
            left = self._pace.words(" at the pace of the warm-up so far" if tuning else "")
            print(f"sampling {done:,} of {self._total:,} steps, {what.draws:,} of {what.samples:,} draws a chain, "
                  f"{_divergences(what, ', ')}{what.words}{left}", file=sys.stderr, flush=True)
        self._done = done
        if self._began is None:  # the steps before it came with the compilation
            self._began = now
        elif self._shown and self._if_slow and tuning and now - self._began > SURE_S:
            self._advise()

    def _advise(self) -> None:
        left = self._pace.left()
        if left is None or left < LONG_S:
            return
        text, self._if_slow = f"note     {self._if_slow}", ""
        if self._bar is None:
            print(text, file=sys.stderr, flush=True)
        else:
            self._bar.write(text, file=sys.stderr)


class _Remaining:
    """How long is left, at the pace of the last `RECENT_S`.

    Args:
        total: how many there are to do.
    """

    def __init__(self, total: int) -> None:
        self._total, self._seen = total, deque[tuple[float, int]]()

    def add(self, now: float, done: int) -> None:
        """Take note that so many are done; those before the first note say nothing of the pace."""
        self._seen.append((now, done))
        while len(self._seen) > 2 and self._seen[1][0] <= now - RECENT_S:
            self._seen.popleft()

    def left(self) -> float | None:
        """Return the seconds that are left; None where there is no pace yet."""
        if len(self._seen) < 2 or self._seen[-1][1] <= self._seen[0][1]:
            return None
        (began, before), (now, done) = self._seen[0], self._seen[-1]
        return (now - began) / (done - before) * (self._total - done)

    def words(self, how: str = "") -> str:
        """Return the time left as the end of a line; nothing where it is not known."""
        left = self.left()
        return "" if left is None else f"; about {duration(left)} left{how}"


class Counter:
    """Shows how many draws are done: ``counter(done, count)``.

    Args:
        label: what is computed at them.
        shown: whether anything is shown.
        at_once: whether to show at once that nothing is done yet, where compilation may take a while.
    """

    def __init__(self, label: str = "", shown: bool = True, at_once: bool = False) -> None:
        self._label, self._shown = label, shown
        self._clock = Clock(at_once)
        self._pace: _Remaining | None = None
        self._whole: _Remaining | None = None
        self._compiling: Waiting | None = None

    def of(self, label: str) -> Counter:
        """Return the counter, for something else."""
        self._label, self._pace, self._whole = label, None, None
        return self

    def __call__(self, done: int, count: int) -> None:
        """Show that ``done`` of ``count`` are done."""
        if not self._shown:
            return
        text = f"{self._label}: {done:,} of {count:,} draws{self._left(done, count)}"
        self._wait(f"{self._label}: compiling, and the first of {count:,} draws" if not done else "")
        if on_terminal():
            print(f"\r{text:<70}\r", end="", file=sys.stderr, flush=True)
        elif self._clock.due():
            print(text, file=sys.stderr, flush=True)

    def _left(self, done: int, count: int) -> str:
        now = time.perf_counter()
        if not done:
            self._whole = _Remaining(count)
            self._whole.add(now, done)
            return ""
        if self._pace is None:  # the first batch comes with the compilation, and begins the count
            self._pace = _Remaining(count)
            self._pace.add(now, done)
            if self._whole is None:
                return ""
            self._whole.add(now, done)
            return self._whole.words(" at most") if done < count else ""
        self._pace.add(now, done)
        return self._pace.words()

    def _wait(self, text: str) -> None:
        """Say every now and then that this goes on; nothing: stop saying it."""
        if self._compiling is not None:
            self._compiling.stop()
        self._compiling = Waiting(text) if text and not on_terminal() else None

    def close(self) -> None:
        """Leave an empty line on a terminal."""
        self._wait("")
        if self._shown and on_terminal():
            print(f"\r{'':<70}\r", end="", file=sys.stderr, flush=True)


def _divergences(stage: Stage, end: str) -> str:
    if not stage.divergences:
        return ""
    return f"{stage.divergences:,} divergence{'s' * (stage.divergences > 1)}{end}"
