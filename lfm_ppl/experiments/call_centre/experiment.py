"""The study: its settings, tasks and tables."""

from __future__ import annotations

import itertools
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lfm_ppl.engine.run import Reporter
from lfm_ppl.engine.task import Task
from lfm_ppl.experiments import chains, published, study
from lfm_ppl.experiments.call_centre import counts, figures, learning, problem, tracking
from lfm_ppl.experiments.datasets import Column, TaskKind, cell, number, row, select_prefix
from lfm_ppl.experiments.study import Data, Study, StudyTable, setting

PUBLISHED = {
    "constant": {"SQM": (4.6, 2.2, -146, 22), "CQM": (4.4, 1.3, -142, 15), "WQM": (1.8, 0.2, -139, 20),
                 "periodic": (2.2, 0.4, -276, 60), "Matern": (10.6, 5.9, -209, 29)},
    "changed": {"SQM": (7.2, 1.8, -183, 21), "CQM": (15.2, 4.0, -205, 24), "WQM": (3.3, 0.6, -152, 15),
                "periodic": (5.7, 1.2, -725, 301), "Matern": (11.6, 1.1, -305, 49)},
}
"""Test -> method -> RMSE, its error, expected log likelihood, its error: tables 2 and 3 of the source."""


@dataclass(frozen=True)
class CallCentreSettings(study.StudySettings):
    """How much is computed."""

    days: int = setting(11, "test days, from the fourth day of the weekday on", quick=2, aliases=study.REALISATIONS)
    data: str | None = setting(None, "folder of the counts (default: simulated counts)", metavar="FOLDER")
    weekday: str = setting("Thursday", "of all days", choices=counts.WEEKDAYS)
    methods: tuple[str, ...] = setting(problem.METHODS, "forces", quick=("SQM", "Matern"), choices=problem.METHODS)
    link: str = setting("linear", "of the model file", choices=("linear", "softplus"))
    functions: int = setting(15, "of which a cycle is made", quick=7)
    integrated: tuple[str, ...] = setting(("SQM",), "the methods whose parameters are integrated out, too",
                                          choices=problem.METHODS)
    draws: int = setting(200, "of their parameters, that are weighted", quick=60)
    mixed: int = setting(20, "of them, so many are drawn to track with", quick=5)
    nuts_days: int = setting(1, "of the test days, the first so many by NUTS, too")
    nuts: tuple[int, int, int] = setting((2, 150, 200), "NUTS", quick=(2, 8, 8), parts=study.CHAINS[:3])

    def __post_init__(self) -> None:
        """Check what a user gives."""
        super().__post_init__()
        if other := [method for method in self.integrated if method not in self.methods]:
            raise ValueError(f"--integrated must be among --methods ({', '.join(self.methods)}), got {other[0]!r}.")


def all_tasks(settings: CallCentreSettings) -> list[Task]:
    """Return every task: what is compiled for a method serves all windows, but for the chains."""
    shared = {"experiment": "call-centre", "link": settings.link, "functions": settings.functions,
              "starts": len(learning.STARTS), "data": settings.data and str(Path(settings.data).resolve()),
              "weekday": settings.weekday, "first": 0, "count": settings.days}
    sizes: dict[str, Any] = {"draws": settings.draws, "mixed": settings.mixed}
    nuts = {**sizes, "chains": list(settings.nuts), "accepted": tracking.ACCEPTED, "count": 1}

    def task(what: str, method: str, ending: str = "", **more: Any) -> Task:
        return Task(f"{what}/{method}{ending}", settings.seed, {**shared, "what": what, "method": method, **more})

    return [*(task("track", method) for method in settings.methods),
            *(task("posterior", method, **sizes) for method in settings.integrated),
            *(task("nuts", method, f"/{index:02d}", **nuts, first=index) for method in settings.integrated
              for index in range(min(settings.nuts_days, settings.days)))]


def check(settings: CallCentreSettings, report: Reporter | None) -> None:
    """Check that there are counts of so many days, and say what they are; errors as of `problem.days`.

    An `OverloadWarning` says on how many test days more customers come than are served, for hours.
    """
    chosen, rate = problem.days(settings.data, settings.weekday, settings.seed)
    arrivals = rate * chosen.calls[problem.TRAIN:]
    if settings.days > len(arrivals):
        raise ValueError(f"there are {len(arrivals)} test days that are {settings.weekday}, {settings.days} are asked "
                         "for; take fewer (--realisations).")
    if report is not None and settings.data is None:
        report("the counts are simulated; give the folder of real ones with --data")
    for test, rates in problem.TESTED.items():
        served = problem.service(rates)[problem.FIRST:]
        hours = [counts.overload(day, served) for day in arrivals[:settings.days]]
        if many := sum(over > counts.WARNED for over in hours):
            warnings.warn(f"{test} service rate: on {many} of {settings.days} test days more customers come than are "
                          f"served for over {counts.WARNED:g} hours, {max(hours):.1f} at most; queues grow meanwhile.",
                          counts.OverloadWarning, stacklevel=3)


def tables(settings: CallCentreSettings, data: Data) -> dict[str, StudyTable]:
    """Return the tables."""
    source = "simulated counts" if settings.data is None else f"counts in {settings.data}"
    days, chained = f"{settings.days} test days, {source}", data["nuts"].sizes["first"]
    return {"constant": StudyTable.from_rows(f"Service rate 10 as in training, {days}", tracked(data, "constant")),
            "changed": StudyTable.from_rows(f"Service rate 15, then 5, {days}", tracked(data, "changed")),
            "gain": StudyTable.from_rows("Gain in the log density of a day by integrating the parameters out",
                                         gain(data)),
            "agreement": StudyTable.from_rows(f"Weighted draws against NUTS, test days: {chained}", agreement(data)),
            "learnt": StudyTable.from_rows("Most likely parameters (medians)", learnt(settings, data))}


def tracked(data: Data, test: str) -> dict[str, Any]:
    """Return means over test days by method, and what the source has.

    They are the root mean squared error of the queue over the ends of the day's 168 counts; the sum of the log
    densities of the true queue at these times (ELL; the source does not give its number of times, so that only the
    order can be compared); coverage of 95% bands; the same error and coverage of the arrivals; the median error of a
    day, since the mean is that of few days with long queues; and both relative to those of Matern.
    """
    matern = data["track"][f"{test}_rmse"].reindex({"method": ["Matern"]}).values  # NaN where it is not there
    columns: dict[str, Column] = {
        "RMSE": "rmse", "ELL": "ell", "coverage": "coverage", "RMSE arrivals": "rate_rmse",
        "coverage arrivals": "rate_coverage", "median RMSE": lambda one: np.median(one.rmse),
        "of Matern": lambda one: np.mean(one.rmse.values) / np.mean(matern),
        "of Matern, medians": lambda one: np.median(one.rmse) / np.median(matern)}
    rows = {}
    for what, label in (("track", "{}"), ("posterior", "{}, parameters integrated out")):
        for method in data[what].method.values:
            name = label.format(method)
            rows[name] = row(select_prefix(data[what].sel({"method": method}), test), columns) | dict(zip(
                ("published RMSE", "published RMSE se", "published ELL", "published ELL se"),
                map(float, PUBLISHED[test].get(name, (np.nan,) * 4)), strict=True))
    return rows


def gain(data: Data) -> dict[str, Any]:
    """Return what marginalising the parameters adds to the most likely ones, by method and test.

    That is the gain in log density of a day's queue, ``days`` the share of days on which there is one, the RMSE as a
    share of that of the most likely parameters, both coverages; the largest Pareto index and the least effective number
    of the importance samples; the share of days whose posterior has ``several modes``, and the largest share of a
    posterior ``beyond`` its highest mode.
    """
    rows = {}
    for method, test in itertools.product(data["posterior"].method.values, problem.TESTED):
        likely, whole = (data[what].sel({"method": method}) for what in ("track", "posterior"))
        before, after = select_prefix(likely, test), select_prefix(whole, test)
        rows[f"{method}, {test}"] = cell("gain", after.ell - before.ell) | {
            "days": number(np.mean, after.ell > before.ell),
            "RMSE ratio": number(np.mean, after.rmse) / number(np.mean, before.rmse),
            "coverage, most likely": number(np.mean, before.coverage),
            "coverage, integrated": number(np.mean, after.coverage), "k": number(np.max, whole.k),
            "least ESS": number(np.min, whole.ess), "several modes": number(np.mean, whole.modes > 1),
            "beyond": number(np.max, whole.beyond)}
    return rows


def agreement(data: Data) -> dict[str, Any]:
    """Return how well importance samples and NUTS agree, by method, over the windows that have both.

    That is how far means and standard deviations are apart at most, see `chains.agreement`; the gains in log density of
    a day's queue over the most likely parameters, both tests, by NUTS and by importance samples of the same windows;
    the largest R-hat, the least effective number of draws, divergences, and CPU seconds of a window.
    """
    rows = {}
    for method in data["nuts"].method.values:
        nuts = data["nuts"].sel({"method": method}).rename(first="dataset").dropna("parameter", how="all")
        same = {name: slice(nuts.sizes[name]) for name in ("dataset", "parameter")}
        likely, weighted = (data[what].sel({"method": method}).isel(same) for what in ("track", "posterior"))
        shift, ratio = chains.agreement(select_prefix(weighted, "posterior").assign(ess=weighted.ess), nuts)
        rows[method] = {"windows": nuts.sizes["dataset"], "means apart (sd)": shift.value, "ratio of sds": ratio.value}
        for test, (name, sampler) in itertools.product(problem.TESTED, (("NUTS", nuts), ("weighted", weighted))):
            rows[method] |= cell(f"gain {test}, {name}", sampler[f"{test}_ell"] - likely[f"{test}_ell"])
        rows[method] |= {"R-hat": chains.largest_r_hat(nuts), "least ESS": chains.least_ess(nuts),
                         "divergences": int(nuts.divergences.sum()), "CPU s": number(np.mean, nuts.seconds)}
    return rows


def learnt(settings: CallCentreSettings, data: Data) -> dict[str, Any]:
    """Return the most likely parameters: medians over windows, the log likelihood, and what a window took.

    Evaluations and CPU seconds are those of all its searches.
    """
    rows = {}
    for method in settings.methods:
        found = data["track"].sel({"method": method})
        names = problem.Method(method.lower(), settings.link, settings.functions).names
        rows[method] = dict(zip(names, np.exp(np.median(found.z.values, axis=0))[:len(names)], strict=True)) | {
            "log likelihood": number(np.mean, found.log_likelihood),
            "evaluations": number(np.mean, found.evaluations), "CPU s": number(np.median, found.seconds)}
    return rows


def notes(settings: CallCentreSettings, data: Data) -> tuple[str, ...]:
    """Return how the errors of the queue compare with the published ones, of Thursdays and the linear link."""
    real = settings.data is not None and settings.weekday == "Thursday" and settings.link == "linear"
    if not real or settings.days < published.FEWEST:
        return ()
    tests = {"constant": "RMSE of the queue, service rate 10", "changed": "RMSE of the queue, service rate 15, then 5"}
    sentences = []
    for test, title in tests.items():
        frame = StudyTable.from_rows(title, tracked(data, test)).frame
        comparisons = published.compare_with_published(frame, "RMSE", "published RMSE")
        sentences.append(published.describe_comparisons(title, comparisons))
    return tuple(sentences)


SCORES = ", ".join(f"{test}_{score}" for test in problem.TESTED for score in (
    "rmse", "coverage", "ell", "rate_rmse", "rate_coverage"))
TRACKED = ", ".join(f"{test}_{name}" for test in problem.TESTED for name in tracking.Tracked._fields)

STUDY = Study(
    CallCentreSettings, all_tasks,
    {"track": TaskKind(tracking.most_likely, {
        "dataset": f"log_likelihood, evaluations, seconds, {SCORES}", "dataset parameter": "z", "time": TRACKED},
                       ("method",)),
     "posterior": TaskKind(tracking.marginalised, {
         "dataset": f"k, ess, modes, beyond, {SCORES}", "dataset parameter": "posterior_mean, posterior_sd",
         "time": "shapes, shapes_sd"}, ("method",)),
     "nuts": TaskKind(tracking.by_nuts, {"": f"divergences, seconds, {SCORES}", "parameter": "mean, sd, ess, r_hat"},
                      ("method", "first"))},
    tables, figures.draw, label="method", notes=notes, check=check)
