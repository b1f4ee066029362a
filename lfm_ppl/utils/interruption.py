"""Ctrl-C and SIGTERM: end the present block of draws first, and end the process if compiled code does not return.

1. While chains run, `Interruption` turns the first signal into a request to stop after the block; a second one raises
   KeyboardInterrupt.
2. Python calls signal handlers between two of its instructions, and so not before compiled code returns. The command
   line therefore runs inside `watched`: Python writes each signal to a wakeup socket at once, and a thread that reads
   the socket ends the process after some seconds, or at a second signal.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

INTERRUPTED = 130
"""Exit status of a program that a signal has ended (128 + SIGINT)."""

_PATIENCE_S = 7.0
"""Seconds for the main thread to end after a signal: a block of draws takes two, a compilation may take a minute."""

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
        if Watch.current is not None:
            Watch.current.dismiss()
        print("\nstopping after this block of draws; once more to stop at once", file=sys.stderr, flush=True)


class Watch:
    """Thread that ends the process some seconds after a signal, unless it is dismissed, and at once after a second one.

    Args:
        last_words: returns the end of the message if the thread ends the process.
    """

    current: Watch | None = None

    def __init__(self, last_words: Callable[[], str]) -> None:
        self._last_words = last_words
        self._is_dismissed = threading.Event()
        self._lock = threading.Lock()
        self._writer, self._reader = socket.socketpair()
        self._writer.setblocking(False)  # as Python requires
        self._thread = threading.Thread(target=self._wait, daemon=True)

    @property
    def wakeup(self) -> int:
        """File descriptor for ``signal.set_wakeup_fd``."""
        return self._writer.fileno()

    def dismiss(self) -> None:
        """Give the main thread all the time that it needs: it has received the signal and is about to end."""
        self._is_dismissed.set()

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        self.dismiss()
        self._writer.close()  # the reader gets nothing, and the thread returns
        self._thread.join()
        self._reader.close()

    def _wait(self) -> None:
        count = 0
        while received := self._reader.recv(64):
            count += sum(number in _SIGNALS for number in received)
            if count == 1:
                threading.Thread(target=self._end_unless_dismissed, daemon=True).start()
            elif count > 1:
                self._end("stopped at once")

    def _end_unless_dismissed(self) -> None:
        if not self._is_dismissed.wait(_PATIENCE_S):
            self._end("stopped")

    def _end(self, reason: str) -> None:
        with self._lock:  # never released, so that the message appears once
            sys.stdout.flush()
            print(f"\nlfm-ppl: {reason}; {self._last_words()}", file=sys.stderr, flush=True)
            os._exit(INTERRUPTED)


@contextlib.contextmanager
def watched(last_words: Callable[[], str]) -> Iterator[Watch | None]:
    """Let Ctrl-C and SIGTERM end the process within seconds, also while compiled code runs.

    Both raise KeyboardInterrupt, unless `Interruption` takes them as a request. Errors that libraries make of
    KeyboardInterrupt become KeyboardInterrupt again.

    Args:
        last_words: returns the end of the message if the process has to be ended.

    Yields:
        The watch; None outside the main thread, which alone receives signals.
    """
    if threading.current_thread() is not threading.main_thread():
        yield None
        return
    watch, outer = Watch(last_words), Watch.current
    terminate = signal.getsignal(signal.SIGTERM)
    if terminate is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    outer_wakeup = signal.set_wakeup_fd(watch.wakeup, warn_on_full_buffer=False)
    watch.start()
    Watch.current = watch
    try:
        yield watch
    except Exception as error:
        if was_interrupt(error):
            raise KeyboardInterrupt(f"interrupted; {last_words()}") from error
        raise
    finally:
        Watch.current = outer
        signal.set_wakeup_fd(outer_wakeup)
        signal.signal(signal.SIGTERM, terminate)
        watch.stop()


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
