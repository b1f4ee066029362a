"""Ctrl-C while compiled code runs, which Python would hear of only at its end."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator

from lfm_ppl.inference.interruption import LISTENERS, was_interrupt

INTERRUPTED = 130
"""Exit status of a program that a signal has ended (128 + SIGINT)."""

_PATIENCE_S = 7.0
"""Time to end by oneself after Ctrl-C: a block of draws takes two seconds, a compilation may take a minute."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Watch:
    """Ends the process where the main thread does not, some seconds after Ctrl-C, and at once after a second one.

    Python's own handlers run in the main thread, between two of its instructions, and so not before a call of compiled
    code returns. What it writes to the wakeup socket comes at once, to a thread that waits there.
    """

    def __init__(self, last_words: Callable[[], str]) -> None:
        self._last_words = last_words
        self._answered = threading.Event()
        self._lock = threading.Lock()
        self._ends, self._hears = socket.socketpair()
        self._ends.setblocking(False)  # Python asks for it; the other end waits
        self._thread = threading.Thread(target=self._wait, daemon=True)

    @property
    def wakeup(self) -> int:
        """File descriptor for ``signal.set_wakeup_fd``."""
        return self._ends.fileno()

    def answered(self) -> None:
        """Say that the main thread has heard of it and is about to end: give it all the time that it needs."""
        self._answered.set()

    def start(self) -> None:
        """Wait for signals."""
        self._thread.start()

    def stop(self) -> None:
        """Wait no longer."""
        self.answered()
        self._ends.close()  # the other end reads nothing, and the thread returns
        self._thread.join()
        self._hears.close()

    def _wait(self) -> None:
        heard = 0
        while received := self._hears.recv(64):
            heard += sum(number in _SIGNALS for number in received)
            if heard == 1:
                threading.Thread(target=self._end_unless_answered, daemon=True).start()
            elif heard > 1:
                self._end("stopped at once")

    def _end_unless_answered(self) -> None:
        if not self._answered.wait(_PATIENCE_S):
            self._end("stopped")

    def _end(self, how: str) -> None:
        with self._lock:  # held to the end: it is said once
            sys.stdout.flush()
            print(f"\nlfm-ppl: {how}; {self._last_words()}", file=sys.stderr, flush=True)
            os._exit(INTERRUPTED)


@contextlib.contextmanager
def watched(last_words: Callable[[], str]) -> Iterator[Watch | None]:
    """Let Ctrl-C and SIGTERM end the process within seconds, whatever compiled code is running.

    Both raise KeyboardInterrupt, unless `lfm_ppl.inference.interruption` takes them as a request; so do errors that
    libraries make of it.

    Args:
        last_words: what to say where the process has to be ended from outside.

    Yields:
        The watch; None outside the main thread, which alone receives signals.
    """
    if threading.current_thread() is not threading.main_thread():
        yield None
        return
    watch = Watch(last_words)
    terminate = signal.getsignal(signal.SIGTERM)
    if terminate is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    previous_wakeup = signal.set_wakeup_fd(watch.wakeup, warn_on_full_buffer=False)
    watch.start()
    LISTENERS.append(watch.answered)
    try:
        yield watch
    except Exception as error:
        if was_interrupt(error):
            raise KeyboardInterrupt(f"interrupted; {last_words()}") from error
        raise
    finally:
        LISTENERS.remove(watch.answered)
        signal.set_wakeup_fd(previous_wakeup)
        signal.signal(signal.SIGTERM, terminate)
        watch.stop()
