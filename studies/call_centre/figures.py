"""Figures of the study: queues and arrivals with their bands, arrivals day by day, and errors of all methods."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lfm_ppl.plots import style

from ..datasets import select_prefix
from ..declaration import Data
from ..drawing import TRUTH, band, legend, line, patch
from ..scores import Z, estimate_mean
from . import problem
from .counts import BIN, COUNTS_PER_DAY, DAY
from .problem import GRID, TEST_RATES, TRAINING_DAYS, CallWindow
from .tracking import QueueEstimate, customers

_SHADE: dict[str, Any] = {"color": style.BLUE, "alpha": 0.2, "label": "95%"}
_COUNTS: dict[str, Any] = {"color": style.BLACK, "lw": 0.5, "label": "counts"}
_COLOURS = (style.BLUE, style.GREEN, style.SKY, style.ORANGE, style.VERMILLION, style.PURPLE)


def draw(settings: Any, data: Data) -> dict[str, Figure]:
    """Return every figure by name."""
    first = problem.build_window(settings.data, settings.weekday, 0, settings.seed)
    return {**{f"queue-{test}": plot_queues(first, data, test) for test in TEST_RATES},
            "arrivals": plot_arrivals(first, data), "cycles": plot_cycles(first, data), "errors": plot_errors(data)}


def _draw_methods(width: str | float, data: Data, test: str, paint: Callable[[Axes, QueueEstimate], None]) -> Figure:
    """Draw one panel for each method: ``paint`` draws the method's estimate for the first window."""
    tracks = select_prefix(data["track"], test)
    figure, panels = style.small_multiples(width, tracks.sizes["method"], 1.5)
    for axes, method in zip(panels, tracks.method.values, strict=True):
        paint(axes, QueueEstimate(*(tracks[name].sel({"method": method}).values for name in QueueEstimate._fields)))
        axes.axvline(TRAINING_DAYS, color=style.GREY, lw=0.7, ls=":", label="end of training")
        axes.set_title(method)
    style.label_time(panels, "working days")
    legend(figure)
    return figure


@style.styled
def plot_queues(first: CallWindow, data: Data, test: str, *, width: str | float = "full") -> Figure:
    """Draw the queue of the first window: three days of training and the test day, as in figure 7 of the source."""
    is_reading, top = np.isfinite(first.y[test][:, 0]), 1.35 * first.queues[test].max()

    def paint(axes: Axes, estimate: QueueEstimate) -> None:
        low, median, high = (customers(estimate.log_queue + z * estimate.log_queue_sd) for z in (-Z, 0.0, Z))
        axes.plot(GRID / DAY, median, color=style.BLUE, lw=0.9, label="filter, median")
        axes.fill_between(GRID / DAY, low, np.minimum(high, 2 * top), lw=0, **_SHADE)
        axes.plot(GRID / DAY, first.queues[test], **TRUTH | {"label": "true queue"})
        axes.plot(GRID[is_reading] / DAY, np.expm1(first.y[test][is_reading, 0]), ls="", marker=".", ms=3,
                  color=style.VERMILLION, label="readings")
        axes.set_ylim(-0.03 * top, top)
        style.label_values(axes, "queue", "customers")

    figure, (morning, afternoon) = _draw_methods(width, data, test, paint), TEST_RATES[test]
    style.note_below(figure, f"Test day {first.date}, service rate {morning:g}, then {afternoon:g} per minute; the "
                             "filter's estimates, given the readings up to each time.")
    return figure


@style.styled
def plot_arrivals(first: CallWindow, data: Data, *, width: str | float = "full") -> Figure:
    """Draw the rate of arrivals in the first window, by method."""
    top = 1.4 * first.arrivals.max()

    def paint(axes: Axes, estimate: QueueEstimate) -> None:
        axes.plot(GRID / DAY, estimate.arrivals, color=style.BLUE, lw=0.9, label="filter")
        band(axes, GRID / DAY, estimate.arrivals, estimate.arrivals_sd, **_SHADE)
        axes.plot(GRID[1:] / DAY, first.arrivals, **_COUNTS)
        axes.set_ylim(-0.3 * top, top)
        style.label_values(axes, "arrivals", "1/min")

    return _draw_methods(width, data, "constant", paint)


@style.styled
def plot_cycles(first: CallWindow, data: Data, *, width: str | float = "full") -> Figure:
    """Draw the arrivals on each of the four days of the first window: counts, and the smoothed rate.

    The smoother uses all readings of the window at the service rate of training.
    """
    posterior = data["posterior"].isel(method=0)
    figure, panels = style.small_multiples(width, TRAINING_DAYS + 1, 1.6)
    hours = 7.0 + BIN * np.arange(1, COUNTS_PER_DAY + 1) / 60.0
    days = (entry.reshape(-1, COUNTS_PER_DAY) for entry in (
        posterior.shapes.values[1:], posterior.shapes_sd.values[1:], first.arrivals))
    top = 1.15 * max(first.arrivals.max(), posterior.shapes.max().item())
    for axes, mean, sd, arrivals, title in zip(panels, *days, ("day 1", "day 2", "day 3", "test day"), strict=True):
        axes.plot(hours, mean, color=style.BLUE, label=f"{posterior.method.item()}, smoothed")
        band(axes, hours, mean, sd, **_SHADE)
        axes.plot(hours, arrivals, **_COUNTS)
        axes.set(ylim=(0, top), title=title)
        style.label_values(axes, "arrivals", "1/min")
    style.label_time(panels, "hours after midnight")
    legend(figure)
    return figure


@style.styled
def plot_errors(data: Data, *, width: str | float = "full") -> Figure:
    """Draw the error of the queue on each test day by method, for both tests, and the coverage of the bands.

    Methods with marginalised parameters come last, in the colour of the method and with open markers.
    """
    figure, (*errors, coverage) = style.in_a_row(width, 3, 2.7)
    methods = list(data["track"].method.values)
    columns = [("track", name, name) for name in methods]
    columns += [("posterior", name, f"{name},\nintegrated") for name in data["posterior"].method.values]
    for x, (kind, method, _) in enumerate(columns):
        colour = _COLOURS[methods.index(method) % 6]
        properties: dict[str, Any] = {"color": colour, "mfc": "white" if kind == "posterior" else colour}
        for axes, test, shift, marker in zip(errors, TEST_RATES, (-0.12, 0.12), "os", strict=True):
            days = select_prefix(data[kind].sel({"method": method}), test)
            axes.semilogy(np.full(days.rmse.size, x), days.rmse, ls="", marker=".", ms=4, mew=0.6, **properties)
            axes.semilogy([x - 0.3, x + 0.3], [days.rmse.mean()] * 2, color=colour, lw=1.5)
            axes.set(title=f"{test} service rate", ylabel="RMSE of the queue (customers)")
            share = estimate_mean(days.coverage)
            coverage.errorbar(x + shift, share.value, share.error, marker=marker, ms=3.5, lw=0.8, mew=0.8,
                              **properties)
    coverage.axhspan(0.9, 0.98, color=style.GREY, alpha=0.15, lw=0)
    coverage.axhline(0.95, color=style.GREY, lw=0.7, ls=":")
    coverage.set(ylim=(min(0.5, coverage.get_ylim()[0]), 1.02), title="coverage", ylabel="share within 95% bands")
    for axes in (*errors, coverage):
        axes.set_xticks(range(len(columns)), [label for *_, label in columns], rotation=60, fontsize=style.SMALL)
        axes.set_xlim(-0.6, len(columns) - 0.4)
        axes.tick_params(labelsize=style.SMALL, length=2.5, width=0.6)
    legend(figure, line("a test day", style.GREY, "", marker=".", ms=3), line("mean", style.GREY, lw=1.5),
           line("constant", style.GREY, "", marker="o", ms=3.5),
           line("changed service rate", style.GREY, "", marker="s", ms=3.5),
           patch("90% to 98%", style.GREY, alpha=0.15))
    return figure
