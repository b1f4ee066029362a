"""Warnings of `fit` on a likelihood whose refinement would move the posterior."""

import json
import warnings

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

import lfm_ppl as lfm
from lfm_ppl.forces.sde import ApproximationWarning
from lfm_ppl.results.result_view import ResultView

# Theophylline, subject 5 of the public data set (Boeckmann, Sheiner and Beal, 1994).
DOSE = 5.86
TIMES = np.array([0.0, 0.3, 0.52, 1.0, 2.02, 3.5, 5.02, 7.02, 9.1, 12.0, 24.35])
CONCENTRATION = np.array([0.0, 2.02, 5.63, 11.4, 9.33, 8.74, 7.56, 7.09, 5.9, 4.37, 1.57])[:, None]


def theophylline(times, y=None, **settings):
    """Absorption by exp of a force, which a single pass of the filter linearises badly."""
    def positive(name, median, sd):
        return numpyro.sample(name, dist.LogNormal(jnp.log(median), sd))

    ka, ke, v = positive("ka", 1.5, 0.7), positive("ke", 0.08, 0.4), positive("v", 0.5, 0.3)
    scale, lengthscale = positive("scale", 0.4, 0.5), positive("lengthscale", 1.5, 0.5)
    proportional, additive = positive("prop", 0.08, 0.4), positive("add", 0.2, 0.5)
    system = lfm.LatentForceModel(
        lambda x, u, t: jnp.stack([jnp.exp(jnp.log(ka * DOSE / v) - ka * t + u[0]) - ke * x[0]]),
        {"absorption": lfm.Matern(scale, lengthscale)},
        lfm.GaussianObservation(lambda x, u, t: x, lambda x, u, t: additive**2 + (proportional * x) ** 2),
        lfm.Gaussian(jnp.zeros(1), 1e-4 * jnp.eye(1)))
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, **settings), obs=y)


def fit(**settings):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = lfm.fit(theophylline, TIMES, CONCENTRATION, model_kwargs=settings, sampler="map", samples=2000,
                         trajectory_draws=0, progress=False)
    messages = [str(warning.message) for warning in caught if issubclass(warning.category, ApproximationWarning)]
    return result, messages


@pytest.mark.slow
def test_the_default_likelihood_of_a_positive_force_is_iterated():
    result, messages = fit()
    attrs = ResultView.of(result).attrs
    assert attrs["likelihood"] == "approximate (three iterations of posterior linearisation)"
    assert attrs["iterations"] == 3
    assert not any("iterations" in message for message in messages)


@pytest.mark.thorough
def test_a_single_pass_is_reported_with_the_cheapest_remedy():
    result, messages = fit(iterations=0)
    attrs = ResultView.of(result).attrs
    assert attrs["likelihood"] == "approximate (a single pass of the filter)"
    (message,) = [message for message in messages if "iterations" in message]
    assert "--iterations 3" in message
    assert message in json.loads(attrs["warnings"])


@pytest.mark.slow
def test_long_steps_are_reported():
    _, messages = fit(steps=1, max_step=1e3)
    assert any("half the integration step" in message and "steps=2" in message for message in messages)


@pytest.mark.slow
def test_the_posterior_of_a_positive_force():
    """v = .571 +- .158 by NUTS on an independent NumPyro model with the force on a grid of times."""
    posterior = lfm.fit(theophylline, TIMES, CONCENTRATION, chains=2, samples=500, trajectory_draws=0,
                        progress=False)["posterior"]
    assert abs(float(posterior["v"].mean()) - 0.571) < 0.05
    assert abs(float(posterior["v"].std()) - 0.158) < 0.05
