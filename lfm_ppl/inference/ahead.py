"""Compile what comes next while something else runs."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Sequence

from jax.stages import Lowered


class Ahead:
    """Programs that a thread compiles; as long as this lives, calls of their functions find them compiled.

    XLA compiles without Python's lock. Tracing is done before, in the thread of the caller: NumPyro's handlers are
    global. Whatever fails here fails again, and is told, where the program is called.

    Args:
        lower: traces and lowers the programs.
    """

    def __init__(self, lower: Callable[[], Sequence[Lowered]]) -> None:
        self._lowered: Sequence[Lowered] = ()
        with contextlib.suppress(Exception):
            self._lowered = lower()
        self._thread = threading.Thread(target=self._compile, name="compile ahead")
        self._thread.start()

    def _compile(self) -> None:
        for one in self._lowered:
            with contextlib.suppress(Exception):
                one.compile()

    def wait(self) -> None:
        """Return when all are compiled."""
        self._thread.join()


def worthwhile() -> bool:
    """Whether there is a CPU besides the one that is busy."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0)) > 1
    return (os.cpu_count() or 1) > 1
