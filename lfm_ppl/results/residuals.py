"""Tests of the one-step-ahead residuals, which are standard normal and white under the model.

1. Average the standardised residuals over the draws.
2. Test mean, variance and normality, and whiteness by the Ljung-Box test, output by output.
3. `misfit` returns one message for each rejection.

Source: Ljung and Box (1978), Biometrika 65.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from scipy import stats

from lfm_ppl.results.result_view import ResultView

MIN_OBSERVATIONS = 8
_FAR, _RARE = 3.0, 1e-3


def mean_residuals(result: Any) -> xr.DataArray:
    """Return the posterior mean of the standardised one-step-ahead residuals (time, output).

    A residual is e_k = L_k^-1 (y_k - E[y_k | y_1..k-1, theta]), with L_k L_k' the predictive
    covariance, or the randomised quantile residual of an observation family. Where the model holds,
    e_k is independent N(0, 1). NaN stands for a missing value.

    Raises:
        ValueError: the group is missing.
    """
    residual = ResultView.of(result).group("one_step_ahead")["residual"]
    return residual.mean(("chain", "draw"), skipna=False).transpose("time", "output")


def autocorrelation(residual: np.ndarray, lags: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the autocorrelation of a series with gaps, and how many pairs each lag has.

    rho_h = mean of (e_k - m)(e_k+h - m) over the pairs of present values, divided by the mean of (e_k - m)^2. Lags
    count rows, also where rows are not equally spaced in time. For an output that is present in fewer than half of the
    rows, or that has hardly any pairs at some lag (an output measured every second row), lags count its observations.

    Args:
        residual: shape (T,), NaN where missing.
        lags: the largest lag.

    Returns:
        rho and the number of pairs, both of shape (lags,), for lags 1, 2, ...; rho is NaN for a
        lag without pairs.
    """
    is_finite = np.isfinite(residual)
    shifts = np.arange(1, min(lags, is_finite.sum() - 1) + 1)
    if is_finite.mean() < 0.5 or any(4 * (is_finite[:-shift] & is_finite[shift:]).sum() < is_finite.sum() - shift
                                     for shift in shifts):
        residual = residual[is_finite]
    centred = residual - np.nanmean(residual)
    variance = np.nanmean(centred**2)
    rho, pairs = np.full(lags, np.nan), np.zeros(lags, int)
    for lag in range(1, min(lags, len(residual) - 1) + 1):
        products = centred[:-lag] * centred[lag:]
        pairs[lag - 1] = np.isfinite(products).sum()
        if pairs[lag - 1] and variance > 0:
            rho[lag - 1] = np.nanmean(products) / variance
    return rho, pairs


def ljung_box(residual: np.ndarray, lags: int) -> float:
    """Return the p-value of the Ljung-Box test of whiteness of residuals (T,), NaN where missing.

    Q = n (n + 2) sum_h r_h^2 / (n - h) is chi-squared with ``lags`` degrees of freedom for white
    residuals, where r_h = (1 - h / n) rho_h; with gaps the number of pairs replaces n - h.
    Source: Ljung and Box (1978), Biometrika 65(2), eq. 1.2.
    """
    rho, pairs = autocorrelation(residual, lags)
    count = np.isfinite(residual).sum()
    is_finite = np.isfinite(rho)
    if not is_finite.any():
        return float("nan")
    statistic = (count + 2) / count * np.sum(pairs[is_finite] * rho[is_finite] ** 2)
    return float(stats.chi2.sf(statistic, is_finite.sum()))


def residual_tests(result: Any) -> pd.DataFrame:
    """Return, for each output, whether its residuals look standard normal and white.

    Returns:
        One row per output: count, mean, sd, ks_p (Kolmogorov-Smirnov against N(0, 1)), ljung_box_p
        and lags. The p-values take the parameters as known, and so are a little too large. They
        are NaN below 8 observations.

    Raises:
        ValueError: the group one_step_ahead is missing.
    """
    residual = mean_residuals(result)
    rows = {}
    for name in residual["output"].values:
        series = residual.sel(output=name).values
        finite = series[np.isfinite(series)]
        count = len(finite)
        lags = default_lags(count)
        enough = count >= MIN_OBSERVATIONS
        rows[str(name)] = {
            "count": count,
            "mean": finite.mean() if count else np.nan,
            "sd": finite.std(ddof=1) if count > 1 else np.nan,
            "ks_p": stats.kstest(finite, "norm").pvalue if enough else np.nan,
            "ljung_box_p": ljung_box(series, lags) if enough else np.nan,
            "lags": lags,
        }
    frame = pd.DataFrame.from_dict(rows, orient="index")
    return frame.astype({"count": int, "lags": int})


def misfit(result: Any) -> list[str]:
    """Return what the residuals say against the model, one message for each finding.

    Findings are those that a right model gives once in a thousand results: residuals beyond three standard deviations,
    the Kolmogorov-Smirnov and the Ljung-Box test. Nothing is said of a panel, and of a result whose residuals are those
    of another filter than its posterior: under constraints, and by a particle filter.
    """
    view = ResultView.of(result)
    is_approximate = "constraints" in view.attrs or str(view.attrs.get("sampler", "")).startswith("pmmh")
    if is_approximate or "one_step_ahead" not in view.groups or view.series_dimension is not None:
        return []
    remedy = "" if "factors" in view.attrs else " (lfm.StudentTObservation)"
    messages, residual, tests = [], mean_residuals(view), residual_tests(view)
    for index in range(residual.sizes["output"]):
        name, test = tests.index[index], tests.iloc[index]
        series = residual.isel(output=index).values
        series = series[np.isfinite(series)]
        count, beyond = len(series), int((np.abs(series) > _FAR).sum())
        share = 2.0 * stats.norm.sf(_FAR)
        if count >= MIN_OBSERVATIONS and beyond > 1 and stats.binom.sf(beyond - 1, count, share) < _RARE:
            messages.append(f"{beyond} of {count} residuals of {name} lie beyond {_FAR:g} sd, where "
                            f"{count * share:.2g} are expected: gross errors{remedy}, or a missing effect. See "
                            "residuals.png.")
        elif test["ks_p"] < _RARE:
            messages.append(f"the residuals of {name} are not standard normal (KS p = {test['ks_p']:.1g}): the bands "
                            "of new data are too wide or too narrow. See residuals.png.")
        if test["ljung_box_p"] < _RARE:
            messages.append(f"the residuals of {name} are autocorrelated (Ljung-Box p = {test['ljung_box_p']:.1g}): "
                            "the model misses something that lasts. See residuals.png.")
    return messages


def default_lags(count: int) -> int:
    """Return how many lags ``count`` observations can support: a fifth of them, 1 to 20."""
    return int(np.clip(count // 5, 1, 20))


def normal_scores(count: int, level: float = 0.95) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where ``count`` ordered N(0, 1) values are expected, with a pointwise interval.

    The i-th smallest of n uniform values is Beta(i, n + 1 - i): its median and its quantiles are
    carried to the normal scale.

    Returns:
        Median, lower and upper end, each of shape (count,).
    """
    i = np.arange(1, count + 1)
    tail = (1.0 - level) / 2.0
    quantiles = [stats.beta.ppf(q, i, count + 1 - i) for q in (0.5, tail, 1.0 - tail)]
    median, low, high = stats.norm.ppf(quantiles)
    return median, low, high
