"""The whole comparison: its settings, its run, and what it leaves in a folder."""

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
from lfm_ppl.experiments.ginzburg_landau import conditional, figures, problem, sampling, state, tables

TASKS = "tasks"


@dataclass(frozen=True)
class Settings:
    """How much is computed.

    Attributes:
        realisations: for states and for MCMC.
        conditional: realisations for the conditional posteriors.
        seed: of everything random.
        particles: of the particle filter, for states and in the figure of the conditional posteriors; the source's.
        smoother_particles: of the particle smoother.
        smoother_draws: its trajectories.
        conditional_particles: of the particle filter for the rates.
        cells: of the grid.
        draw_cells: of the grid for many parameter values.
        nodes: parameter values of a conditional posterior.
        paths: posterior draws over which the smoothed state is averaged.
        marginal_particles: of particle-marginal RAM.
        marginal_steps: of its particles between two observations.
        ram: warm-up, draws and thinning of a chain of RAM.
        nuts: of NUTS.
        pmmh: of particle-marginal RAM.
        tree_depth: largest of NUTS.
    """

    realisations: int = 20
    conditional: int = 100
    seed: int = 0
    particles: int = 40_000
    smoother_particles: int = 1_000
    smoother_draws: int = 200
    conditional_particles: int = 4_000
    cells: int = 400
    draw_cells: int = 240
    nodes: int = 61
    paths: int = 100
    marginal_particles: int = 1_000
    marginal_steps: int = 20
    ram: tuple[int, int, int] = (200, 500, 10)
    nuts: tuple[int, int, int] = (250, 250, 1)
    pmmh: tuple[int, int, int] = (80, 240, 5)
    tree_depth: int = 10

    def __post_init__(self) -> None:
        """Check the numbers that a user gives."""
        for name in ("realisations", "conditional"):
            checks.positive_integer(name, getattr(self, name))
        if self.realisations > problem.MOST or self.conditional > problem.MOST:
            raise ValueError(f"one seed has {problem.MOST} realisations; use several seeds for more.")

    @property
    def figure(self) -> int:
        """The realisation of the figures: the model's default data where it is among those computed."""
        return problem.DEFAULT if min(self.realisations, self.conditional) > problem.DEFAULT else 0

    def chain(self, kernel: str) -> tuple[int, int, int]:
        """Return warm-up, draws and thinning of a chain of "RAM", "NUTS" or "PMMH"."""
        return {"RAM": self.ram, "NUTS": self.nuts, "PMMH": self.pmmh}[kernel]


def quick(realisations: int = 2, conditional: int = 4, seed: int = 0) -> Settings:
    """Return settings that show in a few minutes that everything runs, and no more."""
    return Settings(
        realisations, conditional, seed, particles=500, smoother_particles=200, smoother_draws=50,
        conditional_particles=200, cells=160, draw_cells=120, nodes=31, paths=10, marginal_particles=50,
        marginal_steps=10, ram=(50, 50, 5), nuts=(20, 20, 1), pmmh=(10, 20, 2), tree_depth=4)


class Comparison(NamedTuple):
    """What the experiment found.

    Attributes:
        settings: that it ran with.
        results: of every task, by name.
        table: of everything, one row a method.
        rates: how often the conditional posteriors miss the truth.
        parameters: posterior means and standard deviations by MCMC.
    """

    settings: Settings
    results: dict[str, Result]
    table: pd.DataFrame
    rates: pd.DataFrame
    parameters: pd.DataFrame


def all_tasks(settings: Settings) -> list[Task]:
    """Return every task: all methods on the first realisations, then on the next, so that the time left can be told."""
    found = [*state.tasks(settings), *conditional.tasks(settings), conditional.figure_task(settings),
             *sampling.tasks(settings)]
    return sorted(found, key=lambda task: task.settings.get("index", task.settings.get("first")))


def compute(task: Task) -> Result:
    """Compute one task."""
    return {"state": state.compute, "conditional": conditional.compute,
            "mcmc": sampling.compute}[task.settings["what"]](task)


def run(settings: Settings, folder: str | Path, *, overwrite: bool = False,
        report: Reporter | None = None, workers: Workers = 1) -> Comparison:
    """Compute what is not stored yet in ``folder``, and tabulate everything.

    Args:
        settings: how much.
        folder: of the experiment; its subfolder ``tasks`` holds a file for each task.
        overwrite: compute again what was stored with other settings.
        report: what to do with a line of progress; None: nothing.
        workers: what computes; see `run_tasks`.

    Returns:
        Results and tables.

    Raises:
        ValueError: the folder holds results made with other settings.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:  # doctest: +SKIP
        ...     print(run(quick(), folder).rates)
    """
    results = run_tasks(all_tasks(settings), compute, Path(folder) / TASKS, overwrite=overwrite, report=report,
                        workers=workers)
    return Comparison(settings, results, tables.comparison(results), tables.rates(results), tables.parameters(results))


def save(found: Comparison, folder: str | Path) -> list[Path]:
    """Write tables and figures of a comparison, replacing older ones, and return their paths."""
    tables = {"comparison": found.table, "rates": found.rates, "parameters": found.parameters}
    return output.save(folder, tables, figures.draw(found.settings, found.results), "method")
