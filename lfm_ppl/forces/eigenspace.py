"""The leading eigenvectors of a symmetric matrix, with derivatives where eigenvalues repeat."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

_SEPARATE = 1e-12
"""Share of the largest eigenvalue by which two must differ to be told apart."""


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def leading_eigenvectors(matrix: jax.Array, count: int) -> jax.Array:
    """Return V (n, count), the eigenvectors of a symmetric matrix (n, n) of the largest eigenvalues, falling.

    The derivative is that of the space which they span,

        dV = sum over the other eigenvectors r of  r (r' dM V) (Lambda - mu_r)^-1,

    without the turning of V within its space. It holds only differences between eigenvalues kept and left out, and so
    is finite where kept ones repeat, as they do in pairs for every stationary kernel, and where V'MV is then taken as a
    full matrix it gives the right derivatives of all that depends on the space alone. Only where the cut goes through
    a pair, the derivative does not exist; that pair's share is left out.

    Args:
        matrix: (n, n), symmetric.
        count: how many, a Python int.
    """
    return jnp.linalg.eigh(matrix)[1][:, ::-1][:, :count]


@leading_eigenvectors.defjvp
def _leading_eigenvectors_jvp(count, primals, tangents):
    (matrix,), (change,) = primals, tangents
    vectors = leading_eigenvectors(matrix, count)
    values, every = jnp.linalg.eigh(jax.lax.stop_gradient(matrix))
    values, rest = values[::-1], every[:, ::-1][:, count:]
    gap = values[None, :count] - values[count:, None]
    separate = gap > _SEPARATE * jnp.abs(values).max()
    inverse = jnp.where(separate, 1.0 / jnp.where(separate, gap, 1.0), 0.0)

    def outside(x: jax.Array) -> jax.Array:
        return x - vectors @ (vectors.T @ x)

    def solve(right: jax.Array) -> jax.Array:
        return rest @ (inverse * (rest.T @ right))

    # The solution of X Lambda - M X = right among the other eigenvectors. One step of Newton's method changes nothing
    # here, but gives second derivatives, which those of an eigen-decomposition would spoil.
    right = outside(0.5 * (change + change.T) @ vectors)
    found = solve(right)
    residual = right - found @ (vectors.T @ matrix @ vectors) + outside(matrix @ found)
    return vectors, outside(found + solve(residual))
