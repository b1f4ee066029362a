"""``lfm-ppl forecast``: new observations, with their noise, from a saved result.

1. Rebuild the model and the data from the stored result.
2. Take the times of --until, --at or a file of held-out data, and its known inputs.
3. Forecast (`lfm_ppl.forecast`), and score held-out data (`lfm_ppl.score`).
4. Write the predictions into the result, a table and figures.
"""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import lfm_ppl
from lfm_ppl import plots
from lfm_ppl.cli import choices, folders, pages, session
from lfm_ppl.cli.data_file import output_columns
from lfm_ppl.cli.fit_arguments import TIME_UNIT
from lfm_ppl.cli.options import ForecastOptions, Times
from lfm_ppl.cli.requested_times import requested_times
from lfm_ppl.cli.stored_fit import StoredFit, rebuild_fit
from lfm_ppl.io import data
from lfm_ppl.io.data_set import Data, on_clock_of_fit
from lfm_ppl.io.dosing import ROLES
from lfm_ppl.io.input_table import continued_inputs
from lfm_ppl.report import html_report
from lfm_ppl.results import arviz_data, inputs, tables
from lfm_ppl.results.predictions import GROUP, HELD_OUT, MEAN, held_out_data, summary
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.results.series import series_view
from lfm_ppl.storage import files
from lfm_ppl.utils import atomic_files, calendar_time, checks

TABLE = "forecast.csv"
FIGURE = "forecast.png"
MORE_FIGURES = {"inputs": "forecast-inputs.png", "forces": "forecast-forces.png",
                "deterministics": "forecast-deterministics.png", "states": "forecast-states.png"}
"""Figures of quantities that the result has."""

SCORES = "scores.csv"


def run(result: str, options: ForecastOptions, line: Sequence[str]) -> int:
    """Write the forecast into the result, as a table and as a figure, with scores for held-out data."""
    if options.held_out is None and options.times == Times():
        raise ValueError("no times to forecast; give --until TIME, --at T1,T2,... or --held-out FILE.")
    options.columns.refuse_without("--held-out", options.held_out, time_unit=options.time_unit)
    path = files.locate(result)
    posterior = arviz_data.load(path)
    with contextlib.ExitStack() as stack:
        folder = path.parent
        if options.out:
            folder = stack.enter_context(folders.folder("forecast", options.out, options.overwrite))
        else:
            for name in (TABLE, FIGURE, *MORE_FIGURES.values(), *([SCORES] if options.held_out else [])):
                atomic_files.refuse_existing(folder / name, options.overwrite)
            html_report.refuse_foreign(folder / html_report.NAME, options.overwrite)
            if not options.overwrite and GROUP in ResultView.of(posterior).groups:
                raise FileExistsError(f"{path} already holds predictions. Write to another folder with --out, or "
                                      "replace them with --overwrite.")
            folders.check_writable(folder)
        session.start(1, not options.no_cache)
        task = rebuild_fit(posterior, options.model, path)
        held_out = None if options.held_out is None else _held_out_data(options.held_out, options, task)
        forecast, scores = _forecast(options, task, held_out)
        group = ResultView.of(forecast).group(GROUP).assign_attrs(command_line=pages.command_line(line))
        forecast = arviz_data.add_group(forecast, GROUP, group)
        return _write(forecast, scores, task, path, folder, options)


def _forecast(options: ForecastOptions, task: StoredFit, held_out: Data | None) -> tuple[Any, pd.DataFrame | None]:
    """Return the forecast with the held-out data, and their scores; None without any."""
    times = requested_times(task.observed, options.times)
    keywords: dict[str, Any] = {"inputs": {}, "model_kwargs": task.keywords}
    if held_out is not None:
        times = np.union1d(times, held_out.times)
        keywords["inputs"] = held_out.inputs
    forecast = lfm_ppl.forecast(task.view, task.model, times, draws=options.draws, seed=options.seed,
                                progress=not options.quiet, **keywords)
    if held_out is None or not np.isfinite(held_out.y).any():
        return forecast, None
    # The scores of an observation family need the model.
    view = ResultView.of(forecast)
    is_gaussian = MEAN in view.group(GROUP)
    scores = lfm_ppl.score(view, held_out, **({} if is_gaussian else {"numpyro_model": task.model, **keywords}))
    group = held_out_data(held_out.times, held_out.y, view.group("data"))
    return arviz_data.add_group(forecast, HELD_OUT, group), scores


def _held_out_data(path: str, options: ForecastOptions, task: StoredFit) -> Data:
    """Return the data of a file, on the clock of the fitted data and under the names of the result."""
    observed = task.observed
    if observed.series:
        raise ValueError("--held-out is for results of one series; forecast one of the panel, which "
                         "lfm.save(lfm.select_series(result, LABEL), FOLDER) writes, or score the panel in Python, "
                         "lfm.score(forecast, y).")
    # Only the model file states that blank cells are zero.
    interpolations = {name: "zero" if task.file.inputs.get(name) == "zero" else table.interpolation
                      for name, table in observed.inputs.items()}
    for option in ("inputs", "events"):
        if getattr(options.columns, option) is not None and not interpolations:
            raise ValueError(f"--{option} names columns of known inputs, and the result has no known inputs; leave it "
                             "out.")
    model = dataclasses.replace(task.file, outputs=observed.outputs, inputs=interpolations)
    columns = choices.inputs(options.columns, model) if interpolations else {}
    for name, (_, way) in columns.items():
        if name not in interpolations and way not in ROLES:
            raise ValueError(checks.unknown("known input of the result", name, interpolations))
    unit = observed.units.get("time", "")
    unit_of_fitted_file = task.view.attrs.get(TIME_UNIT)
    read = data.read_csv(path, output_columns(options.columns, model), options.columns.time_column,
                         dict(columns.values()), options.time_unit, observed=not columns,
                         default_unit=unit_of_fitted_file or (unit if observed.origin is not None else None))
    read = on_clock_of_fit(dataclasses.replace(read, outputs=observed.outputs, inputs={
        name: read.inputs[column] for name, (column, _) in columns.items() if column in read.inputs}),
        observed.origin, unit, path)
    if repeated_rows := int(np.isin(read.times, observed.times).sum()):
        print(f"note     {repeated_rows} of {len(read.times)} rows of {path} are at times of the fitted data: if they "
              "are the same data, their scores are not scores of a forecast")
    prepared = task.file.prepare(dataclasses.replace(read, inputs=continued_inputs(observed.inputs, read.inputs)))
    if not np.array_equal(prepared.y, read.y, equal_nan=True):
        raise ValueError(f"{task.file.path} changes the numbers of a data file in `prepare`, so that held-out numbers "
                         "may not be comparable with the fitted ones. Score them in Python, on the model's scale: "
                         "lfm.score(forecast, held_out).")
    return read


def _write(forecast: Any, scores: pd.DataFrame | None, task: StoredFit, path: Path, folder: Path,
           options: ForecastOptions) -> int:
    """Write result, tables, figures and report; return 1 if a figure or the report fails."""
    view, updated = ResultView.of(forecast), forecast
    if not options.out:
        # Load the file again: another process may have added to it.
        updated = arviz_data.add_group(arviz_data.load(path), GROUP, view.group(GROUP))
        for name in (HELD_OUT, inputs.FORECAST):
            updated = arviz_data.remove_group(updated, name)
            if name in view.groups:
                updated = arviz_data.add_group(updated, name, view.groups[name])
    target = folder / files.POSTERIOR if options.out else path
    print(f"wrote    {arviz_data.save(updated, target, options.overwrite or not options.out)} (group {GROUP})")
    table, origin = _table(view), task.observed.origin
    if origin is not None:  # dates as in the data
        unit = task.observed.units["time"]
        table.index = pd.Index([calendar_time.clock(float(time), origin, unit, "T", 3) for time in table.index],
                               name="time")
    print(f"wrote    {tables.write_csv(table, folder / TABLE, options.overwrite, index_label='time')}")
    if scores is not None:
        print(f"\n{tables.text_table(scores, width=shutil.get_terminal_size().columns)}\n")
        print(f"wrote    {tables.write_csv(scores, folder / SCORES, options.overwrite, index_label='output')}")
    statuses = {name: pages.draw(plot, view, folder / name, options.overwrite) for name, plot in _figures(view)}
    more = {} if scores is None else {"Scores on the held-out data": scores}
    paths = [folder / name for name, status in statuses.items() if status == 0]
    return max(*statuses.values(), pages.update(updated, folder, paths, more))


def _table(view: ResultView) -> pd.DataFrame:
    """Return the summary of the predictions, with a column of labels where there are several series."""
    if view.series_dimension is None:
        return summary(view.group(GROUP))
    summaries = {label: summary(series_view(view, label).group(GROUP)) for label in view.series_labels}
    return pd.concat(summaries, names=[view.series_dimension]).reset_index(level=0)


def _figures(view: ResultView) -> Iterator[tuple[str, Callable]]:
    """Yield file name and function of each figure."""
    yield FIGURE, plots.plot_fit
    if view.inputs:
        yield MORE_FIGURES["inputs"], plots.plot_inputs
    for kind in ("force", "deterministic", "state"):
        if view.trajectory_names(kind):
            yield MORE_FIGURES[f"{kind}s"], getattr(plots, f"plot_{kind}s")
