"""The study: its settings, tasks, tables and figures."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy.stats import norm

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import published, scores, study
from lfm_ppl.experiments.study import Results, Study, Table, blocks, setting
from lfm_ppl.experiments.transcription import figures, laplace_modes, problem, slices, smoothers, tables

METHODS = ("LA", "ESLS", "GFS", "GHS(7)", "iterated GHS(7)", "LA, trust region")
BLOCK = 10
"""Data sets that are computed in one go, and stored in one file; a run with more of them uses whole blocks again."""

TRUST = (
    "Where elliptical slice sampling is lower than published it is trusted: it has the exact posterior of a linear "
    "link and agrees with blackjax's independent elliptical slice sampler on five data sets (both are tests), and "
    "chains whose R-hat is above 1.01 go on, up to five times as long (`mixed` and `ESS` say how that ended). This "
    "says nothing of LA and GFS, which draw nothing.")
"""Why a lower error is believed."""

_LABELS = tuple(one.label for one in problem.CONFIGURATIONS)


@dataclass(frozen=True)
class Settings(study.Settings):
    """How much is computed."""

    datasets: int = setting(100, "for each configuration", quick=2, aliases=study.REALISATIONS)
    draws: int = setting(100_000, "of elliptical slice sampling for one data set, all chains together; the source's",
                         quick=4_000)
    burn_in: int = setting(5_000, "the first of them, which are left out", quick=400, least=0)
    configurations: tuple[str, ...] = setting(_LABELS, "how the factor acts", choices=_LABELS)

    def __post_init__(self) -> None:
        """Check what a user gives."""
        super().__post_init__()
        if not 0 <= self.burn_in < self.draws:
            raise ValueError(f"burn_in must lie in [0, draws) = [0, {self.draws}), got {self.burn_in}.")


def all_tasks(settings: Settings) -> list[Task]:
    """Return every task: all methods on the first data sets, then on the next, so that the time left can be told."""
    found = []
    for first, last in blocks(settings.datasets, BLOCK):
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


def by_cell(settings: Settings, results: Results) -> dict[tuple[str, str], Result]:
    """Return (configuration, method) -> the results of all its data sets, one after another."""
    cells = problem.by_cell(all_tasks(settings), results, "method")
    return {cell: {name: np.concatenate([np.atleast_1d(part[name]) for part in parts]) for name in parts[0]}
            for cell, parts in cells.items()}


def tabulated(settings: Settings, results: Results) -> dict[str, Table]:
    """Return the tables."""
    cells = by_cell(settings, results)
    return {"published": Table(f"RMSE of the force and divergences, {settings.datasets} data sets, beside the "
                               "published table", tables.beside_published(cells)),
            "comparison": Table(f"Means over {settings.datasets} data sets (standard errors)",
                                tables.comparison(cells)),
            "paired": Table("Against elliptical slice sampling on the same data sets", tables.against_slices(cells))}


def drawn(settings: Settings, results: Results) -> dict[str, Figure]:
    """Return the figures."""
    return figures.draw(settings, by_cell(settings, results))


def notes(settings: Settings, results: Results) -> tuple[str, ...]:
    """Return how many cells are consistent with the published table, and why lower ones are trusted."""
    table = tables.beside_published(by_cell(settings, results))
    return published.summary(tables.verdicts(table).values()), TRUST


STUDY = Study(Settings, all_tasks, compute, tabulated, drawn, notes=notes)
