"""The style of all figures: sizes of a paper, colours for colour-blind readers.

1. `styled` makes a figure function use the style without changing the global one.
2. Figures are made outside of pyplot, so that nothing keeps them in memory.
3. Ticks, dates, scales and long names are formatted for narrow columns.

Source: Okabe and Ito (2008), Color Universal Design, for the colours.
"""

from __future__ import annotations

import functools
import io
import itertools
import math
import re
import textwrap
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.dates import HOURLY, MINUTELY, MONTHLY, SECONDLY, AutoDateLocator, ConciseDateFormatter, num2date
from matplotlib.figure import Figure
from matplotlib.ticker import Formatter, Locator, MaxNLocator

from lfm_ppl.utils import calendar_time

WIDTHS = {"column": 3.4, "full": 7.0}  # inches: one column of a two-column paper, and both

# Okabe & Ito (2008), Color Universal Design.
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILLION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
GREY = "#707070"
CHAIN_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, BLACK, YELLOW)
TRUTH: dict[str, Any] = {"color": BLACK, "lw": 0.9, "ls": (0, (4, 2)), "zorder": 3.5, "label": "truth"}

_SHARED = ("%d %b %Y", "%b %Y", "%Y")
"""What the ticks of an axis of dates may share, which then stands once beside it: the day, the month or the year."""

SMALL = 7.0
_ROOM = 18  # characters along the side of a panel
STYLE = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 7.5,
    "axes.labelsize": 7.5,
    "axes.titlesize": 7.5,
    "axes.titlelocation": "left",
    "axes.titlepad": 3.0,
    "axes.labelpad": 2.0,
    "legend.fontsize": SMALL,
    "legend.frameon": False,
    "legend.handlelength": 1.4,
    "legend.columnspacing": 1.2,
    "legend.markerscale": 1.5,
    "xtick.labelsize": SMALL,
    "ytick.labelsize": SMALL,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.1,
    "figure.constrained_layout.h_pad": 0.03,
    "figure.constrained_layout.w_pad": 0.03,
    "figure.dpi": 150.0,
    "savefig.dpi": 300.0,
    "pdf.fonttype": 42,  # text that editors can change
    "svg.fonttype": "none",
}

P = ParamSpec("P")


class Drawing(Figure):
    """A figure outside pyplot, which a notebook shows once and nothing keeps in memory."""

    def savefig(self, *args: Any, **kwargs: Any) -> None:
        """Save the figure in our style, whose resolution is that of print."""
        with in_style():
            super().savefig(*args, **kwargs)

    def _repr_png_(self) -> bytes:
        with io.BytesIO() as buffer:
            self.savefig(buffer, format="png", dpi=150)
            return buffer.getvalue()


def in_style() -> Any:
    """Return the context in which figures are made and saved; the global style stays as it is."""
    return matplotlib.style.context(["default", STYLE])


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Make the figure function ``draw`` work in our style and leave the global one alone."""

    @functools.wraps(draw)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with in_style():
            figure = draw(*args, **kwargs)
            # Ticks are made when first drawn, from the style of that moment.
            figure.draw_without_rendering()
        return figure

    return wrapper


def inches(width: str | float) -> float:
    """Return the width of a figure in inches: of "column", "full", or a number of inches."""
    if isinstance(width, str):
        if width not in WIDTHS:
            raise ValueError(f"width must be {' or '.join(map(repr, WIDTHS))} or a number of inches, got {width!r}.")
        return WIDTHS[width]
    if not (math.isfinite(width) and width >= 2.0):
        raise ValueError(f"width must be at least 2 inches, got {width!r}.")
    return float(width)


def is_narrow(width: str | float) -> bool:
    """Return whether there is room for the layout of one column only."""
    return inches(width) < 5.0


def new_figure(width: str | float, height: float) -> Figure:
    """Return an empty figure, ``width`` as in ``inches`` and ``height`` in inches."""
    return Drawing(figsize=(inches(width), height), layout="constrained")


def tidy(axes: Axes, x_ticks: int = 5, y_ticks: int = 4, **properties: Any) -> None:
    """Give ``axes`` small ticks that keep their size, and at most so many intervals; then set its ``properties``."""
    axes.tick_params(labelsize=SMALL, length=2.5, width=0.6, pad=2.0)
    axes.xaxis.set_major_locator(MaxNLocator(x_ticks, steps=[1, 2, 2.5, 5, 10]))
    axes.yaxis.set_major_locator(MaxNLocator(y_ticks, steps=[1, 2, 2.5, 5, 10]))
    axes.set(**properties)


class PlainNumbers(Formatter):
    """Tick labels in units of a power of ten, with as many decimals as tell them apart."""

    def __init__(self, power: int) -> None:
        self.unit = 10.0**power

    def __call__(self, x: float, pos: int | None = None) -> str:
        """Return the label of a number outside of an axis."""
        return self.format_ticks([x])[0]

    def format_ticks(self, values: Sequence[float]) -> list[str]:
        """Return the labels of ticks, all with the same number of decimals."""
        ticks = [float(value) / self.unit for value in values]
        step = min((b - a for a, b in itertools.pairwise(ticks)), default=0.0) or 1.0
        decimals = 0
        while decimals < 12 and any(abs(t - round(t, decimals)) > 1e-3 * step for t in ticks):
            decimals += 1
        labels = [f"{round(tick, decimals) + 0.0:.{decimals}f}" for tick in ticks]
        return [label.replace("-", "\N{MINUS SIGN}") for label in labels]


def scale(axis: Axis) -> str:
    """Label the ticks of ``axis`` in units of a power of ten that keeps them short.

    Returns:
        The power, such as ``10⁻⁵``, to stand before the unit in the label of the axis; empty where
        the numbers are of ordinary size.
    """
    largest = max(map(abs, axis.get_view_interval()))
    power = math.floor(math.log10(largest)) if largest > 0 and math.isfinite(largest) else 0
    if -2 <= power <= 4:
        power = 0
    axis.set_major_formatter(PlainNumbers(power))
    raised = str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"10{raised}" if power else ""


def small_multiples(width: str | float, count: int, height: float, sharex: bool = True) -> tuple[Figure, list[Axes]]:
    """Return a figure of ``count`` panels, and its axes row by row.

    Args:
        width: of the figure.
        count: number of panels, at least one.
        height: of a panel, in inches.
        sharex: whether the panels have a common x axis, whose tick labels only the lowest panel of a column shows.
    """
    limits = (3, 2) if is_narrow(width) else (4, 3)
    columns = 1 if is_narrow(width) and count <= limits[0] else min(count, limits[1])
    rows = math.ceil(count / columns)
    figure = new_figure(width, (height if sharex else height + 0.3) * rows + 0.55)
    panels = list(figure.subplots(rows, columns, sharex=sharex, squeeze=False).flat)
    for spare in panels[count:]:
        spare.remove()
    for index, axes in enumerate(panels[:count]):
        tidy(axes)
        axes.tick_params(labelbottom=not sharex or index + columns >= count)
    return figure, panels[:count]


def in_a_row(width: str | float, count: int, height: float, **shared: Any) -> tuple[Figure, list[Axes]]:
    """Return a figure of ``count`` panels side by side, and its axes; in a narrow one they stand above one another.

    Args:
        width: of the figure.
        count: number of panels.
        height: of the figure where they stand side by side, in inches.
        **shared: axes that the panels share, as for `Figure.subplots`.
    """
    narrow = is_narrow(width)
    figure = new_figure(width, height * (0.3 + 0.7 * count if narrow else 1.0))
    grid = figure.subplots(*((count, 1) if narrow else (1, count)), **shared, squeeze=False)
    return figure, list(grid.flat)


class Dates(Formatter):
    """Tick labels of calendar time, for an axis whose numbers are times since an origin."""

    def __init__(self, origin: str, unit: str) -> None:
        self.origin, self.unit = origin, unit
        self.dates = ConciseDateFormatter(AutoDateLocator(), show_offset=False)

    def days(self, times: Any) -> np.ndarray:
        """Return times as Matplotlib's dates."""
        return calendar_time.days_of(times, self.origin, self.unit)

    def common(self, ticks: Sequence[float]) -> str:
        """Return what all ticks share and their labels leave out: the year, the month, the day."""
        dates = [num2date(day) for day in self.days(ticks)]
        return next((kinds.pop() for form in _SHARED if len(kinds := {day.strftime(form) for day in dates}) == 1), "")

    def __call__(self, x: float, pos: int | None = None) -> str:
        """Return the label of a time outside of an axis, as under the mouse."""
        return num2date(float(self.days(x))).strftime("%Y-%m-%d %H:%M")

    def format_ticks(self, values: Sequence[float]) -> list[str]:
        """Return the labels of ticks, each as short as what stands beside it allows."""
        return self.dates.format_ticks(list(self.days(values)))


class DateTicks(Locator):
    """Ticks at round dates and times of day, for the axis of `Dates`."""

    def __init__(self, dates: Dates, ticks: int) -> None:
        self.dates = dates
        self.inner = AutoDateLocator(minticks=3, maxticks=ticks)
        # Less than three of a unit, and so many of the next smaller one that none of its intervals keeps to the number
        # of ticks, is two and a half days, say, at 12 hours: ticks then stand at the larger unit after all.
        for frequency, divisor in ((MONTHLY, 12), (HOURLY, 24), (MINUTELY, 60), (SECONDLY, 60)):
            self.inner.intervald[frequency] = [*self.inner.intervald[frequency], divisor]

    def __call__(self) -> Any:
        """Return the ticks of the interval that the axis shows."""
        assert self.axis is not None
        return self.tick_values(*self.axis.get_view_interval())

    def tick_values(self, vmin: float, vmax: float) -> Any:
        """Return the ticks of an interval."""
        start, end = self.dates.days((vmin, vmax))
        days = np.asarray(self.inner.tick_values(num2date(start), num2date(end)))
        return vmin + (days - start) * ((vmax - vmin) / (end - start))


def label_time(panels: Sequence[Axes], unit: str, origin: str = "") -> None:
    """Write "time" and its unit, or its dates, under the panels that show x tick labels.

    Args:
        panels: whose x axis is time.
        unit: of time.
        origin: the calendar time of t = 0 as ISO 8601 text; empty: times are plain numbers.
    """
    for axes in panels:
        if origin and unit in calendar_time.SECONDS:
            dates = Dates(origin, unit)
            ticks = DateTicks(dates, 6)
            axes.xaxis.set_major_formatter(dates)
            axes.xaxis.set_major_locator(ticks)
            if axes.xaxis.get_tick_params()["labelbottom"]:
                low, high = axes.get_xlim()
                visible = [tick for tick in ticks.tick_values(low, high) if low <= tick <= high]
                axes.set_xlabel(with_unit("time", dates.common(visible), 40))
            continue
        power = scale(axes.xaxis)
        if axes.xaxis.get_tick_params()["labelbottom"]:
            axes.set_xlabel(with_unit("time", f"{power} {unit}".strip(), 40))


def label_values(axes: Axes, name: str, unit: str, title: str = "") -> None:
    """Write ``name (unit)`` along the y axis; a title, and a name too long for the axis, stand above the panel."""
    unit = f"{scale(axes.yaxis)} {unit}".strip()
    if max(map(len, wrapped(name, _ROOM))) > _ROOM:
        title = f"{title}, {name}" if title else name
        axes.set_ylabel(unit)
    else:
        axes.set_ylabel(with_unit(name, unit))
    axes.set_title(title)


def legend_above(figure: Figure, handles: Sequence[Any] = ()) -> None:
    """Put one legend for all panels on top of ``figure``, in as many rows as it needs.

    Args:
        figure: the figure.
        handles: entries of the legend; empty: each label of the artists in any panel once.
    """
    if not handles:
        by_label: dict[str, Any] = {}
        for axes in figure.axes:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                by_label.setdefault(label, handle)
        handles = list(by_label.values())
    for rows in range(1, len(handles) + 1):
        columns = math.ceil(len(handles) / rows)
        legend = figure.legend(handles=handles, loc="outside upper center", ncols=columns)
        if columns == 1 or legend.get_window_extent().width <= figure.bbox.width:
            return
        legend.remove()


def note_below(figure: Figure, text: str) -> None:
    """Write a remark under ``figure``, if there is one."""
    if lines := textwrap.wrap(text, int(figure.get_figwidth() * 17)):
        figure.supxlabel("\n".join(lines), fontsize=SMALL, color=GREY)


def with_unit(name: str, unit: str, room: int = _ROOM) -> str:
    """Return ``name (unit)``, in lines of ``room`` characters where spaces and brackets allow it."""
    if unit and len(name) + len(unit) + 3 <= room:
        return f"{name} ({unit})"
    return "\n".join([*wrapped(name, room), f"({unit})"] if unit else wrapped(name, room))


def wrapped(name: str, room: int) -> list[str]:
    """Break a name such as ``basal_rate[CDKN1A]`` before brackets and at spaces."""
    if len(name) <= room:
        return [name]
    return [line for piece in re.findall(r"\[[^\[]*|[^\[]+", name)
            for line in textwrap.wrap(piece, room, break_long_words=False, break_on_hyphens=False)]


def first_of(names: Sequence[str], selection: Sequence[str] | None, limit: int, argument: str) -> tuple[list[str], str]:
    """Cut ``names`` to ``limit`` unless the caller chose them, and say what was left out.

    Returns:
        The names to draw, and a remark for the figure (empty where nothing is left out).
    """
    if selection is not None or len(names) <= limit:
        return list(names), ""
    return list(names[:limit]), f"The first {limit} of {len(names)} {argument}; choose others with {argument}=[...]."
