"""The whole experiment: its settings, its run, and what it leaves in a folder."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jax.scipy.special import logsumexp
from jax.scipy.stats import norm

from lfm_ppl import checks
from lfm_ppl.engine.cluster import Workers
from lfm_ppl.engine.run import Reporter, run_tasks
from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import output, scores
from lfm_ppl.experiments.home_heating import figures, learning, prediction, problem, tables

QUANTILES = (0.025, 0.25, 0.5, 0.75, 0.975)
RESIDUALS = ("SQM", "matern")
"""Residuals whose force is drawn."""


@dataclass(frozen=True)
class Settings:
    """How much is computed.

    Attributes:
        data: folder of the real house; None: simulated homes only.
        homes: simulated homes.
        windows: of the real house, the first so many; None: all.
        seed: of everything random.
        methods: residuals, of `problem.METHODS`.
        stores: of `problem.STORES`.
        functions: eigenfunctions.
        particles: of a prediction under a thermostat.
        integrated: residual whose parameters are integrated out, too.
        every: in every so many windows.
        ram: chains, warm-up and draws of each, of RAM.
        nuts: of NUTS.
    """

    data: str | None = None
    homes: int = 10
    windows: int | None = None
    seed: int = 0
    methods: tuple[str, ...] = problem.METHODS
    stores: tuple[str, ...] = problem.STORES
    functions: int = 15
    particles: int = 1000
    integrated: str = "SQM"
    every: int = 7
    ram: tuple[int, int, int] = (4, 1000, 3000)
    nuts: tuple[int, int, int] = (2, 120, 180)

    def __post_init__(self) -> None:
        """Check what a user gives."""
        for name in ("homes", "functions", "particles", "every"):
            checks.positive_integer(name, getattr(self, name))
        if self.windows is not None:
            checks.positive_integer("windows", self.windows)
        for name in ("ram", "nuts"):
            checks.sizes(name, getattr(self, name), ("chains", "warm-up", "draws"))
        for name, known in (("methods", problem.METHODS), ("stores", problem.STORES)):
            for one in getattr(self, name):
                checks.one_of(name, one, known)
        checks.one_of("integrated", self.integrated, self.methods)

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


def quick(**given: Any) -> Settings:
    """Return settings that show in a few minutes that everything runs, and no more."""
    small: dict[str, Any] = {"homes": 2, "windows": 2, "methods": ("SQM", "none", "matern"),
                             "stores": problem.STORES[:1], "functions": 5, "particles": 200, "ram": (2, 50, 50),
                             "nuts": (2, 8, 8)}
    return Settings(**small | given)


class Comparison(NamedTuple):
    """What the experiment found.

    Attributes:
        settings: that it ran with.
        results: of every task, by name.
        tables: name -> table.
    """

    settings: Settings
    results: dict[str, Result]
    tables: dict[str, pd.DataFrame]


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
    return {**_stacked(rows), **shown}


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
    return {**_stacked(rows), **first}


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
    return _stacked(rows)


def _stacked(rows: list[Result]) -> Result:
    return {key: np.stack([np.asarray(row[key]) for row in rows]) for key in rows[0]}


def run(settings: Settings, folder: str | Path, *, overwrite: bool = False,
        report: Reporter | None = None, workers: Workers = 1) -> Comparison:
    """Compute what is not stored yet in ``folder``, and tabulate everything.

    Args:
        settings: how much.
        folder: of the experiment; its subfolder ``tasks`` holds a file for each task.
        overwrite: compute again what was stored with other settings.
        report: what to do with a line of progress; None: nothing.
        workers: what computes; see `run_tasks`.

    Raises:
        ValueError: the folder holds results made with other settings; a file of the house that cannot be used.
    """
    results = run_tasks(tasks(settings), compute, Path(folder) / "tasks", overwrite=overwrite, report=report,
                        workers=workers)
    return Comparison(settings, results, tables.every(settings, results))


def save(found: Comparison, folder: str | Path) -> list[Path]:
    """Write tables and figures, replacing older ones, and return their paths."""
    return output.save(folder, found.tables, figures.draw(found.settings, found.results), "residual")
