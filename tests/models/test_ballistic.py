"""The target on reentry: its integration step, and the wrapping azimuth of the one in three dimensions."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl.inference.likelihood_site import likelihood_site
from lfm_ppl.io import loading


def module(name):
    """Return the module of a model file."""
    return sys.modules[loading.load(name).model.__module__]


@pytest.mark.slow
def test_one_step_between_measurements_is_exact():
    """Over the prior: to 0.005 everywhere, and to 0.001 within 50 nats of the best, where a posterior may be."""
    file, own = loading.load("ballistic"), module("ballistic")
    data = file.simulate()

    def both(z):
        system = own.build(*jnp.exp(z), **own.KNOWN)
        one, eight = (lfm.MarginalLikelihood(system, data.times, steps=steps) for steps in (1, 8))
        return one.log_prob(data.y), eight.log_prob(data.y)

    centre = np.log([5e-4, 30.0, 5.0])
    spread = np.array([1.0, 1.0, 0.7])
    points = centre + spread * np.random.default_rng(0).uniform(-1.5, 1.5, (12, 3))
    one, eight = jax.jit(lambda all_: jax.lax.map(both, all_, batch_size=4))(jnp.asarray(points))
    one, eight = np.asarray(one), np.asarray(eight)
    possible = eight > eight.max() - 50.0
    assert 3 < possible.sum() < 12
    np.testing.assert_allclose(one, eight, rtol=0, atol=5e-3)
    np.testing.assert_allclose(one[possible], eight[possible], rtol=0, atol=1e-3)


@pytest.mark.slow
def test_rare_measurements_get_more_steps():
    data = loading.load("ballistic").simulate()
    grids = [likelihood_site(loading.load("ballistic").model, (times,), {}, jax.random.key(0)).example.time_grid
             for times in (data.times, data.times[::20])]
    longest = [float(np.max(grid.intervals.length)) / grid.steps for grid in grids]
    assert longest[0] == pytest.approx(30 / 119)
    assert longest[1] <= module("ballistic").LONGEST_STEP


@pytest.fixture(scope="module")
def likelihoods():
    """Return (data, function of bearing and measurements -> log likelihood and smoothed means) in three dimensions."""
    own = module("ballistic_3d")
    data = loading.load("ballistic-3d").simulate()

    def run(bearing, y):
        system = own.build(**own.TRUTH, bearing=bearing)
        result = lfm.smooth(system, data.times, y, steps=1, max_step=own.LONGEST_STEP)
        return result.log_likelihood.sum(), result.mean

    return data, jax.jit(run)


def test_the_azimuth_wraps_in_the_default_data(likelihoods):
    data, _ = likelihoods
    assert np.abs(np.diff(data.y[:, 1])).max() > 6.0
    assert (np.abs(data.y[:, 1]) <= np.pi).all()


@pytest.mark.parametrize("bearing", [np.pi, 2.0, -40.0])
def test_turning_the_radar_changes_nothing(likelihoods, bearing):
    """With the axis turned to the target its azimuth does not wrap; the answer is the same."""
    data, run = likelihoods
    turned = np.array(data.y)
    turned[:, 1] = (turned[:, 1] - bearing + np.pi) % (2 * np.pi) - np.pi
    if bearing == np.pi:
        assert np.abs(np.diff(turned[:, 1])).max() < 0.1
    expected, mean = run(0.0, data.y)
    result, other = run(bearing, turned)
    np.testing.assert_allclose(result, expected, rtol=1e-8)
    np.testing.assert_allclose(other, mean, rtol=1e-6, atol=1e-6)


def test_a_turn_more_is_the_same_angle(likelihoods):
    data, run = likelihoods
    more = np.array(data.y)
    more[::3, 1] += 2 * np.pi
    np.testing.assert_allclose(run(0.0, more)[0], run(0.0, data.y)[0], rtol=1e-8)


def test_the_smoother_finds_the_target_where_the_azimuth_jumps(likelihoods):
    data, run = likelihoods
    state = np.asarray(data.truth["state"])[::10]
    error = np.asarray(run(0.0, data.y)[1])[:, :3] - state[:, :3]
    # 1 mrad at 80 km is 80 m, before it is smoothed.
    assert np.sqrt(np.mean(error**2)) < 80.0


def test_data_turn_with_the_radar():
    file = loading.load("ballistic-3d")
    here, there = file.simulate(seed=5), file.simulate(seed=5, bearing=1.0)
    np.testing.assert_allclose(there.y[:, [0, 2]], here.y[:, [0, 2]])
    np.testing.assert_allclose(np.exp(1j * there.y[:, 1]), np.exp(1j * (here.y[:, 1] - 1.0)), atol=1e-9)
