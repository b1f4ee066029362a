"""Ctrl-C while chains run: the block of draws that is under way ends first."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)

LISTENERS: list[Callable[[], None]] = []
"""Called when a request is taken: the main thread runs, and will end by itself."""


class Interruption:
    """Within this context Ctrl-C is a request, once `defer` was called; a second one raises KeyboardInterrupt.

    It takes the place of Python's own handler alone (``signal.default_int_handler``), in the main thread: whoever has
    set another one wants something else. The command line sets Python's handler for SIGTERM, too.

    Attributes:
        requests: how often somebody has asked to stop. Counted also where KeyboardInterrupt is raised, because that may
            be lost: Python ignores what is raised within a callback of the garbage collector, of which JAX has one.
    """

    def __init__(self) -> None:
        self.requests = 0
        self._deferring = False
        self._replaced: list[int] = []

    def __enter__(self) -> Interruption:
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                if signal.getsignal(number) is signal.default_int_handler:
                    signal.signal(number, self._handle)
                    self._replaced.append(number)
        return self

    def __exit__(self, *error: Any) -> None:
        for number in self._replaced:
            signal.signal(number, signal.default_int_handler)

    def defer(self) -> None:
        """From now on there is something to lose: let the present block end before all stops."""
        self._deferring = True

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.requests += 1
        if self.requests > 1 or not self._deferring:
            raise KeyboardInterrupt
        for heard in LISTENERS:
            heard()
        print("\nstopping after this block of draws; once more to stop at once", file=sys.stderr, flush=True)


def was_interrupt(error: BaseException | None) -> bool:
    """Whether an error is Ctrl-C, or what a library made of it, as JAX does where two keys of a cache are compared.

    Example:
        >>> was_interrupt(KeyboardInterrupt()), was_interrupt(ValueError("x is negative"))
        (True, False)
    """
    seen: set[int] = set()  # a chain of errors may be a ring
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        if isinstance(error, KeyboardInterrupt) or "KeyboardInterrupt" in str(error):
            return True
        error = error.__cause__ or error.__context__
    return False
