"""``lfm-ppl fit``: from a model and data to posterior, summary and figures."""

from __future__ import annotations

import argparse
import dataclasses
import json
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from lfm_ppl import data, loading
from lfm_ppl.cli import choices, fit_many, results, session

SETTINGS = ("rule", "steps", "max_step", "iterations", "tolerance")
"""Flags of the approximation; None where the user leaves one to the model."""

_GRID = 241
"""Times of the trajectories with --until, besides those of the data: enough for a smooth line."""


def run(arguments: argparse.Namespace) -> int:
    """Fit, print the summary, and write the results; the posterior is on disk before any figure."""
    if arguments.each or arguments.series is not None:
        return fit_many.run(arguments)
    if arguments.jobs is not None or arguments.scheduler is not None:
        raise ValueError("--jobs and --scheduler are for many data sets; give them with --each or --series.")
    session.start(arguments.chains, not arguments.no_cache)
    model = loading.load(arguments.model)
    options = choices.options(model, arguments.option)
    observed = _observed(arguments, model, options)
    fixed = choices.fixed(arguments.set, model.anchors(observed))
    at = requested(observed.times, arguments.until)
    check_sampler(arguments)
    with results.folder(model.name, arguments.out, arguments.overwrite) as folder:
        _print_task(arguments, model, observed, options, fixed)
        started = time.perf_counter()
        posterior = sample(arguments, model, observed, options, fixed, at)
        seconds = time.perf_counter() - started
        return report(posterior, folder, seconds, arguments.overwrite)


def check_sampler(arguments: argparse.Namespace) -> None:
    """Raise ValueError for a setting of another sampler."""
    if arguments.target_accept is not None and arguments.sampler == "map":
        raise ValueError("--target-accept is for the samplers nuts, ram and pmmh; map accepts and rejects nothing.")
    if arguments.particles is not None and arguments.sampler != "pmmh":
        raise ValueError(f"--particles is for the sampler pmmh; {arguments.sampler} uses none.")


def _observed(arguments: argparse.Namespace, model: loading.ModelFile, options: dict[str, Any]) -> data.Data:
    """Return the data to fit: the user's file as the model takes it, or the model's own."""
    if arguments.data is None:
        for flag in ("outputs", "time_column", "truth"):
            if getattr(arguments, flag) is not None:
                flag = flag.replace("_", "-")
                raise ValueError(f"--{flag} says how to read a data file; give one with --data.")
        return model.simulate(**options)
    observed = taken(model, data.read_csv(arguments.data, columns(arguments, model), arguments.time_column))
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
                f"{model.name} has {len(model.outputs)} outputs ({', '.join(model.outputs)}); "
                f"--outputs names {len(columns)} columns."
            )
    return columns


def taken(model: loading.ModelFile, observed: data.Data) -> data.Data:
    """Return observations under the model's names of its outputs."""
    return observed if model.outputs is None else dataclasses.replace(observed, outputs=model.outputs)


def requested(times: np.ndarray, until: float | None) -> np.ndarray | None:
    """Return the times of the trajectories where they go beyond the data; None: the library's own grid."""
    if until is None:
        return None
    if not (np.isfinite(until) and until > times[-1]):
        raise ValueError(f"--until takes a time after the last observation, at {times[-1]:g}, got {until:g}.")
    return np.union1d(np.linspace(times[0], until, _GRID), times)


def _print_task(
    arguments: argparse.Namespace,
    model: loading.ModelFile,
    observed: data.Data,
    options: dict[str, Any],
    fixed: dict[str, Any],
) -> None:
    source = arguments.data or "simulated by the model"
    missing = int(np.isnan(observed.y).sum())
    size = f"{len(observed.times)} rows of {', '.join(observed.outputs)}"
    print(f"model    {model.name}: {model.summary}" if model.summary else f"model    {model.name}")
    print(f"data     {source}: {size}" + (f"; {missing} values missing" if missing else ""))
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
        size = f"{arguments.chains} chains of {arguments.warmup} warm-up and {arguments.samples} kept draws"
        print(f"sampler  {arguments.sampler}, {size}")
    sys.stdout.flush()


def sample(
    arguments: argparse.Namespace,
    model: loading.ModelFile,
    observed: data.Data,
    options: dict[str, Any],
    fixed: dict[str, Any],
    at: np.ndarray | None = None,
) -> Any:
    """Return the ArviZ object of a fit, with a record of the options and the data.

    Args:
        arguments: the sampler's and the approximation's settings.
        model: what to fit.
        observed: the data, as the model takes them.
        options: the model's options.
        fixed: parameters that are not learnt.
        at: times of the trajectories; None: a grid over the data.
    """
    import lfm_ppl

    posterior = lfm_ppl.fit(
        approximated(arguments, model),
        observed.times,
        observed.y,
        seed=arguments.seed,
        at=at,
        model_kwargs=model.keywords(observed, options),
        fixed=fixed,
        truth=observed.truth,
        progress=not arguments.quiet and sys.stderr.isatty(),  # in a log file a bar is noise
        name=model.name,
        **sampling(arguments, model),
    )
    # What `lfm-ppl check` rebuilds the model from, in the words of the command line.
    posterior.attrs["model_file"] = model.name if loading.available().get(model.name) == model.path else str(model.path)
    posterior.attrs["settings"] = json.dumps({name: getattr(arguments, name) for name in SETTINGS})
    posterior.attrs["options"] = json.dumps(options)
    posterior.attrs["data"] = arguments.data or "simulated"
    if observed.note:
        posterior.attrs["note"] = observed.note
    return posterior


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
    )


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
        "sampler_options": {name: value for name, value in given if value is not None},
    }


def report(posterior: Any, folder: Path, seconds: float, overwrite: bool) -> int:
    """Write and print everything; return 1 where a figure could not be drawn."""
    from lfm_ppl.results import arviz_data, files, tables
    from lfm_ppl.results.plots import save_figures

    written = [arviz_data.save(posterior, folder / files.POSTERIOR, overwrite)]
    table = arviz_data.summary(posterior)
    written.append(tables.write_csv(table, folder / results.SUMMARY, overwrite))
    print(f"\n{tables.text_table(table, width=shutil.get_terminal_size().columns)}\n")
    status = 0
    try:
        written += save_figures(posterior, folder, overwrite=overwrite)
    except Exception as error:  # the draws are safe; a figure is no reason to end with an error
        print(f"lfm-ppl: the figures could not be drawn: {error}", file=sys.stderr)
        print(f"         try again with: lfm-ppl plot {folder} --overwrite", file=sys.stderr)
        status = 1
    attrs = arviz_data.attributes(posterior)
    if "log_likelihood_sd" in attrs:
        print(f"particles {attrs['particles']}; the log likelihood estimate has a standard deviation of "
              f"{attrs['log_likelihood_sd']:.2f} (near 1 is best)")
    print(f"time     {seconds:.0f} s")
    for path in written:
        print(f"wrote    {path}")
    return status
