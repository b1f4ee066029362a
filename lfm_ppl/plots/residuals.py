"""Figure of the one-step-ahead residuals: over time, against the normal, and their whiteness.

1. Left, the posterior mean of the residuals over time.
2. Middle, their quantiles against normal quantiles with a pointwise band.
3. Right, their autocorrelations with a 95% band, and the p-value of the Ljung-Box test.

Source: Ljung and Box (1978), Biometrika 65.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from lfm_ppl.plots import style
from lfm_ppl.plots.panels import finish, pick, series_views
from lfm_ppl.results.residuals import autocorrelation, default_lags, mean_residuals, normal_scores, residual_tests
from lfm_ppl.results.result_view import ResultView

MAX_OUTPUTS = 4
_ENVELOPE = "#DDDDDD"


@style.styled
def plot_residuals(result: Any, outputs: Sequence[str] | None = None, *, series: Any = None,
                   width: str | float = "column") -> Figure:
    """Draw the standardised one-step-ahead residuals of each output in three panels.

    Over time: posterior means, with the 95% interval over the draws as a thin bar, and the lines
    within which 95% of N(0, 1) lie. Normal Q-Q: with the pointwise 95% envelope of an N(0, 1)
    sample. Autocorrelation: with the 95% bounds of white noise. p-values stand above the panels. Of several series of a
    panel it draws the residuals over time, in one panel for each.

    Args:
        result: with the group one_step_ahead.
        outputs: names; None for all, up to 4.
        series: labels or positions of series of a panel; None for all, up to a dozen.
        width: "column" (3.4 in), "full" (7 in), or inches.

    Returns:
        A figure with three panels per output, or with one for each output of each series.

    Raises:
        ValueError: the group is missing, or an output is unknown.

    Example:
        >>> import xarray as xr
        >>> from lfm_ppl.results.arviz_data import build
        >>> residual = np.random.default_rng(0).normal(size=(1, 1, 50, 1))
        >>> scores = xr.Dataset({"residual": (("chain", "draw", "time", "output"), residual)})
        >>> scores = scores.assign_coords({"time": np.arange(50.0), "output": ["position"]})
        >>> figure = plot_residuals(build({"one_step_ahead": scores}))
        >>> [axes.get_title(loc="left") for axes in figure.axes]
        ['position', 'KS p = 0.56', 'Ljung-Box p = 0.11']
    """
    view = ResultView.of(result)
    residual = view.group("one_step_ahead")["residual"]
    names, note = style.first_of(pick(residual, "output", outputs), outputs, MAX_OUTPUTS, "outputs")
    views, remark = series_views(view, series, len(names))
    note = f"{remark} {note}"
    if len(views) > 1:
        return _draw_series(views, names, note, width)
    ((title, view),) = views.items()
    means, tests = mean_residuals(view), residual_tests(view)
    figure, rows = _panels(width, len(names))
    for name, (over_time, quantiles, lags) in zip(names, rows, strict=True):
        values = means.sel(output=name)
        _draw_over_time(over_time, view, name)
        over_time.set_title(f"{title}, {name}" if title else name, fontweight="bold")
        over_time.set_ylabel("residual (sd)")
        _draw_quantiles(quantiles, values.values, tests.loc[name])
        _draw_autocorrelation(lags, values.values, tests.loc[name])
    style.label_time([row[0] for row in rows], view.time_unit, view.time_origin)
    for row in rows if style.is_narrow(width) else rows[-1:]:
        row[1].set_xlabel("normal quantile")
        row[2].set_xlabel("lag (observations)")
    style.legend_above(figure)
    style.note_below(figure, note)
    return figure


def _draw_series(views: Mapping[str, ResultView], names: Sequence[str], note: str, width: str | float) -> Figure:
    """Draw the residuals over time of each output of each series."""
    figure, panels = style.small_multiples(width, len(views) * len(names), 1.25)
    for axes, (name, (title, view)) in zip(panels, itertools.product(names, views.items()), strict=True):
        _draw_over_time(axes, view, name)
        axes.set_title(f"{title}, {name}" if len(names) > 1 else title)
        axes.set_ylabel("residual (sd)")
    finish(figure, panels, view, note)
    return figure


def _panels(width: str | float, count: int) -> tuple[Figure, list[tuple[Axes, Axes, Axes]]]:
    narrow = style.is_narrow(width)
    figure = style.new_figure(width, (2.75 if narrow else 1.55) * count + 0.55)
    rows = []
    if narrow:
        grid = figure.add_gridspec(2 * count, 2, height_ratios=[1.0, 1.15] * count)
        panels = [(grid[2 * k, :], grid[2 * k + 1, 0], grid[2 * k + 1, 1]) for k in range(count)]
    else:
        grid = figure.add_gridspec(count, 3, width_ratios=[1.7, 1.0, 1.0])
        panels = [(grid[k, 0], grid[k, 1], grid[k, 2]) for k in range(count)]
    for number, panel in enumerate(panels):
        over_time, quantiles, lags = (figure.add_subplot(cell) for cell in panel)
        for axes in (over_time, quantiles, lags):
            style.tidy(axes)
        over_time.tick_params(labelbottom=narrow or number == count - 1)
        rows.append((over_time, quantiles, lags))
    return figure, rows


def _draw_over_time(axes: Axes, view: ResultView, name: str) -> None:
    """Draw the residuals of an output over time, of a result of one series."""
    draws = view.group("one_step_ahead")["residual"].transpose("chain", "draw", "time", "output").sel(output=name)
    series = mean_residuals(view).sel(output=name)
    times = series["time"].values
    axes.axhspan(-1.96, 1.96, color=_ENVELOPE, lw=0, zorder=0, label="95% if the model holds")
    axes.axhline(0.0, color=style.GREY, lw=0.6, zorder=1)
    reach = max(3.0, 1.1 * np.nanmax(np.abs(series.values), initial=0.0))
    if len(times) <= 200:
        bounds = np.quantile(draws.values, (0.025, 0.975), axis=(0, 1))
        axes.vlines(times, *bounds, color=style.SKY, lw=0.8, zorder=2)
        reach = max(reach, 1.05 * np.nanmax(np.abs(bounds), initial=0.0))
    size = 2.6 if len(times) <= 150 else 1.2
    axes.plot(times, series, color=style.BLUE, ls="", marker="o", ms=size, mew=0, zorder=3, label="posterior mean")
    pad = 0.03 * (times[-1] - times[0]) or 0.5
    axes.set_xlim(times[0] - pad, times[-1] + pad)  # the same for all outputs, missing or not
    axes.set_ylim(-reach, reach)


def _draw_quantiles(axes: Axes, series: np.ndarray, test: pd.Series) -> None:
    ordered = np.sort(series[np.isfinite(series)])
    median, low, high = normal_scores(len(ordered))
    axes.fill_between(median, low, high, color=_ENVELOPE, lw=0, zorder=0)
    axes.plot(median, median, color=style.GREY, lw=0.6, zorder=1)
    axes.plot(median, ordered, color=style.BLUE, ls="", marker="o", ms=2.2, mew=0, zorder=2)
    reach = 1.08 * np.max(median, initial=1.0)
    axes.set_xlim(-reach, reach)
    axes.set_ylabel("residual quantile")
    axes.set_title(_p_value("KS", test["ks_p"]))


def _draw_autocorrelation(axes: Axes, series: np.ndarray, test: pd.Series) -> None:
    count = int(test["count"])
    lags = min(max(default_lags(count), 10), max(count - 1, 1))
    rho, pairs = autocorrelation(series, lags) if count > 1 else (np.full(lags, np.nan), None)
    lag = np.arange(1, lags + 1)
    if pairs is not None:
        bound = 1.96 / np.sqrt(np.where(pairs, pairs, np.nan))
        axes.stairs(bound, np.arange(lags + 1) + 0.5, baseline=-bound, fill=True, color=_ENVELOPE, zorder=0)
        axes.vlines(lag, 0.0, rho, color=style.BLUE, lw=1.4, zorder=2)
    axes.axhline(0.0, color=style.GREY, lw=0.6, zorder=1)
    reach = max(0.6, 1.1 * np.nanmax(np.abs(rho), initial=0.0))
    axes.set_ylim(-reach, reach)
    axes.set_xlim(0.5, lags + 0.5)
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.set_ylabel("autocorrelation")
    axes.set_title(_p_value("Ljung-Box", test["ljung_box_p"]))


def _p_value(test: str, p: float) -> str:
    if not np.isfinite(p):
        return f"{test}: few data"
    return f"{test} p < 0.001" if p < 0.001 else f"{test} p = {p:.2g}"
