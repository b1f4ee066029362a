"""The panels of a figure over time: the names and the series that it shows, and its labels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lfm_ppl.plots import forecasts, style
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.results.series import series_view
from lfm_ppl.utils.checks import one_of

MAX_PANELS = 12


def pick(variable: xr.DataArray, kind: str, selection: Sequence[str] | None) -> list[str]:
    """Return the names along ``kind`` to draw: those wanted, or all; refuse unknown ones."""
    available = [str(name) for name in variable[kind].values]
    if selection is None:
        return available
    selection = [selection] if isinstance(selection, str) else list(selection)
    for name in selection:
        one_of(kind, name, available)
    if not selection:
        raise ValueError(f"{kind}s is empty; name at least one of {', '.join(available)}.")
    return selection


def series_views(view: ResultView, series: Any, count: int) -> tuple[dict[str, ResultView], str]:
    """Return the series of a panel to draw, and a remark where some are left out.

    Args:
        view: of a panel, or of one series.
        series: labels or positions; None for all, as many as have room.
        count: number of axes of each series.

    Returns:
        Title -> view of one series; without a title where ``view`` is of one.
    """
    if view.series_dimension is None:
        if series is not None:
            raise ValueError("series selects series of a panel, and the result is of one series; leave it out.")
        return {"": view}, ""
    labels = view.series_labels if series is None else [series] if np.ndim(series) == 0 else list(series)
    labels, note = style.first_of(labels, series, max(1, MAX_PANELS // count), "series")
    members = [series_view(view, label) for label in labels]
    return {member.attrs["selected"]: member for member in members}, note


def recent_series(view: ResultView, series: Any, count: int) -> tuple[dict[str, ResultView], str]:
    """Return `series_views` within the window of a forecast, and a remark."""
    views, note = series_views(view, series, count)
    parts = {title: forecasts.recent_part(member) for title, member in views.items()}
    remarks = {remark for _, remark in parts.values() if remark}
    if len(remarks) > 1:
        remarks = {"The last rows of data and the forecast."}
    return {title: part for title, (part, _) in parts.items()}, " ".join([*remarks, note])


def finish(figure: Figure, panels: list[Axes], view: ResultView, remark: str) -> None:
    """Label the time of all panels, and add a legend and a remark."""
    style.label_time(panels, view.time_unit, view.time_origin)
    figure.align_ylabels(panels)
    style.legend_above(figure)
    style.note_below(figure, remark)
