"""Figures of the study: forces with estimates and bands, errors, a target's paths, and a patient's TRH."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from lfm_ppl.plots import style

from ..declaration import Data
from ..drawing import SHADE, TRUTH, legend
from . import problem
from .estimators import BANDS, FULL, HORIZON, MAX_PEAK_ERROR, METHODS


def draw(settings: Any, data: Data) -> dict[str, Figure]:
    """Return every figure by name."""
    return {"forces": plot_forces(data), "errors": plot_errors(data), "target": plot_target(data),
            "patient": plot_patient(data), "peaks": plot_peaks(data)}


@style.styled
def plot_forces(data: Data, *, width: str | float = "column") -> Figure:
    """Draw the first force of each shape, its band, and its estimates by the source and by full information."""
    shapes, rows = data["transcription"]["shape"].values, problem.TIMES[:: METHODS[BANDS].spacing]
    figure = style.new_figure(width, 1.25 * len(shapes) + 0.6)
    panels = figure.subplots(len(shapes), 1, sharex=True, squeeze=False)[:, 0]
    for axes, shape in zip(panels, shapes, strict=True):
        first = data["transcription"]["first"].sel(shape=shape)
        _, low, high = first.sel({"method": BANDS})[:, :len(rows)]
        axes.fill_between(rows, low, high, color=SHADE, lw=0, label="95% band (EP)")
        if HORIZON in first["method"]:
            axes.plot(problem.TIMES, first.sel({"method": HORIZON})[0], color=style.ORANGE, lw=0.8, label=HORIZON)
        axes.plot(problem.TIMES, first.sel({"method": FULL})[0], color=style.BLUE, label=FULL)
        axes.plot(problem.TIMES, data["transcription"]["truth"].sel({"shape": shape, "method": FULL}), **TRUTH)
        style.tidy(axes, title=shape, ylabel="force", xlim=(0.0, problem.TIMES[-1]))
    panels[-1].set_xlabel("time (s)")
    legend(figure)
    return figure


@style.styled
def plot_errors(data: Data, *, width: str | float = "column") -> Figure:
    """Draw the mean squared errors of the force of all records, and the published ones."""
    errors = data["transcription"]["mse"].transpose("method", ...)
    figure = style.new_figure(width, 2.6)
    axes = figure.subplots()
    for row, mse in enumerate(errors.values):
        least, low, median, high, largest = np.quantile(mse, [0.0, 0.25, 0.5, 0.75, 1.0])
        axes.hlines(row, least, largest, color=style.BLUE, lw=0.8)
        axes.hlines(row, low, high, color=style.BLUE, lw=4.0)
        axes.plot(median, row, color=style.BLACK, marker="|", ms=7.0, ls="")
    for colour, line, published in ((style.BLACK, ":", "smoother"), (style.ORANGE, "--", "delayed MHE")):
        axes.axvline(problem.PUBLISHED[published], color=colour, ls=line, lw=1.0, label=f"published, {published}")
    axes.set(xscale="log", xlabel="mean squared error of the force")
    axes.set_yticks(range(len(errors)), list(errors["method"].values))
    axes.invert_yaxis()
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.tick_params(labelsize=style.SMALL)
    legend(figure)
    style.note_below(figure, f"{errors[0].size} records: median, quartiles, extremes")
    return figure


@style.styled
def plot_target(data: Data, *, width: str | float = "column") -> Figure:
    """Draw the first target's altitude, speed and acceleration with their full information estimates."""
    figure, panels = style.small_multiples(width, 3, 1.1)
    scales = ((1e-3, "km"), (1e-3, "km/s"), (1.0, "m/s^2"))
    for axes, path, (factor, unit) in zip(panels, problem.TARGET_PATHS, scales, strict=True):
        paths = factor * data["ballistic"][["estimate", "truth"]].sel(path=path)
        axes.plot(problem.TARGET_TIMES, paths["estimate"], color=style.BLUE, label=FULL)
        axes.plot(problem.TARGET_TIMES, paths["truth"], **TRUTH)
        axes.set_ylabel(style.with_unit(path, unit))
    style.label_time(panels, "s")
    legend(figure)
    return figure


@style.styled
def plot_patient(data: Data, *, width: str | float = "column") -> Figure:
    """Draw the first patient's concentrations, and TRH with its estimate and 95% band."""
    patient, units = data["thyroid"].isel(dataset=0), problem.thyroid().units
    figure = style.new_figure(width, 4.2)
    *panels, trh = figure.subplots(4, 1, sharex=True, height_ratios=(1, 1, 1, 2))
    for axes, name, values in zip(panels, problem.thyroid().outputs or (), patient["y"].T, strict=False):
        axes.plot(patient["measured"], values, color=style.VERMILLION, marker="o", ms=2.0, ls="", label="measured")
        style.tidy(axes, ylabel=style.with_unit(name, units[name]))
        axes.tick_params(labelbottom=False)
    trh.fill_between(patient["times"], patient["low"], patient["high"], color=SHADE, lw=0, label="95% band (EP)")
    trh.plot(patient["times"], patient["mode"], color=style.BLUE, label=FULL)
    trh.plot(patient["times"], patient["truth"], **TRUTH)
    style.tidy(trh, xlabel="time of day (h)", ylabel=style.with_unit(problem.HORMONE, units[problem.HORMONE]),
               xlim=(0.0, 24.0), ylim=(0.0, None))
    legend(figure)
    return figure


@style.styled
def plot_peaks(data: Data, *, width: str | float = "column") -> Figure:
    """Draw the distribution of errors of the time of greatest TRH, and of the peak of its daily wave."""
    errors = np.sort(data["thyroid"]["peak"].values, axis=0)
    share = np.arange(len(errors) + 1) / len(errors)
    figure = style.new_figure(width, 2.0)
    axes = figure.subplots()
    kinds = ((style.ORANGE, "--", "greatest TRH"), (style.BLUE, "-", "peak of the wave of 24 h"))
    for event_errors, (colour, line, label) in zip(errors.T, kinds, strict=True):
        axes.step(np.append(0.0, event_errors), share, where="post", color=colour, ls=line, label=label)
    axes.axvline(MAX_PEAK_ERROR, color=style.BLACK, lw=0.6)
    axes.axhline(0.9, color=style.BLACK, lw=0.6)
    style.tidy(axes, xlim=(0.0, 3.0), ylim=(0.0, 1.02), xlabel="error of the time (h)", ylabel="share of patients")
    legend(figure)
    return figure
