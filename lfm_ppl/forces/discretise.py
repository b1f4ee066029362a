"""Exact discretisation of a linear SDE, without eigendecomposition, for any step length.

1. Divide the step dt by 2^s, so that F h with h = dt / 2^s has at most the size `SUBSTEP`.
2. Compute the terms (F h)^k / k! of the power series of exp(F h); their number makes the series exact to rounding.
3. Compute the process noise of the substep, the integral of exp(F s) D exp(F s)', by Gauss-Legendre quadrature. The
   powers of the nodes times the terms of step 2 give exp(F s) at all nodes without further matrix products.
4. Double s times: Q <- Q + Phi Q Phi', Phi <- Phi Phi. Sums of congruences keep Q positive semi-definite.
5. `repeat` runs the doublings in blocks and skips those that no step needs, so that s may be traced and large.

No eigendecomposition is involved, so that repeated eigenvalues, nilpotent F and gradients need no special treatment.

Source: Van Loan (1978), IEEE Transactions on Automatic Control 23(3), section II; Al-Mohy and Higham (2009), SIAM J.
Matrix Anal. Appl. 31(3).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lfm_ppl.utils.linalg import matmul

SUBSTEP = 0.5
"""Largest size of F h on a substep; 13 terms of the power series are then exact to rounding."""

MOST_DOUBLINGS = 104
"""Default bound on the number of doublings, for F h up to 1e31."""

_BLOCK = 8
"""Doublings that are skipped together; reverse mode stores their result alone."""

_LARGEST_VECTORISED = 8
"""Largest dimension of `discretise_steps` whose products are broadcast; XLA's dot is faster above it."""


@functools.partial(jax.jit, static_argnames="max_doublings")
def discretise(
    feedback: jax.Array, diffusion: jax.Array, dt: ArrayLike, max_doublings: int = MOST_DOUBLINGS
) -> tuple[jax.Array, jax.Array]:
    """Return transition matrix and process noise of a linear SDE over one step.

    For ``dz = F z dt + L dbeta`` with ``D = L L'`` these are

        Phi = exp(F dt),    Q = int_0^dt exp(F s) D exp(F s)' ds.

    ``Q`` is a sum of congruences of ``D``: it is positive semi-definite by construction and its small entries have
    full relative accuracy. No intermediate grows with dt where F is stable. The gradient is finite everywhere, also
    at dt = 0.

    Args:
        feedback: ``F`` of shape (n, n), in 1/time.
        diffusion: ``D`` of shape (n, n), symmetric positive semi-definite.
        dt: length of the step, a scalar >= 0.
        max_doublings: static bound on s. Each doubling doubles the admissible size of ``F dt``.

    Returns:
        ``Phi`` (n, n) and ``Q`` (n, n). Both are NaN where ``F dt`` needs more than `max_doublings` doublings.

    Example:
        >>> import jax.numpy as jnp
        >>> transition, noise = discretise(-jnp.eye(1), 2.0 * jnp.eye(1), 0.5)
        >>> bool(jnp.allclose(noise, 1.0 - transition**2))
        True

    Source:
        Van Loan (1978), IEEE Transactions on Automatic Control 23(3), section II, for the doubling
        of Q; Al-Mohy and Higham (2009), SIAM J. Matrix Anal. Appl. 31(3), for the choice of s.
    """
    feedback, diffusion, dt = as_arrays(feedback, diffusion, dt)
    series, step, doublings = substep_series(feedback, dt)
    nodes, weights = _quadrature(series)
    transition = (powers(nodes, len(series))[:, :, None, None] * series).sum(1)
    integrand = matmul(matmul(transition, diffusion), transition.mT)
    noise = step * (weights[:, None, None] * integrand).sum(0)
    return double(series.sum(0), noise, doublings, max_doublings)


def discretise_steps(
    feedback: jax.Array, diffusion: jax.Array | None, dt: jax.Array, max_doublings: int = MOST_DOUBLINGS
) -> tuple[jax.Array, jax.Array]:
    """Return transitions and process noises of steps of many lengths, as `discretise` does for each of them.

    The powers of ``F`` are shared by all steps. The axis of the steps is the last one of all arrays, along which XLA
    vectorises.

    Args:
        feedback: ``F`` of shape (n, n), in 1/time.
        diffusion: ``D`` of shape (n, n), symmetric positive semi-definite; None: no noise.
        dt: lengths of the steps, (B,).
        max_doublings: as in `discretise`.

    Returns:
        ``Phi`` and ``Q``, (B, n, n) each.

    Example:
        >>> import jax.numpy as jnp
        >>> transition, _ = discretise_steps(-jnp.eye(1), jnp.eye(1), jnp.array([0.0, 1.0]))
        >>> [round(float(entry), 4) for entry in transition[:, 0, 0]]
        [1.0, 0.3679]
    """
    has_noise = diffusion is not None
    feedback, diffusion, dt = as_arrays(feedback, diffusion if has_noise else jnp.zeros_like(feedback), dt)
    if feedback.shape[0] > _LARGEST_VECTORISED:
        return jax.vmap(discretise, (None, None, 0, None))(feedback, diffusion, dt, max_doublings)
    rate = _growth(jax.lax.stop_gradient(feedback))
    doublings = doublings_for(rate * dt)
    step = dt * jnp.exp2(-doublings)
    unit = jnp.where(rate > 0.0, rate, 1.0)
    series = _power_series(feedback / unit)

    def transition_over(times: jax.Array) -> jax.Array:
        return jnp.tensordot(series, powers(unit * times, len(series)), axes=(0, -1))

    def double_once(phi: jax.Array, *noise: jax.Array) -> tuple[jax.Array, ...]:
        return _product(phi, phi), *(q + _product(_product(phi, q), phi.swapaxes(0, 1)) for q in noise)

    values: tuple[jax.Array, ...] = (transition_over(step),)
    if has_noise:
        nodes, weights = _quadrature(series)
        to_end = transition_over(nodes[:, None] * step)
        integrand = _product(_product(to_end, diffusion[:, :, None, None]), to_end.swapaxes(0, 1))
        values = *values, step * (weights[:, None] * integrand).sum(-2)
    phi, *noise = repeat(double_once, values, doublings, max_doublings)
    is_complete = doublings <= max_doublings
    phi, *noise = (jnp.moveaxis(jnp.where(is_complete, value, jnp.nan), -1, 0)
                   for value in (phi, *(0.5 * (q + q.swapaxes(0, 1)) for q in noise)))
    return phi, noise[0] if has_noise else jnp.zeros_like(phi)


def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the products of matrices (n, n, ...) whose first two axes are rows and columns.

    A sum of outer products, because XLA's reduction over the middle axis takes two to nine times as long on a CPU.
    """
    return functools.reduce(jnp.add, [a[:, k, None] * b[k] for k in range(a.shape[1])])


@functools.partial(jax.jit, static_argnames="max_doublings")
def discretise_dispersion(
    feedback: jax.Array, dispersion: jax.Array, dt: ArrayLike, max_doublings: int = MOST_DOUBLINGS
) -> tuple[jax.Array, jax.Array]:
    """Return transition matrix and process noise as `discretise` does, given ``L`` instead of ``D = L L'``.

    It is cheaper for few noise inputs, since only the columns ``exp(F s) L`` are formed.

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
    feedback, dispersion, dt = as_arrays(feedback, dispersion, dt)
    series, step, doublings = substep_series(feedback, dt)
    return discretise_series(series, dispersion, step, doublings, max_doublings)


@functools.partial(jax.jit, static_argnames="max_doublings")
def discretise_series(
    series: jax.Array,
    dispersion: jax.Array,
    step: ArrayLike,
    doublings: jax.Array,
    max_doublings: int,
) -> tuple[jax.Array, jax.Array]:
    """Return transition and noise over ``2^doublings`` substeps, given the power series of one substep.

    Args:
        series: terms ``(F h)^k / k!`` for k = 0, 1, ..., of shape (K, n, n), on the short step h.
        dispersion: ``L`` (n, S).
        step: h, a scalar.
        doublings: number s of doublings, a whole number that may be traced.
        max_doublings: static bound on s.

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
    """Return transition and noise over a step ``2^doublings`` times as long.

    Args:
        transition: ``Phi`` (n, n) of the short step.
        noise: ``Q`` (n, n) of the short step.
        doublings: number of doublings, a whole number that may be traced.
        max_doublings: static bound on their number; the result is NaN for more doublings.

    Returns:
        ``Phi`` (n, n) and ``Q`` (n, n) of the long step.
    """

    def double_once(phi: jax.Array, q: jax.Array) -> tuple[jax.Array, jax.Array]:
        return matmul(phi, phi), q + matmul(matmul(phi, q), phi.mT)

    phi, q = repeat(double_once, (transition, noise), doublings, max_doublings)
    is_complete = doublings <= max_doublings
    return jnp.where(is_complete, phi, jnp.nan), jnp.where(is_complete, 0.5 * (q + q.mT), jnp.nan)


def repeat(function: Callable[..., tuple], values: tuple, count: jax.Array, most: int) -> Any:
    """Apply ``values = function(*values)`` a number of times that may be traced.

    Applications, and blocks of them, that no problem needs are skipped, also under ``jax.vmap``.

    Args:
        function: from arrays to arrays of the same shapes.
        values: the arrays before the first application.
        count: how often it is applied, a whole number; of many problems at once with the shape of the last axes.
        most: static bound on ``count``.
    """

    def unless_finished(body: Callable[[tuple, jax.Array], tuple]) -> Callable[[tuple, jax.Array], tuple[tuple, None]]:
        def step(values: tuple, index: jax.Array) -> tuple[tuple, None]:
            is_needed = eqxi.unvmap_any(index < count)
            return jax.lax.cond(is_needed, lambda: body(values, index), lambda: values), None

        return step

    def apply_once(values: tuple, index: jax.Array) -> tuple:
        return jax.tree.map(lambda new, old: jnp.where(index < count, new, old), function(*values), values)

    def apply_block(values: tuple, first: jax.Array) -> tuple:
        return jax.lax.scan(unless_finished(apply_once), values, first + jnp.arange(_BLOCK))[0]

    starts = jnp.arange(0, most, _BLOCK)
    return jax.lax.scan(jax.checkpoint(unless_finished(apply_block), prevent_cse=False), values, starts)[0]


def step_tangent(
    feedback: ArrayLike, dispersion: ArrayLike, transition: jax.Array, tangent: ArrayLike
) -> tuple[jax.Array, jax.Array]:
    """Return the derivatives ``F Phi`` and ``Phi L L' Phi'`` of transition and noise in dt, times ``tangent``.

    They are exact, and much cheaper than differentiating the computation of Phi and Q.
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

    They are products rather than calls of ``**``, so that every derivative at zero is finite.
    """
    base = jnp.asarray(base)
    columns = [jnp.ones_like(base)]
    for _ in range(count - 1):
        columns.append(columns[-1] * base)
    return jnp.stack(columns, -1)


def term_count(state_dim: int) -> int:
    """Return the number of terms after which the power series of a substep is exact to rounding.

    A chain of n integrators has entries whose leading term is of order h^(n-1). The series must be exact relative to
    the leading term of every entry.
    """
    return 1 + max(13, min(state_dim, 8) + 9)


def as_arrays(*values: Any) -> tuple[jax.Array, ...]:
    """Return arrays of the common floating type of values."""
    dtype = jnp.result_type(float, *values)
    return tuple(jnp.asarray(value, dtype) for value in values)


def substep_series(feedback: jax.Array, dt: ArrayLike) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Divide a step into ``2^s`` substeps on which the power series of the transition converges.

    Args:
        feedback: ``F`` (n, n), in 1/time.
        dt: length of the step, a scalar.

    Returns:
        Terms ``(F h)^k / k!`` (K, n, n), k = 0, 1, ..., the substep h and the number s of doublings.
    """
    doublings = doublings_for(_growth(jax.lax.stop_gradient(feedback * dt)))
    step = jnp.exp2(-doublings) * dt
    return _power_series(feedback * step), step, doublings


def _power_series(scaled):
    """Return the terms ``X^k / k!`` (K, n, n) of the power series of exp(X)."""

    def body(term, k):
        return matmul(scaled, term) / k, term

    orders = jnp.arange(1, 1 + term_count(scaled.shape[0]), dtype=scaled.dtype)
    return jax.lax.scan(body, jnp.eye(scaled.shape[0], dtype=scaled.dtype), orders)[1]


def _growth(matrix):
    """Return the larger of ``||X^3||^(1/3)`` and ``||X^4||^(1/4)``.

    Like the norm of X it bounds the terms of order 6 and higher of the power series, but it is much smaller where
    coordinates have different units, and zero for short chains of integrators. A smaller bound means fewer doublings
    and less rounding error.
    """
    norm = _norm(matrix)
    unit = matrix / jnp.where(norm > 0.0, norm, 1.0)
    square = matmul(unit, unit)
    third, fourth = _norm(matmul(square, unit)), _norm(matmul(square, square))
    return norm * jnp.maximum(jnp.cbrt(third), jnp.sqrt(jnp.sqrt(fourth)))


def _norm(matrix):
    return jnp.abs(matrix).sum(-2).max(initial=0.0)


def _quadrature(series):
    # m nodes are exact to degree 2m - 1; a chain of n integrators has an integrand of order s^(2n-2).
    rule = gauss_legendre(min(max(6, series.shape[-1] + 3), 12))
    return tuple(jnp.asarray(array, series.dtype) for array in rule)
