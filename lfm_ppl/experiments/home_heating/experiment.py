"""The study: its settings, tasks, tables and figures."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jax.scipy.special import logsumexp
from jax.scipy.stats import norm

from lfm_ppl.engine.run import Reporter
from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import scores, study
from lfm_ppl.experiments.home_heating import figures, learning, prediction, problem, tables
from lfm_ppl.experiments.study import Results, Study, Table, setting, stacked

QUANTILES = (0.025, 0.25, 0.5, 0.75, 0.975)
RESIDUALS = ("SQM", "matern")
"""Residuals whose force is drawn."""

_TITLES = {"house": "Real house, {}: the fifth day, means over {} windows (standard errors)",
           "homes": "Simulated homes under a thermostat, {}: the fifth day, means over {} homes (standard errors)",
           "posterior": "Real house, {}: what it gains to integrate the parameters out, {} windows"}


@dataclass(frozen=True)
class Settings(study.Settings):
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
    def chosen(cls, report: Reporter | None, quick: bool = False, **given: Any) -> Self:
        """Return the settings that a user chose, with the folder of the real house where there is one.

        Raises:
            FileNotFoundError: the given folder has no real house.
        """
        folder = problem.data_folder(given.pop("data", None))
        if folder is None and report:
            report(f"no {problem.FILE} in $LFM_DATA/house or ../shared/data/house: simulated homes only")
        return super().chosen(report, quick, data=None if folder is None else str(folder), **given)

    @property
    def shown(self) -> int:
        """The window that is drawn: one in the middle."""
        return self.window_count // 2

    @property
    def window_count(self) -> int:
        """Windows of the real house."""
        if self.data is None:
            return 0
        found = len(problem.house(self.data))
        return found if self.windows is None else min(found, self.windows)


def tasks(settings: Settings) -> list[Task]:
    """Return every task, those of a residual together, since they share what is compiled."""
    found = []
    shared = {"experiment": "home-heating", "functions": settings.functions}
    for store in settings.stores:
        for method in settings.methods:
            own = {**shared, "store": store, "method": method}
            if settings.data is not None:
                house = {**own, "data": str(Path(settings.data).resolve()), "windows": settings.window_count}
                found.append(Task(name("house", store, method), settings.seed, {**house, "shown": settings.shown}))
                if method == settings.integrated and store == settings.stores[0]:
                    found.extend(Task(name(f"posterior/{sampler}", store, method), settings.seed, {
                        **house, "sampler": sampler, "every": settings.every,
                        "chains": list(getattr(settings, sampler.lower()))}) for sampler in learning.SAMPLERS)
            found.append(Task(name("homes", store, method), settings.seed,
                              {**own, "homes": settings.homes, "particles": settings.particles}))
    return found


def name(what: str, store: str, method: str) -> str:
    """Return the name of a task."""
    return f"{what}/{store.replace(' ', '-')}/{method}"


def compute(task: Task) -> Result:
    """Compute one task."""
    started = time.process_time()
    found = {"house": _house, "homes": _homes, "posterior": _posterior}[task.name.split("/")[0]](task)
    return {**found, "cpu_s": time.process_time() - started}


def _model(task: Task) -> tuple[str, str, int]:
    return task.settings["method"], task.settings["store"], task.settings["functions"]


def _house(task: Task) -> Result:
    """Return scores and paths of every window, one after another; each search begins where the last one ended."""
    model, z = _model(task), None
    rows: list[Result] = []
    shown: Result = {}
    for index, window in enumerate(problem.house(task.settings["data"])[:task.settings["windows"]]):
        z, density = learning.most_likely(*model, window, z)
        rows.append({**prediction.known_heater(*model, window, z), "z": z, "density": density})
        if index == task.settings["shown"] and model[0] in RESIDUALS:
            mean, sd = prediction.smoothed(*model)(jnp.asarray(z), jnp.asarray(prediction.masked(window.y)),
                                                   window.outdoor)
            shown = {"residual": np.asarray(mean), "residual_sd": np.asarray(sd)}
    return stacked(rows) | shown


def _homes(task: Task) -> Result:
    """Return scores and paths of every simulated home, and quantiles (5, 144) of the first."""
    model = _model(task)
    rows: list[Result] = []
    first: Result = {}
    for index in range(task.settings["homes"]):
        window = problem.home(index, model[1], task.seed)
        z, _ = learning.most_likely(*model, window)
        key = jax.random.fold_in(task.key, index)
        one, found = prediction.thermostat_ahead(*model, window, z, task.settings["particles"], key)
        rows.append({**one, "z": z})
        if index == 0:
            first = {"quantiles": np.asarray(found.observed.quantiles(QUANTILES))[:, prediction.SCORED, 0]}
    return stacked(rows) | first


def _posterior(task: Task) -> Result:
    """Return scores of some windows with the most likely parameters and with the posterior of all of them."""
    model, z = _model(task), None
    rows: list[Result] = []
    windows = problem.house(task.settings["data"])[:task.settings["windows"]]
    test = problem.TIMES >= problem.TRAIN
    for index, window in enumerate(windows):
        z, _ = learning.most_likely(*model, window, z)
        if index % task.settings["every"]:
            continue
        sampled = learning.posterior(task.settings["sampler"], *model, window, z, jax.random.fold_in(task.key, index),
                                     tuple(task.settings["chains"]))
        draws = sampled["draws"]
        truth, y = window.y[test, 0], jnp.asarray(prediction.masked(window.y))
        several = prediction.filtered_under_draws(*model)(jnp.asarray(scores.spread(draws, 100)), y, window.outdoor)
        mean, variance = several.mean[:, test], several.variance[:, test]
        terms = norm.logpdf(truth, mean, jnp.sqrt(variance))
        point = prediction.known_heater(*model, window, z)
        rows.append({"ell": float((logsumexp(terms, axis=0) - np.log(len(mean))).sum()),
                     "rmse": scores.rmse(mean.mean(axis=0), truth), "point_ell": point["ahead_ell"],
                     "point_rmse": point["ahead_rmse"], "r_hat": np.max(sampled["r_hat"]),
                     "ess": np.min(sampled["ess"]),
                     **{name: sampled[name] for name in ("mean", "sd", "divergences", "seconds")}})
    return stacked(rows)


def title(settings: Settings, name: str) -> str:
    """Return what a table shows."""
    what, _, store = name.partition("-")
    count = settings.homes if what == "homes" else settings.window_count
    if what == "posterior":
        store, count = settings.stores[0], -(-count // settings.every)
    return _TITLES[what].format(store.replace("-", " "), count)


def tabulated(settings: Settings, results: Results) -> dict[str, Table]:
    """Return the tables."""
    found = {name: Table(title(settings, name), frame) for name, frame in tables.every(settings, results).items()}
    if settings.data is None:
        reason = pd.DataFrame({"reason": [f"no {problem.FILE}; give its folder with --data"]}, ["real house"])
        found["left out"] = Table("Left out", reason, reason, stored=False)
    return found


STUDY = Study(Settings, tasks, compute, tabulated, figures.draw, label="residual")
