"""Smooth functions of time as tables, for compiled code."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np


class TimeTable(eqx.Module):
    """A function of time given at equally spaced times, cubic between them.

    Between two nodes it is the polynomial of degree three through the four nearest ones, whose error is at most
    3/128 spacing^4 of the fourth derivative. Beyond the first and the last node the outermost polynomial holds.

    Args:
        start: time of the first node.
        spacing: of the nodes; > 0.
        values: (K, C), at least four rows.

    Raises:
        ValueError: fewer than four rows, a value that is not finite, or a spacing that is not positive.

    Example:
        >>> import numpy as np
        >>> hours = np.arange(0.0, 10.0)
        >>> table = TimeTable(0.0, 1.0, hours[:, None] ** 3)
        >>> float(table(2.5)[0])
        15.625
    """

    start: jax.Array
    spacing: jax.Array
    values: jax.Array

    def __init__(self, start: Any, spacing: Any, values: Any):
        self.start, self.spacing = jnp.asarray(start, float), jnp.asarray(spacing, float)
        self.values = jnp.asarray(values, float)
        if self.values.ndim != 2 or self.values.shape[0] < 4:
            raise ValueError(f"a table needs at least four rows of values, got shape {self.values.shape}.")
        if not (np.all(np.isfinite(values)) and float(spacing) > 0):
            raise ValueError("a table needs finite values and a positive spacing.")

    def __call__(self, t: Any) -> jax.Array:
        """Return the values (C,) at time ``t``."""
        position = (t - self.start) / self.spacing
        first = jnp.clip(jnp.floor(position).astype(int) - 1, 0, self.values.shape[0] - 4)
        rows = jax.lax.dynamic_slice_in_dim(self.values, first, 4)
        x = position - first
        weights = jnp.stack([-(x - 1) * (x - 2) * (x - 3) / 6, x * (x - 2) * (x - 3) / 2,
                             -x * (x - 1) * (x - 3) / 2, x * (x - 1) * (x - 2) / 6])
        return (weights[:, None] * rows).sum(0)
