"""CPU time of a computation."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax


def time_call(run: Callable, *arguments: Any) -> tuple[float, Any]:
    """Return the CPU seconds of a call, summed over all threads, and its value.

    Unlike wall-clock time, CPU time does not depend on other programs on the same machine.
    """
    start = time.process_time()
    value = run(*arguments)
    jax.block_until_ready(jax.tree.leaves(value))
    return time.process_time() - start, value


def time_compiled_call(label: str, run: Callable[[], Any]) -> tuple[float, Any]:
    """Return CPU seconds and value of a call, without compilation.

    The first call with a label is made twice and timed the second time.
    """
    if label not in _compiled_labels:
        time_call(run)
        _compiled_labels.add(label)
    return time_call(run)


_compiled_labels: set[str] = set()
