"""The study of counts, outliers and binary data: settings, tasks and tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import xarray as xr

from lfm_ppl.parallel.task import Task
from lfm_ppl.utils.progress import Reporter

from ..datasets import Column, TaskKind, row
from ..declaration import Data, Results, Study, StudySettings, StudyTable, setting
from ..scores import Estimate
from . import figures, methods
from .problem import COAL, NAMES, ProblemSize, build_problem


@dataclass(frozen=True)
class CountsSettings(StudySettings):
    """Sizes of the study."""

    data: str | None = setting(None, "folder with the folders coal and calls (default: simulated counts)",
                               metavar="FOLDER")
    problems: tuple[str, ...] = setting(NAMES, "data and their families", quick=(COAL,), choices=NAMES)
    size: ProblemSize = setting(ProblemSize(), "", quick=ProblemSize(bins=56, folds=2))
    draws: int = setting(5000, "draws of each of the reference's four chains", quick=500)


def parameter_tasks(settings: CountsSettings) -> list[Task]:
    """Return one task for each problem, which learns its parameters."""
    return [Task(f"{name}/parameters", settings.seed,
                 {"problem": name, "size": list(settings.size), "data": settings.data}) for name in settings.problems]


def comparison_tasks(settings: CountsSettings, results: Results) -> list[Task]:
    """Return one task for each problem and method, with the parameters of the problem."""
    return [Task(f"{task.settings['problem']}/{method}", settings.seed,
                 {**task.settings, "method": method, "draws": settings.draws,
                  "parameters": {name: float(value) for name, value in results[task.name].items()}})
            for task in parameter_tasks(settings) for method in methods.METHODS]


def check(settings: CountsSettings, report: Reporter | None) -> None:
    """Raise FileNotFoundError or ValueError for missing or invalid data."""
    for name in settings.problems:
        build_problem(name, settings.size, settings.seed, settings.data)


def tables(settings: CountsSettings, data: Data) -> dict[str, StudyTable]:
    """Return the tables."""
    comparisons = {name: methods.compare_methods(settings, data, name) for name in settings.problems}
    accuracy = "Posterior of the predictor (mean: largest error in sds; sd: largest relative error)"
    return {"accuracy": StudyTable.from_rows(accuracy, rows(comparisons, ACCURACY)),
            "prediction": StudyTable.from_rows(f"Held-out data, {settings.size.folds} folds",
                                               rows(comparisons, PREDICTION))}


ACCURACY: dict[str, Column] = {
    "log Z": lambda results: Estimate(float(results["log evidence"]), float(results["log evidence error"])),
    "less reference": lambda results: Estimate(float(results["excess"]), float(results["excess error"])),
    "mean": "mean error", "sd": "sd error", "covered": "covered", "seconds": "seconds"}
"""Columns for the predictor's posterior, see `methods.compare_methods`. The standard error of the reference's log Z is
that of importance sampling. ``seconds`` is the CPU time of one evidence with its gradient, or of all draws."""

PREDICTION: dict[str, Column] = {"NLPD": lambda results: -results["log density"], "less reference": "excess NLPD",
                                 "covered": "inside"}
"""Means over all data, each held out with its fold: negative log predictive density, its excess over the reference, and
coverage of the 95% predictive intervals."""


def rows(comparisons: Mapping[str, xr.Dataset], columns: Mapping[str, Column]) -> dict[str, Any]:
    """Return one row for each problem and method, without the columns that a problem lacks."""
    table = {}
    for name, comparison in comparisons.items():
        available = {title: column for title, column in columns.items() if callable(column) or column in comparison}
        for method, label in methods.METHODS.items():
            table[f"{name}, {label}"] = row(comparison.sel({"method": method}), available)
    return table


def notes(settings: CountsSettings, data: Data) -> tuple[str, ...]:
    """Return remarks on the reference and on the parameters."""
    reference = data["comparison"].sel({"method": methods.REFERENCE})
    return (f"Reference: elliptical slices, at least {reference.ess.min():.0f} effective draws, R-hat at most "
            f"{reference.r_hat.max():.3f}; log Z by importance sampling, effective share of the draws at least "
            f"{reference.share.min():.2f}.",
            "Parameters are those at the mode of the posterior with EP's evidence, or the true ones of simulated data; "
            "all methods take the same.")


def _task_kind(task: Task) -> str:
    return "comparison" if "method" in task.settings else "parameters"


KINDS = {
    "parameters": TaskKind(methods.learn_parameters, {
        "": "level, scale, lengthscale, daily_scale, daily_lengthscale, concentration, noise"}, ("problem",)),
    "comparison": TaskKind(methods.apply_method, {
        "dataset": "mean, sd, log density, low, high",
        "": "log evidence, log evidence error, share, ess, r_hat, seconds"}, ("problem", "method")),
}

STUDY = Study(CountsSettings, parameter_tasks, KINDS, tables, figures.draw, notes=notes,
              follow_up_tasks=comparison_tasks, check=check, task_kind=_task_kind)
