"""``lfm-ppl forecast``: new observations, with their noise, from a saved result.

1. Rebuild the model and the data from the stored result.
2. Take the times of --until, --at or a file of held-out data, and its known inputs.
3. Forecast (`lfm_ppl.forecast`), and score held-out data (`lfm_ppl.score`).
4. Write the predictions into the result, a table and figures.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lfm_ppl.cli import choices, page, results, session
from lfm_ppl.cli.requested_times import requested_times
from lfm_ppl.cli.stored_fit import StoredFit, rebuild_fit
from lfm_ppl.io import data
from lfm_ppl.io.data_set import Data, InputTable, on_clock_of
from lfm_ppl.utils import atomic_files, calendar_time, checks

TABLE = "forecast.csv"
FIGURE = "forecast.png"
MORE_FIGURES = {"inputs": "forecast-inputs.png", "forces": "forecast-forces.png",
                "deterministics": "forecast-deterministics.png", "states": "forecast-states.png"}
"""Figures of quantities that the result has."""

SCORES = "scores.csv"

_GRID = 121
"""Number of times of a forecast with --until: enough for smooth bands."""


def run(arguments: argparse.Namespace) -> int:
    """Write the forecast into the result, as a table and as a figure, with scores for held-out data."""
    from lfm_ppl.results import arviz_data, files
    from lfm_ppl.results.predictions import GROUP

    if arguments.held_out is None and arguments.until is None and arguments.at is None:
        raise ValueError("no times to forecast; give --until TIME, --at T1,T2,... or --held-out FILE.")
    for flag in ("outputs", "inputs", "time_column"):
        if getattr(arguments, flag) is not None and arguments.held_out is None:
            raise ValueError(f"--{flag.replace('_', '-')} is about a data file; give one with --held-out.")
    path = files.locate(arguments.result)
    if not arguments.out:
        for name in (TABLE, FIGURE, *MORE_FIGURES.values(), *([SCORES] if arguments.held_out else [])):
            atomic_files.refuse_existing(path.parent / name, arguments.overwrite)
        page.refuse_foreign(path.parent, arguments.overwrite)
    posterior = arviz_data.load(path)
    if not arguments.out and not arguments.overwrite and arviz_data.has_group(posterior, GROUP):
        raise FileExistsError(f"{path} already holds predictions. Write to another folder with --out, or "
                              "replace them with --overwrite.")
    with contextlib.ExitStack() as stack:
        folder = path.parent
        if not arguments.out:
            results.writable(folder)
        else:
            folder = stack.enter_context(results.folder("forecast", arguments.out, arguments.overwrite))
        session.start(1, not arguments.no_cache)
        task = rebuild_fit(posterior, arguments.model, path)
        held_out = None if arguments.held_out is None else _held_out(arguments, task)
        forecast, score = _forecast(arguments, task, held_out)
        return _write(forecast, score, held_out, task, path, folder, arguments)


def _forecast(arguments: argparse.Namespace, task: StoredFit, held_out: Data | None) -> tuple:
    """Return the forecast and the function that scores it."""
    import lfm_ppl
    from lfm_ppl.model.inputs import Input
    from lfm_ppl.results import arviz_data
    from lfm_ppl.results.predictions import GROUP, MEAN

    times = requested_times(task.observed, arguments.until, arguments.at, _GRID, np.array([]))
    inputs = {}
    if held_out is not None:
        times = np.union1d(times, held_out.times)
        inputs = {name: Input(*joined(task.observed.inputs[name], later)) for name, later in held_out.inputs.items()}
    more: dict[str, Any] = {"inputs": inputs, "model_kwargs": task.keywords}
    forecast = lfm_ppl.forecast(task.posterior, task.model, times, draws=arguments.draws, seed=arguments.seed,
                                progress=not arguments.quiet, **more)
    # The scores of an observation family need the model.
    of_family = MEAN not in arviz_data.group(forecast, GROUP)
    model_arguments: dict[str, Any] = {"numpyro_model": task.model, **more} if of_family else {}
    return forecast, lambda: lfm_ppl.score(forecast, held_out, **model_arguments)


def joined(earlier: InputTable, later: InputTable) -> InputTable:
    """Return a known input followed by later values."""
    is_earlier = earlier.times < later.times[0]
    return InputTable(
        np.append(earlier.times[is_earlier], later.times),
        np.append(earlier.values[is_earlier], later.values),
        earlier.interpolation,
    )


def _held_out(arguments: argparse.Namespace, task: StoredFit) -> Data:
    outputs = task.observed.outputs
    columns = outputs
    if arguments.outputs is not None:
        columns = tuple(name.strip() for name in arguments.outputs.split(","))
        if len(columns) != len(outputs):
            raise ValueError(f"the result has {checks.counted(len(outputs), 'output')} ({', '.join(outputs)}); "
                             f"--outputs names {checks.counted(len(columns), 'column')}.")
    # Only the model file states that blank cells are zero.
    interpolations = {name: "zero" if task.file.inputs.get(name) == "zero" else table.interpolation
             for name, table in task.observed.inputs.items()}
    if arguments.inputs is not None and not interpolations:
        raise ValueError("--inputs names columns of known inputs, and the result has no known inputs; leave it out.")
    inputs = (
        choices.inputs(arguments.inputs, dataclasses.replace(task.file, inputs=interpolations))
        if interpolations
        else {}
    )
    read = data.read_csv(arguments.held_out, columns, arguments.time_column, dict(inputs.values()),
                         task.observed.units.get("time") if task.observed.origin is not None else None,
                         observed=not inputs)
    read = dataclasses.replace(read, outputs=outputs,
                               inputs={name: read.inputs[column] for name, (column, _) in inputs.items()})
    if (read.origin is None) != (task.observed.origin is None):
        kinds = ("plain numbers", "dates") if read.origin is None else ("dates", "plain numbers")
        raise ValueError(f"{arguments.held_out}: its times are {kinds[0]}, the times of the result {kinds[1]}; use "
                         "the same form.")
    read = on_clock_of(read, task.observed)
    if repeated_rows := int(np.isin(read.times, task.observed.times).sum()):
        print(f"note     {repeated_rows} of {len(read.times)} rows of {arguments.held_out} are at times of the fitted "
              "data: if they are the same data, their scores are not scores of a forecast")
    prepared = task.file.prepare(dataclasses.replace(read, inputs={
        name: joined(task.observed.inputs[name], later) for name, later in read.inputs.items()}))
    if not np.array_equal(prepared.y, read.y, equal_nan=True):
        raise ValueError(f"{task.file.path} changes the numbers of a data file in `prepare`, so that held-out numbers "
                         "may not be comparable with the fitted ones. Score them in Python, on the model's scale: "
                         "lfm.score(forecast, held_out).")
    return read


def _write(forecast: Any, score: Callable, held_out: Data | None, task: StoredFit, path: Path, folder: Path,
           arguments: argparse.Namespace) -> int:
    from lfm_ppl.results import arviz_data, files, inputs, tables
    from lfm_ppl.results.predictions import GROUP, HELD_OUT, held_out_data, summary

    group = arviz_data.group(forecast, GROUP).assign_attrs(command_line=page.command_line(arguments))
    forecast = arviz_data.add_group(forecast, GROUP, group)
    target = folder / files.POSTERIOR if arguments.out else path
    if held_out is not None and np.isfinite(held_out.y).any():
        later = held_out_data(held_out.times, held_out.y, arviz_data.group(forecast, "observed_data"))
        forecast = arviz_data.add_group(forecast, HELD_OUT, later)
    updated = forecast
    if not arguments.out:
        # Load the file again: another process may have added to it.
        updated = arviz_data.load(path)
        updated = arviz_data.add_group(updated, GROUP, group)
        for name in (HELD_OUT, inputs.FORECAST):
            updated = arviz_data.remove_group(updated, name)
            if arviz_data.has_group(forecast, name):
                updated = arviz_data.add_group(updated, name, arviz_data.group(forecast, name))
    print(f"wrote    {arviz_data.save(updated, target, arguments.overwrite or not arguments.out)} (group {GROUP})")
    table = summary(group)
    seen = task.observed
    if seen.origin is not None:  # dates as in the data
        table.index = pd.Index([calendar_time.clock(float(time), seen.origin, seen.units["time"], "T", 3)
                                for time in table.index], name="time")
    print(f"wrote    {tables.write_csv(table, folder / TABLE, arguments.overwrite, index_label='time')}")
    more: dict[str, pd.DataFrame] = {}
    if held_out is not None and np.isfinite(held_out.y).any():
        scores = score()
        print(f"\n{tables.text_table(scores, width=shutil.get_terminal_size().columns)}\n")
        print(f"wrote    {tables.write_csv(scores, folder / SCORES, arguments.overwrite, index_label='output')}")
        more = {"Scores on the held-out data": scores}
    figure_paths = []
    try:
        for name, draw in _figures(forecast):
            figure = draw(forecast, width="full")
            with atomic_files.atomic_write(folder / name, arguments.overwrite) as temporary:
                figure.savefig(temporary, format="png")
            figure_paths.append(folder / name)
            print(f"wrote    {folder / name}")
    except Exception as error:  # the numbers are saved
        print(f"lfm-ppl: the figure could not be drawn: {error}", file=sys.stderr)
        return 1
    return page.update(updated, folder, tuple(figure_paths), more)


def _figures(forecast: Any) -> Iterator[tuple[str, Callable]]:
    """Yield file name and function of each figure."""
    from lfm_ppl.results import inputs, plots
    from lfm_ppl.results.plots.trajectories import trajectory_names

    yield FIGURE, plots.plot_fit
    if inputs.inputs_of(forecast):
        yield MORE_FIGURES["inputs"], plots.plot_inputs
    for kind in ("force", "deterministic", "state"):
        if trajectory_names(forecast, kind):
            yield MORE_FIGURES[f"{kind}s"], getattr(plots, f"plot_{kind}s")
