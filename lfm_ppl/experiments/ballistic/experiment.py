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
from lfm_ppl.experiments.ballistic import chains, figures, known, parameters, particles, problem, tables, tracking

TASKS = "tasks"


@dataclass(frozen=True)
class Settings:
    """How much is computed.

    Attributes:
        runs: simulated targets.
        seed: of everything random.
        rules: of linearisation, names of `tracking.RULES`; the first one, the model's own, is always among them.
        particle_runs: of them, the first so many, by particles, too.
        particles: numbers of particles; the source has 50,000.
        chain_runs: of them, the first so many, with NUTS and RAM, too.
        drawn_runs: further targets, whose parameters are drawn from the prior.
        draws: of the parameters, that are weighted.
        paths: draws over which the smoothed paths are averaged.
        nuts: chains, and warm-up, draws and thinning of each, of NUTS.
        ram: of RAM.
    """

    runs: int = 500
    seed: int = 0
    rules: tuple[str, ...] = tuple(tracking.RULES)
    particle_runs: int = 20
    particles: tuple[int, ...] = (500, 2_000, 10_000, 50_000)
    chain_runs: int = 3
    drawn_runs: int = 500
    draws: int = 1_000
    paths: int = 50
    nuts: tuple[int, int, int, int] = (2, 300, 700, 1)
    ram: tuple[int, int, int, int] = (4, 100, 500, 15)

    def __post_init__(self) -> None:
        """Check what a user gives."""
        for name in ("runs", "particle_runs", "drawn_runs", "chain_runs", "draws", "paths"):
            checks.positive_integer(name, getattr(self, name))
        if self.runs > problem.MOST:
            raise ValueError(f"one seed has {problem.MOST} targets; use several seeds for more.")
        if not isinstance(self.particles, tuple) or not self.particles or len(set(self.particles)) < len(
                self.particles):
            raise ValueError(f"particles must be a tuple of different numbers, got {self.particles!r}.")
        for rule in self.rules:
            checks.one_of("rules", rule, tracking.RULES)
        if tracking.REPORTED not in self.rules:
            raise ValueError(f"rules must hold {tracking.REPORTED!r}, got {self.rules!r}.")
        for count in self.particles:
            checks.positive_integer("particles", count)
        for name in ("nuts", "ram"):
            checks.sizes(name, getattr(self, name), ("chains", "warm-up", "draws", "thinning"))


def quick(runs: int = 4, seed: int = 0) -> Settings:
    """Return settings that show in a minute that everything runs, and no more."""
    return Settings(runs, seed, rules=(tracking.REPORTED,), particle_runs=2, particles=(500,), chain_runs=1,
                    drawn_runs=2, draws=300, paths=20, nuts=(2, 30, 30, 1), ram=(2, 50, 100, 5))


class Comparison(NamedTuple):
    """What the experiment found.

    Attributes:
        settings: that it ran with.
        results: of every task, by name.
        tracking: errors, coverage and time at the true and with unknown parameters, one row a method.
        particles: particles against the Gaussian filter on the same targets.
        parameters: most likely values, posteriors and their coverage.
        agreement: weighted draws and RAM against NUTS.
    """

    settings: Settings
    results: dict[str, Result]
    tracking: pd.DataFrame
    particles: pd.DataFrame
    parameters: pd.DataFrame
    agreement: pd.DataFrame


def all_tasks(settings: Settings) -> list[Task]:
    """Return every task: those of the first targets first, so that the time left can be told."""
    found = [*tracking.tasks(settings), *parameters.tasks(settings), *particles.tasks(settings),
             *chains.tasks(settings), *parameters.drawn_tasks(settings), *known.tasks(settings)]
    return sorted(found, key=lambda task: task.settings.get("index", task.settings.get("first")))


def compute(task: Task) -> Result:
    """Compute one task."""
    return {"tracking": tracking.compute, "particles": particles.compute, "parameters": parameters.compute,
            "drawn": parameters.compute, "known": known.compute, "chains": chains.compute}[task.settings["what"]](task)


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
    return Comparison(settings, results, tables.tracked(settings, results), tables.against_particles(settings, results),
                      tables.parameters(settings, results), tables.agreement(settings, results))


def save(found: Comparison, folder: str | Path) -> list[Path]:
    """Write tables and figures, replacing older ones, and return their paths."""
    shown = {"tracking": found.tracking, "particles": found.particles, "parameters": found.parameters,
             "agreement": found.agreement}
    return output.save(folder, shown, figures.draw(found.settings, found.results), "case")
