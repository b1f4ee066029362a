"""Errors of the model's constructors: the argument, what came, the remedy."""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import whole_state

import lfm_ppl as lfm

OBSERVATION = lfm.GaussianObservation(whole_state, jnp.ones(2))
PRIOR = lfm.Gaussian(jnp.zeros(2), jnp.eye(2))
FORCE = {"u": lfm.Matern(1.0, 1.0)}


def make(dynamics=lambda x, u, t: -x, forces=FORCE, observation=OBSERVATION, initial_state=PRIOR, **options):
    return lfm.LatentForceModel(dynamics, forces, observation, initial_state, **options)


@pytest.mark.parametrize("options, message", [
    ({"dynamics": lambda x, u, t: x[0]},
     r"dynamics must return.*shape \(2,\); it returned a number of shape \(\)\. Return jnp"),
    ({"dynamics": lambda x, u, t: [x[0], x[1]]}, r"it returned a list of 2, which is not an array\. Return jnp"),
    ({"dynamics": lambda x, u, t: None}, r"it returned None, as a function without"),
    ({"dynamics": lambda x, u, t: jnp.ones(3)}, r"it returned an array of shape \(3,\)\.$"),
    ({"forces": [("u", lfm.Matern(1.0, 1.0)), ("u", lfm.Constant(1.0))]}, "force name 'u' repeats"),
    ({"forces": {"x0": lfm.Matern(1.0, 1.0)}}, "'x0' is used for a state and for a force; rename"),
    ({"state_names": ("a",)}, r"state_names must hold 2 names: initial_state.mean has 2 entries\. It holds 'a'"),
    ({"state_names": "ab"}, "state_names must hold 2 names: .* It holds 'ab'"),
    ({"state_names": ("a", "a")}, "state_names must not repeat"),
    ({"output_names": ("a", "b", "c")},
     "output_names must hold 2 names: the observation returns 2 entries. It holds 'a', 'b'"),
    ({"process_noise": jnp.ones(2)}, r"process_noise must be a dispersion matrix \(2, S\).*got shape \(2,\).*jnp.diag"),
    ({"process_noise": jnp.full((2, 1), jnp.nan)}, "process_noise must be finite"),
    ({"process_noise": lambda x, u, t: jnp.ones(3)}, r"process_noise must return a dispersion matrix.*got \(3,\)"),
    ({"deterministics": {"rate": lambda x, u, t: u}}, "the deterministic 'rate' must return one number"),
    ({"deterministics": {"rate": lambda x, u, t: u[3]}}, "the deterministic 'rate'"),
    ({"deterministics": {"u": lambda x, u, t: u[0]}}, "name 'u' of a deterministic is used for a state or a force"),
    ({"initial_time": np.inf}, "initial_time must be finite"),
    ({"nonlinear_inputs": ("y",)}, "unknown name in nonlinear_inputs 'y'"),
    ({"observation": lfm.GaussianObservation(lambda x, u, t: x[0], jnp.ones(1))},
     r"must return a vector \(D,\), got a number of shape \(\)\. For one output"),
    ({"observation": lfm.GaussianObservation(lambda x, u, t: [x[0]], jnp.ones(1))},
     r"must return a vector \(D,\), got a list of"),
    ({"observation": lfm.GaussianObservation(whole_state, jnp.ones(3))},
     r"2 components.*must be \(2,\) or \(2, 2\); it is \(3, 3\)"),
    ({"observation": lfm.GaussianObservation(whole_state, jnp.ones(2), angular=(2,))},
     "angular indices must lie in 0..1"),
])
def test_model_values(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)


@pytest.mark.parametrize("options, message", [
    ({"deterministics": [1.0]}, "deterministics must be a mapping"),
    ({"deterministics": {"rate": 1.0}}, "the deterministic 'rate' must be a function"),
    ({"dynamics": 3.0}, "dynamics must be callable as f\\(x, u, t\\), got float"),
    ({"observation": jnp.ones(2)}, "observation must be an lfm.GaussianObservation.*Wrap"),
    ({"initial_state": jnp.zeros(2)}, "initial_state must be an lfm.Gaussian"),
    ({"forces": {"u": 1.0}}, "force 'u' must be a force such as lfm.Matern, got float"),
    ({"forces": [lfm.Matern(1.0, 1.0)]}, "forces must map names to forces"),
    ({"forces": lfm.Matern(1.0, 1.0)}, "forces must map names to forces.*or {} for none; got Matern"),
    ({"forces": None}, "forces must map names to forces.*got NoneType"),
    ({"dynamics": lambda x, u: -x}, r"dynamics must take three arguments, f\(x, u, t\): too many positional"),
    ({"observation": lfm.GaussianObservation(lambda x: x, jnp.ones(2))}, r"must take three arguments, h\(x, u, t\)"),
])
def test_model_types(options, message):
    with pytest.raises(TypeError, match=message):
        make(**options)


@pytest.mark.parametrize("call, message", [
    (lambda: lfm.Gaussian(jnp.zeros(2), jnp.array([[1.0, 0.5], [0.2, 1.0]])),
     "initial_state.covariance is not symmetric: the largest.*0.3.*Use 0.5"),
    (lambda: lfm.Gaussian(jnp.zeros(2), jnp.array([[1.0, 2.0], [2.0, 1.0]])),
     "initial_state.covariance is not positive semi-definite: its smallest eigenvalue is -1"),
    (lambda: lfm.Gaussian(jnp.zeros(2), jnp.array([1.0, -1.0])), "negative variance -1 at index 1"),
    (lambda: lfm.Gaussian(jnp.zeros(2), jnp.eye(3)), r"must have shape \(2, 2\) or \(2,\).*got \(3, 3\)"),
    (lambda: lfm.Gaussian(jnp.zeros((2, 1)), jnp.eye(2)), r"initial_state.mean must be a vector \(M,\)"),
    (lambda: lfm.Gaussian(jnp.array([jnp.nan]), jnp.eye(1)), r"initial_state.mean must be finite at index \[0\]"),
    (lambda: lfm.GaussianObservation(whole_state, jnp.array([0.1, -0.1])), "observation covariance has a negative"),
    (lambda: lfm.GaussianObservation(whole_state, jnp.stack([jnp.eye(2), -jnp.eye(2)])),
     "observation covariance of row 1 is not positive semi-definite"),
    (lambda: lfm.Input([0.0, 1.0, 1.0], [1.0, 2.0, 3.0]), r"input times must increase; row 2 \(1\) does not"),
    (lambda: lfm.Input([0.0, 1.0], [1.0, 2.0, 3.0]), "one row for each time"),
    (lambda: lfm.Input([], []), "one row for each time, and at least one"),
    (lambda: lfm.Input([0.0, np.nan], [1.0, 2.0]), "input times must be finite"),
    (lambda: lfm.Input([0.0, 1.0], [1.0, np.inf]), "input values must be finite"),
    (lambda: lfm.Input([0.0, 1.0], [1.0, 2.0], "linaer"), "unknown interpolation 'linaer'. Did you mean 'linear'"),
    (lambda: lfm.simulate(jax.random.key(0), make(), [2.0, 1.0]), "times must not go back"),
    (lambda: lfm.simulate(jax.random.key(0), make(), [1.0], steps=0), "steps must be at least 1"),
    (lambda: lfm.simulate(jax.random.key(0), make(initial_time=2.0), [1.0]),
     "lies before the model's initial_time = 2"),
    (lambda: lfm.state_space(lfm.LatentForceModel(
        lambda x, u, t: x, {}, lfm.GaussianObservation(lambda x, u, t: jnp.ones(1), jnp.ones(1)),
        lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))), "neither states nor forces"),
])
def test_parts(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_functions_are_tried_at_the_prior_mean():
    model = make(observation=lfm.GaussianObservation(whole_state, lambda x, u, t: -t * jnp.ones(2)))
    with pytest.raises(ValueError, match="observation covariance at the prior mean x = .* t = 1 .*semi-definite"):
        lfm.filter(model, [1.0], [[0.1, 0.2]])
    model = make(process_noise=lambda x, u, t: jnp.log(1.0 - t) * jnp.ones((2, 1)))
    with pytest.raises(ValueError, match="process_noise is not finite at the prior mean"):
        lfm.filter(model, [1.0], [[0.1, 0.2]])


@pytest.mark.parametrize("options, message", [
    ({"dynamics": lambda x, u, t: jnp.log(x - 1.0)},
     r"returned \[nan nan\] at the prior mean x = \[0. 0.\], u = \[0.\]: the entry for 'x0' is not finite.*guard"),
    ({"dynamics": lambda x, u, t: -x / t, "initial_time": 0.0}, "at the prior mean .*, t = 0: the entry for 'x0'"),
    ({"observation": lfm.GaussianObservation(lambda x, u, t: jnp.stack([x[0], 1.0 / u[0]]), jnp.ones(2))},
     "the observation function returned .* the entry for 'y1' is not finite"),
    ({"process_noise": lambda x, u, t: jnp.full((2, 1), jnp.nan)}, "process_noise is not finite at the prior mean"),
    ({"observation": lfm.GaussianObservation(whole_state, lambda x, u, t: -jnp.ones(2))},
     "observation covariance at the prior mean .* semi-definite"),
])
def test_functions_are_tried_at_construction(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_a_root_of_zero_has_no_derivative():
    with pytest.warns(UserWarning, match="derivative of the dynamics is not finite at the prior mean .* 'x1'.*guard"):
        make(dynamics=lambda x, u, t: jnp.stack([-x[0], jnp.sqrt(x[1])]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make(dynamics=lambda x, u, t: jnp.sqrt(jnp.maximum(x, 1e-6)))
        make(dynamics=lambda x, u, t: jnp.sqrt(x), initial_state=lfm.Gaussian(jnp.ones(2), jnp.eye(2)))


def test_functions_of_time_wait_for_one_where_none_is_known():
    assert make(dynamics=lambda x, u, t: -x / t).initial_time is None
    assert jax.jit(lambda mean: make(dynamics=lambda x, u, t: x / mean[0], initial_state=lfm.Gaussian(
        mean, jnp.eye(2))).initial_state.mean)(jnp.zeros(2)).shape == (2,), "values are not known in compiled code"


def test_keys_and_indices():
    with pytest.raises(TypeError, match=r"key, the first argument, must be a JAX random key, such .*key\(0\), got 0"):
        lfm.simulate(0, make(), [1.0])
    for angular in ((True, False), (0.0,)):
        with pytest.raises(TypeError, match="angular must hold the indices"):
            lfm.GaussianObservation(whole_state, jnp.ones(2), angular=angular)


def test_observation_function_must_be_callable():
    with pytest.raises(TypeError, match="observation function must be callable as h"):
        lfm.GaussianObservation(jnp.ones(1), jnp.ones(1))


def test_names_units_and_defaults():
    model = make(units={"time": "h", "u": "mol"}, state_names=("a", "b"))
    assert model.units == {"time": "h", "u": "mol"} and model.output_names == ("y0", "y1")
    assert model.force_names == ("u",) and model.state_names == ("a", "b")
    assert make(forces={}).force_names == ()
