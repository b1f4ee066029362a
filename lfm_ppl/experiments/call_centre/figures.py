"""Queues and arrivals with their bands, arrivals day by day, and errors of all methods."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lfm_ppl.experiments.call_centre import problem
from lfm_ppl.experiments.call_centre.problem import BIN, DAY, GRID, OPEN, TESTED, TRAIN, Window
from lfm_ppl.experiments.call_centre.tracking import Tracked, customers
from lfm_ppl.experiments.datasets import select_prefix
from lfm_ppl.experiments.drawing import TRUTH, band, legend, line, patch
from lfm_ppl.experiments.scores import Z, mean_of
from lfm_ppl.experiments.study import Data
from lfm_ppl.results.plots import style

_SHADE: dict[str, Any] = {"color": style.BLUE, "alpha": 0.2, "label": "95%"}
_COUNTS: dict[str, Any] = {"color": style.BLACK, "lw": 0.5, "label": "counts"}
_COLOURS = (style.BLUE, style.GREEN, style.SKY, style.ORANGE, style.VERMILLION, style.PURPLE)


def draw(settings: Any, data: Data) -> dict[str, Figure]:
    """Return every figure by name."""
    first = problem.window(settings.data, settings.weekday, 0, settings.seed)
    return {**{f"queue-{test}": plot_queues(first, data, test) for test in TESTED},
            "arrivals": plot_arrivals(first, data), "cycles": plot_cycles(first, data), "errors": plot_errors(data)}


def _by_method(width: str | float, data: Data, test: str, paint: Callable[[Axes, Tracked], None]) -> Figure:
    """Draw a panel for each method, in which its estimates of the first window are painted."""
    found = select_prefix(data["track"], test)
    figure, panels = style.small_multiples(width, found.sizes["method"], 1.5)
    for axes, method in zip(panels, found.method.values, strict=True):
        paint(axes, Tracked(*(found[name].sel({"method": method}).values for name in Tracked._fields)))
        axes.axvline(TRAIN, color=style.GREY, lw=0.7, ls=":", label="end of training")
        axes.set_title(method)
    style.label_time(panels, "working days")
    legend(figure)
    return figure


@style.styled
def plot_queues(first: Window, data: Data, test: str, *, width: str | float = "full") -> Figure:
    """Draw the queue of the first window: three days of training and the tracked one, as in figure 7 of the source."""
    read, top = np.isfinite(first.y[test][:, 0]), 1.35 * first.queues[test].max()

    def paint(axes: Axes, tracked: Tracked) -> None:
        low, middle, high = (customers(tracked.log_queue + z * tracked.log_queue_sd) for z in (-Z, 0.0, Z))
        axes.plot(GRID / DAY, middle, color=style.BLUE, lw=0.9, label="filter, median")
        axes.fill_between(GRID / DAY, low, np.minimum(high, 2 * top), lw=0, **_SHADE)
        axes.plot(GRID / DAY, first.queues[test], **TRUTH | {"label": "true queue"})
        axes.plot(GRID[read] / DAY, np.expm1(first.y[test][read, 0]), ls="", marker=".", ms=3, color=style.VERMILLION,
                  label="readings")
        axes.set_ylim(-0.03 * top, top)
        style.label_values(axes, "queue", "customers")

    figure, (morning, afternoon) = _by_method(width, data, test, paint), TESTED[test]
    style.note_below(figure, f"Test day {first.date}, service rate {morning:g}, then {afternoon:g} per minute; the "
                             "filter's estimates, given the readings up to each time.")
    return figure


@style.styled
def plot_arrivals(first: Window, data: Data, *, width: str | float = "full") -> Figure:
    """Draw the rate of arrivals in the first window, by method."""
    top = 1.4 * first.arrivals.max()

    def paint(axes: Axes, tracked: Tracked) -> None:
        axes.plot(GRID / DAY, tracked.arrivals, color=style.BLUE, lw=0.9, label="filter")
        band(axes, GRID / DAY, tracked.arrivals, tracked.arrivals_sd, **_SHADE)
        axes.plot(GRID[1:] / DAY, first.arrivals, **_COUNTS)
        axes.set_ylim(-0.3 * top, top)
        style.label_values(axes, "arrivals", "1/min")

    return _by_method(width, data, "constant", paint)


@style.styled
def plot_cycles(first: Window, data: Data, *, width: str | float = "full") -> Figure:
    """Draw the arrivals of the four days of the first window one by one: counts, and what the smoother makes of them.

    The smoother has all readings of the window at the service rate of training.
    """
    found = data["posterior"].isel(method=0)
    figure, panels = style.small_multiples(width, TRAIN + 1, 1.6)
    hours = 7.0 + BIN * np.arange(1, OPEN + 1) / 60.0
    days = (entry.reshape(-1, OPEN) for entry in (found.shapes.values[1:], found.shapes_sd.values[1:], first.arrivals))
    top = 1.15 * max(first.arrivals.max(), found.shapes.max().item())
    for axes, mean, sd, arrivals, title in zip(panels, *days, ("day 1", "day 2", "day 3", "test day"), strict=True):
        axes.plot(hours, mean, color=style.BLUE, label=f"{found.method.item()}, smoothed")
        band(axes, hours, mean, sd, **_SHADE)
        axes.plot(hours, arrivals, **_COUNTS)
        axes.set(ylim=(0, top), title=title)
        style.label_values(axes, "arrivals", "1/min")
    style.label_time(panels, "hours after midnight")
    legend(figure)
    return figure


@style.styled
def plot_errors(data: Data, *, width: str | float = "full") -> Figure:
    """Draw the error of the queue on each test day by method, at both service rates, and the coverage of the bands.

    Methods whose parameters are marginalised come last, in the colour of the method and with open markers.
    """
    figure, (*errors, coverage) = style.in_a_row(width, 3, 2.7)
    methods = list(data["track"].method.values)
    shown = [("track", name, name) for name in methods]
    shown += [("posterior", name, f"{name},\nintegrated") for name in data["posterior"].method.values]
    for place, (what, method, _) in enumerate(shown):
        colour = _COLOURS[methods.index(method) % 6]
        look: dict[str, Any] = {"color": colour, "mfc": "white" if what == "posterior" else colour}
        for axes, test, shift, marker in zip(errors, TESTED, (-0.12, 0.12), "os", strict=True):
            found = select_prefix(data[what].sel({"method": method}), test)
            axes.semilogy(np.full(found.rmse.size, place), found.rmse, ls="", marker=".", ms=4, mew=0.6, **look)
            axes.semilogy([place - 0.3, place + 0.3], [found.rmse.mean()] * 2, color=colour, lw=1.5)
            axes.set(title=f"{test} service rate", ylabel="RMSE of the queue (customers)")
            share = mean_of(found.coverage)
            coverage.errorbar(place + shift, share.value, share.error, marker=marker, ms=3.5, lw=0.8, mew=0.8, **look)
    coverage.axhspan(0.9, 0.98, color=style.GREY, alpha=0.15, lw=0)
    coverage.axhline(0.95, color=style.GREY, lw=0.7, ls=":")
    coverage.set(ylim=(min(0.5, coverage.get_ylim()[0]), 1.02), title="coverage", ylabel="share within 95% bands")
    for axes in (*errors, coverage):
        axes.set_xticks(range(len(shown)), [label for *_, label in shown], rotation=60, fontsize=style.SMALL)
        axes.set_xlim(-0.6, len(shown) - 0.4)
        axes.tick_params(labelsize=style.SMALL, length=2.5, width=0.6)
    legend(figure, line("a test day", style.GREY, "", marker=".", ms=3), line("mean", style.GREY, lw=1.5),
           line("constant", style.GREY, "", marker="o", ms=3.5),
           line("changed service rate", style.GREY, "", marker="s", ms=3.5),
           patch("90% to 98%", style.GREY, alpha=0.15))
    return figure
