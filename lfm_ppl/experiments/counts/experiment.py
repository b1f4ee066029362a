"""The study: its settings, tasks, tables and figures."""

from __future__ import annotations

from dataclasses import dataclass

from lfm_ppl.engine.run import Reporter
from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import study
from lfm_ppl.experiments.counts import figures, methods, problem, tables
from lfm_ppl.experiments.study import Results, Study, Table, setting


@dataclass(frozen=True)
class Settings(study.Settings):
    """How much is computed."""

    data: str | None = setting(None, "folder with the folders coal and calls (default: simulated counts)",
                               metavar="FOLDER")
    problems: tuple[str, ...] = setting(problem.NAMES, "data and their families", quick=(problem.COAL,),
                                        choices=problem.NAMES)
    size: problem.Size = setting(problem.Size(), "", quick=problem.Size(bins=56, folds=2))
    draws: int = setting(5000, "of each of four chains of the reference", quick=500)


def learning(settings: Settings) -> list[Task]:
    """Return a task for each problem, which finds its parameters."""
    return [Task(f"{name}/parameters", settings.seed,
                 {"problem": name, "size": list(settings.size), "data": settings.data}) for name in settings.problems]


def comparing(settings: Settings, results: Results) -> list[Task]:
    """Return a task for each problem and method, which takes the parameters of the problem."""
    return [Task(f"{task.settings['problem']}/{method}", settings.seed,
                 {**task.settings, "method": method, "draws": settings.draws,
                  "parameters": {name: float(value) for name, value in results[task.name].items()}})
            for task in learning(settings) for method in (*methods.METHODS, methods.REFERENCE)]


def compute(task: Task) -> Result:
    """Compute one task."""
    return methods.compute(task) if "method" in task.settings else methods.learn(task)


def check(settings: Settings, report: Reporter | None) -> None:
    """Raise FileNotFoundError or ValueError where something is wrong with the data."""
    for name in settings.problems:
        problem.problem(name, settings.size, settings.seed, settings.data)


def tabulated(settings: Settings, results: Results) -> dict[str, Table]:
    """Return the tables."""
    return {"accuracy": Table("Posterior of the predictor (mean: largest error in sds; sd: largest relative error)",
                              tables.accuracy(settings, results)),
            "prediction": Table(f"Held-out data, {settings.size.folds} folds", tables.prediction(settings, results))}


def notes(settings: Settings, results: Results) -> tuple[str, ...]:
    """Return what there is to say about the reference and the parameters."""
    checked = tables.reference(settings, results)
    return (f"Reference: elliptical slices, at least {checked['ess'].min():.0f} effective draws, R-hat at most "
            f"{checked['r_hat'].max():.3f}; log Z by importance sampling, effective share of the draws at least "
            f"{checked['share'].min():.2f}.",
            "Parameters are those at the mode of the posterior with EP's evidence, or the true ones of simulated data; "
            "all methods take the same.")


STUDY = Study(Settings, learning, compute, tabulated, figures.draw, notes=notes, then=comparing, check=check)
