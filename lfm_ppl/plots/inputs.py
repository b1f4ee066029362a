"""Figure of the known inputs that a result was made with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lfm_ppl.io.input_table import InputTable
from lfm_ppl.plots import forecasts, style
from lfm_ppl.plots.panels import MAX_PANELS, finish
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.utils.checks import one_of

_MANY = 150  # values, from which they have no marks


@style.styled
def plot_inputs(result: Any, inputs: Sequence[str] | None = None, *, width: str | float = "column") -> Figure:
    """Draw the known inputs of a model as it reads them, steps or straight lines, as far as its forecast.

    Beyond its last value an input is held, which a dashed line shows.

    Args:
        result: of a model with known inputs in a data file or `lfm_ppl.Data`.
        inputs: names; None for all, up to 12.
        width: "column" (3.4 in), "full" (7 in), or inches.

    Returns:
        A figure with one panel per input.

    Raises:
        ValueError: the result holds no known inputs, or an input is unknown.

    Example:
        >>> import numpy as np
        >>> from lfm_ppl.io.input_table import InputTable
        >>> from lfm_ppl.results.arviz_data import build
        >>> from lfm_ppl.results.inputs import GROUP, to_dataset
        >>> heater = InputTable(np.array([0.0, 6.0, 22.0]), np.array([0.0, 1.0, 0.0]), "previous")
        >>> [axes.get_ylabel() for axes in plot_inputs(build({GROUP: to_dataset({"heater": heater})})).axes]
        ['heater']
    """
    view = ResultView.of(result)
    tables = view.inputs | view.forecast_inputs
    if not tables:
        raise ValueError("the result holds no known inputs. Give them as columns of the data file, or in "
                         "lfm.Data(..., inputs=...).")
    selected = list(tables) if inputs is None else [inputs] if isinstance(inputs, str) else list(inputs)
    for name in selected:
        one_of("input", name, tables)
    names, note = style.first_of(selected, inputs, MAX_PANELS, "inputs")
    figure, panels = style.small_multiples(width, len(names), 1.25)
    _, end = forecasts.forecast_span(view)
    for axes, name in zip(panels, names, strict=True):
        table = tables[name]
        if table.is_dose:
            _draw_doses(axes, table)
        else:
            _draw_function(axes, table, end)
        forecasts.mark_last_observation(axes, view)
        style.label_values(axes, name, view.input_unit(name))
    if window := forecasts.forecast_window(view):
        panels[0].set_xlim(window)
    finish(figure, panels, view, note)
    return figure


def _draw_function(axes: Axes, table: InputTable, end: float) -> None:
    """Draw an input as the model reads it, held to the end of a forecast."""
    draw_style = "steps-post" if table.interpolation == "previous" else "default"
    marker = "o" if len(table.times) <= _MANY else ""
    axes.plot(table.times, table.values, drawstyle=draw_style, marker=marker, ms=2.2, color=style.PURPLE, mew=0,
              label="known input")
    if table.times[-1] < end:
        axes.plot([table.times[-1], end], np.repeat(table.values[-1], 2), color=style.PURPLE, ls="--",
                  label="held beyond its table")


def _draw_doses(axes: Axes, table: InputTable) -> None:
    """Draw doses as stems from zero."""
    axes.vlines(table.times, 0.0, table.values, color=style.PURPLE, lw=1.2, label="dose")
    axes.plot(table.times, table.values, "o", ms=2.2, color=style.PURPLE, mew=0)
    low, high = table.values.min(initial=0.0), table.values.max(initial=0.0)
    axes.set_ylim(1.1 * low, 1.1 * high if high > low else 1.0)
