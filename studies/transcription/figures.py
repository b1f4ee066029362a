"""Figures of both studies: the force of one data set, errors of all data sets, and posteriors with unknown rates."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from lfm_ppl.plots import style

from ..declaration import Data
from ..drawing import band, line, patch
from ..scores import Z
from . import parameters, problem

COLOURS = {"LA": style.VERMILLION, "LA, trust region": style.ORANGE, "ESLS": style.GREY, "GFS": style.BLUE,
           "GHS(7)": style.SKY, "iterated GHS(7)": style.GREEN}
SAMPLER_STYLES: dict[str, dict[str, Any]] = {
    sampler: {"color": colour, "marker": marker, "ls": dash} for sampler, colour, marker, dash in zip(
        parameters.SAMPLERS, (style.GREY, style.BLUE, style.ORANGE, style.GREEN), "osD^", ("-", "--", "-.", ":"),
        strict=True)}
_FIGURE_METHODS = ("LA", "ESLS", "GFS", "iterated GHS(7)")
_MAX_ERROR = 2.0
"""Largest error on the axis; points of larger errors are drawn at this value."""


def draw(settings: Any, data: Data) -> dict[str, Figure]:
    """Return every figure of the comparison by name."""
    figures = {f"force-{problem.slug(configuration.label)}":
               plot_force(data[configuration.label], problem.data_set(configuration, 0, settings.seed))
               for configuration in problem.CONFIGURATIONS
               if configuration.label in {"repression 0.1", "exponential"} & data.keys()}
    return figures | {"errors": plot_errors(data)}


@style.styled
def plot_force(dataset: xr.Dataset, data: problem.DataSet, *, width: str | float = "full") -> Figure:
    """Draw the first data set of a configuration, and its force, with mean and 95% band by some methods."""
    figure, dataset = style.new_figure(width, 4.2), dataset.sel({"method": list(_FIGURE_METHODS)}).isel(dataset=0)
    data_axes, *panels, empty = figure.subplots(2, 3).ravel()
    styles = zip((style.BLUE, style.VERMILLION, style.GREEN), "os^", ("-", "--", ":"), strict=True)
    for gene, (colour, marker, dash) in enumerate(styles):
        data_axes.plot(data.fine, data.state[:, gene], color=colour, lw=0.9, ls=dash)
        data_axes.plot(problem.TIMES, data.y[:, gene], ls="", marker=marker, ms=2.6, color=colour,
                       label=f"gene {gene + 1}")
    data_axes.legend(loc="upper center", ncols=problem.GENES, handletextpad=0.0, columnspacing=0.6, frameon=False)
    axis: dict[str, Any] = {"xlabel": "time", "xlim": (0.0, problem.END)}
    style.tidy(data_axes, **axis, title="data, and the true expression", ylabel="expression",
               ylim=(None, data.y.max() + 0.35 * np.ptp(data.y)))
    # The limits include the truth, and the bands up to 3 beyond the truth.
    bands = np.stack([dataset["mean"] + end * dataset["sd"] for end in (-Z, Z)])
    reach, low, high = np.where(np.isfinite(bands), bands, 0.0), data.u.min(), data.u.max()
    limits = np.clip(reach.min(), low - 3.0, low) - 0.2, np.clip(reach.max(), high, high + 3.0) + 0.2
    for axes, method in zip(panels, _FIGURE_METHODS, strict=True):
        estimate, colour = dataset.sel({"method": method}), COLOURS[method]
        band(axes, problem.GRID, estimate["mean"], estimate["sd"], color=colour, alpha=0.25, zorder=1)
        axes.plot(problem.GRID, estimate["mean"], color=colour, zorder=3)
        axes.plot(problem.GRID, data.u, color=style.BLACK, lw=0.7, zorder=2)
        style.tidy(axes, **axis, ylabel="force u", ylim=limits, title=f"{method}, RMSE {estimate.rmse:.2f}")
    empty.set_axis_off()
    style.legend_above(figure, [line("truth", style.BLACK, lw=0.7),
                                patch("mean and 95% band", style.GREY, alpha=0.5)])
    return figure


@style.styled
def plot_errors(data: Data, *, width: str | float = "full") -> Figure:
    """Draw the RMSE of the force of every data set, by configuration and method, and the number of divergences."""
    figure, random = style.new_figure(width, 3.2), np.random.default_rng(0)
    axes = figure.subplots()
    methods = [method for method in COLOURS if all(method in dataset.method for dataset in data.values())]
    for number, method in enumerate(methods):
        for position, dataset in enumerate(data.values()):
            results, centre = dataset.sel({"method": method}), position + 0.13 * (number - (len(methods) - 1) / 2)
            diverged = results.diverged.values
            values = np.minimum(results.rmse.values[~diverged], _MAX_ERROR)
            axes.plot(centre + 0.035 * random.uniform(-1, 1, len(values)), values, ls="", marker=".", ms=2.0,
                      color=COLOURS[method], alpha=0.5, zorder=2)
            if len(values):
                axes.plot([centre - 0.055, centre + 0.055], [values.mean()] * 2, color=style.BLACK, lw=1.0, zorder=3)
            if diverged.any():
                axes.annotate(f"{diverged.sum()}", (centre, _MAX_ERROR + 0.03), ha="center", va="bottom",
                              color=COLOURS[method], annotation_clip=False)
    style.tidy(axes, ylim=(0.0, _MAX_ERROR), ylabel="RMSE of the force", xlabel="how the factor acts")
    axes.set_xticks(range(len(data)), [label.replace(" ", "\n") for label in data])
    style.note_below(figure, "Bars: means without divergences, whose numbers stand above the frame. Points above 2 are "
                             "drawn at 2.")
    style.legend_above(figure, [patch(method, COLOURS[method]) for method in methods])
    return figure


@style.styled
def plot_posteriors(dataset: xr.Dataset, data: problem.DataSet, *, width: str | float = "full") -> Figure:
    """Draw 95% intervals of all parameters, and the force, of the first data set by each sampler, with the truth."""
    figure, dataset = style.new_figure(width, 4.6), dataset.isel(dataset=0)
    upper, lower = figure.subplots(2, 1)
    # Each parameter in standard deviations of the reference about its mean, so that all fit one axis.
    reference, positions = dataset.sel(sampler=parameters.REFERENCE), np.arange(len(parameters.NAMES))
    scaled = (dataset[["mean", "low", "high", "truth"]] - reference["mean"]) / reference["sd"]
    for number, (sampler, properties) in enumerate(SAMPLER_STYLES.items()):
        summary, x = scaled.sel(sampler=sampler), positions + 0.16 * (number - (len(SAMPLER_STYLES) - 1) / 2)
        upper.vlines(x, summary["low"], summary["high"], color=properties["color"])
        upper.plot(x, summary["mean"], **properties | {"ls": "", "ms": 2.5})
        mean, sd = (dataset[f"force_{name}"].sel(sampler=sampler) for name in ("mean", "sd"))
        lower.plot(parameters.FORCE_TIMES, mean, **properties | {"marker": ""})
        if sampler == parameters.REFERENCE:
            band(lower, parameters.FORCE_TIMES, mean, sd, color=properties["color"], alpha=0.3, label="")
        else:
            for end in (-Z, Z):
                lower.plot(parameters.FORCE_TIMES, mean + end * sd, **properties | {"marker": "", "lw": 0.6})
    truth = scaled["truth"].sel(sampler=parameters.REFERENCE)
    upper.plot(positions, truth, ls="", marker="_", ms=12, color=style.BLACK)
    lower.plot(problem.GRID, data.u, color=style.BLACK, lw=0.7)
    style.tidy(upper, ylabel="mean and 95%\n(sd of the reference)")
    upper.set_xticks(positions, parameters.NAMES, rotation=40, ha="right")
    style.tidy(lower, ylabel="force u, mean\nand 95% band", xlabel="time", xlim=(0.0, problem.END))
    entries = [line(sampler, **properties, ms=2.5) for sampler, properties in SAMPLER_STYLES.items()]
    style.legend_above(figure, [*entries, line("truth", style.BLACK)])
    return figure
