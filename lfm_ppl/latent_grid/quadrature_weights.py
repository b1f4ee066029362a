r"""Weights of the production on a grid in the state at the observation times.

Between the observations at t_(k-1) and t_k the state of dx/dt = A x + p(t) changes by

    int e^(A (t_k - s)) p(s) ds = sum_i int_(a_i)^(b_i) e^(A (t_k - s)) p(s) ds,

where the observation times cut cell i of the grid, between its points s_i and s_(i+1), to [a_i, b_i].

1. `cut_cells`: the cells that each observation needs, all observations the same number of cells, and their ends a, b.
2. On a cut cell p is constant ("riemann") or linear between its values at a and b ("trapezoid", "linear"); these are
   interpolated between the grid points of the cell.
3. The integral is length times e^(A (t_k - s_i)) p(s_i), length times the mean of the integrand at a and b, or exact.
4. `quadrature_weights`: sum the coefficients of each grid point over its two cells.
5. Matrix exponentials and their integrals are computed once for each distinct length (`map_distinct`).

Source: Lawrence, Sanguinetti and Rattray (2006), NIPS 19, for "riemann"; Van Loan (1978), IEEE Trans. Automatic Control
23(3), for the integrals of the matrix exponential.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.forces.phi_functions import phi_functions


class CutCells(eqx.Module):
    """The C cells that each of T observations needs, (T, C), cut to [a, b] in (t_(k-1), t_k].

    Attributes:
        first: (T,), index of the first grid point that each observation needs.
        length: b - a, zero for a cell outside of the interval.
        left, right: position of a and b in the cell: 0 at its first point, 1 at its last.
        since_point: t_k - s_i, at least 0.
        since_left, since_right: t_k - a and t_k - b.
    """

    first: np.ndarray
    length: np.ndarray
    left: np.ndarray
    right: np.ndarray
    since_point: np.ndarray
    since_left: np.ndarray
    since_right: np.ndarray


def cut_cells(grid: np.ndarray, times: np.ndarray) -> CutCells:
    """Return the cells between each observation and the one before it."""
    previous = np.concatenate([grid[:1], times[:-1]])
    cells = len(grid) - 1
    first = np.clip(np.searchsorted(grid, previous, side="right") - 1, 0, cells - 1)
    last = np.clip(np.searchsorted(grid, times, side="left") - 1, first, cells - 1)
    count = int((last - first).max()) + 1
    first = np.minimum(first, cells - count)
    cell = first[:, None] + np.arange(count)
    start, end, t = grid[cell], grid[cell + 1], times[:, None]
    a, b = np.clip(start, previous[:, None], t), np.clip(end, previous[:, None], t)
    width = end - start
    since_point = np.maximum(t - start, 0.0)
    return CutCells(first, b - a, (a - start) / width, (b - start) / width, since_point, t - a, t - b)


def quadrature_weights(cells: CutCells, transition: Callable, integrals: Callable, rank: int,
                       quadrature: str) -> jax.Array:
    """Return the weights of the grid points, (M, T, C + 1) for a diagonal A, else (M, M, T, C + 1).

    Args:
        cells: the cut cells.
        transition: maps an array of lengths h to e^(A h).
        integrals: maps an array of lengths h to 1/h int_0^h e^(A (h - s)) ds and 1/h int_0^h e^(A (h - s)) s/h ds.
        rank: of a transition: 1 for the diagonal of a matrix, 2 for a matrix.
        quadrature: one of `lfm_ppl.latent_grid.latent_grid.QUADRATURES`.
    """
    def broadcast(a: np.ndarray) -> jax.Array:
        return jnp.asarray(a).reshape(*a.shape, *[1] * rank)

    multiply = jnp.multiply if rank == 1 else jnp.matmul
    length = broadcast(cells.length)
    if quadrature == "riemann":
        point_weight, next_weight = length * transition(cells.since_point), jnp.zeros(())
    else:
        if quadrature == "trapezoid":
            left_weight = 0.5 * length * transition(cells.since_left)
            right_weight = 0.5 * length * transition(cells.since_right)
        else:
            constant, linear = integrals(cells.length)
            after_cell = transition(cells.since_right)
            left_weight = length * multiply(after_cell, constant - linear)
            right_weight = length * multiply(after_cell, linear)
        next_weight = broadcast(cells.left) * left_weight + broadcast(cells.right) * right_weight
        point_weight = left_weight + right_weight - next_weight
    padding = [(0, 0)] * point_weight.ndim
    padding[1] = (0, 1)
    weights = jnp.pad(point_weight, padding)
    return jnp.moveaxis(weights.at[:, 1:].add(next_weight), (0, 1), (-2, -1))


def scalar_integrals(z: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return (e^z - 1)/z and (e^z - 1 - z)/z^2; near zero by their series, where the formulas cancel."""
    is_small = jnp.abs(z) < 0.5
    safe = jnp.where(is_small, 1.0, z)
    small = jnp.where(is_small, z, 0.0)
    second = jnp.ones_like(z)
    for order in range(15, 2, -1):
        second = 1.0 + small * second / order
    second = 0.5 * second
    second = jnp.where(is_small, second, (jnp.expm1(safe) - safe) / safe**2)
    return 1.0 + z * second, second


def matrix_integrals(jacobian: jax.Array, length: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return e^(A h), 1/h int_0^h e^(A (h - s)) ds and 1/h int_0^h e^(A (h - s)) s/h ds, from one exponential."""
    exponential, constant, linear, _ = phi_functions(jacobian * length)
    return exponential, constant, linear


def map_distinct(function: Any, lengths: np.ndarray) -> Any:
    """Return ``function`` of every length, computed once for lengths that are equal up to rounding."""
    scale = max(float(np.max(lengths, initial=0.0)), np.finfo(float).tiny)
    _, first, inverse = np.unique(np.round(lengths / scale, 12), return_index=True, return_inverse=True)
    values = jax.vmap(function)(jnp.asarray(np.ravel(lengths)[first]))
    return jax.tree_util.tree_map(lambda a: a[inverse.reshape(np.shape(lengths))], values)
