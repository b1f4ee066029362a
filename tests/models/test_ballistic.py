"""The target on reentry: its integration step, and the wrapping azimuth of the one in three dimensions."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl.inference.bind import bind
from lfm_ppl.inference.optimise import newton, quasi_newton
from lfm_ppl.io import loading


def module(name):
    """Return the module of a model file."""
    return sys.modules[loading.load(name).model.__module__]


@pytest.mark.slow
def test_one_step_between_measurements_is_exact():
    """Over the prior: to 0.005 everywhere, and to 0.001 within 50 nats of the best, where a posterior may be."""
    file, model_file = loading.load("ballistic"), module("ballistic")
    data = file.simulate()

    def densities(z):
        system = model_file.build(*jnp.exp(z), **model_file.KNOWN)
        single, eight = (lfm.MarginalLikelihood(system, data.times, steps=steps) for steps in (1, 8))
        return single.log_prob(data.y), eight.log_prob(data.y)

    centre = np.log([5e-4, 30.0, 5.0])
    spread = np.array([1.0, 1.0, 0.7])
    points = centre + spread * np.random.default_rng(0).uniform(-1.5, 1.5, (12, 3))
    single, eight = jax.jit(lambda all_: jax.lax.map(densities, all_, batch_size=4))(jnp.asarray(points))
    single, eight = np.asarray(single), np.asarray(eight)
    possible = eight > eight.max() - 50.0
    assert 3 < possible.sum() < 12
    np.testing.assert_allclose(single, eight, rtol=0, atol=5e-3)
    np.testing.assert_allclose(single[possible], eight[possible], rtol=0, atol=1e-3)


@pytest.fixture(scope="module")
def likelihoods():
    """Return (data, function of bearing and measurements -> log likelihood and smoothed means) in three dimensions."""
    model_file = module("ballistic_3d")
    data = loading.load("ballistic-3d").simulate()

    def run(bearing, y):
        system = model_file.build(**model_file.TRUTH, bearing=bearing)
        result = lfm.smooth(system, data.times, y, steps=1, max_step=model_file.LONGEST_STEP, iterations=0)
        return result.log_likelihood.sum(), result.mean

    return data, jax.jit(run)


@pytest.mark.thorough
@pytest.mark.parametrize("bearing", [np.pi, 2.0, -40.0])
def test_turning_the_radar_changes_nothing(likelihoods, bearing):
    """The azimuth of the default data wraps; with the axis turned to the target it does not. The answer is the same."""
    data, run = likelihoods
    assert np.abs(np.diff(data.y[:, 1])).max() > 6.0 and (np.abs(data.y[:, 1]) <= np.pi).all()
    turned = np.array(data.y)
    turned[:, 1] = (turned[:, 1] - bearing + np.pi) % (2 * np.pi) - np.pi
    assert bearing != np.pi or np.abs(np.diff(turned[:, 1])).max() < 0.1
    turned[::3, 1] += 2 * np.pi  # the same angle
    expected, mean = run(0.0, data.y)
    result, turned_mean = run(bearing, turned)
    np.testing.assert_allclose(result, expected, rtol=1e-8)
    np.testing.assert_allclose(turned_mean, mean, rtol=1e-6, atol=1e-6)


@pytest.mark.thorough
def test_the_smoother_finds_the_target_where_the_azimuth_jumps(likelihoods):
    data, run = likelihoods
    state = np.asarray(data.truth["state"])[::10]
    error = np.asarray(run(0.0, data.y)[1])[:, :3] - state[:, :3]
    # 1 mrad at 80 km is 80 m, before it is smoothed.
    assert np.sqrt(np.mean(error**2)) < 80.0


@pytest.mark.slow
def test_gross_errors_move_parameters_only_where_errors_are_gaussian():
    """Modes with 6 of 120 distances off by 20 standard deviations, against those in which they are missing, in sds."""
    file = loading.load("ballistic")
    data = file.simulate()
    shifts = []
    for df in (4.0, 0.0):
        bound = bind(file.model, data.times, data.y, model_kwargs=file.keywords(data, {"df": df}))
        bound = bound.fix(file.anchors(data))
        start = bound.draw(jax.random.key(0))
        for seed in range(3):
            rng = np.random.default_rng(seed)
            spoilt = np.zeros(data.y.shape, bool)
            spoilt[rng.choice(len(spoilt), 6, replace=False)] = True
            error = 600.0 * rng.choice([-1.0, 1.0], data.y.shape)
            objectives = [bound.with_data(np.where(spoilt, values, data.y)).objective()
                          for values in (np.nan, data.y + error)]
            without, with_errors = (newton(objective, quasi_newton(objective, start).point) for objective in objectives)
            assert max(without.decrement, with_errors.decrement) < 1e-8
            sd = np.sqrt(np.diag(without.curvature.factor @ without.curvature.factor.T))
            shifts.append(np.abs((with_errors.point - without.point) / sd).max())
    assert max(shifts[:3]) < 0.2 and min(shifts[3:]) > 1.0
