"""Failure as a number: -inf with zero gradients in every mode of differentiation."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lfm_ppl.utils.gradients import finite_or_minus_infinity


def explosive(x):
    return -jnp.exp(jnp.exp(x)) * x


def guarded(x):
    return finite_or_minus_infinity(explosive, x)


def closed_over(x):
    return finite_or_minus_infinity(lambda y: explosive(x) * y, 1.0)


@pytest.mark.parametrize("function", [guarded, closed_over])
@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit], ids=["eager", "jit"])
def test_finite_values_pass_unchanged(function, wrap):
    assert wrap(function)(1.2) == explosive(1.2)
    for derivative in (jax.grad, jax.jacfwd, jax.hessian):
        assert np.isclose(wrap(derivative(function))(1.2), derivative(explosive)(1.2), rtol=1e-13)


@pytest.mark.parametrize("function", [guarded, closed_over])
@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit], ids=["eager", "jit"])
def test_failure_has_zero_gradients(function, wrap):
    assert wrap(function)(9.0) == -np.inf
    for derivative in (jax.grad, jax.jacfwd, jax.jacrev):
        assert wrap(derivative(function))(9.0) == 0.0
    assert not np.isnan(wrap(jax.hessian(function))(9.0))


def test_under_vmap_only_the_failure_is_affected():
    points = jnp.array([1.0, 9.0, -0.5])
    values, gradients = jax.vmap(jax.value_and_grad(guarded))(points)
    assert np.isneginf(values[1]) and gradients[1] == 0.0
    for index in (0, 2):
        assert np.isclose(gradients[index], jax.grad(explosive)(points[index]))
    tangents = jax.vmap(lambda x: jax.jvp(guarded, (x,), (1.0,))[1])(points)
    assert np.allclose(tangents, gradients)


def test_nan_and_integers():
    assert finite_or_minus_infinity(lambda x: jnp.log(x - 2), 1.0) == -np.inf
    value = finite_or_minus_infinity(lambda x, n: x * n["count"], 2.0, {"count": jnp.array(3)})
    assert value == 6.0
    assert jax.grad(lambda x: finite_or_minus_infinity(lambda x, n: x * n, x, jnp.array(3)))(2.0) == 3.0
