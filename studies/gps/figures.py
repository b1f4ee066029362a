"""Forces and errors of one satellite, as in figures 2 and 3 of the source, and errors of all satellites."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lfm_ppl.plots import style

from ..declaration import Data
from ..drawing import band, legend, patch

METRE = 1e-3
_DETERMINISTIC, _LFM, _SEEN = style.VERMILLION, style.BLUE, style.GREY
_FITTED: dict[str, Any] = {"color": _DETERMINISTIC, "label": "deterministic, fitted to training"}
_LATEST: dict[str, Any] = {"color": style.ORANGE, "label": "deterministic, from the latest state"}
_MODEL: dict[str, Any] = {"color": _LFM, "label": "latent force model"}
_END: dict[str, Any] = {"color": _SEEN, "lw": 0.7, "ls": ":", "label": "end of training"}


def draw(settings: Any, data: Data) -> dict[str, Figure]:
    """Return every figure of the comparison by name."""
    predicted, online = data["predict"], data.get("online")
    systems = list(dict.fromkeys(predicted.system.values))
    figures = {"all" if len(systems) == 1 else f"all-{system}":
               plot_all(predicted.isel(satellite=(predicted.system == system).values)) for system in systems}
    name = (predicted if online is None else online).satellite.values[0]
    satellite = predicted.sel(satellite=name)
    figures |= {f"errors-{name}": plot_errors(satellite), f"forces-{name}": plot_forces(satellite)}
    if online is not None:
        figures[f"online-{name}"] = plot_online(online.sel(satellite=name))
    return figures


@style.styled
def plot_forces(satellite: xr.Dataset, *, width: str | float = "full") -> Figure:
    """Draw the small forces of a satellite: learnt in training and then predicted, and smoothed by all positions."""
    names = satellite.force_names.values
    figure, panels = style.small_multiples(width, len(names), 1.7)
    days = satellite.times / 24.0
    for index, (axes, force) in enumerate(zip(panels, names, strict=True)):
        mean, seen = satellite.forces[:, index], satellite.seen[:, index]
        axes.plot(days, seen, color=_DETERMINISTIC, lw=0.8, label="smoothed from all positions")
        axes.plot(days, mean, color=_LFM, lw=0.9, label="learnt in training, then predicted")
        band(axes, days, mean, satellite.forces_sd[:, index], color=_LFM, alpha=0.2, label="95%")
        axes.axvline(days[int(satellite.train)], **_END)
        middle = np.median(seen)
        reach = 1.5 * max(np.abs(seen - middle).max(), np.abs(mean - middle).max(), 0.05)
        axes.set(ylim=(middle - reach, middle + reach), title=f"{satellite.satellite.item()}: {force}")
        style.label_values(axes, force, "nm/s²")
    style.label_time(panels, "days")
    legend(figure)
    return figure


@style.styled
def plot_errors(satellite: xr.Dataset, *, width: str | float = "full") -> Figure:
    """Draw the errors of a satellite's position along the radial, tangential and normal directions."""
    figure, panels = style.small_multiples(width, 3, 1.7)
    lines = {"fitted": _FITTED, "latest": _LATEST | {"ls": "--"}, "lfm": _MODEL}
    _draw_errors(panels, satellite, ("radial", "tangential", "normal"), lines)
    for axes in panels:
        axes.axvline(satellite.times[int(satellite.train)] / 24.0, **_END)
    legend(figure)
    return figure


@style.styled
def plot_online(satellite: xr.Dataset, *, width: str | float = "full") -> Figure:
    """Draw the errors of online predictions of both models, with windows of observations."""
    figure, panels = style.small_multiples(width, 3, 1.7)
    for axes in panels:
        axes.fill_between(satellite.times / 24.0, 0, 1, where=satellite.observed, color=_SEEN, alpha=0.2, lw=0,
                          transform=axes.get_xaxis_transform())
    lines = {"restarted": _LATEST | {"ls": "--"}, "lfm": _MODEL}
    _draw_errors(panels, satellite, "xyz", lines, first=int(satellite.observed.argmin("time")))
    legend(figure, patch("positions observed", _SEEN, alpha=0.2))
    return figure


def _draw_errors(panels: Sequence[Axes], satellite: xr.Dataset, directions: Sequence[str],
                 lines: Mapping[str, dict[str, Any]], first: int = 0) -> None:
    """Draw errors, and the model's band about zero; the axis limits fit the errors after epoch ``first``."""
    days = satellite.times / 24.0
    for index, (axes, direction) in enumerate(zip(panels, directions, strict=True)):
        for name, properties in lines.items():
            axes.plot(days, satellite[name][:, index] / METRE, lw=0.9, **properties)
        band(axes, days, 0.0, satellite.sd[:, index] / METRE, color=_LFM, alpha=0.2, label="its 95% about zero")
        largest = 1.1 * max(float(np.abs(satellite[name][first:, index]).max()) for name in lines) / METRE
        axes.set(ylim=(-largest, largest), title=f"{satellite.satellite.item()}: {direction}")
        style.label_values(axes, "error", "m")
    style.label_time(panels, "days")


@style.styled
def plot_all(satellites: xr.Dataset, *, width: str | float = "full") -> Figure:
    """Draw the errors after training of all satellites, with separate groups for shadow and for gaps."""
    group = np.where(satellites.complete, satellites.eclipsed.astype(int), 2)
    order = np.lexsort((satellites.satellite, group))
    satellites, group = satellites.isel(satellite=order), group[order]
    figure = style.new_figure(width, 2.6)
    axes = figure.subplots()
    positions = np.arange(len(group))
    for name, marker, properties in (("fitted", "o", _FITTED), ("latest", "^", _LATEST), ("lfm", "s", _MODEL)):
        axes.semilogy(positions, rms(satellites, name), ls="", marker=marker, ms=3.5, **properties)
    for number, label in ((1, "in the Earth's shadow"), (2, "with gaps")):
        for first in np.flatnonzero(group == number)[:1]:
            axes.axvline(first - 0.5, color=_SEEN, lw=0.7, ls=":")
            axes.text(first - 0.4, 1.0, label, va="bottom", transform=axes.get_xaxis_transform(),
                      fontsize=style.SMALL, color=_SEEN)
    axes.set_xticks(positions, satellites.satellite.values, rotation=90, fontsize=style.SMALL)
    axes.tick_params(labelsize=style.SMALL, length=2.5, width=0.6)
    axes.set_ylabel("error after training (m)")
    legend(figure)
    return figure


def rms(satellites: xr.Dataset, name: str, directions: slice = slice(None)) -> xr.DataArray:
    """Return the root mean square distance in metres after training, without missing positions.

    Args:
        satellites: predictions of satellites.
        name: variable with the errors in km.
        directions: selection from radial, tangential and normal.
    """
    errors = satellites[name].isel(time=slice(int(satellites.train[0]), None), direction=directions)
    return (errors**2).sum("direction", skipna=False).mean("time") ** 0.5 / METRE
