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
from lfm_ppl.experiments.counts import figures, methods, problem, tables

TASKS = "tasks"


@dataclass(frozen=True)
class Settings:
    """How much is computed.

    Attributes:
        seed: of everything random.
        data: folder with the folders ``coal`` and ``calls``; None: simulated counts.
        problems: names, of `problem.NAMES`.
        size: of the problems.
        draws: of each of four chains of the reference.
    """

    seed: int = 0
    data: str | None = None
    problems: tuple[str, ...] = problem.NAMES
    size: problem.Size = problem.Size()
    draws: int = 5000

    def __post_init__(self) -> None:
        """Check what a user gives."""
        checks.positive_integer("draws", self.draws)
        for name in self.problems:
            checks.one_of("problem", name, problem.NAMES)


def quick(seed: int = 0, data: str | None = None) -> Settings:
    """Return settings that show in a minute that everything runs, and no more."""
    return Settings(seed, data, (problem.COAL,), problem.Size(bins=56, folds=2), draws=500)


class Comparison(NamedTuple):
    """What the experiment found.

    Attributes:
        settings: that it ran with.
        parameters: problem -> what was learnt.
        results: of every task with a method, by name.
        accuracy: how far each method is from the reference.
        prediction: held-out data.
    """

    settings: Settings
    parameters: dict[str, Result]
    results: dict[str, Result]
    accuracy: pd.DataFrame
    prediction: pd.DataFrame


def learning(settings: Settings) -> list[Task]:
    """Return a task for each problem, which finds its parameters."""
    return [Task(f"{name}/parameters", settings.seed,
                 {"problem": name, "size": list(settings.size), "data": settings.data}) for name in settings.problems]


def comparing(settings: Settings, parameters: dict[str, Result]) -> list[Task]:
    """Return a task for each problem and method, which takes the parameters of the problem."""
    return [Task(f"{task.settings['problem']}/{method}", settings.seed,
                 {**task.settings, "method": method, "draws": settings.draws,
                  "parameters": {name: float(value) for name, value in parameters[task.settings["problem"]].items()}})
            for task in learning(settings) for method in (*methods.METHODS, methods.REFERENCE)]


def run(settings: Settings, folder: str | Path, *, overwrite: bool = False, report: Reporter | None = None,
        workers: Workers = 1) -> Comparison:
    """Compute what is not stored yet in ``folder``, and tabulate everything.

    Args:
        settings: how much.
        folder: of the experiment; its subfolder ``tasks`` holds a file for each task.
        overwrite: compute again what was stored with other settings.
        report: what to do with a line of progress; None: nothing.
        workers: what computes; see `run_tasks`.

    Raises:
        FileNotFoundError: data that are not there.
        ValueError: the folder holds results made with other settings.
    """
    for name in settings.problems:
        problem.problem(name, settings.size, settings.seed, settings.data)  # says what is wrong with the data first
    where = Path(folder) / TASKS
    learnt = run_tasks(learning(settings), methods.learn, where, overwrite=overwrite, report=report, workers=workers)
    parameters = {name: learnt[f"{name}/parameters"] for name in settings.problems}
    results = run_tasks(comparing(settings, parameters), methods.compute, where, overwrite=overwrite, report=report,
                        workers=workers)
    return Comparison(settings, parameters, results, tables.accuracy(settings, results),
                      tables.prediction(settings, results))


def save(found: Comparison, folder: str | Path) -> list[Path]:
    """Write tables and figures, replacing older ones, and return their paths."""
    shown = {"accuracy": found.accuracy, "prediction": found.prediction}
    return output.save(folder, shown, figures.draw(found.settings, found.results), "case")
