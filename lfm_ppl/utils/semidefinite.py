"""Factors and roots of positive semi-definite matrices, with finite derivatives where they are singular.

`SemidefiniteFactor` scales a matrix to unit diagonal first, so that one relative tolerance serves all units.

Source: Golub and Van Loan (2013), Matrix Computations, section 4.2; Higham (2002), Accuracy and Stability of Numerical
Algorithms, chapter 10, for pivoting.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.utils.linalg import CholeskyFactor, cholesky, diagonal, divide, safe_sqrt


class SemidefiniteFactor(NamedTuple):
    """The factor of a positive semi-definite matrix that is scaled to unit diagonal.

    Attributes:
        factor: factor of the scaled matrix, with zero columns where a pivot is at or below the tolerance.
        scale: (n,), factors of rows and columns; zero where the variance is not positive.
        variance: (n,), the diagonal of the matrix.
    """

    factor: CholeskyFactor
    scale: jax.Array
    variance: jax.Array

    def solve(self, b: jax.Array) -> jax.Array:
        """Solve ``P X = B`` for ``B`` (n, m) in the range of ``P``; null directions of ``P`` are zero in ``X``."""
        return self.factor.solve_upper(self.factor.solve_lower(b * self.scale[:, None])) * self.scale[:, None]

    def conditional_shares(self) -> jax.Array:
        """Return the conditional variance of each coordinate relative to its marginal variance, (n,).

        The condition is on the coordinates before it. The share is 0 at or below the tolerance, 1 where the marginal
        variance is zero, -inf where that is negative. Solving amplifies rounding errors by up to the inverse of the
        least share.
        """
        pivots = diagonal(self.factor.chol) ** 2
        # Sites of negative precision can make a variance negative; callers must not solve with such a matrix.
        return jnp.where(self.scale > 0, pivots, jnp.where(self.variance < 0, -jnp.inf, 1.0))


def factorise_semidefinite(p: jax.Array, tolerance: float = 1e-14) -> SemidefiniteFactor:
    """Factorise a positive semi-definite ``P`` (n, n).

    A coordinate whose conditional variance is at most ``tolerance`` times its marginal variance is a null direction.
    """
    variance = diagonal(p)
    is_positive = variance > 0
    scale = jnp.where(is_positive, 1.0 / jnp.sqrt(jnp.where(is_positive, variance, 1.0)), 0.0)
    return SemidefiniteFactor(cholesky(p * scale[:, None] * scale[None, :], floor=tolerance, keep=False), scale,
                              variance)


def solve_semidefinite(p: jax.Array, b: jax.Array, tolerance: float = 1e-14) -> jax.Array:
    """Solve ``P X = B`` for a positive semi-definite ``P`` (n, n) and ``B`` (n,) or (n, m) in the range of ``P``.

    See `factorise_semidefinite` for the tolerance.
    """
    solution = factorise_semidefinite(p, tolerance).solve(b if b.ndim > 1 else b[:, None])
    return solution if b.ndim > 1 else solution[:, 0]


def semidefinite_root(p: jax.Array, tolerance: float = 1e-14) -> jax.Array:
    """Return a lower triangular ``L`` with ``L L' = P`` for a semi-definite ``P``, zero in null directions."""
    factorised = factorise_semidefinite(p, tolerance)
    return safe_sqrt(factorised.variance)[:, None] * factorised.factor.chol


def pivoted_root(p: jax.Array) -> jax.Array:
    """Return ``R`` (n, n) with ``R R' = P`` for a semi-definite ``P``, by Cholesky's method with complete pivoting.

    ``R R'`` is as accurate as ``P``, even for singular ``P``. `semidefinite_root` eliminates the coordinates in the
    given order and loses variance of later coordinates where the conditional variance of an earlier one is pure
    rounding error. In contrast to `semidefinite_root`, this root is neither triangular nor continuous in ``P``.

    Source: Higham (2002), Accuracy and Stability of Numerical Algorithms, section 10.3.
    """
    if p.shape[-1] == 0:
        return p
    sd = safe_sqrt(diagonal(p))
    inverse = divide(jnp.ones(()), sd)
    return sd[:, None] * pivoted_cholesky(p * inverse[:, None] * inverse, p.shape[-1])[0]


def pivoted_cholesky(p: jax.Array, rank: int) -> tuple[jax.Array, jax.Array]:
    """Return the leading columns ``R`` (n, rank) of Cholesky's method with complete pivoting, and the pivots (rank,).

    The pivot of a step has the largest remaining variance. A remainder of rounding errors gives a zero column. The
    rows of the pivots, ``R[pivots]``, are lower triangular.

    Source: Higham (2002), Accuracy and Stability of Numerical Algorithms, section 10.3.
    """
    tolerance = jax.lax.stop_gradient(p.shape[-1] * jnp.finfo(p.dtype).eps * diagonal(p).max())

    def eliminate(remainder: jax.Array, _: None) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        variances = diagonal(remainder)
        # The first of several equal variances: rounding errors would choose another one for other parameters.
        index = jnp.argmax(variances >= (1.0 - 1e-9) * variances.max())
        column = remainder[:, index]
        is_positive = column[index] > tolerance
        column = jnp.where(is_positive, column / jnp.sqrt(jnp.where(is_positive, column[index], 1.0)), 0.0)
        return remainder - column[:, None] * column, (column, index)

    _, (columns, pivots) = jax.lax.scan(eliminate, p, None, length=rank)
    return columns.T, pivots
