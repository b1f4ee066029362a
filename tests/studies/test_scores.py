"""Intervals and rates against closed forms."""

import numpy as np
import pytest
from scipy import stats

from lfm_ppl.studies import scores


@pytest.mark.parametrize("nodes", [np.linspace(-4.0, 8.0, 31), np.geomspace(0.05, 40.0, 61)])
def test_a_gaussian_posterior_has_its_closed_form(nodes):
    mean, sd = (1.3, 0.7) if nodes[0] < 0 else (2.0, 0.3)
    posterior = scores.GridPosterior(nodes, stats.norm.logpdf(nodes, mean, sd) + 123.0)
    # Trapezoidal sums of a smooth density that vanishes at both ends; the spline of a parabola is the parabola.
    p = np.array([0.005, 0.5, 0.995])
    np.testing.assert_allclose(posterior.quantile(p), stats.norm.ppf(p, mean, sd), atol=2e-4 * sd + 1e-3 * sd)
    np.testing.assert_allclose([posterior.mean, posterior.sd], [mean, sd], rtol=1e-4)
    np.testing.assert_allclose(posterior.cdf(mean + sd), stats.norm.cdf(1.0), atol=2e-4)
    assert not posterior.is_cut_off()


def test_a_truncated_exponential_is_cut_and_right():
    nodes = np.linspace(0.0, 3.0, 25)
    posterior = scores.GridPosterior(nodes, -nodes)
    truth = stats.truncexpon(3.0)
    assert posterior.is_cut_off()
    np.testing.assert_allclose(posterior.cdf(1.0), truth.cdf(1.0), atol=1e-5)
    np.testing.assert_allclose(posterior.mean, truth.mean(), atol=1e-5)


@pytest.mark.parametrize("impossible", [-np.inf, np.nan, -2_000.0])
def test_impossible_values_have_no_posterior_mass(impossible):
    """What is left is the density between the others, cut off there and no different."""
    nodes = np.linspace(-3.0, 3.0, 61)
    for low, high in ((-1.0, 3.0), (-1.5, 0.5), (-3.0, 2.7)):
        values = np.where((nodes < low - 0.05) | (nodes > high + 0.05), impossible, -0.5 * nodes**2)
        posterior, truth = scores.GridPosterior(nodes, values), stats.truncnorm(low, high)
        assert posterior.cdf(low - 0.2) < 1e-12 and np.isfinite(posterior.density).all()
        np.testing.assert_allclose(posterior.cdf(0.0), truth.cdf(0.0), atol=2e-3)
        np.testing.assert_allclose([posterior.mean, posterior.sd], [truth.mean(), truth.std()], atol=2e-3)


def test_a_value_that_is_missing_takes_no_more_than_its_place():
    nodes = np.linspace(-4.0, 4.0, 81)
    values = -0.5 * nodes**2
    for missing in ([5], [0, 80], [76, 78]):
        posterior = scores.GridPosterior(nodes, np.where(np.isin(np.arange(81), missing), np.nan, values))
        for value in (-1.0, 0.0, 2.0):
            assert posterior.cdf(value) == pytest.approx(stats.norm.cdf(value), abs=3e-4)


def test_what_is_no_posterior_is_refused():
    with pytest.raises(ValueError, match="increasing"):
        scores.GridPosterior([0.0, 1.0, 1.0, 2.0], np.zeros(4))
    with pytest.raises(ValueError, match="shape of nodes"):
        scores.GridPosterior(np.arange(5.0), np.zeros(4))
    with pytest.raises(ValueError, match="not finite at any node"):
        scores.GridPosterior(np.arange(5.0), np.full(5, -np.inf))


def test_quantiles_of_cell_densities_are_those_of_the_distribution():
    edges = np.linspace(-8.0, 8.0, 321)
    x, width = 0.5 * (edges[1:] + edges[:-1]), edges[1] - edges[0]
    density = np.stack([np.diff(stats.norm.cdf(edges, m, s)) / width for m, s in ((0.0, 1.0), (1.0, 0.5))])
    quantiles = scores.density_quantiles(x, width, density, [0.025, 0.975])
    assert quantiles.shape == (2, 2)
    # Linear interpolation within a cell: an error of order density' width^2 / density.
    np.testing.assert_allclose(quantiles[0], [stats.norm.ppf(0.025), stats.norm.ppf(0.025, 1.0, 0.5)], atol=2e-3)


def test_rates_and_their_errors():
    assert scores.estimate_rate([1, 0, 0, 0]) == scores.Estimate(0.25, np.sqrt(0.25 * 0.75 / 4))
    none = scores.estimate_rate(np.zeros(98))
    assert none.value == 0.0 and none.error == pytest.approx(np.sqrt(0.01 * 0.99 / 98))
    assert np.isnan(scores.estimate_rate([]).value)


def test_means_leave_out_what_is_missing():
    estimate = scores.estimate_mean([1.0, np.nan, 3.0])
    assert estimate == scores.Estimate(2.0, 1.0)
    assert np.isnan(scores.estimate_mean([5.0]).error)


def test_errors_and_coverage():
    assert scores.rmse([1.0, 3.0], [0.0, 0.0]) == pytest.approx(np.sqrt(5.0))
    assert scores.interval_coverage([0.0, 0.0], [1.0, 1.0], [0.5, 2.0]) == 0.5
    mean, sd = np.array([[0.0, 1.0, 2.0], [1.0, 1.0, 1.0]]), np.array([[1.0, 1.0, 1.0], [0.1, 1.0, 1.0]])
    path_scores = scores.score_path("smoother", mean, scores.interval(mean, sd), [1.0, 1.0, 5.0])
    np.testing.assert_allclose(path_scores["smoother_rmse"], np.sqrt([10.0 / 3.0, 16.0 / 3.0]))
    np.testing.assert_allclose(path_scores["smoother_coverage"], [2.0 / 3.0, 2.0 / 3.0])


def test_the_error_of_a_standard_deviation_follows_from_the_fourth_moment():
    """sd of s is s sqrt((kurtosis - 1) / (4 n)) for independent draws; squares that repeat count once."""
    generator = np.random.default_rng(3)
    heavy, normal = generator.laplace(size=(4, 5000)), generator.normal(size=(4, 5000))
    errors = scores.relative_errors_of_sd(np.stack([heavy, normal, np.repeat(normal[:, :1250], 4, axis=1)]))
    expected = np.sqrt(np.array([6.0, 3.0, 3.0]) - 1) / np.sqrt(4 * np.array([20_000, 20_000, 5_000]))
    np.testing.assert_allclose(errors, expected, rtol=0.12)
    assert np.isnan(scores.relative_errors_of_sd(np.ones((1, 2, 50)))).all()


def test_the_law_of_total_variance():
    generator = np.random.default_rng(0)
    mean, variance = generator.normal(size=(3, 2)), generator.uniform(1.0, 2.0, (3, 2))
    total, sd = scores.total_moments(mean, variance)
    np.testing.assert_allclose(total, mean.mean(axis=0))
    np.testing.assert_allclose(sd**2, (variance + mean**2).mean(axis=0) - total**2, rtol=1e-12)
