"""Forces and errors of satellites, as in figures 2 and 3 of the source, and the errors of all of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments.drawing import band, legend, patch
from lfm_ppl.experiments.gps.problem import grouped
from lfm_ppl.results.plots import style

DETERMINISTIC, LATEST, LFM, SEEN = style.VERMILLION, style.ORANGE, style.BLUE, style.GREY
METRE = 1e-3
_FITTED, _FROM_LATEST = "deterministic, fitted to training", "deterministic, from the latest state"
_MODEL = "latent force model"
_END: dict[str, Any] = {"color": SEEN, "lw": 0.7, "ls": ":", "label": "end of training"}


def draw(results: Mapping[str, Result], online: Mapping[str, Result]) -> dict[str, Figure]:
    """Return every figure of the comparison by name."""
    name = next(iter(online), next(iter(results)))
    systems = grouped(results)
    found = {"all" if len(systems) == 1 else f"all-{system}": plot_all(own) for system, own in systems.items()}
    found |= {f"errors-{name}": plot_errors(name, results[name]), f"forces-{name}": plot_forces(name, results[name])}
    if name in online:
        found[f"online-{name}"] = plot_online(name, online[name])
    return found


@style.styled
def plot_forces(name: str, result: Result, *, width: str | float = "full") -> Figure:
    """Draw the small forces of a satellite: learnt in training, predicted after it, and what all positions show."""
    names = [str(one) for one in np.atleast_1d(result["force_names"])]
    figure, panels = style.small_multiples(width, len(names), 1.7)
    days, train = result["times"] / 24.0, result["times"][int(result["train"])] / 24.0
    for index, (axes, force) in enumerate(zip(panels, names, strict=True)):
        mean, sd = result["forces"][:, index], result["forces_sd"][:, index]
        axes.plot(days, result["seen"][:, index], color=DETERMINISTIC, lw=0.8, label="smoothed from all positions")
        axes.plot(days, mean, color=LFM, lw=0.9, label="learnt in training, then predicted")
        band(axes, days, mean, sd, color=LFM, alpha=0.2, label="95%")
        axes.axvline(train, **_END)
        middle = np.median(result["seen"][:, index])
        reach = 1.5 * max(np.abs(result["seen"][:, index] - middle).max(), np.abs(mean - middle).max(), 0.05)
        axes.set_ylim(middle - reach, middle + reach)
        axes.set_title(f"{name}: {force}")
        style.label_values(axes, force, "nm/s²")
    style.label_time(panels, "days")
    legend(figure)
    return figure


@style.styled
def plot_errors(name: str, result: Result, *, width: str | float = "full") -> Figure:
    """Draw the errors of a satellite's position along the radial, tangential and normal directions."""
    figure, panels = style.small_multiples(width, 3, 1.7)
    days, train = result["times"] / 24.0, int(result["train"])
    for index, (axes, direction) in enumerate(zip(panels, ("radial", "tangential", "normal"), strict=True)):
        lfm, sd = result["lfm"][:, index] / METRE, result["sd"][:, index] / METRE
        axes.plot(days, result["fitted"][:, index] / METRE, color=DETERMINISTIC, lw=0.9, label=_FITTED)
        axes.plot(days, result["latest"][:, index] / METRE, color=LATEST, lw=0.9, ls="--", label=_FROM_LATEST)
        axes.plot(days, lfm, color=LFM, lw=0.9, label=_MODEL)
        band(axes, days, 0.0, sd, color=LFM, alpha=0.2, label="its 95% about zero")
        axes.axvline(days[train], **_END)
        largest = max(np.nanmax(np.abs(result[key][:, index])) for key in ("fitted", "latest", "lfm")) / METRE
        axes.set_ylim(-1.1 * largest, 1.1 * largest)
        axes.set_title(f"{name}: {direction}")
        style.label_values(axes, "error", "m")
    style.label_time(panels, "days")
    legend(figure)
    return figure


@style.styled
def plot_online(name: str, result: Result, *, width: str | float = "full") -> Figure:
    """Draw the errors of both models as positions come in, in windows with predictions between them."""
    figure, panels = style.small_multiples(width, 3, 1.7)
    days, observed = result["times"] / 24.0, result["observed"].astype(bool)
    for index, (axes, direction) in enumerate(zip(panels, ("x", "y", "z"), strict=True)):
        sd = result["sd"][:, index] / METRE
        axes.fill_between(days, 0, 1, where=observed, color=SEEN, alpha=0.2, lw=0,
                          transform=axes.get_xaxis_transform())
        axes.plot(days, result["restarted"][:, index] / METRE, color=LATEST, lw=0.9, ls="--", label=_FROM_LATEST)
        axes.plot(days, result["lfm"][:, index] / METRE, color=LFM, lw=0.9, label=_MODEL)
        band(axes, days, 0.0, sd, color=LFM, alpha=0.2, label="its 95% about zero")
        largest = max(np.nanmax(np.abs(result[key][observed.argmin():, index])) for key in ("restarted", "lfm"))
        axes.set_ylim(-1.1 * largest / METRE, 1.1 * largest / METRE)
        axes.set_title(f"{name}: {direction}")
        style.label_values(axes, "error", "m")
    style.label_time(panels, "days")
    legend(figure, patch("positions observed", SEEN, alpha=0.2))
    return figure


@style.styled
def plot_all(results: Mapping[str, Result], *, width: str | float = "full") -> Figure:
    """Draw the errors after training of all satellites; those in the Earth's shadow and with gaps stand apart."""
    figure = style.new_figure(width, 2.6)
    axes = figure.subplots()
    groups: dict[str, list[str]] = {"in the Earth's shadow": [], "with gaps": []}
    names: list[str] = []
    for name in sorted(results):
        one = results[name]
        group = "" if one["complete"] and not one["eclipsed"] else list(groups)[not one["complete"]]
        groups.get(group, names).append(name)
    starts = {}
    for group, own in groups.items():
        if own:
            starts[group] = len(names)
            names += own
    place = np.arange(len(names))
    for key, colour, marker, label in (("fitted", DETERMINISTIC, "o", _FITTED), ("latest", LATEST, "^", _FROM_LATEST),
                                       ("lfm", LFM, "s", _MODEL)):
        errors = [rms(results[name][key][int(results[name]["train"]):]) for name in names]
        axes.semilogy(place, errors, ls="", marker=marker, ms=3.5, color=colour, label=label)
    for group, first in starts.items():
        axes.axvline(first - 0.5, color=SEEN, lw=0.7, ls=":")
        axes.text(first - 0.4, 1.0, group, va="bottom", transform=axes.get_xaxis_transform(),
                  fontsize=style.SMALL, color=SEEN)
    axes.set_xticks(place, names, rotation=90, fontsize=style.SMALL)
    axes.tick_params(labelsize=style.SMALL, length=2.5, width=0.6)
    axes.set_ylabel("error after training (m)")
    legend(figure)
    return figure


def rms(errors: Any) -> float:
    """Return the root mean square distance in metres, of errors (T, 3) in km; NaN rows do not count."""
    return float(np.sqrt(np.nanmean((np.asarray(errors) ** 2).sum(axis=1)))) / METRE
