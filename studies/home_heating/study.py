"""The study of home heating: settings, tasks and tables.

1. A window has four days of training and a fifth day. Windows come from a real house, or from simulated homes.
2. For each residual and heat store, find the most likely parameters of every window, and predict the fifth day: with a
   known heater in the real house (kind ``house``), under a thermostat in simulated homes (kind ``homes``).
3. For one residual, also marginalise the parameters by MCMC (kind ``posterior``).
4. Compare errors and log likelihoods with the published ones and with two reference residuals, paired by day.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
import xarray as xr

from lfm_ppl.parallel.task import Task
from lfm_ppl.utils.progress import Reporter

from .. import chains
from ..datasets import Column, TaskKind, cell, number, row, select_prefix
from ..declaration import CHAINS, REALISATIONS, Data, Study, StudySettings, StudyTable, setting
from ..scores import Estimate, estimate_cells
from ..tasks import slug
from . import figures, prediction, problem

PUBLISHED = {
    "SQM": {5: (0.67, 0.13, -116, 15), 6: (0.22, 0.02, 56, 15), 7: (1.00, 0.16, -190, 28), 8: (0.22, 0.02, 51, 14)},
    "CQM": {5: (0.87, 0.11, -157, 13), 6: (0.22, 0.02, 34, 15), 7: (1.37, 0.17, -268, 37), 8: (0.29, 0.05, 4, 19)},
    "WQM": {5: (1.06, 0.11, -227, 18), 6: (0.27, 0.04, 21, 26), 7: (1.45, 0.21, -239, 21), 8: (0.23, 0.02, 29, 21)},
    "periodic": {5: (0.52, 0.05, -106, 13), 6: (0.24, 0.02, 35, 21), 7: (1.16, 0.19, -364, 97),
                 8: (0.25, 0.02, 23, 18)},
    "none": {5: (0.61, 0.06, -142, 25), 6: (0.25, 0.02, 31, 14), 7: (1.66, 0.26, -367, 77), 8: (0.27, 0.04, 19, 18)},
    "matern": {5: (0.92, 0.12, -162, 16), 6: (0.23, 0.02, 55, 14), 7: (1.43, 0.19, -279, 54)},
    "resonator": {5: (1.15, 0.22, -1373, 1027), 6: (0.82, 0.24, -251, 101), 7: (1.43, 0.19, -279, 54)}}
"""Residual -> table of the source -> RMSE (K) and expected log likelihood (ELL), each with the published spread."""

SOURCES = {("house", "one store", "ahead"): 5, ("house", "one store", "tracked"): 6,
           ("homes", "one store", "ahead"): 7, ("house", "envelope", "ahead"): 8}
"""Kind of task, heat store and prediction -> table of the source."""

TITLES = {"house": "Real house, {}: the fifth day, means over {} windows (standard errors)",
          "homes": "Simulated homes under a thermostat, {}: the fifth day, means over {} homes (standard errors)",
          "posterior": "Real house, {}: what it gains to integrate the parameters out, {} windows"}
REFERENCES = ("none", "matern")
"""Residuals with which the others are compared, paired by day."""


@dataclass(frozen=True)
class HomeHeatingSettings(StudySettings):
    """Data and sizes of the study."""

    data: str | None = setting(None, f"folder of {problem.FILE} (default: $LFM_DATA/house or ../shared/data/house; "
                               "without it, simulated homes only)", metavar="FOLDER")
    homes: int = setting(10, "simulated homes", quick=2, aliases=REALISATIONS)
    windows: int | None = setting(None, "number of windows of the real house (default: all)", quick=2)
    methods: tuple[str, ...] = setting(problem.METHODS, "residuals", quick=("SQM", "none", "matern"),
                                       choices=problem.METHODS)
    stores: tuple[str, ...] = setting(problem.STORES, "heat stores", quick=problem.STORES[:1], choices=problem.STORES)
    functions: int = setting(15, "eigenfunctions", quick=5)
    particles: int = setting(1000, "particles of a prediction under a thermostat", quick=200)
    integrated: str = setting("SQM", "residual whose parameters are also integrated out", choices=problem.METHODS)
    every: int = setting(7, "distance of the windows in which they are integrated out")
    ram: tuple[int, int, int] = setting((4, 1000, 3000), "RAM", quick=(2, 50, 50), parts=CHAINS[:3])
    nuts: tuple[int, int, int] = setting((2, 120, 180), "NUTS", quick=(2, 8, 8), parts=CHAINS[:3])

    def __post_init__(self) -> None:
        """Check the settings."""
        super().__post_init__()
        if self.integrated not in self.methods:
            raise ValueError(f"--integrated must be one of --methods ({', '.join(self.methods)}), got "
                             f"{self.integrated!r}.")

    @classmethod
    def from_command_line(cls, report: Reporter | None, quick: bool = False, **values: Any) -> Self:
        """Return the settings for the options, with the folder of the real house if it exists."""
        folder = problem.data_folder(values.pop("data", None))
        if folder is None and report:
            report(f"no {problem.FILE} in $LFM_DATA/house or ../shared/data/house: simulated homes only")
        return super().from_command_line(report, quick, data=None if folder is None else str(folder), **values)


def tasks(settings: HomeHeatingSettings) -> list[Task]:
    """Return all tasks, ordered by residual, since the tasks of a residual share compiled programs."""
    study_tasks = []
    for store, method in ((store, method) for store in settings.stores for method in settings.methods):
        model = {"study": "home-heating", "functions": settings.functions, "store": store, "method": method}
        name, seed = f"{slug(store)}/{method}", settings.seed
        if settings.data is not None:
            count = len(problem.house(settings.data)[:settings.windows])
            house = {**model, "data": str(Path(settings.data).resolve()), "windows": count}
            study_tasks.append(Task(f"house/{name}", seed, {**house, "shown": count // 2}))
            if (store, method) == (settings.stores[0], settings.integrated):
                study_tasks += [Task(f"posterior/{sampler}/{name}", seed, {
                    **house, "sampler": sampler, "every": settings.every,
                    "chains": list(getattr(settings, sampler.lower()))}) for sampler in prediction.SAMPLERS]
        size = {"homes": settings.homes, "particles": settings.particles}
        study_tasks.append(Task(f"homes/{name}", seed, model | size))
    return study_tasks


def tables(settings: HomeHeatingSettings, data: Data) -> dict[str, StudyTable]:
    """Return the tables."""
    result = {}
    for store in settings.stores:
        for kind in (kind for kind in ("house", "homes") if kind in data):
            dataset = data[kind].sel(store=store)
            result[f"{kind}-{slug(store)}"] = StudyTable.from_rows(
                TITLES[kind].format(store, dataset.sizes["dataset"]), fifth_day_rows(dataset, kind))
        if store == settings.stores[0] and "posterior" in data:
            result["posterior"] = StudyTable.from_rows(
                TITLES["posterior"].format(store, data["posterior"].sizes["dataset"]), marginal_rows(data["posterior"]))
    if settings.data is None:
        reason = pd.DataFrame({"reason": [f"no {problem.FILE}; set its folder with --data"]}, ["real house"])
        result["left out"] = StudyTable("Left out", reason, reason, stored=False)
    return result


def fifth_day_rows(dataset: xr.Dataset, kind: str) -> dict[str, Any]:
    """Return a row for each residual: scores of the fifth day in the real house or in simulated homes.

    Differences from the references are paired, and positive if the row's residual is better. A few days with very low
    log likelihoods dominate the means, so that the row also has the share of days with a higher one.
    """
    rows, store, house = {}, dataset.store.item(), kind == "house"
    days = {"ahead": dataset}
    if house:
        days = {"ahead": select_prefix(dataset, "ahead"), "tracked": select_prefix(dataset, "track")}
    for method in dataset.method.values:
        cells: dict[str, Any] = {}
        for name, day in days.items():
            columns: dict[str, Column] = {f"RMSE {name} (K)": "rmse", f"ELL {name}": "ell"}
            if name == "ahead":
                columns |= {"median ELL ahead": lambda scores: number(np.median, scores.ell),
                            "coverage ahead": "inside"}
            cells |= row(day.sel({"method": method}), columns)
            if (kind, store, name) in SOURCES:
                numbers = PUBLISHED[method].get(SOURCES[kind, store, name], 4 * (np.nan,))
                cells |= estimate_cells(f"published RMSE {name} (K)", Estimate(*numbers[:2]))
                cells |= estimate_cells(f"published ELL {name}", Estimate(*numbers[2:]))
        if house:
            cells |= cell("RMSE ahead, weather unknown (K)", dataset.blind_rmse.sel({"method": method}))
        residual = days["ahead"].sel({"method": method})
        for reference in (name for name in REFERENCES if name in dataset.method):
            comparator = days["ahead"].sel({"method": reference})
            cells |= cell(f"RMSE below {reference} (K)", comparator.rmse - residual.rmse)
            cells |= cell(f"ELL above {reference}", residual.ell - comparator.ell)
            if reference != method:
                cells |= cell(f"share of days above {reference}", residual.ell > comparator.ell)
        rows[method] = cells | {"CPU time (s)": float(dataset.cpu_s.sel({"method": method})) / dataset.sizes["dataset"]}
    return rows


def marginal_rows(dataset: xr.Dataset) -> dict[str, Any]:
    """Return scores with the parameters integrated out, and their gains, over some windows of the real house.

    The distance of a sampler's posterior from that of RAM is the largest difference of means over parameters and
    windows, in standard deviations of RAM.
    """
    first = prediction.SAMPLERS[0]
    reference = dataset.sel(sampler=first)
    rows = {"most likely parameters": row(reference, {"RMSE ahead (K)": "point_rmse", "ELL ahead": "point_ell"})}
    for sampler in prediction.SAMPLERS:
        posterior = dataset.sel(sampler=sampler)
        gain = posterior.ell - posterior.point_ell
        shift = np.abs(posterior["mean"] - reference["mean"]) / reference["sd"]
        rows[f"integrated out by {sampler}"] = {
            **row(posterior, {"RMSE ahead (K)": "rmse", "ELL ahead": "ell"}), **cell("gain in ELL", gain),
            "median gain": number(np.median, gain),
            f"means from {first} (sd)": np.nan if sampler == first else number(np.max, shift),
            "largest R-hat": chains.largest_r_hat(posterior), "smallest ESS": chains.least_ess(posterior),
            "divergences": float(posterior.divergences.sum()), "CPU time (s)": number(np.mean, posterior.seconds)}
    return rows


_BY = ("store", "method")
STUDY = Study(
    HomeHeatingSettings, tasks,
    {"house": TaskKind(prediction.compute, {
        "dataset": "ahead_rmse, ahead_ell, ahead_inside, track_rmse, track_ell, track_inside, blind_rmse, blind_ell, "
                       "blind_inside, density", "dataset parameter": "z", "dataset hour": "mean, sd",
        "time": "residual, residual_sd", "": "cpu_s"}, _BY),
     "homes": TaskKind(prediction.compute, {
         "dataset": "rmse, ell, inside", "dataset parameter": "z", "dataset time": "mean, on",
         "probability time": "quantiles", "": "cpu_s"}, _BY),
     "posterior": TaskKind(prediction.compute, {
         "dataset": "rmse, ell, point_rmse, point_ell, r_hat, ess, divergences, seconds",
         "dataset parameter": "mean, sd", "": "cpu_s"}, ("sampler",))},
    tables, figures.draw, label="residual")
