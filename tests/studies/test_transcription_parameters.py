"""Transcription study with unknown rates: model, short chains, table and figure."""

import jax.numpy as jnp
import numpy as np
import numpyro
import pytest

from lfm_ppl.likelihoods.marginal_likelihood import MarginalLikelihood
from lfm_ppl.parallel.task import Task
from lfm_ppl.studies.transcription import parameters, problem

SOFTPLUS = parameters.LINKS["softplus"]


def sites(data):
    """True values of all sites of a data set."""
    rates = data.rates
    return {"basal": rates.basal, "decay": rates.decay, "sensitivity": rates.sensitivity,
            "away": rates.start - rates.basal / rates.decay, "noise_sd": problem.NOISE,
            "lengthscale": problem.LENGTHSCALE}


@pytest.mark.slow
def test_the_likelihood_at_the_truth_is_that_of_the_known_system():
    data = problem.data_set(SOFTPLUS, 4)
    with numpyro.handlers.substitute(data=sites(data)), numpyro.handlers.trace() as trace:
        parameters.model(problem.TIMES, data.y)
    system = problem.system("softplus", 1.0, data.rates)
    expected = MarginalLikelihood(system, problem.TIMES, rule=parameters.RULE, steps=parameters.STEPS,
                                  iterations=0).log_prob(data.y)
    assert np.isclose(trace["y"]["fn"].log_prob(data.y), expected, rtol=1e-10)
    assert all(np.isfinite(trace[name]["fn"].log_prob(jnp.asarray(value))) for name, value in sites(data).items())


def settings_of(label, chains, warmup, draws, thin):
    """Settings of one task."""
    return {"sampler": label, "link": "softplus", "gamma": None, "index": 0, "chains": chains, "warmup": warmup,
            "draws": draws, "thin": thin, "tree_depth": 10}


@pytest.mark.slow
def test_on_a_linear_link_marginal_and_latent_posteriors_are_the_same():
    """There the filter is exact, so that nothing but Monte Carlo error and the grid stands between them."""
    linear = {"link": "linear"}
    marginal = parameters.compute(Task("marginal", 0, settings_of("RAM, marginal", 4, 500, 1000, 50) | linear))
    latent = parameters.compute(Task("latent", 0, settings_of("NUTS, latent grid", 2, 400, 600, 1) | linear))
    error = np.sqrt(1 / marginal["ess"] + 1 / latent["ess"])
    assert max(marginal["r_hat"].max(), latent["r_hat"].max()) < 1.05
    assert np.all(np.abs(marginal["mean"] - latent["mean"]) / latent["sd"] < 4.5 * error)
    assert np.all(np.abs(np.log(marginal["sd"] / latent["sd"])) < 4.5 * error)
    assert np.abs(marginal["force_mean"] - latent["force_mean"]).max() < 0.3
