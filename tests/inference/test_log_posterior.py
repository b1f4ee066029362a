"""The posterior of positive parameters in their logarithms: its densities, its objective, its order."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import systems
from scipy import stats

import lfm_ppl as lfm
from lfm_ppl.inference.bind import bind_arguments
from lfm_ppl.inference.log_posterior import LogPosterior

TIMES = np.array([0.0, 0.7, 1.1, 2.0])
SETS = [(jnp.array([[0.4], [0.8], [jnp.nan], [0.7]]) * factor, {"shift": jnp.asarray(factor)}) for factor in (1.0, 2.0)]


def model(data):
    """Data that are a pytree: measurements, and a number that is known of each data set."""
    y, known = data
    decay = numpyro.sample("decay", dist.LogNormal(0.0, 0.3))
    amount = numpyro.sample("amount", dist.LogNormal(known["shift"], 0.5))
    system = systems.motif(decay=decay, lengthscale=amount, noise_sd=0.3 * jnp.ones(1), genes=1)
    numpyro.sample("y", lfm.MarginalLikelihood(system, TIMES, steps=2, iterations=0), obs=y)


@pytest.fixture(scope="module")
def bound():
    return bind_arguments(model, (SETS[0],), {})


@pytest.mark.parametrize("names", [("decay", "amount"), ("amount", "decay")])
@pytest.mark.parametrize("data", SETS)
def test_the_densities_are_those_of_the_model_in_the_order_asked_for(bound, names, data):
    posterior = LogPosterior(bound, names)
    values = {"decay": 0.8, "amount": 1.7}
    z = np.log([values[name] for name in names])
    log_likelihood, log_prior = posterior.log_densities(z, data)
    system = systems.motif(decay=0.8, lengthscale=1.7, noise_sd=0.3 * jnp.ones(1), genes=1)
    expected = float(lfm.filter(system, TIMES, data[0], steps=2).log_likelihood.sum())
    assert float(log_likelihood) == pytest.approx(expected, rel=1e-10)
    prior = stats.norm(0.0, 0.3).logpdf(np.log(0.8)) + stats.norm(data[1]["shift"], 0.5).logpdf(np.log(1.7))
    assert float(log_prior) == pytest.approx(prior, rel=1e-10)
    result = posterior.likelihood(z, data).model
    np.testing.assert_allclose(result.observation.covariance, system.observation.covariance)
    np.testing.assert_allclose(result.initial_state.mean, system.initial_state.mean)
    # The medians of 15 draws are within 4 standard errors, 1.25 sd / sqrt(15), of those of the prior.
    away = {"decay": 0.0, "amount": 1.0}, {"decay": 0.3, "amount": 0.5}
    medians, sds = (np.array([of[name] for name in names]) for of in away)
    assert (np.abs(posterior.central - medians) < 4 * 1.25 * sds / np.sqrt(15)).all()
    several = posterior.log_densities_of(np.stack([z, z + 0.1, z - 0.1]), data, batch=2)
    np.testing.assert_allclose([part[0] for part in several], [expected, prior], rtol=1e-10)


@pytest.mark.parametrize("forward_mode", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_weight_of_the_prior_and_the_data_are_arguments_of_one_program(bound, forward_mode):
    posterior, runs = LogPosterior(bound, ("decay", "amount"), forward_mode), []
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
    run = bound.compiled(("energy", ("decay", "amount"), forward_mode), lambda: None)
    assert run._cache_size() == 1


def test_the_filter_and_the_likelihood_take_what_the_site_observes(bound):
    """The data are a pair; the site observes its first."""
    z = np.array([0.1, -0.2])
    other = bound.with_data(SETS[1])
    total = float(bound.log_likelihood(z, SETS[1]))
    assert float(bound.filter(z, SETS[1]).log_likelihood.sum()) == pytest.approx(total, rel=1e-10)
    assert float(other.log_likelihood(z)) == pytest.approx(total, rel=1e-12)
    assert bound.smooth(z).mean.shape[0] == len(TIMES)
    with pytest.raises(ValueError, match=r"must have the shape that was bound, \(\(4, 1\), \{'shift': \(\)\}\)"):
        bound.with_data((SETS[0][0][:2], SETS[0][1]))


def level(y):
    numpyro.factor("y", -jnp.sum(numpyro.sample("level", dist.Normal(0.0, 1.0)) - y) ** 2)


def share(y):
    numpyro.factor("y", -jnp.sum(numpyro.sample("share", dist.Beta(2.0, 2.0)) - y) ** 2)


@pytest.mark.parametrize(("model", "names", "message"), [
    (level, ("level",), "the logarithm of level is not its unconstrained value"),
    (share, ("share",), "the logarithm of share is not its unconstrained value"),
    (level, ("height",), "names must be the model's parameters, in any order: level; got height"),
])
def test_other_parameters_are_refused(model, names, message):
    with pytest.raises(ValueError, match=message):
        LogPosterior(bind_arguments(model, (np.ones(2),), {}), names)


def test_a_tuple_of_numbers_is_a_setting_not_data():
    def sized(shape):
        numpyro.sample("x", dist.Normal(jnp.zeros(shape), 1.0).to_event(len(shape)))

    assert bind_arguments(sized, ((2, 3),), {}).size == 6
    assert jax.tree_util.tree_leaves(bind_arguments(sized, ((2, 3),), {}).y) == []
