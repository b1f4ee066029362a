"""The study: its settings, tasks, tables and figures."""

from __future__ import annotations

from dataclasses import dataclass

from lfm_ppl.engine.task import Task
from lfm_ppl.experiments import study
from lfm_ppl.experiments.ginzburg_landau import conditional, figures, problem, sampling, state, tables
from lfm_ppl.experiments.study import Results, Study, Table, setting

_PARTS = study.CHAINS[1:]


@dataclass(frozen=True)
class Settings(study.Settings):
    """How much is computed."""

    realisations: int = setting(20, "for states and for MCMC", quick=2, aliases=study.REALISATIONS,
                                per_seed=problem.MOST)
    conditional: int = setting(100, "realisations for the conditional posteriors of single parameters", quick=4,
                               per_seed=problem.MOST)
    particles: int = setting(40_000, "of the filter, for states and in the figure of the conditional posteriors; the "
                             "source's", quick=500)
    smoother_particles: int = setting(1_000, "of the particle smoother", quick=200)
    smoother_draws: int = setting(200, "its trajectories", quick=50)
    conditional_particles: int = setting(4_000, "of the particle filter for the rates", quick=200)
    cells: int = setting(400, "of the grid", quick=160)
    draw_cells: int = setting(240, "of the grid for many parameter values", quick=120)
    nodes: int = setting(61, "parameter values of a conditional posterior", quick=31, least=4)
    paths: int = setting(100, "posterior draws over which the smoothed state is averaged", quick=10)
    marginal_particles: int = setting(1_000, "of particle-marginal RAM", quick=50)
    marginal_steps: int = setting(20, "of its particles between two observations", quick=10)
    ram: tuple[int, int, int] = setting((200, 500, 10), "RAM", quick=(50, 50, 5), parts=_PARTS)
    nuts: tuple[int, int, int] = setting((250, 250, 1), "NUTS", quick=(20, 20, 1), parts=_PARTS)
    pmmh: tuple[int, int, int] = setting((80, 240, 5), "particle-marginal RAM", quick=(10, 20, 2), parts=_PARTS)
    tree_depth: int = setting(10, "largest of NUTS", quick=4)

    @property
    def figure(self) -> int:
        """The realisation of the figures: the model's default data where it is among those computed."""
        return problem.DEFAULT if min(self.realisations, self.conditional) > problem.DEFAULT else 0

    def chain(self, kernel: str) -> tuple[int, int, int]:
        """Return warm-up, draws and thinning of a chain of "RAM", "NUTS" or "PMMH"."""
        return {"RAM": self.ram, "NUTS": self.nuts, "PMMH": self.pmmh}[kernel]


def all_tasks(settings: Settings) -> list[Task]:
    """Return every task: all methods on the first realisations, then on the next, so that the time left can be told."""
    found = [*state.tasks(settings), *conditional.tasks(settings), conditional.figure_task(settings),
             *sampling.tasks(settings)]
    return sorted(found, key=lambda task: task.settings.get("index", task.settings.get("first")))


def tabulated(settings: Settings, results: Results) -> dict[str, Table]:
    """Return the tables."""
    return {"comparison": Table(f"Means over {settings.realisations} realisations (standard errors)",
                                tables.comparison(results)),
            "rates": Table(f"Truth outside the 99% interval of a conditional posterior, {settings.conditional} "
                           "realisations", tables.rates(results)),
            "parameters": Table(f"Posteriors of the parameters, {settings.realisations} realisations",
                                tables.parameters(results))}


KINDS = {"state": state.compute, "conditional": conditional.compute, "mcmc": sampling.compute}
"""What the tasks are."""

STUDY = Study(Settings, all_tasks, KINDS, tabulated, figures.draw, label="method")
