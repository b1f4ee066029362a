"""Coordinates of NUTS in which a skewed posterior is nearly symmetric."""

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpy.testing import assert_allclose
from numpyro.infer.util import ParamInfo
from scipy.special import polygamma
from scipy.stats import skew

from lfm_ppl.inference import sampling
from lfm_ppl.inference.bind import bind_arguments
from lfm_ppl.inference.bound_samplers import nuts_sampler
from lfm_ppl.inference.laplace_start import Laplace, laplace_approximation
from lfm_ppl.inference.schedule import Schedule
from lfm_ppl.inference.skew_coordinates import SkewCoordinates, skew_coordinates

COVARIANCE = np.array([[1.0, 0.9], [0.9, 4.0]])
MIXING = np.array([[1.0, 0.0], [0.8, 2.0]])


def bound(model):
    return bind_arguments(model, (), {}, "test")


def gaussian():
    numpyro.sample("x", dist.MultivariateNormal(jnp.array([1.0, -2.0]), jnp.array(COVARIANCE)))


def rates():
    """Return two gamma rates, whose logarithms have long left tails, and a parameter that depends on them."""
    rate = numpyro.sample("rate", dist.Gamma(jnp.array([1.0, 3.0])))
    numpyro.sample("x", dist.Normal(0.5 * jnp.log(rate).sum()))


def coordinates_of(model):
    return skew_coordinates(bound(model), laplace_approximation(jax.random.key(0), bound(model)))


@pytest.mark.parametrize("skewness", [-0.8, -0.3, 0.0, 0.5, 0.8])
def test_coordinates_are_inverse_to_each_other_and_have_the_stated_slope(skewness):
    coordinates = SkewCoordinates(Laplace(np.array([1.0, -2.0]), COVARIANCE), np.array([skewness, -skewness]))
    for x in np.linspace(-30.0, 30.0, 13):
        x = jnp.array([x, 0.5 * x])
        z = coordinates.to_z(x)
        assert_allclose(coordinates.to_x(z), x, atol=1e-11)
        slope = jax.jacfwd(coordinates.to_z)(x)
        assert_allclose(slope, np.diag(coordinates.slope(x)), rtol=1e-12)
        assert (np.diag(slope) > 0.0).all()
    assert_allclose(coordinates.to_z(jnp.zeros(2)), [1.0, -2.0])
    assert_allclose(coordinates.covariance, [[1.0, 0.45], [0.45, 1.0]])


def test_a_normal_posterior_has_no_skewness():
    coordinates = coordinates_of(gaussian)
    assert_allclose(coordinates.skewness, 0.0, atol=1e-5)
    assert_allclose(coordinates.to_z(jnp.array([1.0, 1.0])), [2.0, 0.0], atol=1e-4)


def test_log_gamma_draws_are_nearly_symmetric_in_the_coordinates():
    coordinates = coordinates_of(rates)
    rng = np.random.default_rng(0)
    log_rate = np.log(rng.gamma([1.0, 3.0], size=(20_000, 2)))
    z = np.column_stack([log_rate, 0.5 * log_rate.sum(axis=1) + rng.normal(size=20_000)])
    x = np.asarray(jax.vmap(coordinates.to_x)(jnp.array(z)))
    assert (np.abs(skew(z)[:2]) > [1.0, 0.5]).all()
    assert (np.abs(skew(x)) < 0.35 * np.abs(skew(z)) + 0.05).all()


def cliff():
    x = numpyro.sample("x", dist.Normal())
    numpyro.factor("edge", jnp.where(x < -1.0, -jnp.inf, 0.0))


def test_an_edge_of_the_support_gives_a_finite_skewness():
    skewness = skew_coordinates(bound(cliff), Laplace(np.zeros(1), np.eye(1))).skewness
    assert_allclose(skewness, 0.8)


def test_draws_and_densities_are_those_of_the_unconstrained_parameters():
    model, warmup = bound(rates), 300
    coordinates = coordinates_of(rates)
    assert np.abs(coordinates.skewness[:2]).min() > 0.2
    starts = np.stack([np.asarray(coordinates.laplace.mode) + shift for shift in (-0.5, 0.5)])
    sampler = nuts_sampler(model, warmup, {}, coordinates)
    draws = sampling.run_chains(jax.random.key(1), sampler, starts, Schedule(warmup, 2000, 1, "sequential"))
    for draw, potential in zip(draws.z[0, :5], draws.statistics["lp"][0, :5], strict=True):
        assert_allclose(-potential, model.log_density(draw), rtol=1e-10)
    log_rate = draws.z[..., [model.names.index(f"rate[{i}]") for i in range(2)]]
    for i, shape in enumerate([1.0, 3.0]):
        deviation = log_rate[..., i] - polygamma(0, shape)
        for values, expected in ((deviation, 0.0), (deviation**2, polygamma(1, shape))):
            error = float(az.mcse(values, method="mean"))
            assert abs(values.mean() - expected) < 4.0 * error
            assert error < 0.1 * polygamma(1, shape)


def test_the_first_gradient_of_a_chain_is_that_in_the_coordinates():
    model, coordinates = bound(rates), coordinates_of(rates)
    z = np.asarray(coordinates.laplace.mode) - 0.7
    sampler = nuts_sampler(model, 10, {}, coordinates)
    value, gradient = sampler.evaluate(z)
    state = sampler.algorithm.init(jax.random.key(0), ParamInfo(model.unravel(z), -value, model.unravel(-gradient)),
                                   sampler.problem, sampler.tuning)
    assert_allclose(state.z, z, rtol=1e-12)
    assert_allclose(state.potential, -value, rtol=1e-12)

    def potential(x):
        return -model.log_density(coordinates.to_z(x)) - jnp.log(coordinates.slope(x)).sum()

    x = coordinates.to_x(z)
    assert_allclose(state.hmc.potential_energy, potential(x), rtol=1e-12)
    slope = np.concatenate([np.ravel(state.hmc.z_grad[name]) for name in sorted(model.sites)])
    assert_allclose(slope, jax.grad(potential)(x), rtol=1e-10)
