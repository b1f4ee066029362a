"""``lfm-ppl fit --each`` and ``--series``: one model fitted separately to many data sets.

1. Read all files, or all series of one file; data sets that cannot be read are reported as failed.
2. Fit them (`lfm_ppl.fit_many`), inline or in several processes.
3. Write a folder for each result, and one table and one file of posteriors for all.
"""

from __future__ import annotations

import contextlib
import glob
import os
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import lfm_ppl
from lfm_ppl.cli import choices, folders, session
from lfm_ppl.cli.data_file import read_data, read_series
from lfm_ppl.cli.fit_arguments import approximated_model, result_attributes, sampling_arguments, without_data
from lfm_ppl.cli.options import DataOptions, FitArguments
from lfm_ppl.cli.requested_times import trajectory_times
from lfm_ppl.io import loading
from lfm_ppl.io.data_set import Data
from lfm_ppl.report import html_report
from lfm_ppl.results import arviz_data, tables
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.storage import files
from lfm_ppl.utils.progress import duration
from lfm_ppl.workflows.fit_tasks import file_name

RESULTS = "results"
"""Folder of the results, one folder per data set as of `lfm-ppl fit`: ``lfm-ppl check OUT/results/NAME``."""

_SHOWN = 10
"""Number of failures whose reasons are printed; ``failed.csv`` has all."""


def run(model_name: str, options: FitArguments, line: Sequence[str]) -> int:
    """Fit every data set without a stored result; return 1 if some failed."""
    workers = options.processes.workers
    session.start(1, not options.output.no_cache, one_thread=True)
    model = loading.load(model_name)
    model_options = choices.options(model, options.inference.option)
    if options.data.data is None:
        raise ValueError("--each and --series need --data: a pattern of files, --data 'patients/*.csv' --each, or "
                         "a file with a column of identifiers, --data all.csv --series patient.")
    if options.data.truth is not None:
        raise ValueError("--truth is for one data set; leave it out with --each and --series.")
    observations, failed = _read(model, options.data)
    data_sets, arguments = {}, {}
    for name, file_data in observations.items():
        try:
            observed = model.prepare(file_data)
            arguments[name] = {
                "model_kwargs": without_data(model.keywords(observed, model_options)),
                "at": trajectory_times(observed, options.output.times),
                "fixed": choices.fixed(options.inference.set, model.anchors(observed), model.options),
                "name": model.name}
            data_sets[name] = observed
        except ValueError as error:
            failed[name] = str(error)
    if not data_sets:
        name, reason = next(iter(failed.items()))
        raise ValueError(f"no data set can be used ({len(failed)} failed). {name}: {reason}")
    path = Path(options.output.out or folders.FOLDER / f"{model.name}-many")
    with folders.open_folder(path) as folder, _pickled_by_value(model, workers):
        fits = lfm_ppl.fit_many(
            approximated_model(options, model), data_sets, checkpoint=folder, workers=workers, each=arguments,
            progress=not options.output.quiet, **sampling_arguments(options, model))
        fits.refused = failed
        print(f"model    {model.name}: {model.summary}" if model.summary else f"model    {model.name}")
        print(f"data     {options.data.data}: {len(fits)} data sets", flush=True)
        start_time = time.perf_counter()
        for fitted in fits:
            if fitted.result is not None:
                _write(fitted, folder / RESULTS,
                       result_attributes(options, line, model, data_sets[fitted.name], model_options))
    return _report(fits, folder, duration(time.perf_counter() - start_time))


def _write(fitted: Any, folder: Path, attributes: dict[str, Any]) -> None:
    """Write the result of a data set like the result of a single fit, without figures, which `lfm-ppl plot` draws."""
    target = folder / file_name(fitted.name)
    if fitted.stored and (target / html_report.NAME).is_file():
        return
    fitted.result.attrs.update(attributes)
    arviz_data.save(fitted.result, target / files.POSTERIOR, overwrite=True)
    view = ResultView.of(fitted.result)
    summary = tables.annotate(arviz_data.summary(view), view)
    tables.write_csv(summary, target / folders.SUMMARY, overwrite=True)
    try:
        html_report.save_report(fitted.result, target / html_report.NAME, overwrite=True, figures=[])
    except Exception as error:  # the result is saved
        print(f"lfm-ppl: the page of {fitted.name} could not be written: {error}", file=sys.stderr)


def _report(fits: Any, folder: Path, spent: str) -> int:
    if not fits.overview.empty:
        print(f"\n{tables.text_table(fits.overview, width=shutil.get_terminal_size().columns)}\n")
    print(f"time     {spent}")
    print(f"wrote    {folder} (one result per data set in {folder / RESULTS}; figures: lfm-ppl plot RESULT)")
    for name, reason in list(fits.failed.items())[:_SHOWN]:
        print(f"lfm-ppl: failed: {name}: {reason}", file=sys.stderr)
    if fits.failed:
        print(f"lfm-ppl: {len(fits.failed)} of {len(fits)} data sets failed; all are in {folder / 'failed.csv'}. The "
              "same command tries them again.", file=sys.stderr)
    return 1 if fits.failed else 0


def _read(model: loading.ModelFile, options: DataOptions) -> tuple[dict[str, Data], dict[str, str]]:
    """Return name -> observations, and name -> reason of a file that cannot be used.

    Raises:
        ValueError: no file matches; data sets differ in their columns or in their unit of time.
    """
    failed: dict[str, str] = {}
    paths = _matching_files(options.data or "") if options.each else {}
    if options.each:
        data_sets = {}
        for name, path in paths.items():
            try:
                data_sets[name] = read_data(path, model, options)
            except (ValueError, OSError) as error:
                failed[name] = str(error)
    else:
        data_sets = read_series(model, options)
    for name, observed in data_sets.items():
        first_name, first = next(iter(data_sets.items()))
        if observed.outputs != first.outputs:
            raise ValueError(f"{paths[name]} has the columns {', '.join(observed.outputs)}, but {first_name} has "
                             f"{', '.join(first.outputs)}. Name those to use with --outputs.")
        unit, first_unit = (member.units.get("time", "no unit") for member in (observed, first))
        if unit != first_unit:
            raise ValueError(f"the times of {name} are in {unit}, the times of {first_name} in {first_unit}. Give one "
                             "unit for all of them, with --time-unit for dates.")
    return data_sets, failed


def _matching_files(pattern: str) -> dict[str, str]:
    """Return name -> path of the files that match; the names are paths below the common folder.

    Raises:
        ValueError: there are none.
    """
    paths = sorted(path for path in glob.glob(pattern, recursive=True) if not os.path.isdir(path))
    if not paths:
        hint = f" {pattern} is a folder; its files are '{pattern.rstrip('/')}/*.csv'." if os.path.isdir(pattern) else ""
        raise ValueError(f"no file matches --data {pattern!r}.{hint}")
    return dict(zip(_unique_names(paths), paths, strict=True))


def _unique_names(paths: Sequence[str]) -> list[str]:
    """Return a unique name for each file: its path below the common folder, without the suffix if possible.

    Example:
        >>> _unique_names(["a/x.csv", "a/y.csv"]), _unique_names(["a/x.csv", "b/x.csv"])
        (['x', 'y'], ['a/x', 'b/x'])
        >>> _unique_names(["x.csv", "x.txt"])
        ['x.csv', 'x.txt']
    """
    common_folder = os.path.commonpath([os.path.dirname(os.path.abspath(path)) for path in paths])
    relative_paths = [Path(os.path.relpath(path, common_folder)).as_posix() for path in paths]
    short = [str(Path(name).with_suffix("").as_posix()) for name in relative_paths]
    return short if len(set(short)) == len(short) else relative_paths


@contextlib.contextmanager
def _pickled_by_value(model: loading.ModelFile, workers: int | str) -> Iterator[None]:
    """Pickle the model's module by value: other processes cannot import a file that was loaded by its path."""
    if workers == 1:
        yield
        return
    import cloudpickle

    module = sys.modules[model.model.__module__]
    cloudpickle.register_pickle_by_value(module)
    try:
        yield
    finally:
        cloudpickle.unregister_pickle_by_value(module)
