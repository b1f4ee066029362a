"""Parameters whose posterior lies outside of the prior."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm
from lfm_ppl.accuracy.prior_conflict import prior_conflicts


def model(times, y=None):
    volume = numpyro.sample("volume", dist.LogNormal(3.5, 0.6))
    slope = numpyro.sample("slope", dist.Normal(volume, 1.0))
    with numpyro.plate("subject", 2):
        numpyro.sample("effect", dist.Normal(0.0, 1.0))
    rates = numpyro.sample("rates", dist.Gamma(2.0, jnp.ones(2)).to_event(1))
    system = lfm.LatentForceModel(
        lambda x, u, t: -rates[:1] * x + slope, {},
        lfm.GaussianObservation(lambda x, u, t: x / volume, jnp.ones(1)),
        lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)


def test_a_posterior_outside_of_its_prior_is_named():
    bound = lfm.bind(model, np.arange(3.0), np.ones((3, 1)))
    draws = {"volume": np.full(9, 0.5), "slope": np.full(9, 1.0), "effect": np.full((9, 2), 7.0),
             "rates": np.tile([1.0, 50.0], (9, 1))}

    def conflicts(draws):
        medians = {name: np.median(values, axis=0) for name, values in draws.items()}
        return prior_conflicts(bound.trace_at(medians), medians)

    (message,) = conflicts(draws)
    assert "volume (median 0.5, prior 7.06 to 155)" in message and "rates[1] (median 50" in message
    # The slope agrees with its prior given the volume, and among the effects in a plate some lie far out.
    assert "slope" not in message and "effect" not in message and "rates[0]" not in message
    assert conflicts({**draws, "volume": np.full(9, 30.0), "slope": np.full(9, 31.0), "rates": np.ones((9, 2))}) == []
