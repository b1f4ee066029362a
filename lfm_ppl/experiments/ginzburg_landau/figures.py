"""Figures 2.3, 2.4 and 2.5 of the source in our own drawing, and the rates that they stand for."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from scipy import stats

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments.drawing import legend
from lfm_ppl.experiments.ginzburg_landau import conditional, problem, sampling, tables
from lfm_ppl.experiments.scores import Z
from lfm_ppl.results.plots import style

COLOURS = {"EKF": style.VERMILLION, "CKF": style.BLUE, "GHKF(7)": style.GREEN, problem.PARTICLES: style.ORANGE,
           problem.GRID: style.GREY}
DASHES: dict[str, Any] = {"EKF": (0, (6, 1.5)), "CKF": (0, (3, 1.5)), "GHKF(7)": (0, (1, 1))}
_TINTS = {"EKF": "#F3CDB3", "CKF": "#B3D5E9", problem.GRID: "#D5D5D5", problem.PARTICLES: "#F8E2B3"}
_EXACT = "#DDDDDD"
_SYMBOLS = {"alpha": r"$\alpha$", "beta": r"$\beta$", "sigma": r"$\sigma$"}


def draw(settings: Any, results: dict[str, Result]) -> dict[str, Figure]:
    """Return every figure of the comparison by name, for the realisation ``settings.figure``."""
    data = problem.realisation(settings.figure, settings.seed)
    states = {method: results[f"state/{problem.slug(method)}/{settings.figure:03d}"] for method in problem.METHODS}
    rows = conditional_rows(settings, results)
    paths = {label: results[f"mcmc/{sampling.slug(label)}/{settings.figure:03d}"] for label in sampling.SAMPLERS}
    return {"states": plot_states(data, states), "marginals": plot_marginals(data, states),
            "conditional": plot_conditional(rows), "integrated": plot_integrated(data, paths),
            "rates": plot_rates(results)}


def conditional_rows(settings: Any, results: dict[str, Result]) -> dict[str, np.ndarray]:
    """Return method -> log likelihood (3, nodes) of the figure's realisation."""
    rows = {}
    for task in conditional.tasks(settings):
        if task.settings["first"] <= settings.figure <= task.settings["last"]:
            inside = settings.figure - task.settings["first"]
            rows[task.settings["method"]] = results[task.name]["log_likelihood"][inside]
    rows[problem.PARTICLES] = results[conditional.figure_task(settings).name]["log_likelihood"][0]
    return rows


@style.styled
def plot_states(data: problem.Realisation, states: dict[str, Result], *, width: str | float = "full") -> Figure:
    """Draw what filter and smoother of EKF, CKF and grid say of the path, with 95% bands (figure 2.3 a to f).

    Args:
        data: the realisation.
        states: method -> result of `lfm_ppl.experiments.ginzburg_landau.state.compute`.
        width: "column" (3.4 in), "full" (7 in), or inches.
    """
    methods = ("EKF", "CKF", problem.GRID)
    figure = style.new_figure(width, 4.6)
    grid = figure.subplots(len(methods), 2, sharex=True, sharey=True)
    for row, method in zip(grid, methods, strict=True):
        for axes, what in zip(row, ("filter", "smoother"), strict=True):
            _draw_band(axes, data, states[method], what, method)
            for mark in states[problem.GRID]["marks"]:
                axes.axvline(mark, color=style.BLACK, lw=0.6, ls=(0, (1, 2)), zorder=0)
            name = "exact (grid)" if method == problem.GRID else method
            axes.set_title(f"{name}, {what}, RMSE {states[method][f'{what}_rmse']:.2f}")
            style.tidy(axes)
    reach = 1.8 * float(np.abs(data.path).max())
    grid[0, 0].set_ylim(-reach, reach)
    for axes in grid[-1]:
        axes.set_xlabel("time")
    for axes in grid[:, 0]:
        axes.set_ylabel("x")
    if max(np.abs(states[method]["filter_high"]).max() for method in methods) > reach:
        style.note_below(figure, "Bands that go beyond the frame are cut. Dotted: times whose densities are shown.")
    legend(figure, *_entries(methods))
    return figure


@style.styled
def plot_marginals(data: problem.Realisation, states: dict[str, Result], *, width: str | float = "full") -> Figure:
    """Draw filtering and smoothing densities at three times (figure 2.3 g to j).

    Two times are those of the source, whose path is another one; the third is when, apart from these, the exact
    filtering density of this realisation is most bimodal.

    Args:
        data: the realisation.
        states: method -> result of `lfm_ppl.experiments.ginzburg_landau.state.compute`.
        width: "column" (3.4 in), "full" (7 in), or inches.
    """
    exact = states[problem.GRID]
    figure = style.new_figure(width, 3.6)
    grid = figure.subplots(2, len(exact["marks"]), sharex=True, squeeze=False)
    x = np.linspace(-6.5, 6.5, 400)
    for row, what in zip(grid, ("filter", "smoother"), strict=True):
        for number, (axes, mark) in enumerate(zip(row, exact["marks"], strict=True)):
            index = int(np.searchsorted(data.fine, mark - 1e-9))
            density = exact[f"{what}_density"][number]
            axes.fill_between(exact["x"], density, color=_EXACT, lw=0, zorder=0, label="exact")
            width_ = exact["x"][1] - exact["x"][0]
            mean = np.sum(density * exact["x"]) * width_
            sd = np.sqrt(np.sum(density * (exact["x"] - mean) ** 2) * width_)
            axes.plot(x, stats.norm.pdf(x, mean, sd), color=style.BLACK, lw=0.9, zorder=2, label="its best Gaussian")
            for method in problem.GAUSSIAN:
                one = states[method]
                mean, high = one[f"{what}_mean"][index], one[f"{what}_high"][index]
                axes.plot(x, stats.norm.pdf(x, mean, (high - mean) / Z), color=COLOURS[method], ls=DASHES[method],
                          zorder=3, label=method)
            axes.plot([data.path[index]], [0.0], marker="*", ms=7, color=style.BLACK, mec="white", mew=0.4, ls="",
                      clip_on=False, zorder=5, label="truth")
            axes.set_title(f"{what}, t = {mark:g}")
            axes.set_xlim(x[0], x[-1])
            axes.set_ylim(0.0, 1.12 * max(density.max(), *(line.get_ydata().max() for line in axes.lines)))
            style.tidy(axes)
    for axes in grid[-1]:
        axes.set_xlabel("x")
    for axes in grid[:, 0]:
        axes.set_ylabel("density (1/x)")
    legend(figure)
    return figure


@style.styled
def plot_conditional(rows: dict[str, np.ndarray], *, width: str | float = "full") -> Figure:
    """Draw the posterior of each parameter given the others at the truth, by every method (figure 2.4).

    Args:
        rows: method -> log likelihood (3, nodes), see `conditional_rows`.
        width: "column" (3.4 in), "full" (7 in), or inches.
    """
    figure, panels = style.in_a_row(width, 3, 2.5)
    for number, (axes, name) in enumerate(zip(panels, problem.NAMES, strict=True)):
        found = {method: conditional.posterior(row[number], name) for method, row in rows.items()}
        for method, one in found.items():
            if method == problem.GRID:
                axes.fill_between(one.x, one.density, color=_EXACT, lw=0, zorder=0, label="exact (grid)")
            elif method == problem.PARTICLES:
                axes.plot(one.x, one.density, color=COLOURS[method], lw=0.8, zorder=2, label=method)
            else:
                axes.plot(one.x, one.density, color=COLOURS[method], ls=DASHES[method], zorder=3, label=method)
        truth = problem.TRUTH[number]
        axes.axvline(truth, color=style.BLACK, lw=0.9, zorder=1, label="truth")
        low = min(truth, *(float(one.quantile(0.003)) for one in found.values()))
        high = max(truth, *(float(one.quantile(0.997)) for one in found.values()))
        axes.set_xlim(low - 0.03 * (high - low), high + 0.03 * (high - low))
        axes.set_ylim(bottom=0.0)
        style.tidy(axes)
        axes.set_xlabel(_SYMBOLS[name])
    figure.axes[0].set_ylabel("posterior density")
    legend(figure)
    return figure


@style.styled
def plot_integrated(data: problem.Realisation, paths: dict[str, Result], *, width: str | float = "full") -> Figure:
    """Draw the smoothed state with the parameters integrated out (figure 2.5).

    Args:
        data: the realisation.
        paths: sampler -> result of `lfm_ppl.experiments.ginzburg_landau.sampling.compute`.
        width: "column" (3.4 in), "full" (7 in), or inches.
    """
    shown = {"RAM, EKF": "EKF", "RAM, CKF": "CKF", "particle-marginal RAM": problem.GRID}
    figure = style.new_figure(width, 4.4)
    for axes, (label, like) in zip(figure.subplots(len(shown), 1, sharex=True, sharey=True), shown.items(),
                                   strict=True):
        _draw_band(axes, data, paths[label], "smoother", like)
        published = tables.PUBLISHED.get(label)
        beside = f" (published for another path: {published})" if published else ", exact smoother"
        axes.set_title(f"{label}: RMSE {paths[label]['smoother_rmse']:.3f}{beside}")
        axes.set_ylabel("x")
        style.tidy(axes)
    figure.axes[-1].set_xlabel("time")
    legend(figure, *_entries(tuple(shown.values())))
    return figure


@style.styled
def plot_rates(results: dict[str, Result], *, width: str | float = "full") -> Figure:
    """Draw how often the truth lies outside the central 99% interval of a conditional posterior, with its error."""
    table = tables.rates(results)
    figure = style.new_figure(width, 2.4)
    axes = figure.subplots()
    names = (*problem.NAMES, "pooled")
    for number, method in enumerate(table.index):
        place = np.arange(len(names)) + 0.15 * (number - (len(table) - 1) / 2)
        values = [table.loc[method, name] for name in names]
        errors = [table.loc[method, f"{name} se"] for name in names]
        axes.bar(place, values, 0.13, color=COLOURS[method], label=method, zorder=2)
        axes.errorbar(place, values, errors, fmt="none", ecolor=style.BLACK, elinewidth=0.7, capsize=1.5, zorder=3)
    axes.axhline(conditional.OUTSIDE, color=style.BLACK, lw=0.8, ls=(0, (4, 2)), zorder=4, label="nominal")
    style.tidy(axes)
    axes.set_xticks(range(len(names)), [_SYMBOLS.get(name, "all three") for name in names])
    axes.set_ylim(0.0, 1.0)
    axes.set_xlabel("parameter, the others at the truth")
    axes.set_ylabel("truth outside 99%\n(share of realisations)")
    legend(figure)
    return figure


def _draw_band(axes: Axes, data: problem.Realisation, one: Result, what: str, like: str) -> None:
    axes.fill_between(data.fine, one[f"{what}_low"], one[f"{what}_high"], color=_TINTS[like], lw=0, zorder=1)
    axes.plot(data.fine, one[f"{what}_mean"], color=COLOURS[like], zorder=3)
    axes.plot(data.fine, data.path, color=style.BLACK, lw=0.6, zorder=2, label="truth")
    axes.plot(data.times, data.y[:, 0], ls="", marker="x", ms=3.2, mew=0.9, color=style.BLACK, zorder=4, label="data")
    axes.set_xlim(data.fine[0], data.fine[-1])


def _entries(methods: tuple[str, ...]) -> list[Patch]:
    names = {method: "exact" if method == problem.GRID else method for method in methods}
    return [Patch(facecolor=_TINTS[method], edgecolor=COLOURS[method], label=f"mean and 95%, {name}")
            for method, name in names.items()]
