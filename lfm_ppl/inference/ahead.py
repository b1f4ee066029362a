"""Compile what comes next while something else runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait

from jax.stages import Lowered

from lfm_ppl import compilation
from lfm_ppl.inference.interruption import was_interrupt


class Ahead:
    """A thread that compiles programs, one after another; as long as this lives, their functions find them compiled.

    XLA compiles without Python's lock. Tracing is done before, in the thread of the caller: NumPyro's handlers are
    global. Where there is one CPU alone nothing is done ahead.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "compile ahead") if compilation.cpus() > 1 else None
        self._lowered: list[Lowered] = []

    def add(self, lower: Callable[[], Sequence[Lowered]],
            wanted: Callable[[], bool] = lambda: True) -> Callable[[], None]:
        """Compile programs after those that were added before, and return a function that waits until they are.

        Whatever fails here fails again, and is told, where the program is called.

        Args:
            lower: traces and lowers the programs, at once.
            wanted: called after tracing; where it returns False, nothing is compiled.
        """
        if self._thread is None:
            return lambda: None
        found: Sequence[Lowered] = ()
        try:
            lowered = lower()
            found = lowered if wanted() else ()
        except Exception as error:
            if was_interrupt(error):
                raise KeyboardInterrupt from error
        self._lowered += found
        begun = [self._thread.submit(one.compile) for one in found]

        def ready() -> None:
            wait(begun)  # an exception stays in them

        return ready

    def close(self) -> None:
        """Compile nothing more than what was begun; no one may wait for the rest afterwards."""
        if self._thread is not None:
            self._thread.shutdown(wait=False, cancel_futures=True)
