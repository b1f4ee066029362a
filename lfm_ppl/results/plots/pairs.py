"""Figure of the joint posterior: scatter plots of every pair of scalar parameters.

1. Histograms of the marginals on the diagonal, scatter plots below it.
2. Divergent draws and the truth are marked; axes share their labels along rows and columns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from lfm_ppl.results.plots import style
from lfm_ppl.results.plots.chains import (
    divergences,
    known_truth,
    parameter_units,
    parameters_to_draw,
)

_SMALLEST, _MARGIN = 0.77, 0.8  # inches: a panel that holds its labels, the room beside them
MAX_POINTS = 2000


@style.styled
def plot_pairs(
    result: Any, parameters: Sequence[str] | None = None, *, width: str | float = "full"
) -> Figure:
    """Draw every pair of scalar parameters against each other, and their marginals.

    Below the diagonal are the draws (2,000 of them at most), on it the histogram of each parameter.
    Divergent transitions stand out, and true values are drawn as lines where they are known.

    Args:
        result: with the group posterior; sample_stats and truth where there are any.
        parameters: names such as ``decay`` or ``decay[CDKN1A]``; None for the first that were
            sampled and vary, as many as the width holds (8, or 3 in a column).
        width: "column" (3.4 in), "full" (7 in), or inches.

    Returns:
        A figure with a lower triangle of panels; its axes are row by row.

    Raises:
        ValueError: there is no posterior, a parameter is unknown, or more are named than fit.

    Example:
        >>> import xarray as xr
        >>> from lfm_ppl.results.arviz_data import build
        >>> draws = np.random.default_rng(0).normal(size=(4, 100, 2))
        >>> posterior = xr.Dataset({"decay": (("chain", "draw", "gene"), draws)})
        >>> len(plot_pairs(build({"posterior": posterior})).axes)
        3
    """
    limit = max(int((style.inches(width) - _MARGIN) / _SMALLEST), 1)
    draws, labels, note = parameters_to_draw(result, parameters, limit)
    count = len(labels)
    if count > limit:
        raise ValueError(
            f"{count} parameters do not fit into {style.inches(width):g} inches; name at most "
            f"{limit}, or pass width={math.ceil(count * _SMALLEST + _MARGIN)}."
        )
    truth, units = known_truth(result), parameter_units(result)
    diverging = divergences(result).ravel()
    flat = [draws[label].ravel() for label in labels]
    panel = min((style.inches(width) - _MARGIN) / count, 1.5)
    figure = style.new_figure(width, panel * count + 0.9)
    grid = figure.subplots(count, count, squeeze=False, sharex="col")
    for row in range(count):
        for column in range(count):
            axes = grid[row, column]
            if column > row:
                axes.remove()
                continue
            _tidy(axes, column == 0 and row > 0, row == count - 1, panel)
            if row == column:
                _draw_marginal(axes, flat[row], truth.get(labels[row]))
            else:
                lines = truth.get(labels[column]), truth.get(labels[row])
                _draw_pair(axes, flat[column], flat[row], diverging, lines)
    for index, label in enumerate(labels):
        bottom, left_axes = grid[count - 1, index], grid[index, 0]
        _name_axis(bottom.xaxis, label, units.get(label, ""), panel)
        if index:
            _name_axis(left_axes.yaxis, label, units.get(label, ""), panel)
    figure.align_labels()
    _legend(figure, bool(diverging.any()), any(label in truth for label in labels))
    if note:
        style.note_below(figure, note)
    return figure


_DIVERGENT: dict[str, Any] = {
    "color": style.VERMILLION,
    "ls": "",
    "marker": "D",
    "ms": 2.4,
    "mew": 0,
}
_TRUTH: dict[str, Any] = {"color": style.BLACK, "lw": 0.8, "ls": (0, (4, 2))}


def _tidy(axes: Axes, y_labels: bool, x_labels: bool, panel: float) -> None:
    style.tidy(axes, x_ticks=2, y_ticks=2)
    axes.tick_params(labelleft=y_labels, labelbottom=x_labels)
    if panel < 1.0:  # inches; three numbers do not fit side by side
        axes.tick_params(axis="x", labelrotation=90)


def _draw_marginal(axes: Axes, values: np.ndarray, truth: float | None) -> None:
    bins = int(np.clip(np.sqrt(values.size), 10, 40))
    axes.hist(values[np.isfinite(values)], bins, color=style.SKY, histtype="stepfilled")
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    if truth is not None:
        axes.axvline(truth, **_TRUTH)


def _draw_pair(
    axes: Axes,
    x: np.ndarray,
    y: np.ndarray,
    diverging: np.ndarray,
    truth: tuple[float | None, float | None],
) -> None:
    # Evenly thinned draws look like all of them; divergences are rare and are all drawn.
    thinned = slice(None, None, -(-x.size // MAX_POINTS))
    axes.plot(
        x[thinned], y[thinned], color=style.BLUE, ls="", marker="o", ms=1.6, mew=0, alpha=0.35,
        rasterized=True,
    )  # fmt: skip
    if diverging.any():
        axes.plot(x[diverging], y[diverging], **_DIVERGENT)
    if truth[0] is not None:
        axes.axvline(truth[0], **_TRUTH)
    if truth[1] is not None:
        axes.axhline(truth[1], **_TRUTH)


def _legend(figure: Figure, diverging: bool, truth: bool) -> None:
    handles = [
        Line2D([], [], color=style.BLUE, ls="", marker="o", ms=3, mew=0, label="draw"),
    ]
    if diverging:
        handles.append(Line2D([], [], label="divergent", **_DIVERGENT))
    if truth:
        handles.append(Line2D([], [], label="truth", **_TRUTH))
    if len(handles) > 1:
        style.legend_above(figure, handles)


def _name_axis(axis: Axis, label: str, unit: str, panel: float) -> None:
    room = int(panel / 0.062)  # characters along the side of a panel
    unit = f"{style.scale(axis)} {unit}".strip()
    lines = style.wrapped(label, room) + ([f"({unit})"] if unit else [])
    axis.set_label_text("\n".join(lines), fontsize=style.SMALL)
