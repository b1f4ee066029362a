"""The study: its settings, tasks and tables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lfm_ppl.engine.task import Task
from lfm_ppl.experiments import study
from lfm_ppl.experiments.datasets import Column, TaskKind, row, rows
from lfm_ppl.experiments.periodic_kernels import figures, methods, problem
from lfm_ppl.experiments.periodic_kernels.methods import KPCA, SPARSE, SPARSE_4
from lfm_ppl.experiments.scores import Estimate, estimate_cells, mean_of
from lfm_ppl.experiments.study import Data, Study, StudyTable, setting

PUBLISHED = {SPARSE: (0.36, 3.03, -6.9e4), SPARSE_4: (0.23, 2.74, -1.2e4), KPCA: (9.6e-5, 2.49, 75.0)}
"""Largest error of the covariance, error and expected log likelihood that the source publishes."""


@dataclass(frozen=True)
class PeriodicKernelSettings(study.StudySettings):
    """How much is computed."""

    runs: int = setting(500, "functions that are drawn and predicted", quick=10, aliases=study.REALISATIONS)
    functions: tuple[int, ...] = setting((3, 5, 7, 11, 15, 22, 31, 45, 63, 88), "numbers of functions of the "
                                         "approximations", quick=(5, 11, 22), increasing=True)
    draws: int = setting(200, "of the sparse spectrum's frequencies, for each number", quick=20)
    points: tuple[int, ...] = setting((20, 22, 25, 30, 40, 60, 100, 200), "of the quadrature grid on the window",
                                      quick=(20, 60), increasing=True)

    def __post_init__(self) -> None:
        """Check what a user gives."""
        super().__post_init__()
        if self.functions[-1] > 200:
            raise ValueError(f"functions must be at most 200, got {self.functions[-1]}.")


def all_tasks(settings: PeriodicKernelSettings) -> list[Task]:
    """Return one task for each kernel, one for the quadrature grid, and one for each method of prediction."""
    def task(name: str, what: str, **given: Any) -> Task:
        return Task(name.replace(" ", "_").replace(",", ""), settings.seed, {"what": what, **given})

    size = {"functions": list(settings.functions), "draws": settings.draws}
    return [*(task(f"covariance/{name}", "covariance", **size, kernel=name) for name in problem.kernels()),
            task("quadrature", "quadrature", points=list(settings.points)),
            *(task(f"regression/{name}", "regression", method=name, runs=settings.runs) for name in methods.PREDICTING)]


def tables(settings: PeriodicKernelSettings, data: Data) -> dict[str, StudyTable]:
    """Return the tables."""
    return {"covariance": StudyTable.from_rows("Largest error of the covariance, by the number of functions",
                                               covariances(settings, data)),
            "published": StudyTable.from_rows("Squared exponential of scale 10, on a window of 130",
                                              published(settings, data)),
            "regression": StudyTable.from_rows(f"Means over {settings.runs} functions (standard errors)",
                                               predictions(data))}


def covariances(settings: PeriodicKernelSettings, data: Data) -> dict[str, Any]:
    """Return the largest error of the covariance for each kernel and method, in a column for each number of functions.

    The row ``left out`` is the mean variance that the eigenfunctions miss. ``significant`` is the number at the default
    share of the largest eigenvalue, 1/100, and ``error there`` that of its covariance.
    """
    found, every = data["covariance"].assign_coords(functions=list(settings.functions)), {}
    for kernel in found.kernel.values:
        for method in (*methods.METHODS, "left out"):
            columns: dict[str, Column] = {"{functions}": method}
            if method == methods.EIGENFUNCTIONS:
                columns |= {"significant": "significant", "error there": "at default"}
            if found[method].sel(kernel=kernel).notnull().any():
                every[f"{kernel.replace('_', '/')}, {method}"] = row(found.sel(kernel=kernel), columns)
    return every


def published(settings: PeriodicKernelSettings, data: Data) -> dict[str, Any]:
    """Return the errors of 22 eigenfunctions by their quadrature points, and of random frequencies.

    ``error`` is that of the covariance, for random frequencies the mean over 100 draws, ``least`` of them, and
    ``published`` what the source has.
    """
    found = data["quadrature"]
    every = {f"{min(22, points)} eigenfunctions, {points} points":
             estimate_cells("error", Estimate(float(error), np.nan))
             for points, error in zip(settings.points, found.error, strict=True)}
    if settings.points[-1] >= 22:
        every[f"22 eigenfunctions, {settings.points[-1]} points"]["published"] = PUBLISHED[KPCA][0]
    for label, errors in ((SPARSE, found["sparse 22"]), (SPARSE_4, found["sparse 88"])):
        every[label] = estimate_cells("error", mean_of(errors)) | {
            "least": float(errors.min()), "published": PUBLISHED[label][0]}
    return every


def predictions(data: Data) -> dict[str, Any]:
    """Return how each approximation predicts the functions that were drawn, and what the source has.

    Means with standard errors: ``RMSE`` over the predicted points, ``root of sum``, the same without the division by
    their number, ``log likelihood``, the sum of the points' log densities, ``coverage`` of 95% bands. The source does
    not state the window and the points of its figures.
    """
    columns: dict[str, Column] = {
        "RMSE": "rmse", "root of sum": lambda one: one.rmse * np.sqrt(one.sizes["time"]),
        "log likelihood": "log likelihood", "coverage": "coverage"}
    found = rows(data["regression"], "method", columns)
    for method, (_, rmse, log_likelihood) in PUBLISHED.items():
        found[method] |= {"published RMSE": rmse, "published log likelihood": log_likelihood}
    return found


STUDY = Study(
    PeriodicKernelSettings, all_tasks,
    {"covariance": TaskKind(methods.covariance_errors, {
        "functions": ", ".join((*methods.METHODS, "left out")), "": "significant, at default"}, ("kernel",)),
     "quadrature": TaskKind(methods.quadrature_errors, {"points": "error", "draw": "sparse 22, sparse 88"}),
     "regression": TaskKind(methods.predictions, {
         "dataset": "rmse, log likelihood, coverage", "time": "mean, variance"}, ("method",))},
    tables, figures.draw)
