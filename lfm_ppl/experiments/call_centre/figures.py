"""Queues and arrivals with their bands, arrivals day by day, and errors of all methods."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments.call_centre import counts, posterior, problem, tables, tracking
from lfm_ppl.experiments.call_centre.problem import BIN, DAY, GRID, OPEN, TESTED, TRAIN
from lfm_ppl.experiments.call_centre.tracking import Tracked
from lfm_ppl.experiments.drawing import TRUTH, band, legend, line, patch
from lfm_ppl.experiments.scores import Z, mean_of
from lfm_ppl.results.plots import style

_TRUTH, _ESTIMATE, _READING = style.BLACK, style.BLUE, style.VERMILLION
_END: dict[str, Any] = {"color": style.GREY, "lw": 0.7, "ls": ":", "label": "end of training"}
_COLOURS = (style.BLUE, style.GREEN, style.SKY, style.ORANGE, style.VERMILLION, style.PURPLE)


def draw(settings: Any, results: dict[str, Result]) -> dict[str, Figure]:
    """Return every figure by name."""
    return {"queue-constant": plot_queues(settings, results, "constant"),
            "queue-changed": plot_queues(settings, results, "changed"),
            "arrivals": plot_arrivals(settings, results), "cycles": plot_cycles(settings, results),
            "errors": plot_errors(settings, results)}


def _first(settings: Any) -> problem.Window:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", counts.OverloadWarning)
        return problem.window(settings.data, settings.weekday, 0, settings.seed)


def _estimates(settings: Any, results: dict[str, Result], test: str) -> dict[str, Tracked]:
    found = {}
    for task in tracking.tasks(settings):
        one = results[task.name]
        found[task.settings["method"]] = Tracked(*(one[f"{test}_{key}"] for key in Tracked._fields))
    return found


@style.styled
def plot_queues(settings: Any, results: dict[str, Result], test: str, *, width: str | float = "full") -> Figure:
    """Draw the queue of the first window, as figure 7 of the source does: three days of training and the tracked one.

    Args:
        settings: of the experiment.
        results: of its tasks.
        test: "constant" or "changed".
        width: "column" (3.4 in), "full" (7 in), or inches.
    """
    one, found = _first(settings), _estimates(settings, results, test)
    figure, panels = style.small_multiples(width, len(found), 1.5)
    days = GRID / DAY
    read = np.isfinite(one.y[test][:, 0])
    top = 1.35 * one.queues[test].max()
    for axes, (method, estimate) in zip(panels, found.items(), strict=True):
        axes.plot(days, estimate.queue(), color=_ESTIMATE, lw=0.9, label="filter, median")
        axes.fill_between(days, estimate.queue(-Z), np.minimum(estimate.queue(Z), 2 * top), color=_ESTIMATE, alpha=0.2,
                          lw=0, label="95%")
        axes.plot(days, one.queues[test], **TRUTH | {"label": "true queue"})
        axes.plot(days[read], np.expm1(one.y[test][read, 0]), ls="", marker=".", ms=3, color=_READING, label="readings")
        axes.axvline(TRAIN, **_END)
        axes.set_ylim(-0.03 * top, top)
        axes.set_title(method)
        style.label_values(axes, "queue", "customers")
    style.label_time(panels, "working days")
    legend(figure)
    first, second = TESTED[test]
    style.note_below(figure, f"Test day {one.date}, service rate {first:g}, then {second:g} per minute; the filter's "
                             "estimates, given the readings up to each time.")
    return figure


@style.styled
def plot_arrivals(settings: Any, results: dict[str, Result], *, width: str | float = "full") -> Figure:
    """Draw the rate of arrivals in the first window, by method."""
    one, found = _first(settings), _estimates(settings, results, "constant")
    figure, panels = style.small_multiples(width, len(found), 1.5)
    top = 1.4 * one.arrivals.max()
    for axes, (method, estimate) in zip(panels, found.items(), strict=True):
        mean, sd = estimate.arrivals, estimate.arrivals_sd
        axes.plot(GRID / DAY, mean, color=_ESTIMATE, lw=0.9, label="filter")
        band(axes, GRID / DAY, mean, sd, color=_ESTIMATE, alpha=0.2, label="95%")
        axes.plot(GRID[1:] / DAY, one.arrivals, color=_TRUTH, lw=0.5, label="counts")
        axes.axvline(TRAIN, **_END)
        axes.set_ylim(-0.3 * top, top)
        axes.set_title(method)
        style.label_values(axes, "arrivals", "1/min")
    style.label_time(panels, "working days")
    legend(figure)
    return figure


@style.styled
def plot_cycles(settings: Any, results: dict[str, Result], *, width: str | float = "full") -> Figure:
    """Draw the arrivals of the four days of the first window one by one: counts, and what the smoother makes of them.

    The smoother has all readings of the window at the service rate of training.
    """
    one = _first(settings)
    task = posterior.tasks(settings)[0]
    mean, sd = results[task.name]["shapes"], results[task.name]["shapes_sd"]
    figure, panels = style.small_multiples(width, TRAIN + 1, 1.6)
    hours = 7.0 + BIN * np.arange(1, OPEN + 1) / 60.0
    for day, axes in enumerate(panels):
        own = slice(day * OPEN + 1, (day + 1) * OPEN + 1)
        axes.plot(hours, mean[own], color=_ESTIMATE, label=f"{settings.integrated[0]}, smoothed")
        band(axes, hours, mean[own], sd[own], color=_ESTIMATE, alpha=0.2, label="95%")
        axes.plot(hours, one.arrivals[day * OPEN:(day + 1) * OPEN], color=_TRUTH, lw=0.5, label="counts")
        axes.set_ylim(0, 1.15 * max(one.arrivals.max(), mean.max()))
        axes.set_title("test day" if day == TRAIN else f"day {day + 1}")
        style.label_values(axes, "arrivals", "1/min")
    style.label_time(panels, "hours after midnight")
    legend(figure)
    return figure


@style.styled
def plot_errors(settings: Any, results: dict[str, Result], *, width: str | float = "full") -> Figure:
    """Draw the error of the queue on each test day by method, at both service rates, and the coverage of the bands.

    Methods whose parameters are integrated out come last, in the colour of the method and with open markers.
    """
    figure, panels = style.in_a_row(width, 3, 2.7)
    whole = {tables.INTEGRATED.format(method): method for method in settings.integrated}
    drawn = []
    for name, found in tables.by_method(settings, results).items():
        colour = _COLOURS[settings.methods.index(whole.get(name, name)) % 6]
        drawn.append((found, colour, "white" if name in whole else colour))
    names = [*settings.methods, *(f"{method},\nintegrated" for method in settings.integrated)]
    for axes, test in zip(panels, TESTED, strict=False):
        for place, (found, colour, face) in enumerate(drawn):
            values = found[f"{test}_rmse"]
            axes.semilogy(np.full(len(values), place), values, ls="", marker=".", ms=4, color=colour, mfc=face, mew=0.6)
            axes.semilogy([place - 0.3, place + 0.3], [values.mean()] * 2, color=colour, lw=1.5)
        axes.set_title(f"{test} service rate")
        axes.set_ylabel("RMSE of the queue (customers)")
    for place, (found, colour, face) in enumerate(drawn):
        for shift, marker, test in ((-0.12, "o", "constant"), (0.12, "s", "changed")):
            share = mean_of(found[f"{test}_coverage"])
            panels[2].errorbar(place + shift, share.value, share.error, marker=marker, ms=3.5, lw=0.8, color=colour,
                               mfc=face, mew=0.8)
    panels[2].axhspan(0.9, 0.98, color=style.GREY, alpha=0.15, lw=0)
    panels[2].axhline(0.95, color=style.GREY, lw=0.7, ls=":")
    panels[2].set_ylim(min(0.5, panels[2].get_ylim()[0]), 1.02)
    panels[2].set_title("coverage")
    panels[2].set_ylabel("share within 95% bands")
    for axes in panels:
        axes.set_xticks(range(len(names)), names, rotation=60, fontsize=style.SMALL)
        axes.set_xlim(-0.6, len(names) - 0.4)
        axes.tick_params(labelsize=style.SMALL, length=2.5, width=0.6)
    legend(figure, line("a test day", style.GREY, "", marker=".", ms=3), line("mean", style.GREY, lw=1.5),
           line("constant", style.GREY, "", marker="o", ms=3.5),
           line("changed service rate", style.GREY, "", marker="s", ms=3.5),
           patch("90% to 98%", style.GREY, alpha=0.15))
    return figure
