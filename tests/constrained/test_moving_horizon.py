"""Moving horizon estimation against the filter, the fixed-lag smoother and full information."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import Linear, Motif, whole_state

import lfm_ppl as lfm

TIMES = np.array([0.0, 0.2, 0.5, 0.7, 1.1, 1.1, 1.6, 2.0, 2.3, 2.9, 3.1, 3.6])
RNG = np.random.default_rng(0)
Y = 0.05 * np.sin(2.0 * TIMES)[:, None] + 0.025 * RNG.normal(size=(12, 1))
Y[4] = np.nan
WINDOW = 5


def linear():
    return lfm.LatentForceModel(
        Linear(jnp.array([[-0.6]]), jnp.array([[0.25]])), {"factor": lfm.Matern(1.0, 1.0)},
        lfm.GaussianObservation(whole_state, jnp.array([0.025**2])), lfm.Gaussian(jnp.zeros(1), 0.1 * jnp.eye(1)),
        process_noise=1e-3 * jnp.eye(1), initial_time=0.0)


MODEL = linear()


def test_without_constraints_it_is_the_kalman_filter():
    estimate = lfm.MovingHorizon(MODEL, window=WINDOW, delay=0).estimate(TIMES, Y)
    filtered = lfm.filter(MODEL, TIMES, Y)
    rows = slice(WINDOW - 1, None)
    np.testing.assert_allclose(estimate.state_mean[rows, 0], filtered.filtered_mean[rows, 0], atol=1e-9)
    np.testing.assert_allclose(estimate.force_mean[rows, 0], filtered.filtered_mean[rows, 1], atol=1e-9)


@pytest.mark.slow
def test_with_a_delay_it_is_the_fixed_lag_smoother():
    estimate = lfm.MovingHorizon(MODEL, window=WINDOW, delay=2).estimate(TIMES, Y)
    for last in (WINDOW - 1, 8, 11):
        y = np.where(np.arange(12)[:, None] <= last, Y, np.nan)
        smoothed = lfm.smooth(MODEL, TIMES, y)
        rows = slice(0 if last == WINDOW - 1 else last - 2, None if last == 11 else last - 1)
        np.testing.assert_allclose(estimate.force_mean[rows, 0], smoothed.force("factor").mean[rows], atol=1e-9)


@pytest.mark.slow
def test_a_window_that_holds_everything_is_full_information():
    full = lfm.full_information(MODEL, TIMES, Y, lower={"factor": 0.0}, grid=np.unique(TIMES))
    estimate = lfm.MovingHorizon(MODEL, window=12, delay=6, lower={"factor": 0.0}).estimate(TIMES, Y)
    assert estimate.converged and np.asarray(full.active).any()
    distinct = np.r_[0:5, 6:12]
    np.testing.assert_allclose(estimate.force_mean[distinct], full.force_mean, atol=1e-7)
    np.testing.assert_allclose(estimate.state_mean[distinct], full.state_mean, atol=1e-7)


@pytest.mark.thorough
def test_one_observation_at_a_time(tmp_path, caplog):
    """The same as the record at once, from a saved state too; nothing is compiled after the second call."""
    horizon = lfm.MovingHorizon(MODEL, window=WINDOW, delay=2, lower={"factor": 0.0})
    record = horizon.estimate(TIMES, Y)
    state, estimates = horizon.start(), []
    for index, (t, y) in enumerate(zip(TIMES, Y, strict=True)):
        if index == 2:
            caplog.clear()
        if index == 7:
            np.savez(tmp_path / "state.npz", *map(np.asarray, state))
            state = type(state)(*np.load(tmp_path / "state.npz").values())
        with jax.log_compiles(), caplog.at_level("DEBUG"):
            state, estimate = horizon.update(state, t, y)
        estimates.append(estimate)
    assert not [record for record in caplog.records if "ompil" in record.message and "jit(_update)" in record.message]
    assert all(estimate.converged for estimate in estimates)
    times = np.array([estimate.time for estimate in estimates])
    assert np.isnan(times[:2]).all() and (times[2:] == TIMES[:10]).all()
    force = np.array([estimate.force("factor").mean for estimate in estimates])
    assert np.isnan(estimate.force("factor").sd) and estimate.state("x0").mean == estimate.state_mean[0]
    with pytest.raises(ValueError, match="factr"):
        estimate.force("factr")
    assert force.min() >= 0.0
    np.testing.assert_allclose(force[WINDOW - 1:], record.force_mean[2:10, 0], atol=1e-7)


@pytest.mark.slow
def test_a_model_that_bends():
    decay = jnp.array([0.8, 1.2])
    model = lfm.LatentForceModel(
        Motif(decay, jnp.array([1.0, 0.6]), 0.3, jnp.exp), {"u": lfm.Matern(1.0, 1.3)},
        lfm.GaussianObservation(whole_state, 0.01 * jnp.ones(2)), lfm.Gaussian(0.3 / decay, 0.1 * jnp.eye(2)),
        initial_time=0.0)
    times = np.linspace(0.5, 5.0, 10)
    y = lfm.simulate(jax.random.key(2), model, times).y
    full = lfm.full_information(model, times, y, lower={"u": -0.3}, grid=times, steps=2)
    longest_window = lfm.MovingHorizon(model, window=10, lower={"u": -0.3}, steps=2).estimate(times, y)
    np.testing.assert_allclose(longest_window.force_mean, full.force_mean, atol=1e-5)
    short_window = lfm.MovingHorizon(model, window=6, lower={"u": -0.3}, steps=2).estimate(times, y)
    assert short_window.converged and short_window.force_mean.min() >= -0.3
    assert np.abs(short_window.force_mean - full.force_mean).max() < 0.5


def test_bad_windows_and_observations_are_named():
    for arguments, name in (({"window": 13}, "13"), ({"window": 1}, "window"), ({"window": 5, "delay": 5}, "delay"),
                            ({"window": 5, "delay": -1}, "delay"), ({"window": 5, "lower": {"u": 0.0}}, "'u'")):
        with pytest.raises(ValueError, match=name):
            lfm.MovingHorizon(MODEL, **arguments).estimate(TIMES, Y)
    horizon = lfm.MovingHorizon(MODEL, window=WINDOW)
    for t, y, name in ((0.0, [0.0, 1.0], r"\(2,\)"), (-1.0, [0.0], "-1")):
        with pytest.raises(ValueError, match=name):
            horizon.update(horizon.start(), t, y)
