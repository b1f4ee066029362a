"""The study: its settings, tasks and tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import xarray as xr

from lfm_ppl.experiments import study
from lfm_ppl.experiments.constrained import estimators, figures, problem
from lfm_ppl.experiments.constrained.estimators import BANDS, FULL, METHODS, SMOOTHER
from lfm_ppl.experiments.datasets import Column, TaskKind, merge_rows, row, rows
from lfm_ppl.experiments.scores import SE, rate_of
from lfm_ppl.experiments.study import Data, Study, StudyTable, setting
from lfm_ppl.experiments.tasks import dataset_blocks, slug
from lfm_ppl.parallel.task import Result, Task
from lfm_ppl.results.importance import LARGEST_K


@dataclass(frozen=True)
class ConstrainedSettings(study.StudySettings):
    """How much is computed."""

    runs: int = setting(100, "records of each shape of the transcription factor", quick=2,
                        aliases=study.REALISATIONS, per_seed=problem.MOST)
    patients: int = setting(50, "simulated days of TSH, FT3 and FT4", quick=2, per_seed=problem.MOST)
    targets: int = setting(20, "on reentry", quick=2, per_seed=problem.MOST)
    draws: int = setting(16, "of a patient's parameters, over which bands are averaged")
    weighted: int = setting(150, "draws from which these are taken")
    shapes: tuple[str, ...] = setting(problem.SHAPES, "of the force", quick=problem.SHAPES[:1], choices=problem.SHAPES)
    methods: tuple[str, ...] = setting(tuple(METHODS), "estimators, with full information and EP among them",
                                       quick=(SMOOTHER, FULL, BANDS), choices=tuple(METHODS))
    block: int = setting(25, "records that are computed in one go, and stored in one file")

    def __post_init__(self) -> None:
        """Check what a user gives."""
        super().__post_init__()
        for method in (FULL, BANDS):
            if method not in self.methods:
                raise ValueError(f"--methods must hold {method!r}, which figures and tables are about; it names "
                                 f"{', '.join(self.methods)}.")


def all_tasks(settings: ConstrainedSettings) -> list[Task]:
    """Return a task for each block of records of a shape, of targets and of patients."""
    kinds: list[tuple[str, str, int, dict[str, Any]]] = [
        ("ballistic", "", settings.targets, {}),
        ("thyroid", "", settings.patients, {"draws": settings.draws, "weighted": settings.weighted}),
        *(("transcription", shape, settings.runs, {"methods": list(settings.methods)}) for shape in settings.shapes)]
    return [Task("/".join(filter(None, [what, slug(shape), f"{first:04d}"])), settings.seed, {
        "experiment": "constrained", "what": what, "shape": shape, "first": first, "count": last - first + 1, **own})
        for what, shape, count, own in kinds for first, last in dataset_blocks(count, settings.block)]


class ByMethod(TaskKind):
    """Tasks with the entries ``{method}/{entry}`` of several estimators, which get the dimension ``method``."""

    def collect(self, tasks: Iterable[Task], results: Mapping[str, Result]) -> xr.Dataset:
        """Return the results of tasks, with the ``lengthscale`` that each estimator has of each record."""
        each, found = [], {}
        for task in tasks:
            for method in task.settings["methods"]:
                one = Task(f"{task.name}/{slug(method)}", task.seed, {**task.settings, "method": method})
                result = {name.removeprefix(f"{method}/"): value for name, value in results[task.name].items()}
                learnt = result[f"hyperparameters/{estimators.METHODS[method].learnt}"]
                found[one.name] = result | {"lengthscale": learnt[:, 0]}
                each.append(one)
        return super().collect(each, found)


def tables(settings: ConstrainedSettings, data: Data) -> dict[str, StudyTable]:
    """Return the tables."""
    found = data["transcription"]
    return {"transcription": StudyTable.from_rows(
                f"Transcription, {len(settings.shapes)} shapes of force by {settings.runs} records",
                rows(found, "method", ERRORS)),
            "shapes": StudyTable.from_rows(
                "By the shape of the force",
                {method: by_shape(found.sel({"method": method})) for method in settings.methods}),
            "others": StudyTable.from_rows(
                f"{settings.targets} targets on reentry and {settings.patients} patients", others(data))}


ERRORS: dict[str, Column] = {
    "median MSE": lambda found: found.mse.where(~found.failed).median(),
    "largest MSE": lambda found: found.mse.where(~found.failed).max(),
    "published": lambda found: METHODS[found["method"].item()].published,
    "above 0.0103": lambda found: rate_of(found.mse.values[~found.failed.values] > problem.PUBLISHED["delayed MHE"]),
    "lengthscale (s)": lambda found: found.lengthscale.median(),
    "least": lambda found: found.minimum.where(~found.failed).min(),
    "coverage": lambda found: found.coverage.where(~found.failed),
    "failed": lambda found: found.failed.sum()}
"""Of one estimator over all records: errors of the force without the first 60 samples, the one ``published`` (of one
realisation), the share of records whose error is above the published one of the delayed estimator, the median
``lengthscale (s)``, the ``least`` estimate, ``coverage`` of the 95% bands, and ``failed`` records, without an estimate,
which do not count in the others."""


def by_shape(found: xr.Dataset) -> dict[str, Any]:
    """Return median MSE and coverage of one estimator for each shape of the force."""
    columns: dict[str, Column] = {"median MSE, {shape}": lambda of: of.mse.median(skipna=False),
                                  "coverage, {shape}": "coverage"}
    return merge_rows(rows(found, "shape", columns))


def others(data: Data) -> dict[str, Any]:
    """Return errors of the target's altitude, speed and acceleration, and what is found of patients' TRH."""
    cells = row(data["ballistic"], {"target, RMSE of {path} ({unit})": "rmse", "target, converged": "converged"})
    cells |= row(data["thyroid"], {
        "patients, RMSE of TRH (nmol/l)": "rmse", "patients, coverage of TRH": "coverage",
        "patients, {event} within 1 h": lambda found: found.peak <= estimators.NEAR,
        "patients, Pareto k above 0.7": lambda found: ~(found.k <= LARGEST_K),
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
         "dataset": "rmse, coverage, lowest, k, converged, bands_converged", "dataset event": "peak",
         "dataset time": "truth, mode, mean, low, high", "time": "times", "dataset parameter": "z",
         "dataset draw parameter": "draws", "hour output": "y", "hour": "measured"})},
    tables, figures.draw, {
        "path": ("path", tuple(problem.TARGET_PATHS)), "unit": ("path", tuple(problem.TARGET_PATHS.values())),
        "event": ("event", ("greatest TRH", "peak of the day's wave of TRH"))}, label="estimator")
