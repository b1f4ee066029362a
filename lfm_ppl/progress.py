"""How far a computation is, on standard error: a bar where a line can be redrawn, a line every 30 s elsewhere."""

from __future__ import annotations

import sys
import time
from typing import Any, TextIO

from lfm_ppl import checks

EVERY_S = 30.0
"""Between two lines, where no terminal redraws one."""


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
        now = time.perf_counter()
        if now - self._said < EVERY_S:
            return False
        self._said = now
        return True


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
