"""The leading eigenvectors of a symmetric matrix, differentiable also where eigenvalues repeat."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

_SEPARATE = 1e-12
"""Least difference of two distinct eigenvalues, as a share of the largest eigenvalue."""


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def leading_eigenvectors(matrix: jax.Array, count: int) -> jax.Array:
    """Return V (n, count), the eigenvectors of the largest eigenvalues of a symmetric matrix, in descending order.

    The derivative is that of the space spanned by V,

        dV = sum over the other eigenvectors r of  r (r' dM V) (Lambda - mu_r)^-1,

    and omits rotations of V within this space. It contains only differences between an eigenvalue of V and one of the
    other eigenvectors, and is therefore finite where leading eigenvalues repeat, as they do in pairs for every
    stationary kernel. Functions of the space alone get the right derivative if they use V'MV as a full matrix. Where
    the last leading eigenvalue equals the next one the derivative does not exist; that pair's term is omitted.

    Args:
        matrix: (n, n), symmetric.
        count: number of eigenvectors, a Python int.
    """
    return jnp.linalg.eigh(matrix)[1][:, ::-1][:, :count]


@leading_eigenvectors.defjvp
def _leading_eigenvectors_jvp(count, primals, tangents):
    (matrix,), (change,) = primals, tangents
    vectors = leading_eigenvectors(matrix, count)
    values, all_vectors = jnp.linalg.eigh(jax.lax.stop_gradient(matrix))
    values, complement = values[::-1], all_vectors[:, ::-1][:, count:]
    gap = values[None, :count] - values[count:, None]
    separate = gap > _SEPARATE * jnp.abs(values).max()
    inverse = jnp.where(separate, 1.0 / jnp.where(separate, gap, 1.0), 0.0)

    def project_out(x: jax.Array) -> jax.Array:
        return x - vectors @ (vectors.T @ x)

    def solve(right: jax.Array) -> jax.Array:
        return complement @ (inverse * (complement.T @ right))

    # Solve X Lambda - M X = right in the span of the other eigenvectors. The Newton step at the end does not change the
    # value, but makes second derivatives right: the derivative of `eigh` is infinite where eigenvalues repeat.
    right = project_out(0.5 * (change + change.T) @ vectors)
    solution = solve(right)
    residual = right - solution @ (vectors.T @ matrix @ vectors) + project_out(matrix @ solution)
    return vectors, project_out(solution + solve(residual))
