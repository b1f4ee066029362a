"""``lfm-ppl fit --each`` and ``--series``: the same model fitted to many data sets, each by itself."""

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
from lfm_ppl.io import data, loading

RESULTS = "results"
"""Folder with a folder for each data set, as `lfm-ppl fit` writes one: ``lfm-ppl check OUT/results/NAME``."""

_SHOWN = 10
"""Data sets that failed whose reasons are printed; ``failed.csv`` has them all."""


def run(arguments: argparse.Namespace) -> int:
    """Fit every data set that the folder does not hold yet; return 1 where some failed."""
    from lfm_ppl import fit_many
    from lfm_ppl.cli import fit
    from lfm_ppl.results import tables
    from lfm_ppl.utils.progress import Console, duration

    workers = choices.workers(arguments.jobs, arguments.scheduler)
    session.start(1, not arguments.no_cache, one_thread=True)
    model = loading.load(arguments.model)
    options = choices.options(model, arguments.option)
    fit.check_sampler(arguments)
    if arguments.data is None:
        raise ValueError("--each and --series fit data of your own: give a pattern of files, --data 'patients/*.csv' "
                         "--each, or a file with a column of identifiers, --data all.csv --series patient.")
    if arguments.resume and arguments.overwrite:
        raise ValueError("--resume goes on with what a folder holds, --overwrite begins anew; choose one.")
    if arguments.truth is not None:
        raise ValueError("--truth is for one data set; leave it out with --each and --series.")
    found, failed = _each(arguments, model) if arguments.each else (_series(arguments, model), {})
    data_sets, own = {}, {}
    for name, one in found.items():
        try:
            observed = model.prepare(one)
            own[name] = {"model_kwargs": model.keywords(observed, options),
                         "at": fit.requested(observed, arguments.until, arguments.at),
                         "fixed": choices.fixed(arguments.set, model.anchors(observed), model.options),
                         "name": model.name}
        except ValueError as error:
            failed[name] = str(error)
        else:
            data_sets[name] = observed
    if not data_sets:
        name, reason = next(iter(failed.items()))
        raise ValueError(f"none of the {len(failed)} data sets can be used. {name}: {reason}")
    default = Path("lfm-results") / f"{model.name}-many"
    with results.lasting(default, arguments.out) as folder, _sent_as_code(model, workers):
        fits = fit_many(fit.approximated(arguments, model), data_sets, out=folder, workers=workers, each=own,
                        seed=arguments.seed, overwrite=arguments.overwrite,
                        report=None if arguments.quiet else Console(),
                        **fit.sampling(arguments, model))
        fits.refused = failed
        print(f"model    {model.name}: {model.summary}" if model.summary else f"model    {model.name}")
        print(f"data     {arguments.data}: {len(fits)} data sets", flush=True)
        started = time.perf_counter()
        for fitted in fits:
            if fitted.result is not None:
                _write(fitted, folder / RESULTS, fit.attributes(arguments, model, data_sets[fitted.name], options))
    return _report(fits, folder, duration(time.perf_counter() - started), tables)


def _write(one: Any, folder: Path, attributes: dict[str, Any]) -> None:
    """Write the result of a data set as that of a single fit, but for its figures, which `lfm-ppl plot` draws."""
    from lfm_ppl.results import arviz_data, files, html_report, tables
    from lfm_ppl.workflows.fit_tasks import file_name

    target = folder / file_name(one.name)
    if one.stored and (target / html_report.NAME).is_file():
        return
    one.result.attrs.update(attributes)
    arviz_data.save(one.result, target / files.POSTERIOR, overwrite=True)
    summary = tables.annotated(arviz_data.summary(one.result), one.result)
    tables.write_csv(summary, target / results.SUMMARY, overwrite=True)
    try:
        html_report.save_report(one.result, target / html_report.NAME, overwrite=True, figures=[])
    except Exception as error:  # the result is safe
        print(f"lfm-ppl: the page of {one.name} could not be written: {error}", file=sys.stderr)


def _report(fits: Any, folder: Path, spent: str, tables: Any) -> int:
    if not fits.overview.empty:
        print(f"\n{tables.text_table(fits.overview, width=shutil.get_terminal_size().columns)}\n")
    print(f"time     {spent}")
    print(f"wrote    {folder} (a result of each in {folder / RESULTS}; figures: lfm-ppl plot RESULT)")
    for name, reason in list(fits.failed.items())[:_SHOWN]:
        print(f"lfm-ppl: failed: {name}: {reason}", file=sys.stderr)
    if fits.failed:
        print(f"lfm-ppl: {len(fits.failed)} of {len(fits)} data sets failed; all are in {folder / 'failed.csv'}. The "
              "same command tries them again.", file=sys.stderr)
    return 1 if fits.failed else 0


def _each(arguments: argparse.Namespace, model: loading.ModelFile) -> tuple[dict[str, data.Data], dict[str, str]]:
    """Return file -> observations, and file -> why it cannot be used.

    Raises:
        ValueError: no file matches; files without named outputs have different columns.
    """
    from lfm_ppl.cli import fit

    paths = sorted(path for path in glob.glob(arguments.data, recursive=True) if not os.path.isdir(path))
    if not paths:
        hint = f" {arguments.data} is a folder; its files are '{arguments.data.rstrip('/')}/*.csv'." \
            if os.path.isdir(arguments.data) else ""
        raise ValueError(f"no file matches --data {arguments.data!r}.{hint}")
    found: dict[str, data.Data] = {}
    failed: dict[str, str] = {}
    for name, path in zip(_names(paths), paths, strict=True):
        try:
            found[name] = fit.read(path, model, arguments)
        except (ValueError, OSError) as error:
            failed[name] = str(error)
            continue
        first = next(iter(found))
        if found[name].outputs != found[first].outputs:
            raise ValueError(f"{path} has the columns {', '.join(found[name].outputs)}, but {first} has "
                             f"{', '.join(found[first].outputs)}. Name those to use with --outputs.")
    _check_units(found)
    return found, failed


def _names(paths: list[str]) -> list[str]:
    """Return a name for each file: its path below the folder that all share, without the suffix where that is enough.

    Example:
        >>> _names(["a/x.csv", "a/y.csv"]), _names(["a/x.csv", "b/x.csv"]), _names(["x.csv", "x.txt"])
        (['x', 'y'], ['a/x', 'b/x'], ['x.csv', 'x.txt'])
    """
    shared = os.path.commonpath([os.path.dirname(os.path.abspath(path)) for path in paths])
    whole = [Path(os.path.relpath(path, shared)).as_posix() for path in paths]
    short = [str(Path(name).with_suffix("").as_posix()) for name in whole]
    return short if len(set(short)) == len(short) else whole


def _series(arguments: argparse.Namespace, model: loading.ModelFile) -> dict[str, data.Data]:
    from lfm_ppl.cli import fit

    inputs = choices.inputs(arguments.inputs, model)
    read = data.read_series(arguments.data, arguments.series, fit.columns(arguments, model), arguments.time_column,
                            dict(inputs.values()), arguments.time_unit, fit.usual_unit(model))
    _check_units(read)
    for one in read.values():
        fit.check_unit(model, one, arguments.data, arguments)
    return {name: fit.taken(model, inputs, one) for name, one in read.items()}


def _check_units(found: dict[str, data.Data]) -> None:
    """Raise ValueError where dates of data sets are counted in different units, of which a table would say nothing."""
    first = next(iter(found), "")
    for name, one in found.items():
        unit, other = (each.units.get("time", "no unit") for each in (one, found[first]))
        if unit != other:
            raise ValueError(f"the times of {name} are in {unit}, and those of {first} in {other}. Give one unit for "
                             "all of them, with --time-unit for dates.")


@contextlib.contextmanager
def _sent_as_code(model: loading.ModelFile, workers: Any) -> Any:
    """Let other processes get the model itself: they cannot import a file that was loaded by its path."""
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
