"""The study: its settings, tasks and tables."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
import xarray as xr

from lfm_ppl.engine.task import Task
from lfm_ppl.experiments import chains, study
from lfm_ppl.experiments.datasets import Column, TaskKind, cell, number, row, select_prefix
from lfm_ppl.experiments.home_heating import figures, prediction, problem
from lfm_ppl.experiments.scores import Estimate, estimate_cells
from lfm_ppl.experiments.study import Data, Study, StudyTable, setting
from lfm_ppl.experiments.tasks import slug
from lfm_ppl.utils.progress import Reporter

PUBLISHED = {
    "SQM": {5: (0.67, 0.13, -116, 15), 6: (0.22, 0.02, 56, 15), 7: (1.00, 0.16, -190, 28), 8: (0.22, 0.02, 51, 14)},
    "CQM": {5: (0.87, 0.11, -157, 13), 6: (0.22, 0.02, 34, 15), 7: (1.37, 0.17, -268, 37), 8: (0.29, 0.05, 4, 19)},
    "WQM": {5: (1.06, 0.11, -227, 18), 6: (0.27, 0.04, 21, 26), 7: (1.45, 0.21, -239, 21), 8: (0.23, 0.02, 29, 21)},
    "periodic": {5: (0.52, 0.05, -106, 13), 6: (0.24, 0.02, 35, 21), 7: (1.16, 0.19, -364, 97),
                 8: (0.25, 0.02, 23, 18)},
    "none": {5: (0.61, 0.06, -142, 25), 6: (0.25, 0.02, 31, 14), 7: (1.66, 0.26, -367, 77), 8: (0.27, 0.04, 19, 18)},
    "matern": {5: (0.92, 0.12, -162, 16), 6: (0.23, 0.02, 55, 14), 7: (1.43, 0.19, -279, 54)},
    "resonator": {5: (1.15, 0.22, -1373, 1027), 6: (0.82, 0.24, -251, 101), 7: (1.43, 0.19, -279, 54)}}
"""By tables of the source: RMSE (K) and expected log likelihood with what it gives after them, over both its homes."""

SOURCES = {("house", "one store", "ahead"): 5, ("house", "one store", "tracked"): 6,
           ("homes", "one store", "ahead"): 7, ("house", "envelope", "ahead"): 8}
"""Its tables of what the tables here are of."""

TITLES = {"house": "Real house, {}: the fifth day, means over {} windows (standard errors)",
          "homes": "Simulated homes under a thermostat, {}: the fifth day, means over {} homes (standard errors)",
          "posterior": "Real house, {}: what it gains to integrate the parameters out, {} windows"}
REFERENCES = ("none", "matern")
"""What a residual that repeats is compared with, day by day."""


@dataclass(frozen=True)
class HomeHeatingSettings(study.StudySettings):
    """How much is computed."""

    data: str | None = setting(None, f"folder of {problem.FILE} (default: $LFM_DATA/house or ../shared/data/house; "
                               "without one there are simulated homes only)", metavar="FOLDER")
    homes: int = setting(10, "simulated homes", quick=2, aliases=study.REALISATIONS)
    windows: int | None = setting(None, "of the real house, the first so many (default: all)", quick=2)
    methods: tuple[str, ...] = setting(problem.METHODS, "residuals", quick=("SQM", "none", "matern"),
                                       choices=problem.METHODS)
    stores: tuple[str, ...] = setting(problem.STORES, "of heat", quick=problem.STORES[:1], choices=problem.STORES)
    functions: int = setting(15, "eigenfunctions", quick=5)
    particles: int = setting(1000, "of a prediction under a thermostat", quick=200)
    integrated: str = setting("SQM", "residual whose parameters are integrated out, too", choices=problem.METHODS)
    every: int = setting(7, "in every so many windows")
    ram: tuple[int, int, int] = setting((4, 1000, 3000), "RAM", quick=(2, 50, 50), parts=study.CHAINS[:3])
    nuts: tuple[int, int, int] = setting((2, 120, 180), "NUTS", quick=(2, 8, 8), parts=study.CHAINS[:3])

    def __post_init__(self) -> None:
        """Check what a user gives."""
        super().__post_init__()
        if self.integrated not in self.methods:
            raise ValueError(f"--integrated must be one of --methods ({', '.join(self.methods)}), got "
                             f"{self.integrated!r}.")

    @classmethod
    def from_command_line(cls, report: Reporter | None, quick: bool = False, **given: Any) -> Self:
        """Return the settings that a user chose, with the folder of the real house where there is one."""
        folder = problem.data_folder(given.pop("data", None))
        if folder is None and report:
            report(f"no {problem.FILE} in $LFM_DATA/house or ../shared/data/house: simulated homes only")
        return super().from_command_line(report, quick, data=None if folder is None else str(folder), **given)


def tasks(settings: HomeHeatingSettings) -> list[Task]:
    """Return every task, those of a residual together, since they share what is compiled."""
    found = []
    for store, method in ((store, method) for store in settings.stores for method in settings.methods):
        model = {"experiment": "home-heating", "functions": settings.functions, "store": store, "method": method}
        name, seed = f"{slug(store)}/{method}", settings.seed
        if settings.data is not None:
            count = len(problem.house(settings.data)[:settings.windows])
            house = {**model, "data": str(Path(settings.data).resolve()), "windows": count}
            found.append(Task(f"house/{name}", seed, {**house, "shown": count // 2}))
            if (store, method) == (settings.stores[0], settings.integrated):
                found += [Task(f"posterior/{sampler}/{name}", seed, {
                    **house, "sampler": sampler, "every": settings.every,
                    "chains": list(getattr(settings, sampler.lower()))}) for sampler in prediction.SAMPLERS]
        found.append(Task(f"homes/{name}", seed, {**model, "homes": settings.homes, "particles": settings.particles}))
    return found


def tables(settings: HomeHeatingSettings, data: Data) -> dict[str, StudyTable]:
    """Return the tables."""
    found = {}
    for store in settings.stores:
        for what in (what for what in ("house", "homes") if what in data):
            found[f"{what}-{slug(store)}"] = StudyTable.from_rows(
                TITLES[what].format(store, data[what].sizes["dataset"]), fifth_day(data[what].sel(store=store), what))
        if store == settings.stores[0] and "posterior" in data:
            found["posterior"] = StudyTable.from_rows(
                TITLES["posterior"].format(store, data["posterior"].sizes["dataset"]), marginalised(data["posterior"]))
    if settings.data is None:
        reason = pd.DataFrame({"reason": [f"no {problem.FILE}; give its folder with --data"]}, ["real house"])
        found["left out"] = StudyTable("Left out", reason, reason, stored=False)
    return found


def fifth_day(found: xr.Dataset, what: str) -> dict[str, Any]:
    """Return a row for each residual: the fifth day of the real house, or of simulated homes under their thermostats.

    Differences from the references are paired, and positive where the row's residual is better. A few days with tiny
    log likelihoods rule the means, so the share of days with a higher one stands beside them.
    """
    rows, store, house = {}, found.store.item(), what == "house"
    days = {"ahead": found}
    if house:
        days = {"ahead": select_prefix(found, "ahead"), "tracked": select_prefix(found, "track")}
    for method in found.method.values:
        cells: dict[str, Any] = {}
        for name, day in days.items():
            columns: dict[str, Column] = {f"RMSE {name} (K)": "rmse", f"ELL {name}": "ell"}
            if name == "ahead":
                columns |= {"median ELL ahead": lambda own: number(np.median, own.ell), "coverage ahead": "inside"}
            cells |= row(day.sel({"method": method}), columns)
            if (what, store, name) in SOURCES:
                numbers = PUBLISHED[method].get(SOURCES[what, store, name], 4 * (np.nan,))
                cells |= estimate_cells(f"published RMSE {name} (K)", Estimate(*numbers[:2]))
                cells |= estimate_cells(f"published ELL {name}", Estimate(*numbers[2:]))
        if house:
            cells |= cell("RMSE ahead, weather unknown (K)", found.blind_rmse.sel({"method": method}))
        own = days["ahead"].sel({"method": method})
        for reference in (name for name in REFERENCES if name in found.method):
            other = days["ahead"].sel({"method": reference})
            cells |= cell(f"RMSE below {reference} (K)", other.rmse - own.rmse)
            cells |= cell(f"ELL above {reference}", own.ell - other.ell)
            if reference != method:
                cells |= cell(f"share of days above {reference}", own.ell > other.ell)
        rows[method] = cells | {"CPU time (s)": float(found.cpu_s.sel({"method": method})) / found.sizes["dataset"]}
    return rows


def marginalised(found: xr.Dataset) -> dict[str, Any]:
    """Return what is gained where the parameters are integrated out, over some windows of the real house.

    How far a sampler's posterior is from that of RAM: the largest distance of two means in standard deviations of RAM,
    over parameters and windows.
    """
    first = prediction.SAMPLERS[0]
    reference = found.sel(sampler=first)
    rows = {"most likely parameters": row(reference, {"RMSE ahead (K)": "point_rmse", "ELL ahead": "point_ell"})}
    for sampler in prediction.SAMPLERS:
        own = found.sel(sampler=sampler)
        gain, away = own.ell - own.point_ell, np.abs(own["mean"] - reference["mean"]) / reference["sd"]
        rows[f"integrated out by {sampler}"] = {
            **row(own, {"RMSE ahead (K)": "rmse", "ELL ahead": "ell"}), **cell("gain in ELL", gain),
            "median gain": number(np.median, gain),
            f"means from {first} (sd)": np.nan if sampler == first else number(np.max, away),
            "largest R-hat": chains.largest_r_hat(own), "smallest ESS": chains.least_ess(own),
            "divergences": float(own.divergences.sum()), "CPU time (s)": number(np.mean, own.seconds)}
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
