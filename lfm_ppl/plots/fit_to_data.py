"""The fit to the data: each output with its bands, measurements, missing values and doses.

1. Draw the posterior of the noise-free output and about it the band of new data, and both after the last observation.
2. Draw the truth, the measurements, held-out data, and marks of missing values, doses and resets.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lfm_ppl.plots import forecasts, style
from lfm_ppl.plots.bands import band_of, draw_band, draw_truth, summary_of
from lfm_ppl.plots.panels import MAX_PANELS, finish, pick, recent_series
from lfm_ppl.results.predictions import INTERVAL, quantiles
from lfm_ppl.results.result_view import ENTRY, ResultView
from lfm_ppl.results.scalars import unit_of

_MANY = 150  # measurements


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
        draw_truth(axes, part, "output", name)
        _draw_data(axes, part, name)
        forecasts.draw_held_out(axes, part, name)
        _draw_events(axes, part)
        style.label_values(axes, name, unit_of(observed, name), title)
    finish(figure, panels, view, f"{remark} {note}")
    return figure


def _draw_output(axes: Axes, view: ResultView, name: str) -> None:
    """Draw mean and bands of an output, and what is predicted of it."""
    predicted = forecasts.series_predictions(view)
    predicted = None if predicted is None else predicted.sel(output=[name])
    if predicted is not None and "trajectories" not in view.groups:
        return forecasts.draw_outputs(axes, predicted)
    time, mean, low, high = band_of(view, "output", name)
    is_covered = predicted is not None and set(time.tolist()) <= set(predicted["time"].values.tolist())
    if predicted is not None and is_covered and summary_of(view, "outputs") is None:
        return forecasts.draw_outputs(axes, predicted)
    outer = _draw_new_data(axes, view, name, predicted if is_covered else None, (time, low, high))
    draw_band(axes, (time, mean, low, high), style.BLUE, forecasts.NOISE_FREE, "95%, noise-free")
    if predicted is not None and not is_covered:
        later = predicted.isel(time=predicted["time"].values > time[-1])
        forecasts.draw_outputs(axes, later, (time[-1], mean[-1], *outer, low[-1], high[-1]))


def _draw_new_data(axes: Axes, view: ResultView, name: str, predicted: xr.Dataset | None,
                   inner: tuple[np.ndarray, np.ndarray, np.ndarray]) -> tuple[float, float]:
    """Draw the band of new data about ``inner``, times and ends of the noise-free band; return its last ends."""
    summary, step = summary_of(view, "new_data"), None
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
