"""The study of transcription factors: settings, tasks and tables.

1. Simulate data sets for eight configurations: a link between force and production, and its parameter gamma.
2. Estimate the force of every data set by six methods, with known rates; a task has up to ten data sets.
3. Score mean and standard deviation of the force on a grid. An estimate with an RMSE above 3 has diverged.
4. Compare the methods with each other, with elliptical slice sampling by pairs, and with the published table.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from scipy.stats import norm

from lfm_ppl.parallel.task import Result, Task

from .. import published, scores
from ..datasets import Column, TaskKind, cell, number, row
from ..declaration import REALISATIONS, Data, Study, StudySettings, StudyTable, setting
from ..published import PublishedComparison
from ..scores import estimate_mean
from ..tasks import dataset_blocks, dataset_indices
from . import approximations, figures, problem, slices

METHODS = ("LA", "ESLS", "GFS", "GHS(7)", "iterated GHS(7)", "LA, trust region")
BLOCK = 10
"""Data sets of one task; a run with more data sets reuses all complete blocks."""

TRUST = (
    "Errors of elliptical slice sampling below the published ones are trusted: it samples the exact posterior of a "
    "linear link and agrees with blackjax's independent elliptical slice sampler on five data sets (both are tests), "
    "and chains with an R-hat above 1.01 continue, up to five times as long (see `mixed` and `ESS`). LA and GFS do not "
    "sample, so that these reasons do not apply to them.")
"""Evidence that lower errors than published are correct."""

_LABELS = tuple(entry.label for entry in problem.CONFIGURATIONS)


@dataclass(frozen=True)
class TranscriptionSettings(StudySettings):
    """Sizes of the study."""

    datasets: int = setting(100, "data sets for each configuration", quick=2, aliases=REALISATIONS)
    draws: int = setting(100_000, "draws of elliptical slice sampling for one data set, summed over chains; the "
                         "source's number", quick=4_000)
    burn_in: int = setting(5_000, "number of initial draws to discard", quick=400, least=0)
    configurations: tuple[str, ...] = setting(_LABELS, "links of the factor", choices=_LABELS)

    def __post_init__(self) -> None:
        """Check the settings."""
        super().__post_init__()
        if not 0 <= self.burn_in < self.draws:
            raise ValueError(f"burn_in must lie in [0, draws) = [0, {self.draws}), got {self.burn_in}.")


def all_tasks(settings: TranscriptionSettings) -> list[Task]:
    """Return all tasks, ordered by data set, so that progress can estimate the remaining time."""
    sampling = {"draws": settings.draws, "burn_in": settings.burn_in}
    return [Task(f"{problem.slug(configuration.label)}/{problem.slug(method)}/{first:03d}-{last:03d}", settings.seed,
                 {"study": "transcription", "method": method, **configuration._asdict(), "first": first,
                  "last": last, **(sampling if method == "ESLS" else {})})
            for first, last in dataset_blocks(settings.datasets, BLOCK)
            for configuration in problem.CONFIGURATIONS if configuration.label in settings.configurations
            for method in METHODS]


def compute(task: Task) -> Result:
    """Return the method's estimates of the force for each data set of the task, and their scores."""
    settings, configuration = task.settings, problem.configuration(task)
    data = [problem.data_set(configuration, index, task.seed) for index in dataset_indices(task)]
    if settings["method"] == "ESLS":
        key = Task(f"{problem.slug(configuration.label)}/ESLS", task.seed).key
        keys = jax.vmap(lambda index: jax.random.fold_in(key, index))(jnp.array(dataset_indices(task)))
        result = slices.compute(settings, data, keys)
    else:
        result = approximations.compute(settings, data)
    return result | score_force(result, np.stack([data_set.u for data_set in data]))


def score_force(result: Result, truth: np.ndarray) -> Result:
    """Return ``rmse``, ``coverage``, ``nlpd`` and ``diverged`` (N,) of means and standard deviations (N, 363).

    For all methods the predictive density of the force at a grid point is normal, with the method's mean and standard
    deviation; the band is the mean +- 1.96 standard deviations.
    """
    mean, sd = result["mean"], np.maximum(result["sd"], 1e-12)
    error = np.nan_to_num(scores.rmse(mean, truth), nan=np.inf, posinf=np.inf)
    stopped = np.asarray(result.get("stopped", True), bool)
    return {"rmse": error, "coverage": scores.interval_coverage(*scores.interval(mean, sd), truth),
            "nlpd": -norm.logpdf(truth, mean, sd).mean(axis=1), "diverged": ~(error <= problem.DIVERGED) | ~stopped}


def _without_divergences(name: str) -> Callable[[xr.Dataset], xr.DataArray]:
    """Return the column of a variable with NaN for diverged data sets."""
    return lambda results: results[name].where(~results.diverged)


ERRORS: dict[str, Column] = {
    "RMSE": _without_divergences("rmse"), "divergences": lambda results: results.diverged.sum(),
    "coverage": _without_divergences("coverage"), "NLPD": _without_divergences("nlpd"), "CPU s": "seconds"}
METHOD_COLUMNS: dict[str, dict[str, Column]] = {
    **dict.fromkeys(approximations.SEARCHES, {"at a mode": lambda results: results.converged.mean()}),
    "iterated GHS(7)": {"last change": lambda results: number(np.max, results.change)},
    "ESLS": {"mixed": lambda results: (results.r_hat <= slices.R_HAT).mean(),
             "mixed at first": lambda results: (results.r_hat_first <= slices.R_HAT).mean(),
             "all CPU s": lambda results: results.seconds + results.seconds_more, "ESS": "ess"}}


def comparison(data: Data) -> dict[str, Any]:
    """Return one row for each configuration and method, with standard errors over data sets.

    Columns of all methods: ``RMSE`` of the force over the grid, without diverged data sets; ``divergences``, the number
    of diverged data sets; ``coverage`` of the 95% band, pooled over data sets and points; ``NLPD``, the negative log
    predictive density of the force at a point; ``CPU s`` for one data set, without compilation.

    Columns of elliptical slice sampling: ``mixed``, the share of data sets whose R-hat is at most 1.01 at every
    monitored grid point; ``mixed at first``, the same after the first stage, whose time is ``CPU s``; ``all CPU s`` of
    all stages; ``ESS``, the smallest effective sample size at these points, of the stored draws.

    Laplace: ``at a mode``, the share of data sets whose search ended at a mode. A search can stop without reaching one.
    Iterated smoother: ``last change``, the largest change of a mean in the last iteration, in standard deviations.
    """
    return {f"{label}: {method}": row(dataset.sel({"method": method}), ERRORS | METHOD_COLUMNS.get(method, {}))
            for label, dataset in data.items() for method in dataset.method.values}


def published_rows(data: Data) -> dict[str, Any]:
    """Return one row for each configuration: our and the published RMSE and divergences of the source's methods.

    ``z`` is the difference of the RMSE in our standard errors; the published mean over 100 data sets has about the same
    standard error. ``verdict`` is the text of `PublishedComparison`. The source averages over the data sets on which no
    method failed, but does not define failures of Newton's method in full. ``at modes`` is ``z`` over the data sets on
    which our search ends at a mode, and ``no mode`` the number of other data sets.
    """
    rows = {}
    for label in (label for label in problem.PUBLISHED if label in data):
        dataset = data[label].assign(rmse=_without_divergences("rmse"))
        at_mode = dataset.converged.sel({"method": "LA"}).values == 1
        cells: dict[str, Any] = {"no mode": float((~at_mode).sum())}
        for method, (error, diverged) in problem.PUBLISHED[label].items():
            ours = dataset.sel({"method": method})
            means = estimate_mean(ours.rmse), estimate_mean(ours.rmse[at_mode])
            z, z_at_modes = ((mean.value - error) / mean.error for mean in means)
            cells |= {**cell(method, ours.rmse), f"{method} published": error, f"{method} z": z,
                      f"{method} verdict": str(PublishedComparison(z)), f"{method} div.": float(ours.diverged.sum()),
                      f"{method} div. published": float(diverged), f"{method} z at modes": z_at_modes}
        rows[label] = cells
    return rows


def paired_rows(data: Data) -> dict[str, Any]:
    """Return one row for each configuration and method: paired comparison with elliptical slice sampling.

    ``RMSE ratio`` is the ratio of means over data sets on which neither method diverged, ``difference`` that of the
    RMSE, with its paired standard error, and ``times as fast`` the ratio of CPU times for one data set.
    """
    rows = {}
    for label, dataset in data.items():
        slicing = dataset.sel({"method": "ESLS"})
        for method in dataset.method.values[dataset.method.values != "ESLS"]:
            comparator = dataset.sel({"method": method})
            is_valid = ~(comparator.diverged | slicing.diverged)
            ours, reference = comparator.rmse.where(is_valid), slicing.rmse.where(is_valid)
            rows[f"{label}: {method}"] = {
                **cell("RMSE ratio", ours.mean() / reference.mean()), **cell("difference", ours - reference),
                **cell("times as fast", slicing.seconds.mean() / comparator.seconds.mean())}
    return rows


def tables(settings: TranscriptionSettings, data: Data) -> dict[str, StudyTable]:
    """Return the tables."""
    count = settings.datasets
    return {"published": StudyTable.from_rows(
                f"RMSE of the force and divergences, {count} data sets, beside the published table",
                published_rows(data)),
            "comparison": StudyTable.from_rows(f"Means over {count} data sets (standard errors)", comparison(data)),
            "paired": StudyTable.from_rows("Against elliptical slice sampling on the same data sets",
                                           paired_rows(data))}


def notes(settings: TranscriptionSettings, data: Data) -> tuple[str, ...]:
    """Return the numbers of cells that are consistent with the published table, and the evidence for lower errors."""
    comparisons = [PublishedComparison(z) for cells in published_rows(data).values() for name, z in cells.items()
                   if name.endswith(" z")]
    return published.summarize_comparisons(comparisons), TRUST


KIND = TaskKind(compute, {
    "dataset time": "mean, sd, low, high", "dataset": "rmse, coverage, nlpd, diverged, seconds, stopped, converged, "
    "iterations, change, r_hat, r_hat_first, ess, draws, seconds_more"}, ("method",))
STUDY = Study(TranscriptionSettings, all_tasks, dict.fromkeys(_LABELS, KIND), tables, figures.draw, notes=notes,
              task_kind=lambda task: problem.configuration(task).label)
