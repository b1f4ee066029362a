"""What is simulated under constraints, NUTS over parameters under them, and bands of the force, over many records."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.infer import NUTS
from references import LinearLFM, matern
from systems import Linear, whole_state

import lfm_ppl as lfm
from lfm_ppl.accuracy import calibration

TIMES = np.linspace(0.0, 4.0, 6)
COUPLING = np.array([[0.5], [0.25]])
NOISE_SD = 0.1


def genes(decay, lengthscale):
    """Two genes that one factor moves."""
    return lfm.LatentForceModel(
        Linear(-decay * jnp.eye(2), jnp.asarray(COUPLING)), {"factor": lfm.Matern(1.0, lengthscale)},
        lfm.GaussianObservation(whole_state, jnp.full(2, NOISE_SD**2)), lfm.Gaussian(jnp.zeros(2), 0.01 * jnp.eye(2)),
        initial_time=0.0)


def bounded(decay, lengthscale):
    """The factor cannot be negative."""
    return lfm.ConstrainedLikelihood(genes(decay, lengthscale), TIMES, lower={"factor": 0.0}, grid=TIMES, draws=32)


def transcription(times, y=None):
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(0.0, 0.4))
    decay = numpyro.sample("decay", dist.LogNormal(-0.5, 0.4))
    numpyro.sample("y", bounded(decay, lengthscale), obs=y)


def accepted(decay, lengthscale, count):
    """Draws (N, 6, 3) of (x, factor) from the prior at the times; those with a negative factor are left out."""
    process = LinearLFM(-decay * np.eye(2), COUPLING, [matern(1.0, lengthscale, 1)], 0.0, np.zeros(2), 0.01 * np.eye(2))
    mean, covariance = process.moments(TIMES)
    size = mean.size
    values, vectors = np.linalg.eigh(covariance.transpose(0, 2, 1, 3).reshape(size, size))
    noise = np.random.default_rng(0).normal(size=(count, size))
    draws = (mean.ravel() + noise @ (vectors * np.sqrt(np.maximum(values, 0.0))).T).reshape(count, *mean.shape)
    return draws[(draws[:, :, 2] >= 0.0).all(axis=1)]


@pytest.mark.slow
def test_data_are_simulated_from_the_constrained_prior():
    """Calibration rests on it: the force of the records is the prior's given that it is nowhere negative."""
    count = 4000
    paths, y = jax.jit(jax.vmap(lambda key: (
        bounded(0.6, 1.0).sample_path(key, jnp.full((6, 2), jnp.nan))[0], bounded(0.6, 1.0).sample(key))))(
            jax.random.split(jax.random.key(0), count))
    exact = accepted(0.6, 1.0, 100_000)
    noisy = exact[:, :, :2] + NOISE_SD * np.random.default_rng(1).normal(size=exact[:, :, :2].shape)
    assert len(exact) > 5000 and paths[:, :, 2].min() >= 0.0
    error = 4.0 * np.sqrt(1 / count + 1 / len(exact))
    for ours, reference in ((np.asarray(paths), exact), (np.asarray(y), noisy)):
        ours, reference = ours.reshape(count, -1), reference.reshape(len(exact), -1)
        assert (np.abs(ours.mean(axis=0) - reference.mean(axis=0)) < error * reference.std(axis=0)).all()
        np.testing.assert_allclose(ours.std(axis=0), reference.std(axis=0), rtol=error)
        np.testing.assert_allclose(np.corrcoef(ours.T), np.corrcoef(reference.T), atol=error)


@pytest.mark.slow
def test_nuts_is_calibrated_over_64_data_sets(tmp_path):
    result = calibration.calibrate(jax.random.key(5), transcription, TIMES, NUTS, data_sets=64, draws=15, thin=3,
                                   warmup=100, batch=1, checkpoint=tmp_path)
    assert set(result.ranks) == {"lengthscale", "decay", "log likelihood"}
    values = {name: calibration.p_values(rank, result.draws, bins=8) for name, rank in result.ranks.items()}
    print(values)
    assert min(min(pair.values()) for pair in values.values()) > 0.001, values


@pytest.mark.slow
def test_bands_cover_forces_of_the_constrained_prior():
    """400 records at known parameters: 95% bands at all rows, by the mean over the rows and at the worst of them."""

    @jax.jit
    def covered(key):
        keys = jax.random.split(key)
        path, _ = bounded(0.6, 1.0).sample_path(keys[0], jnp.full((6, 2), jnp.nan))
        y = path[:, :2] + NOISE_SD * jax.random.normal(keys[1], (6, 2))
        low, high = lfm.constrained_posterior(genes(0.6, 1.0), TIMES, y, lower={"factor": 0.0},
                                              grid=TIMES).interval("factor")
        return (path[:, 2] >= low) & (path[:, 2] <= high)

    is_covered = np.asarray(jax.lax.map(covered, jax.random.split(jax.random.key(1), 400)))
    print(is_covered.mean(axis=0))
    error = 3.0 * np.sqrt(0.95 * 0.05 / 400)
    assert abs(is_covered.mean() - 0.95) < error and is_covered.mean(axis=0).min() > 0.95 - error
