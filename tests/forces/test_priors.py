"""Penalised-complexity priors: the density of the paper, its tail probabilities by quadrature, and draws."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
from scipy.integrate import quad

import lfm_ppl as lfm
from lfm_ppl.likelihoods.priors import central_interval, prior


def mass(density, low, high):
    """The integral of a density over lengthscales or scales, in their logarithm."""
    return quad(lambda log: np.exp(log + float(density.log_prob(np.exp(log)))), np.log(low), np.log(high), limit=200)[0]


@pytest.mark.parametrize(("largest", "shortest", "probability"), [(1.5, 1.0, 0.05), (0.2, 30.0, 0.01), (4.0, 0.3, 0.5)])
def test_tail_probabilities(largest, shortest, probability):
    scale, lengthscale = lfm.priors.penalised_complexity(largest, shortest, probability)
    assert mass(lengthscale, 1e-6 * shortest, shortest) == pytest.approx(probability, rel=1e-6)
    assert mass(lengthscale, shortest, 1e16 * shortest) == pytest.approx(1.0 - probability, abs=1e-6)
    assert mass(scale, 1e-9 * largest, largest) == pytest.approx(1.0 - probability, rel=1e-6)
    assert mass(scale, largest, 1e3 * largest) == pytest.approx(probability, rel=1e-6)
    for quantile in (0.01, 0.3, 0.9):
        shorter = mass(lengthscale, 1e-6 * shortest, float(lengthscale.icdf(quantile)))
        assert shorter == pytest.approx(quantile, rel=1e-6)
        assert float(lengthscale.cdf(lengthscale.icdf(quantile))) == pytest.approx(quantile, rel=1e-9)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_the_joint_density_is_that_of_the_paper(order):
    """In one dimension, for the range sqrt(8 nu) / kappa of their Matern covariance."""
    largest, shortest, sd, lengthscale = 1.5, 1.0, 0.7, 3.0
    nu = order + 0.5
    per_lengthscale = np.sqrt(8.0 * nu) / (np.sqrt(2.0 * nu) / 1.0)
    first = -np.log(0.05) * (per_lengthscale * shortest) ** 0.5
    second = -np.log(0.05) / largest
    range_ = per_lengthscale * lengthscale
    density = 0.5 * first * second * range_**-1.5 * np.exp(-first * range_**-0.5 - second * sd)
    of_scale, of_lengthscale = lfm.priors.penalised_complexity(largest, shortest)
    ours = float(of_scale.log_prob(sd) + of_lengthscale.log_prob(lengthscale))
    assert ours == pytest.approx(np.log(density * per_lengthscale), rel=1e-12)


def test_draws_follow_the_distribution():
    density = lfm.priors.PenalisedLengthscale(jnp.array([1.0, 5.0]), 0.1)
    draws = density.sample(jax.random.key(0), (4000,))
    assert draws.shape == (4000, 2) and (draws > 0).all()
    for q in (0.1, 0.5, 0.9):
        assert np.abs((np.asarray(draws) < np.asarray(density.icdf(q))).mean(axis=0) - q).max() < 0.025
    assert np.isfinite(jax.grad(lambda value: density.log_prob(value).sum())(2.0))


def test_in_a_model():
    def model():
        numpyro.sample("lengthscale", lfm.priors.penalised_complexity(1.0, 2.0)[1])

    z = numpyro.infer.util.potential_energy(model, (), {}, {"lengthscale": jnp.log(3.0)})
    density = lfm.priors.PenalisedLengthscale(2.0)
    assert float(z) == pytest.approx(-float(density.log_prob(3.0)) - np.log(3.0))
    assert prior(density) == "PenalisedLengthscale(2, 0.05)"
    np.testing.assert_allclose(central_interval(density), density.icdf(np.array([0.005, 0.995])), rtol=1e-6)


@pytest.mark.parametrize(("arguments", "name"), [
    ((0.0, 1.0), "largest_scale"), ((1.0, -1.0), "shortest_lengthscale"), ((1.0, 1.0, 1.0), "probability"),
    ((1.0, 1.0, np.nan), "probability")])
def test_errors(arguments, name):
    with pytest.raises(ValueError, match=name):
        lfm.priors.penalised_complexity(*arguments)
