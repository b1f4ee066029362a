"""How many computations of a kind are vectorised: all on an accelerator, few on a CPU.

XLA keeps what a loop carries in memory. A filter of sixty series, or draws, no longer fits into a CPU's cache, and each
of its small operations becomes a loop of its own: the gradient of a panel of 48 series takes four times as long with
`jax.vmap` as one series after another, trajectories of draws twice as long as in batches of four.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax

from lfm_ppl.utils import compilation

BATCH_SIZE = 4
"""Draws that a CPU computes in one batch."""

_FEW = 8
"""How many are vectorised at once on a CPU, too: one by one they would be no faster."""


def mapped(function: Callable[..., Any], *arguments: Any, batch_size: int = 1) -> Any:
    """Return ``function`` of each entry along the leading axis of ``arguments``, stacked.

    Args:
        function: to be vectorised.
        *arguments: pytrees of arrays with one leading axis.
        batch_size: how many entries a CPU computes at once, where there are more than a few of them; a divisor of
            their number.

    Example:
        >>> import jax.numpy as jnp
        >>> mapped(lambda a, b: a @ b, jnp.ones((3, 2)), jnp.ones((3, 2))).tolist()
        [2.0, 2.0, 2.0]
    """
    count = jax.tree_util.tree_leaves(arguments)[0].shape[0]
    if count <= _FEW or not on_cpu():
        return jax.vmap(function)(*arguments)
    if batch_size == 1:
        return jax.lax.map(lambda entry: function(*entry), arguments)
    # The batches of `jax.lax.map` itself fail where a result has no entries.
    batches = jax.tree_util.tree_map(lambda x: x.reshape(count // batch_size, batch_size, *x.shape[1:]), arguments)
    results = jax.lax.map(lambda batch: jax.vmap(function)(*batch), batches)
    return jax.tree_util.tree_map(lambda x: x.reshape(count, *x.shape[2:]), results)


def threads() -> int:
    """Return how many compiled programs should run side by side: one for each CPU, one on an accelerator.

    Within a ``with jax.enable_x64(...)`` it is one, too: other threads do not see that.
    """
    if not on_cpu() or compilation.one_thread() or (count := compilation.cpus()) == 1:
        return 1
    with ThreadPoolExecutor(1) as executor:
        return count if executor.submit(_double).result() == _double() else 1


def side_by_side(program: Callable[..., Any], arguments: Sequence[tuple], count: int) -> Generator[Any, None, None]:
    """Yield ``program(*one)`` for each of ``arguments``, in their order, computed by several threads.

    Args:
        program: compiled: tracing is for one thread alone.
        arguments: of each call.
        count: of threads.

    Example:
        >>> list(side_by_side(lambda a, b: a * b, [(2, 3), (4, 5)], 2))
        [6, 20]
    """
    if min(count, len(arguments)) <= 1:
        for call in arguments:
            yield program(*call)
        return
    with ThreadPoolExecutor(count, "side by side") as pool:
        futures = deque(pool.submit(program, *call) for call in arguments)
        try:
            while futures:
                yield futures.popleft().result()
        finally:  # after Ctrl-C what has not begun never does
            for later in futures:
                later.cancel()


def _double() -> bool:
    return jax.config.jax_enable_x64  # type: ignore[attr-defined]


def on_cpu() -> bool:
    """Whether JAX computes on a CPU."""
    return jax.default_backend() == "cpu"
