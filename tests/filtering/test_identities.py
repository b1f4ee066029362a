"""Ways of saying the same that must give the same."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rules import RULES
from systems import Motif, Oscillator, double_well, first_state, identity, motif, softplus, whole_state

import lfm_ppl as lfm

TIMES = np.array([0.5, 1.0, 1.0, 2.2, 3.0])
Y = np.random.default_rng(1).normal(0.6, 0.3, size=(5, 2))
Y[2, 1] = Y[3] = np.nan


@pytest.fixture(scope="module")
def model():
    return motif(variance=0.1)


def same(a: Any, b: Any, tolerance: float):
    for one, other in zip(jax.tree_util.tree_leaves(a), jax.tree_util.tree_leaves(b), strict=True):
        one, other = np.nan_to_num(one), np.nan_to_num(other)
        assert one.shape == other.shape
        assert np.abs(one - other).max() <= tolerance * (1 + np.abs(other).max())


def moments_of(result):
    return (result.log_likelihood, result.predicted_mean, result.predicted_covariance, result.filtered_mean,
            result.filtered_covariance)


def test_cubature_is_an_unscented_transform():
    oscillator = lfm.LatentForceModel(
        Oscillator(1.0, 0.5, 0.7), {"u": lfm.Matern(1.0, 1.0, 0)}, lfm.GaussianObservation(first_state, jnp.ones(1)),
        lfm.Gaussian(jnp.ones(2), 0.2 * jnp.eye(2)))
    result = [lfm.filter(oscillator, TIMES, Y[:, :1], rule=rule, steps=3)
             for rule in (lfm.Cubature(), lfm.Unscented(1.0, 0.0, 0.0))]
    same(moments_of(result[0]), moments_of(result[1]), 1e-12)


class Polynomial(eqx.Module):
    """Two states and a force, of degree three, with products between all of them."""

    strength: Any = 0.4

    def __call__(self, x, u, t):
        return jnp.stack([-x[0] + self.strength * x[0] * x[1] + u[0],
                          -x[1] + 0.3 * x[0] ** 2 * u[0] - 0.1 * x[1] ** 3 + 0.2 * t])


@pytest.mark.parametrize("dynamics", [
    pytest.param(Polynomial(), id="polynomial"),
    pytest.param(Motif(jnp.array([0.8, 1.2]), jnp.array([1.0, 0.5]), 0.2, jnp.square), id="quadratic motif",
                 marks=pytest.mark.slow)])
def test_projected_points_equal_points_in_the_whole_state_within_their_degree(dynamics):
    model = lfm.LatentForceModel(
        dynamics, {"u": lfm.Matern(0.7, 1.0, 0)}, lfm.GaussianObservation(whole_state, 0.1 * jnp.ones(2)),
        lfm.Gaussian(jnp.array([0.5, 0.2]), 0.05 * jnp.eye(2)))
    result = [lfm.filter(model, TIMES, Y, rule=lfm.GaussHermite(3, full_state=full), steps=2)
             for full in (False, True)]
    same(moments_of(result[0]), moments_of(result[1]), 1e-10)


@pytest.mark.slow
def test_projected_and_full_points_converge_to_the_same_value():
    """Softplus is no polynomial: the rules differ, and converge to one value with the number of points."""
    model = motif(order=0, genes=1, variance=0.1, lengthscale=2.0)
    y = Y[:, :1]
    values = {(full, order): float(lfm.filter(model, TIMES, y, rule=lfm.GaussHermite(order, full_state=full),
                                              steps=1).log_likelihood.sum())
              for full in (False, True) for order in (3, 18)}
    limit = values[False, 18]
    assert abs(values[True, 18] - limit) < 1e-7
    assert min(abs(values[False, 3] - limit), abs(values[True, 3] - limit),
               abs(values[False, 3] - values[True, 3])) > 1e-6


def test_replicates_in_any_order(model):
    y = np.array([[0.5, 0.6], [0.9, np.nan], [0.4, 0.8], [0.7, 0.2]])
    times = [1.0, 1.0, 1.0, 2.0]
    order = [2, 0, 1, 3]
    one, other = (lfm.smooth(model, times, values, steps=5) for values in (y, y[order]))
    same((one.mean, one.covariance, one.log_likelihood.sum()), (other.mean, other.covariance,
                                                                other.log_likelihood.sum()), 1e-10)
    same(one.leave_one_out[jnp.array(order)], other.leave_one_out, 1e-9)


@pytest.mark.slow
def test_an_interval_in_two_pieces(model):
    """A row without observations in the middle of every interval, with half of the steps on each side."""
    times = np.array([0.0, 1.0, 2.5, 3.0])
    y = Y[[0, 1, 3, 4]]
    cut = np.sort(np.r_[times, 0.5 * (times[1:] + times[:-1])])
    padded = np.full((len(cut), y.shape[1]), np.nan)
    padded[::2] = y
    whole = lfm.smooth(model, times, y, steps=6)
    halves = lfm.smooth(model, cut, padded, steps=3)
    same((whole.log_likelihood, whole.leave_one_out), (halves.log_likelihood[::2], halves.leave_one_out[::2]), 1e-8)
    same((whole.mean, whole.covariance), (halves.mean[::2], halves.covariance[::2]), 1e-8)


@pytest.mark.parametrize("link, steps", [(identity, 2), pytest.param(softplus, 2, marks=pytest.mark.slow)])
def test_requested_times_change_nothing_elsewhere(link, steps):
    model = motif(link, variance=0.1)
    plain = lfm.smooth(model, TIMES, Y, steps=steps, at=TIMES)
    extra = lfm.smooth(model, TIMES, Y, steps=steps, at=np.r_[5.0, TIMES, 0.7, 2.9, 10.0])
    same((plain.log_likelihood, plain.leave_one_out), (extra.log_likelihood, extra.leave_one_out), 1e-8)
    same((plain.mean, plain.covariance), (extra.mean[1:6], extra.covariance[1:6]), 1e-8)


@pytest.mark.slow
def test_replicates_are_one_observation_of_several_outputs():
    """Three values at each time, row by row or as three outputs: predictions of length zero are passed over."""
    times, y = np.array([0.5, 1.0, 2.2]), np.random.default_rng(3).normal(0.6, 0.3, size=(3, 3))

    def build(theta, observe, count):
        return lfm.LatentForceModel(
            Motif(theta[0], theta[1], 0.3, softplus), {"u": lfm.Matern(1.0, theta[2], 1)},
            lfm.GaussianObservation(observe, 0.04 * jnp.ones(count)),
            lfm.Gaussian(jnp.array([0.4]), 0.1 * jnp.eye(1)), initial_time=0.0)

    def rows(theta):
        result = lfm.filter(build(theta, first_state, 1), np.repeat(times, 3), y.reshape(9, 1))
        return result.log_likelihood.sum(), result.state

    def outputs(theta):
        result = lfm.filter(build(theta, three_times, 3), times, y)
        return result.log_likelihood.sum(), result.state

    theta = jnp.array([0.8, 1.1, 1.3])
    (one, one_state), slope = jax.value_and_grad(rows, has_aux=True)(theta)
    (other, other_state), other_slope = jax.value_and_grad(outputs, has_aux=True)(theta)
    same((one, one_state, slope), (other, other_state, other_slope), 1e-9)


def three_times(x, u, t):
    return jnp.repeat(x[:1], 3)


def test_steps_follow_max_step(model):
    coarse = lfm.filter(model, TIMES, Y, steps=8)
    # At most 0.1: the longest interval, of 1.2, needs 12 steps.
    fine = lfm.filter(model, TIMES, Y, steps=2, max_step=0.1)
    same(coarse.log_likelihood, fine.log_likelihood, 1e-5)
    assert np.abs(coarse.log_likelihood - fine.log_likelihood).max() > 0


@pytest.mark.parametrize("cut", [pytest.param(1, marks=pytest.mark.slow), 2,
                                 pytest.param(3, marks=pytest.mark.slow)])
def test_filter_goes_on_from_its_state(model, cut):
    """Also where the cut falls between two replicates."""
    whole = lfm.filter(model, TIMES, Y, steps=4)
    first = lfm.filter(model, TIMES[:cut], Y[:cut], steps=4)
    second = lfm.filter(model, TIMES[cut:], Y[cut:], steps=4, start=first.state)
    joined = jax.tree_util.tree_map(lambda a, b: jnp.concatenate([a, b]), moments_of(first), moments_of(second))
    same(moments_of(whole), joined, 1e-12)
    same(whole.state, second.state, 1e-12)


@pytest.mark.slow
def test_requested_times_come_in_the_order_that_was_asked(model):
    shuffled = np.array([2.2, 4.0, 0.5, 1.7])
    order = np.argsort(shuffled)
    one, other = (lfm.smooth(model, TIMES, Y, at=at) for at in (shuffled, shuffled[order]))
    same(one.mean[order], other.mean, 0.0)
    assert np.array_equal(one.times, shuffled)


@pytest.mark.slow
def test_a_long_gap_in_one_row_and_in_a_thousand():
    """Missing observations cut the gap; max_step does the same inside one row."""
    model = double_well(mean=0.3, variance=0.1, dispersion=0.6)
    whole = lfm.filter(model, [50.0], [[0.8]], steps=10, max_step=0.05)
    cut = lfm.filter(model, np.linspace(0.05, 50.0, 1000), np.r_[np.full(999, np.nan), 0.8][:, None], steps=1)
    same(whole.log_likelihood, cut.log_likelihood[-1:], 1e-8)
    driven = motif(variance=0.1)  # a gap of 40 lengthscales and decay times
    whole = lfm.filter(driven, [50.0], [[0.8, 0.3]], max_step=0.1)
    y = np.r_[np.full((999, 2), np.nan), [[0.8, 0.3]]]
    cut = lfm.filter(driven, np.linspace(0.05, 50.0, 1000), y, steps=1)
    same(whole.log_likelihood, cut.log_likelihood[-1:], 1e-4)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_rules_agree_on_a_linear_model(rule):
    model = motif(identity, variance=0.1)
    same(moments_of(lfm.filter(model, TIMES, Y, rule=rule)), moments_of(lfm.filter(model, TIMES, Y)), 1e-10)


def test_the_model_may_depend_on_parameters_that_are_traced(model):
    def total(decay):
        return lfm.filter(motif(decay=decay, variance=0.1), TIMES, Y).log_likelihood.sum()

    same(jax.jit(total)(0.8), lfm.filter(model, TIMES, Y).log_likelihood.sum(), 1e-12)
    assert np.allclose(jax.vmap(total)(jnp.array([0.8, 1.1])), [total(0.8), total(1.1)], rtol=1e-12)


def test_traced_times(model):
    result = jax.jit(lambda t: lfm.filter(model, t, Y).log_likelihood)(jnp.asarray(TIMES))
    start = lfm.LatentForceModel(model.dynamics, model.forces, model.observation, model.initial_state,
                                 initial_time=0.0)
    same(result, lfm.filter(start, TIMES, Y).log_likelihood, 1e-10)


def test_more_interval_lengths_than_are_tabulated():
    """Their transitions are then computed row by row; two shorter series have their own tables."""
    model = motif(identity, genes=1, variance=0.1)
    times = np.cumsum(np.random.default_rng(2).uniform(0.01, 0.1, size=1300))
    y = np.sin(times)[:, None]
    whole = lfm.filter(model, times, y)
    first = lfm.filter(model, times[:650], y[:650])
    second = lfm.filter(model, times[650:], y[650:], start=first.state)
    same(whole.log_likelihood, jnp.concatenate([first.log_likelihood, second.log_likelihood]), 1e-10)
    same(whole.state, second.state, 1e-10)
