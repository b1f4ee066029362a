"""What a user meets who passes something wrong: an exception that names the argument."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import double_well, motif

import lfm_ppl as lfm
from lfm_ppl.filtering import arguments

MODEL = double_well()
TIMES, Y = np.array([1.0, 2.0, 3.0]), np.ones((3, 1))


def call(times=TIMES, y=Y, **options):
    return lambda function: function(MODEL, times, y, **options)


# (call with lfm.filter or lfm.smooth, parts of the message)
VALUES = [
    (call([1.0, 0.5, 2.0]), "times", "1"), (call([1.0, np.nan, 2.0]), "times", "[1]"),
    (call([[1.0, 2.0, 3.0]]), "times", "(1, 3)"), (call([], np.ones((0, 1))), "times"),
    (call([-1.0, 0.5, 2.0]), "times[0]", "initial_time"), (call(y=np.ones((2, 1))), "(3, 1)", "(2, 1)"),
    (call(y=np.ones((3, 2))), "(3, 2)"), (call(y=np.full((3, 1), np.nan)), "y"),
    (call(y=np.array([[1.0], [np.inf], [0.0]])), "y[1, 0]"), (call(steps=0), "steps"),
    (call(max_step=0.0), "max_step"),
]
OF_SMOOTHER = [
    (call(at=[-0.5, 2.0]), "at[0]", "-0.5"), (call(at=[[0.5]]), "at"), (call(at=[np.nan]), "at"),
    (call(iterations=-1), "iterations"), (call(iterations=2, damping=0.0), "damping"),
]
TYPES = [
    (call(steps=2.5), "steps"), (call(rule=lfm.Cubature), "rule", "lfm.Cubature()"), (call(rule="cubature"), "rule"),
    (call(y=np.array([["a"], ["b"], ["c"]])), "y"),
]


def test_wrong_arguments_are_named():
    for error, function, cases in ((ValueError, lfm.filter, VALUES), (ValueError, lfm.smooth, VALUES + OF_SMOOTHER),
                                   (TypeError, lfm.filter, TYPES)):
        for wrong, *parts in cases:
            with pytest.raises(error) as raised:
                wrong(function)
            assert [part for part in parts if part not in str(raised.value)] == [], raised.value


def test_a_covariance_for_each_time_needs_one_for_each():
    model = lfm.LatentForceModel(MODEL.dynamics, MODEL.forces, lfm.GaussianObservation(
        lambda x, u, t: x[:1], 0.1 * jnp.ones((4, 1, 1))), MODEL.initial_state)
    for wrong in (lambda: lfm.filter(model, TIMES, Y), lambda: lfm.smooth(model, TIMES, Y),
                  lambda: lfm.MarginalLikelihood(model, TIMES), lambda: lfm.simulate(jax.random.key(0), model, TIMES)):
        with pytest.raises(ValueError, match="covariance.* 4 .* 3 "):
            wrong()


@pytest.mark.thorough
def test_states_and_names_of_a_result():
    """Where a filter may start, and what its result has."""
    first = lfm.filter(MODEL, TIMES, Y)
    with pytest.raises(TypeError, match="start"):
        lfm.filter(MODEL, TIMES + 9.0, Y, start=first)
    with pytest.raises(ValueError, match=r"times\[0\].*start"):
        lfm.filter(MODEL, TIMES - TIMES[0], Y, start=first.state)
    with pytest.raises(ValueError, match="start has 4 .* 1"):
        lfm.filter(MODEL, TIMES + 9.0, Y, start=first.state._replace(mean=jnp.zeros(4), covariance=jnp.eye(4)))
    result = lfm.smooth(MODEL, TIMES, Y)
    for wrong, name in ((lambda: result.force("v"), "'v'"), (lambda: result.state("x1"), "'x0'"),
                        (lambda: result.sample(jax.random.key(0), 0), "draws")):
        with pytest.raises(ValueError, match=name):
            wrong()


def test_the_prior_mean_must_give_finite_values():
    """Functions of time, which are not tried before the data say when."""
    observation = lfm.GaussianObservation(lambda x, u, t: x, jnp.ones(2))
    model = lfm.LatentForceModel(lambda x, u, t: jnp.log(x) + 0.0 * t, {}, observation,
                                 lfm.Gaussian(jnp.array([1.0, -1.0]), jnp.eye(2)), state_names=("a", "b"))
    with pytest.raises(ValueError, match="dynamics.*'b'"):
        lfm.filter(model, TIMES, np.ones((3, 2)))
    broken = lfm.GaussianObservation(lambda x, u, t: jnp.sqrt(x - 5.0) + 0.0 * t, jnp.ones(1))
    model = lfm.LatentForceModel(lambda x, u, t: -x, {}, broken, lfm.Gaussian(jnp.ones(1), jnp.eye(1)))
    with pytest.raises(ValueError, match="observation.*'y0'"):
        lfm.filter(model, TIMES, Y)


def test_in_compiled_code():
    """Times that must be cut cannot be traced; values that would be refused outside give a number."""
    with pytest.raises(ValueError, match="max_step"):
        jax.jit(lambda t: lfm.filter(MODEL, t, Y, max_step=0.1).log_likelihood)(jnp.asarray(TIMES))
    result = jax.jit(lambda noise: lfm.MarginalLikelihood(
        motif(genes=1, noise_sd=noise, variance=0.1), TIMES, iterations=0).log_prob(Y))(jnp.nan)
    assert result == -np.inf


def test_single_precision_warns_once(monkeypatch):
    monkeypatch.setattr(arguments, "_has_warned", False)
    monkeypatch.setattr(arguments.jnp, "result_type", lambda *args: jnp.float32)
    with pytest.warns(UserWarning, match="jax_enable_x64"):
        arguments.warn_single_precision()
    arguments.warn_single_precision()  # the second time it is silent; pytest would show a warning as such
    assert arguments._has_warned
