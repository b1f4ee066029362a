"""Ctrl-C while chains run: the present block of draws ends first."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)

LISTENERS: list[Callable[[], None]] = []
"""Functions that are called when Ctrl-C becomes a request: the main thread is running and will stop soon."""


class Interruption:
    """Context in which Ctrl-C is a request to stop after a call of `defer`; a second one raises KeyboardInterrupt.

    It replaces only Python's own handler (``signal.default_int_handler``), in the main thread: any other handler is the
    user's choice. The command line sets Python's handler for SIGTERM, too.

    Attributes:
        requests: number of signals. Signals that raise KeyboardInterrupt count, too, because Python drops an exception
            that is raised within a callback of the garbage collector, and JAX has such a callback.
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
        """Let the present block end before the run stops, from now on."""
        self._deferring = True

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.requests += 1
        if self.requests > 1 or not self._deferring:
            raise KeyboardInterrupt
        for notify in LISTENERS:
            notify()
        print("\nstopping after this block of draws; once more to stop at once", file=sys.stderr, flush=True)


def was_interrupt(error: BaseException | None) -> bool:
    """Return whether an error is Ctrl-C or was caused by it.

    JAX raises an error of its own, with the name of the exception in its text, where Ctrl-C comes while it compares
    two keys of a cache.

    Example:
        >>> was_interrupt(KeyboardInterrupt()), was_interrupt(ValueError("x is negative"))
        (True, False)
    """
    visited: set[int] = set()  # a chain of errors may be a ring
    while error is not None and id(error) not in visited:
        visited.add(id(error))
        if isinstance(error, KeyboardInterrupt) or "KeyboardInterrupt" in str(error):
            return True
        error = error.__cause__ or error.__context__
    return False
