"""The study of periodic kernels: settings, tasks and tables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lfm_ppl.parallel.task import Task

from ..datasets import Column, TaskKind, row, rows
from ..declaration import REALISATIONS, Data, Study, StudySettings, StudyTable, setting
from ..scores import Estimate, estimate_cells, estimate_mean
from . import figures, methods, problem
from .methods import KPCA, SPARSE, SPARSE_4

PUBLISHED = {SPARSE: (0.36, 3.03, -6.9e4), SPARSE_4: (0.23, 2.74, -1.2e4), KPCA: (9.6e-5, 2.49, 75.0)}
"""Published largest error of the covariance, RMSE, and expected log likelihood."""


@dataclass(frozen=True)
class PeriodicKernelSettings(StudySettings):
    """Sizes of the study."""

    runs: int = setting(500, "random functions to predict", quick=10, aliases=REALISATIONS)
    functions: tuple[int, ...] = setting((3, 5, 7, 11, 15, 22, 31, 45, 63, 88), "numbers of functions of the "
                                         "approximations", quick=(5, 11, 22), increasing=True)
    draws: int = setting(200, "draws of the sparse spectrum's frequencies, for each number of functions", quick=20)
    points: tuple[int, ...] = setting((20, 22, 25, 30, 40, 60, 100, 200), "numbers of quadrature points on the window",
                                      quick=(20, 60), increasing=True)

    def __post_init__(self) -> None:
        """Check the settings."""
        super().__post_init__()
        if self.functions[-1] > 200:
            raise ValueError(f"functions must be at most 200, got {self.functions[-1]}.")


def all_tasks(settings: PeriodicKernelSettings) -> list[Task]:
    """Return one task for each kernel, one for the quadrature grid, and one for each method of prediction."""
    def task(name: str, kind: str, **parameters: Any) -> Task:
        return Task(name.replace(" ", "_").replace(",", ""), settings.seed, {"what": kind, **parameters})

    size = {"functions": list(settings.functions), "draws": settings.draws}
    return [*(task(f"covariance/{name}", "covariance", **size, kernel=name) for name in problem.kernels()),
            task("quadrature", "quadrature", points=list(settings.points)),
            *(task(f"regression/{name}", "regression", method=name, runs=settings.runs) for name in methods.PREDICTORS)]


def tables(settings: PeriodicKernelSettings, data: Data) -> dict[str, StudyTable]:
    """Return the tables."""
    return {"covariance": StudyTable.from_rows("Largest error of the covariance, by the number of functions",
                                               covariance_rows(settings, data)),
            "published": StudyTable.from_rows("Squared exponential of scale 10, on a window of 130",
                                              published_rows(settings, data)),
            "regression": StudyTable.from_rows(f"Means over {settings.runs} functions (standard errors)",
                                               prediction_rows(data))}


def covariance_rows(settings: PeriodicKernelSettings, data: Data) -> dict[str, Any]:
    """Return the largest covariance error of each kernel and method, with one column for each number of functions.

    The row ``left out`` is the mean variance outside the eigenfunctions. ``significant`` is the number of
    eigenfunctions with at least 1/100 of the largest eigenvalue, the default, and ``error there`` their covariance
    error.
    """
    dataset, table = data["covariance"].assign_coords(functions=list(settings.functions)), {}
    for kernel in dataset.kernel.values:
        for method in (*methods.METHODS, "left out"):
            columns: dict[str, Column] = {"{functions}": method}
            if method == methods.EIGENFUNCTIONS:
                columns |= {"significant": "significant", "error there": "at default"}
            if dataset[method].sel(kernel=kernel).notnull().any():
                table[f"{kernel.replace('_', '/')}, {method}"] = row(dataset.sel(kernel=kernel), columns)
    return table


def published_rows(settings: PeriodicKernelSettings, data: Data) -> dict[str, Any]:
    """Return covariance errors of 22 eigenfunctions for each number of quadrature points, and of random frequencies.

    For random frequencies ``error`` is the mean over 100 draws and ``least`` the smallest. ``published`` is the error
    in the source.
    """
    quadrature = data["quadrature"]
    table = {f"{min(22, points)} eigenfunctions, {points} points":
             estimate_cells("error", Estimate(float(error), np.nan))
             for points, error in zip(settings.points, quadrature.error, strict=True)}
    if settings.points[-1] >= 22:
        table[f"22 eigenfunctions, {settings.points[-1]} points"]["published"] = PUBLISHED[KPCA][0]
    for label, errors in ((SPARSE, quadrature["sparse 22"]), (SPARSE_4, quadrature["sparse 88"])):
        table[label] = estimate_cells("error", estimate_mean(errors)) | {
            "least": float(errors.min()), "published": PUBLISHED[label][0]}
    return table


def prediction_rows(data: Data) -> dict[str, Any]:
    """Return the scores of each approximation's predictions, and the published scores.

    Means with standard errors: ``RMSE`` over the predicted points; ``root of sum``, the same without the division by
    the number of points; ``log likelihood``, the sum of the log densities; ``coverage`` of 95% bands. The source does
    not state the window and the points of its figures.
    """
    columns: dict[str, Column] = {
        "RMSE": "rmse", "root of sum": lambda functions: functions.rmse * np.sqrt(functions.sizes["time"]),
        "log likelihood": "log likelihood", "coverage": "coverage"}
    table = rows(data["regression"], "method", columns)
    for method, (_, rmse, log_likelihood) in PUBLISHED.items():
        table[method] |= {"published RMSE": rmse, "published log likelihood": log_likelihood}
    return table


STUDY = Study(
    PeriodicKernelSettings, all_tasks,
    {"covariance": TaskKind(methods.covariance_errors, {
        "functions": ", ".join((*methods.METHODS, "left out")), "": "significant, at default"}, ("kernel",)),
     "quadrature": TaskKind(methods.quadrature_errors, {"points": "error", "draw": "sparse 22, sparse 88"}),
     "regression": TaskKind(methods.predict_functions, {
         "dataset": "rmse, log likelihood, coverage", "time": "mean, variance"}, ("method",))},
    tables, figures.draw)
