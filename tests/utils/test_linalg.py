"""Small matrices: against NumPy, and where matrices are singular."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from lfm_ppl.utils.gaussian_residuals import log_density, masked
from lfm_ppl.utils.linalg import cholesky, congruence, matmul, outer_square, safe_sqrt, solve_lower, solve_upper
from lfm_ppl.utils.semidefinite import pivoted_root, semidefinite_root, solve_semidefinite


def definite(size, rank=None, seed=0):
    root = np.random.default_rng(seed).normal(size=(size, size if rank is None else rank))
    return root @ root.T


@pytest.mark.parametrize("shapes", [((3, 4), (4, 2)), ((5, 2, 3), (3, 6)), ((12, 9), (9, 11)), ((0, 0), (0, 1)),
                                    ((2, 0), (0, 3))])
def test_products(shapes):
    a, b = (np.random.default_rng(i).normal(size=shape) for i, shape in enumerate(shapes))
    assert np.allclose(matmul(jnp.asarray(a), jnp.asarray(b)), a @ b, rtol=1e-13)
    p = definite(shapes[0][-1])
    assert np.allclose(congruence(jnp.asarray(a), jnp.asarray(p)), a @ p @ np.swapaxes(a, -1, -2), rtol=1e-12)
    square = outer_square(jnp.asarray(a))
    assert np.array_equal(square, np.swapaxes(square, -1, -2))


@pytest.mark.parametrize("shapes", [((3, 4), (4, 4)), ((5, 2, 3), (3, 3)), ((2, 3), (5, 3, 3)), ((0, 2), (2, 2))])
def test_derivatives_of_products(shapes):
    """In both modes, of second order too, and beside a constant: equal to derivatives of A P A' by the product rule."""
    rng = np.random.default_rng(3)
    a, change, turn, weight = (rng.normal(size=size) for size in (shapes[0], shapes[0], shapes[1], shapes[1]))
    p, change_of_p = turn + np.swapaxes(turn, -1, -2), weight + np.swapaxes(weight, -1, -2)

    def plain(a, p):
        return jnp.einsum("...ij,...jk,...lk->...il", a, p, a)

    def slope(function, x, directions):
        """Tangent of the square of the value along a direction, and its own gradient."""
        def total(*x):
            return jax.jvp(lambda *x: (function(*x) ** 2).sum(), x, directions)[1]
        return [total(*x), *jax.grad(total, tuple(range(len(x))))(*x)]

    def symmetrised(result):
        return [part + np.swapaxes(part, -1, -2) if np.shape(part) == p.shape else part for part in result]

    cases = [(congruence, plain, (a, p), (change, change_of_p)),
             (lambda a: congruence(a, p), lambda a: plain(a, p), (a,), (change,)),
             (lambda p: congruence(jnp.asarray(a), p), lambda p: plain(a, p), (p,), (change_of_p,)),
             (outer_square, lambda a: a @ jnp.swapaxes(a, -1, -2), (a,), (change,))]
    for ours, theirs, x, directions in cases:
        # The gradient in a symmetric matrix is known up to an antisymmetric part.
        for result, expected in zip(*(symmetrised(slope(f, x, directions)) for f in (ours, theirs)), strict=True):
            assert np.allclose(result, expected, rtol=1e-10, atol=1e-10 * np.abs(expected).max(initial=1.0))


@pytest.mark.slow
def test_derivatives_of_a_congruence_off_symmetry():
    """Of a matrix that is not symmetric the symmetric part counts, in the first and the second order."""
    rng = np.random.default_rng(4)
    a, general = rng.normal(size=(2, 3)), rng.normal(size=(3, 3))

    def plain(a, p):
        return a @ (p + p.T) @ a.T / 2

    for p in (general, definite(3)):
        for derivative in (jax.jacfwd, jax.jacrev, jax.hessian):
            for of in (0, 1):
                np.testing.assert_allclose(derivative(congruence, of)(jnp.asarray(a), jnp.asarray(p)),
                                           derivative(plain, of)(a, p), atol=1e-12)
        mixed = [jax.jacfwd(jax.jacrev(f, 0), 1)(jnp.asarray(a), jnp.asarray(p)) for f in (congruence, plain)]
        np.testing.assert_allclose(*mixed, atol=1e-12)


@pytest.mark.parametrize("size", [1, 2, 9])
def test_cholesky_and_triangular_solves(size):
    p, b = definite(size), np.random.default_rng(1).normal(size=(size, 3))
    factor = cholesky(jnp.asarray(p))
    assert np.allclose(factor.chol, np.linalg.cholesky(p), rtol=1e-10) and not factor.degenerate.any()
    assert np.allclose(solve_lower(factor.chol, jnp.asarray(b)), np.linalg.solve(np.asarray(factor.chol), b))
    assert np.allclose(solve_upper(factor.chol, jnp.asarray(b)), np.linalg.solve(np.asarray(factor.chol).T, b))
    assert np.allclose(solve_semidefinite(jnp.asarray(p), jnp.asarray(b)), np.linalg.solve(p, b), rtol=1e-7)
    assert np.allclose(solve_semidefinite(jnp.asarray(p), jnp.asarray(b[:, 0])), np.linalg.solve(p, b[:, 0]), rtol=1e-7)


@pytest.mark.parametrize("rank", [0, 1, 3])
@pytest.mark.parametrize("scale", [np.ones(5), np.array([1e-9, 1.0, 1e6, 1e-3, 1e9])])
def test_singular_matrices(rank, scale):
    """P X = B for B in the range of P; directions that are null are zero in the root."""
    p = definite(5, rank) * scale[:, None] * scale
    target = p @ np.random.default_rng(2).normal(size=(5, 2))
    solution = np.asarray(solve_semidefinite(jnp.asarray(p), jnp.asarray(target)))
    assert np.allclose(p @ solution / scale[:, None], target / scale[:, None], rtol=1e-6, atol=1e-6)
    root = np.asarray(semidefinite_root(jnp.asarray(p)))
    assert np.allclose(root @ root.T / scale[:, None] / scale, p / scale[:, None] / scale, atol=1e-12)
    assert (np.linalg.matrix_rank(root / scale[:, None], tol=1e-6) == rank)
    pivoted = np.asarray(pivoted_root(jnp.asarray(p)))
    assert np.allclose(pivoted @ pivoted.T / scale[:, None] / scale, p / scale[:, None] / scale, atol=1e-14)


@pytest.mark.parametrize("count", [2, 6, 12])
def test_a_pivoted_root_is_as_accurate_as_a_matrix_that_is_singular_but_for_rounding(count):
    """Gram matrices of exp(-d s) on [0, 2], whose last conditional variances are far below their rounding errors."""
    d = np.linspace(0.3, 1.0, count)
    rates = d[:, None] + d
    gram = -np.expm1(-2.0 * rates) / rates
    with_white = np.block([[gram, 0.7 * gram[:, -1:]], [0.7 * gram[-1:], gram[-1:, -1:]]])
    for p in (gram, with_white, np.zeros((count, count)), np.zeros((0, 0))):
        root = np.asarray(pivoted_root(jnp.asarray(p)))
        np.testing.assert_allclose(root @ root.T, p, atol=1e-14)


def test_degenerate_pivots_are_reported_and_replaced():
    p = jnp.diag(jnp.array([2.0, 0.0, -1.0, 1e-3]))
    factor = cholesky(p, floor=1e-2)
    assert factor.degenerate.tolist() == [False, True, True, True]
    assert np.allclose(jnp.diagonal(factor.chol), np.sqrt([2.0, 1e-2, 1e-2, 1e-2]))
    assert jnp.diagonal(cholesky(p).chol)[1] == 1.0
    assert jnp.diagonal(cholesky(p, keep=False).chol)[1] == 0.0


def test_gradients_stay_finite_where_nothing_varies():
    grad = jax.grad(lambda s: semidefinite_root(s * jnp.eye(2)).sum() + safe_sqrt(s))
    assert np.isfinite(grad(0.0)) and np.isclose(grad(4.0), 0.75)
    assert jax.grad(safe_sqrt)(0.0) == 0.0 and jax.grad(safe_sqrt)(-1.0) == 0.0
    solve = jax.grad(lambda s: solve_semidefinite(s * jnp.ones((2, 2)), s * jnp.ones(2)).sum())
    assert np.isfinite(solve(0.0)) and np.isfinite(solve(1.0))


def by_columns(p, floor, keep):
    """Factorise column by column, for JAX to differentiate operation by operation."""
    rows, columns = np.arange(len(p)), []
    for j in range(len(p)):
        column = p[:, j] - sum((previous * previous[j] for previous in columns), jnp.zeros(len(p)))
        positive = column[j] > floor[j]
        root = jnp.sqrt(jnp.where(positive, column[j], jnp.where(floor[j] > 0, floor[j], 1.0)))
        diagonal = root if keep else jnp.where(positive, root, 0.0)
        below = jnp.where(positive, column / root, 0.0)
        columns.append(jnp.where(rows > j, below, jnp.where(rows == j, diagonal, 0.0)))
    chol = jnp.stack(columns, axis=-1)
    return chol, solve_lower(chol, jnp.eye(len(p)))


def at_once(p, floor, keep):
    factor = cholesky(p, floor, keep)
    return factor.chol, factor.inverse


@functools.partial(jax.jit, static_argnums=(0, 1))
def derivatives(factorise, keep, root, live, weights, floor):
    def value(z):
        scaled = root * (1.0 + z[0] * jnp.arange(5.0)) + 0.3 * z[1] * live[:, None]
        result = factorise(outer_square(scaled), floor * (1.0 + z[2]), keep)
        return sum((weight * jnp.tril(matrix)).sum() for weight, matrix in zip(weights, result, strict=True))

    z = jnp.array([0.1, 0.2, 0.3])
    grad = jax.grad(value)
    return value(z), grad(z), jax.jacfwd(value)(z), jax.hessian(value)(z), jax.vmap(grad)(jnp.stack([z, -z]))


@pytest.mark.thorough
@pytest.mark.parametrize("floor", [[0.0, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0, 2.0], [0.3, 0.3, 0.3, 0.3]])
@pytest.mark.parametrize("dead", [(), (0,), (1, 3), (2,)])
def test_derivatives_of_a_factor_are_those_of_its_operations(floor, dead):
    """Forwards, backwards, twice and side by side, for regular and degenerate pivots, which depend on their floor."""
    live = np.array([index not in dead for index in range(4)], float)
    root = np.random.default_rng(0).normal(size=(4, 5)) * live[:, None]
    weights = np.random.default_rng(1).normal(size=(2, 4, 4))

    results = (derivatives(f, True, root, live, weights, np.array(floor)) for f in (at_once, by_columns))
    for result, expected in zip(*results, strict=True):
        np.testing.assert_allclose(result, expected, rtol=1e-11, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("indices", [(0, 1, 2), (2,), (2, 0), (1, -1, 2, 3), (-1, -1, 0)])
def test_a_constant_matrix_that_selects_takes_slices(indices):
    pick = np.array([np.eye(4)[index] if index >= 0 else np.zeros(4) for index in indices])
    a = jnp.asarray(np.random.default_rng(0).normal(size=(2, 4, 4)))
    assert np.array_equal(matmul(pick, a), pick @ a) and np.array_equal(matmul(a, pick.T), a @ pick.T)
    assert np.array_equal(congruence(pick, definite(4)), pick @ definite(4) @ pick.T)
    assert "dot" not in str(jax.make_jaxpr(lambda a: matmul(pick, a))(a))
    assert isinstance(matmul(pick, np.eye(4)), np.ndarray)


@pytest.mark.thorough
@pytest.mark.parametrize("missing", [(), (1,), (0, 2), (0, 1, 2)])
def test_density_of_what_is_not_missing(missing):
    covariance, residual = definite(3), np.array([0.3, -1.2, 0.7])
    present = ~np.isin(np.arange(3), missing)

    def density(residual, covariance):
        some, matrix = masked(residual, covariance, jnp.isfinite(residual))
        chol = cholesky(matrix).chol
        return log_density(solve_lower(chol, some), chol, jnp.isfinite(residual))

    masked_residual = jnp.where(present, residual, jnp.nan)
    block = np.ix_(present, present)
    expected = stats.multivariate_normal.logpdf(residual[present], cov=covariance[block]) if present.any() else 0.0
    assert float(density(masked_residual, jnp.asarray(covariance))) == pytest.approx(expected, rel=1e-13)
    by_residual, by_covariance = jax.grad(density, argnums=(0, 1))(masked_residual, jnp.asarray(covariance))
    assert np.isfinite(by_residual).all() and np.isfinite(by_covariance).all()
    assert not by_residual[~present].any() and not by_covariance[~present].any()
    batch = jnp.stack([masked_residual, 2.0 * masked_residual])
    assert np.allclose(jax.vmap(density, (0, None))(batch, covariance), [density(row, covariance) for row in batch])
