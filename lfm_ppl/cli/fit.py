"""``lfm-ppl fit``: from a model and data to posterior, summary and figures."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import shlex
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from lfm_ppl.cli import choices, fit_many, forecast, page, results, session
from lfm_ppl.cli.interruption import INTERRUPTED, watched
from lfm_ppl.io import data, loading
from lfm_ppl.utils import calendar_time, checks
from lfm_ppl.utils.progress import duration

SETTINGS = ("rule", "steps", "max_step", "iterations", "tolerance")
"""Flags of the approximation; None where the user leaves one to the model."""

_GRID = 241
"""Times of the trajectories with --until or --at, besides those of the data: enough for a smooth line."""


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
    at = requested(observed, arguments.until, arguments.at)
    check_sampler(arguments)
    numpyro_model = approximated(arguments, model)
    if arguments.resume and arguments.out is None:
        raise ValueError("--resume goes on with the run in a folder; name the folder with --out.")
    if arguments.resume and arguments.overwrite:
        raise ValueError("--resume goes on with the run in a folder, --overwrite begins another one; choose one.")
    if arguments.out is not None:  # first, because it knows of runs that can be gone on with
        checkpoint.check_folder(arguments.out, arguments.resume, arguments.overwrite)
    with results.folder(model.name, arguments.out, arguments.overwrite, arguments.resume) as folder:
        finished = arguments.resume and checkpoint.is_finished(folder)
        if arguments.resume and not finished and not checkpoint.is_kept(folder):
            print(f"resume   there is nothing to go on with in {folder}: this is a new run")
        if arguments.set:  # a name that the model does not have must not be printed as fixed
            _check_fixed(numpyro_model, observed, model.keywords(observed, options), fixed)
        _print_task(arguments, model, observed, options, fixed)
        started = time.perf_counter()
        go_on = f"go on with: {_again(arguments, folder)}"
        with watched(lambda: go_on if checkpoint.is_kept(folder) else _nothing_left(folder)) as watch:
            try:
                posterior = sample(arguments, model, numpyro_model, observed, options, fixed, folder, at)
            except KeyboardInterrupt as error:
                said = str(error) or "stopped before there were draws"
                print(f"\nlfm-ppl: {said}" + (f"; {go_on}" if checkpoint.is_kept(folder) else ""), file=sys.stderr)
                return INTERRUPTED
            partial = arviz_data.attributes(posterior).get("partial")
            if watch is not None and partial is not None:
                watch.answered()
            # The page is written last, so that a run that was killed at its figures draws them now.
            if finished and partial is None and page.exists(folder):
                print(f"\nthe run in {folder} is finished; nothing was changed")
                return 0
            seconds = time.perf_counter() - started
            status = report(posterior, folder, seconds, arguments.overwrite or arguments.resume)
        if partial is None:
            return status
        print(f"partial  {partial}\nresume   {_again(arguments, folder)}")
        return INTERRUPTED


def _again(arguments: argparse.Namespace, folder: Path) -> str:
    """Return the command that goes on with this run."""
    line = [word for word in arguments.line if word not in ("--overwrite", "--resume")]
    if arguments.out is None:
        line += ["--out", str(folder)]
    return shlex.join(["lfm-ppl", *line, "--resume"])


def _nothing_left(folder: Path) -> str:
    from lfm_ppl.results.files import POSTERIOR

    if (folder / POSTERIOR).is_file():
        return f"the result is whole; draw its figures with: lfm-ppl plot {folder} --overwrite"
    with contextlib.suppress(OSError):  # raised where it is not empty
        folder.rmdir()
    return "nothing was sampled yet"


def check_sampler(arguments: argparse.Namespace) -> None:
    """Raise ValueError for a setting of another sampler."""
    if arguments.target_accept is not None and arguments.sampler == "map":
        raise ValueError("--target-accept is for the samplers nuts, ram and pmmh; map accepts and rejects nothing.")
    if arguments.trajectory_draws == 0 and (arguments.until is not None or arguments.at is not None):
        raise ValueError("--until and --at ask for trajectories, of which --trajectory-draws 0 gives none.")
    if arguments.init is not None and arguments.sampler == "map":
        raise ValueError("--init says where chains start; the sampler map has none, and finds the mode itself.")
    if arguments.particles is not None and arguments.sampler != "pmmh":
        raise ValueError(f"--particles is for the sampler pmmh; {arguments.sampler} uses none.")


def _observed(arguments: argparse.Namespace, model: loading.ModelFile, options: dict[str, Any]) -> data.Data:
    """Return the data to fit: the user's file as the model takes it, or the model's own."""
    if arguments.data is None:
        for flag in ("outputs", "inputs", "time_column", "time_unit", "truth"):
            if getattr(arguments, flag) is not None:
                flag = flag.replace("_", "-")
                raise ValueError(f"--{flag} says how to read a data file; give one with --data.")
        return model.simulate(**options)
    observed = read(arguments.data, model, arguments)
    if arguments.truth is not None:
        observed = dataclasses.replace(observed, truth=data.read_truth(arguments.truth))
    return model.prepare(observed)


def columns(arguments: argparse.Namespace, model: loading.ModelFile) -> tuple[str, ...] | None:
    """Return the columns of a file that are outputs; None: all but the time."""
    columns = model.outputs
    if arguments.outputs is not None:
        columns = tuple(name.strip() for name in arguments.outputs.split(","))
        if model.outputs is not None and len(columns) != len(model.outputs):
            raise ValueError(
                f"{model.name} has {checks.counted(len(model.outputs), 'output')} ({', '.join(model.outputs)}); "
                f"--outputs names {checks.counted(len(columns), 'column')}."
            )
    return columns


def read(path: str, model: loading.ModelFile, arguments: argparse.Namespace) -> data.Data:
    """Return the observations in a file, under the model's names of its outputs and inputs."""
    inputs = choices.inputs(arguments.inputs, model)
    observed = data.read_csv(path, columns(arguments, model), arguments.time_column, dict(inputs.values()),
                             arguments.time_unit, usual_unit=usual_unit(model))
    check_unit(model, observed, path, arguments)
    return taken(model, inputs, observed)


def check_unit(model: loading.ModelFile, observed: data.Data, path: str, arguments: argparse.Namespace) -> None:
    """Raise ValueError where the dates of a file cannot be counted in the unit that the model says."""
    unit = model.units.get("time")
    if observed.origin is not None and unit and usual_unit(model) is None and not arguments.time_unit:
        raise ValueError(f"UNITS of {model.path} says that time is in {unit!r}, in which the dates of {path} cannot be "
                         f"counted. Write one of {', '.join(calendar_time.USUAL)}, or give --time-unit.")


def usual_unit(model: loading.ModelFile) -> str | None:
    """Return the unit in which a model counts time, where it says so: that of dates in a file."""
    unit = model.units.get("time")
    return unit if unit in calendar_time.SECONDS else None


def taken(model: loading.ModelFile, inputs: dict[str, tuple[str, str]], observed: data.Data) -> data.Data:
    """Return observations under the model's names of its outputs and inputs.

    Args:
        model: what takes them.
        inputs: name -> column, interpolation, see `choices.inputs`.
        observed: as read.
    """
    return dataclasses.replace(observed, outputs=model.outputs or observed.outputs,
                               inputs={name: observed.inputs[column] for name, (column, _) in inputs.items()})


def requested(observed: data.Data, until: str | None, at: str | None) -> np.ndarray | None:
    """Return the times of the trajectories where some are asked for; None: the library's own grid."""
    if until is None and at is None:
        return None
    times = observed.times
    wanted = forecast.requested(observed, until, at, 2, times)
    return np.union1d(np.linspace(times[0], max(wanted[-1], times[-1]), _GRID), wanted)


def _print_task(
    arguments: argparse.Namespace,
    model: loading.ModelFile,
    observed: data.Data,
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
        print(f"note     {name} has no value: the data say nothing of what it alone depends on")
    if observed.inputs:
        print("inputs   " + ", ".join(f"{name} ({table.interpolation})" for name, table in observed.inputs.items()))
    if observed.origin is not None:
        print(f"time     in {observed.units['time']} since {observed.origin.replace('T', ' ')}")
    for flag, sign, given in (("--lower", ">=", arguments.lower), ("--upper", "<=", arguments.upper)):
        where = "" if arguments.grid is None else f" at {arguments.grid} times"
        for name, value in (choices.bounds(flag, given) or {}).items():
            print(f"bound    {name} {sign} {value:g}{where}")
    if options:
        print("options  " + ", ".join(f"{name} = {value}" for name, value in options.items()))
    anchors = model.anchors(observed)
    for name, value in fixed.items():
        own = name in anchors and anchors[name] == value
        free = f" by the model; --set {name}=free frees it" if own else ""
        print(f"fixed    {name} = {value}{free}")
    if observed.note:
        print(f"note     {observed.note}")
    if arguments.sampler != "map":
        warmup = "" if arguments.warmup is None else f" {arguments.warmup} warm-up and"
        size = f"{arguments.chains} chains of{warmup} {arguments.samples or 1000} kept draws"
        print(f"sampler  {arguments.sampler}, {size}")
    sys.stdout.flush()


def _check_fixed(numpyro_model: Any, observed: data.Data, keywords: dict[str, Any], fixed: dict[str, Any]) -> None:
    from lfm_ppl.inference.bound_model import bind

    with calendar_time.in_messages(observed.origin, observed.units.get("time", "")):
        bind(numpyro_model, observed.times, observed.y, **keywords).fix(fixed)


def sample(
    arguments: argparse.Namespace,
    model: loading.ModelFile,
    numpyro_model: Any,
    observed: data.Data,
    options: dict[str, Any],
    fixed: dict[str, Any],
    folder: Path,
    at: np.ndarray | None = None,
) -> Any:
    """Return the ArviZ object of a fit, with a record of the options and the data; kept in the folder meanwhile."""
    import lfm_ppl

    return lfm_ppl.fit(
        numpyro_model,
        observed,
        seed=arguments.seed,
        at=at,
        model_kwargs=model.keywords(observed, options),
        fixed=fixed,
        progress=not arguments.quiet,
        name=model.name,
        checkpoint=folder,
        resume=arguments.resume,
        overwrite=arguments.overwrite,
        attributes=attributes(arguments, model, observed, options),
        **sampling(arguments, model),
    )


def attributes(arguments: argparse.Namespace, model: loading.ModelFile, observed: data.Data,
               options: dict[str, Any]) -> dict[str, Any]:
    """Return what a result must remember for `lfm-ppl check` and `forecast`, in the words of the command line."""
    return {
        "model_file": model.name if loading.available().get(model.name) == model.path else str(model.path),
        "settings": json.dumps({name: getattr(arguments, name) for name in SETTINGS} | constraints(arguments)),
        "options": json.dumps(options), "data": arguments.data or "simulated",
        "description": model.description, "meanings": json.dumps(dict(model.parameters)),
        "command_line": page.command_line(arguments),
        **({"note": observed.note} if observed.note else {}),
    }  # fmt: skip


def approximated(arguments: argparse.Namespace, model: loading.ModelFile) -> Any:
    """Return the NumPyro model with the user's settings of the approximation."""
    from lfm_ppl.inference.handlers.settings import approximate

    return approximate(
        model.model,
        rule=choices.rule(arguments.rule),
        steps=arguments.steps,
        max_step=arguments.max_step,
        iterations=arguments.iterations,
        tolerance=arguments.tolerance,
        **constraints(arguments),
    )


def constraints(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the bounds that the user gives, and where they hold; nothing where there are none."""
    given = {"lower": choices.bounds("--lower", arguments.lower), "upper": choices.bounds("--upper", arguments.upper)}
    if given == {"lower": None, "upper": None}:
        if arguments.grid is not None:
            raise ValueError("--grid says at how many times --lower and --upper hold; give one of them with it.")
        return {}
    if arguments.sampler == "pmmh":
        raise ValueError("--lower and --upper are for the samplers nuts, ram and map: the particle filter of pmmh "
                         "knows no constraints.")
    return {name: value for name, value in (given | {"grid": arguments.grid}).items() if value is not None}


def sampling(arguments: argparse.Namespace, model: loading.ModelFile) -> dict[str, Any]:
    """Return the arguments of `lfm_ppl.fit` that say how to sample."""
    target_accept = arguments.target_accept
    if target_accept is None and arguments.sampler == "nuts":
        target_accept = model.target_accept
    given = (("target_accept_prob", target_accept), ("particles", arguments.particles))
    return {
        "sampler": arguments.sampler,
        "chains": arguments.chains,
        "warmup": arguments.warmup,
        "samples": arguments.samples,
        "thin": arguments.thin,
        "trajectory_draws": arguments.trajectory_draws,
        "init": arguments.init,
        "sampler_options": {name: value for name, value in given if value is not None},
    }


def report(posterior: Any, folder: Path, seconds: float, overwrite: bool) -> int:
    """Write and print everything, of a partial result all but figures; return 1 where figures or page failed."""
    from lfm_ppl.results import arviz_data, files, tables
    from lfm_ppl.results.plots import save_figures
    from lfm_ppl.results.residuals import misfit

    # A run that was kept on its way has left a partial result, or the whole one, under this name.
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
    except Exception as error:  # the draws are safe; a figure is no reason to end with an error
        print(f"lfm-ppl: the figures could not be drawn: {error}", file=sys.stderr)
        print(f"         try again with: lfm-ppl plot {folder} --overwrite", file=sys.stderr)
        status = 1
    if "log_likelihood_sd" in attrs:
        print(f"particles {attrs['particles']}; the log likelihood estimate has a standard deviation of "
              f"{attrs['log_likelihood_sd']:.2f} (near 1 is best)")
    whole = float(attrs.get("wall_time_s", 0.0))
    before = f", and {duration(whole - seconds)} before it was stopped" if whole > 1.05 * seconds + 1.0 else ""
    print(f"time     {seconds:.0f} s{before}")
    for path in written:
        print(f"wrote    {path}")
    return max(status, page.save(posterior, folder, overwrite, figures))
