"""The force of one data set by every method, and the errors of all data sets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments.drawing import band, line, patch
from lfm_ppl.experiments.scores import Z
from lfm_ppl.experiments.transcription import problem
from lfm_ppl.results.plots import style

COLOURS = {"LA": style.VERMILLION, "LA, trust region": style.ORANGE, "ESLS": style.GREY, "GFS": style.BLUE,
           "GHS(7)": style.SKY, "iterated GHS(7)": style.GREEN}
_SHOWN = ("LA", "ESLS", "GFS", "iterated GHS(7)")


def draw(settings: Any, cells: Mapping[tuple[str, str], Result]) -> dict[str, Figure]:
    """Return every figure of the comparison by name."""
    found = {}
    for configuration in problem.CONFIGURATIONS:
        if configuration.label in ("repression 0.1", "exponential") and configuration.label in settings.configurations:
            own = {method: cells[configuration.label, method] for method in _SHOWN}
            data = problem.data_set(configuration, 0, settings.seed)
            found[f"force-{problem.slug(configuration.label)}"] = plot_force(data, own)
    return found | {"errors": plot_errors(cells)}


@style.styled
def plot_force(data: problem.DataSet, methods: Mapping[str, Result], *, width: str | float = "full") -> Figure:
    """Draw the force of a data set, its mean and 95% band by each method, and the data.

    Args:
        data: the data set, the first of those in ``methods``.
        methods: method -> its results.
        width: "column" (3.4 in), "full" (7 in), or inches.
    """
    figure = style.new_figure(width, 4.2)
    grid = figure.subplots(2, 3)
    panels = list(grid.ravel())
    axes = panels[0]
    kinds = zip((style.BLUE, style.VERMILLION, style.GREEN), "os^", ("-", "--", ":"), strict=True)
    for gene, (colour, marker, dash) in enumerate(kinds):
        axes.plot(data.fine, data.state[:, gene], color=colour, lw=0.9, ls=dash)
        axes.plot(problem.TIMES, data.y[:, gene], ls="", marker=marker, ms=2.6, color=colour, label=f"gene {gene + 1}")
    axes.set_title("data, and the true expression")
    axes.set_ylim(top=data.y.max() + 0.35 * np.ptp(data.y))
    axes.legend(loc="upper center", ncols=problem.GENES, handletextpad=0.0, columnspacing=0.6, frameon=False)
    axes.set_ylabel("expression")
    style.tidy(axes)
    # The truth is seen whole, and a band unless it reaches far beyond.
    means, sds = (np.stack([found[name][0] for found in methods.values()]) for name in ("mean", "sd"))
    reach = [np.where(np.isfinite(bands), bands, 0.0) for bands in (means - Z * sds, means + Z * sds)]
    low = max(min(reach[0].min(), data.u.min()), data.u.min() - 3.0) - 0.2
    high = min(max(reach[1].max(), data.u.max()), data.u.max() + 3.0) + 0.2
    for axes, (method, found) in zip(panels[1:], methods.items(), strict=False):
        mean, sd = found["mean"][0], found["sd"][0]
        colour = COLOURS[method]
        band(axes, problem.GRID, mean, sd, color=colour, alpha=0.25, zorder=1)
        axes.plot(problem.GRID, mean, color=colour, zorder=3)
        axes.plot(problem.GRID, data.u, color=style.BLACK, lw=0.7, zorder=2)
        axes.set_ylim(low, high)
        axes.set_title(f"{method}, RMSE {found['rmse'][0]:.2f}")
        axes.set_ylabel("force u")
        style.tidy(axes)
    for axes in panels[1 + len(methods):]:
        axes.set_axis_off()
    for axes in panels[: 1 + len(methods)]:
        axes.set_xlabel("time")
        axes.set_xlim(0.0, problem.END)
    style.legend_above(figure, [line("truth", style.BLACK, lw=0.7),
                                patch("mean and 95% band", style.GREY, alpha=0.5)])
    return figure


@style.styled
def plot_errors(cells: Mapping[tuple[str, str], Result], *, width: str | float = "full") -> Figure:
    """Draw the RMSE of the force of every data set, by configuration and method; diverged ones as crosses at the top.

    Args:
        cells: (configuration, method) -> results.
        width: "column" (3.4 in), "full" (7 in), or inches.
    """
    labels = [one.label for one in problem.CONFIGURATIONS if any(label == one.label for label, _ in cells)]
    methods = [method for method in COLOURS if any((label, method) in cells for label in labels)]
    figure = style.new_figure(width, 3.2)
    axes = figure.subplots()
    random = np.random.default_rng(0)
    top = 2.0
    for number, method in enumerate(methods):
        for place, label in enumerate(labels):
            found = cells.get((label, method))
            if found is None:
                continue
            centre = place + 0.13 * (number - (len(methods) - 1) / 2)
            sound = ~np.asarray(found["diverged"], bool)
            values = np.minimum(found["rmse"][sound], top)
            spread = 0.035 * random.uniform(-1, 1, len(values))
            axes.plot(centre + spread, values, ls="", marker=".", ms=2.0, color=COLOURS[method], alpha=0.5, zorder=2)
            if len(values):
                axes.plot([centre - 0.055, centre + 0.055], [values.mean()] * 2, color=style.BLACK, lw=1.0, zorder=3)
            if (~sound).any():
                axes.annotate(f"{(~sound).sum()}", (centre, top + 0.03), ha="center", va="bottom",
                              color=COLOURS[method], annotation_clip=False)
    style.tidy(axes)
    axes.set_ylim(0.0, top)
    axes.set_xticks(range(len(labels)), [label.replace(" ", "\n") for label in labels])
    axes.set_ylabel("RMSE of the force")
    axes.set_xlabel("how the factor acts")
    style.note_below(figure, "Bars: means without divergences, whose numbers stand above the frame. Points above 2 are "
                             "drawn at 2.")
    style.legend_above(figure, [patch(method, COLOURS[method]) for method in methods])
    return figure
