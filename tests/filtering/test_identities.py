"""Ways of saying the same that must give the same."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import Motif, first_state, identity, motif, softplus, whole_state

import lfm_ppl as lfm

TIMES = np.array([0.5, 1.0, 1.0, 2.2, 3.0])
Y = np.random.default_rng(1).normal(0.6, 0.3, size=(5, 2))
Y[2, 1] = Y[3] = np.nan


@pytest.fixture(scope="module")
def model():
    return motif(variance=0.1)


def assert_same(a: Any, b: Any, tolerance: float):
    for leaf, expected_leaf in zip(jax.tree_util.tree_leaves(a), jax.tree_util.tree_leaves(b), strict=True):
        leaf, expected_leaf = np.nan_to_num(leaf), np.nan_to_num(expected_leaf)
        assert leaf.shape == expected_leaf.shape
        assert np.abs(leaf - expected_leaf).max() <= tolerance * (1 + np.abs(expected_leaf).max())


def moments_of(result):
    return (result.log_likelihood, result.predicted_mean, result.predicted_covariance, result.filtered_mean,
            result.filtered_covariance)


class Polynomial(eqx.Module):
    """Two states and a force, of degree three, with products between all of them."""

    strength: Any = 0.4

    def __call__(self, x, u, t):
        return jnp.stack([-x[0] + self.strength * x[0] * x[1] + u[0],
                          -x[1] + 0.3 * x[0] ** 2 * u[0] - 0.1 * x[1] ** 3 + 0.2 * t])


@pytest.mark.slow
def test_projected_points_equal_points_in_the_whole_state_within_their_degree():
    model = lfm.LatentForceModel(
        Polynomial(), {"u": lfm.Matern(0.7, 1.0, 0)}, lfm.GaussianObservation(whole_state, 0.1 * jnp.ones(2)),
        lfm.Gaussian(jnp.array([0.5, 0.2]), 0.05 * jnp.eye(2)))
    result = [lfm.filter(model, TIMES, Y, rule=lfm.GaussHermite(3, full_state=full), steps=2)
             for full in (False, True)]
    assert_same(moments_of(result[0]), moments_of(result[1]), 1e-10)


@pytest.mark.slow
def test_replicates_in_any_order(model):
    y = np.array([[0.5, 0.6], [0.9, np.nan], [0.4, 0.8], [0.7, 0.2]])
    times = [1.0, 1.0, 1.0, 2.0]
    order = [2, 0, 1, 3]
    ordered, permuted = (lfm.smooth(model, times, values, steps=5) for values in (y, y[order]))
    assert_same((ordered.mean, ordered.covariance, ordered.log_likelihood.sum()),
                (permuted.mean, permuted.covariance, permuted.log_likelihood.sum()), 1e-10)
    assert_same(ordered.leave_one_out[jnp.array(order)], permuted.leave_one_out, 1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize("link, error", [(identity, 1e-8), pytest.param(softplus, 2e-3, marks=pytest.mark.slow)])
def test_requested_times_change_nothing_elsewhere(link, error):
    """Requested times divide the steps, so that a model that is not linear changes by the error of its integration."""
    model = motif(link, variance=0.1)
    plain = lfm.smooth(model, TIMES, Y, at=TIMES)
    extra = lfm.smooth(model, TIMES, Y, at=np.r_[5.0, TIMES, 0.7, 2.9, 10.0])
    np.testing.assert_allclose(extra.log_likelihood, plain.log_likelihood, atol=error)
    np.testing.assert_allclose(extra.leave_one_out, plain.leave_one_out, atol=error)
    sd = np.sqrt(np.diagonal(plain.covariance, axis1=1, axis2=2))
    np.testing.assert_array_less(np.abs(extra.mean[1:6] - plain.mean), error * sd + 1e-12)
    np.testing.assert_array_less(np.abs(extra.covariance[1:6] - plain.covariance),
                                 2 * error * sd[:, :, None] * sd[:, None, :] + 1e-12)


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
    (rows_value, rows_state), slope = jax.value_and_grad(rows, has_aux=True)(theta)
    (outputs_value, outputs_state), outputs_slope = jax.value_and_grad(outputs, has_aux=True)(theta)
    assert_same((rows_value, rows_state, slope), (outputs_value, outputs_state, outputs_slope), 1e-9)


def three_times(x, u, t):
    return jnp.repeat(x[:1], 3)


@pytest.mark.parametrize("rule", [
    lfm.MonteCarlo(50, seed=1), pytest.param(lfm.Unscented(0.8, 2.0, 1.0), marks=pytest.mark.slow)],
    ids=lambda rule: rule.name)
def test_rules_agree_on_a_linear_model(rule):
    model = motif(identity, variance=0.1)
    assert_same(moments_of(lfm.filter(model, TIMES, Y, rule=rule)), moments_of(lfm.filter(model, TIMES, Y)), 1e-10)


@pytest.mark.slow
def test_parameters_and_times_may_be_traced(model):
    def log_likelihood(decay, times):
        return lfm.filter(motif(decay=decay, variance=0.1), times, Y).log_likelihood

    batch = jax.jit(jax.vmap(log_likelihood, (0, None)))(jnp.array([0.8, 1.1]), jnp.asarray(TIMES))
    assert_same(batch, jnp.stack([lfm.filter(motif(decay=decay, variance=0.1), TIMES, Y).log_likelihood
                                  for decay in (0.8, 1.1)]), 1e-10)


@pytest.mark.slow
def test_more_interval_lengths_than_are_tabulated():
    """Their transitions are then computed row by row; two shorter series have their own tables."""
    model = motif(identity, genes=1, variance=0.1)
    times = np.cumsum(np.random.default_rng(2).uniform(0.01, 0.1, size=1300))
    y = np.sin(times)[:, None]
    full_result = lfm.filter(model, times, y)
    first = lfm.filter(model, times[:650], y[:650])
    second = lfm.filter(model, times[650:], y[650:], start=first.state)
    assert_same(full_result.log_likelihood, jnp.concatenate([first.log_likelihood, second.log_likelihood]), 1e-10)
    assert_same(full_result.state, second.state, 1e-10)
