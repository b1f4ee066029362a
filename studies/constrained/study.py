"""The study of constrained forces: settings, tasks and tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import xarray as xr

from lfm_ppl.accuracy.importance_weights import LARGEST_K
from lfm_ppl.parallel.task import Result, Task

from ..datasets import Column, TaskKind, merge_rows, row, rows
from ..declaration import REALISATIONS, Data, Study, StudySettings, StudyTable, setting
from ..scores import SE, estimate_rate
from ..tasks import dataset_blocks, slug
from . import estimators, figures, problem
from .estimators import BANDS, FULL, METHODS, SMOOTHER


@dataclass(frozen=True)
class ConstrainedSettings(StudySettings):
    """Sizes of the study."""

    runs: int = setting(100, "records of each shape of the transcription factor", quick=2,
                        aliases=REALISATIONS, per_seed=problem.MAX_DATA_SETS)
    patients: int = setting(50, "simulated days of TSH, FT3 and FT4", quick=2, per_seed=problem.MAX_DATA_SETS)
    targets: int = setting(20, "targets on reentry", quick=2, per_seed=problem.MAX_DATA_SETS)
    draws: int = setting(16, "draws of a patient's parameters, over which bands are averaged")
    weighted: int = setting(150, "weighted draws from which these are resampled")
    shapes: tuple[str, ...] = setting(problem.SHAPES, "shapes of the force", quick=problem.SHAPES[:1],
                                      choices=problem.SHAPES)
    methods: tuple[str, ...] = setting(tuple(METHODS), "estimators, including full information and EP",
                                       quick=(SMOOTHER, FULL, BANDS), choices=tuple(METHODS))
    block: int = setting(25, "records of one task, stored in one file")

    def __post_init__(self) -> None:
        """Check the settings."""
        super().__post_init__()
        for method in (FULL, BANDS):
            if method not in self.methods:
                raise ValueError(f"--methods must include {method!r}, which the figures show; got "
                                 f"{', '.join(self.methods)}.")


def all_tasks(settings: ConstrainedSettings) -> list[Task]:
    """Return a task for each block of records of a shape, of targets and of patients."""
    kinds: list[tuple[str, str, int, dict[str, Any]]] = [
        ("ballistic", "", settings.targets, {}),
        ("thyroid", "", settings.patients, {"draws": settings.draws, "weighted": settings.weighted}),
        *(("transcription", shape, settings.runs, {"methods": list(settings.methods)}) for shape in settings.shapes)]
    return [Task("/".join(filter(None, [kind, slug(shape), f"{first:04d}"])), settings.seed, {
        "study": "constrained", "what": kind, "shape": shape, "first": first, "count": last - first + 1,
        **parameters}) for kind, shape, count, parameters in kinds
            for first, last in dataset_blocks(count, settings.block)]


class ByMethod(TaskKind):
    """Tasks with entries ``{method}/{entry}`` of several estimators; their dataset has the dimension ``method``."""

    def collect(self, tasks: Iterable[Task], results: Mapping[str, Result]) -> xr.Dataset:
        """Return the results of tasks, with the ``lengthscale`` of each record in each estimator."""
        method_tasks, method_results = [], {}
        for task in tasks:
            for method in task.settings["methods"]:
                method_task = Task(f"{task.name}/{slug(method)}", task.seed, {**task.settings, "method": method})
                result = {name.removeprefix(f"{method}/"): value for name, value in results[task.name].items()}
                hyperparameters = result[f"hyperparameters/{estimators.METHODS[method].hyperparameters}"]
                method_results[method_task.name] = result | {"lengthscale": hyperparameters[:, 0]}
                method_tasks.append(method_task)
        return super().collect(method_tasks, method_results)


def tables(settings: ConstrainedSettings, data: Data) -> dict[str, StudyTable]:
    """Return the tables."""
    dataset = data["transcription"]
    return {"transcription": StudyTable.from_rows(
                f"Transcription, {len(settings.shapes)} shapes of force by {settings.runs} records",
                rows(dataset, "method", ERRORS)),
            "shapes": StudyTable.from_rows(
                "By the shape of the force",
                {method: shape_row(dataset.sel({"method": method})) for method in settings.methods}),
            "others": StudyTable.from_rows(
                f"{settings.targets} targets on reentry and {settings.patients} patients", other_rows(data))}


ERRORS: dict[str, Column] = {
    "median MSE": lambda results: results.mse.where(~results.failed).median(),
    "largest MSE": lambda results: results.mse.where(~results.failed).max(),
    "published": lambda results: METHODS[results["method"].item()].published,
    "above 0.0103": lambda results: estimate_rate(
        results.mse.values[~results.failed.values] > problem.PUBLISHED["delayed MHE"]),
    "lengthscale (s)": lambda results: results.lengthscale.median(),
    "least": lambda results: results.minimum.where(~results.failed).min(),
    "coverage": lambda results: results.coverage.where(~results.failed),
    "failed": lambda results: results.failed.sum()}
"""Columns for an estimator over all records: errors of the force without the first 60 samples; the ``published`` error
of one realisation; the share of records with a larger error than the published one of the delayed estimator; the median
``lengthscale (s)``; the ``least`` estimate; ``coverage`` of the 95% bands; the number of ``failed`` records without an
estimate, which the other columns leave out."""


def shape_row(dataset: xr.Dataset) -> dict[str, Any]:
    """Return median MSE and coverage of an estimator for each shape of the force."""
    columns: dict[str, Column] = {"median MSE, {shape}": lambda records: records.mse.median(skipna=False),
                                  "coverage, {shape}": "coverage"}
    return merge_rows(rows(dataset, "shape", columns))


def other_rows(data: Data) -> dict[str, Any]:
    """Return errors of the target's altitude, speed and acceleration, and scores of the patients' TRH."""
    cells = row(data["ballistic"], {"target, RMSE of {path} ({unit})": "rmse", "target, converged": "converged"})
    cells |= row(data["thyroid"], {
        "patients, RMSE of TRH (nmol/l)": "rmse", "patients, coverage of TRH": "coverage",
        "patients, {quantity} within 1 h": lambda patients: patients.peak <= estimators.MAX_PEAK_ERROR,
        "patients, Pareto k above 0.7": lambda patients: ~(patients.k <= LARGEST_K),
        "patients, converged": "converged", "patients, bands converged": "bands_converged"})
    return {name: {"value": cells[name], f"value{SE}": cells[name + SE]} for name in cells if not name.endswith(SE)}


STUDY = Study(
    ConstrainedSettings, all_tasks,
    {"transcription": ByMethod(estimators.transcription, {
        "dataset": "mse, minimum, coverage, failed, lengthscale", "curve time": "first", "time": "truth"},
        ("shape", "method")),
     "ballistic": TaskKind(estimators.ballistic, {
         "dataset path": "rmse", "dataset": "converged", "path time": "estimate, truth"}),
     "thyroid": TaskKind(estimators.thyroid, {
         "dataset": "rmse, coverage, lowest, k, converged, bands_converged", "dataset quantity": "peak",
         "dataset time": "truth, mode, mean, low, high", "time": "times", "dataset parameter": "z",
         "dataset draw parameter": "draws", "hour output": "y", "hour": "measured"})},
    tables, figures.draw, {
        "path": ("path", tuple(problem.TARGET_PATHS)), "unit": ("path", tuple(problem.TARGET_PATHS.values())),
        "quantity": ("quantity", ("greatest TRH", "peak of the day's wave of TRH"))}, label="estimator")
