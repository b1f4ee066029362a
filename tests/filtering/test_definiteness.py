"""Covariances stay positive semi-definite, and forces stationary, however coarse the integration."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from references import LinearLFM, Regression, matern
from systems import Linear, Oscillator, Outputs, first_state, identity, motif, softplus

import lfm_ppl as lfm
from lfm_ppl.filtering.backward import at_interval_starts, backward
from lfm_ppl.filtering.forward import forward
from lfm_ppl.filtering.moments import Record
from lfm_ppl.filtering.problem import filter_problem
from lfm_ppl.filtering.smoothing_kernel import smoothing_kernel
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.filtering.update import GaussianUpdate
from lfm_ppl.model.state_space import state_space

TIMES = np.array([0.0, 0.01, 0.5, 0.5, 1.2, 2.0])
Y = np.array([0.4, 0.40002, 0.43, 0.43, np.nan, 0.3])[:, None]


def first_order(order, linear, variance, noise):
    return lfm.LatentForceModel(
        motif(identity if linear else softplus, genes=1, order=order).dynamics,
        {"u": lfm.Matern(1.0, 1.3, order)}, lfm.GaussianObservation(first_state, noise * jnp.ones(1)),
        lfm.Gaussian(jnp.array([0.4]), variance * jnp.eye(1)))


def second_order(order, linear, variance, noise):
    return lfm.LatentForceModel(
        Oscillator(1.0, 0.3, 0.0 if linear else 0.5), {"u": lfm.Matern(1.0, 1.3, order)},
        lfm.GaussianObservation(first_state, noise * jnp.ones(1)),
        lfm.Gaussian(jnp.array([0.4, 0.0]), variance * jnp.eye(2)),
        nonlinear_inputs=None if linear else ("x0",))


@eqx.filter_jit
def passes(model, variance, noise):
    """All covariances that occur: predicted, filtered, smoothed."""
    model = eqx.tree_at(lambda m: (m.initial_state.covariance, m.observation.covariance), model,
                        (variance * jnp.eye(len(model.state_names)), noise * jnp.ones(1)))
    ssm = state_space(model)
    grid = build_time_grid(ssm, TIMES, 1)
    problem = filter_problem(ssm, lfm.Cubature(), grid)
    trace = forward(problem, GaussianUpdate(jnp.asarray(Y)), record=Record.SMOOTHER)
    smoothed = backward(problem, trace)
    kernel = jax.vmap(smoothing_kernel)(at_interval_starts(trace.filtered, trace.initial), trace.predicted, trace.phi,
                                        trace.process_cov)
    return (trace.predicted.covariance, trace.filtered.covariance, trace.process_cov, smoothed.moments.covariance,
            kernel.conditional), trace.log_likelihood, smoothed.leave_one_out


@pytest.mark.parametrize("build, order, linear", [
    (second_order, 1, False), *(pytest.param(*case, marks=pytest.mark.slow) for case in (
        (second_order, 1, True), (first_order, 2, False)))])
def test_smallest_eigenvalue(build, order, linear):
    model = build(order, linear, 0.0, 1.0)
    for variance in (0.0, 1e-12, 1.0):
        for noise in (1e-20, 1e-10, 1.0):
            covariances, log_likelihood, left_out = passes(model, jnp.asarray(variance), jnp.asarray(noise))
            assert np.isfinite(log_likelihood).all() and np.isfinite(left_out).all()
            for label, covariance in zip(("predicted", "filtered", "noise", "smoothed", "conditional"), covariances,
                                         strict=True):
                assert np.isfinite(covariance).all()
                eigenvalues = np.linalg.eigvalsh(covariance)
                assert (eigenvalues[:, 0] >= -1e-13 * eigenvalues[:, -1]).all(), (label, variance, noise)
                assert np.abs(covariance - np.swapaxes(covariance, 1, 2)).max() <= 1e-15 * np.abs(covariance).max()


@pytest.mark.slow
@pytest.mark.parametrize(("link", "steps"), [(identity, 1), (softplus, 7)])
def test_the_force_keeps_its_stationary_distribution(link, steps):
    """Nothing is learnt from the observation of an output that the force does not reach."""
    model = motif(link, order=2)
    model = eqx.tree_at(lambda m: m.dynamics.sensitivity, model, jnp.zeros(2))
    result = lfm.smooth(model, [0.3, 1.0, 50.0], np.ones((3, 2)), steps=steps, at=[0.1, 0.9, 50.0, 2000.0])
    stationary = np.asarray(lfm.Matern(1.0, 1.3, 2).initial_covariance())
    assert np.abs(result.covariance[:, 2:, 2:] - stationary).max() < 1e-10
    assert np.abs(result.mean[:, 2:]).max() < 1e-10


@pytest.mark.slow
def test_stationary_in_prediction():
    """Predicted moments before the first observation: exact for the force's block, also when it drives x."""
    model = motif(softplus, order=1)
    for length in (1e-9, 0.3, 10.0, 1300.0):
        result = lfm.filter(model, [length], [[0.3, 0.2]], steps=1)
        stationary = np.asarray(lfm.Matern(1.0, 1.3, 1).initial_covariance())
        assert np.abs(result.predicted_covariance[0, 2:, 2:] - stationary).max() < 1e-10


def test_a_gap_of_a_thousand_lengthscales():
    """The right value where the model is linear, a finite one where it is not."""
    times, y = np.array([0.5, 1.0, 1301.0, 1301.5]), np.array([[0.4], [0.7], [-0.2], [0.3]])
    model = lfm.LatentForceModel(
        Linear(-0.8 * jnp.eye(1), jnp.ones((1, 1))), {"u": lfm.Matern(1.0, 1.3, 1)},
        lfm.GaussianObservation(Outputs(jnp.eye(1, 2)), jnp.array([0.01])),
        lfm.Gaussian(jnp.ones(1), jnp.zeros((1, 1))), initial_time=0.0)
    # 40 e-folds before the second pair everything is forgotten: the two pairs are independent.
    def dense(start, mean, part):
        process = LinearLFM(-0.8 * np.eye(1), np.ones((1, 1)), [matern(1.0, 1.3, 1)], start, mean, np.zeros((1, 1)))
        return Regression(process, np.eye(1, 2), np.array([0.01])).log_likelihood(times[part], y[part])

    expected = dense(0.0, np.ones(1), slice(0, 2)) + dense(1251.0, np.zeros(1), slice(2, 4))
    result = lfm.filter(model, times, y).log_likelihood.sum()
    assert abs(result - expected) < 1e-8 * abs(expected)
    assert np.isfinite(lfm.filter(motif(genes=1, order=0), times, y, steps=1).log_likelihood).all()


@pytest.mark.slow
def test_known_initial_state():
    """A known state moves on as if its variance were tiny."""
    nearby = lfm.filter(motif(variance=1e-16), [0.0, 0.0, 0.4], np.array([[0.4, 0.25]] * 3))
    for variance in (0.0, 1e-300, 1e-30):
        result = lfm.filter(motif(variance=variance), [0.0, 0.0, 0.4], np.array([[0.4, 0.25]] * 3))
        for a, b in zip(jax.tree_util.tree_leaves(result), jax.tree_util.tree_leaves(nearby), strict=True):
            assert np.isfinite(a).all()
            assert np.allclose(a, b, rtol=1e-8, atol=1e-12)
