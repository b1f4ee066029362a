"""``lfm-ppl check``: the error of the Gaussian filter in a saved posterior, and the corrected posterior.

1. Rebuild the model and the data from the stored result.
2. Compare the log likelihood of the filter with a reference at draws of the posterior (`lfm_ppl.check_accuracy`).
3. Print the report, and store it in the result, as a table and as a figure.
4. With --correct: resample the draws where their weights are reliable, else run exact chains.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import shlex
import sys
import time
import warnings
from pathlib import Path
from typing import Any

from lfm_ppl.cli import fit, page, results, session
from lfm_ppl.cli.stored_fit import StoredFit, rebuild_fit
from lfm_ppl.utils import atomic_files
from lfm_ppl.utils.interruption import INTERRUPTED, Watch, watched

TABLE = "accuracy.csv"
FIGURE = "accuracy.png"
CORRECTED = "corrected"
UNFINISHED = "unfinished-check"
"""Folder beside the result that stores log likelihoods until the check is complete."""

_DRAWS, _DRAWS_TO_CORRECT = 200, 1000
_CHAINS, _WARMUP, _SAMPLES = 4, 500, 500
"""Settings of the chains that correct a result of the sampler map, which has no chains."""

_RECORD = ("model_file", "settings", "options", "data", "note", "time_origin", "description")


def run(arguments: argparse.Namespace) -> int:
    """Print the accuracy report, store it beside and in the result, and write the corrected result if asked."""
    from lfm_ppl.results import arviz_data, checkpoint, files

    if not arguments.correct:
        if arguments.out is not None:
            raise ValueError("--out names the folder of the corrected result; add --correct.")
        if arguments.delayed:
            raise ValueError("--delayed is a setting of the corrected result; add --correct.")
    if arguments.resume and arguments.overwrite:
        raise ValueError("--resume continues a check, --overwrite starts a new one; give one of them.")
    path = files.locate(arguments.result)
    posterior = arviz_data.load(path)
    settled = _settled(posterior, arguments)
    if settled is None:
        for name in (TABLE, FIGURE):
            atomic_files.refuse_existing(path.parent / name, arguments.overwrite or arguments.resume)
    page.refuse_foreign(path.parent, arguments.overwrite)
    results.writable(path.parent)
    session.start(int(arviz_data.attributes(posterior).get("chains", 1)), not arguments.no_cache)
    task = rebuild_fit(posterior, arguments.model, path)
    with contextlib.ExitStack() as stack:
        folder = None
        if arguments.correct:
            out = arguments.out or str(path.parent / CORRECTED)
            folder = stack.enter_context(results.folder(task.name, out, arguments.overwrite, arguments.resume))
            checkpoint.check_folder(folder, arguments.resume, arguments.overwrite)
        resume_hint = f"resume with: {_resume_command(arguments)}"
        watch = stack.enter_context(watched(lambda: resume_hint))
        try:
            report = settled or _checked(task, arguments, path.parent / UNFINISHED)
            for message in arviz_data.convergence_warnings(posterior):
                warnings.warn(f"the draws that are checked: {message}", stacklevel=1)
            if settled is None:
                print(f"\n{report.text(command=False)}\n")
                status = _write(report, task.posterior, path, page.command_line(arguments))
            else:
                _refuse_other(task)
                print(f"checked  before: k = {report.k:.4g} is not below {report.threshold:.4g}, so that no weights of "
                      "draws can correct this posterior (--draws N checks again)")
                status = 0
            if folder is not None and report.exact:
                print("the filter is exact: there is nothing to correct")
            elif folder is not None:
                status = max(status, _correct(task, report, arguments, folder, watch))
                # Again, with a link to the corrected result.
                status = max(status, page.update(arviz_data.load(path), path.parent))
                if status != INTERRUPTED:
                    way = "draws weighted by the exact likelihood" if report.reliable else "particle-marginal RAM"
                    print(f"done     the corrected posterior ({way}) is in {folder}")
            if folder is None and (command := report.verdict.command):
                # Last, where it is seen.
                print(f"next     {command.replace('RESULT', shlex.quote(arguments.result))}")
        except KeyboardInterrupt as error:
            print(f"\nlfm-ppl: {str(error) or 'stopped'}; {resume_hint}", file=sys.stderr)
            return INTERRUPTED
        if status == INTERRUPTED:
            print(f"resume   {_resume_command(arguments)}")
        else:
            checkpoint.remove_run(path.parent / UNFINISHED)
        return status


def _settled(posterior: Any, arguments: argparse.Namespace) -> Any:
    """Return the stored report if it requires new chains, so that a new check would be wasted; else None."""
    from lfm_ppl.results import arviz_data
    from lfm_ppl.results.report import GROUP, AccuracyReport
    from lfm_ppl.results.verdict import CORRECT

    asked_anew = arguments.draws is not None or arguments.reference != "auto"
    if not arguments.correct or asked_anew or not arviz_data.has_group(posterior, GROUP):
        return None
    report = AccuracyReport.of(posterior)
    is_chains = any(remedy.startswith(CORRECT) for remedy in report.verdict.remedies)
    return report if not report.reliable and is_chains else None


def _refuse_other(task: StoredFit) -> None:
    """Raise ValueError if the log likelihood at a draw of each chain differs from the stored one."""
    from lfm_ppl.inference.posterior import evenly_spaced
    from lfm_ppl.results import arviz_data, likelihoods, rebuilding

    posterior = arviz_data.group(task.posterior, "posterior")
    chains = posterior.sizes["chain"]
    draw_indices, rows = evenly_spaced(chains, posterior.sizes["draw"], 1)
    problem = rebuilding.problem(task.posterior, task.model, model_kwargs=task.keywords).select(rows)
    log_likelihoods = likelihoods.recorded(problem, likelihoods.gaussian(problem))
    rebuilding.check_likelihood(task.posterior, log_likelihoods.reshape(chains, len(draw_indices)), draw_indices)


def _resume_command(arguments: argparse.Namespace) -> str:
    """Return the command that resumes this check."""
    return shlex.join(["lfm-ppl", *(word for word in arguments.line if word not in ("--overwrite", "--resume")),
                       "--resume"])


def _checked(task: StoredFit, arguments: argparse.Namespace, folder: Path) -> Any:
    from lfm_ppl.results.accuracy import check_accuracy

    return check_accuracy(
        task.posterior,
        task.model,
        reference=arguments.reference,
        draws=arguments.draws or (_DRAWS_TO_CORRECT if arguments.correct else _DRAWS),
        particles=arguments.particles,
        model_kwargs=task.keywords,
        seed=arguments.seed,
        progress=not arguments.quiet,
        checkpoint=folder,
        resume=arguments.resume,
    )


def _write(report: Any, posterior: Any, path: Path, command_line: str) -> int:
    """Store the report in the result and beside it; return 1 where figure or page could not be made."""
    from lfm_ppl.results import arviz_data, tables
    from lfm_ppl.results.plots import plot_accuracy
    from lfm_ppl.results.report import GROUP

    # Load the file again: another process may have added to it.
    report_group = report.to_dataset().assign_attrs(command_line=command_line)
    stored = arviz_data.add_group(arviz_data.load(path), GROUP, report_group)
    print(f"wrote    {arviz_data.save(stored, path, overwrite=True)} (group {GROUP})")
    print(f"wrote    {tables.write_csv(report.table, path.parent / TABLE, overwrite=True)}")
    try:
        figure = plot_accuracy(posterior, width="full")
        with atomic_files.atomic_write(path.parent / FIGURE, overwrite=True) as temporary:
            figure.savefig(temporary, format="png")
    except Exception as error:  # the numbers are safe
        print(f"lfm-ppl: the figure could not be drawn: {error}", file=sys.stderr)
        return 1
    print(f"wrote    {path.parent / FIGURE}")
    return page.update(stored, path.parent)


def _correct(task: StoredFit, report: Any, arguments: argparse.Namespace, folder: Path, watch: Watch | None) -> int:
    """Write the corrected result: by resampling where the weights are reliable, else by new chains."""
    from lfm_ppl.results import arviz_data
    from lfm_ppl.results.correction import correct_posterior

    started = time.perf_counter()
    if report.reliable:
        print(f"correct  resampling {report.log_weight.size} draws, worth {report.ess:.0f} after weighting"
              + (" (no chains are needed, and none are delayed)" if arguments.delayed else ""))
        corrected = correct_posterior(task.posterior, task.model, model_kwargs=task.keywords, seed=arguments.seed)
    else:
        corrected = _exact_chains(task, arguments, folder)
    partial = arviz_data.attributes(corrected).get("partial")
    if partial is not None and watch is not None:
        watch.dismiss()
    first = arviz_data.attributes(task.posterior).get("command_line")
    corrected.attrs["command_line"] = "\n".join([*([first] if first else []), page.command_line(arguments)])
    status = fit.report(corrected, folder, time.perf_counter() - started, arguments.overwrite or arguments.resume)
    if partial is None:
        return status
    print(f"partial  {partial}")
    return INTERRUPTED


def _exact_chains(task: StoredFit, arguments: argparse.Namespace, folder: Path) -> Any:
    """Sample the exact posterior by particle-marginal RAM.

    Where the weights fail, the filter's likelihood is too small in a part of the posterior, and delayed acceptance,
    which screens proposals with it, mixes worse than it saves; so it is left to the user.
    """
    import lfm_ppl
    from lfm_ppl.results import arviz_data

    attrs = arviz_data.attributes(task.posterior)
    mode = attrs.get("sampler") == "map"
    chains, warmup, samples = ((_CHAINS, _WARMUP, _SAMPLES) if mode else
                               (int(attrs[name]) for name in ("chains", "warmup", "samples")))
    if attrs.get("init") == "laplace":  # the short warm-up of NUTS is too short for a random walk
        warmup = max(warmup, _WARMUP)
    trajectory_times = None
    if arviz_data.has_group(task.posterior, "trajectories"):
        trajectory_times = arviz_data.group(task.posterior, "trajectories")["at"].values
    kind = ", delayed acceptance" if arguments.delayed else ""
    print(f"correct  particle-marginal RAM{kind}, {chains} chains of {warmup} warm-up and {samples} kept draws",
          flush=True)
    options: dict[str, Any] = {"delayed": arguments.delayed}
    if arguments.particles is not None:
        options["particles"] = arguments.particles
    corrected = lfm_ppl.fit(
        task.model, task.observed, sampler="pmmh", sampler_options=options, chains=chains, warmup=warmup,
        samples=samples, seed=arguments.seed, at=trajectory_times,
        trajectory_draws=0 if trajectory_times is None else 400,
        model_kwargs=task.keywords,
        fixed=json.loads(attrs.get("fixed") or "{}"), name=task.name, progress=not arguments.quiet,
        checkpoint=folder, resume=arguments.resume, overwrite=arguments.overwrite,
        attributes={name: attrs[name] for name in _RECORD if name in attrs},
    )  # fmt: skip
    if arviz_data.has_group(task.posterior, "truth"):
        arviz_data.add_group(corrected, "truth", arviz_data.group(task.posterior, "truth"))
    return corrected

