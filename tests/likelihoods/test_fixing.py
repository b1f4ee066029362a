"""Fixing parameters: the remaining ones keep the distribution that conditioning gives them."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.infer import Predictive
from numpyro.infer.util import potential_energy

from lfm_ppl.likelihoods.handlers.fixing import fix, pin
from lfm_ppl.likelihoods.priors import prior

COVARIANCE = np.array([[1.0, 0.8, 0.3], [0.8, 1.0, 0.5], [0.3, 0.5, 1.0]])
LABELS = ("a", "b", "c")


def model():
    numpyro.sample("x", dist.MultivariateNormal(jnp.zeros(3), jnp.array(COVARIANCE)))
    numpyro.sample("decay", dist.LogNormal(0.0, 1.0).expand([3]).to_event(1))
    with numpyro.plate("genes", 4):
        numpyro.sample("u", dist.Uniform(jnp.arange(4.0), 5.0))
    numpyro.sample("noise_sd", dist.HalfNormal(1.0))
    numpyro.sample("weights", dist.Dirichlet(jnp.ones(3)))


FIXED = {"x[b]": 1.0, "decay[2]": 0.8, "u[1]": 2.0, "u[3]": 4.0, "noise_sd": 0.5}


def test_unconstrained_density_is_that_of_the_free_elements():
    fixed = fix(model, FIXED, LABELS)
    free = {"x": jnp.array([0.3, -0.2]), "decay": jnp.array([0.1, 0.7]), "u": jnp.array([0.2, -1])}
    weights = jnp.array([0.3, -0.4])
    energy = potential_energy(fixed, (), {}, {**free, "weights": weights})
    # the same by hand: densities of the vectors, plus log derivatives of exp and of the sigmoids
    x = np.array([0.3, 1.0, -0.2])
    decay = np.array([np.exp(0.1), np.exp(0.7), 0.8])
    log_prob = dist.MultivariateNormal(0.0, COVARIANCE).log_prob(x)
    log_prob += dist.LogNormal(0.0, 1.0).log_prob(decay).sum() + 0.1 + 0.7
    log_prob += -np.log(5.0 - np.arange(4.0)).sum()
    for z, lower in ((0.2, 0.0), (-1.0, 2.0)):
        s = 1 / (1 + np.exp(-z))
        log_prob += np.log((5.0 - lower) * s * (1 - s))
    log_prob += dist.HalfNormal(1.0).log_prob(0.5)
    simplex = dist.biject_to(dist.constraints.simplex)
    w = simplex(weights)
    log_prob += dist.Dirichlet(jnp.ones(3)).log_prob(w) + simplex.log_abs_det_jacobian(weights, w)
    np.testing.assert_allclose(-energy, log_prob, rtol=1e-12)


def test_draws_of_the_prior_hold_the_values():
    draws = Predictive(fix(model, FIXED, LABELS), num_samples=5)(jax.random.key(0))
    assert np.all(draws["decay"][:, 2] == 0.8) and np.all(draws["u"][:, 1] == 2.0)
    assert np.ptp(draws["decay"][:, 0]) > 0
    assert np.all(draws["noise_sd"] == 0.5)
    values = Predictive(fix(model, {"decay": 0.8, "u": [1, 2, 3, 4]}), num_samples=1)(jax.random.key(0))
    np.testing.assert_array_equal(values["decay"], [[0.8, 0.8, 0.8]])
    np.testing.assert_array_equal(values["u"], [[1, 2, 3, 4]])


@pytest.mark.parametrize(("fixed", "name"), [
    ({"dacay": 1.0}, "'dacay'"), ({"dacay[a]": 1.0}, "'dacay'"), ({"decay[d]": 1.0}, "'d'"),
    ({"decay[3]": 1.0}, "'3'"), ({"u[a]": 1.0}, "'a'"), ({"decay[a]": -1.0}, "decay"), ({"noise_sd": -1.0}, "noise_sd"),
    ({"noise_sd[0]": 1.0}, "noise_sd"), ({"decay": [1.0, 2.0]}, "decay"), ({"decay": 1.0, "decay[a]": 1.0}, "decay"),
    ({"weights[a]": 0.5}, "weights"),
])
def test_what_cannot_be_fixed(fixed, name):
    with pytest.raises(ValueError, match=name):
        numpyro.handlers.seed(fix(model, fixed, LABELS), 0)()


def test_the_prior_of_fixed_elements_in_words():
    """The free elements' prior and the values of the others; arguments by element are those for free elements."""
    trace = numpyro.handlers.trace(numpyro.handlers.seed(fix(model, FIXED, LABELS), 0)).get_trace()
    assert prior(trace["decay"]["fn"]) == "LogNormal(0, 1); fixed: c = 0.8"
    assert prior(trace["u"]["fn"]) == "Uniform([0, 2], 5); fixed: 1 = 2, 3 = 4"
    all_fixed = pin("decay", dist.HalfNormal(jnp.ones(2)), {"0": 0.5, "1": 2.0})
    assert prior(all_fixed) == "fixed: 0 = 0.5, 1 = 2"
