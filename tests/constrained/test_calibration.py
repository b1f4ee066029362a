"""NUTS over the parameters of a constrained model, calibrated: ranks of true parameters, and bands of the force."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.infer import NUTS
from scipy.stats import chisquare
from systems import Linear, whole_state

import lfm_ppl as lfm

TIMES = np.linspace(0.0, 4.0, 6)


def transcription(times, y=None):
    """Two genes that a factor moves, which cannot be negative."""
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(0.0, 0.4))
    decay = numpyro.sample("decay", dist.LogNormal(-0.5, 0.4))
    model = lfm.LatentForceModel(
        Linear(-decay * jnp.eye(2), jnp.array([[0.5], [0.25]])), {"factor": lfm.Matern(1.0, lengthscale)},
        lfm.GaussianObservation(whole_state, jnp.full(2, 0.1**2)), lfm.Gaussian(jnp.zeros(2), 0.01 * jnp.eye(2)),
        initial_time=0.0)
    numpyro.sample("y", lfm.MarginalLikelihood(model, times, lower={"factor": 0.0}, grid=TIMES, draws=32), obs=y)


@pytest.mark.slow
def test_nuts_is_calibrated_over_100_data_sets(tmp_path):
    found = lfm.calibrate(jax.random.key(0), transcription, TIMES, NUTS, data_sets=100, draws=15, thin=3, warmup=100,
                          batch=20, folder=tmp_path)
    for name in ("lengthscale", "decay"):
        counts = np.bincount(found.ranks[name] // 4, minlength=4)
        assert counts.sum() == 100 and chisquare(counts).pvalue > 1e-3, name


@pytest.mark.slow
def test_bands_of_a_force_cover_it():
    """100 forces from the prior under the constraint, at known parameters: 95% bands at all rows, means over rows."""
    model = lfm.LatentForceModel(
        Linear(-0.6 * jnp.eye(2), jnp.array([[0.5], [0.25]])), {"factor": lfm.Matern(1.0, 1.0)},
        lfm.GaussianObservation(whole_state, jnp.full(2, 0.1**2)), lfm.Gaussian(jnp.zeros(2), 0.01 * jnp.eye(2)),
        initial_time=0.0)
    nothing = jnp.full((len(TIMES), 2), jnp.nan)
    one = lfm.MarginalLikelihood(model, TIMES, lower={"factor": 0.0}, grid=TIMES)

    @jax.jit
    def covered(key):
        keys = jax.random.split(key, 3)
        path, _ = one.feasible_path(nothing, None, keys[0])
        y = path[:, :2] + 0.1 * jax.random.normal(keys[1], (len(TIMES), 2))
        low, high = lfm.constrained_posterior(model, TIMES, y, lower={"factor": 0.0}, grid=TIMES).interval("factor")
        return (path[:, 2] >= low) & (path[:, 2] <= high)

    inside = np.asarray(jax.lax.map(covered, jax.random.split(jax.random.key(1), 400)))
    assert abs(inside.mean() - 0.95) < 0.02
