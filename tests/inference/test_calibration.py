import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.infer import NUTS

import lfm_ppl as lfm
from lfm_ppl.accuracy import calibration

TIMES = np.linspace(0.0, 6.0, 10)


def motif(times, y=None, link=lambda u: u, steps=10):
    """One gene, one force: dx/dt = sensitivity link(u) - decay x, from a known start."""
    decay = numpyro.sample("decay", dist.LogNormal(-0.3, 0.4))
    sensitivity = numpyro.sample("sensitivity", dist.LogNormal(0.0, 0.4))
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(0.5, 0.3))
    noise_sd = numpyro.sample("noise_sd", dist.LogNormal(-1.2, 0.3))
    system = lfm.LatentForceModel(
        lambda x, u, t: sensitivity * link(u) - decay * x,
        {"u": lfm.Matern(1.0, lengthscale, order=1)},
        lfm.GaussianObservation(lambda x, u, t: x, noise_sd**2 * jnp.ones(1)),
        lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))),
    )
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=steps), obs=y)


def softplus(times, y=None):
    motif(times, y, jax.nn.softplus, steps=4)


def assert_uniform(name, result, bins):
    """No statistic of any scalar is rarer than one in a thousand under uniform ranks."""
    if folder := os.environ.get("LFM_SBC_OUT"):
        calibration.save(result, Path(folder) / name, overwrite=True)
    values = {scalar: calibration.p_values(rank, result.draws, bins) for scalar, rank in result.ranks.items()}
    print(name, values)
    assert min(min(pair.values()) for pair in values.values()) > 0.001, values


@pytest.mark.slow
@pytest.mark.parametrize(("sampler", "model"), [("nuts", motif), ("ram", softplus)], ids=["nuts", "ram"])
def test_samplers_are_calibrated(sampler, model):
    settings = {
        "nuts": {"kernel": lambda m: NUTS(m, forward_mode_differentiation=True), "thin": 3, "warmup": 150, "batch": 20},
        "ram": {"kernel": lfm.RAM, "thin": 60, "warmup": 2000},
    }[sampler]
    result = calibration.calibrate(jax.random.key(12), model, TIMES, data_sets=80, draws=31, **settings)
    assert_uniform(f"{sampler}_{model.__name__}", result, bins=8)
