"""Figures over time: the fit to the data, the forces, the states.

1. Select the trajectories of one kind, and their predictions; beside a short forecast, the last rows only.
2. Draw the mean and the 95% band, from the mixture over the draws if it is stored, else from the draws.
3. Draw forecasts after the last observation, missing values, held-out data and the truth.
4. Draw all regimes of a switching model in one panel: the areas of their probabilities, which sum to one.
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
from lfm_ppl.results.predictions import INTERVAL, PERIODS, REGIMES, SHOWN_PERIODS, quantiles, repeats_often
from lfm_ppl.results.result_view import ENTRY, ResultView
from lfm_ppl.results.scalars import unit_of
from lfm_ppl.results.series import series_view
from lfm_ppl.utils.checks import one_of

MAX_PANELS = 12
_MANY = 150  # measurements
_PROBABILITY = "probability"
_FORCE, _DETERMINISTIC = "#9AD3C1", "#F3CFA3"
"""Tints of the line colours."""


@style.styled
def plot_fit(result: Any, outputs: Sequence[str] | None = None, *, series: Any = None,
             width: str | float = "column") -> Figure:
    """Draw the data of each output with the posterior of what was measured, and forecasts of it.

    The inner band holds 95% of the noise-free output, the outer one 95% of new measurements. Where the result has
    predictions, both go on after the last observation, which a dotted line marks, and the outer band is theirs; at
    fewer than 12 times they are drawn as bars, which lines join. Of a forecast that was made after the fit and would
    fill less than a fifth of the axis, the figure shows the last rows only. Bands follow the summaries that the
    trajectories hold; where they hold draws alone, they are quantiles of these, and the outer one ends with the data:
    it is exact at the measurement times, and between them the inner one widened by the difference of the two,
    interpolated linearly; of counts it is a step at each time. Replicates are pooled. Of simulated data the
    noise-free truth is drawn, too. A band shows the model as it is: under Gaussian noise new data of a positive
    quantity may be negative; observe its logarithm, or use an observation family of positive values.

    Args:
        result: with the groups data and trajectories, posterior_predictive for the outer band, predictions for
            forecasts, which alone are drawn of a result without trajectories, such as a partial one, held_out_data that
            these were compared with, and truth where it is known.
        outputs: names; None for all, up to 12.
        series: labels or positions of series of a panel; None for all, up to a dozen.
        width: "column" (3.4 in), "full" (7 in), or inches.

    Returns:
        A figure with one panel per output, and for each series of a panel. Ticks at the top mark the times of missing
        values, triangles at the bottom the times of doses.

    Raises:
        ValueError: a group is missing, or an output is unknown.

    Example:
        >>> from lfm_ppl.results.arviz_data import build
        >>> time = np.linspace(0.0, 9.0, 10)
        >>> dims = ("chain", "draw", "time", "output")
        >>> mean = xr.Dataset({"outputs": (dims, np.ones((2, 5, 10, 1)))})
        >>> data = xr.Dataset({"y": (("time", "output"), np.ones((10, 1)), {"units": "nM"})})
        >>> mean = mean.assign_coords({"time": time, "output": ["mRNA"]})
        >>> data = data.assign_coords({"time": time, "output": ["mRNA"]})
        >>> figure = plot_fit(build({"trajectories": mean, "data": data}))
        >>> figure.axes[0].get_ylabel()
        'mRNA (nM)'
    """
    view = ResultView.of(result)
    view.refuse_several_sites()
    observed = view.group("data")["y"]
    names, note = style.first_of(pick(observed, "output", outputs), outputs, MAX_PANELS, "outputs")
    parts, remark = recent_series(view, series, len(names))
    figure, panels = style.small_multiples(width, len(parts) * len(names), 1.35)
    for axes, (name, (title, part)) in zip(panels, itertools.product(names, parts.items()), strict=True):
        _draw_output(axes, part, name)
        forecasts.mark_last_observation(axes, part)
        _draw_truth(axes, part, "output", name)
        _draw_data(axes, part, name)
        forecasts.draw_held_out(axes, part, name)
        _draw_events(axes, part)
        style.label_values(axes, name, unit_of(observed, name), title)
    finish(figure, panels, view, f"{remark} {note}")
    return figure


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


def pick(variable: xr.DataArray, kind: str, selection: Sequence[str] | None) -> list[str]:
    """Return the names along ``kind`` to draw: those wanted, or all; refuse unknown ones."""
    available = [str(name) for name in variable[kind].values]
    if selection is None:
        return available
    selection = [selection] if isinstance(selection, str) else list(selection)
    for name in selection:
        one_of(kind, name, available)
    if not selection:
        raise ValueError(f"{kind}s is empty; name at least one of {', '.join(available)}.")
    return selection


def series_views(view: ResultView, series: Any, count: int) -> tuple[dict[str, ResultView], str]:
    """Return the series of a panel to draw, and a remark where some are left out.

    Args:
        view: of a panel, or of one series.
        series: labels or positions; None for all, as many as have room.
        count: number of axes of each series.

    Returns:
        Title -> view of one series; without a title where ``view`` is of one.
    """
    if view.series_dimension is None:
        if series is not None:
            raise ValueError("series selects series of a panel, and the result is of one series; leave it out.")
        return {"": view}, ""
    labels = view.series_labels if series is None else [series] if np.ndim(series) == 0 else list(series)
    labels, note = style.first_of(labels, series, max(1, MAX_PANELS // count), "series")
    members = [series_view(view, label) for label in labels]
    return {member.attrs["selected"]: member for member in members}, note


def recent_series(view: ResultView, series: Any, count: int) -> tuple[dict[str, ResultView], str]:
    """Return `series_views` within the window of a forecast, and a remark."""
    views, note = series_views(view, series, count)
    parts = {title: forecasts.recent_part(member) for title, member in views.items()}
    remarks = {remark for _, remark in parts.values() if remark}
    if len(remarks) > 1:
        remarks = {"The last rows of data and the forecast."}
    return {title: part for title, (part, _) in parts.items()}, " ".join([*remarks, note])


def _draw_kind(view: ResultView, kind: str, selection: Sequence[str] | None, series: Any, width: str | float,
               colours: tuple[str, str]) -> Figure:
    """Draw a panel for each force, state or deterministic, its mean and band in the two ``colours``."""
    draws = _trajectories(view, kind)
    names, note = style.first_of(pick(draws, kind, selection), selection, MAX_PANELS, f"{kind}s")
    regimes = [name for name in json.loads(draws.attrs.get(REGIMES, "[]")) if name in names]
    names = [name for name in names if name not in regimes] + [_PROBABILITY] * bool(regimes)
    parts, remark = recent_series(view, series, len(names))
    windows = {name: window for part in parts.values() for name, window in _season_windows(
        _trajectories(part, kind), forecasts.forecast_span(part)[1]).items()}
    figure, panels = style.small_multiples(width, len(parts) * len(names), 1.25, not set(windows) & set(names))
    for axes, (name, (title, part)) in zip(panels, itertools.product(names, parts.items()), strict=True):
        predicted = forecasts.series_predictions(part)
        paths = None if predicted is None else predicted.get(f"{kind}s")
        if regimes and name == _PROBABILITY:
            _draw_regimes(axes, part, paths, regimes, title)
            continue
        band = np.array(_band(part, kind, name))
        first, last = windows.get(name, (-np.inf, np.inf))
        time, mean, low, high = band[:, band[0] >= first]
        _draw_band(axes, (time, mean, low, high), *colours, "95%")
        if paths is not None:
            later = paths.sel({kind: name, "time": (paths["time"] > time[-1]) & (paths["time"] <= last)})
            forecasts.draw_paths(axes, later, (time[-1], mean[-1], low[-1], high[-1]), *colours)
            forecasts.mark_last_observation(axes, part)
        _draw_truth(axes, part, kind, name)
        style.label_values(axes, name, unit_of(draws, name), title)
    shortened = [name for name in names if name in windows]
    periods = f"Of {', '.join(shortened)} {SHOWN_PERIODS} periods at the end of the data." if shortened else ""
    finish(figure, panels, view, f"{remark} {periods} {note}")
    return figure


def _draw_regimes(axes: Axes, view: ResultView, paths: xr.DataArray | None, regimes: Sequence[str], title: str) -> None:
    """Draw the probabilities of the regimes as areas, with their predictions (chain, draw, time, state) or None."""
    probability = _trajectories(view, "state").sel(state=list(regimes)).mean(["chain", "draw"])
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
        truth = _true_path(axes, view, "state", regime)
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


def finish(figure: Figure, panels: list[Axes], view: ResultView, remark: str) -> None:
    """Label the time of all panels, and add a legend and a remark."""
    style.label_time(panels, view.time_unit, view.time_origin)
    figure.align_ylabels(panels)
    style.legend_above(figure)
    style.note_below(figure, remark)


def _trajectories(view: ResultView, kind: str) -> xr.DataArray:
    dataset = view.group("trajectories")
    if f"{kind}s" not in dataset or dataset.sizes[kind] == 0:
        raise ValueError(f"the result holds no {kind} trajectories; its group trajectories has "
                         f"{', '.join(map(str, dataset.data_vars))}. They come from lfm.fit with trajectory_draws "
                         f"above zero, for a model that has {kind}s.")
    return dataset[f"{kind}s"].transpose("chain", "draw", ..., "time", kind)


def _draw_truth(axes: Axes, view: ResultView, kind: str, name: str) -> None:
    """Draw the true trajectory where it is known, as far as the axes are in use."""
    truth = _true_path(axes, view, kind, name)
    if truth is not None:
        axes.plot(*truth, **style.TRUTH)


def _true_path(axes: Axes, view: ResultView, kind: str, name: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Return times and values of the true trajectory, as far as the axes are in use; None where it is unknown."""
    truth = view.groups.get("truth", xr.Dataset()).get(f"{kind}s")
    if truth is None or kind not in truth.dims or name not in truth[kind].values:
        return None
    times, (low, high) = truth["time"].values, axes.dataLim.intervalx
    is_shown = (times >= low) & (times <= high) | (low > high)  # nothing else is drawn yet
    return (times[is_shown], truth.sel({kind: name}).values[is_shown]) if is_shown.any() else None


def _draw_output(axes: Axes, view: ResultView, name: str) -> None:
    """Draw mean and bands of an output, and what is predicted of it."""
    predicted = forecasts.series_predictions(view)
    predicted = None if predicted is None else predicted.sel(output=[name])
    if predicted is not None and "trajectories" not in view.groups:
        return forecasts.draw_outputs(axes, predicted)
    time, mean, low, high = _band(view, "output", name)
    is_covered = predicted is not None and set(time.tolist()) <= set(predicted["time"].values.tolist())
    if predicted is not None and is_covered and _summary(view, "outputs") is None:
        return forecasts.draw_outputs(axes, predicted)
    outer = _draw_new_data(axes, view, name, predicted if is_covered else None, (time, low, high))
    _draw_band(axes, (time, mean, low, high), style.BLUE, forecasts.NOISE_FREE, "95%, noise-free")
    if predicted is not None and not is_covered:
        later = predicted.isel(time=predicted["time"].values > time[-1])
        forecasts.draw_outputs(axes, later, (time[-1], mean[-1], *outer, low[-1], high[-1]))


def _draw_band(axes: Axes, curves: Sequence[np.ndarray], line: str, tint: str, label: str) -> None:
    """Draw mean and band of times, mean and ends; at few times as bars that lines join."""
    time, mean, low, high = curves
    if len(time) < forecasts.CURVES:
        return forecasts.draw_curves(axes, curves, (), line, {label: tint})
    axes.fill_between(time, low, high, color=tint, lw=0, zorder=2, label=label)
    axes.plot(time, mean, color=line, zorder=3, label="posterior mean")


def _draw_new_data(axes: Axes, view: ResultView, name: str, predicted: xr.Dataset | None,
                   inner: tuple[np.ndarray, np.ndarray, np.ndarray]) -> tuple[float, float]:
    """Draw the band of new data about ``inner``, times and ends of the noise-free band; return its last ends."""
    summary, step = _summary(view, "new_data"), None
    band: tuple[np.ndarray, ...]
    if summary is not None:
        band = (inner[0], *summary.sel(output=name).values[1:])
    elif predicted is not None:
        band = forecasts.new_data_band(predicted)
    elif "posterior_predictive" in view.groups:
        draws = view.groups["posterior_predictive"]["y"].transpose("chain", "draw", ENTRY)
        draws = draws.isel({ENTRY: draws["output"].values == name})
        if not draws.sizes[ENTRY]:
            return inner[1][-1], inner[2][-1]
        band, step = _band_of_draws(draws, *inner)
    else:
        return inner[1][-1], inner[2][-1]
    time, low, high = band
    if len(time) < forecasts.CURVES and step is None:
        axes.vlines(time, low, high, color=forecasts.PREDICTIVE, lw=7.0, zorder=0.9)
    axes.fill_between(time, low, high, color=forecasts.PREDICTIVE, lw=0, zorder=1, step=step, label="95%, new data")
    return low[-1], high[-1]


def _band_of_draws(predictive: xr.DataArray, positions: np.ndarray, low: np.ndarray,
                   high: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], Any]:
    """Return times and ends of the predictive interval, from the first to the last measurement, and its kind of step.

    Whole numbers have it at their own times alone. Other draws have it in between as well, within the range of the
    draws, so that the band of a positive quantity stays positive.
    """
    measured, which = np.unique(predictive["time"].values, return_inverse=True)
    draws = predictive.values.reshape(-1, predictive.sizes[ENTRY])
    bounds = np.array([quantiles(draws[:, which == k].ravel(), INTERVAL) for k in range(len(measured))])
    if np.all(draws == np.round(draws)):
        return (measured, bounds[:, 0], bounds[:, 1]), "mid"
    grid = np.union1d(measured, positions[(positions >= measured[0]) & (positions <= measured[-1])])
    bound_curves = [np.interp(grid, positions, curve)
                    + np.interp(grid, measured, bound - np.interp(measured, positions, curve))
                    for curve, bound in zip((low, high), bounds.T, strict=True)]
    lower, upper = np.clip(bound_curves, np.nanmin(draws), np.nanmax(draws))
    return (grid, lower, upper), None


def _band(view: ResultView, kind: str, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return times, mean and the ends of the 95% interval of a state, force or output, by its density if known."""
    draws = _trajectories(view, kind).sel({kind: name})
    summary = _summary(view, f"{kind}s")
    if summary is not None:
        return draws["time"].values, *summary.sel({kind: name}).values
    flat = draws.values.reshape(-1, draws.sizes["time"])
    low, high = np.quantile(flat, INTERVAL, axis=0)
    return draws["time"].values, flat.mean(axis=0), low, high


def _summary(view: ResultView, name: str) -> xr.DataArray | None:
    """Return the summary (statistic, time, ...) of trajectories; None where there are draws alone."""
    summary = view.group("trajectories").get(f"{name}_summary")
    return None if summary is None else summary.transpose("statistic", "time", ...)


def _draw_data(axes: Axes, view: ResultView, name: str) -> None:
    """Draw measurements of an output, many of them small, and ticks at the top edge where one is missing.

    Rows of a data file that hold a dose or a reset and no measurement are not missing.
    """
    observed = view.group("data")["y"]
    times, values = observed["time"].values, observed.sel(output=name).values
    event_times = [np.append(table.times, [] if table.resets is None else table.resets)
                   for table in view.inputs.values() if table.is_dose]
    is_event = np.isin(times, np.concatenate([np.zeros(0), *event_times])) & observed.isnull().all("output").values
    is_missing = np.isnan(values) & ~is_event
    look: dict[str, Any] = {"color": style.BLACK, "ms": 2.6, "mec": "white", "mew": 0.3, "zorder": 4}
    if len(times) > _MANY:
        look = {"color": style.GREY, "ms": 1.5, "mew": 0, "zorder": 2.5}
    is_measured = ~np.isnan(values)
    axes.plot(times[is_measured], values[is_measured], ls="", marker="o", rasterized=len(times) > 5000, label="data",
              **look)
    if is_missing.any():
        axes.plot(times[is_missing], np.full(is_missing.sum(), 0.98), transform=axes.get_xaxis_transform(), ls="",
                  color=style.GREY, marker="|", ms=4, mew=0.8, zorder=5, label="missing")


def _draw_events(axes: Axes, view: ResultView) -> None:
    """Draw marks at the bottom edge at the times of doses and resets, as far as the axes are in use."""
    tables = [table for table in (view.inputs | view.forecast_inputs).values() if table.is_dose]
    end = axes.dataLim.intervalx[1]
    height: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "zorder": 5}
    marks: dict[str, Any] = {"ls": "", "ms": 3.5, "mew": 0.0}
    doses, durations = (np.concatenate([np.zeros(0), *(array for array in arrays)]) for arrays in zip(
        *((table.times, table.durations_of_all) for table in tables), strict=True)) if tables else (np.zeros(0),) * 2
    resets = np.concatenate([np.zeros(0), *(table.resets for table in tables if table.resets is not None)])
    is_infusion = (durations > 0) & (doses <= end)
    if is_infusion.any():
        end_times = np.minimum(doses + durations, end)[is_infusion]
        axes.hlines(np.full(len(end_times), 0.03), doses[is_infusion], end_times, color=style.PURPLE, lw=1.5,
                    label="infusion", **height)
    for times, marker, label in ((doses[(durations == 0) & (doses <= end)], "^", "dose"),
                                 (resets[resets <= end], "v", "reset")):
        if len(times):
            axes.plot(times, np.full(len(times), 0.03), marker=marker, color=style.PURPLE, label=label, **marks,
                      **height)
