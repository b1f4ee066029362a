"""The study: its settings, tasks and tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import xarray as xr

from lfm_ppl.engine.run import Reporter
from lfm_ppl.engine.task import Task
from lfm_ppl.experiments import study
from lfm_ppl.experiments.counts import figures, methods, problem
from lfm_ppl.experiments.datasets import Column, TaskKind, row
from lfm_ppl.experiments.scores import Estimate
from lfm_ppl.experiments.study import Data, Results, Study, StudyTable, setting


@dataclass(frozen=True)
class CountsSettings(study.StudySettings):
    """How much is computed."""

    data: str | None = setting(None, "folder with the folders coal and calls (default: simulated counts)",
                               metavar="FOLDER")
    problems: tuple[str, ...] = setting(problem.NAMES, "data and their families", quick=(problem.COAL,),
                                        choices=problem.NAMES)
    size: problem.Size = setting(problem.Size(), "", quick=problem.Size(bins=56, folds=2))
    draws: int = setting(5000, "of each of four chains of the reference", quick=500)


def learning(settings: CountsSettings) -> list[Task]:
    """Return a task for each problem, which finds its parameters."""
    return [Task(f"{name}/parameters", settings.seed,
                 {"problem": name, "size": list(settings.size), "data": settings.data}) for name in settings.problems]


def comparing(settings: CountsSettings, results: Results) -> list[Task]:
    """Return a task for each problem and method, which takes the parameters of the problem."""
    return [Task(f"{task.settings['problem']}/{method}", settings.seed,
                 {**task.settings, "method": method, "draws": settings.draws,
                  "parameters": {name: float(value) for name, value in results[task.name].items()}})
            for task in learning(settings) for method in methods.METHODS]


def check(settings: CountsSettings, report: Reporter | None) -> None:
    """Raise FileNotFoundError or ValueError where something is wrong with the data."""
    for name in settings.problems:
        problem.problem(name, settings.size, settings.seed, settings.data)


def tables(settings: CountsSettings, data: Data) -> dict[str, StudyTable]:
    """Return the tables."""
    every = {name: methods.compared(settings, data, name) for name in settings.problems}
    accuracy = "Posterior of the predictor (mean: largest error in sds; sd: largest relative error)"
    return {"accuracy": StudyTable.from_rows(accuracy, rows(every, ACCURACY)),
            "prediction": StudyTable.from_rows(f"Held-out data, {settings.size.folds} folds", rows(every, PREDICTION))}


ACCURACY: dict[str, Column] = {
    "log Z": lambda one: Estimate(float(one["log evidence"]), float(one["log evidence error"])),
    "less reference": lambda one: Estimate(float(one["excess"]), float(one["excess error"])),
    "mean": "mean error", "sd": "sd error", "covered": "covered", "seconds": "seconds"}
"""Of the predictor's posterior, see `methods.compared`; log Z of the reference has the standard error of importance
sampling. ``seconds`` of CPU time are those of an evidence with its gradient, or of all draws."""

PREDICTION: dict[str, Column] = {"NLPD": lambda one: -one["log density"], "less reference": "excess NLPD",
                                 "covered": "inside"}
"""Means over all data, each held out with its fold: the negative log predictive density, by how much it exceeds the
reference's, and the share of data in their 95% predictive intervals."""


def rows(every: Mapping[str, xr.Dataset], columns: Mapping[str, Column]) -> dict[str, Any]:
    """Return one row for each problem, see `methods.compared`, and method; columns of what it lacks are left out."""
    found = {}
    for name, compared in every.items():
        known = {title: column for title, column in columns.items() if callable(column) or column in compared}
        for method, label in methods.METHODS.items():
            found[f"{name}, {label}"] = row(compared.sel({"method": method}), known)
    return found


def notes(settings: CountsSettings, data: Data) -> tuple[str, ...]:
    """Return what there is to say about the reference and the parameters."""
    reference = data["comparison"].sel({"method": methods.REFERENCE})
    return (f"Reference: elliptical slices, at least {reference.ess.min():.0f} effective draws, R-hat at most "
            f"{reference.r_hat.max():.3f}; log Z by importance sampling, effective share of the draws at least "
            f"{reference.share.min():.2f}.",
            "Parameters are those at the mode of the posterior with EP's evidence, or the true ones of simulated data; "
            "all methods take the same.")


STUDY = Study(
    CountsSettings, learning,
    {"parameters": TaskKind(methods.learn, {
        "": "level, scale, lengthscale, daily_scale, daily_lengthscale, concentration, noise"}, ("problem",)),
     "comparison": TaskKind(methods.compute, {
         "dataset": "mean, sd, log density, low, high",
         "": "log evidence, log evidence error, share, ess, r_hat, seconds"}, ("problem", "method"))},
    tables, figures.draw, notes=notes, follow_up_tasks=comparing, check=check,
    task_kind=lambda task: "comparison" if "method" in task.settings else "parameters")
