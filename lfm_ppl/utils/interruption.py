"""Ctrl-C and SIGTERM: end the present block of draws first.

1. While chains run, `Interruption` turns the first signal into a request to stop after the block; a second one raises
   KeyboardInterrupt.
2. Commands run inside `interruptible`, which adds to the message what to do next.

Python calls signal handlers between two of its instructions: not before compiled code returns.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

INTERRUPTED = 130
"""Exit status of a program that a signal has ended (128 + SIGINT)."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interruption:
    """Context in which Ctrl-C is a request to stop after a call of `defer`; a second one raises KeyboardInterrupt.

    It replaces only Python's own handler (``signal.default_int_handler``), in the main thread; other handlers stay. The
    command line sets Python's handler for SIGTERM, too.

    Attributes:
        requests: number of signals. Signals that raise KeyboardInterrupt count, too, because Python drops an exception
            that is raised within a callback of the garbage collector, and JAX has such a callback.
    """

    def __init__(self) -> None:
        self.requests = 0
        self._is_deferring = False
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
        self._is_deferring = True

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.requests += 1
        if self.requests > 1 or not self._is_deferring:
            raise KeyboardInterrupt
        print("\nstopping after this block of draws; once more to stop without it", file=sys.stderr, flush=True)


@contextlib.contextmanager
def interruptible(last_words: Callable[[], str] | None = None) -> Iterator[None]:
    """Raise KeyboardInterrupt for SIGTERM and for errors that libraries make of it.

    Args:
        last_words: returns the end of the message, such as the command that resumes a run.
    """
    is_default = signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    if is_default and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    except (KeyboardInterrupt, Exception) as error:
        if not was_interrupt(error):
            raise
        message = str(error) if isinstance(error, KeyboardInterrupt) else ""
        if last_words is not None:
            message = f"{message or 'interrupted'}; {last_words()}"
        raise KeyboardInterrupt(message) from error
    finally:
        if is_default and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def was_interrupt(error: BaseException | None) -> bool:
    """Return whether an error is Ctrl-C or was caused by it.

    JAX raises an error of its own, with the name of the exception in its text, if Ctrl-C comes while it compares two
    keys of a cache.

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
