"""Scores against closed forms and integrals, and what is refused."""

import numpy as np
import pytest
import xarray as xr
from scipy import integrate, stats

import lfm_ppl as lfm
from lfm_ppl.results import scoring
from lfm_ppl.results.layout import with_summaries
from lfm_ppl.results.predictions import mixture_quantiles

RNG = np.random.default_rng(4)
TIMES = np.array([1.0, 2.0, 4.0])


def predicted(mean, sd, draws=None, names=("a", "b"), **attributes):
    """A dataset of predictions from moments (S, K, D) of each draw."""
    mean, sd = np.broadcast_arrays(np.asarray(mean, float), np.asarray(sd, float))
    draws = mean + sd * RNG.normal(size=mean.shape) if draws is None else draws
    dims = ("chain", "draw", "time", "output")
    variables = {"y": (dims, draws[None], attributes), "y_mean": (dims, mean[None]), "y_sd": (dims, sd[None])}
    return xr.Dataset(variables, {"time": TIMES, "output": list(names)})


def test_crps_is_the_integral_of_the_squared_distance_of_distributions():
    """The fair estimator is the integral over the empirical distribution plus a known correction for S draws."""
    draws, y = RNG.normal(size=40), 0.7
    ordered = np.sort(np.append(draws, y))
    middle = 0.5 * (ordered[1:] + ordered[:-1])
    empirical = (draws[:, None] <= middle).mean(axis=0)
    integral = np.sum(np.diff(ordered) * (empirical - (middle >= y)) ** 2)
    pairs = np.abs(draws[:, None] - draws).sum()
    expected = integral + pairs / (2 * 40**2) - pairs / (2 * 40 * 39)
    np.testing.assert_allclose(scoring.crps(draws[:, None], np.array([y])), expected, rtol=1e-12)


def test_crps_of_draws_is_unbiased_for_that_of_the_normal_distribution():
    y = np.array([-1.0, 0.2, 3.0])
    exact = [integrate.quad(lambda v, datum=datum: (stats.norm.cdf(v) - (v >= datum)) ** 2, -12, 12, points=[datum],
                            limit=200)[0]
             for datum in y]
    closed = scoring.gaussian_scores(np.zeros(3), np.ones(3), y)
    np.testing.assert_allclose(closed.crps, exact, rtol=1e-6)
    np.testing.assert_allclose(closed.log_score, stats.norm.logpdf(y))
    np.testing.assert_array_equal(closed.covered, [1, 1, 0])
    many = np.array([scoring.crps(RNG.normal(size=(4, 3)), y) for _ in range(20_000)])  # four draws: bias would show
    error = many.std(axis=0) / np.sqrt(len(many))
    assert (np.abs(many.mean(axis=0) - exact) < 4.5 * error).all()


def test_scores_of_a_mixture():
    mean, sd = RNG.normal(size=(5, 3, 2)), RNG.uniform(0.5, 1.5, size=(5, 3, 2))
    y = RNG.normal(size=(3, 2))
    y[1, 0] = np.nan
    dataset = predicted(mean, sd)
    result = lfm.score(dataset, y)
    density = stats.norm.pdf(y, mean, sd).mean(axis=0)
    error = y - mean.mean(axis=0)
    assert result.index.tolist() == ["a", "b", "all"]
    assert result.columns.tolist() == ["n", "rmse", "crps", "log_score", "coverage_95"]
    assert result["n"].tolist() == [2, 3, 5]
    np.testing.assert_allclose(result["log_score"], [np.nanmean(np.log(density[:, 0])), np.log(density[:, 1]).mean(),
                                                    np.nanmean(np.log(density))])
    np.testing.assert_allclose(result["rmse"], [np.sqrt(np.nanmean(error[:, 0] ** 2)),
                                               np.sqrt(np.mean(error[:, 1] ** 2)), np.sqrt(np.nanmean(error**2))])
    ranked = scoring.crps(dataset["y"].values[0], y)
    np.testing.assert_allclose(result.loc["a", "crps"], np.nanmean(ranked[:, 0]))
    low, high = mixture_quantiles(mean, sd, [0.25, 0.75])
    for quantile, p in ((low, 0.25), (high, 0.75)):
        np.testing.assert_allclose(stats.norm.cdf(quantile, mean, sd).mean(axis=0), p, atol=1e-8)
    is_covered = np.where(np.isnan(y), np.nan, (low <= y) & (y <= high))
    np.testing.assert_allclose(lfm.score(dataset, y, level=0.5)["coverage_50"],
                               [np.nanmean(is_covered[:, 0]), is_covered[:, 1].mean(), np.nanmean(is_covered)])


def test_quantiles_of_a_mixture_with_one_part_far_away():
    mean, sd = np.zeros((400, 1)), np.full((400, 1), 0.01)
    sd[0] = 1000.0
    (result,) = mixture_quantiles(mean, sd, 0.025, 1e-4)[0]
    np.testing.assert_allclose(stats.norm.cdf(result, mean, sd).mean(), 0.025, atol=1e-5)


def test_summaries_of_a_panel_with_normal_parts_and_with_points():
    rng = np.random.default_rng(1)
    lead, where = (2, 3, 4), (5,)  # chains, draws, series; times
    mean, sd, points = rng.normal(size=(*lead, *where, 2)), rng.uniform(0.5, 1.0, (*lead, *where, 2)), rng.normal(
        size=(*lead, 8, *where, 1))
    dims = ("chain", "draw", "series", "time")
    paths = xr.Dataset({"states": ((*dims, "state"), mean), "outputs": ((*dims, "output"), points[..., 0, :, :])})
    result = with_summaries(paths, {"state_mean": mean, "state_sd": sd, "output_points": points})
    assert result["states_summary"].dims == ("statistic", "series", "time", "state")
    high = result["states_summary"].sel(statistic="q97.5").values
    np.testing.assert_allclose(stats.norm.cdf(high, mean, sd).mean(axis=(0, 1)), 0.975, atol=1e-5)
    low = np.quantile(points, 0.025, axis=(0, 1, 3))
    np.testing.assert_allclose(result["outputs_summary"].sel(statistic="q2.5"), low, rtol=1e-12)
    np.testing.assert_allclose(result["outputs_summary"].sel(statistic="mean"), points.mean(axis=(0, 1, 3)), rtol=1e-12)
    assert "new_data_summary" not in result and "forces_summary" not in result


def test_draws_alone_have_no_log_score():
    dataset = predicted(np.zeros((2000, 3, 2)), 1.0)[["y"]]
    result = lfm.score(dataset, np.zeros((3, 2)))
    assert np.isnan(result["log_score"]).all()
    assert (result["coverage_95"] == 1).all()


def test_held_out_data_are_found_by_time_and_name():
    mean, sd = RNG.normal(size=(50, 3, 2)), np.ones((50, 3, 2))
    dataset, y = predicted(mean, sd), RNG.normal(size=(3, 2))
    some = lfm.Data(TIMES[1:], y[1:, 1:], ("b",))
    expected = lfm.score(dataset, np.where([[False, False], [False, True], [False, True]], y, np.nan)).loc["b"]
    np.testing.assert_allclose(lfm.score(dataset, some).loc["b"], expected)
    array = xr.DataArray(y[1:, 1:], dims=("time", "output"), coords={"time": TIMES[1:], "output": ["b"]})
    np.testing.assert_allclose(lfm.score(dataset, array).loc["b"], expected)


def test_angles_are_compared_on_the_circle():
    mean = np.full((200, 3, 2), np.pi)
    draws = (mean + 0.1 * RNG.normal(size=mean.shape) + np.pi) % (2 * np.pi) - np.pi  # on both sides of the cut
    dataset = predicted(mean, 0.1, draws, angular='["a"]')
    result = lfm.score(dataset, np.array([[-np.pi + 0.05, np.pi]] * 3))
    np.testing.assert_allclose(result.loc["a", "rmse"], 0.05)
    assert result.loc["a", "crps"] < 0.06 < 0.5 < result.loc["b", "crps"]  # b is no angle


def test_what_cannot_be_compared(result):
    dataset = predicted(np.zeros((4, 3, 2)), 1.0)
    for held_out, words in (
            (np.zeros((2, 2)), "shape"), (np.full((3, 2), np.nan), "missing"), (np.full((3, 2), np.inf), "infinite"),
            (lfm.Data([2.0, 3.0], np.zeros((2, 1)), ("a",)), "time 3"),
            (lfm.Data([2.0], np.zeros((1, 1)), ("c",)), "'c'")):
        with pytest.raises(ValueError, match=words):
            lfm.score(dataset, held_out)
    with pytest.raises(ValueError, match="predictions"):
        lfm.score(result, np.zeros((3, 2)))
    with pytest.raises(ValueError, match="level"):
        lfm.score(dataset, np.zeros((3, 2)), level=95)


def test_a_log_score_of_few_draws_is_a_warning():
    dataset = predicted(RNG.normal(size=(400, 3, 2)), 1e-4)
    with pytest.warns(UserWarning, match="10 draws"):
        lfm.score(dataset, np.zeros((3, 2)))
