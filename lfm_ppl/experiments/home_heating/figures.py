"""Fans of the day ahead, the residual cycle by cycle, and the scores of all residuals."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments.drawing import TRUTH, band, legend, line
from lfm_ppl.experiments.home_heating import prediction, problem, tables
from lfm_ppl.experiments.scores import mean_of
from lfm_ppl.results.plots import style

LABELS = {"none": "no residual", "matern": "Matern", **{name: name for name in ("SQM", "CQM", "WQM", "periodic",
                                                                              "resonator")}}
_MEASURED = TRUTH | {"label": "measured"}
_WIDE, _NARROW = "#D6E8F3", "#9CC9E3"
_MARKS = {"one store": (style.BLUE, "o"), "envelope": (style.VERMILLION, "s")}
_SHOWN = ("SQM", "periodic", "CQM", "none", "matern", "resonator")


def draw(settings: Any, results: dict[str, Result]) -> dict[str, Figure]:
    """Return every figure by name."""
    found = {"homes-ahead": plot_homes(settings, results), "scores": plot_scores(settings, results)}
    if settings.data is not None:
        found["house-ahead"] = plot_house(settings, results)
        if all(one in settings.methods for one in ("SQM", "matern")):
            found["residual"] = plot_residual(settings, results)
    return found


@style.styled
def plot_homes(settings: Any, results: dict[str, Result], *, store: str | None = None,
               width: str | float = "full") -> Figure:
    """Draw the fifth day of the first simulated home: temperature with bands, set point, and heater."""
    store = store or settings.stores[0]
    window = problem.home(0, store, settings.seed)
    assert window.fine is not None and window.set_points is not None
    hours = problem.FINE[prediction.SCORED] - problem.TRAIN
    truth, heater = window.fine[prediction.SCORED][:, [0, 2]].T
    figure, panels = _grid(settings.methods, width)
    for method, (upper, lower) in panels.items():
        found = tables.of(results, "homes", store, method)
        low, quarter, middle, upper_quarter, high = found["quantiles"]
        upper.plot(hours, middle, color=style.BLUE, label="predicted")
        upper.fill_between(hours, low, high, color=_WIDE, lw=0, label="95% band")
        upper.fill_between(hours, quarter, upper_quarter, color=_NARROW, lw=0, label="50% band")
        upper.step(np.arange(problem.DAY + 1), np.append(*2 * [window.set_points[problem.TRAIN:]])[:problem.DAY + 1],
                   where="post", color=style.GREEN, lw=0.8, label="set point")
        upper.plot(hours, truth, **_MEASURED)
        _score(upper, method, found["rmse"][0], found["ell"][0])
        lower.fill_between(hours, heater, step="post", color="#D0D0D0", lw=0, label="heater on")
        lower.plot(hours, found["on"][0], color=style.VERMILLION, lw=0.8, label="predicted probability")
        lower.set_ylim(0.0, 1.05)
    _finish(figure, panels, "heater on")
    legend(figure)
    return figure


@style.styled
def plot_house(settings: Any, results: dict[str, Result], *, store: str | None = None,
               width: str | float = "full") -> Figure:
    """Draw the fifth day of one window of the real house: temperature with bands, and its known heating power."""
    store = store or settings.stores[0]
    window = problem.house(settings.data)[settings.shown]
    hours = np.arange(problem.DAY)
    figure, panels = _grid(settings.methods, width)
    for method, (upper, lower) in panels.items():
        found = tables.of(results, "house", store, method)
        mean, sd = found["mean"][settings.shown], found["sd"][settings.shown]
        upper.plot(hours, mean, color=style.BLUE, label="predicted")
        band(upper, hours, mean, sd, color=_WIDE)
        band(upper, hours, mean, sd, color=_NARROW, z=0.6745, label="50% band")
        upper.plot(hours, window.y[problem.TRAIN:, 0], **_MEASURED)
        _score(upper, method, found["ahead_rmse"][settings.shown], found["ahead_ell"][settings.shown])
        lower.fill_between(hours, window.y[problem.TRAIN:, 2], step="post", color="#D0D0D0", lw=0,
                           label="heating power (100 units)")
        lower.set_ylim(bottom=0.0)
    _finish(figure, panels, "power")
    legend(figure)
    return figure


@style.styled
def plot_residual(settings: Any, results: dict[str, Result], *, width: str | float = "full") -> Figure:
    """Draw the smoothed residual of the real house day by day, with the band of the day that is predicted."""
    figure, panels = style.in_a_row(width, 2, 2.6, sharey=True)
    colours = ("#BBBBBB", style.SKY, style.GREEN, style.PURPLE)
    hours = np.arange(problem.DAY)
    for axes, method in zip(panels, ("SQM", "matern"), strict=True):
        found = tables.of(results, "house", settings.stores[0], method)
        mean, sd = (found[name].reshape(-1, problem.DAY) for name in ("residual", "residual_sd"))
        for day in range(problem.TRAIN_DAYS):
            axes.plot(hours, mean[day], color=colours[day], lw=0.9, label=f"day {day + 1}")
        axes.plot(hours, mean[-1], color=style.BLUE, lw=1.4, label="day 5, predicted")
        band(axes, hours, mean[-1], sd[-1], color=_WIDE, label="its 95% band")
        axes.axhline(0.0, color=style.BLACK, lw=0.5)
        style.tidy(axes)
        axes.set_xticks([0, 6, 12, 18, 24])
        axes.set_title(LABELS[method])
        axes.set_xlabel("hour of the day")
    panels[0].set_ylabel("residual heat (K/h)")
    legend(figure)
    return figure


@style.styled
def plot_scores(settings: Any, results: dict[str, Result], *, width: str | float = "full") -> Figure:
    """Draw day-ahead RMSE of every residual with two standard errors, and the quartiles of its log likelihood."""
    kinds = [("homes", "", "simulated homes")] + ([("house", "ahead_", "real house")] if settings.data else [])
    figure = style.new_figure(width, 2.1 * len(kinds) + 0.3)
    grid = figure.subplots(len(kinds), 2, squeeze=False)
    places = np.arange(len(settings.methods))
    for (what, prefix, label), row in zip(kinds, grid, strict=True):
        for axes, score, axis in zip(row, ("rmse", "ell"), ("RMSE a day ahead (K)", "log likelihood of a day"),
                                     strict=True):
            for index, store in enumerate(settings.stores):
                values = [tables.of(results, what, store, method)[prefix + score] for method in settings.methods]
                colour, marker = _MARKS[store]
                if score == "rmse":
                    means = [mean_of(one) for one in values]
                    middle, bars = [one.value for one in means], 2 * np.array([[one.error for one in means]] * 2)
                else:
                    low, middle, high = np.array([np.quantile(one, [0.25, 0.5, 0.75]) for one in values]).T
                    bars = np.stack([middle - low, high - middle])
                axes.errorbar(places + 0.16 * (index - 0.5), middle, bars, color=colour, marker=marker, ls="", ms=3.0,
                              elinewidth=0.8, capsize=1.5)
            style.tidy(axes)
            axes.set_xlim(-0.5, len(places) - 0.5)
            axes.set_xticks(places, [LABELS[method] for method in settings.methods], rotation=30, ha="right")
            axes.set_ylabel(axis)
            axes.set_title(label)
            if score == "ell":
                axes.set_yscale("symlog", linthresh=20.0)
    legend(figure, *(line(store, _MARKS[store][0], "", marker=_MARKS[store][1], ms=3.0) for store in settings.stores))
    style.note_below(figure, "Left: means and two standard errors. Right: medians and quartiles; the axis is linear "
                             "near zero and logarithmic beyond 20.")
    return figure


def _grid(methods: tuple[str, ...], width: str | float) -> tuple[Figure, dict[str, tuple[Axes, Axes]]]:
    shown = [method for method in _SHOWN if method in methods] or list(methods)
    columns = min(3, len(shown))
    rows = -(-len(shown) // columns)
    figure = style.new_figure(width, 2.3 * rows + 0.4)
    grid = figure.subplots(2 * rows, columns, sharex=True, sharey="row", squeeze=False,
                           height_ratios=[3.0, 1.0] * rows)
    panels = {}
    for index, method in enumerate(shown):
        row, column = divmod(index, columns)
        panels[method] = (grid[2 * row, column], grid[2 * row + 1, column])
    for index in range(len(shown), rows * columns):
        row, column = divmod(index, columns)
        grid[2 * row, column].remove()
        grid[2 * row + 1, column].remove()
    return figure, panels


def _finish(figure: Figure, panels: dict[str, tuple[Axes, Axes]], label: str) -> None:
    columns = min(3, len(panels))
    for index, (upper, lower) in enumerate(panels.values()):
        for axes in (upper, lower):
            style.tidy(axes, y_ticks=4 if axes is upper else 2)
            axes.set_xlim(0.0, float(problem.DAY))
            axes.set_xticks([0, 6, 12, 18, 24])
        if index % columns == 0:
            upper.set_ylabel("temperature (degC)")
            lower.set_ylabel(label)
        if index + columns >= len(panels):
            lower.set_xlabel("hour of the day")
    style.note_below(figure, "In brackets: root mean squared error and log likelihood of the day.")


def _score(axes: Axes, method: str, rmse: float, ell: float) -> None:
    axes.set_title(f"{LABELS[method]} ({rmse:.2f} K, {ell:.0f})")
