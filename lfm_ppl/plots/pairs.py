"""Figure of the joint posterior: scatter plots of every pair of scalar parameters.

1. Histograms of the marginals on the diagonal, scatter plots below it.
2. Divergent draws and the truth are marked; a name on the diagonal holds for its row and its column.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lfm_ppl.plots import style
from lfm_ppl.plots.chains import parameters_to_draw
from lfm_ppl.results.result_view import ResultView

_SMALLEST, _MARGIN = 0.77, 0.8  # inches: a panel that holds its labels, the room beside them
MAX_POINTS = 2000


@style.styled
def plot_pairs(result: Any, parameters: Sequence[str] | None = None, *, width: str | float = "full") -> Figure:
    """Draw every pair of scalar parameters against each other, and their marginals.

    Below the diagonal are the draws (2,000 of them at most), on it the histogram of each parameter under its name,
    which holds for the column below and for the row to the left. Divergent transitions stand out, and true values are
    drawn as lines where they are known.

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
    view = ResultView.of(result)
    labels, note = parameters_to_draw(view, parameters, limit)
    count = len(labels)
    if count > limit:
        raise ValueError(f"{count} parameters do not fit into {style.inches(width):g} inches; name at most {limit}, or "
                         f"pass width={math.ceil(count * _SMALLEST + _MARGIN)}.")
    truth, units = view.truth, view.units
    diverging = view.divergences.ravel()
    flat = [view.draws[label].ravel() for label in labels]
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
        unit = f"{style.scale(bottom.xaxis)} {units.get(label, '')}".strip()
        if index:
            left_axes.yaxis.set_major_formatter(bottom.xaxis.get_major_formatter())
        _write_above(grid[index, index], f"{label} ({unit})" if unit else label, float(2 * index >= count))
    if diverging.any() or any(label in truth for label in labels):
        style.legend_above(figure)
    style.note_below(figure, note)
    return figure


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
        axes.axvline(truth, **style.TRUTH)


def _draw_pair(axes: Axes, x: np.ndarray, y: np.ndarray, diverging: np.ndarray,
               truth: tuple[float | None, float | None]) -> None:
    # Evenly thinned draws look like all of them; divergences are rare and are all drawn.
    thinned = slice(None, None, -(-x.size // MAX_POINTS))
    axes.plot(x[thinned], y[thinned], color=style.BLUE, ls="", marker="o", ms=1.6, mew=0, alpha=0.35, rasterized=True,
              label="draw")
    if diverging.any():
        axes.plot(x[diverging], y[diverging], color=style.VERMILLION, ls="", marker="D", ms=2.4, mew=0,
                  label="divergent")
    if truth[0] is not None:
        axes.axvline(truth[0], **style.TRUTH)
    if truth[1] is not None:
        axes.axhline(truth[1], **style.TRUTH)


def _write_above(axes: Axes, text: str, side: float) -> None:
    """Write a text of any length above ``axes``, from its left edge (0) on or up to its right edge (1)."""
    axes.set_title(" ")  # the layout leaves room for the height of a title; the width would push panels apart
    name = axes.text(side, 1.03, text, transform=axes.transAxes, ha="right" if side else "left", va="bottom")
    name.set_in_layout(False)
