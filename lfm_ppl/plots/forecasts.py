"""Forecasts in the figures over time: the rows that are shown before them, and their curves.

1. Next to a forecast that was made after the fit and is short beside the data, `recent_part` keeps the last rows only.
2. Mean and bands continue the curves of the fit. Predictions at few times are bars, joined by thin straight lines: the
   curve between them is unknown.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from lfm_ppl.plots import style
from lfm_ppl.results.inputs import FORECAST
from lfm_ppl.results.inputs import GROUP as CONSTANT
from lfm_ppl.results.predictions import GROUP, HELD_OUT, INTERVAL, MEAN, interval, noise_free_interval
from lfm_ppl.results.result_view import ENTRY, ResultView
from lfm_ppl.results.series import times_of

NOISE_FREE, PREDICTIVE = "#8FBFDE", "#D3E4F1"
"""Tints of blue: bands of noise-free outputs and of new data."""

CURVES = 12
"""Number of times from which means and bands are drawn as curves."""

_LONGEST_GAP = 3.0  # usual gaps between predictions that a curve crosses; nights without rows are longer
_SMALLEST_SHARE, _FEWEST_ROWS = 0.2, 20
"""Share of the axis below which a forecast gets a third of it, and rows that are shown before it at least."""


def series_predictions(view: ResultView) -> xr.Dataset | None:
    """Return the predictions of one series, or of all series of a panel; None where there are none."""
    if (dataset := view.groups.get(GROUP)) is None:
        return None
    return dataset.drop_duplicates("time") if "time" in dataset.indexes else dataset


def forecast_span(view: ResultView) -> tuple[float, float]:
    """Return the times of the last observation and of the last prediction; minus infinity without predictions."""
    predicted = series_predictions(view)
    if predicted is None or predicted.sizes["time"] == 0:
        return -np.inf, -np.inf
    end = float(times_of(predicted).values.max())
    return float(predicted.attrs.get("last_observation", end)), end


def is_made_later(view: ResultView) -> bool:
    """Return whether the predictions reach beyond the data and the trajectories of the fit."""
    last, end = forecast_span(view)
    return last < end and not ("trajectories" in view.groups and
                               times_of(view.groups["trajectories"]).values.max() >= end)


def without_forecast(view: ResultView) -> ResultView:
    """Return the result as the fit left it, without a forecast that was made later."""
    if not is_made_later(view):
        return view
    return view.with_groups({name: dataset for name, dataset in view.groups.items()
                             if name not in (GROUP, HELD_OUT, FORECAST)})


def forecast_window(view: ResultView) -> tuple[float, float] | None:
    """Return the interval of time to show of a result with a forecast; None: everything."""
    if not is_made_later(view) or "data" not in view.groups:
        return None
    last, end = forecast_span(view)
    times = view.groups["data"]["time"].values
    start = min(last - 2.0 * (end - last), times[-_FEWEST_ROWS:][0])
    if "trajectories" in view.groups:
        start = min(start, view.groups["trajectories"]["time"].values[-_FEWEST_ROWS:][0])
    return None if end - last >= _SMALLEST_SHARE * (end - times[0]) or start <= times[0] else (start, end)


def recent_part(view: ResultView) -> tuple[ResultView, str]:
    """Return the result within `forecast_window`, and a remark where rows are left out."""
    window = forecast_window(view)
    if window is None:
        return view, ""
    times = view.groups["data"]["time"].values
    groups = {}
    for name, dataset in view.groups.items():
        # Known inputs have times of their own, such as ``dose_time``, and resets.
        clocks = [clock for clock in dataset.dims if clock == "time" or
                  name in (CONSTANT, FORECAST) and str(clock).endswith(("_time", "_reset"))]
        groups[name] = dataset.isel({clock: dataset[clock].values >= window[0] for clock in clocks})
        if ENTRY in dataset.dims:
            groups[name] = groups[name].isel({ENTRY: dataset["time"].values >= window[0]})
    remark = f"The last {(times >= window[0]).sum()} of {len(times)} rows of data and the forecast."
    return view.with_groups(groups), remark


def mark_last_observation(axes: Axes, view: ResultView) -> None:
    """Mark the last observation where predictions follow it."""
    last, end = forecast_span(view)
    if last < end:
        axes.axvline(last, color=style.GREY, lw=0.8, ls=(0, (1, 2)), zorder=2.5, label="last observation")


def draw_held_out(axes: Axes, view: ResultView, name: str) -> None:
    """Draw the data that the predictions of an output were compared with."""
    if HELD_OUT in view.groups:
        values = view.groups[HELD_OUT]["y"].sel(output=name)
        axes.plot(values["time"], values, color=style.BLACK, ls="", marker="o", ms=2.6, mfc="white", mew=0.6, zorder=4,
                  label="held-out data")


def draw_outputs(axes: Axes, predicted: xr.Dataset, start: tuple[float, ...] = ()) -> None:
    """Draw predictions of one output, noise-free and new data.

    They continue from ``start``, time, mean and ends of both bands; empty where nothing comes before.
    """
    if predicted.sizes["time"] == 0:
        return
    time, lower, upper = new_data_band(predicted)
    low, high = noise_free_interval(predicted)[..., 0]
    mean = predicted[MEAN if MEAN in predicted else "outputs"].mean(["chain", "draw"]).values[:, 0]
    draw_curves(axes, (time, mean, lower, upper, low, high), start, style.BLUE,
                 {"95%, new data": PREDICTIVE, "95%, noise-free": NOISE_FREE})


def new_data_band(predicted: xr.Dataset) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times and the ends of the 95% interval of new data of one output."""
    return predicted["time"].values, *interval(predicted)[..., 0]


def draw_paths(axes: Axes, paths: xr.DataArray, start: tuple[float, ...], line: str, tint: str) -> None:
    """Draw predictions of a force, a state or a deterministic (chain, draw, time) with their 95% band."""
    if paths.sizes["time"]:
        flat = paths.transpose("chain", "draw", "time").values.reshape(-1, paths.sizes["time"])
        curves = (paths["time"].values, flat.mean(axis=0), *np.quantile(flat, INTERVAL, axis=0))
        draw_curves(axes, curves, start, line, {"95%": tint})


def draw_curves(axes: Axes, curves: Sequence[np.ndarray], start: tuple[float, ...], line: str,
                 tints: dict[str, str]) -> None:
    """Draw times, a mean and the ends of bands, the widest first; ``tints`` maps the labels of bands to colours.

    At fewer than `CURVES` times the bands are bars, which thin lines join.
    """
    count = len(curves[0])
    joined = list(curves)
    if start and start[0] < curves[0][0]:
        joined = [np.append(first, curve) for first, curve in zip(start, curves, strict=True)]
    if count >= CURVES:
        curves = joined
    elif len(joined[0]) > 1:
        axes.plot(joined[0], joined[1], color=line, lw=0.7, zorder=2.9)
        for curve in joined[2:]:
            axes.plot(joined[0], curve, color=line, lw=0.5, ls=(0, (3, 2)), alpha=0.7, zorder=2.8)
    time, mean, *bounds = curves
    gaps = np.diff(time)
    is_far = gaps > _LONGEST_GAP * np.median(gaps) if count >= CURVES else np.ones(len(gaps), bool)
    is_bar = np.append(True, is_far) & np.append(is_far, True)
    broken = [np.insert(curve, np.flatnonzero(is_far) + 1, np.nan) for curve in (time, mean, *bounds)]
    inches = axes.figure.bbox.width / axes.figure.dpi
    thickness = min(5.0, 10.0 * inches / count)  # points; bars of a short forecast stay apart
    for order, (label, tint) in enumerate(tints.items(), start=1):
        low, high = broken[2 * order:2 * order + 2]
        axes.fill_between(broken[0], low, high, color=tint, lw=0, zorder=order, label=label)
        low, high = bounds[2 * order - 2:2 * order]
        breadth = thickness * (1.4 - 0.4 * order)
        axes.vlines(time[is_bar], low[is_bar], high[is_bar], color=tint, lw=breadth, zorder=order)
    axes.plot(broken[0], broken[1], color=line, zorder=3, label="posterior mean")
    axes.plot(time[is_bar], mean[is_bar], color=line, ls="", marker="_", ms=thickness, zorder=3)
