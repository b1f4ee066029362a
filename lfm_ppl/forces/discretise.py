"""Exact discretisation of a linear SDE, without eigendecomposition, for any step length."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lfm_ppl.linalg import matmul

SUBSTEP = 0.5
"""Largest size of F h at which the power series starts; 13 terms of it are exact to rounding."""


@functools.partial(jax.jit, static_argnames="max_doublings")
def discretise(
    feedback: jax.Array, diffusion: jax.Array, dt: ArrayLike, max_doublings: int = 32
) -> tuple[jax.Array, jax.Array]:
    """Return transition matrix and process noise of a linear SDE over one step.

    For ``dz = F z dt + L dbeta`` with ``D = L L'`` these are

        Phi = exp(F dt),    Q = int_0^dt exp(F s) D exp(F s)' ds.

    Both are computed on a substep ``h = dt / 2^s`` (power series, Gauss-Legendre nodes) and then
    doubled s times, ``Q <- Q + Phi Q Phi'`` and ``Phi <- Phi Phi``. ``Q`` is a sum of congruences
    of ``D``, so it is positive semi-definite by construction and its tiny entries are accurate
    relative to themselves; nothing grows with dt when F is stable. Repeated roots and nilpotent
    ``F`` are ordinary cases. The gradient is finite everywhere, dt = 0 included.

    Args:
        feedback: ``F`` of shape (n, n), in 1/time.
        diffusion: ``D`` of shape (n, n), symmetric positive semi-definite.
        dt: length of the step, a scalar >= 0.
        max_doublings: static bound on s. Each doubling doubles the admissible size of ``F dt``;
            32 reach 2e9. Lower it where the steps are known to be short: the cost is linear in it.

    Returns:
        ``Phi`` (n, n) and ``Q`` (n, n). Both are NaN where ``F dt`` exceeds what `max_doublings`
        reach.

    Example:
        >>> import jax.numpy as jnp
        >>> transition, noise = discretise(-jnp.eye(1), 2.0 * jnp.eye(1), 0.5)
        >>> bool(jnp.allclose(noise, 1.0 - transition**2))
        True

    Source:
        Van Loan (1978), IEEE Transactions on Automatic Control 23(3), section II, for the doubling
        of Q; Al-Mohy and Higham (2009), SIAM J. Matrix Anal. Appl. 31(3), for the choice of s.
    """
    feedback, diffusion, dt = _as_arrays(feedback, diffusion, dt)
    series, step, doublings = _start(feedback, dt)
    nodes, weights = _quadrature(series)
    transition = (powers(nodes, len(series))[:, :, None, None] * series).sum(1)
    integrand = matmul(matmul(transition, diffusion), transition.mT)
    noise = step * (weights[:, None, None] * integrand).sum(0)
    return double(series.sum(0), noise, doublings, max_doublings)


@functools.partial(jax.jit, static_argnames="max_doublings")
def discretise_dispersion(
    feedback: jax.Array, dispersion: jax.Array, dt: ArrayLike, max_doublings: int = 32
) -> tuple[jax.Array, jax.Array]:
    """Return the same as `discretise`, from the dispersion ``L`` in place of ``D = L L'``.

    It is cheaper when there are few noise inputs: only the columns ``exp(F s) L`` are formed.

    Args:
        feedback: ``F`` of shape (n, n), in 1/time.
        dispersion: ``L`` of shape (n, S).
        dt: length of the step, a scalar >= 0.
        max_doublings: as in `discretise`.

    Returns:
        ``Phi`` (n, n) and ``Q`` (n, n).

    Example:
        >>> import jax.numpy as jnp
        >>> transition, noise = discretise_dispersion(jnp.zeros((1, 1)), jnp.ones((1, 1)), 3.0)
        >>> round(float(noise[0, 0]), 4)
        3.0
    """
    feedback, dispersion, dt = _as_arrays(feedback, dispersion, dt)
    series, step, doublings = _start(feedback, dt)
    return discretise_series(series, dispersion, step, doublings, max_doublings)


@functools.partial(jax.jit, static_argnames="max_doublings")
def discretise_series(
    series: jax.Array,
    dispersion: jax.Array,
    step: ArrayLike,
    doublings: jax.Array,
    max_doublings: int,
) -> tuple[jax.Array, jax.Array]:
    """Return transition and noise over ``2^doublings`` steps, from the power series of one.

    Args:
        series: terms ``(F h)^k / k!`` for k = 0, 1, ..., of shape (K, n, n), on the short step h.
        dispersion: ``L`` (n, S).
        step: h, a scalar.
        doublings: how often to double, a whole number that may be traced.
        max_doublings: static bound on it.

    Returns:
        ``Phi`` (n, n) and ``Q`` (n, n) of the long step.
    """
    nodes, weights = _quadrature(series)
    columns = matmul(series, dispersion)
    columns = (powers(nodes, len(series))[:, :, None, None] * columns).sum(1)
    columns = jnp.moveaxis(columns * jnp.sqrt(weights)[:, None, None], 0, 1)
    columns = columns.reshape(series.shape[-1], -1)
    noise = jnp.asarray(step) * (columns[:, None, :] * columns[None, :, :]).sum(-1)
    return double(series.sum(0), noise, doublings, max_doublings)


def double(
    transition: jax.Array, noise: jax.Array, doublings: jax.Array, max_doublings: int
) -> tuple[jax.Array, jax.Array]:
    """Return transition and noise over a step that is ``2^doublings`` times as long.

    Args:
        transition: ``Phi`` (n, n) of the short step.
        noise: ``Q`` (n, n) of the short step.
        doublings: how often to double, a whole number that may be traced.
        max_doublings: static length of the loop; more doublings than this give NaN.

    Returns:
        ``Phi`` (n, n) and ``Q`` (n, n) of the long step.
    """

    def body(index, carry):
        phi, q = carry
        active = index < doublings
        q_twice = q + matmul(matmul(phi, q), phi.mT)
        return jnp.where(active, matmul(phi, phi), phi), jnp.where(active, q_twice, q)

    phi, q = jax.lax.fori_loop(0, max_doublings, body, (transition, noise))
    reached = doublings <= max_doublings
    return jnp.where(reached, phi, jnp.nan), jnp.where(reached, 0.5 * (q + q.mT), jnp.nan)


def step_tangent(
    feedback: ArrayLike, dispersion: ArrayLike, transition: jax.Array, tangent: ArrayLike
) -> tuple[jax.Array, jax.Array]:
    """Return the derivatives ``F Phi`` and ``Phi L L' Phi'`` in dt, times ``tangent``.

    They are exact and much cheaper than to differentiate the way in which Phi and Q are computed.
    """
    column = matmul(transition, jnp.asarray(dispersion))
    rate = jnp.asarray(tangent)
    return rate * matmul(jnp.asarray(feedback), transition), rate * matmul(column, column.mT)


def doublings_for(size: jax.Array) -> jax.Array:
    """Return the number s of halvings, as a float >= 0, with ``size / 2^s <= SUBSTEP``."""
    ratio = jax.lax.stop_gradient(size) / SUBSTEP
    return jnp.ceil(jnp.log2(jnp.maximum(ratio, 1.0)))


def gauss_legendre(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes and weights (count,) of the Gauss-Legendre rule on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (nodes + 1.0), 0.5 * weights


def powers(base: ArrayLike, count: int) -> jax.Array:
    """Return ``base^k`` for k = 0, ..., count - 1 in a new last axis.

    By multiplication, so that every derivative at zero is finite.
    """
    base = jnp.asarray(base)
    columns = [jnp.ones_like(base)]
    for _ in range(count - 1):
        columns.append(columns[-1] * base)
    return jnp.stack(columns, -1)


def term_count(state_dim: int) -> int:
    """Return how many terms of the power series reach rounding level on a short step.

    A chain of n integrators has entries of order h^(n-1); the terms that follow the leading one,
    of every entry, must reach rounding level too.
    """
    return 1 + max(13, min(state_dim, 8) + 9)


def _as_arrays(*values):
    dtype = jnp.result_type(float, *values)
    return tuple(jnp.asarray(value, dtype) for value in values)


def _start(feedback, dt):
    """Terms ``(F h)^k / k!`` of the power series on the substep h, h itself, and s."""
    doublings = doublings_for(_growth(jax.lax.stop_gradient(feedback * dt)))
    step = dt * jnp.exp2(-doublings)
    scaled = feedback * step

    def body(term, k):
        return matmul(scaled, term) / k, term

    orders = jnp.arange(1, 1 + term_count(feedback.shape[0]), dtype=feedback.dtype)
    _, series = jax.lax.scan(body, jnp.eye(feedback.shape[0], dtype=feedback.dtype), orders)
    return series, step, doublings


def _growth(matrix):
    """Return the larger of ``||X^3||^(1/3)`` and ``||X^4||^(1/4)``.

    It bounds the terms of order 6 and more of the power series as the norm of X does, and is much
    smaller where coordinates have different units, and zero for short chains of integrators: fewer
    doublings, and less rounding.
    """
    norm = _norm(matrix)
    unit = matrix / jnp.where(norm > 0.0, norm, 1.0)
    square = matmul(unit, unit)
    third, fourth = _norm(matmul(square, unit)), _norm(matmul(square, square))
    return norm * jnp.maximum(jnp.cbrt(third), jnp.sqrt(jnp.sqrt(fourth)))


def _norm(matrix):
    return jnp.abs(matrix).sum(-2).max(initial=0.0)


def _quadrature(series):
    # m nodes are exact to degree 2m - 1; a chain of n states has an integrand of order s^(2n-2).
    rule = gauss_legendre(min(max(6, series.shape[-1] + 3), 12))
    return tuple(jnp.asarray(part, series.dtype) for part in rule)
