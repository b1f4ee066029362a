"""Each rule alone, against dense Gauss-Hermite quadrature."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from references import gauss_hermite
from rules import RULES

import lfm_ppl as lfm
from lfm_ppl.cli import options
from lfm_ppl.linearisation.input_selection import InputStructure
from lfm_ppl.linearisation.rule import Inputs
from lfm_ppl.linearisation.sigma_points import SigmaPointRule

SIGMA = [rule for rule in RULES if isinstance(rule, SigmaPointRule)]
MEAN = np.array([0.3, -0.5, 0.8, 0.1])
ROOT = np.random.default_rng(0).normal(size=(4, 4)) * np.array([[0.5], [0.8], [0.3], [1.0]])
COVARIANCE = ROOT @ ROOT.T
DENSE = gauss_hermite(4, 9)


def test_every_public_rule_is_in_the_list_and_has_a_word_on_the_command_line():
    public = {name: getattr(lfm, name) for name in lfm.__all__}
    kinds = {name for name, cls in public.items() if isinstance(cls, type) and issubclass(cls, lfm.Rule)} - {"Rule"}
    assert kinds == {type(rule).__name__ for rule in RULES}, "add it to tests/rules.py"
    assert kinds == set(options.RULES.values()), "give it a word in RULES of lfm_ppl/cli/options.py"


def structure(points, averaged=(), constant=()):
    return InputStructure(points, averaged, constant, ((True,) * 4,), True)


def linearise(rule, function, where, slope=None, covariance=COVARIANCE, outputs=2):
    indices = list((*where.nonlinear, *where.averaged))
    inputs = Inputs(jnp.asarray(MEAN), jnp.asarray(covariance[np.ix_(indices, indices)]),
                    1e-6 * jnp.ones(len(where.nonlinear)))
    slope = jnp.zeros((outputs, 4)) if slope is None else slope
    return rule.linearise(lambda v: (function(v), function(v) ** 2), inputs, where, slope)


def exact(function, covariance=COVARIANCE):
    """E f, A = Cov(f, v) P^-1 and Omega, by a tensor of 9 Gauss-Hermite points an input."""
    points = MEAN + DENSE.nodes @ np.linalg.cholesky(covariance).T
    values = np.asarray(jax.vmap(function)(jnp.asarray(points)))
    mean = DENSE.weights @ values
    centred = values - mean
    cross = (DENSE.weights[:, None] * centred).T @ (points - MEAN)
    slope = np.linalg.solve(covariance, cross.T).T
    return mean, slope, (DENSE.weights[:, None] * centred).T @ centred - slope @ covariance @ slope.T


LINEAR = np.array([[1.0, -2.0, 0.5, 0.3], [0.0, 1.0, 1.0, -1.0]])


def ids(rule):
    return rule.name


@pytest.mark.parametrize("rule", RULES, ids=ids)
def test_linear_functions_are_exact(rule):
    result = linearise(rule, lambda v: jnp.asarray(LINEAR) @ v + 0.7, structure((0, 1, 2, 3)))
    assert np.allclose(result.value, LINEAR @ MEAN + 0.7, rtol=1e-13)
    assert np.allclose(result.jacobian, LINEAR, atol=1e-12)
    assert np.abs(result.residual_cov).max() < 1e-12


def cubic(v):
    return jnp.stack([v[0] ** 3 - v[0] * v[1] * v[2] + v[3], v[1] ** 2 * v[3] + v[2]])


def quadratic(v):
    return jnp.stack([v[0] ** 2 - v[1] * v[2] + v[3], v[1] ** 2 + v[2] * v[3]])


@pytest.mark.parametrize("rule", [rule for rule in SIGMA
                                  if not isinstance(rule, lfm.CentralDifference | lfm.MonteCarlo)], ids=ids)
def test_expectations_to_degree_three(rule):
    """E f of cubic functions, and A of quadratic ones, which take products of degree three."""
    everything = structure((0, 1, 2, 3))
    assert np.allclose(linearise(rule, cubic, everything).value, exact(cubic)[0], rtol=1e-12)
    result, (mean, slope, _) = linearise(rule, quadratic, everything), exact(quadratic)
    assert np.allclose(result.value, mean, rtol=1e-12) and np.allclose(result.jacobian, slope, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("order", [3, 5])
def test_gauss_hermite_within_its_degree(order):
    """Degree 2 order - 1 in each input: A and Omega of a function of degree (order - 1) are exact."""
    power = order - 1

    def function(v):
        return jnp.stack([(v[0] + v[1]) ** power, v[3] ** power - v[0]])

    result = linearise(lfm.GaussHermite(order), function, structure((0, 1, 2, 3)))
    for computed, expected in zip((result.value, result.jacobian, result.residual_cov), exact(function), strict=True):
        assert np.allclose(computed, expected, rtol=1e-10, atol=1e-11)


@pytest.mark.parametrize("rule", SIGMA, ids=ids)
def test_residual_covariance_is_semidefinite(rule):
    def function(v):
        return jnp.stack([jnp.sin(v[0]) * v[1], jnp.exp(0.5 * v[2]) + v[3] ** 2])

    result = linearise(rule, function, structure((0, 1, 2, 3)))
    eigenvalues = np.linalg.eigvalsh(result.residual_cov)
    assert eigenvalues[0] >= -1e-13 * eigenvalues[-1]


@pytest.mark.parametrize("rule", [lfm.GaussHermite(5), lfm.GaussHermite(3)], ids=ids)
def test_averaged_coordinates_are_exact(rule):
    """R(r, v) u: points in r and v alone give all moments, the moments of u by conditioning."""

    def function(v):
        return jnp.stack([v[0] * v[2] + v[1] * v[3], (1.0 + v[1]) * v[2] - 0.3 * v[3]])

    result = linearise(rule, function, structure((0, 1), (2, 3)))
    for computed, expected in zip((result.value, result.jacobian, result.residual_cov), exact(function), strict=True):
        assert np.allclose(computed, expected, rtol=1e-10, atol=1e-11)


def test_constant_coordinates_follow_by_linearity():
    """0.5 v3 enters linearly: its slope is given, and the points lie in v0 alone."""

    def function(v):
        return jnp.stack([v[0] ** 2 * (1 + v[1]) + 0.5 * v[3], v[0] - 2.0 * v[2]])

    linear_part = jnp.zeros((2, 4)).at[0, 3].set(0.5).at[1, 2].set(-2.0)
    result = linearise(lfm.GaussHermite(4), function, structure((0,), (1,), (2, 3)), linear_part)
    mean, slope, residual = exact(function)
    assert np.allclose(result.value, mean, rtol=1e-11) and np.allclose(result.jacobian, slope, rtol=1e-10, atol=1e-11)
    assert np.allclose(result.residual_cov, residual, rtol=1e-10, atol=1e-11)


@pytest.mark.parametrize("rule", SIGMA, ids=ids)
@pytest.mark.parametrize("constant", [(0, 3)])
def test_without_variance_the_slope_is_the_jacobian(rule, constant):
    keep = np.array([i not in constant for i in range(4)])
    covariance = COVARIANCE * keep[:, None] * keep

    def function(v):
        return jnp.stack([jnp.sin(v[0]) + v[1] ** 3 + v[2], jnp.exp(v[3]) - v[2]])

    result = linearise(rule, function, structure((0, 1, 2, 3)), covariance=covariance)
    jacobian = np.asarray(jax.jacfwd(function)(jnp.asarray(MEAN)))
    assert np.isfinite(result.jacobian).all()
    assert np.allclose(result.jacobian[:, list(constant)], jacobian[:, list(constant)], atol=1e-7)
    gradient = jax.jacrev(lambda scale: linearise(rule, lambda v: scale * function(v), structure((0, 1, 2, 3)),
                                                  covariance=covariance).jacobian)(1.0)
    assert np.allclose(gradient, result.jacobian, atol=1e-8)


@pytest.mark.parametrize("rule", SIGMA, ids=ids)
@pytest.mark.parametrize("dim", [1, 2, 5])
def test_points_integrate_linear_functions_and_the_regression(rule, dim):
    points = rule.points(dim)
    assert np.isclose(points.weights.sum(), 1.0)
    assert np.allclose(points.weights @ points.nodes, 0.0, atol=1e-14)
    assert np.allclose((points.weights[:, None] * points.nodes).T @ points.nodes, np.eye(dim), atol=1e-12)
    assert np.array_equal(points.residual_weights, points.residual_weights.T)


def test_central_differences_are_stirlings_formula():
    """Mean and covariance of Norgaard et al. (2000), equations 29 and 31, in two inputs."""
    h = 1.7
    root = np.array([[0.7, 0.0], [0.2, 0.4]])

    def f(v):
        return jnp.stack([jnp.sin(v[0]) * v[1], v[0] ** 2 + jnp.cos(v[1])])

    mean = MEAN[:2]
    inputs = Inputs(jnp.asarray(mean), jnp.asarray(root @ root.T), 1e-6 * jnp.ones(2))
    where = InputStructure((0, 1), (), (), ((True, True),), True)
    result = lfm.CentralDifference(h).linearise(lambda v: (f(v), ()), inputs, where, jnp.zeros((2, 2)))
    plus, minus = (np.stack([f(mean + sign * h * column) for column in root.T]) for sign in (1, -1))
    centre = np.asarray(f(mean))
    expected = (h**2 - 2) / h**2 * centre + (plus + minus).sum(0) / (2 * h**2)
    first, second = plus - minus, plus + minus - 2 * centre
    covariance = first.T @ first / (4 * h**2) + (h**2 - 1) / (4 * h**4) * second.T @ second
    assert np.allclose(result.value, expected, rtol=1e-12)
    assert np.allclose(
        result.residual_cov + result.jacobian @ root @ root.T @ result.jacobian.T, covariance, rtol=1e-12
    )


def test_taylor_is_value_and_jacobian():
    result = linearise(lfm.Taylor(), cubic, structure((0, 1), (2,), (3,)), jnp.zeros((2, 4)).at[0, 3].set(1.0).at[
        1, 3].set(MEAN[1] ** 2))
    assert np.allclose(result.jacobian, jax.jacfwd(cubic)(jnp.asarray(MEAN)), rtol=1e-13)
    assert np.allclose(result.value, cubic(MEAN)) and not result.residual_cov.any()


def test_errors():
    for make, name in (
            (lambda: lfm.Unscented(alpha=0.0), "alpha"), (lambda: lfm.Unscented(1.0, 0.0, -2.0).points(1), "kappa"),
            (lambda: lfm.GaussHermite(1), "order"), (lambda: lfm.GaussHermite(0), "order"),
            (lambda: lfm.GaussHermite(10).points(6), r"10\^6"), (lambda: lfm.CentralDifference(0.5), "step"),
            (lambda: lfm.MonteCarlo(11), "11"), (lambda: lfm.MonteCarlo(4).points(3), "7")):
        with pytest.raises(ValueError, match=name):
            make()
    with pytest.raises(TypeError, match="order"):
        lfm.GaussHermite(2.5)
