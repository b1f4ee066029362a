"""Figure of the accuracy report: log ratios, and densities before and after the correction.

1. Log ratio of reference and filter against the log likelihood of the filter, with the noise of the reference.
2. For each parameter the density of all draws, and the density changed by the weights of the checked draws.

Source: Silverman (1986), Density Estimation, section 2.10.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lfm_ppl.accuracy.report import AccuracyReport
from lfm_ppl.plots import style
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.results.scalars import choose

MAX_PANELS = 11
_BELOW = -30.0
"""Log weights, relative to the largest, that a drawing cannot tell from zero."""


@style.styled
def plot_accuracy(result: Any, parameters: Sequence[str] | None = None, *, width: str | float = "column") -> Figure:
    """Draw the report of `lfm_ppl.check_accuracy`.

    First the error of the filter, exact log likelihood minus that of the filter, for each checked draw against the
    filter's log likelihood, both relative to their mean: a level cloud leaves the posterior as it is, a slope or a
    curve moves it. The Pareto shape k of the weights exp(error) stands above. Then, for each scalar parameter, the
    density of the Gaussian filter's posterior (all draws) and that of the corrected one (weighted draws), the means of
    both, and the true value where it is known. The corrected one is dashed, and its mean left out, where the weights
    cannot be relied on.

    Args:
        result: with the groups posterior and accuracy, and truth where there is one.
        parameters: names such as ``decay`` or ``decay[CDKN1A]``; None for all that vary, up to 11.
        width: "column" (3.4 in), "full" (7 in), or inches.

    Returns:
        A figure with the panel of the ratios and one panel per scalar parameter.

    Raises:
        ValueError: there is no report, or a parameter is unknown.
    """
    view = ResultView.of(result)
    report, draws = AccuracyReport.of(view), view.draws
    labels, note = style.first_of(choose(draws, parameters), parameters, MAX_PANELS, "parameters")
    truth, units, table = view.truth, view.units, report.table
    columns = 2 if style.is_narrow(width) else 3
    rows = math.ceil((len(labels) + 1) / columns)
    figure = style.new_figure(width, 1.2 * rows + 0.6)
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    for spare in panels[len(labels) + 1 :]:
        spare.remove()
    for axes in panels[: len(labels) + 1]:
        style.tidy(axes, x_ticks=3, y_ticks=3)
    _draw_ratios(panels[0], report)
    checked_columns = np.searchsorted(view.posterior["draw"].values, report.dataset["draw"].values)
    weight = np.exp(report.log_weight).ravel()
    line = {"ls": "-", "label": "corrected posterior"} if report.reliable else {
        "ls": (0, (2.5, 1.2)), "label": "corrected posterior, not reliable"}
    for axes, label in zip(panels[1:], labels, strict=False):
        _draw_densities(axes, draws[label], draws[label][:, checked_columns].ravel(), weight, line)
        if label in table.index and report.reliable:
            _mark_means(axes, table.loc[label, "mean"], table.loc[label, "corrected_mean"])
        if label in truth:
            axes.axvline(truth[label], **style.TRUTH)
        unit = f"{style.scale(axes.xaxis)} {units.get(label, '')}".strip()
        axes.set_xlabel(style.with_unit(label, unit, 24))
    style.legend_above(figure)
    style.note_below(figure, f"{_explanation(report)} {note}")
    return figure


def _draw_ratios(axes: Axes, report: AccuracyReport) -> None:
    filtered, ratio = report.dataset["log_likelihood"].values.ravel(), report.log_ratio.ravel()
    seen = np.isfinite(ratio)
    x, y = filtered[seen] - filtered[seen].mean(), ratio[seen] - ratio[seen].mean()
    axes.axhline(0.0, color=style.GREY, lw=0.6)
    sd = report.dataset["noise_sd"].values.ravel()[seen]
    if np.nanmax(sd) > 0.0:
        sd = np.where(np.isfinite(sd), sd, 0.0)
        axes.errorbar(x, y, yerr=sd, fmt="none", ecolor=style.SKY, elinewidth=0.4, zorder=1)
    axes.plot(x, y, color=style.BLUE, ls="", marker="o", ms=1.8, mew=0, alpha=0.6, zorder=2, label="draw")
    if np.ptp(y) < 1e-6:
        axes.set_ylim(-1.0, 1.0)
    axes.set_xlabel("log likelihood, filter")
    axes.set_ylabel("exact − filter")
    axes.set_title("exact filter" if report.exact else f"k = {report.k:.2f} (limit {report.threshold:.2f})")


def _draw_densities(axes: Axes, values: np.ndarray, subset: np.ndarray, weight: np.ndarray,
                    line: dict[str, Any]) -> None:
    flat = values.ravel()
    grid = np.linspace(*_range(flat, subset, weight), 200)
    support = flat.min(), flat.max()
    density = _density(grid, flat, np.full(flat.size, 1.0 / flat.size), support)
    width = _bandwidth(subset, weight, grid)
    # What the weights change on the subset, as for the moments: the subset's own chance cancels.
    equal = np.full(subset.size, 1.0 / subset.size)
    change = _density(grid, subset, weight, support, width) - _density(grid, subset, equal, support, width)
    axes.fill_between(grid, density, color=style.SKY, alpha=0.5, lw=0, label="posterior of the filter")
    axes.plot(grid, np.maximum(density + change, 0.0), color=style.VERMILLION, lw=1.1, **line)
    axes.set_ylim(0.0, None)
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)


def _range(values: np.ndarray, subset: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Return the interval to draw: within the draws, which keep to the support of the parameter."""
    low, high = np.quantile(values, (0.005, 0.995))
    used = subset[weight > weight.max() * np.exp(_BELOW)]
    low, high = min(low, np.quantile(used, 0.005)), max(high, np.quantile(used, 0.995))
    room = 0.12 * (high - low)
    return max(low - room, values.min()), min(high + room, values.max())


def _bandwidth(values: np.ndarray, weight: np.ndarray, grid: np.ndarray) -> float:
    """Return Silverman's bandwidth for weighted values."""
    sd = np.sqrt(weight @ (values - weight @ values) ** 2)
    return max(1.06 * sd * (weight**2).sum() ** 0.2, 1e-3 * (grid[-1] - grid[0]))


def _density(grid: np.ndarray, values: np.ndarray, weight: np.ndarray, support: tuple[float, float],
             bandwidth: float | None = None) -> np.ndarray:
    """Return a Gaussian kernel density estimate, reflected at both ends so that it keeps its mass in between.

    Source: Silverman (1986), Density Estimation, section 2.10.
    """
    bandwidth = bandwidth or _bandwidth(values, weight, grid)
    total = np.zeros_like(grid)
    for points in (grid, 2.0 * support[0] - grid, 2.0 * support[1] - grid):
        total += np.exp(-0.5 * ((points[:, None] - values) / bandwidth) ** 2) @ weight
    return total / (bandwidth * np.sqrt(2.0 * np.pi))


def _mark_means(axes: Axes, posterior_mean: float, corrected_mean: float) -> None:
    """Mark the means under the densities."""
    where = axes.get_xaxis_transform()
    for mean, colour in ((posterior_mean, style.BLUE), (corrected_mean, style.VERMILLION)):
        axes.plot(mean, 0.04, color=colour, marker="^", ms=4, mew=0, ls="", transform=where, zorder=4, label="mean")


def _explanation(report: AccuracyReport) -> str:
    """Return how to read the figure."""
    if report.exact:
        return "The filter is exact for this model: there is nothing to correct."
    error = ("First panel: log likelihood of checked draws, each axis relative to its mean. Where the cloud is level, "
             "the error of the filter does not change the posterior.")
    if report.reliable:
        return f"{error} k below its limit: the corrected posteriors can be relied on."
    return f"{error} k above its limit: the weights fail, and the corrected posteriors cannot be relied on."
