"""The force of one data set by every method, the errors of all data sets, and posteriors where rates are unknown."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from lfm_ppl.experiments.drawing import band, line, patch
from lfm_ppl.experiments.scores import Z
from lfm_ppl.experiments.study import Data
from lfm_ppl.experiments.transcription import parameters, problem
from lfm_ppl.results.plots import style

COLOURS = {"LA": style.VERMILLION, "LA, trust region": style.ORANGE, "ESLS": style.GREY, "GFS": style.BLUE,
           "GHS(7)": style.SKY, "iterated GHS(7)": style.GREEN}
LOOKS: dict[str, dict[str, Any]] = {
    sampler: {"color": colour, "marker": marker, "ls": dash} for sampler, colour, marker, dash in zip(
        parameters.SAMPLERS, (style.GREY, style.BLUE, style.ORANGE, style.GREEN), "osD^", ("-", "--", "-.", ":"),
        strict=True)}
_SHOWN = ("LA", "ESLS", "GFS", "iterated GHS(7)")
_TOP = 2.0
"""Of the errors that are drawn where they are."""


def draw(settings: Any, data: Data) -> dict[str, Figure]:
    """Return every figure of the comparison by name."""
    return {f"force-{problem.slug(one.label)}": plot_force(data[one.label], problem.data_set(one, 0, settings.seed))
            for one in problem.CONFIGURATIONS if one.label in {"repression 0.1", "exponential"} & data.keys()
            } | {"errors": plot_errors(data)}


@style.styled
def plot_force(found: xr.Dataset, data: problem.DataSet, *, width: str | float = "full") -> Figure:
    """Draw the first data set of a configuration, and its force, with mean and 95% band by some methods."""
    figure, found = style.new_figure(width, 4.2), found.sel({"method": list(_SHOWN)}).isel(dataset=0)
    first, *panels, empty = figure.subplots(2, 3).ravel()
    looks = zip((style.BLUE, style.VERMILLION, style.GREEN), "os^", ("-", "--", ":"), strict=True)
    for gene, (colour, marker, dash) in enumerate(looks):
        first.plot(data.fine, data.state[:, gene], color=colour, lw=0.9, ls=dash)
        first.plot(problem.TIMES, data.y[:, gene], ls="", marker=marker, ms=2.6, color=colour, label=f"gene {gene + 1}")
    first.legend(loc="upper center", ncols=problem.GENES, handletextpad=0.0, columnspacing=0.6, frameon=False)
    axis: dict[str, Any] = {"xlabel": "time", "xlim": (0.0, problem.END)}
    style.tidy(first, **axis, title="data, and the true expression", ylabel="expression",
               ylim=(None, data.y.max() + 0.35 * np.ptp(data.y)))
    # The truth is seen whole, and a band unless it reaches far beyond.
    bands = np.stack([found["mean"] + end * found["sd"] for end in (-Z, Z)])
    reach, low, high = np.where(np.isfinite(bands), bands, 0.0), data.u.min(), data.u.max()
    limits = np.clip(reach.min(), low - 3.0, low) - 0.2, np.clip(reach.max(), high, high + 3.0) + 0.2
    for axes, method in zip(panels, _SHOWN, strict=True):
        own, colour = found.sel({"method": method}), COLOURS[method]
        band(axes, problem.GRID, own["mean"], own["sd"], color=colour, alpha=0.25, zorder=1)
        axes.plot(problem.GRID, own["mean"], color=colour, zorder=3)
        axes.plot(problem.GRID, data.u, color=style.BLACK, lw=0.7, zorder=2)
        style.tidy(axes, **axis, ylabel="force u", ylim=limits, title=f"{method}, RMSE {own.rmse:.2f}")
    empty.set_axis_off()
    style.legend_above(figure, [line("truth", style.BLACK, lw=0.7),
                                patch("mean and 95% band", style.GREY, alpha=0.5)])
    return figure


@style.styled
def plot_errors(data: Data, *, width: str | float = "full") -> Figure:
    """Draw the RMSE of the force of every data set, by configuration and method, and how many diverged."""
    figure, random = style.new_figure(width, 3.2), np.random.default_rng(0)
    axes = figure.subplots()
    methods = [method for method in COLOURS if all(method in found.method for found in data.values())]
    for number, method in enumerate(methods):
        for place, found in enumerate(data.values()):
            own, centre = found.sel({"method": method}), place + 0.13 * (number - (len(methods) - 1) / 2)
            diverged = own.diverged.values
            values = np.minimum(own.rmse.values[~diverged], _TOP)
            axes.plot(centre + 0.035 * random.uniform(-1, 1, len(values)), values, ls="", marker=".", ms=2.0,
                      color=COLOURS[method], alpha=0.5, zorder=2)
            if len(values):
                axes.plot([centre - 0.055, centre + 0.055], [values.mean()] * 2, color=style.BLACK, lw=1.0, zorder=3)
            if diverged.any():
                axes.annotate(f"{diverged.sum()}", (centre, _TOP + 0.03), ha="center", va="bottom",
                              color=COLOURS[method], annotation_clip=False)
    style.tidy(axes, ylim=(0.0, _TOP), ylabel="RMSE of the force", xlabel="how the factor acts")
    axes.set_xticks(range(len(data)), [label.replace(" ", "\n") for label in data])
    style.note_below(figure, "Bars: means without divergences, whose numbers stand above the frame. Points above 2 are "
                             "drawn at 2.")
    style.legend_above(figure, [patch(method, COLOURS[method]) for method in methods])
    return figure


@style.styled
def plot_posteriors(found: xr.Dataset, data: problem.DataSet, *, width: str | float = "full") -> Figure:
    """Draw 95% intervals of all parameters, and the force, of the first data set by each sampler, with the truth."""
    figure, found = style.new_figure(width, 4.6), found.isel(dataset=0)
    upper, lower = figure.subplots(2, 1)
    # Each parameter in standard deviations of the reference about its mean, so that all fit one axis.
    reference, places = found.sel(sampler=parameters.REFERENCE), np.arange(len(parameters.NAMES))
    scaled = (found[["mean", "low", "high", "truth"]] - reference["mean"]) / reference["sd"]
    for number, (sampler, look) in enumerate(LOOKS.items()):
        own, place = scaled.sel(sampler=sampler), places + 0.16 * (number - (len(LOOKS) - 1) / 2)
        upper.vlines(place, own["low"], own["high"], color=look["color"])
        upper.plot(place, own["mean"], **look | {"ls": "", "ms": 2.5})
        mean, sd = (found[f"force_{name}"].sel(sampler=sampler) for name in ("mean", "sd"))
        lower.plot(parameters.AT, mean, **look | {"marker": ""})
        if sampler == parameters.REFERENCE:
            band(lower, parameters.AT, mean, sd, color=look["color"], alpha=0.3, label="")
        else:
            for end in (-Z, Z):
                lower.plot(parameters.AT, mean + end * sd, **look | {"marker": "", "lw": 0.6})
    upper.plot(places, scaled["truth"].sel(sampler=parameters.REFERENCE), ls="", marker="_", ms=12, color=style.BLACK)
    lower.plot(problem.GRID, data.u, color=style.BLACK, lw=0.7)
    style.tidy(upper, ylabel="mean and 95%\n(sd of the reference)")
    upper.set_xticks(places, parameters.NAMES, rotation=40, ha="right")
    style.tidy(lower, ylabel="force u, mean\nand 95% band", xlabel="time", xlim=(0.0, problem.END))
    style.legend_above(figure, [*(line(sampler, **look, ms=2.5) for sampler, look in LOOKS.items()),
                                line("truth", style.BLACK)])
    return figure
