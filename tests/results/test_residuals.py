"""The numbers behind the residual figure, against direct formulas and simulation."""

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from lfm_ppl.results import arviz_data
from lfm_ppl.results.residuals import autocorrelation, ljung_box, mean_residuals, misfit, normal_scores, residual_tests


def result_with(residual):
    """A result whose residuals (time, output) are the same for every draw."""
    repeated = np.broadcast_to(residual, (2, 3, *residual.shape)).copy()
    names = [f"y{k}" for k in range(residual.shape[1])]
    return arviz_data.build({"one_step_ahead": xr.Dataset(
        {"residual": (("chain", "draw", "time", "output"), repeated)}, {"output": names})})


def test_ljung_box_is_the_textbook_formula_without_gaps():
    series = np.random.default_rng(0).normal(size=50) + 0.3
    n, lags = 50, 7
    centred = series - series.mean()
    r = np.array([(centred[:-h] * centred[h:]).sum() for h in range(1, lags + 1)])
    r /= (centred**2).sum()
    q = n * (n + 2) * np.sum(r**2 / (n - np.arange(1, lags + 1)))
    assert ljung_box(series, lags) == pytest.approx(stats.chi2.sf(q, lags), rel=1e-12)
    rho, pairs = autocorrelation(series, lags)
    np.testing.assert_allclose(rho * pairs / n, r)
    np.testing.assert_array_equal(pairs, n - np.arange(1, lags + 1))


def test_autocorrelation_uses_only_the_pairs_that_are_there():
    series = np.array([1.0, np.nan, 2.0, -1.0, np.nan, np.nan, 3.0, 1.0])
    rho, pairs = autocorrelation(series, 4)
    centred = series - 6.0 / 5.0
    variance = np.nanmean(centred**2)
    assert list(pairs) == [2, 1, 2, 2]
    first = (centred[2] * centred[3] + centred[6] * centred[7]) / 2 / variance
    np.testing.assert_allclose(rho[0], first)
    np.testing.assert_allclose(rho[1], centred[0] * centred[2] / variance)


def test_lags_of_an_output_that_few_rows_have_count_its_observations():
    dense = np.random.default_rng(1).normal(size=40)
    sparse = np.full(120, np.nan)
    sparse[::3] = dense
    for result, expected in zip(autocorrelation(sparse, 8), autocorrelation(dense, 8), strict=True):
        np.testing.assert_allclose(result, expected)
    assert ljung_box(sparse, 8) == pytest.approx(ljung_box(dense, 8))


def test_a_misfit_is_said_and_a_fit_is_not():
    rng = np.random.default_rng(4)
    right = rng.normal(size=(60, 1))
    assert misfit(result_with(right)) == []
    gross = right.copy()
    gross[[5, 20, 40], 0] = 4.0, -4.5, 5.0
    (message,) = misfit(result_with(gross))
    assert "3 of 60 residuals of y0" in message
    slow = np.convolve(rng.normal(size=69), np.ones(10), mode="valid")[:, None] / np.sqrt(10.0)
    assert any("autocorrelated" in message for message in misfit(result_with(slow)))
    assert len(misfit(result_with(0.3 * right))) == 1
    # Residuals of another filter, and too few of them, give no message.
    wide = result_with(3.0 * np.random.default_rng(7).normal(size=(60, 1)))
    assert misfit(wide)
    for name, value in (("constraints", "x >= 0"), ("sampler", "pmmh")):
        other_result = result_with(3.0 * np.random.default_rng(7).normal(size=(60, 1)))
        other_result.attrs[name] = value
        assert misfit(other_result) == []
    few = result_with(np.full((3, 1), 9.0))
    assert misfit(few) == []


def test_a_misfit_is_rarely_said_where_the_model_holds():
    residual = np.random.default_rng(6).normal(size=(60, 500))
    assert len(misfit(result_with(residual))) <= 5  # three tests of 500 outputs, each wrong once in a thousand


@pytest.mark.parametrize("gaps", [0.0, 0.2])
def test_p_values_are_uniform_when_the_model_holds(gaps):
    rng = np.random.default_rng(5)
    residual = rng.normal(size=(120, 400))
    residual[rng.random(residual.shape) < gaps] = np.nan
    table = residual_tests(result_with(residual))
    # Kolmogorov distance of 400 uniform values exceeds 0.096 once in a thousand; Ljung-Box is
    # asymptotic, which at 96 to 120 observations costs up to 0.03.
    assert stats.kstest(table["ks_p"], "uniform").statistic < 0.096
    assert stats.kstest(table["ljung_box_p"], "uniform").statistic < 0.126


def test_p_values_find_what_is_wrong():
    rng = np.random.default_rng(2)
    wide = 1.6 * rng.normal(size=200)
    wandering = stats.norm.ppf((np.argsort(np.argsort(np.cumsum(wide))) + 0.5) / 200)
    shifted = rng.normal(size=200) + 0.5
    table = residual_tests(result_with(np.stack([wide, wandering, shifted], axis=1)))
    assert table.loc["y0", "ks_p"] < 0.001 < table.loc["y0", "ljung_box_p"]
    assert table.loc["y1", "ljung_box_p"] < 0.001 < table.loc["y1", "ks_p"]
    assert table.loc["y2", "ks_p"] < 0.001
    np.testing.assert_allclose(table.loc["y0", ["mean", "sd"]], [wide.mean(), wide.std(ddof=1)])


def test_few_or_no_observations_give_nan_and_no_noise(recwarn):
    residual = np.full((20, 3), np.nan)
    residual[:5, 0] = 0.1
    residual[7, 1] = 0.3
    table = residual_tests(result_with(residual))
    assert list(table["count"]) == [5, 1, 0]
    assert table[["ks_p", "ljung_box_p"]].isna().all(axis=None)
    assert not recwarn.list


def test_mean_residuals(result, datasets):
    mean = mean_residuals(result)
    residual = datasets["one_step_ahead"]["residual"]
    assert mean.dims == ("time", "output")
    np.testing.assert_allclose(mean.values, residual.values.mean(axis=(0, 1)))
    with pytest.raises(ValueError, match="one_step_ahead"):
        mean_residuals(arviz_data.build({"posterior": datasets["posterior"]}))


def test_normal_scores_cover_ordered_normal_values():
    rng = np.random.default_rng(0)
    ordered = np.sort(rng.normal(size=(4000, 15)), axis=1)
    median, low, high = normal_scores(15)
    # Three standard errors of a median and of a 95% coverage from 4,000 draws.
    assert np.all(np.abs((ordered < median).mean(axis=0) - 0.5) < 3 * 0.5 / np.sqrt(4000))
    coverage = ((ordered > low) & (ordered < high)).mean(axis=0)
    assert np.all(np.abs(coverage - 0.95) < 3.5 * np.sqrt(0.95 * 0.05 / 4000))
    np.testing.assert_allclose(median, -median[::-1], atol=1e-12)
