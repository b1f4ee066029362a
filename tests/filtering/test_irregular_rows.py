"""Rows with lengths of their own: exact transitions that are stored by interval instead of tabulated by length."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl.filtering import intervals, time_grid
from lfm_ppl.filtering.grid_layout import _padded_lengths, padded_size

TIMES = np.sort(np.random.default_rng(3).uniform(0.0, 9.0, 21))
Y = np.sin(TIMES)[:, None]


def log_prob(parameters, times=TIMES):
    rate, damping, lengthscale = parameters
    model = lfm.LatentForceModel(
        lambda x, u, t: jnp.stack([x[1], -rate * x[0] - damping * x[1] + u[0]]), {"f": lfm.Matern(1.0, lengthscale)},
        lfm.GaussianObservation(lambda x, u, t: x[:1], jnp.array([0.01])), lfm.Gaussian(jnp.zeros(2), jnp.eye(2)),
        initial_time=0.0)
    return lfm.MarginalLikelihood(model, times).log_prob(Y)


@pytest.mark.thorough
@pytest.mark.parametrize("block", [8, 128])
def test_stored_transitions_equal_tabulated_ones(monkeypatch, block):
    theta = jnp.array([1.3, 0.4, 0.8])
    tabulated = jax.value_and_grad(log_prob)(theta)
    monkeypatch.setattr(time_grid, "_LARGEST_TABLE", 0)
    monkeypatch.setattr(intervals, "_BLOCK", block)
    value, gradient = jax.value_and_grad(log_prob)(theta)
    np.testing.assert_allclose(value, tabulated[0], rtol=1e-12)
    np.testing.assert_allclose(gradient, tabulated[1], rtol=1e-10)
    np.testing.assert_allclose(jax.jacfwd(log_prob)(theta), gradient, rtol=1e-10)
    differences = [(log_prob(theta + d) - log_prob(theta - d)) / (2 * d.sum()) for d in 1e-5 * jnp.eye(3)]
    np.testing.assert_allclose(gradient, differences, rtol=1e-6)


@pytest.mark.thorough
def test_derivatives_with_respect_to_times():
    gradient = jax.grad(log_prob, argnums=1)(jnp.array([1.3, 0.4, 0.8]), jnp.asarray(TIMES))
    change = 1e-5 * np.eye(21)[7]
    difference = (log_prob((1.3, 0.4, 0.8), TIMES + change) - log_prob((1.3, 0.4, 0.8), TIMES - change)) / 2e-5
    np.testing.assert_allclose(gradient[7], difference, rtol=1e-6)


@pytest.mark.parametrize("lengths", [(17, 24), (26, 31), (42, 47)])
def test_tables_of_similar_numbers_of_lengths_have_one_size(lengths):
    """Of a few hundred intervals, as default trajectories have them, where a table was not padded."""
    sizes = {_padded_lengths(count, 256) for count in lengths}
    assert sizes == {padded_size(lengths[1])}
    assert _padded_lengths(300, 256) == 256
