"""The study: its settings, tasks, tables and figures."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lfm_ppl.engine.run import Reporter
from lfm_ppl.engine.task import Task
from lfm_ppl.experiments import published, study
from lfm_ppl.experiments.call_centre import counts, figures, posterior, problem, tables, tracking
from lfm_ppl.experiments.call_centre.counts import OPEN, OverloadWarning
from lfm_ppl.experiments.study import Results, Study, Table, setting


@dataclass(frozen=True)
class Settings(study.Settings):
    """How much is computed."""

    days: int = setting(11, "test days, from the fourth day of the weekday on", quick=2, aliases=study.REALISATIONS)
    data: str | None = setting(None, "folder of the counts (default: simulated counts)", metavar="FOLDER")
    weekday: str = setting("Thursday", "of all days", choices=counts.WEEKDAYS)
    methods: tuple[str, ...] = setting(tuple(tracking.METHODS), "forces", quick=("SQM", "Matern"),
                                       choices=tuple(tracking.METHODS))
    link: str = setting("linear", "of the model file", choices=("linear", "softplus"))
    functions: int = setting(15, "of which a cycle is made", quick=7)
    integrated: tuple[str, ...] = setting(("SQM",), "the methods whose parameters are integrated out, too",
                                          choices=tuple(tracking.METHODS))
    draws: int = setting(200, "of their parameters, that are weighted", quick=60)
    mixed: int = setting(20, "of them, so many are drawn to track with", quick=5)
    nuts_days: int = setting(1, "of the test days, the first so many by NUTS, too")
    nuts: tuple[int, int, int] = setting((2, 150, 200), "NUTS", quick=(2, 8, 8), parts=study.CHAINS[:3])

    def __post_init__(self) -> None:
        """Check what a user gives."""
        super().__post_init__()
        if other := [method for method in self.integrated if method not in self.methods]:
            raise ValueError(f"--integrated must be among --methods ({', '.join(self.methods)}), got {other[0]!r}.")

    def windows(self) -> dict[str, Any]:
        """Return which windows there are, as tasks store it."""
        data = self.data and str(Path(self.data).resolve())
        return {"data": data, "weekday": self.weekday, "first": 0, "count": self.days}


def all_tasks(settings: Settings) -> list[Task]:
    """Return every task."""
    return [*tracking.tasks(settings), *posterior.tasks(settings), *posterior.nuts_tasks(settings)]


def check(settings: Settings, report: Reporter | None) -> None:
    """Check that there are counts of so many days, and say what they are.

    Raises:
        FileNotFoundError, ValueError: counts that cannot be read, too few days.

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
                          OverloadWarning, stacklevel=4)


def tabulated(settings: Settings, results: Results) -> dict[str, Table]:
    """Return the tables."""
    source = "simulated counts" if settings.data is None else f"counts in {settings.data}"
    days = f"{settings.days} test days, {source}"
    both = min(settings.days, settings.nuts_days)
    return {"constant": Table(f"Service rate 10 as in training, {days}", tables.tracked(settings, results, "constant")),
            "changed": Table(f"Service rate 15, then 5, {days}", tables.tracked(settings, results, "changed")),
            "gain": Table("Gain in the log density of a day by integrating the parameters out",
                          tables.gain(settings, results)),
            "agreement": Table(f"Weighted draws against NUTS, test days: {both}", tables.agreement(settings, results)),
            "learnt": Table("Most likely parameters (medians)", tables.learnt(settings, results))}


def notes(settings: Settings, results: Results) -> tuple[str, ...]:
    """Return how the errors of the queue compare with the published ones, of Thursdays and the linear link."""
    source = settings.data is not None and settings.weekday == "Thursday" and settings.link == "linear"
    if not source or settings.days < published.FEWEST:
        return ()
    tests = {"constant": "RMSE of the queue, service rate 10", "changed": "RMSE of the queue, service rate 15, then 5"}
    return tuple(published.said(what, published.beside(tables.tracked(settings, results, test), "RMSE",
                                                       "published RMSE")) for test, what in tests.items())


KINDS = {"track": tracking.compute, "posterior": posterior.compute, "nuts": posterior.compute_nuts}
"""What the tasks are."""

STUDY = Study(Settings, all_tasks, KINDS, tabulated, figures.draw, label="method", notes=notes, check=check)
