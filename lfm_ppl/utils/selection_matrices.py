"""Products with selection matrices as slices, which XLA fuses with their neighbours, unlike a product or a gather."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def selected_columns(matrix: np.ndarray) -> list[int] | None:
    """Return the column of the entry 1 in each row, -1 for a row of zeros; None unless the matrix is a selection."""
    if matrix.ndim != 2 or matrix.size == 0 or not np.isin(matrix, (0.0, 1.0)).all() or (matrix.sum(1) > 1).any():
        return None
    return [int(row.argmax()) if row.any() else -1 for row in matrix]


def select(a: Any, indices: list[int], axis: int) -> jax.Array:
    """Return the slices of ``a`` at ``indices`` along a (negative) axis, zeros where the index is -1."""
    runs: list[list[int]] = []  # consecutive indices, or consecutive zeros
    for index in indices:
        if runs and (index == runs[-1][-1] == -1 or -1 < runs[-1][-1] == index - 1):
            runs[-1].append(index)
        else:
            runs.append([index])
    axis = a.ndim + axis
    shapes = [(*a.shape[:axis], len(run), *a.shape[axis + 1:]) for run in runs]
    parts = [jnp.zeros(shape, a.dtype) if run[0] < 0 else jax.lax.slice_in_dim(a, run[0], run[-1] + 1, axis=axis)
             for run, shape in zip(runs, shapes, strict=True)]
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=axis)
