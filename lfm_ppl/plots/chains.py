"""Figure of the chains: traces and rank histograms of each scalar parameter.

1. Left, every draw in its order, with divergences marked.
2. Right, the ranks of the draws of each chain among all draws, one histogram above the other.

Source: Vehtari et al. (2021), Bayesian Analysis 16.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy import stats

from lfm_ppl.plots import style
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.results.scalars import choose, sampled

MAX_ROWS = 8


@style.styled
def plot_trace(result: Any, parameters: Sequence[str] | None = None, *, width: str | float = "column") -> Figure:
    """Draw the trace and the ranks of each scalar parameter, side by side.

    Left, every chain over its draws, divergent transitions marked at the bottom, and the true value
    where it is known. Right, for each chain the histogram of the ranks of its draws among the draws of
    all chains; it is level (the dashed line) where the chains agree.
    Source of the rank plot: Vehtari et al. (2021), Bayesian Analysis 16(2), section 5.

    Args:
        result: with the group posterior; sample_stats and truth where there are any.
        parameters: names such as ``decay`` or ``decay[CDKN1A]``; None for all that were sampled and vary, up to 8.
        width: "column" (3.4 in), "full" (7 in), or inches.

    Returns:
        A figure with one row of two panels per scalar parameter.

    Raises:
        ValueError: there is no posterior, or a parameter is unknown.

    Example:
        >>> import xarray as xr
        >>> from lfm_ppl.results.arviz_data import build
        >>> draws = np.random.default_rng(0).normal(size=(4, 100, 2))
        >>> posterior = xr.Dataset({"decay": (("chain", "draw", "gene"), draws)})
        >>> len(plot_trace(build({"posterior": posterior}), ["decay[0]"]).axes)
        2
    """
    view = ResultView.of(result)
    labels, note = parameters_to_draw(view, parameters, MAX_ROWS)
    draws, truth, units, diverging = view.draws, view.truth, view.units, view.divergences
    narrow = style.is_narrow(width)
    figure = style.new_figure(width, (0.82 if narrow else 0.95) * len(labels) + 0.75)
    rows = figure.subplots(len(labels), 2, squeeze=False, sharex="col", gridspec_kw={"width_ratios": [1.6, 1.0]})
    for (trace, ranks), label in zip(rows, labels, strict=True):
        for axes in (trace, ranks):
            style.tidy(axes, y_ticks=3)
        _draw_trace(trace, draws[label], diverging, truth.get(label))
        _draw_ranks(ranks, draws[label])
        unit = f"{style.scale(trace.yaxis)} {units.get(label, '')}".strip()
        trace.set_title(style.with_unit(label, unit, 40))
    rows[-1, 0].set_xlabel("draw")
    rows[-1, 1].set_xlabel("rank")
    chains = min(len(next(iter(draws.values()))), len(style.CHAIN_COLOURS))
    handles = [Line2D([], [], color=colour, lw=1.4, label=f"chain {chain}")
               for chain, colour in enumerate(_colours(chains))]
    if any(label in truth for label in labels):
        handles.append(Line2D([], [], **style.TRUTH))
    if diverging.any():
        handles.append(Line2D([], [], ls="", label="divergent", **_DIVERGENT))
    style.legend_above(figure, handles)
    style.note_below(figure, note)
    return figure


def parameters_to_draw(view: ResultView, names: Sequence[str] | None, limit: int) -> tuple[list[str], str]:
    """Return the labels of the scalars to draw, and a remark where some are left out."""
    selected = sampled(view.posterior) if names is None else choose(view.draws, names)
    if not selected:
        raise ValueError("no parameter varies in the posterior, so there is nothing to draw; known: "
                         f"{', '.join(view.draws) or 'none'}.")
    return style.first_of(selected, names, limit, "parameters")


_DIVERGENT: dict[str, Any] = {"color": style.VERMILLION, "marker": "|", "ms": 5, "mew": 1.0}


def _colours(chains: int) -> list[str]:
    return [style.CHAIN_COLOURS[chain % len(style.CHAIN_COLOURS)] for chain in range(chains)]


def _draw_trace(axes: Axes, draws: np.ndarray, diverging: np.ndarray, truth: float | None) -> None:
    chains, count = draws.shape
    for values, colour in zip(draws, _colours(chains), strict=True):
        axes.plot(values, color=colour, lw=0.4, alpha=0.8, rasterized=draws.size > 2000)
    positions = np.flatnonzero(diverging.any(axis=0))
    if len(positions):
        axes.plot(positions, np.full(len(positions), 0.05), ls="", transform=axes.get_xaxis_transform(), **_DIVERGENT)
    if truth is not None:
        axes.axhline(truth, **style.TRUTH)
    axes.set_xlim(-0.01 * count, 1.01 * count)


def _draw_ranks(axes: Axes, draws: np.ndarray) -> None:
    """Draw one histogram of ranks per chain, above one another, each relative to a level one."""
    chains, count = draws.shape
    ranks = stats.rankdata(draws, nan_policy="omit").reshape(draws.shape)
    edges = np.linspace(0.5, draws.size + 0.5, int(np.clip(count // 10, 4, 20)) + 1)
    heights = np.array([np.histogram(chain, edges)[0] for chain in ranks])
    level = count / (len(edges) - 1)
    scale = 0.9 / max(heights.max() / level, 1.8)
    for chain, colour in enumerate(_colours(chains)):
        # One patch for all bars: separate bars take longer to draw than the rest of the figure.
        axes.stairs(chain + heights[chain] / level * scale, edges, baseline=chain, fill=True, color=colour)
        axes.axhline(chain + scale, color=style.BLACK, lw=0.5, ls=(0, (2, 2)))
    axes.set_xlim(0, draws.size)
    axes.set_xticks([0, draws.size // 2, draws.size])
    axes.set_ylim(0, chains)
    axes.set_ylabel("chain")
    step = -(-chains // 4)
    axes.set_yticks(np.arange(0, chains, step) + scale / 2, [str(c) for c in range(0, chains, step)])
