"""Curves of a state, a force or an output over time: posterior mean, 95% band and truth.

Mean and band come from the mixture over the draws if it is stored, else from the draws.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from lfm_ppl.plots import forecasts, style
from lfm_ppl.results.predictions import INTERVAL
from lfm_ppl.results.result_view import ResultView


def trajectories_of(view: ResultView, kind: str) -> xr.DataArray:
    """Return the trajectories of one kind, (chain, draw, ..., time, kind); refuse a result without them."""
    dataset = view.group("trajectories")
    if f"{kind}s" not in dataset or dataset.sizes[kind] == 0:
        raise ValueError(f"the result holds no {kind} trajectories; its group trajectories has "
                         f"{', '.join(map(str, dataset.data_vars))}. They come from lfm.fit with trajectory_draws "
                         f"above zero, for a model that has {kind}s.")
    return dataset[f"{kind}s"].transpose("chain", "draw", ..., "time", kind)


def draw_truth(axes: Axes, view: ResultView, kind: str, name: str) -> None:
    """Draw the true trajectory where it is known, as far as the axes are in use."""
    truth = true_path(axes, view, kind, name)
    if truth is not None:
        axes.plot(*truth, **style.TRUTH)


def true_path(axes: Axes, view: ResultView, kind: str, name: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Return times and values of the true trajectory, as far as the axes are in use; None where it is unknown."""
    truth = view.groups.get("truth", xr.Dataset()).get(f"{kind}s")
    if truth is None or kind not in truth.dims or name not in truth[kind].values:
        return None
    times, (low, high) = truth["time"].values, axes.dataLim.intervalx
    is_shown = (times >= low) & (times <= high) | (low > high)  # nothing else is drawn yet
    return (times[is_shown], truth.sel({kind: name}).values[is_shown]) if is_shown.any() else None


def draw_band(axes: Axes, curves: Sequence[np.ndarray], line: str, tint: str, label: str) -> None:
    """Draw mean and band of times, mean and ends; at few times as bars that lines join."""
    time, mean, low, high = curves
    if len(time) < forecasts.CURVES:
        return forecasts.draw_curves(axes, curves, (), line, {label: tint})
    axes.fill_between(time, low, high, color=tint, lw=0, zorder=2, label=label)
    axes.plot(time, mean, color=line, zorder=3, label="posterior mean")


def band_of(view: ResultView, kind: str, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return times, mean and the ends of the 95% interval of a state, force or output, by its density if known."""
    draws = trajectories_of(view, kind).sel({kind: name})
    summary = summary_of(view, f"{kind}s")
    if summary is not None:
        return draws["time"].values, *summary.sel({kind: name}).values
    flat = draws.values.reshape(-1, draws.sizes["time"])
    low, high = np.quantile(flat, INTERVAL, axis=0)
    return draws["time"].values, flat.mean(axis=0), low, high


def summary_of(view: ResultView, name: str) -> xr.DataArray | None:
    """Return the summary (statistic, time, ...) of trajectories; None where there are draws alone."""
    summary = view.group("trajectories").get(f"{name}_summary")
    return None if summary is None else summary.transpose("statistic", "time", ...)
