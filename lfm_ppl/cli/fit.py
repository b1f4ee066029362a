"""``lfm-ppl fit``: from a model and data to posterior, summary and figures.

1. Check all options and read model and data, before anything is computed.
2. Print the task, and fit (`lfm_ppl.fit`); the checkpoint lies in the folder of the result.
3. Write the posterior, the summary and then the figures and the report, so that a failure costs no draws.
4. After Ctrl-C print the command that resumes the run.
"""

from __future__ import annotations

import dataclasses
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import lfm_ppl
from lfm_ppl.cli import choices, fit_many, folders, pages, session
from lfm_ppl.cli.data_file import read_data, read_series, unit_of_file
from lfm_ppl.cli.fit_arguments import approximated_model, result_attributes, sampling_arguments, without_data
from lfm_ppl.cli.options import DataOptions, FitArguments
from lfm_ppl.cli.requested_times import trajectory_times
from lfm_ppl.inference.bind import bind
from lfm_ppl.io import loading
from lfm_ppl.io.data_set import Data, stack_series
from lfm_ppl.io.input_table import OF_SERIES, InputTable
from lfm_ppl.io.truth import read_truth
from lfm_ppl.report import html_report
from lfm_ppl.results import arviz_data, tables
from lfm_ppl.results.fields import add_fields
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.storage import checkpoint, files
from lfm_ppl.utils import calendar_time, checks
from lfm_ppl.utils.interruption import INTERRUPTED, interruptible
from lfm_ppl.utils.progress import duration


def run(name: str, options: FitArguments, line: Sequence[str]) -> int:
    """Fit, print the summary, and write the results; the posterior is on disk before any figure."""
    is_panel = loading.is_panel(name)
    if options.data.each or (options.data.series is not None and not is_panel):
        return fit_many.run(name, options, line)
    if options.processes.jobs is not None or options.processes.scheduler is not None:
        raise ValueError("--jobs and --scheduler are for many data sets; give them with --each or --series" + (
            ", and leave them out with a model of all series together." if is_panel else "."))
    if is_panel and options.data.data is not None and options.data.series is None:
        raise ValueError(f"{name} is a model of several series (lfm.panel); name the column of --data that identifies "
                         "the series of each row with --series.")
    output = options.output
    session.start(options.inference.chains, not output.no_cache)
    model = loading.load(name)
    model_options = choices.options(model, options.inference.option)
    observed = observed_data(options.data, model, model_options)
    keywords, fields = model.keywords(observed, model_options), model.fields(observed, model_options)
    fixed = choices.fixed(options.inference.set, model.anchors(observed), model.options)
    times = trajectory_times(observed, output.times)
    numpyro_model = approximated_model(options, model)
    if output.out is not None:
        checkpoint.check_folder(output.out, output.resume, output.overwrite)
    elif output.resume:
        raise ValueError("--resume continues the run in a folder; name the folder with --out.")
    with folders.folder(model.name, output.out, output.overwrite or output.resume) as folder:
        is_finished = output.resume and checkpoint.is_finished(folder)
        if output.resume and not is_finished and not checkpoint.has_run(folder):
            print(f"resume   no run to resume in {folder}: this is a new run")
        if options.inference.set:  # an unknown name must not be printed as fixed
            with calendar_time.in_messages(observed.origin, observed.units.get("time", "")):
                bind(numpyro_model, observed.times, observed.y, model_kwargs=keywords).fix(fixed)
        _print_data(options, model, observed, fixed)
        _print_settings(options, model_options, observed)
        resume = pages.command_line(line, *([] if output.out else ["--out", str(folder)]), "--resume")
        start_time = time.perf_counter()
        with interruptible(lambda: _remains(folder, resume)):
            posterior = lfm_ppl.fit(
                numpyro_model, observed, at=times, model_kwargs=without_data(keywords), fixed=fixed,
                progress=not output.quiet, name=model.name, checkpoint=folder, resume=output.resume,
                attributes=result_attributes(options, line, model, observed, model_options),
                **sampling_arguments(options, model))
            partial = posterior.attrs.get("partial")
            # The report is written last: without it the run was killed while it drew its figures.
            if is_finished and partial is None and (folder / html_report.NAME).is_file():
                print(f"\nthe run in {folder} is complete; nothing was changed")
                return 0
            add_fields(posterior, fields)
            status = report(posterior, folder, time.perf_counter() - start_time, output.overwrite or output.resume)
        if partial is None:
            return status
        print(f"partial  {partial}\nresume   {resume}")
        return INTERRUPTED


def _remains(folder: Path, resume: str) -> str:
    """Return what an interrupted run has left."""
    if checkpoint.has_run(folder):
        return f"resume with: {resume}"
    if (folder / files.POSTERIOR).is_file():
        return f"the result is complete; draw its figures with: lfm-ppl plot {folder} --overwrite"
    return "nothing was sampled yet"


def observed_data(options: DataOptions, model: loading.ModelFile, model_options: dict[str, Any]) -> Data:
    """Return the data of --data as the model takes them, or simulated data."""
    options.columns.refuse_without("--data", options.data, time_unit=options.time_unit, truth=options.truth)
    if options.data is None:
        return model.simulate(**model_options)
    observed = (read_data(options.data, model, options) if options.series is None
                else stack_series(read_series(model, options)))
    if options.truth is not None:
        observed = dataclasses.replace(observed, truth=read_truth(options.truth))
    return model.prepare(observed)


def _inputs_in_words(observed: Data) -> dict[str, str]:
    """Return how each known input is read; of doses also their number and sum, over all series of a panel."""
    groups: dict[str, list[InputTable]] = {}
    for name, table in observed.inputs.items():
        groups.setdefault(name.partition(OF_SERIES)[0], []).append(table)
    words = {}
    for name, members in groups.items():
        words[name] = members[0].interpolation
        if members[0].is_dose:
            count = checks.counted(sum(len(table.times) for table in members), "dose")
            infusions = sum(int((table.durations_of_all > 0).sum()) for table in members)
            words[name] += f", {count} of {sum(float(table.values.sum()) for table in members):g} in all"
            words[name] += f", {infusions} by infusion" if infusions else ""
    return words


def _print_data(options: FitArguments, model: loading.ModelFile, observed: Data, fixed: dict[str, Any]) -> None:
    print(f"model    {model.name}: {model.summary}" if model.summary else f"model    {model.name}")
    is_missing = np.isnan(observed.y) & ~_rows_of_doses(observed)[..., None]
    counts = dict(zip(observed.outputs, is_missing.reshape(-1, len(observed.outputs)).sum(axis=0), strict=True))
    rows, missing = observed.y[..., 0].size, int(sum(counts.values()))
    text = f"{observed.times.shape[-1]} rows of {', '.join(observed.outputs)}"
    if observed.series:
        text = f"{len(observed.series)} series of up to {text}"
    if missing:
        text += f"; {missing} values missing"
    if missing and len(counts) > 1:
        text += " (" + ", ".join(f"{'all' if count == rows else count} of {name}"
                                 for name, count in counts.items() if count) + ")"
    print(f"data     {options.data.data or 'simulated by the model'}: {text}")
    for name in (name for name, values in zip(observed.outputs, np.moveaxis(observed.y, -1, 0), strict=True)
                 if np.isnan(values).all()):
        print(f"note     {name} has no value: its own parameters follow the prior")
    if observed.inputs:
        print("inputs   " + ", ".join(f"{name} ({way})" for name, way in _inputs_in_words(observed).items()))
    if observed.origin is not None:
        print(f"time     in {observed.units['time']} since {observed.origin.replace('T', ' ')}")
    elif (unit := unit_of_file(options.data)) and observed.units.get("time", unit) != unit:
        print(f"time     in {observed.units['time']}, the unit of the model, also for --until and --at; converted from "
              f"{unit} in the file")
    anchors = model.anchors(observed)
    for name, value in fixed.items():
        is_anchor = name in anchors and anchors[name] == value
        print(f"fixed    {name} = {value}" + (f" by the model; --set {name}=free frees it" if is_anchor else ""))


def _rows_of_doses(observed: Data) -> np.ndarray:
    """Return which rows (T,), or (B, T), hold a dose and no measurement; their empty outputs are no missing values."""
    is_dosed = np.zeros(observed.times.shape, bool)
    for name, table in observed.inputs.items():
        if table.is_dose:
            label = name.partition(OF_SERIES)[2]
            series = observed.series.index(label) if label in observed.series else ...
            is_dosed[series] |= np.isin(observed.times[series], table.times)
    return is_dosed & np.isnan(observed.y).all(axis=-1)


def _print_settings(options: FitArguments, model_options: dict[str, Any], observed: Data) -> None:
    approximation, inference = options.approximation, options.inference
    where = "" if approximation.grid is None else f" at {approximation.grid} times"
    for flag, sign, bounds in (("--lower", ">=", approximation.lower), ("--upper", "<=", approximation.upper)):
        for name, value in (choices.bounds(flag, bounds) or {}).items():
            print(f"bound    {name} {sign} {value:g}{where}")
    if model_options:
        print("options  " + ", ".join(f"{name} = {value}" for name, value in model_options.items()))
    if observed.note:
        print(f"note     {observed.note}")
    if inference.sampler != "map":
        warmup = "" if inference.warmup is None else f" {inference.warmup} warm-up and"
        draws = inference.samples or 1000
        print(f"sampler  {inference.sampler}, {inference.chains} chains of{warmup} {draws} kept draws")
    sys.stdout.flush()


def report(posterior: Any, folder: Path, seconds: float, overwrite: bool) -> int:
    """Write and print the results, without figures if they are partial; return 1 if figures or report failed."""
    from lfm_ppl.plots import save_figures
    from lfm_ppl.results.residuals import misfit

    # A checkpoint has written a partial or complete result under this name.
    written = [arviz_data.save(posterior, folder / files.POSTERIOR, overwrite=True)]
    view = ResultView.of(posterior)
    table, attrs = arviz_data.summary(view), view.attrs
    written.append(tables.write_csv(tables.annotate(table, view), folder / folders.SUMMARY, overwrite))
    print(f"\n{tables.text_table(table, width=shutil.get_terminal_size().columns)}\n")
    for message in misfit(view):
        print(f"note     {message}")
    figures: list[Path] = []
    status = 0
    try:
        if "partial" not in attrs:
            figures = save_figures(view, folder, overwrite=overwrite)
    except Exception as error:  # the draws are saved
        print(f"lfm-ppl: the figures could not be drawn: {error}\n"
              f"         try again with: lfm-ppl plot {folder} --overwrite", file=sys.stderr)
        status = 1
    if "log_likelihood_sd" in attrs:
        print(f"particles {attrs['particles']}; the log likelihood estimate has a standard deviation of "
              f"{attrs['log_likelihood_sd']:.2f} (near 1 is best)")
    earlier = float(attrs.get("wall_time_s", 0.0)) - seconds
    print(f"time     {seconds:.0f} s"
          + (f", and {duration(earlier)} before it was stopped" if earlier > 0.05 * seconds + 1.0 else ""))
    for path in (*written, *figures):
        print(f"wrote    {path}")
    return max(status, pages.report_failure(
        lambda: html_report.save_report(view, folder / html_report.NAME, overwrite, figures=figures)))
