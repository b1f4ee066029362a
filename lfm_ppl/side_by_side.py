"""How many computations of a kind go side by side: all on an accelerator, few on a CPU.

XLA keeps what a loop carries in memory. A filter with sixty lanes no longer fits into a CPU's cache, and each of its
small operations becomes a loop of its own: with 48 series the gradient of a panel takes four times as long side by side
as one series after another, draws of trajectories twice as long as in fours.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax

WIDTH = 4
"""Draws that a CPU computes side by side."""

_FEW = 8
"""Series up to which those of a panel go side by side on a CPU, too: a program for one lane is no faster then."""


def width(most: int) -> int:
    """Return how many of ``most`` computations should go side by side.

    Example:
        >>> width(2)
        2
    """
    return min(most, WIDTH) if _on_cpu() else most


def mapped(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return ``function`` of each entry along the leading axis of ``arguments``, pytrees: one by one, or all at once.

    Example:
        >>> import jax.numpy as jnp
        >>> mapped(lambda a, b: a @ b, jnp.ones((3, 2)), jnp.ones((3, 2))).tolist()
        [2.0, 2.0, 2.0]
    """
    if _on_cpu() and jax.tree_util.tree_leaves(arguments)[0].shape[0] > _FEW:
        return jax.lax.map(lambda entry: function(*entry), arguments)
    return jax.vmap(function)(*arguments)


def _on_cpu() -> bool:
    return jax.default_backend() == "cpu"
