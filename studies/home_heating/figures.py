"""Figures of the study: bands of the day ahead, daily residuals, and scores of all residuals.

1. A day of a simulated home and of the real house: temperature with bands, and heating.
2. The smoothed residual of each day, and the band of the predicted day.
3. RMSE of every residual, and quartiles of the log likelihood.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lfm_ppl.plots import style

from ..datasets import select_prefix
from ..declaration import Data
from ..drawing import TRUTH, band, bars, legend, line
from ..scores import estimate_mean
from . import prediction, problem

LABELS = {method: method for method in problem.METHODS} | {"none": "no residual", "matern": "Matern"}
_MEASURED = TRUTH | {"label": "measured"}
_WIDE, _NARROW, _HEAT = "#D6E8F3", "#9CC9E3", "#D0D0D0"
_MARKS: dict[str, dict[str, Any]] = {"one store": {"color": style.BLUE, "marker": "o"},
                                     "envelope": {"color": style.VERMILLION, "marker": "s"}}
_FIGURE_METHODS = ("SQM", "periodic", "CQM", "none", "matern", "resonator")
_DAY: dict[str, Any] = {"xlim": (0.0, float(problem.DAY)), "xticks": range(0, problem.DAY + 1, 6)}


def draw(settings: Any, data: Data) -> dict[str, Figure]:
    """Return every figure by name."""
    result = {"homes-ahead": plot_homes(settings, data), "scores": plot_scores(data)}
    if "house" in data:
        result["house-ahead"] = plot_house(settings, data)
        if {"SQM", "matern"} <= set(settings.methods):
            result["residual"] = plot_residual(data)
    return result


@style.styled
def plot_homes(settings: Any, data: Data, *, store: str | None = None, width: str | float = "full") -> Figure:
    """Draw the fifth day of the first simulated home: temperature with bands, set point, and heater."""
    store = store or settings.stores[0]
    window = problem.home(0, store, settings.seed)
    assert window.fine is not None and window.set_points is not None
    hours, set_points = problem.FINE[prediction.SCORED] - problem.TRAIN, window.set_points[problem.TRAIN:]
    truth, _, heater = window.fine[prediction.SCORED].T
    figure, panels = _build_panels(width, data["homes"].sel(store=store).isel(dataset=0), "heater on")
    for residual, upper, lower in panels:
        low, quarter, middle, upper_quarter, high = residual.quantiles
        upper.plot(hours, middle, color=style.BLUE, label="predicted")
        upper.fill_between(hours, low, high, color=_WIDE, lw=0, label="95% band")
        upper.fill_between(hours, quarter, upper_quarter, color=_NARROW, lw=0, label="50% band")
        upper.step(np.arange(problem.DAY + 1), np.append(set_points, set_points[0]), where="post", color=style.GREEN,
                   lw=0.8, label="set point")
        upper.plot(hours, truth, **_MEASURED)
        lower.fill_between(hours, heater, step="post", color=_HEAT, lw=0, label="heater on")
        lower.plot(hours, residual.on, color=style.VERMILLION, lw=0.8, label="predicted probability")
        lower.set_ylim(0.0, 1.05)
    legend(figure)
    return figure


@style.styled
def plot_house(settings: Any, data: Data, *, store: str | None = None, width: str | float = "full") -> Figure:
    """Draw the fifth day of one window of the real house: temperature with bands, and its known heating power."""
    house, hours = data["house"].sel(store=store or settings.stores[0]), np.arange(problem.DAY)
    index = house.sizes["dataset"] // 2
    temperature, _, power = problem.house(settings.data)[index].y[problem.TRAIN:].T
    house = house.isel(dataset=index)
    figure, panels = _build_panels(width, house.assign(select_prefix(house, "ahead")), "power")
    for residual, upper, lower in panels:
        upper.plot(hours, residual["mean"], color=style.BLUE, label="predicted")
        band(upper, hours, residual["mean"], residual["sd"], color=_WIDE)
        band(upper, hours, residual["mean"], residual["sd"], color=_NARROW, z=0.6745, label="50% band")
        upper.plot(hours, temperature, **_MEASURED)
        lower.fill_between(hours, power, step="post", color=_HEAT, lw=0, label="heating power (100 units)")
        lower.set_ylim(bottom=0.0)
    legend(figure)
    return figure


def _build_panels(width: str | float, dataset: xr.Dataset,
                  heating: str) -> tuple[Figure, list[tuple[xr.Dataset, Axes, Axes]]]:
    """Return a figure, and for each residual in it the results and the axes of temperature and heating."""
    methods = [method for method in _FIGURE_METHODS if method in dataset.method] or list(dataset.method.values)
    columns = min(3, len(methods))
    rows = -(-len(methods) // columns)
    figure = style.new_figure(width, 2.3 * rows + 0.4)
    grid = figure.subplots(2 * rows, columns, sharex=True, sharey="row", squeeze=False, height_ratios=[3.0, 1.0] * rows)
    panels = []
    for index, (upper, lower) in enumerate(zip(grid[::2].flat, grid[1::2].flat, strict=True)):
        if index >= len(methods):
            upper.remove()
            lower.remove()
            continue
        residual = dataset.sel({"method": methods[index]})
        scores = f"{float(residual.rmse):.2f} K, {float(residual.ell):.0f}"
        style.tidy(upper, title=f"{LABELS[methods[index]]} ({scores})", **_DAY)
        style.tidy(lower, y_ticks=2, **_DAY)
        if index % columns == 0:
            upper.set_ylabel("temperature (degC)")
            lower.set_ylabel(heating)
        if index + columns >= len(methods):
            lower.set_xlabel("hour of the day")
        panels.append((residual, upper, lower))
    style.note_below(figure, "In brackets: root mean squared error and log likelihood of the day.")
    return figure, panels


@style.styled
def plot_residual(data: Data, *, width: str | float = "full") -> Figure:
    """Draw the smoothed residual of the real house for each day, with the band of the predicted day."""
    figure, panels = style.in_a_row(width, 2, 2.6, sharey=True)
    colours, hours = ("#BBBBBB", style.SKY, style.GREEN, style.PURPLE), np.arange(problem.DAY)
    for axes, method in zip(panels, ("SQM", "matern"), strict=True):
        results = data["house"].isel(store=0).sel({"method": method})
        *days, last = results.residual.values.reshape(-1, problem.DAY)
        for day, (mean, colour) in enumerate(zip(days, colours, strict=True), start=1):
            axes.plot(hours, mean, color=colour, lw=0.9, label=f"day {day}")
        axes.plot(hours, last, color=style.BLUE, lw=1.4, label="day 5, predicted")
        band(axes, hours, last, results.residual_sd.values[-problem.DAY:], color=_WIDE, label="its 95% band")
        axes.axhline(0.0, color=style.BLACK, lw=0.5)
        style.tidy(axes, xticks=_DAY["xticks"], title=LABELS[method], xlabel="hour of the day")
    panels[0].set_ylabel("residual heat (K/h)")
    legend(figure)
    return figure


@style.styled
def plot_scores(data: Data, *, width: str | float = "full") -> Figure:
    """Draw the day-ahead RMSE of every residual with two standard errors, and quartiles of the log likelihood."""
    kinds = {"simulated homes": data["homes"]}
    if "house" in data:
        kinds["real house"] = select_prefix(data["house"], "ahead")
    methods, stores = data["homes"].method.values, data["homes"].store.values
    figure, positions = style.new_figure(width, 2.1 * len(kinds) + 0.3), np.arange(len(methods))
    grid = figure.subplots(len(kinds), 2, squeeze=False)
    for (title, dataset), (rmse_axes, ell_axes) in zip(kinds.items(), grid, strict=True):
        for index, store in enumerate(stores):
            store_scores, x = dataset.sel(store=store), positions + 0.16 * (index - 0.5)
            bars(rmse_axes, x, [estimate_mean(errors) for errors in store_scores.rmse], **_MARKS[store])
            low, middle, high = store_scores.ell.quantile([0.25, 0.5, 0.75], "dataset", skipna=False).values
            ell_axes.errorbar(x, middle, [middle - low, high - middle], ls="", ms=3.0, elinewidth=0.8, capsize=1.5,
                              **_MARKS[store])
        for axes, ylabel in ((rmse_axes, "RMSE a day ahead (K)"), (ell_axes, "log likelihood of a day")):
            style.tidy(axes, xlim=(-0.5, len(positions) - 0.5), ylabel=ylabel, title=title)
            axes.set_xticks(positions, [LABELS[method] for method in methods], rotation=30, ha="right")
        ell_axes.set_yscale("symlog", linthresh=20.0)
    legend(figure, *(line(store, ls="", ms=3.0, **_MARKS[store]) for store in stores))
    style.note_below(figure, "Left: means and two standard errors. Right: medians and quartiles; the axis is linear "
                             "near zero and logarithmic beyond 20.")
    return figure
