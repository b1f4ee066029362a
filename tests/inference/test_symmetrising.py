"""The transform of NUTS after which a skewed posterior is nearly symmetric."""

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

from lfm_ppl.inference import sampling, symmetrising
from lfm_ppl.inference.bound_samplers import nuts_sampler
from lfm_ppl.inference.laplace_start import Laplace, laplace_approximation
from lfm_ppl.inference.schedule import Schedule
from lfm_ppl.inference.symmetrising import SymmetrisingTransform, symmetrising_transform
from tests.inference.densities import bound, gaussian


def rates():
    """Return two gamma rates, whose logarithms have long left tails, and a parameter that depends on them."""
    rate = numpyro.sample("rate", dist.Gamma(jnp.array([1.0, 3.0])))
    numpyro.sample("x", dist.Normal(0.5 * jnp.log(rate).sum()))


def transform_of(model):
    laplace = laplace_approximation(jax.random.key(0), bound(model))
    return symmetrising_transform(jax.random.key(2), bound(model), laplace)


@pytest.mark.parametrize("asymmetry", [-0.8, -0.3, 0.0, 0.5, 0.8])
def test_transform_are_inverse_to_each_other_and_have_the_stated_slope(asymmetry):
    covariance = np.array([[1.0, 0.9], [0.9, 4.0]])
    transform = SymmetrisingTransform(Laplace(np.array([1.0, -2.0]), covariance), np.array([asymmetry, -asymmetry]))
    for x in np.linspace(-30.0, 30.0, 13):
        x = jnp.array([x, 0.5 * x])
        z = transform.to_z(x)
        assert_allclose(transform.to_x(z), x, atol=1e-11)
        derivative = jax.jacfwd(transform.to_z)(x)
        assert_allclose(derivative, np.diag(transform.derivative(x)), rtol=1e-12)
        assert (np.diag(derivative) > 0.0).all()
    assert_allclose(transform.to_z(jnp.zeros(2)), [1.0, -2.0])
    assert_allclose(transform.correlation, [[1.0, 0.45], [0.45, 1.0]])


def test_a_normal_posterior_has_no_skewness():
    transform = transform_of(gaussian)
    assert_allclose(transform.asymmetry, 0.0, atol=1e-5)
    assert_allclose(transform.to_z(jnp.array([1.0, 1.0])), [2.0, -2.0 + np.sqrt(2.0)], atol=1e-4)


def test_log_gamma_draws_are_nearly_symmetric_after_the_transform():
    transform = transform_of(rates)
    rng = np.random.default_rng(0)
    log_rate = np.log(rng.gamma([1.0, 3.0], size=(20_000, 2)))
    z = np.column_stack([log_rate, 0.5 * log_rate.sum(axis=1) + rng.normal(size=20_000)])
    x = np.asarray(jax.vmap(transform.to_x)(jnp.array(z)))
    assert (np.abs(skew(z)[:2]) > [1.0, 0.5]).all()
    assert (np.abs(skew(x)) < 0.35 * np.abs(skew(z)) + 0.05).all()


def cliff():
    x = numpyro.sample("x", dist.Normal())
    numpyro.factor("edge", jnp.where(x < -1.0, -jnp.inf, 0.0))


def test_an_edge_of_the_support_says_nothing_about_a_tail():
    transform = symmetrising_transform(jax.random.key(2), bound(cliff), Laplace(np.zeros(1), np.eye(1)))
    assert_allclose(transform.asymmetry, 0.0)


def ridge():
    """Return two skewed parameters and one that is nearly their sum."""
    z = numpyro.sample("z", dist.Normal().expand([3]).to_event(1))
    numpyro.factor("skewed", (z - jnp.exp(z))[:2].sum() + 0.5 * (z**2).sum())
    numpyro.factor("sum", -0.5 * ((z[2] - z[0] - z[1]) / 0.01) ** 2)


def test_a_narrow_ridge_of_three_parameters_is_not_bent():
    transform = transform_of(ridge)
    assert_allclose(transform.asymmetry, 0.0)
    assert np.abs(symmetrising._asymmetry(
        lambda z: float(bound(ridge).log_density(z)), transform))[:2].min() > 0.2


def test_draws_and_densities_are_those_of_the_unconstrained_parameters():
    model, warmup = bound(rates), 300
    transform = transform_of(rates)
    assert np.abs(transform.asymmetry[:2]).min() > 0.2
    starts = np.stack([np.asarray(transform.laplace.mode) + shift for shift in (-0.5, 0.5)])
    sampler = nuts_sampler(model, warmup, {}, transform)
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


def test_the_first_gradient_of_a_chain_is_that_of_the_transformed_density():
    model, transform = bound(rates), transform_of(rates)
    z = np.asarray(transform.laplace.mode) - 0.7
    sampler = nuts_sampler(model, 10, {}, transform)
    value, gradient = sampler.evaluate(z)
    state = sampler.algorithm.init(jax.random.key(0), ParamInfo(model.unravel(z), -value, model.unravel(-gradient)),
                                   sampler.problem, sampler.tuning)
    assert_allclose(state.z, z, rtol=1e-12)
    assert_allclose(state.potential, -value, rtol=1e-12)

    def potential(x):
        return -model.log_density(transform.to_z(x)) - transform.log_jacobian(x)

    x = transform.to_x(z)
    assert_allclose(state.hmc.potential_energy, potential(x), rtol=1e-12)
    slope = np.concatenate([np.ravel(state.hmc.z_grad[name]) for name in sorted(model.sites)])
    assert_allclose(slope, jax.grad(potential)(x), rtol=1e-10)
