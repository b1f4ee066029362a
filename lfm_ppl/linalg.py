"""Linear algebra of small matrices, written so that XLA can fuse it."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

_LOG_2PI = float(np.log(2.0 * np.pi))

_FUSED_SIZE = 8
"""Largest dimension that is multiplied by broadcasting; XLA's CPU dot wins above it.

Also the largest that is factorised and solved in unrolled operations. Their number grows with the cube of the
dimension, and with it the time of compilation; a larger matrix is worked through in a loop over its columns.
"""


def matmul(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the matrix product of two stacks of small matrices.

    ``C_ij = sum_k A_ik B_kj``, as a broadcast product and a sum when every dimension is at most 8:
    XLA on the CPU fuses these with their neighbours, which is about 7 times faster than a call of
    its dot for matrices of a handful of states. Larger matrices go to the usual product.

    Args:
        a: matrices ``A`` of shape (..., n, k).
        b: matrices ``B`` of shape (..., k, m); leading dimensions broadcast.

    Returns:
        Products of shape (..., n, m).

    Example:
        >>> import jax.numpy as jnp
        >>> matmul(jnp.eye(2), jnp.ones((2, 3))).shape
        (2, 3)
    """
    if max(*a.shape[-2:], *b.shape[-2:]) > _FUSED_SIZE:
        return jnp.matmul(a, b)
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)


def outer_square(a: jax.Array) -> jax.Array:
    """Return ``A A'`` for matrices of shape (..., n, k), symmetric to the last bit."""
    return matmul(a, jnp.swapaxes(a, -1, -2))


def congruence(a: jax.Array, p: jax.Array) -> jax.Array:
    """Return the symmetric matrix ``A P A'`` for ``A`` (..., n, k) and a symmetric ``P`` (..., k, k)."""
    return symmetric(matmul(matmul(a, p), jnp.swapaxes(a, -1, -2)))


def symmetric(a: jax.Array) -> jax.Array:
    """Return ``(A + A') / 2``, which removes the rounding error of a congruence."""
    return 0.5 * (a + jnp.swapaxes(a, -1, -2))


def safe_sqrt(x: jax.Array) -> jax.Array:
    """Return the square root of max(x, 0), with a zero gradient where x <= 0."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


class Factor(NamedTuple):
    """A lower triangular factor ``L`` with ``P = L L'``, and the pivots that were not positive.

    Attributes:
        chol: (n, n), lower triangular.
        degenerate: (n,), True where the pivot was at or below its floor.
    """

    chol: jax.Array
    degenerate: jax.Array


def cholesky(p: jax.Array, floor: jax.Array | float = 0.0, keep: bool = True) -> Factor:
    """Factorise a positive semi-definite matrix column by column, in plain operations.

    LAPACK's routine is a call that XLA cannot fuse and gives NaN, in value or gradient, for a singular matrix. Here a
    pivot at or below its floor is replaced, so that values and gradients stay finite.

    Args:
        p: (n, n), symmetric.
        floor: scalar or (n,), at or below which a pivot (a conditional variance) counts as degenerate.
        keep: a degenerate pivot is replaced by its floor (by 1 where that is zero); if False its column is zero,
            which gives the semi-definite factor.

    Returns:
        The factor and its degenerate pivots.
    """
    size = p.shape[-1]
    if size == 0:
        return Factor(p, jnp.zeros(0, bool))
    floor = jnp.broadcast_to(jnp.asarray(floor, p.dtype), (size,))
    if size > _FUSED_SIZE:
        return _cholesky_in_a_loop(p, floor, keep)
    rows = np.arange(size)
    columns: list[jax.Array] = []
    degenerate = []
    for j in range(size):
        column = p[:, j]
        for previous in columns:
            column = column - previous * previous[j]
        positive = column[j] > floor[j]
        degenerate.append(~positive)
        replacement = jnp.where(floor[j] > 0, floor[j], 1.0)
        root = jnp.sqrt(jnp.where(positive, column[j], replacement))
        diagonal = root if keep else jnp.where(positive, root, 0.0)
        below = jnp.where(positive, column / root, 0.0)
        columns.append(jnp.where(rows > j, below, jnp.where(rows == j, diagonal, 0.0)))
    return Factor(jnp.stack(columns, axis=-1), jnp.stack(degenerate))


def _cholesky_in_a_loop(p: jax.Array, floor: jax.Array, keep: bool) -> Factor:
    """Factorise as `cholesky` does; each column is taken off what is left of the matrix."""
    rows = np.arange(p.shape[-1])

    def take(left: jax.Array, at: tuple) -> tuple[jax.Array, tuple]:
        j, least = at
        column = left[:, j]
        pivot = column[j]
        positive = pivot > least
        root = jnp.sqrt(jnp.where(positive, pivot, jnp.where(least > 0, least, 1.0)))
        diagonal = root if keep else jnp.where(positive, root, 0.0)
        below = jnp.where(positive, column / root, 0.0)
        column = jnp.where(rows > j, below, jnp.where(rows == j, diagonal, 0.0))
        return left - column[:, None] * column[None, :], (column, ~positive)

    _, (columns, degenerate) = jax.lax.scan(take, p, (jnp.arange(p.shape[-1]), floor))
    return Factor(columns.T, degenerate)


def solve_lower(chol: jax.Array, b: jax.Array) -> jax.Array:
    """Solve ``L X = B`` for a lower triangular ``L`` (n, n) and ``B`` (n,) or (n, m), in plain operations.

    A zero on the diagonal (a semi-definite factor) gives a zero row of ``X``.
    """
    if chol.shape[-1] == 0:
        return b
    if chol.shape[-1] > _FUSED_SIZE:
        return _substitute(chol, b, reverse=False)
    rows: list[jax.Array] = []
    for j in range(chol.shape[-1]):
        value = b[j]
        for k, row in enumerate(rows):
            value = value - chol[j, k] * row
        rows.append(_divide(value, chol[j, j]))
    return jnp.stack(rows)


def solve_upper(chol: jax.Array, b: jax.Array) -> jax.Array:
    """Solve ``L' X = B`` for a lower triangular ``L`` (n, n); zeros on the diagonal as in `solve_lower`."""
    size = chol.shape[-1]
    if size == 0:
        return b
    if size > _FUSED_SIZE:
        return _substitute(chol.T, b, reverse=True)
    rows: dict[int, jax.Array] = {}
    for j in reversed(range(size)):
        value = b[j]
        for k in range(j + 1, size):
            value = value - chol[k, j] * rows[k]
        rows[j] = _divide(value, chol[j, j])
    return jnp.stack([rows[j] for j in range(size)])


def _substitute(triangle: jax.Array, b: jax.Array, reverse: bool) -> jax.Array:
    """Solve a triangular system row by row, the last row first in ``reverse``."""

    def solve(found: jax.Array, at: tuple) -> tuple[jax.Array, None]:
        j, row, value = at
        return found.at[j].set(_divide(value - row @ found, row[j])), None

    rows = (jnp.arange(triangle.shape[-1]), triangle, b)
    return jax.lax.scan(solve, jnp.zeros(b.shape, jnp.result_type(triangle, b)), rows, reverse=reverse)[0]


def solve_semidefinite(p: jax.Array, b: jax.Array, tolerance: float = 1e-14) -> jax.Array:
    """Solve ``P X = B`` for a positive semi-definite ``P`` (n, n) and ``B`` (n, m) in the range of ``P``.

    The matrix is scaled to unit diagonal first, and directions whose conditional variance is below ``tolerance`` of
    their marginal variance carry no information: they get zero weight.
    """
    variance = jnp.diagonal(p)
    live = variance > 0
    scale = jnp.where(live, 1.0 / jnp.sqrt(jnp.where(live, variance, 1.0)), 0.0)
    factor = cholesky(p * scale[:, None] * scale[None, :], floor=tolerance, keep=False)
    scaled = b * (scale[:, None] if b.ndim > 1 else scale)
    solution = solve_upper(factor.chol, solve_lower(factor.chol, scaled))
    return solution * (scale[:, None] if b.ndim > 1 else scale)


def conditional_shares(p: jax.Array) -> jax.Array:
    """Return the variance of each coordinate given those before it, as a share (n,) of its own; 1 where that is zero.

    The least of them says by how much solving with ``P`` magnifies rounding errors.
    """
    variance = jnp.diagonal(p)
    live = variance > 0
    scale = jnp.where(live, 1.0 / jnp.sqrt(jnp.where(live, variance, 1.0)), 0.0)
    pivots = jnp.diagonal(cholesky(p * scale[:, None] * scale[None, :], keep=False).chol) ** 2
    return jnp.where(live, pivots, 1.0)


def semidefinite_root(p: jax.Array, tolerance: float = 1e-14) -> jax.Array:
    """Return a lower triangular ``L`` with ``L L' = P`` for a semi-definite ``P``; null directions are zero."""
    variance = jnp.diagonal(p)
    live = variance > 0
    sd = jnp.where(live, jnp.sqrt(jnp.where(live, variance, 1.0)), 0.0)
    inverse = jnp.where(live, 1.0 / jnp.where(live, sd, 1.0), 0.0)
    return sd[:, None] * cholesky(p * inverse[:, None] * inverse[None, :], floor=tolerance, keep=False).chol


def masked(residual: jax.Array, covariance: jax.Array, present: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Leave out missing entries: return the residual with zeros, the covariance with rows of the identity for them.

    Args:
        residual: (..., D), anything where missing.
        covariance: (..., D, D); leading dimensions broadcast.
        present: (..., D), whether an entry is.
    """
    both = present[..., :, None] & present[..., None, :]
    return jnp.where(present, residual, 0.0), jnp.where(both, covariance, jnp.eye(present.shape[-1]))


def log_density(white: jax.Array, chol: jax.Array, present: jax.Array | None = None) -> jax.Array:
    """Return the log density (...) of the Gaussian N(0, L L') at a residual, its missing entries left out by `masked`.

    Args:
        white: (..., D), L^-1 times the residual.
        chol: (..., D, D), the lower triangular L.
        present: (..., D), whether an entry is; all are by default.
    """
    count = white.shape[-1] if present is None else present.sum(-1)
    scale = jnp.log(jnp.diagonal(chol, axis1=-2, axis2=-1)).sum(-1)
    return -0.5 * ((white**2).sum(-1) + count * _LOG_2PI) - scale


def wrapped(angle: jax.Array) -> jax.Array:
    """Return the angle in [-pi, pi] radians."""
    return jnp.arctan2(jnp.sin(angle), jnp.cos(angle))


def _divide(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.where(b != 0, a / jnp.where(b != 0, b, 1.0), 0.0)
