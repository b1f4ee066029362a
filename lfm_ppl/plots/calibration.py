"""Figure of simulation-based calibration: the ranks of every scalar parameter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator
from scipy import stats

from lfm_ppl.accuracy.calibration import Calibration, p_values
from lfm_ppl.plots import style

MAX_PANELS = 9
_BAND = "#DDDDDD"


@style.styled
def plot_calibration(calibration: Calibration, parameters: Sequence[str] | None = None, *, bins: int = 16,
                     width: str | float = "column") -> Figure:
    """Draw the histogram of the ranks of each scalar parameter.

    Where the sampler is right the bars are level, up to chance: 99% of them end inside the grey band. A hill says that
    the posterior is too wide, a valley too narrow, a slope that it is shifted. The p-value over a panel is of the
    largest distance between the distribution function of the ranks and the uniform one.

    Args:
        calibration: what `lfm_ppl.accuracy.calibration.calibrate` returns.
        parameters: names; None for all, up to 9.
        bins: a divisor of the number of possible ranks.
        width: "column" (3.4 in), "full" (7 in), or inches.

    Returns:
        A figure with one panel per scalar.

    Raises:
        ValueError: a parameter is unknown, or ``bins`` does not divide the number of possible ranks.

    Example:
        >>> ranks = np.random.default_rng(0).integers(0, 64, 200)
        >>> figure = plot_calibration(Calibration({"decay": ranks}, 63))
        >>> figure.axes[0].get_title(loc="left")
        'decay, p = 0.28'
    """
    for name in parameters or ():
        if name not in calibration.ranks:
            raise ValueError(f"unknown parameter {name!r}; there are {', '.join(calibration.ranks)}.")
    names, note = style.first_of(list(parameters or calibration.ranks), parameters, MAX_PANELS, "parameters")
    figure, panels = style.small_multiples(width, len(names), 0.95)
    for axes, name in zip(panels, names, strict=True):
        rank = calibration.ranks[name]
        _draw(axes, rank, calibration.draws, bins)
        p = p_values(rank, calibration.draws, bins)["ecdf"]
        axes.set_title(f"{name}, p < 0.001" if p < 0.001 else f"{name}, p = {p:.2g}")
        if axes.xaxis.get_tick_params()["labelbottom"]:
            axes.set_xlabel(f"rank among {calibration.draws} draws")
    figure.supylabel("data sets", fontsize=7.5)
    style.legend_above(figure)
    style.note_below(figure, note)
    return figure


def _draw(axes: Axes, rank: np.ndarray, draws: int, bins: int) -> None:
    edges = np.linspace(-0.5, draws + 0.5, bins + 1)
    counts, _ = np.histogram(rank, edges)
    low, high = stats.binom.ppf([0.005, 0.995], len(rank), 1.0 / bins)
    axes.axhspan(low, high, color=_BAND, lw=0, zorder=0, label="99% if calibrated")
    axes.stairs(counts, edges, fill=True, color=style.SKY, alpha=0.75, zorder=1, label="data sets")
    axes.axhline(len(rank) / bins, color=style.GREY, lw=0.8, zorder=2, label="expected")
    axes.set_xlim(edges[0], edges[-1])
    axes.xaxis.set_major_locator(FixedLocator([0, (draws + 1) // 2, draws]))
    axes.set_ylim(0, 1.1 * max(high, counts.max()))
