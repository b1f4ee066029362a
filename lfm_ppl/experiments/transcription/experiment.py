"""The study: its settings, tasks and tables."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from scipy.stats import norm

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import published, scores, study
from lfm_ppl.experiments.datasets import Column, TaskKind, cell, number, row
from lfm_ppl.experiments.published import PublishedComparison
from lfm_ppl.experiments.scores import mean_of
from lfm_ppl.experiments.study import Data, Study, StudyTable, setting
from lfm_ppl.experiments.tasks import dataset_blocks, dataset_indices
from lfm_ppl.experiments.transcription import approximations, figures, problem, slices

METHODS = ("LA", "ESLS", "GFS", "GHS(7)", "iterated GHS(7)", "LA, trust region")
BLOCK = 10
"""Data sets that are computed in one go, and stored in one file; a run with more of them uses whole blocks again."""

TRUST = (
    "Where elliptical slice sampling is lower than published it is trusted: it has the exact posterior of a linear "
    "link and agrees with blackjax's independent elliptical slice sampler on five data sets (both are tests), and "
    "chains whose R-hat is above 1.01 go on, up to five times as long (`mixed` and `ESS` say how that ended). This "
    "says nothing of LA and GFS, which draw nothing.")
"""Why a lower error is believed."""

_LABELS = tuple(one.label for one in problem.CONFIGURATIONS)


@dataclass(frozen=True)
class TranscriptionSettings(study.StudySettings):
    """How much is computed."""

    datasets: int = setting(100, "for each configuration", quick=2, aliases=study.REALISATIONS)
    draws: int = setting(100_000, "of elliptical slice sampling for one data set, all chains together; the source's",
                         quick=4_000)
    burn_in: int = setting(5_000, "the first of them, which are left out", quick=400, least=0)
    configurations: tuple[str, ...] = setting(_LABELS, "how the factor acts", choices=_LABELS)

    def __post_init__(self) -> None:
        """Check what a user gives."""
        super().__post_init__()
        if not 0 <= self.burn_in < self.draws:
            raise ValueError(f"burn_in must lie in [0, draws) = [0, {self.draws}), got {self.burn_in}.")


def all_tasks(settings: TranscriptionSettings) -> list[Task]:
    """Return every task: all methods on the first data sets, then on the next, so that the time left can be told."""
    sampling = {"draws": settings.draws, "burn_in": settings.burn_in}
    return [Task(f"{problem.slug(configuration.label)}/{problem.slug(method)}/{first:03d}-{last:03d}", settings.seed,
                 {"experiment": "transcription", "method": method, **configuration._asdict(), "first": first,
                  "last": last, **(sampling if method == "ESLS" else {})})
            for first, last in dataset_blocks(settings.datasets, BLOCK)
            for configuration in problem.CONFIGURATIONS if configuration.label in settings.configurations
            for method in METHODS]


def compute(task: Task) -> Result:
    """Return what the method says of the force of each data set of the task, and how good it is."""
    settings, configuration = task.settings, problem.configuration(task)
    data = [problem.data_set(configuration, index, task.seed) for index in dataset_indices(task)]
    if settings["method"] == "ESLS":
        key = Task(f"{problem.slug(configuration.label)}/ESLS", task.seed).key
        keys = jax.vmap(lambda index: jax.random.fold_in(key, index))(jnp.array(dataset_indices(task)))
        found = slices.compute(settings, data, keys)
    else:
        found = approximations.compute(settings, data)
    return found | judged(found, np.stack([one.u for one in data]))


def judged(found: Result, truth: np.ndarray) -> Result:
    """Return ``rmse``, ``coverage``, ``nlpd`` and ``diverged`` (N,) of means and standard deviations (N, 363).

    The predictive density of the force at a point of the grid is the normal one with the method's mean and standard
    deviation, for all methods; the band is the mean +- 1.96 standard deviations.
    """
    mean, sd = found["mean"], np.maximum(found["sd"], 1e-12)
    error = np.nan_to_num(scores.rmse(mean, truth), nan=np.inf, posinf=np.inf)
    stopped = np.asarray(found.get("stopped", True), bool)
    return {"rmse": error, "coverage": scores.interval_coverage(*scores.interval(mean, sd), truth),
            "nlpd": -norm.logpdf(truth, mean, sd).mean(axis=1), "diverged": ~(error <= problem.DIVERGED) | ~stopped}


def _sound(name: str) -> Callable[[xr.Dataset], xr.DataArray]:
    """Return the column of a variable on the data sets that did not diverge; NaN on others."""
    return lambda found: found[name].where(~found.diverged)


ERRORS: dict[str, Column] = {
    "RMSE": _sound("rmse"), "divergences": lambda found: found.diverged.sum(), "coverage": _sound("coverage"),
    "NLPD": _sound("nlpd"), "CPU s": "seconds"}
OF_METHOD: dict[str, dict[str, Column]] = {
    **dict.fromkeys(approximations.SEARCHES, {"at a mode": lambda found: found.converged.mean()}),
    "iterated GHS(7)": {"last change": lambda found: number(np.max, found.change)},
    "ESLS": {"mixed": lambda found: (found.r_hat <= slices.R_HAT).mean(),
             "mixed at first": lambda found: (found.r_hat_first <= slices.R_HAT).mean(),
             "all CPU s": lambda found: found.seconds + found.seconds_more, "ESS": "ess"}}


def comparison(data: Data) -> dict[str, Any]:
    """Return one row for each configuration and method.

    ``RMSE`` of the force over the grid, without diverged data sets, and ``divergences``, their number; ``coverage`` of
    the 95% band, pooled over data sets and points; ``NLPD``, the negative log predictive density of the force at a
    point; ``CPU s`` for one data set, compilation apart; of elliptical slice sampling ``mixed`` (the share of data sets
    whose R-hat is at most 1.01 at every monitored point of the grid), ``mixed at first`` (the same after the draws that
    ``CPU s`` is of), ``all CPU s`` (with those that followed where it was not) and ``ESS``, the smallest among these
    points, of the draws that are kept; of Laplace ``at a mode``, the share of data sets on which the search ended at
    one, which it may not and yet stop; of the iterated smoother ``last change``, the largest by which the last
    iteration moved a mean, in standard deviations. ``name se`` are standard errors over data sets.
    """
    return {f"{label}: {method}": row(found.sel({"method": method}), ERRORS | OF_METHOD.get(method, {}))
            for label, found in data.items() for method in found.method.values}


def beside_published(data: Data) -> dict[str, Any]:
    """Return one row for each configuration: RMSE and divergences of the source's methods beside the published ones.

    ``z`` is the difference of the RMSE in standard errors of ours; the published mean over 100 data sets has an error
    as large again. ``verdict`` says what that means, see `PublishedComparison`. The source averages over the data sets
    on which no method failed. What Newton's method counts as a failure there is not said in full; ``at modes`` is ``z``
    over the data sets on which ours ends at a mode, and ``no mode`` the number of others.
    """
    rows = {}
    for label in (label for label in problem.PUBLISHED if label in data):
        found = data[label].assign(rmse=_sound("rmse"))
        at_mode = found.converged.sel({"method": "LA"}).values == 1
        cells: dict[str, Any] = {"no mode": float((~at_mode).sum())}
        for method, (error, diverged) in problem.PUBLISHED[label].items():
            ours = found.sel({"method": method})
            means = mean_of(ours.rmse), mean_of(ours.rmse[at_mode])
            z, z_at_modes = ((mean.value - error) / mean.error for mean in means)
            cells |= {**cell(method, ours.rmse), f"{method} published": error, f"{method} z": z,
                      f"{method} verdict": str(PublishedComparison(z)), f"{method} div.": float(ours.diverged.sum()),
                      f"{method} div. published": float(diverged), f"{method} z at modes": z_at_modes}
        rows[label] = cells
    return rows


def against_slices(data: Data) -> dict[str, Any]:
    """Return one row for each configuration and method: the RMSE relative to elliptical slice sampling's, by pairs.

    ``RMSE ratio`` of the means over data sets on which neither diverged; ``difference`` of the RMSE, with its paired
    standard error; ``times as fast`` in CPU time for one data set.
    """
    rows = {}
    for label, found in data.items():
        slicing = found.sel({"method": "ESLS"})
        for method in found.method.values[found.method.values != "ESLS"]:
            other = found.sel({"method": method})
            ours, reference = (one.rmse.where(~(other.diverged | slicing.diverged)) for one in (other, slicing))
            rows[f"{label}: {method}"] = {
                **cell("RMSE ratio", ours.mean() / reference.mean()), **cell("difference", ours - reference),
                **cell("times as fast", slicing.seconds.mean() / other.seconds.mean())}
    return rows


def tables(settings: TranscriptionSettings, data: Data) -> dict[str, StudyTable]:
    """Return the tables."""
    count = settings.datasets
    return {"published": StudyTable.from_rows(
                f"RMSE of the force and divergences, {count} data sets, beside the published table",
                beside_published(data)),
            "comparison": StudyTable.from_rows(f"Means over {count} data sets (standard errors)", comparison(data)),
            "paired": StudyTable.from_rows("Against elliptical slice sampling on the same data sets",
                                           against_slices(data))}


def notes(settings: TranscriptionSettings, data: Data) -> tuple[str, ...]:
    """Return how many cells are consistent with the published table, and why lower ones are trusted."""
    verdicts = [PublishedComparison(z) for cells in beside_published(data).values() for name, z in cells.items()
                if name.endswith(" z")]
    return published.summarize_comparisons(verdicts), TRUST


KIND = TaskKind(compute, {
    "dataset time": "mean, sd, low, high", "dataset": "rmse, coverage, nlpd, diverged, seconds, stopped, converged, "
    "iterations, change, r_hat, r_hat_first, ess, draws, seconds_more"}, ("method",))
STUDY = Study(TranscriptionSettings, all_tasks, dict.fromkeys(_LABELS, KIND), tables, figures.draw, notes=notes,
              task_kind=lambda task: problem.configuration(task).label)
