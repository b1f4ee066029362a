"""Rates with their bands, held-out calls, and errors against the reference."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments.counts import problem, tables
from lfm_ppl.experiments.counts.methods import METHODS, REFERENCE
from lfm_ppl.experiments.drawing import SHADE, TRUTH, legend
from lfm_ppl.experiments.scores import Z
from lfm_ppl.results.plots import style

_COLOURS = {"ep": (style.BLUE, "o"), "variational": (style.GREEN, "s"), "laplace": (style.VERMILLION, "^")}
_DAYS = 2
"""Days of calls that are drawn."""


def draw(settings: Any, results: dict[str, Result]) -> dict[str, Figure]:
    """Return every figure by name; of problems that were left out there is none."""
    found = {"errors": plot_errors(settings, results)}
    if problem.COAL in settings.problems:
        found["coal"] = plot_coal(settings, results)
    if set(problem.CALLS) <= set(settings.problems):
        found["calls"] = plot_calls(settings, results)
    return found


def _of(settings: Any, name: str) -> problem.Problem:
    return problem.problem(name, settings.size, settings.seed, settings.data)


@style.styled
def plot_coal(settings: Any, results: dict[str, Result], *, width: str | float = "full") -> Figure:
    """Draw the disasters, and their rate by EP and by the reference."""
    one, found, exact = (_of(settings, problem.COAL), results[f"{problem.COAL}/ep"],
                         results[f"{problem.COAL}/{REFERENCE}"])
    per_year = 1.0 / float(np.median(np.diff(one.times)))
    figure = style.new_figure(width, 2.6)
    counted, rate = figure.subplots(2, 1, sharex=True, height_ratios=(1, 2.5))
    counted.vlines(one.times, 0, one.y[:, 0], color=style.GREY, lw=0.8)
    counted.set_ylabel("disasters")
    low, high = (np.exp(found["mean"] + sign * Z * found["sd"]) for sign in (-1, 1))
    rate.plot(one.times, np.exp(found["mean"]), color=style.BLUE, label="EP: median")
    rate.fill_between(one.times, low, high, color=SHADE, lw=0, label="95%")
    for sign in (-1, 0, 1):
        rate.plot(one.times, np.exp(exact["mean"] + sign * Z * exact["sd"]), **TRUTH | {"label": "reference"})
    rate.set_ylim(0.0, 1.05 * high.max())
    rate.set_ylabel("rate (1/year)")
    rate.set_xlabel(f"year; bins of {12 / per_year:.0f} months")
    for axes in (counted, rate):
        style.tidy(axes)
    legend(figure)
    return figure


@style.styled
def plot_calls(settings: Any, results: dict[str, Result], *, width: str | float = "full") -> Figure:
    """Draw the first days of calls, and the 95% intervals of each count that is held out with its two hours."""
    one = _of(settings, problem.CALLS[0])
    rows = slice(0, _DAYS * len(one.times) // settings.size.days)
    figure = style.new_figure(width, 3.6)
    panels = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
    for axes, name in zip(panels, problem.CALLS, strict=True):
        found = results[f"{name}/ep"]
        axes.fill_between(one.times[rows], found["low"][rows], found["high"][rows], color=SHADE, lw=0, step="mid",
                          label="95%, held out")
        axes.plot(one.times[rows], one.y[rows, 0], ".", color=style.BLACK, ms=2.5, label="calls")
        axes.set_title(name.removeprefix("calls-").replace("-daily", ", daily force").replace("-", " "),
                       fontsize=style.SMALL)
        axes.set_ylim(0.0, 1.6 * one.y[rows].max())
        style.tidy(axes)
    for axes in panels[2:]:
        axes.set_xlabel("hours of opening")
    for axes in panels[::2]:
        axes.set_ylabel("calls in 20 minutes")
    legend(figure)
    return figure


@style.styled
def plot_errors(settings: Any, results: dict[str, Result], *, width: str | float = "full") -> Figure:
    """Draw the errors of each method in every problem, on logarithmic axes; dotted: 0.2 in log Z, 0.05 sd, 3%."""
    table = tables.accuracy(settings, results)
    asked = {"less reference": (0.2, "error of log Z"), "mean": (0.05, "error of means (sd)"),
             "sd": (0.03, "error of sds (share)")}
    figure, panels = style.in_a_row(width, 3, 0.9 + 0.22 * len(settings.problems), sharey=True)
    for axes, (column, (bound, label)) in zip(panels, asked.items(), strict=True):
        axes.axvline(bound, color=style.GREY, ls=":", lw=0.8)
        for row, name in enumerate(settings.problems):
            for shift, (method, (colour, marker)) in zip((-0.2, 0.0, 0.2), _COLOURS.items(), strict=True):
                value = abs(table.loc[f"{name}, {METHODS[method]}", column])
                axes.plot(max(value, 1e-4), row + shift, marker, color=colour, ms=3.5, label=METHODS[method])
        axes.set_xscale("log")
        # Whole decades, so that two ticks have a number at least.
        low, high = axes.get_xlim()
        axes.set_xlim(10 ** np.floor(np.log10(low)), 10 ** np.ceil(np.log10(high)))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel(label)
        axes.tick_params(labelsize=style.SMALL)
    panels[0].set_yticks(range(len(settings.problems)), [name.replace("-", " ") for name in settings.problems])
    panels[0].invert_yaxis()
    legend(figure)
    return figure
