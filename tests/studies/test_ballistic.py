"""Ballistic study: small runs of every part, tables and figures."""

import numpy as np
import pytest
from scipy import stats

from lfm_ppl.studies.ballistic import parameters
from lfm_ppl.studies.ballistic.problem import (
    posterior,
    simulate_target,
    true_z,
)


@pytest.mark.slow
def test_the_densities_are_those_of_the_model():
    """The prior against scipy's, and the likelihood against that of the system built by hand."""
    z = true_z() + np.array([0.3, -0.2, 0.1])
    target = simulate_target(0)
    log_likelihood, log_prior = posterior().log_densities(z, target.y)
    expected = stats.norm([np.log(5e-4), np.log(30.0), np.log(5.0)], [1.0, 1.0, 0.7]).logpdf(z).sum()
    # The levels of the noise are fixed at the medians of their priors, whose densities there belong to it.
    expected += sum(stats.lognorm(0.7, scale=level).logpdf(level) for level in (50.0, 10.0, 30.0))
    assert log_prior == pytest.approx(expected, rel=1e-12)
    assert log_likelihood == pytest.approx(float(posterior().likelihood(z).log_prob(target.y)), rel=1e-10)


@pytest.mark.slow
def test_the_posterior_is_that_of_a_grid():
    """Mean and standard deviation of each parameter against a sum over a grid of all three."""
    target = simulate_target(0)
    result = parameters.estimate(target, 1_000, 5, 0)
    assert result["k"] < 0.7 and result["exists"]
    axes = [np.linspace(m - 5 * s, m + 5 * s, 25)
            for m, s in zip(result["posterior_mean"], result["posterior_sd"], strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    log_density = np.sum(posterior().log_densities_of(nodes, target.y, batch=25), axis=0)
    weight = np.exp(log_density - log_density.max())
    weight /= weight.sum()
    mean = weight @ nodes
    sd = np.sqrt(weight @ (nodes - mean) ** 2)
    error = sd / np.sqrt(result["ess"])
    np.testing.assert_array_less(np.abs(result["posterior_mean"] - mean), 4 * error)
    np.testing.assert_allclose(result["posterior_sd"], sd, rtol=4 / np.sqrt(result["ess"]))
    np.testing.assert_allclose(result["below"], weight @ (nodes < true_z()), atol=0.1)
    # No point of the grid is more likely than the most likely one.
    points = np.stack([result["likely"], *nodes[np.argsort(log_density)[-5:]]])
    best, *lower = posterior().log_densities_of(points, target.y)[0]
    assert best >= max(lower) - 1e-6
