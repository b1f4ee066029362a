"""Errors of the model's constructors: type of the error, and the name of the argument."""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import whole_state

import lfm_ppl as lfm
from lfm_ppl.model.state_space import state_space

VARIANCES = jnp.ones(2)
OBSERVATION = lfm.GaussianObservation(whole_state, VARIANCES)
PRIOR = lfm.Gaussian(jnp.zeros(2), jnp.eye(2))
FORCE = {"u": lfm.Matern(1.0, 1.0)}


def make(dynamics=lambda x, u, t: -x, forces=FORCE, observation=OBSERVATION, initial_state=PRIOR, **options):
    return lfm.LatentForceModel(dynamics, forces, observation, initial_state, **options)


def observed(function, covariance=VARIANCES, **options):
    return {"observation": lfm.GaussianObservation(function, covariance, **options)}


@pytest.mark.parametrize("error, options, message", [
    (ValueError, {"dynamics": lambda x, u, t: x[0]}, r"dynamics must return.*shape \(2,\).*a number.*jnp.array"),
    (ValueError, {"dynamics": lambda x, u, t: [x[0], x[1]]}, "dynamics .* a list of 2"),
    (ValueError, {"dynamics": lambda x, u, t: None}, "dynamics .* None"),
    (ValueError, {"dynamics": lambda x, u, t: jnp.ones(3)}, r"dynamics .* \(3,\)"),
    (TypeError, {"dynamics": 3.0}, "dynamics must be callable"),
    (TypeError, {"dynamics": lambda x, u: -x}, r"dynamics must take three arguments, f\(x, u, t\)"),
    (ValueError, {"dynamics": lambda x, u, t: jnp.log(x - 1.0)}, "dynamics .* 'x0' is not finite.*guard"),
    (ValueError, {"dynamics": lambda x, u, t: -x / t, "initial_time": 0.0}, "t = 0: the entry for 'x0'"),
    (ValueError, {"forces": [("u", lfm.Matern(1.0, 1.0)), ("u", lfm.Constant(1.0))]}, "force name 'u' repeats"),
    (ValueError, {"forces": {"x0": lfm.Matern(1.0, 1.0)}}, "'x0' is used for a state and for a force"),
    (TypeError, {"forces": {"u": 1.0}}, "force 'u' must be a force"),
    (TypeError, {"forces": [lfm.Matern(1.0, 1.0)]}, "forces must map names to forces"),
    (TypeError, {"forces": lfm.Matern(1.0, 1.0)}, "forces must map names to forces.*or {} for none"),
    (TypeError, {"forces": None}, "forces must map names to forces"),
    (ValueError, {"state_names": ("a",)}, "state_names must hold 2 names.*'a'"),
    (ValueError, {"state_names": "ab"}, "state_names must hold 2 names.*'ab'"),
    (ValueError, {"state_names": ("a", "a")}, "state_names must not repeat"),
    (ValueError, {"output_names": ("a", "b", "c")}, "output_names must hold 2 names"),
    (ValueError, {"process_noise": jnp.ones(2)}, r"process_noise must be a dispersion matrix \(2, S\)"),
    (ValueError, {"process_noise": jnp.full((2, 1), jnp.nan)}, "process_noise must be finite"),
    (ValueError, {"process_noise": lambda x, u, t: jnp.ones(3)}, "process_noise must return a dispersion matrix"),
    (ValueError, {"process_noise": lambda x, u, t: jnp.full((2, 1), jnp.nan)}, "process_noise is not finite"),
    (ValueError, {"deterministics": {"rate": lambda x, u, t: u}}, "the deterministic 'rate' must return one number"),
    (ValueError, {"deterministics": {"u": lambda x, u, t: u[0]}}, "name 'u' of a deterministic"),
    (TypeError, {"deterministics": [1.0]}, "deterministics must be a mapping"),
    (TypeError, {"deterministics": {"rate": 1.0}}, "the deterministic 'rate' must be a function"),
    (ValueError, {"initial_time": np.inf}, "initial_time must be finite"),
    (ValueError, {"nonlinear_inputs": ("y",)}, "nonlinear_inputs 'y'"),
    (TypeError, {"initial_state": jnp.zeros(2)}, "initial_state must be an lfm.Gaussian"),
    (TypeError, {"observation": jnp.ones(2)}, "observation must be an lfm.GaussianObservation"),
    (ValueError, observed(lambda x, u, t: x[0]), r"observation function must return a vector \(D,\).*a number"),
    (ValueError, observed(lambda x, u, t: [x[0]]), r"observation function must return a vector \(D,\).*a list"),
    (TypeError, observed(lambda x: x), r"observation function must take three arguments, h\(x, u, t\)"),
    (ValueError, observed(whole_state, jnp.ones(3)), r"2 components.*\(2, 2\); the covariance is \(3, 3\)"),
    (ValueError, observed(whole_state, angular=(2,)), "angular indices must lie in 0..1"),
    (ValueError, observed(lambda x, u, t: jnp.stack([x[0], 1.0 / u[0]])), "observation function .*'y1' is not finite"),
    (ValueError, observed(whole_state, lambda x, u, t: -jnp.ones(2)), "observation covariance .* semi-definite"),
])
def test_models(error, options, message):
    with pytest.raises(error, match=message):
        make(**options)


@pytest.mark.parametrize("error, call, message", [
    (ValueError, lambda: lfm.Gaussian(jnp.zeros(2), jnp.array([[1.0, 0.5], [0.2, 1.0]])), "not symmetric.* 0.3"),
    (ValueError, lambda: lfm.Gaussian(jnp.zeros(2), jnp.array([[1.0, 2.0], [2.0, 1.0]])), "semi-definite: .* is -1"),
    (ValueError, lambda: lfm.Gaussian(jnp.zeros(2), jnp.array([1.0, -1.0])), "negative variance -1 at index 1"),
    (ValueError, lambda: lfm.Gaussian(jnp.zeros(2), jnp.eye(3)), r"must have shape \(2, 2\) or \(2,\)"),
    (ValueError, lambda: lfm.Gaussian(jnp.zeros((2, 1)), jnp.eye(2)), "initial_state.mean must be a vector"),
    (ValueError, lambda: lfm.Gaussian(jnp.array([jnp.nan]), jnp.eye(1)), r"mean must be finite at index \[0\]"),
    (ValueError, lambda: lfm.GaussianObservation(whole_state, jnp.array([0.1, -0.1])), "observation covariance"),
    (ValueError, lambda: lfm.GaussianObservation(whole_state, jnp.stack([jnp.eye(2), -jnp.eye(2)])), "of row 1 is not"),
    (TypeError, lambda: lfm.GaussianObservation(jnp.ones(1), jnp.ones(1)), "observation function must be callable"),
    (TypeError, lambda: lfm.GaussianObservation(whole_state, jnp.ones(2), (True, False)), "angular must hold"),
    (TypeError, lambda: lfm.GaussianObservation(whole_state, jnp.ones(2), (0.0,)), "angular must hold"),
    (ValueError, lambda: lfm.Input([0.0, 1.0, 1.0], [1.0, 2.0, 3.0]), r"input times must increase; row 2 \(1\)"),
    (ValueError, lambda: lfm.Input([0.0, 1.0], [1.0, 2.0, 3.0]), "one row for each time"),
    (ValueError, lambda: lfm.Input([], []), "one row for each time, and at least one"),
    (ValueError, lambda: lfm.Input([0.0, np.nan], [1.0, 2.0]), "input times must be finite"),
    (ValueError, lambda: lfm.Input([0.0, 1.0], [1.0, np.inf]), "input values must be finite"),
    (ValueError, lambda: lfm.Input([0.0, 1.0], [1.0, 2.0], "linaer"), "'linaer'. Did you mean 'linear'"),
    (ValueError, lambda: lfm.Input([0.0, 1.0], [1.0, 2.0], outside="eror"), "'eror'. Did you mean 'error'"),
    (ValueError, lambda: lfm.simulate(jax.random.key(0), make(), [2.0, 1.0]), "times must not go back"),
    (ValueError, lambda: lfm.simulate(jax.random.key(0), make(), [1.0], steps=0), "steps must be at least 1"),
    (ValueError, lambda: lfm.simulate(jax.random.key(0), make(initial_time=2.0), [1.0]), "initial_time = 2"),
    (TypeError, lambda: lfm.simulate(0, make(), [1.0]), "key, the first argument"),
    (ValueError, lambda: state_space(lfm.LatentForceModel(
        lambda x, u, t: x, {}, lfm.GaussianObservation(lambda x, u, t: jnp.ones(1), jnp.ones(1)),
        lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))), "neither states nor forces"),
    # Functions of time are evaluated once the first time is known.
    (ValueError, lambda: lfm.filter(make(**observed(whole_state, lambda x, u, t: -t * VARIANCES)), [1.0], [[0.1, 0.2]]),
     "observation covariance at the prior mean x = .* t = 1 .*semi-definite"),
    (ValueError, lambda: lfm.filter(make(process_noise=lambda x, u, t: jnp.log(1.0 - t) * jnp.ones((2, 1))), [1.0],
                                    [[0.1, 0.2]]), "process_noise is not finite at the prior mean"),
])
def test_parts(error, call, message):
    with pytest.raises(error, match=message):
        call()


def test_functions_of_time_wait_for_the_initial_time():
    assert make(dynamics=lambda x, u, t: -x / t).initial_time is None
    assert jax.jit(lambda mean: make(dynamics=lambda x, u, t: x / mean[0], initial_state=lfm.Gaussian(
        mean, jnp.eye(2))).initial_state.mean)(jnp.zeros(2)).shape == (2,), "values are not known in compiled code"


def test_a_root_of_zero_has_no_derivative():
    with pytest.warns(UserWarning, match="derivative of the dynamics is not finite .* 'x1'"):
        make(dynamics=lambda x, u, t: jnp.stack([-x[0], jnp.sqrt(x[1])]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make(dynamics=lambda x, u, t: jnp.sqrt(jnp.maximum(x, 1e-6)))
        make(dynamics=lambda x, u, t: jnp.sqrt(x), initial_state=lfm.Gaussian(jnp.ones(2), jnp.eye(2)))


def test_names_units_and_defaults():
    model = make(units={"time": "h", "u": "mol"}, state_names=("a", "b"))
    assert model.units == {"time": "h", "u": "mol"} and model.output_names == ("y0", "y1")
    assert model.force_names == ("u",) and model.state_names == ("a", "b")
    assert make(forces={}).force_names == ()
