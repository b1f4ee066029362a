"""The report of a result, ``report.html``: one page without network access or scripts.

1. Collect the values of each section from the groups and attributes of a result; a section without values is left out.
2. Draw the figures, or read files.
3. Fill in the template ``report.html.jinja``, and write the page atomically.
"""

from __future__ import annotations

import base64
import functools
import io
import json
import re
import shlex
import textwrap
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from jinja2 import Environment, StrictUndefined, Template
from markupsafe import Markup

from lfm_ppl.accuracy import report
from lfm_ppl.inference.long_steps import EXPONENTIAL
from lfm_ppl.inference.tuning import ANCHOR
from lfm_ppl.plots import saving
from lfm_ppl.results import arviz_data, predictions, tables
from lfm_ppl.results.inputs import ORIGIN
from lfm_ppl.results.residuals import misfit
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.results.scalars import unit_of
from lfm_ppl.results.series import TIMES, series_view, times_of
from lfm_ppl.storage.files import POSTERIOR
from lfm_ppl.utils import calendar_time
from lfm_ppl.utils.atomic_files import atomic_write, refuse_existing

NAME = "report.html"

_GENERATOR = '<meta name="generator" content="lfm_ppl">'

_LONG_TEXT = 50
"""Number of characters of a cell from which on it is broken into lines."""

_MOST_TIMES = 40
"""Number of times of a forecast that are listed; more are thinned evenly."""

_MOST_SERIES = 5
"""Number of series of a panel whose forecast is listed."""

_DIAGNOSTICS = ["mcse_mean", "ess_bulk", "ess_tail", "r_hat"]

_NOT_SETTINGS = ("model", "model_file", "description", "data", "note", "warnings", "partial", "settings", "run",
                 "map_converged", arviz_data.MODE, "command_line", "call", ORIGIN, "priors", "meanings", "assumptions",
                 "inference_library", arviz_data.FACTORS, arviz_data.WEIGHTS, arviz_data.DEGENERATE, ANCHOR,
                 EXPONENTIAL)
"""Attributes that stand in other sections, or that only programs read."""

_FILES = re.compile(r"(.*\.nc|(summary|accuracy|forecast|scores)\.csv"
                    r"|field-.+\.(png|pdf|svg)"
                    r"|(forecast-)?(fit|inputs|forces|deterministics|states|trace|pairs|residuals|accuracy|forecast)"
                    r"(-\d+)?\.(png|pdf|svg))")
"""Files of a result; other files in a folder are not linked."""


def save_report(result: Any, path: str | Path, overwrite: bool = False, *, figures: Sequence[str | Path] | None = None,
                more: Mapping[str, pd.DataFrame] | None = None) -> Path:
    """Write a result as one HTML page that needs nothing but itself: no network, no script, no other file.

    It begins with the warnings, the forces, the fit and the table of the parameters. The forecast and the verdict of
    the accuracy check, where the result has them, and further figures follow. Model, data, settings, commands and links
    to the files beside the page come last. It reads in light and dark, on a phone and on paper.

    Args:
        result: of `lfm_ppl.fit`, `lfm_ppl.to_arviz` or `lfm_ppl.forecast`, or read by `lfm_ppl.load`.
        path: the file to write, or a folder, in which it is ``report.html``.
        overwrite: replace a file that exists.
        figures: PNG files to show, as `lfm_ppl.plots.save_figures` wrote them; None: all that the result has
            the numbers for are drawn. A figure that cannot be drawn is named on the page.
        more: title -> table, shown after the forecast: scores, for instance.

    Returns:
        The path of the page.

    Raises:
        FileExistsError: the file exists and ``overwrite`` is False.
        ValueError: the result has no posterior.
        TypeError: ``result`` is no ArviZ object.

    Example:
        >>> import tempfile, lfm_ppl as lfm
        >>> draws = xr.Dataset({"decay": (("chain", "draw"), np.random.default_rng(0).normal(size=(4, 100)))})
        >>> result = arviz_data.build({"posterior": draws}, {"model": "gene"})
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     page = lfm.save_report(result, folder, figures=())
        ...     page.name, "<h1>gene</h1>" in page.read_text()
        ('report.html', True)
    """
    path = Path(path) / NAME if Path(path).is_dir() else Path(path)
    refuse_existing(path, overwrite)
    view = ResultView.of(result)
    view.refuse_several_sites()
    attrs = view.attrs
    table = tables.annotate(arviz_data.summary(view), view)
    pictures, failures = _draw_figures(view) if figures is None else (
        {Path(figure).stem: Path(figure).read_bytes() for figure in figures}, [])
    diagnostics = [name for name in _DIAGNOSTICS if name in table]
    description = str(attrs.get("description", "")).strip()
    return write_page(
        path, overwrite, str(attrs.get("model", "model")), description.partition("\n")[0], pictures,
        result={"partial": attrs.get("partial"), "messages": arviz_data.convergence_warnings(view, table),
                "misfit": misfit(view), "is_mode": view.is_about_mode, "table": _short(table, view),
                "is_weighted": "effective_draws" in attrs},
        forecast=_forecast(view, more or {}), accuracy=_accuracy(view, path.parent),
        failures=failures, convergence=table[diagnostics] if diagnostics and len(table) else None,
        model={"name": attrs.get("model"), "file": attrs.get("model_file"), "paragraphs": _paragraphs(description),
               "priors": _priors(view), "assumptions": view.decoded("assumptions")},
        data=_data(view) if "data" in view.groups else {},
        settings={name: text for name, value in attrs.items()
                  if name not in _NOT_SETTINGS and (text := _plain(value))} or None,
        repeat={"commands": _commands(view), "note": ""}, files=_files(path) or None)


def write_page(path: str | Path, overwrite: bool, title: str, lead: str, pictures: Mapping[str, bytes],
               **sections: Any) -> Path:
    """Write a page, atomically, and return its path.

    Args:
        path: the file.
        overwrite: replace a file that exists.
        title: of the page.
        lead: a line below it; empty for none.
        pictures: name -> PNG.
        **sections: anchor of a section of the template -> its values; None leaves the section out.

    Raises:
        FileExistsError: ``path`` exists and ``overwrite`` is False.
    """
    figures = [{"name": name, "kind": re.sub(r"-\d+$", "", name), "png": png} for name, png in pictures.items()]
    page = _template().render(title=title, lead=lead, figures=figures, sections={
        anchor: values for anchor, values in sections.items() if values is not None})
    with atomic_write(path, overwrite) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return Path(path)


def refuse_foreign(path: str | Path, overwrite: bool) -> None:
    """Raise FileExistsError for a file of another program that may not be replaced; a page of lfm_ppl may be."""
    path = Path(path)
    is_generated = path.is_file() and _GENERATOR in path.read_text(encoding="utf-8", errors="replace")[:500]
    refuse_existing(path, overwrite or is_generated)


@functools.cache
def _template() -> Template:
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    environment.filters |= {"format_cells": tables.format_cells, "column_kinds": _column_kinds,
                            "base64": lambda png: base64.b64encode(png).decode("ascii")}
    return environment.from_string(resources.files("lfm_ppl.report").joinpath("report.html.jinja").read_text("utf-8"))


def _column_kinds(frame: pd.DataFrame) -> list[tuple[str, str]]:
    """Return the name of each column with its HTML class: ``n`` of numbers, ``t`` of text in several lines."""
    return [(str(name), Markup(' class="n"') if pd.api.types.is_numeric_dtype(column) else
             Markup(' class="t"') if column.astype(str).str.len().max() > _LONG_TEXT else "")
            for name, column in frame.items()]


def _draw_figures(view: ResultView) -> tuple[dict[str, bytes], list[str]]:
    """Return the figures of a result, name -> PNG, and a message for each that could not be drawn."""
    pictures, failures = {}, []
    for name, draw, names in saving.pages_of(view, "full"):
        try:
            with io.BytesIO() as buffer:
                draw(view, names, width="full").savefig(buffer, format="png")
                pictures[name] = buffer.getvalue()
        except Exception as error:  # the page is worth having without it
            failures.append(f"The figure {name} could not be drawn: {error}")
    return pictures, failures


def _short(table: pd.DataFrame, view: ResultView) -> pd.DataFrame:
    """Return the table of the parameters without diagnostics; warnings on all of them stand above it."""
    if table.empty:
        return table
    messages = {label: arviz_data.convergence_warnings(view, table.loc[[label]]) for label in table.index}
    shared = set.intersection(*map(set, messages.values()))
    rows = ["; ".join(message.partition(": ")[0] for message in messages[label] if message not in shared)
            for label in table.index]
    table = table.drop(columns=[*_DIAGNOSTICS, "partial", "warnings"], errors="ignore")
    return table.assign(warnings=rows) if any(rows) else table


def _priors(view: ResultView) -> pd.DataFrame:
    """Return the prior of each parameter in words, and its meaning where the model file tells it."""
    table, meanings = pd.DataFrame({"prior": view.decoded("priors")}, dtype=object), view.decoded("meanings")
    return table.assign(meaning=[meanings.get(name, "") for name in table.index]) if any(meanings.values()) else table


def _paragraphs(text: str) -> list[tuple[bool, str]]:
    r"""Return the paragraphs of a docstring, and whether each is indented, such as an equation.

    Example:
        >>> _paragraphs("A spring\nand a mass.\n\n    dx/dt = v")
        [(False, 'A spring and a mass.'), (True, 'dx/dt = v')]
    """
    blocks = [block for block in re.split(r"\n(?:[ \t]*\n)+", text.strip("\n")) if block.strip()]
    return [(True, textwrap.dedent(block).rstrip()) if any(line[:1].isspace() for line in block.splitlines())
            else (False, " ".join(block.split())) for block in blocks]


def _data(view: ResultView) -> dict[str, Any]:
    dataset = view.group("data")
    name = next(str(label) for label in dataset.data_vars if label != TIMES)
    variable, origin = dataset[name], _origin(view)
    times = np.asarray(times_of(dataset).values, float)
    names = [str(output) for output in variable["output"].values] if "output" in variable.coords else [name]
    columns = np.asarray(variable.values, float).reshape(-1, len(names)).T
    facts = {"source": view.attrs.get("data"), "series": variable.sizes.get(view.series_dimension),
             "rows": variable.sizes["time"],
             "missing": f"{int(variable.isnull().sum())} of {variable.size} values", "times": _span(times, view),
             "time 0": calendar_time.clock(0.0, origin, view.time_unit) if origin else None,
             "note": view.attrs.get("note")}
    described = [_described(np.asarray(table.values, float), view.input_unit(label))
                 | {"interpolation": table.interpolation, "times": _span(np.asarray(table.times), view)}
                 for label, table in view.inputs.items()]
    return {"facts": {label: text for label, text in facts.items() if text is not None},
            "outputs": pd.DataFrame([_described(column, unit_of(variable, label))
                                     for label, column in zip(names, columns, strict=True)], names),
            "inputs": pd.DataFrame(described, list(view.inputs))}


def _described(values: np.ndarray, unit: str) -> dict[str, Any]:
    column = pd.Series(values.ravel())
    return {"unit": unit, "values": int(column.count()), "missing": int(column.isna().sum()), "min": column.min(),
            "mean": column.mean(), "max": column.max()}


def _span(times: np.ndarray, view: ResultView) -> str:
    """Return the first and the last time, as dates where the result knows them."""
    times, unit = times[np.isfinite(times)], view.time_unit
    if not times.size:
        return "none"
    text = f"{times.min():.10g} to {times.max():.10g}" + (f" {unit}" if unit else "")
    if origin := _origin(view):
        first, last = (calendar_time.clock(float(time), origin, unit) for time in (times.min(), times.max()))
        text += f" ({first} to {last})"
    return text


def _origin(view: ResultView) -> str:
    """Return the calendar time of t = 0; empty where it, or the unit that times count, is not known."""
    return view.time_origin if view.time_unit in calendar_time.SECONDS else ""


def _accuracy(view: ResultView, folder: Path) -> dict[str, Any]:
    if report.GROUP not in view.groups:
        return {"is_constrained": "constraints" in view.attrs}
    checked = report.AccuracyReport.of(view)
    verdict, remedies = checked.verdict, list(checked.verdict.remedies)
    path = shlex.quote(str(folder)) if (folder / POSTERIOR).is_file() else "RESULT"
    if len(remedies) < 2:
        remedies = [verdict.command] if verdict.command else []
    return {"verdict": verdict, "remedies": [remedy.replace("RESULT", path) for remedy in remedies],
            "facts": dict(checked.numbers()), "table": checked.table[list(report.SHOWN)]}


def _forecast(view: ResultView, more: Mapping[str, pd.DataFrame]) -> dict[str, Any] | None:
    """Return tables of the predictions, after the data where any of them are."""
    if predictions.GROUP not in view.groups:
        return {"tables": more, "more": more, "label": "", "count": 0, "most_series": 0, "total": 0} if more else None
    labels = view.series_labels
    members = [series_view(view, label) for label in labels[:_MOST_SERIES]]
    groups = ({member.attrs["selected"]: member.group(predictions.GROUP) for member in members}
              or {"": view.group(predictions.GROUP)})
    dataset, unit, origin = next(iter(groups.values())), view.time_unit, _origin(view)
    later = np.flatnonzero(dataset["time"].values > dataset.attrs.get("last_observation", np.inf))
    index = later if later.size else np.arange(dataset.sizes["time"])
    thinned = index[np.unique(np.linspace(0, index.size - 1, _MOST_TIMES).round().astype(int))]

    def table(series: xr.Dataset) -> pd.DataFrame:
        frame = predictions.summary(series.isel(time=thinned))
        return frame.set_axis([calendar_time.clock(float(time), origin, unit) if origin else f"{time:.10g}"
                               for time in frame.index])

    return {"tables": {title: table(series) for title, series in groups.items()} | dict(more), "more": more,
            "label": f"time ({unit})" if unit and not origin else "time", "is_later": later.size > 0,
            "shown": thinned.size, "total": index.size, "count": len(labels), "most_series": _MOST_SERIES}


def _plain(value: Any) -> str:
    """Return an attribute as text: JSON objects by their entries, nothing for empty values."""
    if isinstance(value, str) and value.startswith(("{", "[")):
        try:
            value = json.loads(value)
        except json.JSONDecodeError:
            return value
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_plain(item)}" for name, item in value.items())
    return "" if value is None or isinstance(value, (list, tuple)) and not value else tables.format_number(value, 4)


def _commands(view: ResultView) -> list[str]:
    """Return the commands or calls that give the same numbers, in their order."""
    attrs = view.attrs
    call = [str(attrs["call"])] if "call" in attrs else []
    if call and "effective_draws" in attrs:
        call += ["lfm.check_accuracy(result, model)", "result = lfm.correct_posterior(result, model)"]
    groups = [view.groups[name] for name in (report.GROUP, predictions.GROUP) if name in view.groups]
    first = [str(attrs["command_line"])] if "command_line" in attrs else call
    return [*first, *(str(group.attrs["command_line"]) for group in groups if group.attrs.get("command_line"))]


def _files(path: Path) -> list[str]:
    if not path.parent.is_dir():
        return []
    names = sorted(entry.name for entry in path.parent.iterdir() if entry.is_file() and _FILES.fullmatch(entry.name)
                   and entry.name != path.name and not entry.name.startswith("."))
    corrected = f"corrected/{NAME}"  # where `lfm-ppl check --correct` writes
    return [*names, *([corrected] if (path.parent / corrected).is_file() else [])]
