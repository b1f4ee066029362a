"""How far a computation is, on standard error: a bar where a line can be redrawn, a line every 30 s elsewhere."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any, TextIO

from lfm_ppl.utils import checks

EVERY_S = 30.0
"""Between two lines, where no terminal redraws one."""


_SHORTEST_S = 1.0
"""Least time between two lines of a thread, whatever `EVERY_S` is set to."""


def on_terminal(file: TextIO | None = None) -> bool:
    """Whether a line can be redrawn: on a terminal, or in a notebook."""
    return (file or sys.stderr).isatty() or (file is None and "ipykernel" in sys.modules)


def bar(total: int, done: int, file: TextIO | None = None, **options: Any) -> Any:
    """Return a bar of tqdm, ``done`` of ``total`` of which are there already."""
    from tqdm.auto import tqdm

    return tqdm(total=total, initial=done, file=file or sys.stderr, **options)


class Clock:
    """Says when the next line is due."""

    def __init__(self, at_once: bool = False) -> None:
        self._said = -float("inf") if at_once else time.perf_counter()

    def due(self) -> bool:
        """Whether `EVERY_S` have passed since it last was."""
        current_time = time.perf_counter()
        if current_time - self._said < EVERY_S:
            return False
        self._said = current_time
        return True


class Waiting:
    """Says every `EVERY_S`, until it is stopped, how long something has taken that tells nothing itself, a compilation.

    Args:
        text: what goes on.
    """

    def __init__(self, text: str) -> None:
        self._over, start_time = threading.Event(), time.perf_counter()

        def tell() -> None:
            while not self._over.wait(max(EVERY_S, _SHORTEST_S)):
                print(f"{text} ({duration(time.perf_counter() - start_time)} so far)", file=sys.stderr, flush=True)

        threading.Thread(target=tell, daemon=True).start()

    def stop(self) -> None:
        """Say nothing more."""
        self._over.set()


@contextlib.contextmanager
def waiting(text: str, is_shown: bool) -> Iterator[None]:
    """Say what begins, and as long as it lasts that it goes on; nothing where that is not ``shown``."""
    if not is_shown:
        yield
        return
    print(text, file=sys.stderr, flush=True)
    display = Waiting(text)
    try:
        yield
    finally:
        display.stop()


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
