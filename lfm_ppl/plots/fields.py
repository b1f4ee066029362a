"""Figures of fields in space and time: place against time, and snapshots with their uncertainty."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lfm_ppl.plots import style
from lfm_ppl.results.fields import GROUP, evaluate_field
from lfm_ppl.results.result_view import ResultView

_SNAPSHOTS = (0.1, 0.5, 0.9)
"""Shares of the times before the snapshots."""

_COLOURS = {"mean": "viridis", "sd": "cividis", "truth": "viridis"}


@style.styled
def plot_field(result: Any, field: Any, points: Any = None, *, width: str | float = "column", **options: Any) -> Figure:
    """Draw the posterior of a field: of one dimension against time, and snapshots at three times.

    Of one dimension, the panels are the posterior mean, the sd, the truth where it is known, and snapshots of the mean
    with a 95% band; of two dimensions, maps of these at three times. Sensors are marked.

    Args:
        result: of `lfm_ppl.fit`, with the group trajectories.
        field: as of `evaluate_field`; or the name of a field that ``lfm-ppl fit`` has stored in the result.
        points: (P,) or (P, 2) where it is drawn; None: a grid over the domain of the field.
        width: "column" (3.4 in), "full" (7 in), or inches.
        **options: ``sensors``, ``name``, ``unit`` and ``length_unit`` of `evaluate_field`.

    Raises:
        ValueError: the result has no trajectories of the field, or has stored no field of this name.

    Example:
        >>> import lfm_ppl as lfm
        >>> from lfm_ppl.results.arviz_data import build
        >>> states = (("chain", "draw", "time", "state"), np.random.default_rng(0).normal(size=(2, 5, 4, 3)))
        >>> named = {"time": np.arange(4.0), "draw": np.arange(5), "state": ["mode 0", "mode 1", "mode 2"]}
        >>> posterior = xr.Dataset({"decay": (("chain", "draw"), np.ones((2, 5)))}, {"draw": np.arange(5)})
        >>> result = build({"trajectories": xr.Dataset({"states": states}, named), "posterior": posterior})
        >>> plot_field(result, lfm.LaplaceBasis((0.0, 1.0), 3), sensors=[0.5], name="heat").axes[0].get_ylabel()
        'place'
    """
    view = ResultView.of(result)
    dataset = (view.group(f"{GROUP}{field}") if isinstance(field, str)
               else evaluate_field(view, field, points, **options))
    dataset = dataset.isel(place=np.lexsort(dataset["r"].values.T))
    kinds = [kind for kind in _COLOURS if kind in dataset]
    snapshots = dataset.isel(time=[round(share * (dataset.sizes["time"] - 1)) for share in _SNAPSHOTS])
    titles = [f"t = {time:.3g} {view.time_unit}".strip() for time in snapshots["time"].values]
    if dataset.sizes["axis"] == 1:
        figure = style.new_figure(width, 1.15 * len(kinds) + 2.0)
        grid = figure.add_gridspec(len(kinds) + 1, len(titles), height_ratios=[1.0] * len(kinds) + [1.25])
        for row, kind in enumerate(kinds):
            axes = figure.add_subplot(grid[row, :])
            _draw_against_time(figure, axes, dataset, kind)
            axes.tick_params(labelbottom=row + 1 == len(kinds))
        style.label_time([axes], view.time_unit, view.time_origin)
        bands: list[Axes] = []
        for column, title in enumerate(titles):
            bands.append(figure.add_subplot(grid[-1, column], sharey=bands[0] if bands else None))
            _draw_band(bands[-1], snapshots.isel(time=column), title)
            bands[-1].tick_params(labelleft=column == 0)
        style.label_values(bands[0], dataset.attrs["name"], dataset.attrs["unit"], titles[0])
    else:
        figure = style.new_figure(width, 0.33 * style.inches(width) * len(kinds) + 0.5)
        panels = figure.subplots(len(kinds), len(titles), sharex=True, sharey=True, squeeze=False)
        for row, kind in zip(panels, kinds, strict=True):
            _draw_maps(figure, row, snapshots, kind)
        for axes, title in zip(panels[0], titles, strict=True):
            axes.set_title(title)
        panels[-1, 0].set(xlabel=_place_label(dataset, "x"), ylabel=_place_label(dataset, "y"))
    style.legend_above(figure)
    return figure


def _place_label(dataset: xr.Dataset, name: str = "place") -> str:
    return style.with_unit(name, dataset.attrs["length_unit"])


def _colours(dataset: xr.Dataset, kind: str) -> dict[str, Any]:
    """Return the colour map of a kind of values and its limits, the same for the mean and the truth."""
    values = dataset[[name for name in _COLOURS if name in dataset and (name == "sd") == (kind == "sd")]].to_array()
    return {"cmap": _COLOURS[kind], "vmin": float(values.min()), "vmax": float(values.max()), "shading": "gouraud",
            "rasterized": True}


def _add_colour_bar(figure: Figure, mesh: Any, panels: Any, dataset: xr.Dataset, kind: str) -> None:
    label = style.with_unit(f"{dataset.attrs['name']}, {kind}", dataset.attrs["unit"])
    bar = figure.colorbar(mesh, ax=panels, label=label, pad=0.02, aspect=12)
    bar.ax.tick_params(labelsize=style.SMALL, length=2.5, width=0.6, pad=2.0)


def _draw_against_time(figure: Figure, axes: Axes, dataset: xr.Dataset, kind: str) -> None:
    style.tidy(axes, ylabel=_place_label(dataset))
    mesh = axes.pcolormesh(dataset["time"].values, dataset["r"].values[:, 0], dataset[kind].values.T,
                           **_colours(dataset, kind))
    _add_colour_bar(figure, mesh, axes, dataset, kind)
    if "sensors" in dataset:
        axes.plot(dataset["time"].values, dataset["sensors"].values[:, :, 0], color="white", lw=0.6, ls=":")


def _draw_band(axes: Axes, snapshot: xr.Dataset, title: str) -> None:
    positions, mean, sd = snapshot["r"].values[:, 0], snapshot["mean"].values, snapshot["sd"].values
    style.tidy(axes, 3, title=title, xlabel=_place_label(snapshot))
    axes.plot(positions, mean, color=style.BLUE, label="posterior mean")
    axes.fill_between(positions, mean - 1.96 * sd, mean + 1.96 * sd, color="#8FBFDE", lw=0, zorder=1, label="95%")
    if "truth" in snapshot:
        axes.plot(positions, snapshot["truth"].values, **style.TRUTH)
    if "sensors" in snapshot:
        sensors = snapshot["sensors"].values[:, 0]
        axes.plot(sensors, np.full(len(sensors), 0.03), "^", transform=axes.get_xaxis_transform(), ms=2.5, mew=0,
                  color=style.VERMILLION, label="sensor")


def _draw_maps(figure: Figure, row: Any, snapshots: xr.Dataset, kind: str) -> None:
    for column, axes in enumerate(row):
        style.tidy(axes, 2, 2, aspect="equal")
        mesh = axes.tripcolor(*snapshots["r"].values.T, snapshots[kind].values[column], **_colours(snapshots, kind))
        if "sensors" in snapshots:
            axes.plot(*snapshots["sensors"].values[column].T, "o", color="white", mec="black", mew=0.3, ms=2.0, ls="",
                      label="sensor")
    _add_colour_bar(figure, mesh, list(row), snapshots, kind)
