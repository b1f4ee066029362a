"""``lfm-ppl fit --each`` and ``--series``: one model fitted separately to many data sets.

1. Read all files, or all series of one file; data sets that cannot be read are reported as failed.
2. Fit them (`lfm_ppl.fit_many`), inline or in several processes.
3. Write a folder for each result, and one table and one file of posteriors for all.
"""

from __future__ import annotations

import argparse
import contextlib
import glob
import os
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from lfm_ppl.cli import choices, results, session
from lfm_ppl.cli.data_file import check_time_unit, model_time_unit, output_columns, read_data, with_model_names
from lfm_ppl.cli.fit_arguments import approximated_model, check_sampler, result_attributes, sampling_arguments
from lfm_ppl.cli.requested_times import trajectory_times
from lfm_ppl.io import data, loading
from lfm_ppl.io.data_set import Data

RESULTS = "results"
"""Folder of the results, one folder per data set as of `lfm-ppl fit`: ``lfm-ppl check OUT/results/NAME``."""

_SHOWN = 10
"""Number of failures whose reasons are printed; ``failed.csv`` has all."""


def run(arguments: argparse.Namespace) -> int:
    """Fit every data set without a stored result; return 1 if some failed."""
    from lfm_ppl import fit_many
    from lfm_ppl.results import tables
    from lfm_ppl.utils.progress import duration

    workers = choices.workers(arguments.jobs, arguments.scheduler)
    session.start(1, not arguments.no_cache, one_thread=True)
    model = loading.load(arguments.model)
    options = choices.options(model, arguments.option)
    check_sampler(arguments)
    if arguments.data is None:
        raise ValueError("--each and --series need --data: a pattern of files, --data 'patients/*.csv' --each, or "
                         "a file with a column of identifiers, --data all.csv --series patient.")
    if arguments.resume and arguments.overwrite:
        raise ValueError("--resume uses the stored results, --overwrite replaces them; give one of them.")
    if arguments.truth is not None:
        raise ValueError("--truth is for one data set; leave it out with --each and --series.")
    observations, failed = _read_files(arguments, model) if arguments.each else (_read_series(arguments, model), {})
    data_sets, options_by_name = {}, {}
    for name, file_data in observations.items():
        try:
            observed = model.prepare(file_data)
            options_by_name[name] = {"model_kwargs": model.keywords(observed, options),
                         "at": trajectory_times(observed, arguments.until, arguments.at),
                         "fixed": choices.fixed(arguments.set, model.anchors(observed), model.options),
                         "name": model.name}
        except ValueError as error:
            failed[name] = str(error)
        else:
            data_sets[name] = observed
    if not data_sets:
        name, reason = next(iter(failed.items()))
        raise ValueError(f"no data set can be used ({len(failed)} failed). {name}: {reason}")
    default = Path("lfm-results") / f"{model.name}-many"
    with results.lasting(default, arguments.out) as folder, _pickled_by_value(model, workers):
        fits = fit_many(
            approximated_model(arguments, model),
            data_sets,
            out=folder,
            workers=workers,
            each=options_by_name,
            seed=arguments.seed,
            overwrite=arguments.overwrite,
            progress=not arguments.quiet,
            **sampling_arguments(arguments, model),
        )
        fits.refused = failed
        print(f"model    {model.name}: {model.summary}" if model.summary else f"model    {model.name}")
        print(f"data     {arguments.data}: {len(fits)} data sets", flush=True)
        started = time.perf_counter()
        for fitted in fits:
            if fitted.result is not None:
                _write(fitted, folder / RESULTS, result_attributes(arguments, model, data_sets[fitted.name], options))
    return _report(fits, folder, duration(time.perf_counter() - started), tables)


def _write(fitted: Any, folder: Path, attributes: dict[str, Any]) -> None:
    """Write the result of a data set like the result of a single fit, without figures, which `lfm-ppl plot` draws."""
    from lfm_ppl.results import arviz_data, files, html_report, tables
    from lfm_ppl.workflows.fit_tasks import file_name

    target = folder / file_name(fitted.name)
    if fitted.stored and (target / html_report.NAME).is_file():
        return
    fitted.result.attrs.update(attributes)
    arviz_data.save(fitted.result, target / files.POSTERIOR, overwrite=True)
    summary = tables.annotated(arviz_data.summary(fitted.result), fitted.result)
    tables.write_csv(summary, target / results.SUMMARY, overwrite=True)
    try:
        html_report.save_report(fitted.result, target / html_report.NAME, overwrite=True, figures=[])
    except Exception as error:  # the result is saved
        print(f"lfm-ppl: the page of {fitted.name} could not be written: {error}", file=sys.stderr)


def _report(fits: Any, folder: Path, spent: str, tables: Any) -> int:
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


def _read_files(arguments: argparse.Namespace, model: loading.ModelFile) -> tuple[dict[str, Data], dict[str, str]]:
    """Return name -> observations, and name -> reason of a file that cannot be used.

    Raises:
        ValueError: no file matches; files without named outputs have different columns.
    """
    paths = sorted(path for path in glob.glob(arguments.data, recursive=True) if not os.path.isdir(path))
    if not paths:
        hint = f" {arguments.data} is a folder; its files are '{arguments.data.rstrip('/')}/*.csv'." \
            if os.path.isdir(arguments.data) else ""
        raise ValueError(f"no file matches --data {arguments.data!r}.{hint}")
    data_sets: dict[str, Data] = {}
    failed: dict[str, str] = {}
    for name, path in zip(_names(paths), paths, strict=True):
        try:
            data_sets[name] = read_data(path, model, arguments)
        except (ValueError, OSError) as error:
            failed[name] = str(error)
            continue
        first = next(iter(data_sets))
        if data_sets[name].outputs != data_sets[first].outputs:
            raise ValueError(f"{path} has the columns {', '.join(data_sets[name].outputs)}, but {first} has "
                             f"{', '.join(data_sets[first].outputs)}. Name those to use with --outputs.")
    _check_units(data_sets)
    return data_sets, failed


def _names(paths: list[str]) -> list[str]:
    """Return a unique name for each file: its path below the common folder, without the suffix if possible.

    Example:
        >>> _names(["a/x.csv", "a/y.csv"]), _names(["a/x.csv", "b/x.csv"]), _names(["x.csv", "x.txt"])
        (['x', 'y'], ['a/x', 'b/x'], ['x.csv', 'x.txt'])
    """
    shared = os.path.commonpath([os.path.dirname(os.path.abspath(path)) for path in paths])
    relative_paths = [Path(os.path.relpath(path, shared)).as_posix() for path in paths]
    short = [str(Path(name).with_suffix("").as_posix()) for name in relative_paths]
    return short if len(set(short)) == len(short) else relative_paths


def _read_series(arguments: argparse.Namespace, model: loading.ModelFile) -> dict[str, Data]:

    inputs = choices.inputs(arguments.inputs, model)
    read = data.read_series(
        arguments.data,
        arguments.series,
        output_columns(arguments, model),
        arguments.time_column,
        dict(inputs.values()),
        arguments.time_unit,
        model_time_unit(model),
    )
    _check_units(read)
    for observed in read.values():
        check_time_unit(model, observed, arguments.data, arguments)
    return {name: with_model_names(model, inputs, observed) for name, observed in read.items()}


def _check_units(data_sets: dict[str, Data]) -> None:
    """Raise ValueError if dates of data sets are counted in different units, since tables of all have one unit."""
    first = next(iter(data_sets), "")
    for name, observed in data_sets.items():
        unit, first_unit = (member.units.get("time", "no unit") for member in (observed, data_sets[first]))
        if unit != first_unit:
            raise ValueError(
                f"the times of {name} are in {unit}, the times of {first} in {first_unit}. Give one unit for "
                "all of them, with --time-unit for dates."
            )


@contextlib.contextmanager
def _pickled_by_value(model: loading.ModelFile, workers: Any) -> Any:
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
