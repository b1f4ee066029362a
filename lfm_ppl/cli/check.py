"""``lfm-ppl check``: the error of the Gaussian filter in a saved posterior, and the corrected posterior.

1. Rebuild the model and the data from the stored result.
2. Compare the log likelihood of the filter with a reference at draws of the posterior (`lfm_ppl.check_accuracy`).
3. Print the report, and store it in the result, as a table and as a figure.
4. With --correct: resample the draws where their weights are reliable, else run exact chains.
"""

from __future__ import annotations

import contextlib
import shlex
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lfm_ppl
from lfm_ppl.accuracy import log_likelihoods
from lfm_ppl.accuracy.check_accuracy import check_accuracy
from lfm_ppl.accuracy.correction import correct_posterior
from lfm_ppl.accuracy.report import GROUP, AccuracyReport
from lfm_ppl.accuracy.verdict import CORRECT
from lfm_ppl.cli import fit, folders, pages, session
from lfm_ppl.cli.fit_arguments import TIME_UNIT
from lfm_ppl.cli.options import CheckOptions
from lfm_ppl.cli.stored_fit import StoredFit, rebuild_fit
from lfm_ppl.inference.trajectories import evenly_spaced
from lfm_ppl.report import html_report
from lfm_ppl.results import arviz_data, rebuilding, tables
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.results.series import times_of
from lfm_ppl.storage import checkpoint, files
from lfm_ppl.utils import atomic_files
from lfm_ppl.utils.interruption import INTERRUPTED, interruptible

TABLE = "accuracy.csv"
FIGURE = "accuracy.png"
CORRECTED = "corrected"
UNFINISHED = "unfinished-check"
"""Folder beside the result that stores log likelihoods until the check is complete."""

_DRAWS, _DRAWS_TO_CORRECT = 200, 1000
_CHAINS, _WARMUP, _SAMPLES = 4, 500, 500
"""Settings of the chains that correct a result of the sampler map, which has no chains."""

_RECORD = ("model_file", "settings", "options", "data", "note", "time_origin", "description", TIME_UNIT)


def run(result: str, options: CheckOptions, line: Sequence[str]) -> int:
    """Print the accuracy report, store it beside and in the result, and write the corrected result if asked."""
    path = files.locate(result)
    posterior = arviz_data.load(path)
    settled = _settled_report(posterior, options)
    replace = options.overwrite or options.resume
    for name in (TABLE, FIGURE) if settled is None else ():
        atomic_files.refuse_existing(path.parent / name, replace)
    html_report.refuse_foreign(path.parent / html_report.NAME, options.overwrite)
    folders.check_writable(path.parent)
    session.start(int(posterior.attrs.get("chains", 1)), not options.no_cache)
    task = rebuild_fit(posterior, options.model, path)
    command, resume = pages.command_line(line), pages.command_line(line, "--resume")
    with contextlib.ExitStack() as stack:
        folder = None
        if options.correct:
            out = options.out or str(path.parent / CORRECTED)
            folder = stack.enter_context(folders.folder(task.name, out, replace))
            checkpoint.check_folder(folder, options.resume, options.overwrite)
        stack.enter_context(interruptible(lambda: f"resume with: {resume}"))
        report = settled or check_accuracy(
            posterior, task.model, reference=options.reference,
            draws=options.draws or (_DRAWS_TO_CORRECT if options.correct else _DRAWS), particles=options.particles,
            model_kwargs=task.keywords, seed=options.seed, progress=not options.quiet,
            checkpoint=path.parent / UNFINISHED, resume=options.resume)
        for message in arviz_data.convergence_warnings(posterior):
            warnings.warn(f"the draws that are checked: {message}", stacklevel=1)
        if settled is None:
            print(f"\n{report.text(command=False)}\n")
            status = _write(report, posterior, path, command)
        else:
            _check_likelihood(task)
            print(f"checked  before: k = {report.k:.4g} is not below {report.threshold:.4g}, so that no weights of "
                  "draws can correct this posterior (--draws N checks again)")
            status = 0
        if folder is not None and report.exact:
            print("the filter is exact: there is nothing to correct")
        elif folder is not None:
            # The report of the result again, with a link to the corrected result.
            status = max(status, _correct(posterior, task, report, options, folder, command),
                         pages.update(arviz_data.load(path), path.parent))
            if status != INTERRUPTED:
                method = "draws weighted by the exact likelihood" if report.reliable else "particle-marginal RAM"
                print(f"done     the corrected posterior ({method}) is in {folder}")
        elif report.verdict.command:  # last, where it is seen
            print(f"next     {report.verdict.command.replace('RESULT', shlex.quote(result))}")
        if status == INTERRUPTED:
            print(f"resume   {resume}")
        else:
            checkpoint.remove_run(path.parent / UNFINISHED)
        return status


def _settled_report(posterior: Any, options: CheckOptions) -> AccuracyReport | None:
    """Return the stored report if it requires new chains, so that a new check would be wasted; else None."""
    is_new_check = not options.correct or options.draws is not None or options.reference != "auto"
    view = ResultView.of(posterior)
    if is_new_check or GROUP not in view.groups:
        return None
    report = AccuracyReport.of(view)
    needs_chains = any(remedy.startswith(CORRECT) for remedy in report.verdict.remedies)
    return report if not report.reliable and needs_chains else None


def _check_likelihood(task: StoredFit) -> None:
    """Raise ValueError if the log likelihood at a draw of each chain differs from the stored one."""
    sizes = task.view.posterior.sizes
    draw_indices, rows = evenly_spaced(sizes["chain"], sizes["draw"], 1)
    problem = rebuilding.problem(task.view, task.model, model_kwargs=task.keywords).select(rows)
    values = log_likelihoods.recorded(problem, log_likelihoods.gaussian(problem))
    rebuilding.check_likelihood(task.view, values.reshape(sizes["chain"], len(draw_indices)), draw_indices)


def _write(report: AccuracyReport, posterior: Any, path: Path, command: str) -> int:
    """Store the report in the result and beside it; return 1 if the figure or the page fails."""
    from lfm_ppl.plots import plot_accuracy

    # Load the file again: another process may have added to it.
    stored = arviz_data.add_group(arviz_data.load(path), GROUP, report.to_dataset().assign_attrs(command_line=command))
    print(f"wrote    {arviz_data.save(stored, path, overwrite=True)} (group {GROUP})")
    print(f"wrote    {tables.write_csv(report.table, path.parent / TABLE, overwrite=True)}")
    return pages.draw(plot_accuracy, posterior, path.parent / FIGURE, True) or pages.update(stored, path.parent)


def _correct(posterior: Any, task: StoredFit, report: AccuracyReport, options: CheckOptions, folder: Path,
             command: str) -> int:
    """Write the corrected result: by resampling where the weights are reliable, else by new chains."""
    start_time = time.perf_counter()
    if report.reliable:
        note = " (no chains are needed, and none are delayed)" if options.delayed else ""
        print(f"correct  resampling {report.log_weight.size} draws, worth {report.ess:.0f} after weighting{note}")
        corrected = correct_posterior(posterior, task.model, model_kwargs=task.keywords, seed=options.seed)
    else:
        corrected = _exact_chains(task, options, folder)
    first = task.view.attrs.get("command_line")
    corrected.attrs["command_line"] = "\n".join([*([first] if first else []), command])
    status = fit.report(corrected, folder, time.perf_counter() - start_time, options.overwrite or options.resume)
    partial = corrected.attrs.get("partial")
    if partial is None:
        return status
    print(f"partial  {partial}")
    return INTERRUPTED


def _exact_chains(task: StoredFit, options: CheckOptions, folder: Path) -> Any:
    """Sample the exact posterior by particle-marginal RAM.

    Where the weights fail, the filter's likelihood is too small in a part of the posterior, and delayed acceptance,
    which screens proposals with it, mixes worse than it saves; so it is left to the user.
    """
    attrs = task.view.attrs
    chains, warmup, samples = (_CHAINS, _WARMUP, _SAMPLES) if attrs.get("sampler") == "map" else (
        int(attrs[name]) for name in ("chains", "warmup", "samples"))
    if attrs.get("init") == "laplace":  # the short warm-up of NUTS is too short for a random walk
        warmup = max(warmup, _WARMUP)
    trajectory_times = None
    if "trajectories" in task.view.groups:
        trajectory_times = times_of(task.view.groups["trajectories"]).values
    kind = ", delayed acceptance" if options.delayed else ""
    print(f"correct  particle-marginal RAM{kind}, {chains} chains of {warmup} warm-up and {samples} kept draws",
          flush=True)
    particles = {} if options.particles is None else {"particles": options.particles}
    corrected = lfm_ppl.fit(
        task.model, task.observed, sampler="pmmh", sampler_options={"delayed": options.delayed, **particles},
        chains=chains, warmup=warmup, samples=samples, seed=options.seed, at=trajectory_times,
        trajectory_draws=0 if trajectory_times is None else 400, model_kwargs=task.keywords,
        fixed=task.view.decoded("fixed"), name=task.name, progress=not options.quiet,
        checkpoint=folder, resume=options.resume, overwrite=options.overwrite,
        attributes={name: attrs[name] for name in _RECORD if name in attrs})
    if "truth" in task.view.groups:
        arviz_data.add_group(corrected, "truth", task.view.groups["truth"])
    return corrected
