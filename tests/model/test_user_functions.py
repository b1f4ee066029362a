"""What is seen of a user's functions before anything is compiled: indices out of range, and what JAX cannot trace."""

from __future__ import annotations

import inspect
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import whole_state

import lfm_ppl as lfm
from lfm_ppl.model.user_functions import trace

TABLE = jnp.array([1.0, 2.0, 4.0, 8.0])
OBSERVATION = lfm.GaussianObservation(whole_state, jnp.ones(2))
PRIOR = lfm.Gaussian(jnp.zeros(2), jnp.eye(2))


def make(dynamics=lambda x, u, t: -x, observation=OBSERVATION, **options):
    forces = {"u": lfm.Matern(1.0, 1.0)}
    return lfm.LatentForceModel(dynamics, forces, observation, PRIOR, **options)


def check(function):
    """Check a function of x (3,)."""
    trace("dynamics", "f(x)", function, jnp.zeros(3)).check_indices(("x",))


@pytest.mark.parametrize("function, message", [
    (lambda x: x[7], r"dynamics reads x\[7\], but x has 3 entries; use an index from 0 to 2, or from -3 to -1"),
    (lambda x: x[-4], r"reads x\[-4\]"),
    (lambda x: x[jnp.array([0, 3])], r"reads x\[3\]"),
    (lambda x: x[np.array([0, -5])], r"reads x\[-5\]"),
    (lambda x: x.at[3].get(), r"reads x\[3\]"),
    (lambda x: jax.lax.dynamic_index_in_dim(x, 3), r"reads x\[3\]"),
    (lambda x: x + TABLE[4], r"reads index 4 of axis 0 of an array of shape \(4,\), but that axis has 4 entries"),
    (lambda x: (x[:, None] * TABLE)[:, 5], r"reads index 5 of axis 1 of an array of shape \(3, 4\)"),
    (lambda x: (x[:, None] * TABLE)[3, :2], r"reads index 3 of axis 0 of an array of shape \(3, 4\)"),
    (lambda x: jnp.zeros(2).at[2].set(x[0]), r"sets index 2 of axis 0 of an array of shape \(2,\)"),
    (jax.jit(lambda x: x[7]), r"reads x\[7\]"),
    (lambda x: jax.checkpoint(lambda x: x[7])(x), r"reads x\[7\]"),
    (lambda x: jax.lax.cond(x[0] > 0, lambda x: x[3], lambda x: x[0], x), r"reads x\[3\]"),
    (lambda x: jax.lax.scan(lambda total, _: (total + x[3], None), 0.0, None, 5)[0], "reads index 3 of axis 0"),
    (lambda x: jax.lax.fori_loop(0, 3, lambda i, total: total + x[4], 0.0), "reads index 4 of axis 0"),
    (lambda x: jax.lax.while_loop(lambda total: total < 3.0, lambda total: total + x[4], 0.0), "index 4 of axis 0"),
])
def test_indices_out_of_range(function, message):
    with pytest.raises(ValueError, match=message):
        check(function)


@pytest.mark.parametrize("dynamics, message", [
    (lambda x, u, t: -x + lfm.Input([0.0, 1.0], [1.0, 2.0]), r"dynamics computes with a known input; call it with the"),
    (lambda t, x, u: -x[0] * t[0] * jnp.ones(2) + u[0], r"Its arguments are .*x, u, t.*, in this order"),
])
def test_python_errors_say_what_to_write(dynamics, message):
    with pytest.raises(TypeError, match=message):
        make(dynamics)


@pytest.mark.parametrize("function", [
    lambda x: x[0] + x[-1] + x[-3] + x[2] + x[1:9].sum() + x[5:].sum(),
    lambda x: x[jnp.array([0, -1, 2])] + x[np.array([1, -3])].sum(),
    lambda x: x.at[2].set(1.0).at[-3].add(2.0) + x.at[jnp.array([0, 7])].add(1.0),
    lambda x: x.at[7].get(mode="clip") + x.at[7].get(mode="fill", fill_value=0.0),
    lambda x: jnp.take(x, 7, mode="clip") + jnp.take(x, 7, mode="wrap") + jnp.take(x, jnp.array([-1, 2])).sum(),
    lambda x: TABLE[jnp.searchsorted(TABLE, x[0])] + TABLE[jnp.clip(x.astype(int), 0, 3)].sum(),
    lambda x: jnp.interp(x, TABLE, TABLE) + jnp.roll(x, 1) + jnp.flip(x) + jnp.sort(x),
    lambda x: jax.vmap(lambda i: x[i])(jnp.arange(3)) + jnp.asarray([x[i] for i in range(3)]),
    lambda x: jax.lax.fori_loop(0, 3, lambda i, total: total + x[i], 0.0),
    lambda x: jax.lax.scan(lambda total, i: (total + x[i], x), 0.0, jnp.arange(3))[0],
    lambda x: jnp.linalg.solve(jnp.diag(1.0 + x**2), x) + jnp.diagonal(jnp.outer(x, x)),
    lambda x: jnp.tril(jnp.ones((3, 3))) @ x + jnp.linalg.cholesky(jnp.eye(3) + jnp.outer(x, x))[2],
    lambda x: x[jnp.argmax(x)] + x[np.array([True, False, True])].sum() + x[..., None][:, 0] + x[None, 2],
])
def test_indices_in_range(function):
    check(function)


def test_every_function_of_a_model_is_looked_at():
    for options, message in (
            ({"dynamics": lambda x, u, t: u[7] - x}, r"dynamics reads u\[7\], but u has 1 entry"),
            ({"observation": lfm.GaussianObservation(lambda x, u, t: jnp.stack([x[0], x[2]]), jnp.ones(2))},
             r"the observation function reads x\[2\], but x has 2 entries"),
            ({"observation": lfm.GaussianObservation(whole_state, lambda x, u, t: jnp.ones(2) * u[1] ** 2)},
             r"the observation covariance reads u\[1\]"),
            ({"process_noise": lambda x, u, t: x[4] * jnp.ones((2, 1))}, r"process_noise reads x\[4\]")):
        with pytest.raises(ValueError, match=message):
            make(**options)


def test_the_line_is_named():
    def dynamics(x, u, t):
        growth = jax.nn.softplus(x[0])
        return growth * jnp.log(x) - jax.nn.relu(u[1])

    line = inspect.getsourcelines(dynamics)[1] + 2
    with pytest.raises(ValueError, match=rf"reads u\[1\].* It stands in .*test_user_functions.py, line {line}\."):
        make(dynamics)
    with pytest.raises(ValueError, match=rf"is not finite.* It stands in .*test_user_functions.py, line {line}\."):
        make(lambda x, u, t: dynamics(x - 1.0, jnp.ones(2), t))


def test_the_line_is_that_of_what_reaches_the_value():
    def dynamics(x, u, t):
        guarded = jnp.where(x > 0.0, 1.0 / x, 0.0)
        return jnp.sqrt(guarded - 1.0)

    line = inspect.getsourcelines(dynamics)[1] + 2
    with pytest.raises(ValueError, match=rf"is not finite.* It stands in .*test_user_functions.py, line {line}\."):
        make(dynamics)
    with pytest.raises(ValueError, match=r"is not finite.*jnp.maximum\)\.$"):  # of keys NumPy knows nothing
        make(lambda x, u, t: dynamics(x, u, t) + jax.random.normal(jax.random.key(0), (2,)))


def test_parameters_may_be_traced():
    """A NumPyro model is compiled: then only the indices are known."""
    with pytest.raises(ValueError, match=r"dynamics reads u\[1\], but u has 1 entry"):
        jax.jit(lambda p: make(lambda x, u, t: p * u[1] - x).initial_state.mean)(2.0)
    with pytest.raises(ValueError, match=r"reads index 3 of axis 0 of an array of shape \(3,\)"):
        jax.jit(lambda p: make(lambda x, u, t: p[3] * u[0] - x).initial_state.mean)(jnp.ones(3))
    jax.jit(lambda p: make(lambda x, u, t: p[2] * u[0] - x).initial_state.mean)(jnp.ones(3))


@pytest.mark.parametrize("dynamics, message", [
    (lambda x, u, t: np.exp(x), "It calls NumPy.*jnp.exp.*TracerArrayConversionError"),
    (lambda x, u, t: math.exp(x[0]) * x, r"It makes a Python number .*math.*ConcretizationTypeError"),
    (lambda x, u, t: x if x[0] > 1 else -x, "It has a Python branch.*jnp.where.*TracerBoolConversionError"),
    (lambda x, u, t: max(x[0], 0.0) * x, "It has a Python branch.*jnp.where"),
    (lambda x, u, t: [1.0, 2.0][x[0].astype(int)] * x, "Python index or count.*TracerIntegerConversionError"),
    (lambda x, u, t: x[x > 0], "It picks entries by a condition.*jnp.where.*NonConcreteBooleanIndexError"),
])
def test_what_cannot_be_traced(dynamics, message):
    with pytest.raises(TypeError, match=f"dynamics must be made of JAX operations.*{message}") as raised:
        make(dynamics)
    assert isinstance(raised.value.__cause__, (TypeError, IndexError)), "JAX's error follows"
    with pytest.raises(TypeError, match=f"the observation function must be made of JAX operations.*{message}"):
        make(observation=lfm.GaussianObservation(dynamics, jnp.ones(2)))


def test_single_precision_is_named():
    with jax.enable_x64(False):
        old = lfm.Matern(1.0, 0.1)
        prior = lfm.Gaussian(jnp.zeros(2), jnp.eye(2))
        model = lfm.LatentForceModel(lambda x, u, t: -x, {}, OBSERVATION, prior)
    for force in (old, old + lfm.Matern(1.0, 2.0)):
        with pytest.raises(ValueError, match="the force 'drive' holds numbers in float32, made before.*jax_enable_x64"):
            lfm.LatentForceModel(lambda x, u, t: -x, {"drive": force}, OBSERVATION, PRIOR)
    with pytest.raises(ValueError, match="initial_state holds numbers in float32"):
        lfm.filter(model, [0.0, 1.0], np.zeros((2, 2)))
