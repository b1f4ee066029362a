"""What a computation costs."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax


def timed(run: Callable, *arguments: Any) -> tuple[float, Any]:
    """Return how many seconds of CPU time, of all threads, a call takes, and its value.

    Other programs on the same machine do not change it, as they would the time on the wall.
    """
    started = time.process_time()
    found = run(*arguments)
    jax.block_until_ready(jax.tree_util.tree_leaves(found))
    return time.process_time() - started, found


def timed_again(label: str, run: Callable[[], Any]) -> tuple[float, Any]:
    """Return the same of a call without arguments, which is made once before where none with this label was yet.

    What it compiles is not counted then.
    """
    if label not in _made:
        timed(run)
        _made.add(label)
    return timed(run)


_made: set[str] = set()
