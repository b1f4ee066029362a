"""The study: its settings, tasks, tables and figures."""

from __future__ import annotations

from dataclasses import dataclass

from lfm_ppl.engine.task import Task
from lfm_ppl.experiments import study
from lfm_ppl.experiments.periodic_kernels import covariance, figures, regression, tables
from lfm_ppl.experiments.study import Results, Study, Table, setting


@dataclass(frozen=True)
class Settings(study.Settings):
    """How much is computed."""

    runs: int = setting(500, "functions that are drawn and predicted", quick=10, aliases=study.REALISATIONS)
    functions: tuple[int, ...] = setting((3, 5, 7, 11, 15, 22, 31, 45, 63, 88), "numbers of functions of the "
                                         "approximations", quick=(5, 11, 22), increasing=True)
    draws: int = setting(200, "of the sparse spectrum's frequencies, for each number", quick=20)
    points: tuple[int, ...] = setting((20, 22, 25, 30, 40, 60, 100, 200), "of the quadrature grid on the window",
                                      quick=(20, 60), increasing=True)

    def __post_init__(self) -> None:
        """Check what a user gives."""
        super().__post_init__()
        if self.functions[-1] > 200:
            raise ValueError(f"functions must be at most 200, got {self.functions[-1]}.")


def all_tasks(settings: Settings) -> list[Task]:
    """Return every task."""
    return [*covariance.tasks(settings), *regression.tasks(settings)]


def tabulated(settings: Settings, results: Results) -> dict[str, Table]:
    """Return the tables."""
    return {"covariance": Table("Largest error of the covariance, by the number of functions",
                                tables.covariances(settings, results)),
            "published": Table("Squared exponential of scale 10, on a window of 130",
                               tables.published(settings, results)),
            "regression": Table(f"Means over {settings.runs} functions (standard errors)",
                                tables.predictions(settings, results))}


KINDS = {"covariance": covariance.compute, "quadrature": covariance.quadrature, "regression": regression.compute}
"""What the tasks are."""

STUDY = Study(Settings, all_tasks, KINDS, tabulated, figures.draw)
