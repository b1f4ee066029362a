"""The report of a result, ``report.html``: one page without network access or scripts.

1. Collect the sections from the groups and attributes of a result: model, data, fit, table, figures, settings.
2. Draw the figures, or use the files that exist.
3. Render the page (`lfm_ppl.results.web_page`), and write it atomically.
"""

from __future__ import annotations

import io
import json
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from lfm_ppl.results import arviz_data, predictions, report, tables, web_page
from lfm_ppl.results.files import POSTERIOR
from lfm_ppl.results.inputs import ORIGIN, input_unit, inputs_of, time_origin, time_unit
from lfm_ppl.results.plots import saving, style
from lfm_ppl.results.residuals import misfit
from lfm_ppl.results.scalars import unit_of
from lfm_ppl.results.web_page import Section
from lfm_ppl.utils import calendar_time

NAME = "report.html"

COMMAND = "command_line"
"""Attribute of a result, and of its groups accuracy and predictions: the command that made it."""

CALL, DESCRIPTION = "call", "description"
"""Attributes of a result: the call in Python that made it, and the docstring of the model."""

PRIORS, MEANINGS, ASSUMPTIONS = "priors", "meanings", "assumptions"
"""Attributes of a result, as JSON: name -> prior in words; what the model file says of a parameter; and what the model
says of its observations, forces and initial state."""

_MOST_TIMES = 40
"""Times of a forecast that are listed; more are thinned evenly."""

_MOST_SERIES = 5
"""Series of a panel that a forecast is listed of."""

_CAPTIONS = {
    "fit": "Data and fit: posterior mean, 95% of the noise-free output and of new data", "inputs": "Known inputs",
    "forces": "Latent forces",
    "deterministics": "What follows from states and forces", "states": "States", "trace": "Chains",
    "pairs": "Pairs of parameters", "residuals": "Residuals one step ahead",
    "accuracy": "What the exact likelihood would change", "forecast": "Forecast with its noise",
    "forecast-inputs": "Known inputs of the forecast", "forecast-forces": "Forecast of the latent forces",
    "forecast-deterministics": "Forecast of what follows from states and forces",
    "forecast-states": "Forecast of the states",
}

_SETTINGS = {
    "sampler": "sampler", "chains": "chains", "warmup": "warm-up steps", "samples": "draws a chain",
    "thin": "steps a draw", "seed": "seed", "rule": "rule", "steps": "integration steps", "max_step": "longest step",
    "tolerance": "tolerance of a step (sd)", "iterations": "iterations", "likelihood": "likelihood",
    "sites": "observation family",
    "fixed": "fixed", "options": "options",
    "constraints": "constraints",
    "particles": "particles", "log_likelihood_sd": "sd of the log likelihood", "delayed": "delayed acceptance",
    "effective_draws": "effective draws", "map_message": "optimiser",
    "map_log_density": "log density at the mode", "log_evidence": "log evidence (Laplace)",
    "wall_time_s": "time (s)", "created_at": "made at",
}
_ELSEWHERE = ("model", "model_file", DESCRIPTION, "data", "note", "versions", "warnings", "partial", "settings", "run",
              "map_converged", arviz_data.MODE, COMMAND, CALL, ORIGIN, PRIORS, MEANINGS, ASSUMPTIONS,
              "inference_library", "site_failures", "constraint_weights", arviz_data.DEGENERATE)
"""Attributes that stand in other sections, or that nobody needs to read."""

_FILES = re.compile(r"(.*\.nc|(summary|accuracy|forecast|scores)\.csv"
                    r"|(forecast-)?(fit|inputs|forces|deterministics|states|trace|pairs|residuals|accuracy|forecast)"
                    r"(-\d+)?\.(png|pdf|svg))")
"""Files of a result; what else lies in a folder is nobody's business."""


def save_report(result: Any, path: str | Path, overwrite: bool = False, *, figures: Sequence[str | Path] | None = None,
                more: Mapping[str, pd.DataFrame] | None = None) -> Path:
    """Write a result as one HTML page that needs nothing but itself: no network, no script, no other file.

    It holds the model with its docstring, settings and versions, the data, the summary with its warnings, the verdict
    of the accuracy check and the forecast where the result has them, the figures, how to do it again, and links to the
    files of the result that lie beside the page. All text is escaped. It reads in light and dark, on a phone and on
    paper.

    Args:
        result: of `lfm_ppl.fit`, `lfm_ppl.to_arviz` or `lfm_ppl.forecast`, or read by `lfm_ppl.load`.
        path: the file to write, or a folder, in which it is ``report.html``.
        overwrite: replace a file that exists.
        figures: PNG files to show, as `lfm_ppl.results.plots.save_figures` wrote them; None: all that the result has
            the numbers for are drawn. One that cannot be drawn is named on the page, which is written all the same.
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
    web_page.refuse_existing(path, overwrite)
    attrs = arviz_data.attributes(result)
    description = str(attrs.get(DESCRIPTION, "")).strip()
    sections = [
        Section("result", "Result", _state(result, attrs)),
        Section("model", "Model", _model(attrs, description)),
        Section("data", "Data", _data(result, attrs)),
        Section("summary", "Parameters", _summary(result)),
        Section("accuracy", "Accuracy", _accuracy(result, path.parent)),
        Section("forecast", "Forecast", _forecast(result, more or {})),
        Section("figures", "Figures", _draw_figures(result) if figures is None else _read(figures)),
        Section("settings", "Settings", _settings(attrs)),
        Section("repeat", "How to repeat it", _repeat(result, attrs)),
        Section("files", "Files", _files(path)),
    ]
    lead = description.partition("\n")[0]
    return web_page.write(web_page.render(str(attrs.get("model", "model")), lead, sections), path, overwrite)


def _state(result: Any, attrs: Mapping[str, Any]) -> str:
    """Say in a glance what there is: whether it is whole, and what is wrong with it."""
    html = ""
    if (partial := attrs.get("partial")) is not None:
        html += web_page.warnings([f"This result is partial: {partial}."])
    messages = arviz_data.convergence_warnings(result)
    html += web_page.warnings([*messages, *misfit(result)])
    if not messages:
        html += web_page.paragraph("The draws are of a Laplace approximation at the posterior mode, not of chains."
                                    if arviz_data.of_mode(result) else
                                    "The draws are weighted ones; how many they are worth stands in the table."
                                    if "effective_draws" in attrs else
                                    "The chains agree, and are long enough: the draws represent the posterior of "
                                    "this model. Whether the model fits the data, the residuals tell.")
    if arviz_data.has_group(result, report.GROUP):
        html += web_page.paragraph(f"Accuracy: {report.AccuracyReport.of(result).verdict.word}.")
    return html


def _model(attrs: Mapping[str, Any], description: str) -> str:
    file = str(attrs.get("model_file", ""))
    name = str(attrs.get("model", "model"))
    html = web_page.facts([("name", name), *([("file", file)] if file not in ("", name) else [])])
    html += (web_page.prose(description) if description else web_page.paragraph(
        "The model has no docstring; what stands in one would be shown here.", "note"))
    if assumed := json.loads(str(attrs.get(ASSUMPTIONS, "{}"))):
        html += web_page.heading("Assumptions") + web_page.facts(list(assumed.items())) + web_page.paragraph(
            "Numbers that depend on parameters belong to one set of values typical of the prior, not of the "
            "posterior.", "note")
    priors = json.loads(str(attrs.get(PRIORS, "{}")))
    if not priors:
        return html
    meanings = json.loads(str(attrs.get(MEANINGS, "{}")))
    table = pd.DataFrame({"prior": priors} | ({"meaning": {name: meanings.get(name, "") for name in priors}}
                                               if any(meanings.get(name) for name in priors) else {}))
    html += web_page.heading("Priors") + web_page.paragraph(
        "Where a prior depends on another parameter, its numbers are those at one value of it.", "note")
    return html + tables.html_table(table, index_label="parameter")


def _data(result: Any, attrs: Mapping[str, Any]) -> str:
    if not arviz_data.has_group(result, "observed_data"):
        return web_page.paragraph("The result holds no data.", "note")
    dataset = arviz_data.group(result, "observed_data")
    name = next(str(label) for label in dataset.data_vars if label != "times")
    variable = dataset[name]
    times = np.asarray((dataset["times"] if "times" in dataset else dataset["time"]).values, float)
    lines = [("source", str(attrs["data"]))] if "data" in attrs else []
    if "series" in variable.dims:
        lines.append(("series", str(variable.sizes["series"])))
    missing = int(variable.isnull().sum())
    lines += [("rows", str(variable.sizes["time"])), ("missing", f"{missing} of {variable.size} values"),
              ("times", _span(times, result))]
    if origin := _origin(result):
        lines.append(("time 0", calendar_time.clock(0.0, origin, time_unit(result))))
    if attrs.get("note"):
        lines.append(("note", str(attrs["note"])))
    html = web_page.facts(lines)
    names = [str(output) for output in variable["output"].values] if "output" in variable.coords else [name]
    columns = np.asarray(variable.values, float).reshape(-1, len(names))
    html += tables.html_table(pd.DataFrame([_described(column, unit_of(variable, output)) for output, column in zip(
        names, columns.T, strict=True)], names), index_label="output")
    inputs = inputs_of(result)
    if inputs:
        rows = [{"interpolation": table.interpolation, "times": _span(np.asarray(table.times), result),
                 **_described(np.asarray(table.values, float), input_unit(result, name))}
                for name, table in inputs.items()]
        html += web_page.heading("Known inputs") + tables.html_table(
            pd.DataFrame(rows, list(inputs)), index_label="input")
    return html


def _described(values: np.ndarray, unit: str) -> dict[str, Any]:
    seen = values[np.isfinite(values)]
    low, mean, high = (seen.min(), seen.mean(), seen.max()) if seen.size else (np.nan,) * 3
    return {"unit": unit, "values": int(seen.size), "missing": int(np.isnan(values).sum()), "min": float(low),
            "mean": float(mean), "max": float(high)}


def _span(times: np.ndarray, result: Any) -> str:
    """Return the first and the last time, as dates where the result knows them."""
    times, unit = times[np.isfinite(times)], time_unit(result)
    if not times.size:
        return "none"
    text = f"{times.min():.10g} to {times.max():.10g}" + (f" {unit}" if unit else "")
    if origin := _origin(result):
        first, last = (calendar_time.clock(float(time), origin, unit) for time in (times.min(), times.max()))
        text += f" ({first} to {last})"
    return text


def _origin(result: Any) -> str:
    """Return the calendar time of t = 0; empty where it, or the unit that times count, is not known."""
    return time_origin(result) if time_unit(result) in calendar_time.SECONDS else ""


def _summary(result: Any) -> str:
    table = arviz_data.summary(result)
    if table.empty:
        return web_page.paragraph("The model has no parameters that are sampled.", "note")
    kind = tables.annotated(table, result)["kind"]
    messages = {label: arviz_data.convergence_warnings(result, table.loc[[label]]) for label in table.index}
    # What concerns all of them, and what to do about it, stands at the top of the page.
    shared = set.intersection(*map(set, messages.values()))
    row_messages = ["; ".join(message.partition(": ")[0] for message in messages[label] if message not in shared)
                    for label in table.index]
    columns = {"warnings": row_messages} if any(row_messages) else {}
    table = table.drop(columns="partial", errors="ignore").assign(kind=kind, **columns)
    return tables.html_table(table, index_label="parameter")


def _accuracy(result: Any, folder: Path) -> str:
    if "constraints" in arviz_data.attributes(result):
        return web_page.paragraph("What the approximation of the likelihood does to this posterior cannot be measured: "
                                  "no reference knows constraints.", "note")
    if not arviz_data.has_group(result, report.GROUP):
        return web_page.paragraph("What the approximation of the likelihood does to this posterior has not been "
                                  "measured yet; lfm-ppl check, or lfm.check_accuracy, measures it.", "note")
    checked = report.AccuracyReport.of(result)
    word, reason, command, remedies = checked.verdict
    lines = [("verdict", f"{word}: {reason}")]
    path = shlex.quote(str(folder)) if (folder / POSTERIOR).is_file() else "RESULT"
    if len(remedies) > 1:
        lines += [(f"remedy {number}", remedy.replace("RESULT", path)) for number, remedy in enumerate(remedies, 1)]
    elif command:
        lines.append(("next", command.replace("RESULT", path)))
    return web_page.facts([*lines, *checked.numbers()]) + tables.html_table(
        checked.table[list(report.SHOWN)], index_label="parameter")


def _forecast(result: Any, more: Mapping[str, pd.DataFrame]) -> str:
    html = ""
    if arviz_data.has_group(result, predictions.GROUP):
        dataset = arviz_data.group(result, predictions.GROUP)
        if "series" in dataset.dims:
            for index in range(min(dataset.sizes["series"], _MOST_SERIES)):
                series = dataset.isel(series=index)
                label = series["series"].item() if "series" in series.coords else index
                html += web_page.heading(f"Series {label}") + _forecast_of(series, result)
            if dataset.sizes["series"] > _MOST_SERIES:
                html += web_page.paragraph(f"The first {_MOST_SERIES} of {dataset.sizes['series']} series.", "note")
        else:
            html = _forecast_of(dataset, result)
    return html + "".join(web_page.heading(title) + tables.html_table(table) for title, table in more.items())


def _forecast_of(dataset: xr.Dataset, result: Any) -> str:
    """Return the table of what is predicted, after the data where any of it is."""
    times = np.asarray(dataset["time"].values, float)
    later = np.flatnonzero(times > dataset.attrs.get("last_observation", np.inf))
    index = later if later.size else np.arange(times.size)
    thinned = index[np.unique(np.linspace(0, index.size - 1, _MOST_TIMES).round().astype(int))]
    table = predictions.summary(dataset.isel(time=thinned))
    unit, origin = time_unit(result), _origin(result)
    labels = [calendar_time.clock(float(time), origin, unit) if origin else f"{time:.10g}" for time in table.index]
    html = tables.html_table(table.set_axis(labels), index_label=f"time ({unit})" if unit and not origin else "time")
    period = "after the last observation" if later.size else "of the prediction"
    shown_times = f"{thinned.size} of {index.size} times" if thinned.size < index.size else "All times"
    return html + web_page.paragraph(
        f"{shown_times} {period}. Mean, sd and quantiles (in percent) are of new data, with their noise, and then of "
        f"the {predictions.NOISE_FREE}.", "note")


def _draw_figures(result: Any) -> str:
    figures, failed = [], []
    for name, draw, names in saving.pages_of(result, "full"):
        try:
            figure = draw(result, names, width="full")
            with style.in_style(), io.BytesIO() as buffer:
                figure.savefig(buffer, format="png")
                figures.append(web_page.picture(buffer.getvalue(), _caption(name)))
        except Exception as error:  # the page is worth having without it
            failed.append(f"The figure {name} could not be drawn: {error}")
    return web_page.warnings(failed) + "\n".join(figures)


def _read(figures: Sequence[str | Path]) -> str:
    if not figures:
        return web_page.paragraph("No figures were drawn; `lfm-ppl plot` draws them from the result.", "note")
    return "\n".join(web_page.picture(Path(path).read_bytes(), _caption(Path(path).stem)) for path in figures)


def _caption(name: str) -> str:
    if name in _CAPTIONS:
        return _CAPTIONS[name]
    kind, _, page = name.partition("-")
    return _CAPTIONS.get(kind, kind) + (f", page {page}" if page else "")


def _settings(attrs: Mapping[str, Any]) -> str:
    lines = [(label, text) for name, label in _SETTINGS.items() if (text := _plain(attrs.get(name)))]
    lines += [(name, text) for name, value in attrs.items()
              if name not in _SETTINGS and name not in _ELSEWHERE and (text := _plain(value))]
    versions = _plain(attrs.get("versions"))
    return web_page.facts([*lines, *([("versions", versions)] if versions else [])])


def _plain(value: Any) -> str:
    """Return an attribute as text: JSON objects by their entries, nothing for what is empty."""
    if isinstance(value, str) and value.startswith(("{", "[")):
        try:
            value = json.loads(value)
        except json.JSONDecodeError:
            return value
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_plain(item)}" for name, item in value.items())
    if value is None or isinstance(value, (list, tuple)) and not value:
        return ""
    return tables.format_number(value, 4)


def _repeat(result: Any, attrs: Mapping[str, Any]) -> str:
    """Return what to type for the same numbers, in the order in which it was typed."""
    commands = [str(attrs[COMMAND])] if COMMAND in attrs else []
    groups = [name for name in (report.GROUP, predictions.GROUP) if arviz_data.has_group(result, name)]
    group_commands = [arviz_data.group(result, name).attrs.get(COMMAND) for name in groups]
    commands += [str(command) for command in group_commands if command]
    html = web_page.preformatted("\n".join(commands)) if commands else ""
    if CALL in attrs and COMMAND not in attrs:
        lines = [str(attrs[CALL])]
        if "effective_draws" in attrs:
            lines += ["lfm.check_accuracy(result, model)", "result = lfm.correct_posterior(result, model)"]
        html = web_page.preformatted("\n".join(lines)) + html
    if not html:
        return web_page.paragraph("The result does not say how it was made.", "note")
    return html + web_page.paragraph("The seed makes the draws the same in the same environment: data, machine and "
                                      "versions (see Settings). A folder with a result is not replaced; name another "
                                      "one, or add --overwrite.", "note")


def _files(path: Path) -> str:
    if not path.parent.is_dir():
        return ""
    names = sorted(entry.name for entry in path.parent.iterdir() if entry.is_file() and _FILES.fullmatch(entry.name)
                   and entry.name != path.name and not entry.name.startswith("."))
    corrected = f"corrected/{NAME}"  # where `lfm-ppl check --correct` writes
    return web_page.file_list([*names, *([corrected] if (path.parent / corrected).is_file() else [])])
