"""Figures over time: the fit to the data, the forces, the states.

1. Select the trajectories of one kind, and their predictions.
2. Draw the mean and the 95% band, from the mixture over the draws if it is stored, else from the draws.
3. Draw forecasts after the last observation, missing values, held-out data and the truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from lfm_ppl.results.arviz_data import group, has_group
from lfm_ppl.results.inputs import time_origin, time_unit
from lfm_ppl.results.plots import style
from lfm_ppl.results.predictions import GROUP, HELD_OUT, INTERVAL, MEAN, interval, noise_free_interval, quantiles
from lfm_ppl.results.scalars import unit_of
from lfm_ppl.utils.checks import unknown

MAX_PANELS = 12
_MANY = 150  # measurements
_BARS = 12  # forecasts from which they are drawn as bands
END: dict[str, Any] = {"color": style.GREY, "lw": 0.8, "ls": (0, (1, 2)), "zorder": 2.5}
_TRUTH: dict[str, Any] = {"color": style.BLACK, "lw": 0.9, "ls": (0, (4, 2)), "zorder": 3.5}
_HELD_OUT: dict[str, Any] = {"color": style.BLACK, "ls": "", "marker": "o", "ms": 2.6, "mfc": "white", "mew": 0.6,
                             "zorder": 4}
_NOISE_FREE, _PREDICTIVE, _FORCE, _DETERMINISTIC = "#8FBFDE", "#D3E4F1", "#9AD3C1", "#F3CFA3"
"""Tints of the line colours."""


@style.styled
def plot_fit(
    result: Any, outputs: Sequence[str] | None = None, *, width: str | float = "column"
) -> Figure:
    """Draw the data of each output with the posterior of what was measured, and forecasts of it.

    The inner band holds 95% of the noise-free output, the outer one 95% of new measurements. Where the
    result has predictions, both go on after the last observation, which a dotted line marks, and the outer
    band is theirs; forecasts at fewer than 12 times are drawn as bars. Bands follow the summaries that the
    trajectories hold; where they hold draws alone, they are quantiles of these, and the outer one ends with the data:
    it is exact at the measurement times, and between them the inner one widened by the difference of the two,
    interpolated linearly. Replicates are pooled. Of simulated data the noise-free truth is drawn, too.

    Args:
        result: with the groups observed_data and trajectories, posterior_predictive for the outer band, predictions for
            forecasts, which alone are drawn of a result without trajectories, such as a partial one, held_out_data that
            these were compared with, and truth where it is known.
        outputs: names; None for all, up to 12.
        width: "column" (3.4 in), "full" (7 in), or inches.

    Returns:
        A figure with one panel per output. Missing values are marked above the time axis.

    Raises:
        ValueError: a group is missing, or an output is unknown.

    Example:
        >>> from lfm_ppl.results.arviz_data import build
        >>> time = np.linspace(0.0, 9.0, 10)
        >>> dims = ("chain", "draw", "at", "output")
        >>> mean = xr.Dataset({"outputs": (dims, np.ones((2, 5, 10, 1)))})
        >>> data = xr.Dataset({"y": (("time", "output"), np.ones((10, 1)), {"units": "nM"})})
        >>> mean = mean.assign_coords({"at": time, "output": ["mRNA"]})
        >>> data = data.assign_coords({"time": time, "output": ["mRNA"]})
        >>> figure = plot_fit(build({"trajectories": mean, "observed_data": data}))
        >>> figure.axes[0].get_ylabel()
        'mRNA (nM)'
    """
    observed = group(result, "observed_data")["y"].transpose("time", "output")
    predictive = _predictive(result)
    predicted = _predicted(result)
    alone = predicted is not None and not has_group(result, "trajectories")
    noise_free = None if alone else _trajectories(result, "output")
    inner = None if noise_free is None else _summary(result, "outputs")
    new = None if noise_free is None else _summary(result, "new_data")
    later = group(result, HELD_OUT)["y"] if has_group(result, HELD_OUT) else None
    truth = _true(result, "output")
    has_truth, (last, end) = False, forecast_span(result)
    names, note = style.first_of(pick(observed, "output", outputs), outputs, MAX_PANELS, "outputs")
    figure, panels = style.small_multiples(width, len(names), 1.35)
    for axes, name in zip(panels, names, strict=True):
        data = observed.sel(output=name)
        covered = predicted is not None and (noise_free is None or
                                             _covers(predicted["time"].values, noise_free["at"].values))
        if predicted is not None and covered and inner is None:
            _draw_forecast(axes, predicted.sel(output=[name]))
        else:
            time, mean, low, high = _band(result, "output", name)
            if new is not None:
                axes.fill_between(time, *new.sel(output=name).values[1:], color=_PREDICTIVE, lw=0, zorder=1)
            elif predicted is not None and covered:
                axes.fill_between(*_noisy_band(predicted.sel(output=[name])), color=_PREDICTIVE, lw=0, zorder=1)
            elif predictive is not None:
                outer = _widened(predictive.sel(output=name), time, low, high)
                axes.fill_between(*outer, color=_PREDICTIVE, lw=0, zorder=1)
            axes.fill_between(time, low, high, color=_NOISE_FREE, lw=0, zorder=2)
            axes.plot(time, mean, color=style.BLUE, zorder=3)
            if predicted is not None and not covered:
                wide = (low[-1], high[-1]) if new is None else new.sel(output=name).values[1:, -1]
                _draw_forecast(axes, predicted.sel(output=[name]).isel(time=predicted["time"].values >= time[-1]),
                               (time[-1], mean[-1], *wide, low[-1], high[-1]))
        if last < end:
            axes.axvline(last, **END)
        has_truth |= _draw_truth(axes, truth, "output", name)
        _draw_data(axes, data)
        if later is not None:
            axes.plot(later["time"], later.sel(output=name), **_HELD_OUT)
        style.label_values(axes, name, unit_of(observed, name))
    style.label_time(panels, time_unit(result), time_origin(result))
    figure.align_ylabels(panels)
    handles: list[Artist] = [Line2D([], [], label="data", **_data_style(observed.sizes["time"]))]
    handles += [Line2D([], [], label="held-out data", **_HELD_OUT)] if later is not None else []
    handles += [Line2D([], [], color=style.BLUE, label="posterior mean")]
    handles += [Patch(color=_NOISE_FREE, label="95%, noise-free")]
    if new is not None or predictive is not None or predicted is not None:
        handles += [Patch(color=_PREDICTIVE, label="95%, new data")]
    if has_truth:
        handles += [Line2D([], [], label="truth", **_TRUTH)]
    if last < end:
        handles += [Line2D([], [], label="last observation", **END)]
    if np.isnan(observed.sel(output=names)).any():
        handles += [Line2D([], [], label="missing", **_missing_style(observed.sizes["time"]))]
    style.legend_above(figure, handles)
    if note:
        style.note_below(figure, note)
    return figure


@style.styled
def plot_forces(
    result: Any, forces: Sequence[str] | None = None, *, width: str | float = "column"
) -> Figure:
    """Draw the posterior mean of each force with a 95% band, the forecast of it, and the truth where they are known.

    Args:
        result: with the group trajectories, predictions of a forecast, and truth where it is known.
        forces: names; None for all, up to 12.
        width: "column" (3.4 in), "full" (7 in), or inches.

    Returns:
        A figure with one panel per force.

    Raises:
        ValueError: the result holds no force trajectories, or a force is unknown.

    Example:
        >>> from lfm_ppl.results.arviz_data import build
        >>> dims = ("chain", "draw", "at", "force")
        >>> draws = xr.Dataset({"forces": (dims, np.zeros((2, 5, 10, 1)))})
        >>> draws = draws.assign_coords({"at": np.linspace(0.0, 9.0, 10), "force": ["p53"]})
        >>> figure = plot_forces(build({"trajectories": draws}), ["p53"], width="full")
        >>> [axes.get_ylabel() for axes in figure.axes]
        ['p53']
    """
    return _panels(result, "force", forces, width, (style.GREEN, _FORCE))


@style.styled
def plot_states(
    result: Any, states: Sequence[str] | None = None, *, width: str | float = "column"
) -> Figure:
    """Draw the posterior mean of each state with a 95% band, the forecast of it, and the truth where they are known.

    Args:
        result: with the group trajectories, predictions of a forecast, and truth where it is known.
        states: names; None for all, up to 12.
        width: "column" (3.4 in), "full" (7 in), or inches.

    Returns:
        A figure with one panel per state.

    Raises:
        ValueError: the result holds no state trajectories, or a state is unknown.

    Example:
        >>> from lfm_ppl.results.arviz_data import build
        >>> dims = ("chain", "draw", "at", "state")
        >>> draws = xr.Dataset({"states": (dims, np.zeros((2, 5, 10, 2)))})
        >>> draws = draws.assign_coords({"at": np.linspace(0.0, 9.0, 10), "state": ["x", "v"]})
        >>> [axes.get_ylabel() for axes in plot_states(build({"trajectories": draws})).axes]
        ['x', 'v']
    """
    return _panels(result, "state", states, width, (style.BLUE, _NOISE_FREE))


@style.styled
def plot_deterministics(
    result: Any, names: Sequence[str] | None = None, *, width: str | float = "column"
) -> Figure:
    """Draw the posterior mean of what follows from states and forces with a 95% band, its forecast, and its truth.

    Args:
        result: with the group trajectories, of a model with ``deterministics``, predictions, and truth where known.
        names: of the deterministics; None for all, up to 12.
        width: "column" (3.4 in), "full" (7 in), or inches.

    Returns:
        A figure with one panel for each.

    Raises:
        ValueError: the result holds none, or a name is unknown.

    Example:
        >>> from lfm_ppl.results.arviz_data import build
        >>> dims = ("chain", "draw", "at", "deterministic")
        >>> draws = xr.Dataset({"deterministics": (dims, np.zeros((2, 5, 10, 1)))})
        >>> draws = draws.assign_coords({"at": np.linspace(0.0, 9.0, 10), "deterministic": ["uptake"]})
        >>> [axes.get_ylabel() for axes in plot_deterministics(build({"trajectories": draws})).axes]
        ['uptake']
    """
    return _panels(result, "deterministic", names, width, (style.ORANGE, _DETERMINISTIC))


def trajectory_names(result: Any, kind: str) -> list[str]:
    """Return the names of the forces, states, deterministics or outputs that ``result`` has trajectories of."""
    if not has_group(result, "trajectories") or kind not in group(result, "trajectories").dims:
        return []
    return [str(name) for name in group(result, "trajectories")[kind].values]


def pick(variable: xr.DataArray, kind: str, selection: Sequence[str] | None) -> list[str]:
    """Return the names along ``kind`` to draw: those wanted, or all; refuse unknown ones."""
    available = [str(name) for name in variable[kind].values]
    if selection is None:
        return available
    selection = [selection] if isinstance(selection, str) else list(selection)
    for name in selection:
        if name not in available:
            raise ValueError(unknown(kind, name, available))
    if not selection:
        raise ValueError(f"{kind}s is empty; name at least one of {', '.join(available)}.")
    return selection


def _panels(
    result: Any,
    kind: str,
    selection: Sequence[str] | None,
    width: str | float,
    colours: tuple[str, str],
) -> Figure:
    draws = _trajectories(result, kind)
    truth = _true(result, kind)
    names, note = style.first_of(pick(draws, kind, selection), selection, MAX_PANELS, f"{kind}s")
    figure, panels = style.small_multiples(width, len(names), 1.25)
    line, tint = colours
    has_truth = False
    predicted = _predicted(result)
    forecast = None if predicted is None else predicted.get(f"{kind}s")
    last, end = forecast_span(result)
    later = forecast is not None and last < end
    for axes, name in zip(panels, names, strict=True):
        time, mean, low, high = _band(result, kind, name)
        axes.fill_between(time, low, high, color=tint, lw=0, zorder=1)
        axes.plot(time, mean, color=line, zorder=2)
        if forecast is not None and later:
            paths = forecast.sel({kind: name, "time": forecast["time"] >= time[-1]}).transpose("chain", "draw", "time")
            if paths.sizes["time"]:
                flat = paths.values.reshape(-1, paths.sizes["time"])
                curves = (paths["time"].values, flat.mean(axis=0), *np.quantile(flat, INTERVAL, axis=0))
                _draw_ahead(axes, curves, line, (tint,), (time[-1], mean[-1], low[-1], high[-1]))
            axes.axvline(last, **END)
        has_truth |= _draw_truth(axes, truth, kind, name)
        style.label_values(axes, name, unit_of(draws, name))
    style.label_time(panels, time_unit(result), time_origin(result))
    figure.align_ylabels(panels)
    handles = [Line2D([], [], color=line, label="posterior mean"), Patch(color=tint, label="95%")]
    if has_truth:
        handles += [Line2D([], [], label="truth", **_TRUTH)]
    if later:
        handles += [Line2D([], [], label="last observation", **END)]
    style.legend_above(figure, handles)
    if note:
        style.note_below(figure, note)
    return figure


def _trajectories(result: Any, kind: str) -> xr.DataArray:
    dataset = group(result, "trajectories")
    if f"{kind}s" not in dataset or dataset.sizes[kind] == 0:
        raise ValueError(
            f"the result holds no {kind} trajectories; its group trajectories has "
            f"{', '.join(map(str, dataset.data_vars))}. They come from lfm.fit with "
            f"trajectory_draws above zero, for a model that has {kind}s."
        )
    return dataset[f"{kind}s"].transpose("chain", "draw", "at", kind)


def _true(result: Any, kind: str) -> xr.DataArray | None:
    """Return the true trajectories of a kind; None where they are not known."""
    return group(result, "truth").get(f"{kind}s") if has_group(result, "truth") else None


def _draw_truth(axes: Axes, truth: xr.DataArray | None, kind: str, name: str) -> bool:
    """Draw the true trajectory where it is known, as far as the axes are in use, and return whether it is."""
    if truth is None or kind not in truth.dims or name not in truth[kind].values:
        return False
    times, (low, high) = truth["at_truth"].values, axes.dataLim.intervalx
    used = (times >= low) & (times <= high) | (low > high)  # nothing else is drawn yet
    axes.plot(times[used], truth.sel({kind: name}).values[used], **_TRUTH)
    return bool(used.any())


def _predictive(result: Any) -> xr.DataArray | None:
    if not has_group(result, "posterior_predictive"):
        return None
    return group(result, "posterior_predictive")["y"].transpose("chain", "draw", "time", "output")


def _predicted(result: Any) -> xr.Dataset | None:
    """Return the predictions of one series; None where there are none."""
    if not has_group(result, GROUP):
        return None
    dataset = group(result, GROUP)
    return None if "series" in dataset.dims else dataset.drop_duplicates("time")


def forecast_span(result: Any) -> tuple[float, float]:
    """Return the times of the last observation and of the last prediction; minus infinity without predictions."""
    predicted = _predicted(result)
    if predicted is None or predicted.sizes["time"] == 0:
        return -np.inf, -np.inf
    end = float(predicted["time"].values.max())
    return float(predicted.attrs.get("last_observation", end)), end


def _covers(times: np.ndarray, requested: np.ndarray) -> bool:
    """Whether there are predictions all along the trajectories."""
    return len(times) >= _BARS and bool(set(requested.tolist()) <= set(times.tolist()))


def _noisy_band(predicted: xr.Dataset) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times and the ends of the 95% interval of new data of one output."""
    return predicted["time"].values, *interval(predicted)[..., 0]


def _draw_forecast(axes: Axes, predicted: xr.Dataset, start: tuple[float, ...] = ()) -> None:
    """Draw predictions of one output, noise-free and new data; ``start`` is what they go on from."""
    if predicted.sizes["time"] == 0:
        return
    time, lower, upper = _noisy_band(predicted)
    low, high = noise_free_interval(predicted)[..., 0]
    mean = predicted[MEAN if MEAN in predicted else "outputs"].mean(["chain", "draw"]).values[:, 0]
    _draw_ahead(axes, (time, mean, lower, upper, low, high), style.BLUE, (_PREDICTIVE, _NOISE_FREE), start)


def _draw_ahead(axes: Axes, curves: Sequence[np.ndarray], line: str, tints: Sequence[str],
                start: tuple[float, ...]) -> None:
    """Draw a mean and bands, the widest first: as bars where there are few times.

    Args:
        axes: where to.
        curves: times, mean, and the ends of each band.
        line: colour of the mean.
        tints: colours of the bands.
        start: the same numbers where the curves go on from; empty where nothing comes before.
    """
    filled = len(curves[0]) >= _BARS
    if filled and start and start[0] < curves[0][0]:
        curves = [np.append(first, curve) for first, curve in zip(start, curves, strict=True)]
    time, mean, *bounds = curves
    for order, (low, high, tint) in enumerate(zip(bounds[::2], bounds[1::2], tints, strict=True), start=1):
        if filled:
            axes.fill_between(time, low, high, color=tint, lw=0, zorder=order)
        else:
            axes.vlines(time, low, high, color=tint, lw=7 - 2 * order, zorder=order)
    marks: dict[str, Any] = {} if filled else {"ls": "", "marker": "_", "ms": 5}
    axes.plot(time, mean, color=line, zorder=3, **marks)


def _band(result: Any, kind: str, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return times, mean and the ends of the 95% interval of a state, force or output, by its density if known."""
    draws = _trajectories(result, kind).sel({kind: name})
    summary = _summary(result, f"{kind}s")
    if summary is not None:
        return draws["at"].values, *summary.sel({kind: name}).values
    flat = draws.values.reshape(-1, draws.sizes["at"])
    low, high = np.quantile(flat, INTERVAL, axis=0)
    return draws["at"].values, flat.mean(axis=0), low, high


def _summary(result: Any, name: str) -> xr.DataArray | None:
    """Return the summary (statistic, at, ...) of trajectories; None where there are draws alone."""
    summary = group(result, "trajectories").get(f"{name}_summary")
    return None if summary is None or "series" in summary.dims else summary.transpose("statistic", "at", ...)


def _widened(
    predictive: xr.DataArray, positions: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times from the first to the last measurement and the predictive interval there."""
    measured, which = np.unique(predictive["time"].values, return_inverse=True)
    draws = predictive.values.reshape(-1, predictive.sizes["time"])
    bounds = np.array([quantiles(draws[:, which == k].ravel(), INTERVAL) for k in range(len(measured))])
    below = bounds[:, 0] - np.interp(measured, positions, low)
    above = bounds[:, 1] - np.interp(measured, positions, high)
    grid = np.union1d(measured, positions[(positions >= measured[0]) & (positions <= measured[-1])])
    return (
        grid,
        np.interp(grid, positions, low) + np.interp(grid, measured, below),
        np.interp(grid, positions, high) + np.interp(grid, measured, above),
    )


def _draw_data(axes: Axes, data: xr.DataArray) -> None:
    times, values = data["time"].values, data.values
    missing = np.isnan(values)
    axes.plot(
        times[~missing],
        values[~missing],
        rasterized=len(times) > 5000,
        **_data_style(len(times)),
    )
    axes.plot(
        times[missing],
        np.full(missing.sum(), 0.04),
        transform=axes.get_xaxis_transform(),
        **_missing_style(len(times)),
    )


def _data_style(count: int) -> dict[str, Any]:
    """Return how to draw ``count`` values: many of them small, and under the line of the mean."""
    common = {"ls": "", "marker": "o"}
    if count > _MANY:
        return {**common, "color": style.GREY, "ms": 1.5, "mew": 0, "zorder": 2.5}
    return {**common, "color": style.BLACK, "ms": 2.6, "mec": "white", "mew": 0.3, "zorder": 4}


def _missing_style(count: int) -> dict[str, Any]:
    size = 2 if count > _MANY else 3
    return {"color": style.GREY, "ls": "", "marker": "x", "ms": size, "mew": 0.8, "zorder": 5}
