"""The posterior of positive parameters in their logarithms: its densities, its objective, its order."""

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import systems
from scipy import stats

import lfm_ppl as lfm
from lfm_ppl.inference.bind import bind_arguments
from lfm_ppl.studies.log_posterior import LogPosterior

TIMES = np.array([0.0, 0.7, 1.1, 2.0])
SETS = [(jnp.array([[0.4], [0.8], [jnp.nan], [0.7]]) * factor, {"shift": jnp.asarray(factor)}) for factor in (1.0, 2.0)]


def model(data):
    """Data that are a pytree: measurements, and a number that is known of each data set."""
    y, constants = data
    decay = numpyro.sample("decay", dist.LogNormal(0.0, 0.3))
    amount = numpyro.sample("amount", dist.LogNormal(constants["shift"], 0.5))
    system = systems.motif(systems.identity, decay, lengthscale=amount, noise_sd=0.3 * jnp.ones(1), genes=1)
    numpyro.sample("y", lfm.MarginalLikelihood(system, TIMES, steps=2, iterations=0), obs=y)


@pytest.fixture(scope="module")
def bound():
    return bind_arguments(model, (SETS[0],), {})


@pytest.mark.thorough
def test_the_densities_are_those_of_the_model_in_the_order_of_the_names(bound):
    names, values = ("decay", "amount"), {"decay": 0.8, "amount": 1.7}
    posterior = LogPosterior(bound, names)
    z = np.log([values[name] for name in names])
    system = systems.motif(systems.identity, 0.8, lengthscale=1.7, noise_sd=0.3 * jnp.ones(1), genes=1)
    expected = []
    for data in SETS:
        likelihood = float(lfm.filter(system, TIMES, data[0], steps=2).log_likelihood.sum())
        prior = stats.norm(0.0, 0.3).logpdf(np.log(0.8)) + stats.norm(data[1]["shift"], 0.5).logpdf(np.log(1.7))
        expected.append([likelihood, prior])
        np.testing.assert_allclose(posterior.log_densities(z, data), expected[-1], rtol=1e-10)
    turned = LogPosterior(bound, names[::-1])
    np.testing.assert_allclose(turned.log_densities(z[::-1], SETS[1]), expected[1], rtol=1e-10)
    several = posterior.log_densities_of(np.stack([z, z + 0.1, z - 0.1]), SETS[1], batch=2)
    np.testing.assert_allclose([part[0] for part in several], expected[1], rtol=1e-10)
    result = posterior.likelihood(z, SETS[1]).model
    np.testing.assert_allclose(result.observation.covariance, system.observation.covariance)
    # The medians of 15 draws are within 4 standard errors, 1.25 sd / sqrt(15), of the medians of the prior.
    for order in (posterior, turned):
        difference = np.abs(order.central - np.array([{"decay": 0.0, "amount": 1.0}[name] for name in order.names]))
        assert (difference < 4 * 1.25 * 0.5 / np.sqrt(15)).all()


def test_the_weight_of_the_prior_and_the_data_are_arguments_of_one_program(bound):
    posterior, runs = LogPosterior(bound, ("decay", "amount"), True), []
    z, step = np.array([-0.2, 0.4]), 1e-5 * np.eye(2)
    for data in SETS:
        for prior in (1.0, 0.0):
            objective = posterior.objective(data, prior)
            value, gradient = objective.value_and_gradient(z)
            log_likelihood, log_prior = posterior.log_densities(z, data)
            assert value == pytest.approx(-float(log_likelihood) - prior * float(log_prior), rel=1e-12)
            differences = [(objective.value(z + h) - objective.value(z - h)) / 2e-5 for h in step]
            np.testing.assert_allclose(gradient, differences, rtol=1e-6, atol=1e-8)
            runs.append(value)
    assert len(set(runs)) == 4
    run = bound.program(("energy", ("decay", "amount"), True), lambda: None)
    assert len(run._own) == 1


def test_the_filter_and_the_likelihood_take_what_the_site_observes(bound):
    """The data are a pair; the site observes its first."""
    z = np.array([0.1, -0.2])
    other_bound = bound.with_data(SETS[1])
    total = float(bound.log_likelihood(z, SETS[1]))
    assert float(bound.filter(z, SETS[1]).log_likelihood.sum()) == pytest.approx(total, rel=1e-10)
    assert float(other_bound.log_likelihood(z)) == pytest.approx(total, rel=1e-12)
    assert bound.smooth(z).mean.shape[0] == len(TIMES)


def level(y):
    numpyro.factor("y", -jnp.sum(numpyro.sample("level", dist.Normal(0.0, 1.0)) - y) ** 2)


def share(y):
    numpyro.factor("y", -jnp.sum(numpyro.sample("share", dist.Beta(2.0, 2.0)) - y) ** 2)


@pytest.mark.parametrize(("model", "names", "name"), [
    (level, ("level",), "level"), (share, ("share",), "share"), (level, ("height",), "height"),
])
def test_other_parameters_are_refused(model, names, name):
    with pytest.raises(ValueError, match=name):
        LogPosterior(bind_arguments(model, (np.ones(2),), {}), names)
