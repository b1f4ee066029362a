"""The whole experiment: its settings, its run, and what it leaves in a folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from lfm_ppl import checks
from lfm_ppl.engine.cluster import Workers
from lfm_ppl.engine.run import Reporter, run_tasks
from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import output
from lfm_ppl.experiments.periodic_kernels import covariance, figures, regression, tables

TASKS = "tasks"


@dataclass(frozen=True)
class Settings:
    """How much is computed.

    Attributes:
        runs: functions that are drawn and predicted.
        seed: of everything random.
        functions: numbers of functions of the approximations.
        draws: of the sparse spectrum's frequencies, for each number.
        points: of the quadrature grid on the window.
    """

    runs: int = 500
    seed: int = 0
    functions: tuple[int, ...] = (3, 5, 7, 11, 15, 22, 31, 45, 63, 88)
    draws: int = 200
    points: tuple[int, ...] = (20, 22, 25, 30, 40, 60, 100, 200)

    def __post_init__(self) -> None:
        """Check what a user gives."""
        for name in ("runs", "draws"):
            checks.positive_integer(name, getattr(self, name))
        for name in ("functions", "points"):
            counts = getattr(self, name)
            if not isinstance(counts, tuple) or not counts or list(counts) != sorted(set(counts)):
                raise ValueError(f"{name} must be a tuple of increasing numbers, got {counts!r}.")
            for count in counts:
                checks.positive_integer(name, count)
        if self.functions[-1] > 200:
            raise ValueError(f"functions must be at most 200, got {self.functions[-1]}.")


def quick(runs: int = 10, seed: int = 0) -> Settings:
    """Return settings that show in a minute that everything runs, and no more."""
    return Settings(runs, seed, functions=(5, 11, 22), draws=20, points=(20, 60))


class Comparison(NamedTuple):
    """What the experiment found.

    Attributes:
        settings: that it ran with.
        results: of every task, by name.
        covariance: largest errors of the covariance functions, by kernel and method.
        published: the comparison that the source publishes, and the quadrature grid that it needs.
        regression: errors, log likelihood and coverage of predicted functions.
    """

    settings: Settings
    results: dict[str, Result]
    covariance: pd.DataFrame
    published: pd.DataFrame
    regression: pd.DataFrame


def compute(task: Task) -> Result:
    """Compute one task."""
    return {"covariance": covariance.compute, "quadrature": covariance.quadrature,
            "regression": regression.compute}[task.settings["what"]](task)


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
    every = [*covariance.tasks(settings), *regression.tasks(settings)]
    results = run_tasks(every, compute, Path(folder) / TASKS, overwrite=overwrite, report=report, workers=workers)
    return Comparison(settings, results, tables.covariances(settings, results), tables.published(settings, results),
                      tables.predictions(settings, results))


def save(found: Comparison, folder: str | Path) -> list[Path]:
    """Write tables and figures, replacing older ones, and return their paths."""
    shown = {"covariance": found.covariance, "published": found.published, "regression": found.regression}
    return output.save(folder, shown, figures.draw(found.settings, found.results), "case")
