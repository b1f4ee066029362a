"""``lfm-ppl forecast``: new observations, with their noise, from a saved result."""

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

from lfm_ppl.cli import check, choices, page, results, session
from lfm_ppl.io import data
from lfm_ppl.utils import calendar_time, checks

TABLE = "forecast.csv"
FIGURE = "forecast.png"
MORE_FIGURES = {"inputs": "forecast-inputs.png", "forces": "forecast-forces.png",
                "deterministics": "forecast-deterministics.png", "states": "forecast-states.png"}
"""Of what the result holds."""

SCORES = "scores.csv"

_GRID = 121
"""Times of a forecast with --until: enough for smooth bands."""


def run(arguments: argparse.Namespace) -> int:
    """Write the forecast into the result, as a table and as a figure, and its scores where held-out data are given."""
    from lfm_ppl.results import arviz_data, files
    from lfm_ppl.results.predictions import GROUP

    if arguments.held_out is None and arguments.until is None and arguments.at is None:
        raise ValueError("say what to forecast: --until TIME, --at T1,T2,... or --held-out FILE (at its times).")
    for flag in ("outputs", "inputs", "time_column"):
        if getattr(arguments, flag) is not None and arguments.held_out is None:
            raise ValueError(f"--{flag.replace('_', '-')} says how to read a data file; give one with --held-out.")
    path = files.locate(arguments.result)
    if not arguments.out:
        for name in (TABLE, FIGURE, *MORE_FIGURES.values(), *([SCORES] if arguments.held_out else [])):
            files.refuse_existing(path.parent / name, arguments.overwrite)
        page.refuse_foreign(path.parent, arguments.overwrite)
    posterior = arviz_data.load(path)
    if not arguments.out and not arguments.overwrite and arviz_data.has_group(posterior, GROUP):
        raise FileExistsError(f"{path} holds predictions already, which are kept. Write elsewhere with --out, or "
                              "replace them with --overwrite.")
    with contextlib.ExitStack() as stack:
        folder = path.parent
        if not arguments.out:
            results.writable(folder)
        else:
            folder = stack.enter_context(results.folder("forecast", arguments.out, arguments.overwrite))
        session.start(1, not arguments.no_cache)
        task = check.rebuilt(posterior, arguments.model, path)
        held_out = None if arguments.held_out is None else _held_out(arguments, task)
        forecast, score = _forecast(arguments, task, held_out)
        return _write(forecast, score, held_out, task, path, folder, arguments)


def _forecast(arguments: argparse.Namespace, task: check.Check, held_out: data.Data | None) -> tuple:
    """Return the forecast, and what scores it."""
    import lfm_ppl
    from lfm_ppl.model.inputs import Input
    from lfm_ppl.results import arviz_data
    from lfm_ppl.results.predictions import GROUP, MEAN

    times = requested(task.observed, arguments.until, arguments.at, _GRID, np.array([]))
    inputs = {}
    if held_out is not None:
        times = np.union1d(times, held_out.times)
        inputs = {name: Input(*joined(task.observed.inputs[name], later)) for name, later in held_out.inputs.items()}
    more: dict[str, Any] = {"inputs": inputs, "model_kwargs": task.keywords}
    forecast = lfm_ppl.forecast(task.posterior, task.model, times, draws=arguments.draws, seed=arguments.seed,
                                progress=not arguments.quiet, **more)
    # An observation family has its own law, which is the model's.
    of_family = MEAN not in arviz_data.group(forecast, GROUP)
    own: dict[str, Any] = {"numpyro_model": task.model, **more} if of_family else {}
    return forecast, lambda: lfm_ppl.score(forecast, held_out, **own)


def joined(before: data.InputTable, later: data.InputTable) -> data.InputTable:
    """Return a known input that goes on with later values."""
    kept = before.times < later.times[0]
    return data.InputTable(np.append(before.times[kept], later.times), np.append(before.values[kept], later.values),
                           before.interpolation)


def requested(observed: data.Data, until: str | None, at: str | None, grid: int, always: np.ndarray) -> np.ndarray:
    """Return the times that --until and --at ask for, numbers or dates, in order, and those of ``always``.

    Raises:
        ValueError: neither a number nor a date; --until is not after the last observation.
    """
    last = observed.times[-1]
    asked = [_time("--at", text, observed, ". Separate times by commas.") for text in (at or "").split(",") if at]
    if not np.isfinite(asked).all():
        raise ValueError(f"--at takes finite times, separated by commas, got {at}.")
    wanted = [always, np.array(asked)]
    if until is not None:
        end = _time("--until", until, observed)
        if not (np.isfinite(end) and end > last):
            shown = f"{last:g}"
            if observed.origin is not None:
                shown = calendar_time.clock(last, observed.origin, observed.units["time"], "T")
            raise ValueError(f"--until takes a time after the last observation, at {shown}, got {until}.")
        wanted.append(np.linspace(last, end, grid))
    return np.unique(np.concatenate(wanted))


def _time(flag: str, text: str, observed: data.Data, more: str = "") -> float:
    try:
        return calendar_time.position(text, observed.origin, observed.units.get("time", ""))
    except ValueError as error:
        raise ValueError(f"{flag}: {str(error).rstrip('.')}{more or '.'}") from None


def _held_out(arguments: argparse.Namespace, task: check.Check) -> data.Data:
    outputs = task.observed.outputs
    columns = outputs
    if arguments.outputs is not None:
        columns = tuple(name.strip() for name in arguments.outputs.split(","))
        if len(columns) != len(outputs):
            raise ValueError(f"the result has {checks.counted(len(outputs), 'output')} ({', '.join(outputs)}); "
                             f"--outputs names {checks.counted(len(columns), 'column')}.")
    # The result does not say that blank cells were read as zero; the model file may.
    known = {name: "zero" if task.file.inputs.get(name) == "zero" else one.interpolation
             for name, one in task.observed.inputs.items()}
    if arguments.inputs is not None and not known:
        raise ValueError("--inputs names columns of known inputs, and the result has no known inputs; leave it out.")
    inputs = choices.inputs(arguments.inputs, dataclasses.replace(task.file, inputs=known)) if known else {}
    read = data.read_csv(arguments.held_out, columns, arguments.time_column, dict(inputs.values()),
                         task.observed.units.get("time") if task.observed.origin is not None else None,
                         observed=not inputs)
    read = dataclasses.replace(read, outputs=outputs,
                               inputs={name: read.inputs[column] for name, (column, _) in inputs.items()})
    if (read.origin is None) != (task.observed.origin is None):
        kinds = ("plain numbers", "dates") if read.origin is None else ("dates", "plain numbers")
        raise ValueError(f"{arguments.held_out}: its times are {kinds[0]}, and those of the result {kinds[1]}; give "
                         "both in one form.")
    read = data.on_clock_of(read, task.observed)
    if again := int(np.isin(read.times, task.observed.times).sum()):
        print(f"note     {again} of {len(read.times)} rows of {arguments.held_out} are at times of the fitted data: if "
              "they are the same data, scores on them say nothing of a forecast")
    taken = task.file.prepare(dataclasses.replace(read, inputs={
        name: joined(task.observed.inputs[name], later) for name, later in read.inputs.items()}))
    if not np.array_equal(taken.y, read.y, equal_nan=True):
        raise ValueError(f"{task.file.path} changes the numbers of a data file (`prepare`), perhaps by the file's own, "
                         "so that held-out numbers cannot be compared with a fit to others. Score them in Python, "
                         "on the model's scale: lfm.score(forecast, held_out).")
    return read


def _write(forecast: Any, score: Callable, held_out: data.Data | None, task: check.Check, path: Path, folder: Path,
           arguments: argparse.Namespace) -> int:
    from lfm_ppl.results import arviz_data, files, inputs, tables
    from lfm_ppl.results.predictions import GROUP, HELD_OUT, held_out_data, summary

    group = arviz_data.group(forecast, GROUP).assign_attrs(command_line=page.command_line(arguments))
    forecast = arviz_data.add_group(forecast, GROUP, group)
    target = folder / files.POSTERIOR if arguments.out else path
    if held_out is not None and np.isfinite(held_out.y).any():
        later = held_out_data(held_out.times, held_out.y, arviz_data.group(forecast, "observed_data"))
        forecast = arviz_data.add_group(forecast, HELD_OUT, later)
    whole = forecast
    if not arguments.out:
        # The file again, not what was read before the computation: somebody may have added to it.
        whole = arviz_data.load(path)
        whole = arviz_data.add_group(whole, GROUP, group)
        for name in (HELD_OUT, inputs.FORECAST):
            whole = arviz_data.remove_group(whole, name)
            if arviz_data.has_group(forecast, name):
                whole = arviz_data.add_group(whole, name, arviz_data.group(forecast, name))
    print(f"wrote    {arviz_data.save(whole, target, arguments.overwrite or not arguments.out)} (group {GROUP})")
    table = summary(group)
    seen = task.observed
    if seen.origin is not None:  # as in the data
        table.index = pd.Index([calendar_time.clock(float(time), seen.origin, seen.units["time"], "T", 3)
                                for time in table.index], name="time")
    print(f"wrote    {tables.write_csv(table, folder / TABLE, arguments.overwrite, index_label='time')}")
    more: dict[str, pd.DataFrame] = {}
    if held_out is not None and np.isfinite(held_out.y).any():
        scores = score()
        print(f"\n{tables.text_table(scores, width=shutil.get_terminal_size().columns)}\n")
        print(f"wrote    {tables.write_csv(scores, folder / SCORES, arguments.overwrite, index_label='output')}")
        more = {"Scores on the held-out data": scores}
    drawn = []
    try:
        for name, draw in _figures(forecast):
            figure = draw(forecast, width="full")
            with files.writing(folder / name, arguments.overwrite) as temporary:
                figure.savefig(temporary, format="png")
            drawn.append(folder / name)
            print(f"wrote    {folder / name}")
    except Exception as error:  # the numbers are safe
        print(f"lfm-ppl: the figure could not be drawn: {error}", file=sys.stderr)
        return 1
    return page.update(whole, folder, tuple(drawn), more)


def _figures(forecast: Any) -> Iterator[tuple[str, Callable]]:
    """Yield file name and function of each figure that there are numbers for."""
    from lfm_ppl.results import inputs, plots
    from lfm_ppl.results.plots.trajectories import trajectory_names

    yield FIGURE, plots.plot_fit
    if inputs.inputs_of(forecast):
        yield MORE_FIGURES["inputs"], plots.plot_inputs
    for kind in ("force", "deterministic", "state"):
        if trajectory_names(forecast, kind):
            yield MORE_FIGURES[f"{kind}s"], getattr(plots, f"plot_{kind}s")
