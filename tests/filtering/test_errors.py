"""What a user meets who passes something wrong: the argument, what came, the remedy."""

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


@pytest.mark.parametrize("times, y, options, message", [
    ([1.0, 0.5, 2.0], Y, {}, r"times must not go back: row 1 is 0.5 after 1. Sort"),
    ([1.0, np.nan, 2.0], Y, {}, r"times must be finite at index \[1\]"),
    ([[1.0, 2.0, 3.0]], Y, {}, r"times must be a vector \(T,\).*got shape \(1, 3\)"),
    ([], np.ones((0, 1)), {}, "at least one entry"),
    ([-1.0, 0.5, 2.0], Y, {}, r"times\[0\] = -1 lies before the model's initial_time = 0; set"),
    (TIMES, np.ones((2, 1)), {}, r"3 times.*shape \(3, 1\); got \(2, 1\)"),
    (TIMES, np.ones((3, 2)), {}, r"got \(3, 2\)"),
    (TIMES, np.full((3, 1), np.nan), {}, "every entry of y is missing"),
    (TIMES, np.array([[1.0], [np.inf], [0.0]]), {}, r"y\[1, 0\] is infinite; use NaN"),
    (TIMES, Y, {"steps": 0}, "steps must be at least 1, got 0"),
    (TIMES, Y, {"max_step": 0.0}, "max_step must be finite and greater than zero, got 0"),
])
def test_values(times, y, options, message):
    for function in (lfm.filter, lfm.smooth):
        with pytest.raises(ValueError, match=message):
            function(MODEL, times, y, **options)


@pytest.mark.parametrize("options, message", [
    ({"steps": 2.5}, "steps must be a whole number, got 2.5"),
    ({"rule": lfm.Cubature}, r"rule must be a linearisation rule.*Call it: lfm.Cubature\(\)"),
    ({"rule": "cubature"}, "rule must be a linearisation rule"),
])
def test_types(options, message):
    with pytest.raises(TypeError, match=message):
        lfm.filter(MODEL, TIMES, Y, **options)
    with pytest.raises(TypeError, match="y must be numeric"):
        lfm.filter(MODEL, TIMES, np.array([["a"], ["b"], ["c"]]))


@pytest.mark.parametrize("options, message", [
    ({"at": [-0.5, 2.0]}, r"at\[0\] = -0.5 lies before the initial time 0; set"),
    ({"at": [[0.5]]}, r"at must be a vector.*|at.*shape"),
    ({"at": [np.nan]}, "at must be finite"),
    ({"iterations": -1}, "iterations must be at least 1, got -1"),
    ({"iterations": 2, "damping": 0.0}, r"damping must lie in \(0, 1\].*got 0.0"),
])
def test_smoother(options, message):
    with pytest.raises(ValueError, match=message):
        lfm.smooth(MODEL, TIMES, Y, **options)


def per_row(x, u, t):
    return x[:1]


def test_a_covariance_for_each_time_needs_one_for_each():
    model = lfm.LatentForceModel(MODEL.dynamics, MODEL.forces,
                                 lfm.GaussianObservation(per_row, 0.1 * jnp.ones((4, 1, 1))), MODEL.initial_state)
    message = "covariance holds 4 matrices, one for each time, but there are 3 times"
    for call in (lambda: lfm.filter(model, TIMES, Y), lambda: lfm.smooth(model, TIMES, Y),
                 lambda: lfm.MarginalLikelihood(model, TIMES), lambda: lfm.simulate(jax.random.key(0), model, TIMES)):
        with pytest.raises(ValueError, match=message):
            call()


def test_where_a_filter_may_start():
    first = lfm.filter(MODEL, TIMES, Y)
    with pytest.raises(TypeError, match="start must be the state of an earlier.*got FilterResult. Pass result.state"):
        lfm.filter(MODEL, TIMES + 9.0, Y, start=first)
    with pytest.raises(ValueError, match=r"times\[0\] = 0 lies before 3, the time of `start`"):
        lfm.filter(MODEL, TIMES - TIMES[0], Y, start=first.state)
    other = lfm.filter(motif(genes=2), TIMES, np.ones((3, 2)))
    with pytest.raises(ValueError, match="start has 4 entries, but the joint state of this model has 1"):
        lfm.filter(MODEL, TIMES + 9.0, Y, start=other.state)


def test_names_of_a_result():
    result = lfm.smooth(motif(genes=1), TIMES, Y)
    with pytest.raises(ValueError, match="unknown force 'v'.*Known: u"):
        result.force("v")
    with pytest.raises(ValueError, match="unknown state 'x1'. Did you mean 'x0'"):
        result.state("x1")
    with pytest.raises(ValueError, match="draws must be at least 1, got 0"):
        result.sample(jax.random.key(0), 0)


def test_the_prior_mean_must_give_finite_values():
    """Functions of time, which are not tried before the data say when."""
    observation = lfm.GaussianObservation(lambda x, u, t: x, jnp.ones(2))
    model = lfm.LatentForceModel(lambda x, u, t: jnp.log(x) + 0.0 * t, {}, observation,
                                 lfm.Gaussian(jnp.array([1.0, -1.0]), jnp.eye(2)), state_names=("a", "b"))
    with pytest.raises(ValueError, match="dynamics returned.*'b' is not finite. Change initial_state.mean, or guard"):
        lfm.filter(model, TIMES, np.ones((3, 2)))
    broken = lfm.GaussianObservation(lambda x, u, t: jnp.sqrt(x - 5.0) + 0.0 * t, jnp.ones(1))
    model = lfm.LatentForceModel(lambda x, u, t: -x, {}, broken, lfm.Gaussian(jnp.ones(1), jnp.eye(1)))
    with pytest.raises(ValueError, match="observation function returned.*'y0' is not finite"):
        lfm.filter(model, TIMES, Y)


def test_traced_times_cannot_be_cut():
    with pytest.raises(ValueError, match="max_step, requested times.*known before compilation; pass NumPy"):
        jax.jit(lambda t: lfm.filter(MODEL, t, Y, max_step=0.1).log_likelihood)(jnp.asarray(TIMES))


def test_nothing_raises_inside_compiled_code():
    """Values that would be refused outside give a number inside."""
    result = jax.jit(lambda noise: lfm.MarginalLikelihood(
        motif(genes=1, noise_sd=noise, variance=0.1), TIMES).log_prob(Y))(jnp.nan)
    assert result == -np.inf


def test_single_precision_warns_once(monkeypatch):
    monkeypatch.setattr(arguments, "_has_warned", False)
    monkeypatch.setattr(arguments.jnp, "result_type", lambda *args: jnp.float32)
    with pytest.warns(UserWarning, match='jax.config.update\\("jax_enable_x64", True\\)'):
        arguments.warn_single_precision()
    arguments.warn_single_precision()  # the second time it is silent; pytest would show a warning as such
    assert arguments._has_warned
