"""The whole experiment: its settings, its run, and what it leaves in a folder."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from lfm_ppl import checks
from lfm_ppl.engine.cluster import Workers
from lfm_ppl.engine.run import Reporter, run_tasks
from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import output
from lfm_ppl.experiments.call_centre import counts, figures, posterior, problem, tables, tracking
from lfm_ppl.experiments.call_centre.counts import OPEN, OverloadWarning

TASKS = "tasks"


@dataclass(frozen=True)
class Settings:
    """How much is computed.

    Attributes:
        days: test days, from the fourth day of the weekday on.
        seed: of everything random.
        data: folder of the counts; None: simulated counts.
        weekday: of all days.
        methods: names of `tracking.METHODS`.
        link: of the model file.
        functions: of which a cycle is made.
        integrated: the methods whose parameters are integrated out, too; at least one, all of them among ``methods``.
        draws: of their parameters, that are weighted.
        mixed: of them, so many are drawn to track with.
        nuts_days: of the test days, the first so many, by NUTS, too.
        nuts: its chains, and warm-up and draws of each.
    """

    days: int = 11
    seed: int = 0
    data: str | None = None
    weekday: str = "Thursday"
    methods: tuple[str, ...] = tuple(tracking.METHODS)
    link: str = "linear"
    functions: int = 15
    integrated: tuple[str, ...] = ("SQM",)
    draws: int = 200
    mixed: int = 20
    nuts_days: int = 1
    nuts: tuple[int, int, int] = (2, 150, 200)

    def __post_init__(self) -> None:
        """Check what a user gives."""
        for name in ("days", "functions", "draws", "mixed", "nuts_days"):
            checks.positive_integer(name, getattr(self, name))
        checks.sizes("nuts", self.nuts, ("chains", "warm-up", "draws"))
        for method in self.methods:
            checks.one_of("methods", method, tracking.METHODS)
        if not isinstance(self.integrated, tuple) or not self.integrated:
            raise ValueError(f"integrated must be a tuple of at least one method, got {self.integrated!r}.")
        for method in self.integrated:
            checks.one_of("integrated", method, self.methods)
        checks.one_of("weekday", self.weekday, counts.WEEKDAYS)
        checks.one_of("link", self.link, ("linear", "softplus"))

    def windows(self) -> dict[str, Any]:
        """Return which windows there are, as tasks store it."""
        data = self.data and str(Path(self.data).resolve())
        return {"data": data, "weekday": self.weekday, "first": 0, "count": self.days}


def quick(**given: Any) -> Settings:
    """Return settings that show in a few minutes that everything runs, and no more."""
    small: dict[str, Any] = {"days": 2, "methods": ("SQM", "Matern"), "functions": 7, "draws": 60, "mixed": 5,
                             "nuts": (2, 8, 8)}
    return Settings(**small | given)


class Comparison(NamedTuple):
    """What the experiment found.

    Attributes:
        settings: that it ran with.
        results: of every task, by name.
        constant: one row a method, at the service rate of training.
        changed: the same with a changed service rate.
        gain: of integrating the parameters out.
        agreement: of weighted draws with NUTS.
        learnt: most likely parameters.
    """

    settings: Settings
    results: dict[str, Result]
    constant: pd.DataFrame
    changed: pd.DataFrame
    gain: pd.DataFrame
    agreement: pd.DataFrame
    learnt: pd.DataFrame


def all_tasks(settings: Settings) -> list[Task]:
    """Return every task."""
    return [*tracking.tasks(settings), *posterior.tasks(settings), *posterior.nuts_tasks(settings)]


def compute(task: Task) -> Result:
    """Compute one task."""
    kinds = {"track": tracking.compute, "posterior": posterior.compute, "nuts": posterior.compute_nuts}
    return kinds[task.settings["what"]](task)


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
        FileNotFoundError, ValueError: counts that cannot be read, too few days; the folder holds results made with
            other settings.

    Warns:
        OverloadWarning: on some test days more customers come than are served, for hours.
    """
    there = problem.windows(settings.data, settings.weekday, settings.seed)
    if settings.days > there:
        raise ValueError(f"there are {there} test days that are {settings.weekday}, {settings.days} are asked for; "
                         "take fewer (--realisations).")
    if report is not None and settings.data is None:
        report("the counts are simulated; give the folder of real ones with --data")
    _warn_overload(settings)
    results = run_tasks(all_tasks(settings), compute, Path(folder) / TASKS, overwrite=overwrite, report=report,
                        workers=workers)
    return Comparison(settings, results, tables.tracked(settings, results, "constant"),
                      tables.tracked(settings, results, "changed"), tables.gain(settings, results),
                      tables.agreement(settings, results), tables.learnt(settings, results))


def _warn_overload(settings: Settings) -> None:
    """Say once on how many test days more customers come than are served for hours."""
    own, rate = problem.days(settings.data, settings.weekday, settings.seed)
    for name, tested in problem.TESTED.items():
        served = problem.service(tested)[-OPEN:]
        tests = rate * own.calls[problem.TRAIN:problem.TRAIN + settings.days]
        hours = [counts.overload(one, served) for one in tests]
        many = sum(one > counts.WARNED for one in hours)
        if many:
            warnings.warn(f"{name} service rate: on {many} of {settings.days} test days more customers come than are "
                          f"served for over {counts.WARNED:g} hours, {max(hours):.1f} at most; queues grow meanwhile.",
                          OverloadWarning, stacklevel=3)


def save(found: Comparison, folder: str | Path) -> list[Path]:
    """Write tables and figures, replacing older ones, and return their paths."""
    shown = {"constant": found.constant, "changed": found.changed, "gain": found.gain,
             "agreement": found.agreement, "learnt": found.learnt}
    return output.save(folder, shown, figures.draw(found.settings, found.results), "method")
