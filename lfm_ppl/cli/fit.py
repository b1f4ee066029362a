"""``lfm-ppl fit``: from a model and data to posterior, summary and figures.

1. Check all options and read model and data, before anything is computed.
2. Print the task, and fit (`lfm_ppl.fit`); the checkpoint lies in the folder of the result.
3. Write the posterior, the summary and then the figures and the report, so that a failure costs no draws.
4. After Ctrl-C print the command that resumes the run.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import shlex
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from lfm_ppl.cli import choices, fit_many, page, results, session
from lfm_ppl.cli.data_file import read_data
from lfm_ppl.cli.fit_arguments import approximated_model, check_sampler, result_attributes, sampling_arguments
from lfm_ppl.cli.requested_times import trajectory_times
from lfm_ppl.io import loading
from lfm_ppl.io.data_set import Data
from lfm_ppl.io.truth import read_truth
from lfm_ppl.utils import calendar_time
from lfm_ppl.utils.interruption import INTERRUPTED, watched
from lfm_ppl.utils.progress import duration


def run(arguments: argparse.Namespace) -> int:
    """Fit, print the summary, and write the results; the posterior is on disk before any figure."""
    from lfm_ppl.results import arviz_data, checkpoint

    if arguments.each or arguments.series is not None:
        return fit_many.run(arguments)
    if arguments.jobs is not None or arguments.scheduler is not None:
        raise ValueError("--jobs and --scheduler are for many data sets; give them with --each or --series.")
    session.start(arguments.chains, not arguments.no_cache)
    model = loading.load(arguments.model)
    options = choices.options(model, arguments.option)
    observed = _observed(arguments, model, options)
    fixed = choices.fixed(arguments.set, model.anchors(observed), model.options)
    requested_times = trajectory_times(observed, arguments.until, arguments.at)
    check_sampler(arguments)
    numpyro_model = approximated_model(arguments, model)
    if arguments.resume and arguments.out is None:
        raise ValueError("--resume continues the run in a folder; name the folder with --out.")
    if arguments.resume and arguments.overwrite:
        raise ValueError("--resume continues a run, --overwrite starts a new one; give one of them.")
    if arguments.out is not None:  # first: its error mentions resumable runs
        checkpoint.check_folder(arguments.out, arguments.resume, arguments.overwrite)
    with results.folder(model.name, arguments.out, arguments.overwrite, arguments.resume) as folder:
        finished = arguments.resume and checkpoint.is_finished(folder)
        if arguments.resume and not finished and not checkpoint.has_run(folder):
            print(f"resume   no run to resume in {folder}: this is a new run")
        if arguments.set:  # an unknown name must not be printed as fixed
            _check_fixed(numpyro_model, observed, model.keywords(observed, options), fixed)
        _print_task(arguments, model, observed, options, fixed)
        started = time.perf_counter()
        resume_hint = f"resume with: {_resume_command(arguments, folder)}"
        with watched(lambda: resume_hint if checkpoint.has_run(folder) else _nothing_left(folder)) as watch:
            try:
                posterior = sample(arguments, model, numpyro_model, observed, options, fixed, folder, requested_times)
            except KeyboardInterrupt as error:
                reason = str(error) or "stopped before there were draws"
                print(
                    f"\nlfm-ppl: {reason}" + (f"; {resume_hint}" if checkpoint.has_run(folder) else ""), file=sys.stderr
                )
                return INTERRUPTED
            partial = arviz_data.attributes(posterior).get("partial")
            if watch is not None and partial is not None:
                watch.dismiss()
            # The report is written last: without it the run was killed while it drew its figures.
            if finished and partial is None and page.exists(folder):
                print(f"\nthe run in {folder} is complete; nothing was changed")
                return 0
            seconds = time.perf_counter() - started
            status = report(posterior, folder, seconds, arguments.overwrite or arguments.resume)
        if partial is None:
            return status
        print(f"partial  {partial}\nresume   {_resume_command(arguments, folder)}")
        return INTERRUPTED


def _resume_command(arguments: argparse.Namespace, folder: Path) -> str:
    """Return the command that resumes this run."""
    line = [word for word in arguments.line if word not in ("--overwrite", "--resume")]
    if arguments.out is None:
        line += ["--out", str(folder)]
    return shlex.join(["lfm-ppl", *line, "--resume"])


def _nothing_left(folder: Path) -> str:
    from lfm_ppl.results.files import POSTERIOR

    if (folder / POSTERIOR).is_file():
        return f"the result is complete; draw its figures with: lfm-ppl plot {folder} --overwrite"
    with contextlib.suppress(OSError):  # raised where it is not empty
        folder.rmdir()
    return "nothing was sampled yet"


def _observed(arguments: argparse.Namespace, model: loading.ModelFile, options: dict[str, Any]) -> Data:
    """Return the data of --data as the model takes them, or simulated data."""
    if arguments.data is None:
        for flag in ("outputs", "inputs", "time_column", "time_unit", "truth"):
            if getattr(arguments, flag) is not None:
                flag = flag.replace("_", "-")
                raise ValueError(f"--{flag} is about a data file; give one with --data.")
        return model.simulate(**options)
    observed = read_data(arguments.data, model, arguments)
    if arguments.truth is not None:
        observed = dataclasses.replace(observed, truth=read_truth(arguments.truth))
    return model.prepare(observed)


def _print_task(
    arguments: argparse.Namespace,
    model: loading.ModelFile,
    observed: Data,
    options: dict[str, Any],
    fixed: dict[str, Any],
) -> None:
    source = arguments.data or "simulated by the model"
    count = np.isnan(observed.y).reshape(-1, len(observed.outputs)).sum(axis=0)
    missing, rows = int(count.sum()), observed.y[..., 0].size
    where = "" if len(count) == 1 else " (" + ", ".join(
        f"{'all' if number == rows else number} of {name}"
        for number, name in zip(count, observed.outputs, strict=True) if number) + ")"
    size = f"{len(observed.times)} rows of {', '.join(observed.outputs)}"
    print(f"model    {model.name}: {model.summary}" if model.summary else f"model    {model.name}")
    print(f"data     {source}: {size}" + (f"; {missing} values missing{where}" if missing else ""))
    for name in np.array(observed.outputs)[count == rows]:
        print(f"note     {name} has no value: its own parameters follow the prior")
    if observed.inputs:
        print("inputs   " + ", ".join(f"{name} ({table.interpolation})" for name, table in observed.inputs.items()))
    if observed.origin is not None:
        print(f"time     in {observed.units['time']} since {observed.origin.replace('T', ' ')}")
    for flag, sign, bounds in (("--lower", ">=", arguments.lower), ("--upper", "<=", arguments.upper)):
        where = "" if arguments.grid is None else f" at {arguments.grid} times"
        for name, value in (choices.bounds(flag, bounds) or {}).items():
            print(f"bound    {name} {sign} {value:g}{where}")
    if options:
        print("options  " + ", ".join(f"{name} = {value}" for name, value in options.items()))
    anchors = model.anchors(observed)
    for name, value in fixed.items():
        is_anchor = name in anchors and anchors[name] == value
        free = f" by the model; --set {name}=free frees it" if is_anchor else ""
        print(f"fixed    {name} = {value}{free}")
    if observed.note:
        print(f"note     {observed.note}")
    if arguments.sampler != "map":
        warmup = "" if arguments.warmup is None else f" {arguments.warmup} warm-up and"
        size = f"{arguments.chains} chains of{warmup} {arguments.samples or 1000} kept draws"
        print(f"sampler  {arguments.sampler}, {size}")
    sys.stdout.flush()


def _check_fixed(numpyro_model: Any, observed: Data, keywords: dict[str, Any], fixed: dict[str, Any]) -> None:
    from lfm_ppl.inference.bind import bind

    with calendar_time.in_messages(observed.origin, observed.units.get("time", "")):
        bind(numpyro_model, observed.times, observed.y, **keywords).fix(fixed)


def sample(
    arguments: argparse.Namespace,
    model: loading.ModelFile,
    numpyro_model: Any,
    observed: Data,
    options: dict[str, Any],
    fixed: dict[str, Any],
    folder: Path,
    requested_times: np.ndarray | None = None,
) -> Any:
    """Return the ArviZ object of a fit; an unfinished run stays in the folder."""
    import lfm_ppl

    return lfm_ppl.fit(
        numpyro_model,
        observed,
        seed=arguments.seed,
        at=requested_times,
        model_kwargs=model.keywords(observed, options),
        fixed=fixed,
        progress=not arguments.quiet,
        name=model.name,
        checkpoint=folder,
        resume=arguments.resume,
        overwrite=arguments.overwrite,
        attributes=result_attributes(arguments, model, observed, options),
        **sampling_arguments(arguments, model),
    )


def report(posterior: Any, folder: Path, seconds: float, overwrite: bool) -> int:
    """Write and print the results, without figures if they are partial; return 1 if figures or report failed."""
    from lfm_ppl.results import arviz_data, files, tables
    from lfm_ppl.results.plots import save_figures
    from lfm_ppl.results.residuals import misfit

    # A checkpoint has written a partial or complete result under this name.
    written = [arviz_data.save(posterior, folder / files.POSTERIOR, overwrite=True)]
    table = arviz_data.summary(posterior)
    written.append(tables.write_csv(tables.annotated(table, posterior), folder / results.SUMMARY, overwrite))
    print(f"\n{tables.text_table(table, width=shutil.get_terminal_size().columns)}\n")
    status = 0
    attrs = arviz_data.attributes(posterior)
    for message in misfit(posterior):
        print(f"note     {message}")
    figures: list[Path] = []
    try:
        if "partial" not in attrs:
            figures = save_figures(posterior, folder, overwrite=overwrite)
            written += figures
    except Exception as error:  # the draws are saved
        print(f"lfm-ppl: the figures could not be drawn: {error}", file=sys.stderr)
        print(f"         try again with: lfm-ppl plot {folder} --overwrite", file=sys.stderr)
        status = 1
    if "log_likelihood_sd" in attrs:
        print(f"particles {attrs['particles']}; the log likelihood estimate has a standard deviation of "
              f"{attrs['log_likelihood_sd']:.2f} (near 1 is best)")
    total_seconds = float(attrs.get("wall_time_s", 0.0))
    earlier_time = (
        f", and {duration(total_seconds - seconds)} before it was stopped"
        if total_seconds > 1.05 * seconds + 1.0
        else ""
    )
    print(f"time     {seconds:.0f} s{earlier_time}")
    for path in written:
        print(f"wrote    {path}")
    return max(status, page.save(posterior, folder, overwrite, figures))
