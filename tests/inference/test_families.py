"""Observation families in a Bayesian workflow: calibration of NUTS with EP, and draws of the prior."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.infer import NUTS

import lfm_ppl as lfm
from lfm_ppl.results import calibration

TIMES = np.linspace(0.0, 10.0, 20)


def force(x, u, t):
    return u


def observed(observation, scale, lengthscale, times, y):
    model = lfm.LatentForceModel(lambda x, u, t: jnp.zeros(0), {"u": lfm.Matern(scale, lengthscale)}, observation,
                                 lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))
    numpyro.sample("y", lfm.MarginalLikelihood(model, times), obs=y)


def process():
    return (numpyro.sample("scale", dist.LogNormal(-0.2, 0.4)), numpyro.sample("lengthscale", dist.LogNormal(0.7, 0.4)))


def poisson(times, y=None):
    level = numpyro.sample("level", dist.Normal(0.7, 0.7))
    observed(lfm.PoissonObservation(lambda x, u, t: level + u), *process(), times, y)


def student_t(times, y=None):
    noise = numpyro.sample("noise", dist.LogNormal(-1.2, 0.4))
    observed(lfm.StudentTObservation(force, 4.0, noise), *process(), times, y)


def bernoulli(times, y=None):
    level = numpyro.sample("level", dist.Normal(0.0, 1.0))
    observed(lfm.BernoulliObservation(lambda x, u, t: level + 2.0 * u), *process(), times, y)


def negative_binomial(times, y=None):
    concentration = numpyro.sample("concentration", dist.LogNormal(1.0, 0.7))
    observed(lfm.NegativeBinomialObservation(lambda x, u, t: 1.0 + u, concentration), *process(), times, y)


MODELS = {"Poisson": poisson, "Student-t": student_t, "Bernoulli": bernoulli, "negative binomial": negative_binomial}
# Of the unconstrained parameters, by name: mean and sd of their normal priors.
PRIORS = {"level": (0.0, 1.0), "noise": (-1.2, 0.4), "concentration": (1.0, 0.7), "scale": (-0.2, 0.4),
          "lengthscale": (0.7, 0.4)}


def assert_uniform(found, bins):
    values = {name: calibration.p_values(rank, found.draws, bins) for name, rank in found.ranks.items()}
    print(values)
    assert min(min(pair.values()) for pair in values.values()) > 0.001, values


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Poisson", "Student-t"])
def test_nuts_with_expectation_propagation_is_calibrated(name):
    found = calibration.calibrate(jax.random.key(3), MODELS[name], TIMES, lambda m: NUTS(m, max_tree_depth=6),
                                  data_sets=200, thin=3, warmup=200, batch=25)
    assert_uniform(found, bins=16)


@pytest.mark.slow
def test_random_walks_with_expectation_propagation_are_calibrated():
    """The same, small: 24 data sets of 6 rows, and random walks, whose program is a fraction of that of NUTS."""
    found = calibration.calibrate(jax.random.key(4), poisson, np.arange(6.0), lfm.RAM, data_sets=24, draws=15, thin=20,
                                  warmup=200)
    assert_uniform(found, bins=4)


def prior_draws(name, count, seed=0, outliers=0.05):
    """Values and gradients at draws of the prior, of data from the middle of it with some gross errors."""
    model = MODELS[name]
    drawn = numpyro.handlers.trace(numpyro.handlers.seed(model, seed)).get_trace(TIMES)["y"]["value"]
    y = np.array(drawn)
    rng = np.random.default_rng(seed)
    if name == "Student-t":
        y = y + 5.0 * (rng.uniform(size=y.shape) < outliers)
    bound = lfm.bind(model, TIMES, y)
    mean, sd = np.array([PRIORS[one] for one in bound.names]).T
    z = mean + sd * rng.normal(size=(count, len(mean)))
    run = jax.jit(lambda z: jax.lax.map(jax.value_and_grad(bound.log_density), z, batch_size=50))
    return map(np.asarray, run(z))


@pytest.mark.parametrize("name, count", [("Student-t", 50), *(pytest.param(name, 10_000, marks=pytest.mark.slow)
                                                              for name in MODELS)])
def test_draws_of_the_prior_have_a_density_and_a_gradient(name, count):
    """A model may be far from the data: no NaN, and fewer than one in a hundred without converged sites."""
    value, gradient = prior_draws(name, count)
    print(name, count, "share of -inf", np.isneginf(value).mean())
    assert not np.isnan(value).any() and np.isfinite(gradient).all()
    assert np.isneginf(value).mean() < 0.01
