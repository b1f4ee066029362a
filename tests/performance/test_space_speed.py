"""Speed of fields in space and time. Run with ``-m performance`` on an idle machine."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm

pytestmark = pytest.mark.performance


def test_fifty_sensors_and_a_thousand_times(benchmark):
    """Log likelihood of the heat equation with 16 modes and its gradient, in less than a second."""
    basis, times = lfm.LaplaceBasis((0.0, 1.0), 16), np.linspace(0.0, 10.0, 1000)
    sensors, y = np.linspace(0.01, 0.99, 50), np.random.default_rng(0).normal(size=(1000, 50))

    def log_density(theta):
        diffusivity, decay, scale, space, time, noise = theta
        source = lfm.SpectralField(basis, lfm.Matern(scale, space), lfm.Matern(1.0, time, order=0))
        model = lfm.heat(source, diffusivity, decay, sensors=sensors, covariance=noise)
        return lfm.MarginalLikelihood(model, times).log_prob(y)

    theta, run = jnp.array([0.02, 0.1, 1.0, 0.3, 1.0, 0.1]), jax.jit(jax.value_and_grad(log_density))
    jax.block_until_ready(run(theta))
    benchmark.pedantic(lambda: jax.block_until_ready(run(theta)), rounds=5, warmup_rounds=1)
    assert benchmark.stats.stats.min < 1.0
