"""Observations that arrive one by one or in windows: the same numbers as in one pass."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import systems

import lfm_ppl as lfm

MODEL = lfm.LatentForceModel(
    lambda x, u, t: jnp.stack([u[0] - x[0] ** 3, x[0] - x[1]]), {"drive": lfm.Matern(1.0, 1.0)},
    lfm.GaussianObservation(lambda x, u, t: jnp.stack([x[0] + 0.1 * x[1] ** 2]), jnp.array([0.04])),
    lfm.Gaussian(jnp.zeros(2), jnp.eye(2)), process_noise=0.2 * jnp.eye(2), initial_time=0.0)
TIMES = np.cumsum(np.random.default_rng(0).uniform(0.1, 0.3, 24))
Y = np.where(np.arange(24) % 5 == 3, np.nan, np.random.default_rng(1).normal(size=24))[:, None]


def same(parts, whole):
    """Every field of the parts, one after the other, equals that of the whole."""
    for name in ("times", "log_likelihood", "predicted_mean", "predicted_covariance", "filtered_mean",
                 "filtered_covariance", "whitened_innovation"):
        joined = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_allclose(joined, getattr(whole, name), rtol=1e-10, atol=1e-12, err_msg=name)


def stream(cuts):
    parts, state = [], None
    for begin, end in zip((0, *cuts), (*cuts, len(TIMES)), strict=True):
        parts.append(lfm.filter(MODEL, TIMES[begin:end], Y[begin:end], steps=3, start=state))
        state = parts[-1].state
    return parts


@pytest.fixture(scope="module")
def whole():
    return lfm.filter(MODEL, TIMES, Y, steps=3)


def test_one_observation_at_a_time(whole, caplog):
    """Also those that are missing altogether; and after the second there is nothing more to compile."""
    parts = stream(range(1, 24))
    same(parts, whole)
    with jax.log_compiles(), caplog.at_level("DEBUG"):
        again = lfm.filter(MODEL, TIMES[8:9], Y[8:9], steps=3, start=parts[7].state)
    assert not [record for record in caplog.records if "ompil" in record.message and "filter_on" in record.message]
    np.testing.assert_array_equal(again.filtered_mean, parts[8].filtered_mean)


def test_windows_with_predictions_between_them():
    """Two observed windows, each with a prediction after it, from which the next window goes on."""
    window = np.arange(24) // 6 % 2 == 0
    y = np.where(window[:, None], Y, np.nan)
    joint = lfm.filter(MODEL, TIMES, y, steps=3)
    parts, state = [], None
    for begin in range(0, 24, 6):
        parts.append(lfm.filter(MODEL, TIMES[begin:begin + 6], y[begin:begin + 6], steps=3, start=state))
        state = parts[-1].state
    same(parts, joint)
    gap = ~window
    assert np.all(np.asarray(joint.log_likelihood)[gap] == 0.0)
    np.testing.assert_array_equal(joint.predicted_mean[gap], joint.filtered_mean[gap])


def test_a_saved_state_goes_on(tmp_path):
    """A state is three arrays: written to a file and read back, it continues the same."""
    first = lfm.filter(MODEL, TIMES[:6], Y[:6], steps=3)
    np.savez(tmp_path / "state.npz", *map(np.asarray, first.state))
    with np.load(tmp_path / "state.npz") as kept:
        state = lfm.FilterState(*(jnp.asarray(kept[name]) for name in kept.files))
    after, same_after = (lfm.filter(MODEL, TIMES[6:12], Y[6:12], steps=3, start=one) for one in (state, first.state))
    np.testing.assert_array_equal(after.filtered_mean, same_after.filtered_mean)


def test_the_first_call_needs_an_observation():
    with pytest.raises(ValueError, match="every entry of y is missing"):
        lfm.filter(MODEL, TIMES[:2], np.full((2, 1), np.nan), steps=3)


def cubic(x, u, t):
    return u - x**3


def repeating(period_decay, lengthscale):
    """A model whose force jumps at 1.1 and 2.6; its parameters may be traced."""
    kernel = lfm.forces.PeriodicSquaredExponential(1.0, lengthscale, 1.5)
    force = lfm.QuasiPeriodic(kernel, lfm.forces.SQM(period_decay, (1.1, 2.6)), functions=3)
    return lfm.LatentForceModel(
        cubic, {"drive": force}, lfm.GaussianObservation(systems.whole_state, jnp.array([0.04])),
        lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), initial_time=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("cut", [pytest.param(3, marks=pytest.mark.slow), 12])
def test_forces_that_jump_go_on_in_compiled_code(cut):
    """The times are known; the state comes from the same compiled function, or from outside of it as an argument."""
    times = TIMES[:18]
    decays = jnp.array([0.7, 2.0])

    def first(decay):
        return lfm.filter(repeating(decay, 1.2), times[:cut], Y[:cut], steps=3)

    def second(decay, state):
        return lfm.filter(repeating(decay, 1.2), times[cut:], Y[cut:18], steps=3, start=state).log_likelihood

    expected = [lfm.filter(repeating(decay, 1.2), times, Y[:18], steps=3).log_likelihood[cut:] for decay in decays]
    within = jax.vmap(lambda decay: second(decay, first(decay).state))(decays)
    np.testing.assert_allclose(within, expected, rtol=1e-9)
    states = jax.vmap(lambda decay: first(decay).state)(decays)
    passed_in = jax.jit(jax.vmap(second))(decays, states)
    np.testing.assert_allclose(passed_in, expected, rtol=1e-9)


@pytest.mark.slow
def test_a_jump_is_not_repeated_where_the_filter_stands_at_it():
    """The first window ends exactly at the jump, which it has seen."""
    times = np.array([0.4, 1.1, 1.9, 2.6, 3.0])
    model, y = repeating(0.7, 1.2), np.array([0.1, 0.4, -0.3, 0.2, 0.0])[:, None]
    joint = lfm.filter(model, times, y, steps=3)
    first = lfm.filter(model, times[:2], y[:2], steps=3)
    on = jax.jit(lambda state: lfm.filter(model, times[2:], y[2:], steps=3, start=state))(first.state)
    np.testing.assert_allclose(on.log_likelihood, joint.log_likelihood[2:], rtol=1e-9)
    np.testing.assert_allclose(on.filtered_covariance, joint.filtered_covariance[2:], rtol=1e-9, atol=1e-12)


def test_longest_steps_need_a_known_start():
    state = lfm.filter(MODEL, TIMES[:6], Y[:6], steps=3).state
    with pytest.raises(ValueError, match="max_step.*`start`.*NumPy arrays"):
        jax.jit(lambda state: lfm.filter(MODEL, TIMES[6:], Y[6:], max_step=0.1, start=state))(state)
