"""Figures of the study: rates with their bands, held-out calls, and errors against the reference."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from lfm_ppl.plots import style

from ..declaration import Data
from ..drawing import SHADE, TRUTH, legend
from ..scores import Z
from . import problem
from .methods import METHODS, REFERENCE, compare_methods

_STYLES = {"ep": (-0.2, style.BLUE, "o"), "variational": (0.0, style.GREEN, "s"),
           "laplace": (0.2, style.VERMILLION, "^")}
"""Method -> vertical shift, colour and marker."""

_DAYS = 2
"""Days of calls in the figure."""


def draw(settings: Any, data: Data) -> dict[str, Figure]:
    """Return the figures of the problems in the settings, by name."""
    figures = {"errors": plot_errors(settings, data)}
    if problem.COAL in settings.problems:
        figures["coal"] = plot_coal(settings, data)
    if set(problem.CALLS) <= set(settings.problems):
        figures["calls"] = plot_calls(settings, data)
    return figures


@style.styled
def plot_coal(settings: Any, data: Data, *, width: str | float = "full") -> Figure:
    """Draw the disasters, and their rate by EP and by the reference."""
    results = compare_methods(settings, data, problem.COAL)
    figure = style.new_figure(width, 2.6)
    count_axes, rate_axes = figure.subplots(2, 1, sharex=True, height_ratios=(1, 2.5))
    count_axes.vlines(results.times, 0, results.y, color=style.GREY, lw=0.8)
    (low, median, high), reference = (
        [np.exp(posterior["mean"] + z * posterior["sd"]) for z in (-Z, 0.0, Z)]
        for posterior in (results.sel({"method": method}) for method in ("ep", REFERENCE)))
    rate_axes.plot(results.times, median, color=style.BLUE, label="EP: median")
    rate_axes.fill_between(results.times, low, high, color=SHADE, lw=0, label="95%")
    for path in reference:
        rate_axes.plot(results.times, path, **TRUTH | {"label": "reference"})
    style.tidy(count_axes, ylabel="disasters")
    style.tidy(rate_axes, ylim=(0.0, 1.05 * high.max()), ylabel="rate (1/year)",
               xlabel=f"year; bins of {12 * np.median(np.diff(results.times)):.0f} months")
    legend(figure)
    return figure


@style.styled
def plot_calls(settings: Any, data: Data, *, width: str | float = "full") -> Figure:
    """Draw the first days of calls, and 95% predictive intervals of the counts, held out in blocks of two hours."""
    figure = style.new_figure(width, 3.6)
    panels = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
    for axes, name in zip(panels, problem.CALLS, strict=True):
        results = compare_methods(settings, data, name).sel({"method": "ep"})
        results = results.isel(dataset=slice(_DAYS * results.sizes["dataset"] // settings.size.days))
        axes.fill_between(results.times, results.low, results.high, color=SHADE, lw=0, step="mid",
                          label="95%, held out")
        axes.plot(results.times, results.y, ".", color=style.BLACK, ms=2.5, label="calls")
        title = name.removeprefix("calls-").replace("-daily", ", daily force").replace("-", " ")
        axes.set_title(title, fontsize=style.SMALL)
        style.tidy(axes, ylim=(0.0, 1.6 * results.y.max()), xlabel="hours of opening", ylabel="calls in 20 minutes")
        axes.label_outer()
    legend(figure)
    return figure


@style.styled
def plot_errors(settings: Any, data: Data, *, width: str | float = "full") -> Figure:
    """Draw the errors of each method in every problem, on logarithmic axes.

    Dotted lines mark errors of 0.2 in log Z, of 0.05 sd in means and of 3% in sds.
    """
    bounds = {"excess": (0.2, "error of log Z"), "mean error": (0.05, "error of means (sd)"),
              "sd error": (0.03, "error of sds (share)")}
    names = settings.problems
    comparisons = [compare_methods(settings, data, name) for name in names]
    figure, panels = style.in_a_row(width, 3, 0.9 + 0.22 * len(names), sharey=True)
    for axes, (error, (bound, label)) in zip(panels, bounds.items(), strict=True):
        axes.axvline(bound, color=style.GREY, ls=":", lw=0.8)
        for method, (shift, colour, marker) in _STYLES.items():
            values = [np.maximum(abs(results[error].sel({"method": method})), 1e-4) for results in comparisons]
            axes.plot(values, np.arange(len(names)) + shift, marker, color=colour, ms=3.5, label=METHODS[method])
        axes.set(xscale="log", xlabel=label)
        # Limits at powers of ten make sure that at least two ticks have labels.
        low, high = np.log10(axes.get_xlim())
        axes.set_xlim(10 ** np.floor(low), 10 ** np.ceil(high))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.tick_params(labelsize=style.SMALL)
    panels[0].set_yticks(range(len(names)), [name.replace("-", " ") for name in names])
    panels[0].invert_yaxis()
    legend(figure)
    return figure
