"""Fixing parameters: the remaining ones keep the distribution that conditioning gives them."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.infer import MCMC, NUTS, Predictive
from numpyro.infer.util import initialize_model, potential_energy

from lfm_ppl.inference.handlers.fixing import fix, pin
from lfm_ppl.inference.priors import prior

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


@pytest.mark.slow
def test_free_elements_follow_the_conditional_distribution():
    mcmc = MCMC(
        NUTS(fix(model, FIXED, LABELS)),
        num_warmup=300,
        num_samples=2000,
        num_chains=2,
        chain_method="vectorized",
        progress_bar=False,
    )
    mcmc.run(jax.random.key(0))
    draws = mcmc.get_samples()
    assert set(draws) == {"x", "decay", "u", "weights"}
    # 4000 draws; 5 Monte Carlo standard errors of a mean with an ESS of a quarter of them
    error = 5 / np.sqrt(1000)
    gain = COVARIANCE[[0, 2], 1]
    np.testing.assert_allclose(draws["x"].mean(0)[np.array([0, 2])], gain, atol=error)
    rest = COVARIANCE[np.ix_([0, 2], [0, 2])] - np.outer(gain, gain)
    np.testing.assert_allclose(
        np.cov(draws["x"][:, np.array([0, 2])].T), rest, atol=np.sqrt(2) * error
    )
    np.testing.assert_allclose(np.log(draws["decay"][:, :2]).mean(0), 0.0, atol=error)
    np.testing.assert_allclose(draws["u"].mean(0)[jnp.array([0, 2])], [2.5, 3.5], atol=1.5 * error)
    for site, index, value in (("x", 1, 1.0), ("decay", 2, 0.8), ("u", 1, 2.0), ("u", 3, 4.0)):
        assert np.all(draws[site][:, index] == value)


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


def test_unconstrained_dimensions_are_those_of_the_free_elements():
    start = initialize_model(jax.random.key(1), fix(model, FIXED, LABELS)).param_info.z
    shapes = {name: value.shape for name, value in start.items()}
    assert shapes == {"x": (2,), "decay": (2,), "u": (2,), "weights": (2,)}


def test_draws_of_the_prior_hold_the_values():
    draws = Predictive(fix(model, FIXED, LABELS), num_samples=5)(jax.random.key(0))
    assert np.all(draws["decay"][:, 2] == 0.8) and np.all(draws["u"][:, 1] == 2.0)
    assert np.ptp(draws["decay"][:, 0]) > 0
    assert np.all(draws["noise_sd"] == 0.5)


def test_a_whole_vector_is_fixed_by_a_number_or_by_its_values():
    draw = Predictive(fix(model, {"decay": 0.8, "u": [1, 2, 3, 4]}), num_samples=1)
    values = draw(jax.random.key(0))
    np.testing.assert_array_equal(values["decay"], [[0.8, 0.8, 0.8]])
    np.testing.assert_array_equal(values["u"], [[1, 2, 3, 4]])


@pytest.mark.parametrize(
    ("fixed", "message"),
    [
        ({"dacay": 1.0}, r"unknown parameter to fix 'dacay'\. Did you mean 'decay'"),
        ({"dacay[a]": 1.0}, r"unknown parameter to fix 'dacay'"),
        ({"decay[d]": 1.0}, r"unknown element of decay 'd'\..*Known: a, b, c"),
        ({"decay[3]": 1.0}, r"unknown element of decay '3'"),
        ({"u[a]": 1.0}, r"unknown element of u 'a'.*Known: 0, 1, 2, 3"),
        ({"decay[a]": -1.0}, r"decay cannot be fixed at .*its prior allows > 0"),
        ({"noise_sd": -1.0}, r"noise_sd cannot be fixed at -1.0"),
        ({"noise_sd[0]": 1.0}, r"noise_sd has shape \(\); single elements .* of a vector only"),
        ({"decay": [1.0, 2.0]}, r"decay has shape \(3,\), got a value of shape \(2,\)"),
        ({"decay": 1.0, "decay[a]": 1.0}, r"decay is fixed as a whole and by element"),
        ({"weights[a]": 0.5}, r"weights.*depend on each other"),
    ],
)
def test_what_cannot_be_fixed(fixed, message):
    with pytest.raises(ValueError, match=message):
        numpyro.handlers.seed(fix(model, fixed, LABELS), 0)()


def test_the_prior_of_fixed_elements_in_words():
    """The free elements' prior and the values of the others; of arguments by element those of the free ones."""
    trace = numpyro.handlers.trace(numpyro.handlers.seed(fix(model, FIXED, LABELS), 0)).get_trace()
    assert prior(trace["decay"]["fn"]) == "LogNormal(0, 1); fixed: c = 0.8"
    assert prior(trace["u"]["fn"]) == "Uniform([0, 2], 5); fixed: 1 = 2, 3 = 4"
    all_fixed = pin("decay", dist.HalfNormal(jnp.ones(2)), {"0": 0.5, "1": 2.0})
    assert prior(all_fixed) == "fixed: 0 = 0.5, 1 = 2"
