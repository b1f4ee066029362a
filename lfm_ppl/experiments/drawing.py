"""What the figures of studies share: how a truth, a band and error bars look, and a legend of what is drawn.

A figure draws with labels, in any of its panels, and ends with `legend`, which shows each label once. Its function
takes what was computed and, by name, its ``width``: "column" (3.4 in), "full" (7 in), or inches.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from lfm_ppl.experiments.scores import Estimate, Z
from lfm_ppl.results.plots import style

SHADE = "#B3D5E9"
"""Of a band about a blue line."""

SPAN = "#DDDDDD"
"""Of what is allowed, or expected."""

TRUTH: dict[str, Any] = {"color": style.BLACK, "lw": 0.8, "ls": "--", "label": "truth"}
"""How the truth is drawn."""


def band(axes: Axes, x: Any, mean: Any, sd: Any, *, color: str = SHADE, label: str = "95% band", z: float = Z,
         **how: Any) -> None:
    """Draw the band of ``z`` standard deviations about a mean."""
    axes.fill_between(x, mean - z * sd, mean + z * sd, color=color, lw=0, label=label, **how)


def bars(axes: Axes, x: Any, estimates: Sequence[Estimate], *, times: float = 2.0, **how: Any) -> None:
    """Draw estimates with error bars of so many standard errors, as points unless a line ``ls`` is asked for."""
    look: dict[str, Any] = {"ls": "", "ms": 3.0, "elinewidth": 0.8, "capsize": 1.5} | how
    axes.errorbar(x, [one.value for one in estimates], times * np.array([one.error for one in estimates]), **look)


def line(label: str, color: str, ls: Any = "-", **how: Any) -> Line2D:
    """Return the entry of a legend for a line, or for points where ``ls`` is empty and there is a marker."""
    return Line2D([], [], color=color, ls=ls, label=label, **how)


def patch(label: str, color: str, **how: Any) -> Patch:
    """Return the entry of a legend for an area."""
    return Patch(color=color, label=label, **how)


def legend(figure: Figure, *more: Any) -> None:
    """Put one legend for all panels on top: each label of what is drawn once, in its order, then ``more`` entries."""
    found: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    style.legend_above(figure, [*found.values(), *more])
