"""Weighted draws about one mode and about several."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import special, stats

from lfm_ppl.studies.importance_at_modes import moments, weighted


def test_weighted_draws_have_the_moments_of_their_density():
    """A normal density found from a wrong mode and a wrong curvature."""
    factor = np.array([[2.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.0, -0.3, 0.4]])
    target = stats.multivariate_normal([1.0, -2.0, 3.0], factor @ factor.T)
    mode = SimpleNamespace(point=target.mean + [1.0, 0.0, 0.2], curvature=SimpleNamespace(factor=0.8 * factor))
    draws, result, _ = weighted_draws = weighted(target.logpdf, [mode], 20_000, 0)
    mean, covariance = moments(draws, weighted_draws.weight)
    # Without the second t distribution it is below 12,000.
    assert result.k < 0.5 and result.ess > 15_000
    variance = np.diag(target.cov)
    np.testing.assert_array_less(np.abs(mean - target.mean), 4 * np.sqrt(variance / result.ess))
    np.testing.assert_allclose(np.diag(covariance), variance, rtol=4 * np.sqrt(2 / result.ess))
    summary, resample = weighted_draws.summary, weighted_draws.resampled(5_000, 0)
    np.testing.assert_allclose(summary["posterior_mean"], mean)
    np.testing.assert_allclose(summary["posterior_sd"], np.sqrt(np.diag(covariance)))
    assert (summary["k"], summary["ess"]) == (result.k, result.ess)
    assert resample.shape == (5_000, 3)
    np.testing.assert_array_less(np.abs(resample.mean(axis=0) - target.mean), 4 * np.sqrt(variance / 4_000))
    with pytest.raises(ValueError, match="no curvature"):
        weighted(target.logpdf, [SimpleNamespace(point=mode.point, curvature=None)], 10, 0)


def test_weights_that_one_draw_has_do_not_end_the_search():
    """A density far narrower than its curvature says: the second proposal must not be singular."""
    mode = SimpleNamespace(point=np.zeros(3), curvature=SimpleNamespace(factor=np.eye(3)))
    draws, result, _ = weighted(lambda z: -0.5 * ((z - 3.0) ** 2).sum(axis=1) / 1e-8, [mode], 50, 0)
    assert np.isfinite(draws).all() and result.k > 0.7


SHARE = 0.03
FIRST = stats.multivariate_normal([0.0, 0.0], np.diag([1.0, 0.04]))
SECOND = stats.multivariate_normal([9.0, 2.0], [[0.3, -0.2], [-0.2, 0.5]])


def two_modes(z):
    """Logarithm of 7.5 times a density with a small second mode, far from the first."""
    parts = [np.log(1 - SHARE) + FIRST.logpdf(z), np.log(SHARE) + SECOND.logpdf(z)]
    return special.logsumexp(parts, axis=0) + np.log(7.5)


def modes(*parts, wrong=1.3):
    """Modes at the means of normal densities, their curvature off by a factor."""
    return [SimpleNamespace(point=part.mean, curvature=SimpleNamespace(factor=wrong * np.linalg.cholesky(part.cov)))
            for part in parts]


def test_a_small_second_mode_has_its_share():
    draws, result, mass = weighted(two_modes, modes(FIRST, SECOND), 6_000, 0)
    weight = np.exp(result.log_weight[0])
    second = draws[:, 0] > 5
    # It gets some of the draws whatever its share, which is therefore known better than by draws of the density.
    assert draws.shape == (6_000, 2) and second.mean() == pytest.approx(0.1 / 1.07, rel=0.1)
    share = weight[second].sum()
    error = np.sqrt((weight**2 * (second - share) ** 2).sum())
    assert abs(share - SHARE) < 4 * error < SHARE / 4
    assert mass.sum() == pytest.approx(1.0) and mass[1] == pytest.approx(share, rel=0.01)
    mean, covariance = moments(draws[second], weight[second] / share)
    ess = share**2 / (weight[second] ** 2).sum()
    # The second t distribution has the moments about the mode, and no longer the wrong curvature of it.
    assert result.reliable and ess > 0.8 * second.sum() and ess > 300
    np.testing.assert_array_less(np.abs(mean - SECOND.mean), 4 * np.sqrt(np.diag(SECOND.cov) / ess))
    np.testing.assert_allclose(np.diag(covariance), np.diag(SECOND.cov), rtol=4 * np.sqrt(2 / ess))


def test_a_mode_that_is_not_given_is_not_seen():
    """The limitation that is documented: not even the Pareto index tells."""
    draws, result, _ = weighted(two_modes, modes(FIRST), 2_000, 0)
    assert result.k < 0.5 and np.exp(result.log_weight[0])[draws[:, 0] > 5].sum() < SHARE / 10


@pytest.mark.parametrize("where", [[40.0, 0.0], [0.1, 0.05]])
def test_what_is_no_mode_does_no_harm(where):
    """A second point without mass about it; and the same mode given twice."""
    second = stats.multivariate_normal(where, FIRST.cov)
    draws, result, mass = weighted(FIRST.logpdf, modes(FIRST, second), 4_000, 0)
    mean, covariance = moments(draws, np.exp(result.log_weight[0]))
    assert result.reliable and result.ess > 3_000
    np.testing.assert_array_less(np.abs(mean), 4 * np.sqrt(np.diag(FIRST.cov) / result.ess))
    np.testing.assert_allclose(np.diag(covariance), np.diag(FIRST.cov), rtol=4 * np.sqrt(2 / result.ess))
    assert mass.sum() == pytest.approx(1.0)
    if where[0] > 20:
        # It keeps its place and its draws, and has nothing of the posterior.
        assert mass[1] < 1e-9 and (draws[:, 0] > 20).mean() == pytest.approx(0.1 / 1.1, rel=0.01)


@pytest.mark.parametrize("share", [0.1, 0.01, 0.001])
def test_mixture_weights_are_right_from_few_draws(share):
    """In five dimensions, where the tails of a t distribution about one mode reach the other."""
    parts = [stats.multivariate_normal(np.zeros(5)), stats.multivariate_normal([6.0, 0.0, 0.0, 0.0, 0.0])]

    def log_density(z):
        return special.logsumexp([np.log(1 - share) + parts[0].logpdf(z), np.log(share) + parts[1].logpdf(z)], axis=0)

    result = [weighted(log_density, modes(*parts, wrong=1.0), 200, seed).mixture_weights[1] for seed in range(30)]
    assert abs(np.mean(result) - share) < 0.35 * share + 4 * np.std(result) / np.sqrt(30)
    assert np.std(result) < max(0.3 * share, 0.002)


def test_densities_that_are_not_finite_have_no_weight():
    """Half of the space has none; a density of a single parameter; a mode without curvature beside one that has it."""
    def log_density(z):
        log_prob = stats.norm(1.0, 2.0).logpdf(z[:, 0])
        return np.where(z[:, 0] > 4.0, np.inf, np.where(z[:, 0] < -2.0, np.nan, log_prob))

    candidates = [SimpleNamespace(point=np.array([9.0]), curvature=None),
                  SimpleNamespace(point=np.array([1.0]), curvature=SimpleNamespace(factor=np.array([[2.0]])))]
    draws, result, mass = weighted(log_density, candidates, 5_000, 0)
    weight = np.exp(result.log_weight[0])
    assert draws.shape == (5_000, 1) and mass.tolist() == pytest.approx([1.0])
    assert (weight[(draws[:, 0] < -2.0) | (draws[:, 0] > 4.0)] == 0).all()
    expected = stats.truncnorm(-1.5, 1.5, 1.0, 2.0)
    assert weight @ draws[:, 0] == pytest.approx(1.0, abs=4 * expected.std() / np.sqrt(result.ess))
    with pytest.raises(ValueError, match="likelihood of zero"):
        weighted(lambda z: np.full(len(z), np.nan), candidates[1:], 10, 0)


@pytest.mark.parametrize("count", [1, 2, 3, 5, 50])
def test_every_mode_has_draws(count):
    draws, _, _ = weighted(two_modes, modes(FIRST, SECOND, FIRST), count, 0)
    assert len(draws) == max(count, 3)
