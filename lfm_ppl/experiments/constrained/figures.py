"""Forces with their estimates and bands, errors, a target's paths, and the TRH of a patient."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments.constrained import estimators, problem, tables
from lfm_ppl.experiments.drawing import SHADE, TRUTH, legend
from lfm_ppl.results.plots import style


def draw(settings: Any, results: dict[str, Result]) -> dict[str, Figure]:
    """Return every figure by name."""
    return {"forces": plot_forces(settings, results), "errors": plot_errors(settings, results),
            "target": plot_target(settings, results), "patient": plot_patient(settings, results),
            "peaks": plot_peaks(settings, results)}


@style.styled
def plot_forces(settings: Any, results: dict[str, Result], *, width: str | float = "column") -> Figure:
    """Draw the first force of each shape, as the source's estimator and full information see it, with its band."""
    figure = style.new_figure(width, 1.25 * len(settings.shapes) + 0.6)
    panels = figure.subplots(len(settings.shapes), 1, sharex=True, squeeze=False)[:, 0]
    for axes, shape in zip(panels, settings.shapes, strict=True):
        found = results[f"transcription/{shape.replace(' ', '-')}/0000"]
        _, low, high = found[f"{estimators.BANDS}/first"]
        axes.fill_between(problem.TIMES[:: estimators.ROWS[estimators.BANDS]], low, high, color=SHADE, lw=0,
                          label="95% band (EP)")
        if estimators.HORIZON in settings.methods:
            axes.plot(problem.TIMES, found[f"{estimators.HORIZON}/first"][0], color=style.ORANGE, lw=0.8,
                      label=estimators.HORIZON)
        axes.plot(problem.TIMES, found[f"{estimators.FULL}/first"][0], color=style.BLUE, label=estimators.FULL)
        axes.plot(problem.TIMES, found["truth"], **TRUTH)
        axes.set_title(shape)
        axes.set_ylabel("force")
        axes.set_xlim(0.0, problem.TIMES[-1])
        style.tidy(axes)
    panels[-1].set_xlabel("time (s)")
    legend(figure)
    return figure


@style.styled
def plot_errors(settings: Any, results: dict[str, Result], *, width: str | float = "column") -> Figure:
    """Draw the mean squared errors of the force of all records, beside the published ones."""
    figure = style.new_figure(width, 2.6)
    axes = figure.subplots()
    errors = [tables.gathered(results, "transcription", f"{method}/mse") for method in settings.methods]
    for row, mse in enumerate(errors):
        least, low, median, high, largest = np.quantile(mse, [0.0, 0.25, 0.5, 0.75, 1.0])
        axes.hlines(row, least, largest, color=style.BLUE, lw=0.8)
        axes.hlines(row, low, high, color=style.BLUE, lw=4.0)
        axes.plot(median, row, color=style.BLACK, marker="|", ms=7.0, ls="")
    for colour, line, published in ((style.BLACK, ":", "smoother"), (style.ORANGE, "--", "delayed MHE")):
        axes.axvline(problem.PUBLISHED[published], color=colour, ls=line, lw=1.0, label=f"published, {published}")
    axes.set_xscale("log")
    axes.set_yticks(range(len(errors)), list(settings.methods))
    axes.invert_yaxis()
    axes.set_xlabel("mean squared error of the force")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.tick_params(labelsize=style.SMALL)
    legend(figure)
    style.note_below(figure, f"{len(errors[0])} records: median, quartiles, extremes")
    return figure


@style.styled
def plot_target(settings: Any, results: dict[str, Result], *, width: str | float = "column") -> Figure:
    """Draw the first target's altitude, speed and acceleration with their full information estimates."""
    found = results["ballistic/0000"]
    figure, panels = style.small_multiples(width, 3, 1.1)
    scales = ((1e-3, "km"), (1e-3, "km/s"), (1.0, "m/s^2"))
    for index, (axes, path) in enumerate(zip(panels, problem.TARGET_PATHS, strict=True)):
        factor, unit = scales[index]
        axes.plot(problem.TARGET_TIMES, factor * found["estimate"][index], color=style.BLUE, label=estimators.FULL)
        axes.plot(problem.TARGET_TIMES, factor * found["truth"][index], **TRUTH)
        axes.set_ylabel(style.with_unit(path, unit))
    style.label_time(panels, "s")
    legend(figure)
    return figure


@style.styled
def plot_patient(settings: Any, results: dict[str, Result], *, width: str | float = "column") -> Figure:
    """Draw the first patient's concentrations, and TRH with its estimate and 95% band."""
    found, units = results["thyroid/0000"], problem.thyroid().units
    figure = style.new_figure(width, 4.2)
    panels = list(figure.subplots(4, 1, sharex=True, height_ratios=(1, 1, 1, 2)))
    for axes, name, values in zip(panels, problem.thyroid().outputs or (), found["y"].T, strict=False):
        axes.plot(found["measured"], values, color=style.VERMILLION, marker="o", ms=2.0, ls="", label="measured")
        axes.set_ylabel(style.with_unit(name, units[name]))
    trh = panels[-1]
    trh.fill_between(found["times"], found["low"][0], found["high"][0], color=SHADE, lw=0, label="95% band (EP)")
    trh.plot(found["times"], found["mode"][0], color=style.BLUE, label=estimators.FULL)
    trh.plot(found["times"], found["truth"][0], **TRUTH)
    trh.set_ylabel(style.with_unit(problem.HORMONE, units[problem.HORMONE]))
    trh.set_ylim(bottom=0.0)
    for axes in panels:
        axes.set_xlim(0.0, 24.0)
        axes.set_xticks(range(0, 25, 6))
        style.tidy(axes)
        axes.tick_params(labelbottom=axes is trh)
    trh.set_xlabel("time of day (h)")
    legend(figure)
    return figure


@style.styled
def plot_peaks(settings: Any, results: dict[str, Result], *, width: str | float = "column") -> Figure:
    """Draw by how much the times of the greatest TRH, and of the peak of its daily wave, are off."""
    errors = np.sort(tables.gathered(results, "thyroid", "peak"), axis=0)
    share = np.arange(1, len(errors) + 1) / len(errors)
    figure = style.new_figure(width, 2.0)
    axes = figure.subplots()
    kinds = ((style.ORANGE, "--", "greatest TRH"), (style.BLUE, "-", "peak of the wave of 24 h"))
    for index, (colour, line, label) in enumerate(kinds):
        axes.step(np.append(0.0, errors[:, index]), np.append(0.0, share), where="post", color=colour, ls=line,
                  label=label)
    axes.axvline(tables.NEAR, color=style.BLACK, lw=0.6)
    axes.axhline(0.9, color=style.BLACK, lw=0.6)
    axes.set_xlim(0.0, max(3.0, 1.1 * tables.NEAR))
    axes.set_ylim(0.0, 1.02)
    axes.set_xlabel("error of the time (h)")
    axes.set_ylabel("share of patients")
    style.tidy(axes)
    legend(figure)
    return figure
