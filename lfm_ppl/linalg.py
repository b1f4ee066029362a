"""Linear algebra of small matrices, written so that XLA can fuse it."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jax.custom_derivatives import SymbolicZero

_LOG_2PI = float(np.log(2.0 * np.pi))

_FUSED_SIZE = 8
"""Largest dimension that is multiplied by broadcasting; XLA's CPU dot wins above it.

Also the largest that is factorised and solved in unrolled operations, whose number, and with it the time of
compilation, grows with the dimension; a larger matrix is worked through in a loop over its columns.
"""


def matmul(a: jax.Array | np.ndarray, b: jax.Array | np.ndarray) -> Any:
    """Return the matrix product of two stacks of small matrices.

    ``C_ij = sum_k A_ik B_kj``, as a broadcast product and a sum when every dimension is at most 8:
    XLA on the CPU fuses these with their neighbours, which is about 7 times faster than a call of
    its dot for matrices of a handful of states. Larger matrices go to the usual product. A NumPy matrix that only
    selects or places rows (columns) of the other one takes slices instead of arithmetic.

    Args:
        a: matrices ``A`` of shape (..., n, k).
        b: matrices ``B`` of shape (..., k, m); leading dimensions broadcast.

    Returns:
        Products of shape (..., n, m); a NumPy matrix for two of them.

    Example:
        >>> import jax.numpy as jnp
        >>> matmul(jnp.eye(2), jnp.ones((2, 3))).shape
        (2, 3)
    """
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return np.matmul(a, b)
    if isinstance(a, np.ndarray) and (chosen := _selected(a)) is not None:
        return _taken(b, chosen, -2)
    if isinstance(b, np.ndarray) and (chosen := _selected(b.T)) is not None:
        return _taken(a, chosen, -1)
    if a.shape[-1] == 1:
        return a * b
    if max(*a.shape[-2:], *b.shape[-2:]) > _FUSED_SIZE:
        return jnp.matmul(a, b)
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)


def _selected(matrix: np.ndarray) -> list[int] | None:
    """Return the column of the one in each row, -1 for a row of zeros; None for any other matrix."""
    if matrix.ndim != 2 or matrix.size == 0 or not np.isin(matrix, (0.0, 1.0)).all() or (matrix.sum(1) > 1).any():
        return None
    return [int(row.argmax()) if row.any() else -1 for row in matrix]


def _taken(a: Any, indices: list[int], axis: int) -> jax.Array:
    """Return slices of ``a`` at indices along an axis, zeros where the index is -1; XLA fuses them, unlike a gather."""
    runs: list[list[int]] = []
    for index in indices:
        if runs and (index == runs[-1][-1] == -1 or -1 < runs[-1][-1] == index - 1):
            runs[-1].append(index)
        else:
            runs.append([index])
    axis = a.ndim + axis
    shape = [(*a.shape[:axis], len(run), *a.shape[axis + 1:]) for run in runs]
    parts = [jnp.zeros(size, a.dtype) if run[0] < 0 else jax.lax.slice_in_dim(a, run[0], run[-1] + 1, axis=axis)
             for run, size in zip(runs, shape, strict=True)]
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=axis)


def outer_square(a: jax.Array) -> jax.Array:
    """Return ``A A'`` for matrices of shape (..., n, k), symmetric to the last bit."""
    return _outer_square(jnp.asarray(a))


@jax.custom_jvp
def _outer_square(a: jax.Array) -> jax.Array:
    return matmul(a, a.mT)


@_outer_square.defjvp
def _outer_square_jvp(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    """Differentiate by dA A' and its transpose: one product, where the product rule takes two."""
    (a,), (change,) = primals, tangents
    half = matmul(change, a.mT)
    return matmul(a, a.mT), half + half.mT


def congruence(a: jax.Array | np.ndarray, p: jax.Array) -> jax.Array:
    """Return the symmetric matrix ``A P A'`` for ``A`` (..., n, k) and a symmetric ``P`` (..., k, k)."""
    return _congruence_product(a, p) if isinstance(a, np.ndarray) else _congruence(a, jnp.asarray(p))


def _congruence_product(a: jax.Array | np.ndarray, p: jax.Array) -> jax.Array:
    return symmetric(matmul(matmul(a, p), a.swapaxes(-1, -2)))


@jax.custom_jvp
def _congruence(a: jax.Array, p: jax.Array) -> jax.Array:
    return _congruence_product(a, p)


@functools.partial(_congruence.defjvp, symbolic_zeros=True)
def _congruence_jvp(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    """Differentiate A P A', P the symmetric part of what was given, by A dP A' + dA P A' and the latter's transpose.

    Three products, where the product rule takes four.
    """
    (a, p), (change, of_p) = primals, tangents
    left = matmul(a, symmetric(p))
    value = symmetric(matmul(left, a.mT))
    tangent = jnp.zeros_like(value) if isinstance(of_p, SymbolicZero) else _congruence_product(a, of_p)
    if not isinstance(change, SymbolicZero):
        half = matmul(change, left.mT)
        tangent = tangent + half + half.mT
    return value, tangent


def symmetric(a: jax.Array) -> jax.Array:
    """Return ``(A + A') / 2``, which removes the rounding error of a congruence."""
    return 0.5 * (a + jnp.swapaxes(a, -1, -2))


def diagonal(a: jax.Array) -> jax.Array:
    """Return the diagonal (..., n) of matrices (..., n, n) by a mask, whose derivative is no scatter."""
    return jnp.where(np.eye(a.shape[-1], dtype=bool), a, 0.0).sum(-1)


def safe_sqrt(x: jax.Array) -> jax.Array:
    """Return the square root of max(x, 0), with a zero gradient where x <= 0."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


class CholeskyFactor(NamedTuple):
    """A lower triangular factor ``L`` with ``P = L L'``, and the pivots that were not positive.

    Attributes:
        chol: (n, n), lower triangular.
        degenerate: (n,), True where the pivot was at or below its floor.
        inverse: (n, n), that of ``L``, with a zero row where the diagonal of ``L`` is zero; None for a large matrix.
    """

    chol: jax.Array
    degenerate: Any
    inverse: Any = None

    def solve_lower(self, b: jax.Array) -> jax.Array:
        """Solve ``L X = B`` for ``B`` (n, m), as `solve_lower`."""
        return solve_lower(self.chol, b) if self.inverse is None else matmul(self.inverse, b)

    def solve_upper(self, b: jax.Array) -> jax.Array:
        """Solve ``L' X = B`` for ``B`` (n, m), as `solve_upper`."""
        return solve_upper(self.chol, b) if self.inverse is None else matmul(self.inverse.T, b)


def cholesky(p: jax.Array, floor: jax.Array | float = 0.0, keep: bool = True,
             name: str | None = None) -> CholeskyFactor:
    """Factorise a positive semi-definite matrix in plain operations.

    LAPACK's routine is a call that XLA cannot fuse and gives NaN, in value or gradient, for a singular matrix. Here a
    pivot at or below its floor is replaced, so that values and gradients stay finite.

    Args:
        p: (n, n), symmetric.
        floor: scalar or (n,), at or below which a pivot (a conditional variance) counts as degenerate.
        keep: a degenerate pivot is replaced by its floor (by 1 where that is zero); if False its column is zero,
            which gives the semi-definite factor.
        name: under which a checkpoint may keep the factor for the derivative.

    Returns:
        The factor, its degenerate pivots and its inverse.
    """
    size = p.shape[-1]
    if size == 0:
        return CholeskyFactor(p, jnp.zeros(0, bool), p)
    floor = jnp.broadcast_to(jnp.asarray(floor, p.dtype), (size,))
    if size > _FUSED_SIZE:
        return _cholesky_in_a_loop(p, floor, keep)
    factor = _eliminated(name, p, floor)
    if keep:
        return factor
    dead = factor.degenerate
    return CholeskyFactor(jnp.where(dead, 0.0, factor.chol), dead, jnp.where(dead[:, None], 0.0, factor.inverse))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _eliminated(name: str | None, p: jax.Array, floor: jax.Array) -> CholeskyFactor:
    """Factorise with replaced pivots, by Gaussian elimination in (P, I), which becomes (L', L^-1) row by row."""
    size = p.shape[-1]
    if size == 1:
        positive = p > floor
        root = jnp.sqrt(jnp.where(positive, p, jnp.where(floor > 0, floor, 1.0)))
        return CholeskyFactor(root, ~positive[0], 1.0 / root)
    rows = np.arange(size)
    left = jnp.concatenate([p, jnp.eye(size, dtype=p.dtype)], axis=1)
    found, degenerate = [], []
    for j in range(size):
        pivot = left[j, j]
        positive = pivot > floor[j]
        degenerate.append(~positive)
        root = jnp.sqrt(jnp.where(positive, pivot, jnp.where(floor[j] > 0, floor[j], 1.0)))
        row = left[j] / root
        # A degenerate column of L is zero below its diagonal.
        kept = jnp.where(positive | (np.arange(2 * size) >= size), row, 0.0)
        found.append(jnp.where(np.arange(2 * size) == j, root, kept))
        if j + 1 < size:
            column = jnp.where(positive & (rows > j), left[:, j] / root, 0.0)
            left = left - column[:, None] * row[None, :]
    whole = jnp.stack(found)
    return CholeskyFactor(jnp.where(rows[:, None] >= rows, whole[:, :size].T, 0.0), jnp.stack(degenerate),
                          whole[:, size:])


@functools.partial(_eliminated.defjvp, symbolic_zeros=True)
def _eliminated_jvp(name: str | None, primals: tuple, tangents: tuple) -> tuple[CholeskyFactor, CholeskyFactor]:
    """Differentiate in closed form: dL = L F and d(L^-1) = -F L^-1, F the lower half of L^-1 dP L^-T.

    A degenerate column of F is zero, but for the relative change of the pivot that was put in its place.
    """
    p, floor = primals
    change, of_floor = tangents
    factor = _eliminated(name, p, floor)
    if name is not None:
        factor = jax.tree_util.tree_map(lambda a: checkpoint_name(a, name), factor)
    chol, degenerate, inverse = factor
    weight = np.tri(len(p)) - 0.5 * np.eye(len(p))
    if isinstance(change, SymbolicZero):
        lower = jnp.zeros_like(p)
    else:
        white = matmul(matmul(inverse, change), inverse.T)
        lower = jnp.where(degenerate | (weight == 0), 0.0, weight * white)
    if not isinstance(of_floor, SymbolicZero):
        used = degenerate & (floor > 0)
        lower = lower + jnp.diag(jnp.where(used, 0.5 * of_floor / jnp.where(used, floor, 1.0), 0.0))
    return factor, CholeskyFactor(matmul(chol, lower), np.zeros(degenerate.shape, jax.dtypes.float0),
                                  -matmul(lower, inverse))


def _cholesky_in_a_loop(p: jax.Array, floor: jax.Array, keep: bool) -> CholeskyFactor:
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
    return CholeskyFactor(columns.T, degenerate)


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


def inverse_and_log_det(a: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return A^-1 and log |det A| of ``I + T F`` (n, n), T diagonal and F positive semi-definite.

    By elimination without pivoting: for T >= 0 such a matrix is a positive definite one but for a scaling of rows and
    columns, and needs none. Entries of T may be negative, and so may determinants.
    """
    size = a.shape[-1]
    if size == 1:
        return 1.0 / a, jnp.log(jnp.abs(a[0, 0]))
    if size > _FUSED_SIZE:
        return jnp.linalg.inv(a), jnp.linalg.slogdet(a)[1]
    left = jnp.concatenate([a, jnp.eye(size, dtype=a.dtype)], axis=1)
    log_det = jnp.zeros((), a.dtype)
    rows = np.arange(size)
    for j in range(size):
        log_det = log_det + jnp.log(jnp.abs(left[j, j]))
        row = left[j] / left[j, j]
        left = jnp.where((rows == j)[:, None], row, left - left[:, j, None] * row)
    return left[:, size:], log_det


class SemidefiniteFactor(NamedTuple):
    """A positive semi-definite matrix, factorised after it was scaled to unit diagonal.

    Attributes:
        factor: of the scaled matrix, with zero columns where a pivot was at or below the tolerance.
        scale: (n,), by which rows and columns were multiplied; zero where the variance is not positive.
        variance: (n,), its diagonal.
    """

    factor: CholeskyFactor
    scale: jax.Array
    variance: jax.Array

    def solve(self, b: jax.Array) -> jax.Array:
        """Solve ``P X = B`` for ``B`` (n, m) in the range of ``P``; directions without a pivot get zero weight."""
        return self.factor.solve_upper(self.factor.solve_lower(b * self.scale[:, None])) * self.scale[:, None]

    def conditional_shares(self) -> jax.Array:
        """Return the variance of each coordinate given those before it, as a share (n,) of its own.

        It is 0 at or below the tolerance, 1 where the coordinate's own variance is zero, and -inf where that is
        negative. The least of them says by how much solving magnifies rounding errors.
        """
        pivots = diagonal(self.factor.chol) ** 2
        # Sites of negative precision leave what is no covariance: nothing is solved with it.
        return jnp.where(self.scale > 0, pivots, jnp.where(self.variance < 0, -jnp.inf, 1.0))


def factorise_semidefinite(p: jax.Array, tolerance: float = 1e-14) -> SemidefiniteFactor:
    """Factorise a positive semi-definite ``P`` (n, n).

    Directions whose conditional variance is at or below ``tolerance`` of their marginal variance carry no information.
    """
    variance = diagonal(p)
    live = variance > 0
    scale = jnp.where(live, 1.0 / jnp.sqrt(jnp.where(live, variance, 1.0)), 0.0)
    return SemidefiniteFactor(cholesky(p * scale[:, None] * scale[None, :], floor=tolerance, keep=False), scale,
                              variance)


def solve_semidefinite(p: jax.Array, b: jax.Array, tolerance: float = 1e-14) -> jax.Array:
    """Solve ``P X = B`` for a positive semi-definite ``P`` (n, n) and ``B`` (n,) or (n, m) in the range of ``P``.

    See `factorise_semidefinite` for the tolerance.
    """
    solution = factorise_semidefinite(p, tolerance).solve(b if b.ndim > 1 else b[:, None])
    return solution if b.ndim > 1 else solution[:, 0]


def semidefinite_root(p: jax.Array, tolerance: float = 1e-14) -> jax.Array:
    """Return a lower triangular ``L`` with ``L L' = P`` for a semi-definite ``P``; null directions are zero."""
    found = factorise_semidefinite(p, tolerance)
    return safe_sqrt(found.variance)[:, None] * found.factor.chol


def pivoted_root(p: jax.Array) -> jax.Array:
    """Return ``R`` (n, n) with ``R R' = P`` for a semi-definite ``P``, by Cholesky's method with complete pivoting.

    ``R R'`` is as accurate as ``P``, however singular that is. `semidefinite_root` takes the coordinates in their own
    order, and loses variance of a later one where an earlier one varies, given those before it, by rounding only. It is
    triangular and continuous in ``P``, and this is neither.

    Source: Higham (2002), Accuracy and Stability of Numerical Algorithms, section 10.3.
    """
    if p.shape[-1] == 0:
        return p
    sd = safe_sqrt(diagonal(p))
    inverse = _divide(jnp.ones(()), sd)
    least = p.shape[-1] * jnp.finfo(p.dtype).eps

    def take(left: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        index = jnp.argmax(diagonal(left))
        column = left[:, index]
        live = column[index] > least
        column = jnp.where(live, column / jnp.sqrt(jnp.where(live, column[index], 1.0)), 0.0)
        return left - column[:, None] * column, column

    _, columns = jax.lax.scan(take, p * inverse[:, None] * inverse, None, length=p.shape[-1])
    return sd[:, None] * columns.T


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
    scale = jnp.log(diagonal(chol)).sum(-1)
    return -0.5 * ((white**2).sum(-1) + count * _LOG_2PI) - scale


def wrapped(angle: jax.Array) -> jax.Array:
    """Return the angle in [-pi, pi] radians."""
    return jnp.arctan2(jnp.sin(angle), jnp.cos(angle))


def _divide(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.where(b != 0, a / jnp.where(b != 0, b, 1.0), 0.0)
