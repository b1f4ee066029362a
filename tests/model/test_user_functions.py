"""Checks of user functions before compilation: indices out of range, and functions that JAX cannot trace."""

from __future__ import annotations

import inspect
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import whole_state

import lfm_ppl as lfm
from lfm_ppl.model.user_functions import trace_function

TABLE = jnp.array([1.0, 2.0, 4.0, 8.0])
OBSERVATION = lfm.GaussianObservation(whole_state, jnp.ones(2))
PRIOR = lfm.Gaussian(jnp.zeros(2), jnp.eye(2))


def make(dynamics=lambda x, u, t: -x, observation=OBSERVATION, **options):
    return lfm.LatentForceModel(dynamics, {"u": lfm.Matern(1.0, 1.0)}, observation, PRIOR, **options)


def check(function):
    """Check a function of x (3,)."""
    trace_function("dynamics", "f(x)", function, jnp.zeros(3)).check_indices(("x",))


@pytest.mark.parametrize("function, message", [
    (lambda x: x[7], r"dynamics reads x\[7\], but x has 3 entries.* from 0 to 2, or from -3 to -1"),
    (lambda x: x[-4], r"x\[-4\]"),
    (lambda x: x[jnp.array([0, 3])], r"x\[3\]"),
    (lambda x: x[np.array([0, -5])], r"x\[-5\]"),
    (lambda x: x.at[3].get(), r"x\[3\]"),
    (lambda x: jax.lax.dynamic_index_in_dim(x, 3), r"x\[3\]"),
    (lambda x: x + TABLE[4], r"index 4 of axis 0 of an array of shape \(4,\)"),
    (lambda x: (x[:, None] * TABLE)[:, 5], r"index 5 of axis 1 of an array of shape \(3, 4\)"),
    (lambda x: (x[:, None] * TABLE)[3, :2], r"index 3 of axis 0 of an array of shape \(3, 4\)"),
    (lambda x: jnp.zeros(2).at[2].set(x[0]), r"sets index 2 of axis 0"),
    (jax.jit(lambda x: x[7]), r"x\[7\]"),
    (lambda x: jax.checkpoint(lambda x: x[7])(x), r"x\[7\]"),
    (lambda x: jax.lax.cond(x[0] > 0, lambda x: x[3], lambda x: x[0], x), r"x\[3\]"),
    (lambda x: jax.lax.scan(lambda total, _: (total + x[3], None), 0.0, None, 5)[0], "index 3 of axis 0"),
    (lambda x: jax.lax.fori_loop(0, 3, lambda i, total: total + x[4], 0.0), "index 4 of axis 0"),
    (lambda x: jax.lax.while_loop(lambda total: total < 3.0, lambda total: total + x[4], 0.0), "index 4 of axis 0"),
])
def test_indices_out_of_range(function, message):
    with pytest.raises(ValueError, match=message):
        check(function)


@pytest.mark.parametrize("function", [
    lambda x: x[0] + x[-1] + x[-3] + x[2] + x[1:9].sum() + x[5:].sum(),
    lambda x: x[jnp.array([0, -1, 2])] + x[np.array([1, -3])].sum(),
    lambda x: x.at[2].set(1.0).at[-3].add(2.0) + x.at[jnp.array([0, 7])].add(1.0),
    lambda x: x.at[7].get(mode="clip") + x.at[7].get(mode="fill", fill_value=0.0),
    lambda x: jnp.take(x, 7, mode="clip") + jnp.take(x, 7, mode="wrap") + jnp.take(x, jnp.array([-1, 2])).sum(),
    lambda x: TABLE[jnp.searchsorted(TABLE, x[0])] + TABLE[jnp.clip(x.astype(int), 0, 3)].sum(),
    lambda x: TABLE[(jnp.floor(x[0]) - 100.0).astype(int)],  # the index depends on a value that is not known
    lambda x: jnp.interp(x, TABLE, TABLE) + jnp.roll(x, 1) + jnp.flip(x) + jnp.sort(x),
    lambda x: jax.vmap(lambda i: x[i])(jnp.arange(3)) + jnp.asarray([x[i] for i in range(3)]),
    lambda x: jax.lax.fori_loop(0, 3, lambda i, total: total + x[i], 0.0),
    lambda x: jax.lax.scan(lambda total, i: (total + x[i], x), 0.0, jnp.arange(3))[0],
    lambda x: jnp.linalg.solve(jnp.diag(1.0 + x**2), x) + jnp.diagonal(jnp.outer(x, x)),
    lambda x: jnp.tril(jnp.ones((3, 3))) @ x + jnp.linalg.cholesky(jnp.eye(3) + jnp.outer(x, x))[2],
    lambda x: x[jnp.argmax(x)] + x[np.array([True, False, True])].sum() + x[..., None][:, 0] + x[None, 2],
    lambda x: x + jax.random.normal(jax.random.key(0), (3,)),
])
def test_indices_in_range(function):
    check(function)


@pytest.mark.parametrize("options, message", [
    ({"dynamics": lambda x, u, t: u[7] - x}, r"dynamics reads u\[7\], but u has 1 entry"),
    ({"observation": lfm.GaussianObservation(lambda x, u, t: jnp.stack([x[0], x[2]]), jnp.ones(2))},
     r"the observation function reads x\[2\], but x has 2 entries"),
    ({"observation": lfm.GaussianObservation(whole_state, lambda x, u, t: jnp.ones(2) * u[1] ** 2)},
     r"the observation covariance reads u\[1\]"),
    ({"process_noise": lambda x, u, t: x[4] * jnp.ones((2, 1))}, r"process_noise reads x\[4\]"),
    ({"deterministics": {"rate": lambda x, u, t: u[3]}}, r"the deterministic 'rate' reads u\[3\]"),
])
def test_every_function_of_a_model_is_checked(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_the_message_has_the_line():
    def dynamics(x, u, t):
        growth = jax.nn.softplus(x[0])
        return growth * x - jax.nn.relu(u[1])

    line = inspect.getsourcelines(dynamics)[1] + 2
    with pytest.raises(ValueError, match=rf"reads u\[1\].* It stands in .*test_user_functions.py, line {line}\."):
        make(dynamics)


def test_values_of_an_untaken_branch_are_not_checked():
    make(lambda x, u, t: jnp.where(x > 0.0, 1.0 / x, -x))
    with pytest.raises(ValueError, match="dynamics returned .* 'x0' is not finite"):
        make(lambda x, u, t: jnp.where(x > 0.0, -x, 1.0 / x))


def test_parameters_may_be_traced():
    """A NumPyro model is compiled: then only the shapes are known."""
    with pytest.raises(ValueError, match=r"dynamics reads u\[1\], but u has 1 entry"):
        jax.jit(lambda p: make(lambda x, u, t: p * u[1] - x).initial_state.mean)(2.0)
    with pytest.raises(ValueError, match=r"reads index 3 of axis 0 of an array of shape \(3,\)"):
        jax.jit(lambda p: make(lambda x, u, t: p[3] * u[0] - x).initial_state.mean)(jnp.ones(3))
    jax.jit(lambda p: make(lambda x, u, t: p[2] * u[0] * TABLE[p[0].astype(int) - 9] - x).initial_state.mean)(
        jnp.ones(3))


@pytest.mark.parametrize("dynamics, message", [
    (lambda x, u, t: np.exp(x), "NumPy.*jnp.exp"),
    (lambda x, u, t: math.exp(x[0]) * x, "math module"),
    (lambda x, u, t: x if x[0] > 1 else -x, "Python branch.*jnp.where"),
    (lambda x, u, t: max(x[0], 0.0) * x, "Python branch.*jnp.where"),
    (lambda x, u, t: [1.0, 2.0][x[0].astype(int)] * x, "Python index"),
    (lambda x, u, t: x[x > 0], "selects.*jnp.where"),
])
def test_functions_that_cannot_be_traced(dynamics, message):
    with pytest.raises(TypeError, match=f"dynamics must be made of JAX operations.*{message}.*Error") as raised:
        make(dynamics)
    assert isinstance(raised.value.__cause__, (TypeError, IndexError)), "JAX's error follows"


@pytest.mark.parametrize("dynamics, message", [
    (lambda x, u, t: -x + lfm.Input([0.0, 1.0], [1.0, 2.0]), "dynamics computes with a known input"),
    (lambda t, x, u: -x[0] * t[0] * jnp.ones(2) + u[0], "x, u, t.*, in this order"),
])
def test_python_errors_have_remedies(dynamics, message):
    with pytest.raises(TypeError, match=message):
        make(dynamics)


def test_single_precision_is_an_error():
    with jax.enable_x64(False):
        old = lfm.Matern(1.0, 0.1)
        prior = lfm.Gaussian(jnp.zeros(2), jnp.eye(2))
        model = lfm.LatentForceModel(lambda x, u, t: -x, {}, OBSERVATION, prior)
    for force in (old, old + lfm.Matern(1.0, 2.0)):
        with pytest.raises(ValueError, match="the force 'drive' holds numbers in float32.*jax_enable_x64"):
            lfm.LatentForceModel(lambda x, u, t: -x, {"drive": force}, OBSERVATION, PRIOR)
    with pytest.raises(ValueError, match="initial_state holds numbers in float32"):
        lfm.filter(model, [0.0, 1.0], np.zeros((2, 2)))
