"""Figures 2.3, 2.4 and 2.5 of the source, and rates of truths outside the posterior intervals.

1. Figure 2.3: filtered and smoothed paths with bands, and densities at three times.
2. Figure 2.4: conditional posteriors of each parameter by every method.
3. Figure 2.5: the smoothed state with the parameters marginalised.
4. Rates: share of 99% intervals that do not contain the true parameter.

Source: Hartikainen (2013), chapter 2.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from scipy import stats

from lfm_ppl.plots import style

from ..datasets import select_prefix
from ..declaration import Data
from ..drawing import SHADE, SPAN, bars, legend
from ..scores import GridPosterior, Z, estimate_rate
from . import parameters, problem

COLOURS = {"EKF": style.VERMILLION, "CKF": style.BLUE, "GHKF(7)": style.GREEN, problem.PARTICLES: style.ORANGE,
           problem.GRID: style.GREY}
_TINTS = {"EKF": "#F3CDB3", "CKF": SHADE, problem.GRID: "#D5D5D5"}
_DENSITIES: dict[str, dict[str, Any]] = {
    "EKF": {"ls": (0, (6, 1.5)), "zorder": 3}, "CKF": {"ls": (0, (3, 1.5)), "zorder": 3},
    "GHKF(7)": {"ls": (0, (1, 1)), "zorder": 3}, problem.PARTICLES: {"lw": 0.8, "zorder": 2}}


def draw(settings: Any, data: Data) -> dict[str, Figure]:
    """Return every figure by name, for the realisation ``settings.figure``."""
    truth = problem.realisation(settings.figure, settings.seed)
    states, chains = (data[kind].isel(dataset=settings.figure) for kind in ("state", "mcmc"))
    return {"states": plot_states(truth, states), "marginals": plot_marginals(truth, states),
            "conditional": plot_conditional(data, settings.figure), "integrated": plot_integrated(truth, chains),
            "rates": plot_rates(data)}


@style.styled
def plot_states(truth: problem.Realisation, states: xr.Dataset, *, width: str | float = "full") -> Figure:
    """Draw filtered and smoothed paths by EKF, CKF and grid with 95% bands (figure 2.3 a to f)."""
    methods = ["EKF", "CKF", problem.GRID]
    figure, reach = style.new_figure(width, 4.6), 1.8 * float(np.abs(truth.path).max())
    for row, method in zip(figure.subplots(len(methods), 2, sharex=True, sharey=True), methods, strict=True):
        for axes, pass_name in zip(row, ("filter", "smoother"), strict=True):
            path = select_prefix(states.sel({"method": method}), pass_name)
            name = "exact (grid)" if method == problem.GRID else method
            _draw_path(axes, truth, path, method, title=f"{name}, {pass_name}, RMSE {path.rmse:.2f}",
                       ylim=(-reach, reach))
            for time in states.marks.sel({"method": problem.GRID}):
                axes.axvline(time, color=style.BLACK, lw=0.6, ls=(0, (1, 2)), zorder=0)
    if np.abs(states.filter_high.sel({"method": methods})).max() > reach:
        style.note_below(figure, "Bands that go beyond the frame are cut. Dotted: times whose densities are shown.")
    legend(figure, *_bands(methods))
    return figure


@style.styled
def plot_marginals(truth: problem.Realisation, states: xr.Dataset, *, width: str | float = "full") -> Figure:
    """Draw filtering and smoothing densities at three times (figure 2.3 g to j), see `states.MARKS`."""
    exact, x = states.sel({"method": problem.GRID}), np.linspace(-6.5, 6.5, 400)
    figure, cells = style.new_figure(width, 3.6), exact.x.values
    panels = figure.subplots(2, exact.sizes["mark"], sharex=True, squeeze=False)
    for row, pass_name in zip(panels, ("filter", "smoother"), strict=True):
        for axes, time, density in zip(row, exact.marks.values, exact[f"{pass_name}_density"].values, strict=True):
            index = int(np.searchsorted(truth.fine, time - 1e-9))
            axes.fill_between(cells, density, color=SPAN, lw=0, zorder=0, label="exact")
            mean = np.average(cells, weights=density)
            sd = np.sqrt(np.average((cells - mean) ** 2, weights=density))
            axes.plot(x, stats.norm.pdf(x, mean, sd), color=style.BLACK, lw=0.9, zorder=2, label="its best Gaussian")
            for method in problem.GAUSSIAN:
                moments = select_prefix(states, pass_name).sel({"method": method}).isel(time=index)
                normal = stats.norm(moments["mean"].item(), (moments.high - moments["mean"]).item() / Z)
                axes.plot(x, normal.pdf(x), color=COLOURS[method], **_DENSITIES[method], label=method)
            highest = max(density.max(), *(line.get_ydata().max() for line in axes.lines))
            axes.plot([truth.path[index]], [0.0], marker="*", ms=7, color=style.BLACK, mec="white", mew=0.4, ls="",
                      clip_on=False, zorder=5, label="truth")
            style.tidy(axes, title=f"{pass_name}, t = {time:g}", xlim=x[[0, -1]], ylim=(0.0, 1.12 * highest),
                       xlabel="x" if pass_name == "smoother" else "")
        row[0].set_ylabel("density (1/x)")
    legend(figure)
    return figure


@style.styled
def plot_conditional(data: Data, index: int = 0, *, width: str | float = "full") -> Figure:
    """Draw the posterior of each parameter given the others at the truth, by every method (figure 2.4).

    The posteriors by particles come from the task of this figure, the others from realisation ``index``.
    """
    log_likelihoods = parameters.log_likelihoods(data["conditional"]).isel(dataset=index)
    rows = dict(zip(log_likelihoods.method.values, log_likelihoods.values, strict=True))
    rows[problem.PARTICLES] = data["conditional-figure"].log_likelihood.values[0]
    figure, panels = style.in_a_row(width, 3, 2.5)
    for number, (axes, name, truth) in enumerate(zip(panels, problem.NAMES, problem.TRUTH, strict=True)):
        posteriors = {method: GridPosterior(parameters.nodes(name, row.shape[1]), row[number])
                      for method, row in rows.items()}
        for method, posterior in posteriors.items():
            if method == problem.GRID:
                axes.fill_between(posterior.x, posterior.density, color=SPAN, lw=0, zorder=0, label="exact (grid)")
            else:
                axes.plot(posterior.x, posterior.density, color=COLOURS[method], **_DENSITIES[method], label=method)
        axes.axvline(truth, color=style.BLACK, lw=0.9, zorder=1, label="truth")
        low, high = np.transpose([posterior.quantile([0.003, 0.997]) for posterior in posteriors.values()])
        low, high = min(truth, *low), max(truth, *high)
        margin = 0.03 * (high - low)
        style.tidy(axes, xlabel=rf"$\{name}$", xlim=(low - margin, high + margin), ylim=(0.0, None))
    panels[0].set_ylabel("posterior density")
    legend(figure)
    return figure


@style.styled
def plot_integrated(truth: problem.Realisation, chains: xr.Dataset, *, width: str | float = "full") -> Figure:
    """Draw the smoothed state with the parameters marginalised (figure 2.5)."""
    smoothers = {"RAM, EKF": "EKF", "RAM, CKF": "CKF", "particle-marginal RAM": problem.GRID}
    figure = style.new_figure(width, 4.4)
    panels = figure.subplots(len(smoothers), 1, sharex=True, sharey=True)
    for axes, (label, smoother) in zip(panels, smoothers.items(), strict=True):
        path, published = select_prefix(chains.sel(sampler=label), "smoother"), parameters.PUBLISHED.get(label)
        remark = f" (published for another path: {published})" if published else ", exact smoother"
        _draw_path(axes, truth, path, smoother, title=f"{label}: RMSE {path.rmse:.3f}{remark}")
    legend(figure, *_bands(smoothers.values()))
    return figure


@style.styled
def plot_rates(data: Data, *, width: str | float = "full") -> Figure:
    """Draw the share of conditional posteriors whose central 99% interval does not contain the truth, with errors."""
    is_outside = parameters.outcomes(data["conditional"]).outside
    figure = style.new_figure(width, 2.4)
    axes, positions = figure.subplots(), np.arange(len(problem.NAMES) + 1)
    for number, (method, method_outcomes) in enumerate(zip(is_outside.method.values, is_outside, strict=True)):
        by_parameter = method_outcomes.transpose("parameter", "dataset")
        shares = [*map(estimate_rate, by_parameter), parameters.pooled_rate(method_outcomes)]
        x = positions + 0.15 * (number - (len(is_outside) - 1) / 2)
        axes.bar(x, [share.value for share in shares], 0.13, color=COLOURS[method], label=method, zorder=2)
        bars(axes, x, shares, times=1.0, fmt="none", ecolor=style.BLACK, elinewidth=0.7, zorder=3)
    axes.axhline(parameters.OUTSIDE, color=style.BLACK, lw=0.8, ls=(0, (4, 2)), zorder=4, label="nominal")
    style.tidy(axes, ylim=(0.0, 1.0), xlabel="parameter, the others at the truth",
               ylabel="truth outside 99%\n(share of realisations)")
    axes.set_xticks(positions, [*(rf"$\{name}$" for name in problem.NAMES), "all three"])
    legend(figure)
    return figure


def _draw_path(axes: Axes, truth: problem.Realisation, estimate: xr.Dataset, method: str, **properties: Any) -> None:
    axes.fill_between(truth.fine, estimate.low, estimate.high, color=_TINTS[method], lw=0, zorder=1)
    axes.plot(truth.fine, estimate["mean"], color=COLOURS[method], zorder=3)
    axes.plot(truth.fine, truth.path, color=style.BLACK, lw=0.6, zorder=2, label="truth")
    axes.plot(truth.times, truth.y[:, 0], ls="", marker="x", ms=3.2, mew=0.9, color=style.BLACK, zorder=4, label="data")
    style.tidy(axes, xlabel="time", ylabel="x", xlim=truth.fine[[0, -1]], **properties)
    axes.label_outer()


def _bands(methods: Iterable[str]) -> list[Patch]:
    return [Patch(facecolor=_TINTS[method], edgecolor=COLOURS[method],
                  label=f"mean and 95%, {'exact' if method == problem.GRID else method}") for method in methods]
