"""The study: its settings, tasks, tables and figures."""

from __future__ import annotations

from dataclasses import dataclass

from lfm_ppl.engine.task import Task
from lfm_ppl.experiments import study
from lfm_ppl.experiments.ballistic import chains, figures, known, parameters, particles, problem, tables, tracking
from lfm_ppl.experiments.study import Results, Study, Table, setting


@dataclass(frozen=True)
class Settings(study.Settings):
    """How much is computed."""

    runs: int = setting(500, "simulated targets", quick=4, aliases=study.REALISATIONS, per_seed=problem.MOST)
    rules: tuple[str, ...] = setting(tuple(tracking.RULES), "linearisation; the model's own must be among them",
                                     quick=(tracking.REPORTED,), choices=tuple(tracking.RULES))
    particle_runs: int = setting(20, "of the targets, the first so many by particles, too", quick=2)
    particles: tuple[int, ...] = setting((500, 2_000, 10_000, 50_000), "their numbers; the source has 50,000",
                                         quick=(500,))
    chain_runs: int = setting(3, "of the targets, the first so many with NUTS and RAM, too", quick=1)
    drawn_runs: int = setting(500, "further targets, whose parameters are drawn from the prior", quick=2)
    draws: int = setting(1_000, "weighted draws of the parameters", quick=300)
    paths: int = setting(50, "draws over which the smoothed paths are averaged", quick=20)
    nuts: tuple[int, int, int, int] = setting((2, 300, 700, 1), "NUTS", quick=(2, 30, 30, 1), parts=study.CHAINS)
    ram: tuple[int, int, int, int] = setting((4, 100, 500, 15), "RAM", quick=(2, 50, 100, 5), parts=study.CHAINS)

    def __post_init__(self) -> None:
        """Check what a user gives."""
        super().__post_init__()
        if tracking.REPORTED not in self.rules:
            raise ValueError(f"rules must hold {tracking.REPORTED!r}, got {self.rules!r}.")


def all_tasks(settings: Settings) -> list[Task]:
    """Return every task: those of the first targets first, so that the time left can be told."""
    found = [*tracking.tasks(settings), *parameters.tasks(settings), *particles.tasks(settings),
             *chains.tasks(settings), *parameters.drawn_tasks(settings), *known.tasks(settings)]
    return sorted(found, key=lambda task: task.settings.get("index", task.settings.get("first")))


def tabulated(settings: Settings, results: Results) -> dict[str, Table]:
    """Return the tables."""
    few, chained = (min(settings.runs, count) for count in (settings.particle_runs, settings.chain_runs))
    return {"tracking": Table(f"Means over {settings.runs} targets (standard errors)",
                              tables.tracked(settings, results)),
            "particles": Table(f"Particles against the Gaussian filter and smoother, {few} targets",
                               tables.against_particles(settings, results)),
            "parameters": Table(f"Parameters, in logarithms, {settings.runs} targets",
                                tables.parameters(settings, results)),
            "agreement": Table(f"Against NUTS, {chained} targets", tables.agreement(settings, results))}


KINDS = {"tracking": tracking.compute, "particles": particles.compute, "parameters": parameters.compute,
         "drawn": parameters.compute, "known": known.compute, "chains": chains.compute}
"""What the tasks are."""

STUDY = Study(Settings, all_tasks, KINDS, tabulated, figures.draw)
