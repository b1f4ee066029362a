"""Linear algebra of small matrices, in operations that XLA can fuse.

1. `matmul` multiplies small matrices by broadcasting and summation, and selection matrices by slices; `congruence` and
   `outer_square` return exactly symmetric products.
2. `cholesky` factorises a positive semi-definite matrix by Gaussian elimination, which also gives L^-1.
   LAPACK's routine is an opaque call for XLA, and fails for singular matrices.
3. A pivot at or below its floor is replaced by the floor, or its column by zero, so that values and derivatives are
   finite for singular matrices.
4. Products and factorisations have derivatives in closed form (custom_jvp), with fewer operations than the
   differentiated algorithm.
5. Loops over matrices up to `_FUSED_SIZE` are unrolled; larger ones use XLA's dot and scans, which compile fast.

Source: Golub and Van Loan (2013), Matrix Computations, chapter 4; Higham (2002), Accuracy and Stability of Numerical
Algorithms, chapter 10.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jax.custom_derivatives import SymbolicZero

from lfm_ppl.utils.selection_matrices import select, selected_columns

_FUSED_SIZE = 8
"""Largest dimension of products by broadcasting, and of unrolled factorisations and solves.

XLA's CPU dot is faster above it. The number of unrolled operations, and thus the compilation time, grows with the
dimension; larger matrices are factorised in a loop over their columns.
"""


def matmul(a: jax.Array | np.ndarray, b: jax.Array | np.ndarray) -> Any:
    """Return the matrix product of two stacks of small matrices.

    ``C_ij = sum_k A_ik B_kj`` is computed as a broadcast product and a sum if every dimension is at most 8. XLA fuses
    these with their neighbours on the CPU, which is about 7 times faster than its dot for matrices of a few states.
    Larger matrices use the usual product. A NumPy matrix that selects rows (or columns) of the other matrix becomes
    slices.

    Args:
        a: matrices ``A`` of shape (..., n, k).
        b: matrices ``B`` of shape (..., k, m); leading dimensions broadcast.

    Returns:
        Products of shape (..., n, m); a NumPy array if both factors are NumPy arrays.
    """
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return np.matmul(a, b)
    if isinstance(a, np.ndarray) and (rows := selected_columns(a)) is not None:
        return select(b, rows, -2)
    if isinstance(b, np.ndarray) and (columns := selected_columns(b.T)) is not None:
        return select(a, columns, -1)
    if a.shape[-1] == 1:
        return a * b
    if max(*a.shape[-2:], *b.shape[-2:]) > _FUSED_SIZE:
        return jnp.matmul(a, b)
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)


def outer_square(a: jax.Array) -> jax.Array:
    """Return ``A A'`` for matrices of shape (..., n, k), exactly symmetric."""
    return _outer_square(jnp.asarray(a))


@jax.custom_jvp
def _outer_square(a: jax.Array) -> jax.Array:
    return matmul(a, a.mT)


@_outer_square.defjvp
def _outer_square_jvp(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    """Differentiate A A' by dA A' and its transpose: one product instead of the two of the product rule."""
    (a,), (a_tangent,) = primals, tangents
    half = matmul(a_tangent, a.mT)
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
    """Differentiate by A dP A' + dA P A' + (dA P A')': three products instead of the four of the product rule."""
    (a, p), (a_tangent, p_tangent) = primals, tangents
    ap = matmul(a, symmetric(p))
    value = symmetric(matmul(ap, a.mT))
    tangent = jnp.zeros_like(value) if isinstance(p_tangent, SymbolicZero) else _congruence_product(a, p_tangent)
    if not isinstance(a_tangent, SymbolicZero):
        half = matmul(a_tangent, ap.mT)
        tangent = tangent + half + half.mT
    return value, tangent


def symmetric(a: jax.Array) -> jax.Array:
    """Return ``(A + A') / 2``, which removes the asymmetry due to rounding."""
    return 0.5 * (a + jnp.swapaxes(a, -1, -2))


def diagonal(a: jax.Array) -> jax.Array:
    """Return the diagonal (..., n) of matrices (..., n, n), by a mask: its derivative needs no scatter."""
    return jnp.where(np.eye(a.shape[-1], dtype=bool), a, 0.0).sum(-1)


def safe_sqrt(x: jax.Array) -> jax.Array:
    """Return the square root of max(x, 0), with a zero gradient where x <= 0."""
    is_positive = x > 0
    return jnp.where(is_positive, jnp.sqrt(jnp.where(is_positive, x, 1.0)), 0.0)


class CholeskyFactor(NamedTuple):
    """A lower triangular factor ``L`` with ``P = L L'``.

    Attributes:
        chol: (n, n), lower triangular.
        degenerate: (n,), True where the pivot was at or below its floor.
        inverse: (n, n), ``L^-1``, with a zero row where the diagonal of ``L`` is zero.
    """

    chol: jax.Array
    degenerate: Any
    inverse: jax.Array

    def solve_lower(self, b: jax.Array) -> jax.Array:
        """Solve ``L X = B`` for ``B`` (n, m), as `solve_lower`."""
        return matmul(self.inverse, b)

    def solve_upper(self, b: jax.Array) -> jax.Array:
        """Solve ``L' X = B`` for ``B`` (n, m), as `solve_upper`."""
        return matmul(self.inverse.T, b)


def cholesky(p: jax.Array, floor: jax.Array | float = 0.0, keep: bool = True,
             name: str | None = None) -> CholeskyFactor:
    """Factorise a positive semi-definite matrix in fusible operations.

    A pivot at or below its floor is replaced, so that values and gradients are finite for singular matrices, where
    LAPACK's routine gives NaN.

    Args:
        p: (n, n), symmetric.
        floor: scalar or (n,); a pivot (a conditional variance) at or below its floor is degenerate.
        keep: if True, a degenerate pivot is replaced by its floor (by 1 where the floor is zero); if False, its column
            is zero, which gives the semi-definite factor.
        name: checkpoint name of the factor, by which a checkpoint policy can save it for the derivative.
    """
    size = p.shape[-1]
    if size == 0:
        return CholeskyFactor(p, jnp.zeros(0, bool), p)
    floor = jnp.broadcast_to(jnp.asarray(floor, p.dtype), (size,))
    factor = _eliminate(name, p, floor)
    if keep:
        return factor
    degenerate = factor.degenerate
    return CholeskyFactor(jnp.where(degenerate, 0.0, factor.chol), degenerate,
                          jnp.where(degenerate[:, None], 0.0, factor.inverse))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _eliminate(name: str | None, p: jax.Array, floor: jax.Array) -> CholeskyFactor:
    """Factorise with replaced pivots, by Gaussian elimination in (P, I), which becomes (L', L^-1) row by row."""
    size = p.shape[-1]
    if size == 1:
        is_positive = p > floor
        root = jnp.sqrt(jnp.where(is_positive, p, jnp.where(floor > 0, floor, 1.0)))
        return CholeskyFactor(root, ~is_positive[0], 1.0 / root)
    rows, columns = np.arange(size), np.arange(2 * size)

    def eliminate(remainder: jax.Array, pivot_input: tuple) -> tuple[jax.Array, tuple]:
        j, pivot_floor = pivot_input
        pivot = remainder[j, j]
        is_positive = pivot > pivot_floor
        root = jnp.sqrt(jnp.where(is_positive, pivot, jnp.where(pivot_floor > 0, pivot_floor, 1.0)))
        row = remainder[j] / root
        # A degenerate column of L is zero below its diagonal.
        factor_row = jnp.where(columns == j, root, jnp.where(is_positive | (columns >= size), row, 0.0))
        column = jnp.where(is_positive & (rows > j), remainder[:, j] / root, 0.0)
        return remainder - column[:, None] * row[None, :], (factor_row, ~is_positive)

    remainder = jnp.concatenate([p, jnp.eye(size, dtype=p.dtype)], axis=1)
    if size > _FUSED_SIZE:
        factor_rows, degenerate = jax.lax.scan(eliminate, remainder, (jnp.arange(size), floor))[1]
    else:
        steps = []
        for j in range(size):
            remainder, step = eliminate(remainder, (j, floor[j]))
            steps.append(step)
        factor_rows, degenerate = (jnp.stack(values) for values in zip(*steps, strict=True))
    return CholeskyFactor(jnp.where(rows[:, None] >= rows, factor_rows[:, :size].T, 0.0), degenerate,
                          factor_rows[:, size:])


@functools.partial(_eliminate.defjvp, symbolic_zeros=True)
def _eliminate_jvp(name: str | None, primals: tuple, tangents: tuple) -> tuple[CholeskyFactor, CholeskyFactor]:
    """Differentiate in closed form: dL = L F and d(L^-1) = -F L^-1, where F is the lower half of L^-1 dP L^-T.

    A degenerate column of F is zero, except for the relative change of the floor that replaces the pivot.
    """
    p, floor = primals
    p_tangent, floor_tangent = tangents
    factor = _eliminate(name, p, floor)
    if name is not None:  # here and not in the primal, since only a derivative has something to store
        factor = jax.tree_util.tree_map(lambda a: checkpoint_name(a, name), factor)
    chol, degenerate, inverse = factor
    weight = np.tri(len(p)) - 0.5 * np.eye(len(p))
    if isinstance(p_tangent, SymbolicZero):
        lower = jnp.zeros_like(p)
    else:
        white = matmul(matmul(inverse, p_tangent), inverse.T)
        lower = jnp.where(degenerate | (weight == 0), 0.0, weight * white)
    if not isinstance(floor_tangent, SymbolicZero):
        has_floor = degenerate & (floor > 0)
        lower = lower + jnp.diag(jnp.where(has_floor, 0.5 * floor_tangent / jnp.where(has_floor, floor, 1.0), 0.0))
    return factor, CholeskyFactor(matmul(chol, lower), np.zeros(degenerate.shape, jax.dtypes.float0),
                                  -matmul(lower, inverse))


def solve_lower(chol: jax.Array, b: jax.Array) -> jax.Array:
    """Solve ``L X = B`` for a lower triangular ``L`` (n, n) and ``B`` (n,) or (n, m), in fusible operations.

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
        rows.append(divide(value, chol[j, j]))
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
        rows[j] = divide(value, chol[j, j])
    return jnp.stack([rows[j] for j in range(size)])


def _substitute(triangle: jax.Array, b: jax.Array, reverse: bool) -> jax.Array:
    """Solve a triangular system row by row, from the last row if ``reverse``."""

    def solve_row(solution: jax.Array, equation: tuple) -> tuple[jax.Array, None]:
        j, row, value = equation
        return solution.at[j].set(divide(value - row @ solution, row[j])), None

    rows = (jnp.arange(triangle.shape[-1]), triangle, b)
    return jax.lax.scan(solve_row, jnp.zeros(b.shape, jnp.result_type(triangle, b)), rows, reverse=reverse)[0]


def inverse_and_log_det(a: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return A^-1 and log |det A| of ``A = I + T F`` (n, n), with T diagonal and F positive semi-definite.

    Gauss-Jordan elimination without pivoting suffices: for T >= 0, A is similar by scaling to a positive definite
    matrix. Entries of T, and then the determinant, may also be negative.
    """
    size = a.shape[-1]
    if size == 1:
        return 1.0 / a, jnp.log(jnp.abs(a[0, 0]))
    if size > _FUSED_SIZE:
        return jnp.linalg.inv(a), jnp.linalg.slogdet(a)[1]
    augmented = jnp.concatenate([a, jnp.eye(size, dtype=a.dtype)], axis=1)
    log_det = jnp.zeros((), a.dtype)
    rows = np.arange(size)
    for j in range(size):
        log_det = log_det + jnp.log(jnp.abs(augmented[j, j]))
        row = augmented[j] / augmented[j, j]
        augmented = jnp.where((rows == j)[:, None], row, augmented - augmented[:, j, None] * row)
    return augmented[:, size:], log_det


def divide(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return a / b, zero with finite derivatives where b is zero."""
    return jnp.where(b != 0, a / jnp.where(b != 0, b, 1.0), 0.0)


def fastest_rate(jacobian: jax.Array) -> jax.Array:
    """Estimate the largest modulus of an eigenvalue of the Jacobian (M, n) in the physical state, |K^8|^(1/8).

    The units of the states matter little: a ratio of 1,000 between them makes it 2.4 times as large at most.
    """
    size = jacobian.shape[0]
    largest = jnp.maximum(jnp.max(jnp.abs(jacobian[:, :size]), initial=0.0), 1e-300)
    power = jacobian[:, :size] / largest
    for _ in range(3):
        power = matmul(power, power)
    return largest * jnp.maximum(jnp.max(jnp.abs(power), initial=0.0), 1e-100) ** 0.125
