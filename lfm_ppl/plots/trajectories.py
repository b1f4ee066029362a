"""Figures of the forces, the states and the deterministics over time.

1. Select the trajectories of one kind, and their predictions; beside a short forecast, the last rows only.
2. Draw the mean, the 95% band, forecasts after the last observation and the truth.
3. Draw all regimes of a switching model in one panel: the areas of their probabilities, which sum to one.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lfm_ppl.plots import forecasts, style
from lfm_ppl.plots.bands import band_of, draw_band, draw_truth, trajectories_of, true_path
from lfm_ppl.plots.panels import MAX_PANELS, finish, pick, recent_series
from lfm_ppl.results.predictions import PERIODS, REGIMES, SHOWN_PERIODS, repeats_often
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.results.scalars import unit_of

_PROBABILITY = "probability"
_FORCE, _DETERMINISTIC = "#9AD3C1", "#F3CFA3"
"""Tints of the line colours."""


@style.styled
def plot_forces(result: Any, forces: Sequence[str] | None = None, *, series: Any = None,
                width: str | float = "column") -> Figure:
    """Draw the posterior mean of each force with a 95% band, the forecast of it, and the truth where they are known.

    Args:
        result: with the group trajectories, predictions of a forecast, and truth where it is known.
        forces: names; None for all, up to 12.
        series: labels or positions of series of a panel; None for all, up to a dozen.
        width: "column" (3.4 in), "full" (7 in), or inches.

    Returns:
        A figure with one panel per force, and for each series of a panel.

    Raises:
        ValueError: the result holds no force trajectories, or a force is unknown.

    Example:
        >>> from lfm_ppl.results.arviz_data import build
        >>> dims = ("chain", "draw", "time", "force")
        >>> draws = xr.Dataset({"forces": (dims, np.zeros((2, 5, 10, 1)))})
        >>> draws = draws.assign_coords({"time": np.linspace(0.0, 9.0, 10), "force": ["p53"]})
        >>> figure = plot_forces(build({"trajectories": draws}), ["p53"], width="full")
        >>> [axes.get_ylabel() for axes in figure.axes]
        ['p53']
    """
    return _draw_kind(ResultView.of(result), "force", forces, series, width, (style.GREEN, _FORCE))


@style.styled
def plot_states(result: Any, states: Sequence[str] | None = None, *, series: Any = None,
                width: str | float = "column") -> Figure:
    """Draw the posterior mean of each state with a 95% band, the forecast of it, and the truth where they are known.

    The regimes of `lfm_ppl.Switching` share a panel with their probabilities, and a strip above of the true regime.

    Args:
        result: with the group trajectories, predictions of a forecast, and truth where it is known.
        states: names; None for all, up to 12.
        series: labels or positions of series of a panel; None for all, up to a dozen.
        width: "column" (3.4 in), "full" (7 in), or inches.

    Returns:
        A figure with one panel per state and one for all regimes, and for each series of a panel.

    Raises:
        ValueError: the result holds no state trajectories, or a state is unknown.

    Example:
        >>> from lfm_ppl.results.arviz_data import build
        >>> dims = ("chain", "draw", "time", "state")
        >>> draws = xr.Dataset({"states": (dims, np.zeros((2, 5, 10, 2)))})
        >>> draws = draws.assign_coords({"time": np.linspace(0.0, 9.0, 10), "state": ["x", "v"]})
        >>> [axes.get_ylabel() for axes in plot_states(build({"trajectories": draws})).axes]
        ['x', 'v']
    """
    return _draw_kind(ResultView.of(result), "state", states, series, width, (style.BLUE, forecasts.NOISE_FREE))


@style.styled
def plot_deterministics(result: Any, names: Sequence[str] | None = None, *, series: Any = None,
                        width: str | float = "column") -> Figure:
    """Draw the posterior mean of the deterministics with a 95% band, its forecast, and its truth.

    Args:
        result: with the group trajectories, of a model with ``deterministics``, predictions, and truth where known.
        names: of the deterministics; None for all, up to 12.
        series: labels or positions of series of a panel; None for all, up to a dozen.
        width: "column" (3.4 in), "full" (7 in), or inches.

    Returns:
        A figure with one panel for each, and for each series of a panel.

    Raises:
        ValueError: the result holds none, or a name is unknown.

    Example:
        >>> from lfm_ppl.results.arviz_data import build
        >>> dims = ("chain", "draw", "time", "deterministic")
        >>> draws = xr.Dataset({"deterministics": (dims, np.zeros((2, 5, 10, 1)))})
        >>> draws = draws.assign_coords({"time": np.linspace(0.0, 9.0, 10), "deterministic": ["uptake"]})
        >>> [axes.get_ylabel() for axes in plot_deterministics(build({"trajectories": draws})).axes]
        ['uptake']
    """
    return _draw_kind(ResultView.of(result), "deterministic", names, series, width, (style.ORANGE, _DETERMINISTIC))


def _draw_kind(view: ResultView, kind: str, selection: Sequence[str] | None, series: Any, width: str | float,
               colours: tuple[str, str]) -> Figure:
    """Draw a panel for each force, state or deterministic, its mean and band in the two ``colours``."""
    draws = trajectories_of(view, kind)
    names, note = style.first_of(pick(draws, kind, selection), selection, MAX_PANELS, f"{kind}s")
    regimes = [name for name in json.loads(draws.attrs.get(REGIMES, "[]")) if name in names]
    names = [name for name in names if name not in regimes] + [_PROBABILITY] * bool(regimes)
    parts, remark = recent_series(view, series, len(names))
    windows = {name: window for part in parts.values() for name, window in _season_windows(
        trajectories_of(part, kind), forecasts.forecast_span(part)[1]).items()}
    figure, panels = style.small_multiples(width, len(parts) * len(names), 1.25, not set(windows) & set(names))
    for axes, (name, (title, part)) in zip(panels, itertools.product(names, parts.items()), strict=True):
        predicted = forecasts.series_predictions(part)
        paths = None if predicted is None else predicted.get(f"{kind}s")
        if regimes and name == _PROBABILITY:
            _draw_regimes(axes, part, paths, regimes, title)
            continue
        band = np.array(band_of(part, kind, name))
        first, last = windows.get(name, (-np.inf, np.inf))
        time, mean, low, high = band[:, band[0] >= first]
        draw_band(axes, (time, mean, low, high), *colours, "95%")
        if paths is not None:
            later = paths.sel({kind: name, "time": (paths["time"] > time[-1]) & (paths["time"] <= last)})
            forecasts.draw_paths(axes, later, (time[-1], mean[-1], low[-1], high[-1]), *colours)
            forecasts.mark_last_observation(axes, part)
        draw_truth(axes, part, kind, name)
        style.label_values(axes, name, unit_of(draws, name), title)
    shortened = [name for name in names if name in windows]
    periods = f"Of {', '.join(shortened)} {SHOWN_PERIODS} periods at the end of the data." if shortened else ""
    finish(figure, panels, view, f"{remark} {periods} {note}")
    return figure


def _draw_regimes(axes: Axes, view: ResultView, paths: xr.DataArray | None, regimes: Sequence[str], title: str) -> None:
    """Draw the probabilities of the regimes as areas, with their predictions (chain, draw, time, state) or None."""
    probability = trajectories_of(view, "state").sel(state=list(regimes)).mean(["chain", "draw"])
    times = probability["time"].values
    if paths is not None:
        later = paths.sel(state=list(regimes), time=paths["time"] > times[-1]).mean(["chain", "draw"])
        probability = xr.concat([probability, later], "time", coords="minimal", compat="override")
        forecasts.mark_last_observation(axes, view)
    colours = dict(zip(regimes, itertools.cycle(style.CHAIN_COLOURS), strict=False))
    axes.stackplot(probability["time"].values, probability.transpose("state", "time").values, labels=regimes, lw=0,
                   colors=colours.values(), alpha=0.6)
    ticks = {0.0: "0", 0.5: "0.5", 1.0: "1"}
    for regime, colour in colours.items():
        truth = true_path(axes, view, "state", regime)
        if truth is not None:
            axes.fill_between(truth[0], 1.05, 1.05 + 0.1 * truth[1], step="mid", color=colour, lw=0)
            ticks[1.1] = "truth"
    axes.set(ylim=(0.0, max(ticks) + 0.05 * (len(ticks) > 3)), ylabel=_PROBABILITY, title=title)
    axes.set_yticks(list(ticks), list(ticks.values()))


def _season_windows(draws: xr.DataArray, end: float) -> dict[str, tuple[float, float]]:
    """Return the interval of time to show of each force that repeats often, about the end of its trajectories."""
    times = draws["time"].values
    periods = json.loads(draws.attrs.get(PERIODS, "{}"))
    return {name: (times[-1] - SHOWN_PERIODS * period, times[-1] + SHOWN_PERIODS * period)
            for name, period in periods.items() if repeats_often(period, max(end, times[-1]) - times[0])}


