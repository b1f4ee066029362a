"""All figures of a result, as files."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.figure import Figure

from lfm_ppl.plots import (
    accuracy,
    chains,
    fields,
    fit_to_data,
    forecasts,
    inputs,
    pairs,
    panels,
    residuals,
    trajectories,
)
from lfm_ppl.results.fields import GROUP as FIELD
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.results.scalars import sampled
from lfm_ppl.utils.atomic_files import atomic_write, refuse_existing

MAX_PAGES = 5
Draw = Callable[..., Figure]
_OVER_TIME: dict[str, Draw] = {
    "fit": fit_to_data.plot_fit, "inputs": inputs.plot_inputs, "forces": trajectories.plot_forces,
    "deterministics": trajectories.plot_deterministics, "states": trajectories.plot_states,
}


def save_figures(result: Any, folder: str | Path, formats: Sequence[str] = ("png",), *, width: str | float = "full",
                 overwrite: bool = False) -> list[Path]:
    """Draw every figure that ``result`` has the groups for, and write it to ``folder``.

    The figures are fit, inputs, forces, deterministics, states, fields, trace (not of sampler "map", which has no
    chains), pairs, residuals and accuracy. A forecast that was made after the fit has its own: forecast,
    forecast-inputs and so on. What does not fit on one page goes to numbered ones, such as ``trace-1.png`` and
    ``trace-2.png``, five at most.
    Every file is written under a temporary name and renamed.

    Args:
        result: an ArviZ object.
        folder: made where it does not exist.
        formats: endings that matplotlib can write: png, pdf, svg, eps...
        width: "column" (3.4 in), "full" (7 in), or inches.
        overwrite: replace files that exist.

    Returns:
        The paths written, in the order of the figures.

    Raises:
        ValueError: a format is unknown.
        FileExistsError: a file exists and ``overwrite`` is False; nothing is drawn then.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> import xarray as xr
        >>> from lfm_ppl.results.arviz_data import build
        >>> draws = np.random.default_rng(0).normal(size=(4, 100))
        >>> result = build({"posterior": xr.Dataset({"decay": (("chain", "draw"), draws)})})
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     [path.name for path in save_figures(result, folder, ("png", "pdf"))]
        ['trace.png', 'trace.pdf', 'pairs.png', 'pairs.pdf']
    """
    formats = [formats] if isinstance(formats, str) else list(formats)
    formats = [ending.lower().removeprefix(".") for ending in formats]
    supported = FigureCanvasBase.get_supported_filetypes()
    for ending in formats:
        if ending not in supported:
            raise ValueError(f"unknown figure format {ending!r}; known: {', '.join(supported)}.")
    view = ResultView.of(result)
    pages = list(pages_of(view, width))
    paths = [Path(folder) / f"{name}.{ending}" for name, _, _ in pages for ending in formats]
    for path in paths:
        refuse_existing(path, overwrite)
    for name, draw, names in pages:
        figure = draw(view, names, width=width)
        figure.set_layout_engine("none")  # laid out already; each format would do it again
        for ending in formats:
            with atomic_write(Path(folder) / f"{name}.{ending}", overwrite) as temporary:
                figure.savefig(temporary, format=ending)
    return paths


def pages_of(result: Any, width: str | float) -> Iterator[tuple[str, Draw, Any]]:
    """Yield file name, function and the names to draw, for each page of each figure."""
    view = ResultView.of(result)
    view.refuse_several_sites()
    later, series = forecasts.is_made_later(view), view.series_labels
    for prefix in ("", "forecast-") if later else ("",):
        for kind, draw in _OVER_TIME.items():
            names = (list(view.inputs) if kind == "inputs" else
                     view.trajectory_names("output" if kind == "fit" else kind.removesuffix("s")))
            if kind == "fit" and "data" not in view.groups:
                continue
            title = f"{prefix}{kind}".replace("forecast-fit", "forecast")
            draw = draw if prefix or not later else _of_the_fit(draw)
            yield from _pages(title, draw, names, panels.MAX_PANELS, series if kind != "inputs" else [])
    for name in (name.removeprefix(FIELD) for name in view.groups if name.startswith(FIELD)):
        yield f"field-{name}", fields.plot_field, name
    if "posterior" in view.groups:
        labels = sampled(view.posterior)
        if not view.is_about_mode:  # independent draws have no chains to look at
            yield from _numbered("trace", chains.plot_trace, labels, chains.MAX_ROWS)
        if labels:
            # Pages would miss most pairs; the figure itself says how to choose others.
            yield "pairs", pairs.plot_pairs, None
    if "one_step_ahead" in view.groups:
        residual = view.groups["one_step_ahead"]["residual"]
        # An observation family may not know the probabilities that residuals are made of.
        names = [str(name) for name in residual["output"].values if residual.sel(output=name).notnull().any()]
        yield from _pages("residuals", residuals.plot_residuals, names, residuals.MAX_OUTPUTS, series)
    if "accuracy" in view.groups:
        yield "accuracy", accuracy.plot_accuracy, None


def _of_the_fit(draw: Draw) -> Draw:
    """Return the function of a figure without the forecast, which has figures of its own."""

    @functools.wraps(draw)
    def wrapper(view: ResultView, *args: Any, **kwargs: Any) -> Figure:
        return draw(forecasts.without_forecast(view), *args, **kwargs)

    return wrapper


def _pages(title: str, draw: Draw, names: list[str], size: int,
           series: Sequence[Any]) -> Iterator[tuple[str, Draw, list[Any]]]:
    """Yield the pages of a figure: ``size`` names on each, or these names of as many series as have room."""
    if not series or not names:
        yield from _numbered(title, draw, names, size)
        return

    @functools.wraps(draw)
    def draw_series(view: ResultView, page: Sequence[Any], **options: Any) -> Figure:
        return draw(view, names[:size], series=page, **options)

    yield from _numbered(title, draw_series, series, panels.MAX_PANELS // min(size, len(names)))


def _numbered(title: str, draw: Draw, names: Sequence[Any], size: int) -> Iterator[tuple[str, Draw, list[Any]]]:
    pages = [list(names[start:start + size]) for start in range(0, len(names), size)]
    if len(pages) > MAX_PAGES:
        warnings.warn(f"{title}: drawing the first {MAX_PAGES * size} of {len(names)}; call {draw.__name__} with names "
                      "for the others.", stacklevel=4)
    for number, page in enumerate(pages[:MAX_PAGES], start=1):
        yield (f"{title}-{number}" if len(pages) > 1 else title), draw, page
