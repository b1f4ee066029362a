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


def assert_same(parts, full_result):
    """Every field of the parts, one after the other, equals that of the whole."""
    for name in ("times", "log_likelihood", "predicted_mean", "predicted_covariance", "filtered_mean",
                 "filtered_covariance", "whitened_innovation"):
        joined = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_allclose(joined, getattr(full_result, name), rtol=1e-10, atol=1e-12, err_msg=name)


def stream(cuts):
    parts, state = [], None
    for begin, end in zip((0, *cuts), (*cuts, len(TIMES)), strict=True):
        parts.append(lfm.filter(MODEL, TIMES[begin:end], Y[begin:end], steps=3, start=state))
        state = parts[-1].state
    return parts


@pytest.fixture(scope="module")
def full_result():
    return lfm.filter(MODEL, TIMES, Y, steps=3)


def test_one_observation_at_a_time(full_result, caplog, tmp_path):
    """Also those that are missing altogether, and from a saved state; after the second nothing more is compiled."""
    parts = stream(range(1, 24))
    assert_same(parts, full_result)
    np.savez(tmp_path / "state.npz", *map(np.asarray, parts[7].state))
    with np.load(tmp_path / "state.npz") as arrays:
        state = lfm.FilterState(*(jnp.asarray(arrays[name]) for name in arrays.files))
    with jax.log_compiles(), caplog.at_level("DEBUG"):
        row_result = lfm.filter(MODEL, TIMES[8:9], Y[8:9], steps=3, start=state)
    assert not [record for record in caplog.records if "ompil" in record.message and "filter_on" in record.message]
    np.testing.assert_array_equal(row_result.filtered_mean, parts[8].filtered_mean)
    with pytest.raises(ValueError, match="max_step.*start"):
        jax.jit(lambda state: lfm.filter(MODEL, TIMES[8:], Y[8:], max_step=0.1, start=state))(state)


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
def test_forces_that_jump_go_on_in_compiled_code():
    """The times are known; the state comes from the same compiled function, or from outside of it as an argument."""
    cut, times = 12, TIMES[:18]
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
