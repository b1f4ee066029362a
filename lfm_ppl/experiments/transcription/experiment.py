"""The whole comparison: its settings, its run, and what it leaves in a folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from scipy.stats import norm

from lfm_ppl import checks
from lfm_ppl.engine.cluster import Workers
from lfm_ppl.engine.run import Reporter, run_tasks
from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import output, scores
from lfm_ppl.experiments.transcription import figures, laplace_modes, problem, slices, smoothers, tables

TASKS = "tasks"
METHODS = ("LA", "ESLS", "GFS", "GHS(7)", "iterated GHS(7)", "LA, trust region")
BLOCK = 10
"""Data sets that are computed in one go, and stored in one file; a run with more of them uses whole blocks again."""


@dataclass(frozen=True)
class Settings:
    """How much is computed.

    Attributes:
        datasets: for each configuration.
        seed: of everything random.
        draws: of elliptical slice sampling for one data set, all chains together; the source's.
        burn_in: the first of them, which are left out.
        configurations: their labels; all by default.
    """

    datasets: int = 100
    seed: int = 0
    draws: int = 100_000
    burn_in: int = 5_000
    configurations: tuple[str, ...] = tuple(one.label for one in problem.CONFIGURATIONS)

    def __post_init__(self) -> None:
        """Check what a user gives."""
        checks.positive_integer("datasets", self.datasets)
        checks.positive_integer("draws", self.draws)
        if not 0 <= self.burn_in < self.draws:
            raise ValueError(f"burn_in must lie in [0, draws) = [0, {self.draws}), got {self.burn_in}.")
        if not self.configurations or isinstance(self.configurations, str):
            raise ValueError(f"configurations must be a tuple of labels, got {self.configurations!r}.")
        for label in self.configurations:
            checks.one_of("configurations", label, [one.label for one in problem.CONFIGURATIONS])


def quick(datasets: int = 2, seed: int = 0, **changes: Any) -> Settings:
    """Return settings that show in a few minutes that everything runs, and no more."""
    return Settings(datasets, seed, draws=4_000, burn_in=400, **changes)


class Comparison(NamedTuple):
    """What the experiment found.

    Attributes:
        settings: that it ran with.
        cells: (configuration, method) -> the results of all its data sets.
        table: a row for each configuration and method.
        published: RMSE and divergences beside the published ones, with a verdict on each RMSE.
        paired: every method against elliptical slice sampling.
    """

    settings: Settings
    cells: dict[tuple[str, str], Result]
    table: pd.DataFrame
    published: pd.DataFrame
    paired: pd.DataFrame


def all_tasks(settings: Settings) -> list[Task]:
    """Return every task: all methods on the first data sets, then on the next, so that the time left can be told."""
    found = []
    for first in range(0, settings.datasets, BLOCK):
        last = min(first + BLOCK, settings.datasets) - 1
        for configuration in problem.CONFIGURATIONS:
            for method in METHODS if configuration.label in settings.configurations else ():
                own: dict = {"draws": settings.draws, "burn_in": settings.burn_in} if method == "ESLS" else {}
                found.append(Task(
                    f"{problem.slug(configuration.label)}/{problem.slug(method)}/{first:03d}-{last:03d}", settings.seed,
                    {"experiment": "transcription", "method": method, "link": configuration.link,
                     "gamma": configuration.gamma, "first": first, "last": last, **own}))
    return found


def compute(task: Task) -> Result:
    """Return what the method says of the force of each data set of the task, and how good it is."""
    settings = task.settings
    configuration = problem.Configuration(settings["link"], settings["gamma"])
    data = [problem.data_set(configuration, index, task.seed)
            for index in range(settings["first"], settings["last"] + 1)]
    method = settings["method"]
    if method in smoothers.SMOOTHERS:
        found = smoothers.compute(settings, data)
    elif method in laplace_modes.SEARCHES:
        found = laplace_modes.compute(settings, data)
    else:
        cell = Task(f"{problem.slug(configuration.label)}/{problem.slug(method)}", task.seed)
        keys = jax.vmap(lambda index: jax.random.fold_in(cell.key, index))(
            jnp.arange(settings["first"], settings["last"] + 1))
        found = slices.compute(settings, data, keys)
    return found | judged(found, np.stack([one.u for one in data]))


def judged(found: Result, truth: np.ndarray) -> Result:
    """Return ``rmse``, ``coverage``, ``nlpd`` and ``diverged`` (N,) of means and standard deviations (N, 363).

    The predictive density of the force at a point of the grid is the normal one with the method's mean and standard
    deviation, for all methods; the band is the mean +- 1.96 standard deviations.
    """
    mean, sd = found["mean"], np.maximum(found["sd"], 1e-12)
    error = np.array([scores.rmse(one, u) if np.isfinite(one).all() else np.inf
                      for one, u in zip(mean, truth, strict=True)])
    z = (truth - mean) / sd
    diverged = ~(error <= problem.DIVERGED)
    if "stopped" in found:
        diverged |= ~np.asarray(found["stopped"], bool)
    return {"rmse": error, "coverage": (np.abs(z) <= scores.Z).mean(axis=1),
            "nlpd": -norm.logpdf(truth, mean, sd).mean(axis=1), "diverged": diverged}


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
        ValueError: the folder holds results made with other settings.
    """
    results = run_tasks(all_tasks(settings), compute, Path(folder) / TASKS, overwrite=overwrite, report=report,
                        workers=workers)
    cells = by_cell(settings, results)
    return Comparison(settings, cells, tables.comparison(cells), tables.beside_published(cells),
                      tables.against_slices(cells))


def by_cell(settings: Settings, results: dict[str, Result]) -> dict[tuple[str, str], Result]:
    """Return (configuration, method) -> the results of all its data sets, one after another."""
    cells = problem.by_cell(all_tasks(settings), results, "method")
    return {cell: {name: np.concatenate([np.atleast_1d(part[name]) for part in parts]) for name in parts[0]}
            for cell, parts in cells.items()}


def save(found: Comparison, folder: str | Path) -> list[Path]:
    """Write tables and figures of a comparison, replacing older ones, and return their paths."""
    shown = {"comparison": found.table, "published": found.published, "paired": found.paired}
    return output.save(folder, shown, figures.draw(found.settings, found.cells), "case")
