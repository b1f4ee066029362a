"""Elements that the figures of studies share: truth, bands, error bars and legends.

Each artist gets a label when it is drawn, in any panel; `legend` then shows each label once. The functions of the
figures take the results and the keyword ``width``: "column" (3.4 in), "full" (7 in), or a number of inches.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from lfm_ppl.plots import style

from .scores import Estimate, Z

SHADE = "#B3D5E9"
"""Colour of a band about a blue line."""

SPAN = "#DDDDDD"
"""Colour of a range of permitted or expected values."""

TRUTH: dict[str, Any] = {"color": style.BLACK, "lw": 0.8, "ls": "--", "label": "truth"}
"""Line properties of the truth."""


def band(axes: Axes, x: Any, mean: Any, sd: Any, *, color: str = SHADE, label: str = "95% band", z: float = Z,
         **properties: Any) -> None:
    """Draw the band of ``z`` standard deviations about a mean."""
    axes.fill_between(x, mean - z * sd, mean + z * sd, color=color, lw=0, label=label, **properties)


def bars(axes: Axes, x: Any, estimates: Sequence[Estimate], *, times: float = 2.0, **properties: Any) -> None:
    """Draw estimates with error bars of ``times`` standard errors, as points unless ``ls`` sets a line style."""
    defaults: dict[str, Any] = {"ls": "", "ms": 3.0, "elinewidth": 0.8, "capsize": 1.5}
    values, errors = [estimate.value for estimate in estimates], [estimate.error for estimate in estimates]
    axes.errorbar(x, values, times * np.array(errors), **(defaults | properties))


def line(label: str, color: str, ls: Any = "-", **properties: Any) -> Line2D:
    """Return a legend entry for a line, or for points with an empty ``ls`` and a marker."""
    return Line2D([], [], color=color, ls=ls, label=label, **properties)


def patch(label: str, color: str, **properties: Any) -> Patch:
    """Return a legend entry for an area."""
    return Patch(color=color, label=label, **properties)


def legend(figure: Figure, *entries: Any) -> None:
    """Draw one legend for all panels above the figure: each label of an artist once, then the further ``entries``."""
    handles: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    style.legend_above(figure, [*handles.values(), *entries])
