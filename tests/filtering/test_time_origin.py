"""The origin of time is a convention: no result may depend on it."""


import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.model.state_space import state_space

ROWS = 120


def oscillator(rate, drag=0.0):
    """Eight periods in a hundred rows, pushed by a force whose lengthscale is twelve rows."""
    frequency = 2 * np.pi * 0.08 * rate
    return lfm.LatentForceModel(
        lambda x, u, t: jnp.stack([x[1], frequency**2 * (u[0] - x[0]) - drag * frequency * jnp.tanh(x[1] / frequency)]),
        {"push": lfm.Matern(1.0, 12.0 / rate)}, lfm.GaussianObservation(lambda x, u, t: x[:1], jnp.array([0.05**2])),
        lfm.Gaussian(jnp.zeros(2), jnp.diag(jnp.array([1.0, frequency**2]))))


def stamps(origin, rate, jitter):
    """Time stamps as a logger writes them, and the same numbers counted from the first one."""
    steps = 1.0 + jitter * np.random.default_rng(1).uniform(-1, 1, ROWS - 1)
    times = origin + np.concatenate([[0.0], np.cumsum(steps)]) / rate
    return times, times - times[0]


@pytest.mark.parametrize("origin, jitter, rate, drag", [
    (1.7e9, 0.2, 1e4, 0.3), *(pytest.param(*case, marks=pytest.mark.slow) for case in (
        (1e6, 0.0, 1.0, 0.0), (1.7e9, 0.2, 1e3, 0.0)))])
def test_the_log_likelihood_does_not_depend_on_the_origin(origin, jitter, rate, drag):
    times, since = stamps(origin, rate, jitter)
    y = np.sin(2 * np.pi * 0.08 * rate * since)[:, None] + 0.05 * np.random.default_rng(2).normal(size=(ROWS, 1))
    model = oscillator(rate, drag)
    expected, result = (lfm.filter(model, origin, y, steps=4) for origin in (since, times))
    np.testing.assert_allclose(result.log_likelihood, expected.log_likelihood, atol=1e-9)


@pytest.mark.slow
def test_moments_at_requested_times_do_not_depend_on_the_origin():
    times, since = stamps(1.7e9, 1e3, 0.2)
    requested = 1.7e9 + np.linspace(0.0, 0.1, 40)
    y = np.sin(2 * np.pi * 80.0 * since)[:, None]
    model = oscillator(1e3, 0.3)
    expected = lfm.smooth(model, since, y, at=requested - times[0], steps=4, iterations=2)
    result = lfm.smooth(model, times, y, at=requested, steps=4, iterations=2)
    np.testing.assert_allclose(result.mean, expected.mean, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(result.covariance, expected.covariance, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("times", [
    np.arange(100_000) * 0.1, 1e6 + np.arange(100_000) * 1e-4, 1.7e9 + np.arange(100_000) * 1e-3,
    np.linspace(0.0, 7.0, 100_000), np.cumsum(np.full(100_000, 1 / 3))], ids=str)
def test_regular_times_have_few_interval_lengths(times):
    grid = build_time_grid(state_space(oscillator(1.0)), times, 1)
    lengths = np.asarray(grid.lengths)
    assert len(lengths) < 100
    np.testing.assert_allclose(lengths[grid.intervals.length_index][1:], np.diff(times), rtol=2e-15, atol=0.0)


def test_interval_lengths_are_not_chained():
    """Neighbours agree to their rounding, the first and the last do not."""
    length = 1.0 + 4 * np.finfo(float).eps * np.arange(500)
    times = np.concatenate([[0.0], np.cumsum(length)])
    grid = build_time_grid(state_space(oscillator(1.0)), times, 1)
    result = np.asarray(grid.lengths)[grid.intervals.length_index]
    np.testing.assert_allclose(result, grid.intervals.length, rtol=2e-15, atol=0.0)


@pytest.mark.slow
def test_a_known_input_is_read_on_the_side_of_the_interval():
    """It jumps at the rows, whose stamps have few digits left."""
    times, since = stamps(1.7e9, 1e4, 0.2)
    values = np.random.default_rng(3).normal(size=ROWS)

    def model(table):
        signal = lfm.Input(table, values)
        return lfm.LatentForceModel(
            lambda x, u, t: 1e4 * (signal(t) - x), {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.01])),
            lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))

    y = np.zeros((ROWS, 1))
    expected, result = lfm.filter(model(since), since, y), lfm.filter(model(times), times, y)
    np.testing.assert_allclose(result.log_likelihood, expected.log_likelihood, atol=1e-9)
