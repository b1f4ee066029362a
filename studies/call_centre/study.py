"""The study of the call centre: settings, tasks and tables.

1. For each method and test day find the parameters that are most likely given the three days before, and track the test
   day with them (kind ``track``).
2. For some methods marginalise the parameters by importance samples about all modes (``posterior``).
3. On the first test days repeat this with NUTS draws (``nuts``).
4. Score queue and arrivals on the test day, at the service rate of training and at changed rates, and compare them with
   the published errors.

Source: Reece and others (2014), JMLR 15, section 8, tables 2 and 3.
"""

from __future__ import annotations

import itertools
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lfm_ppl.parallel.task import Task
from lfm_ppl.utils.progress import Reporter

from .. import chains, published
from ..datasets import Column, TaskKind, cell, number, row, select_prefix
from ..declaration import CHAINS, REALISATIONS, Data, Study, StudySettings, StudyTable, setting
from . import counts, figures, learning, problem, tracking

PUBLISHED = {
    "constant": {"SQM": (4.6, 2.2, -146, 22), "CQM": (4.4, 1.3, -142, 15), "WQM": (1.8, 0.2, -139, 20),
                 "periodic": (2.2, 0.4, -276, 60), "Matern": (10.6, 5.9, -209, 29)},
    "changed": {"SQM": (7.2, 1.8, -183, 21), "CQM": (15.2, 4.0, -205, 24), "WQM": (3.3, 0.6, -152, 15),
                "periodic": (5.7, 1.2, -725, 301), "Matern": (11.6, 1.1, -305, 49)},
}
"""Test -> method -> RMSE, its standard error, expected log likelihood, its standard error: tables 2 and 3 of the
source."""


@dataclass(frozen=True)
class CallCentreSettings(StudySettings):
    """Sizes of the study."""

    days: int = setting(11, "test days, from the fourth day of the weekday on", quick=2, aliases=REALISATIONS)
    data: str | None = setting(None, "folder of the counts (default: simulated counts)", metavar="FOLDER")
    weekday: str = setting("Thursday", "weekday of all days", choices=counts.WEEKDAYS)
    methods: tuple[str, ...] = setting(problem.METHODS, "forces", quick=("SQM", "Matern"), choices=problem.METHODS)
    link: str = setting("linear", "link of the model file", choices=("linear", "softplus"))
    functions: int = setting(15, "functions that represent a cycle", quick=7)
    integrated: tuple[str, ...] = setting(("SQM",), "methods whose parameters are integrated out as well",
                                          choices=problem.METHODS)
    draws: int = setting(200, "importance samples of their parameters", quick=60)
    mixed: int = setting(20, "draws resampled from these, with which the test day is tracked", quick=5)
    nuts_days: int = setting(1, "test days that are tracked with NUTS draws as well, from the first on")
    nuts: tuple[int, int, int] = setting((2, 150, 200), "NUTS", quick=(2, 8, 8), parts=CHAINS[:3])

    def __post_init__(self) -> None:
        """Check that methods with integrated parameters are among all methods."""
        super().__post_init__()
        if unlisted := [method for method in self.integrated if method not in self.methods]:
            raise ValueError(f"--integrated must be among --methods ({', '.join(self.methods)}), got {unlisted[0]!r}.")


def all_tasks(settings: CallCentreSettings) -> list[Task]:
    """Return all tasks; one task computes all windows of a method, which share compiled programs, except for NUTS."""
    shared = {"study": "call-centre", "link": settings.link, "functions": settings.functions,
              "starts": len(learning.STARTS), "data": settings.data and str(Path(settings.data).resolve()),
              "weekday": settings.weekday, "first": 0, "count": settings.days}
    sizes: dict[str, Any] = {"draws": settings.draws, "mixed": settings.mixed}
    nuts = {**sizes, "chains": list(settings.nuts), "accepted": tracking.TARGET_ACCEPTANCE, "count": 1}

    def task(kind: str, method: str, suffix: str = "", **entries: Any) -> Task:
        return Task(f"{kind}/{method}{suffix}", settings.seed, {**shared, "what": kind, "method": method, **entries})

    return [*(task("track", method) for method in settings.methods),
            *(task("posterior", method, **sizes) for method in settings.integrated),
            *(task("nuts", method, f"/{index:02d}", **nuts, first=index) for method in settings.integrated
              for index in range(min(settings.nuts_days, settings.days)))]


def check(settings: CallCentreSettings, report: Reporter | None) -> None:
    """Check that there are enough days, and report their source; errors as in `problem.load_days`.

    An `OverloadWarning` gives the number of test days with hours of overload.
    """
    days, rate = problem.load_days(settings.data, settings.weekday, settings.seed)
    arrivals = rate * days.calls[problem.TRAINING_DAYS:]
    if settings.days > len(arrivals):
        raise ValueError(f"there are {len(arrivals)} test days on a {settings.weekday}, but {settings.days} are "
                         "requested; reduce --realisations.")
    if report is not None and settings.data is None:
        report("the counts are simulated; give the folder of real ones with --data")
    for test, rates in problem.TEST_RATES.items():
        service = problem.service_rates(rates)[problem.TEST_START:]
        hours = [counts.overload(day, service) for day in arrivals[:settings.days]]
        if overloaded := sum(duration > counts.OVERLOAD_HOURS for duration in hours):
            warnings.warn(f"{test} service rate: on {overloaded} of {settings.days} test days more customers come than "
                          f"are served for over {counts.OVERLOAD_HOURS:g} hours, {max(hours):.1f} at most; queues grow "
                          "meanwhile.", counts.OverloadWarning, stacklevel=3)


def tables(settings: CallCentreSettings, data: Data) -> dict[str, StudyTable]:
    """Return the tables."""
    source = "simulated counts" if settings.data is None else f"counts in {settings.data}"
    days, nuts_days = f"{settings.days} test days, {source}", data["nuts"].sizes["first"]
    return {"constant": StudyTable.from_rows(f"Service rate 10 as in training, {days}",
                                             compare_methods(data, "constant")),
            "changed": StudyTable.from_rows(f"Service rate 15, then 5, {days}", compare_methods(data, "changed")),
            "gain": StudyTable.from_rows("Gain in the log density of a day by integrating the parameters out",
                                         marginalisation_gain(data)),
            "agreement": StudyTable.from_rows(f"Weighted draws against NUTS, test days: {nuts_days}",
                                              compare_with_nuts(data)),
            "learnt": StudyTable.from_rows("Most likely parameters (medians)", median_parameters(settings, data))}


def compare_methods(data: Data, test: str) -> dict[str, Any]:
    """Return means over test days by method, with the published values.

    ``RMSE`` is the root mean squared error of the queue at the ends of the day's 168 counts. ``ELL`` is the sum of the
    log densities of the true queue at these times; the source does not give its number of times, so that only the order
    of methods can be compared. Coverage is that of 95% bands. The mean RMSE is dominated by few days with long queues,
    which is why the median is given as well. ``of Matern`` is relative to the Matern force.
    """
    matern = data["track"][f"{test}_rmse"].reindex({"method": ["Matern"]}).values  # NaN if Matern is not computed
    columns: dict[str, Column] = {
        "RMSE": "rmse", "ELL": "ell", "coverage": "coverage", "RMSE arrivals": "rate_rmse",
        "coverage arrivals": "rate_coverage", "median RMSE": lambda days: np.median(days.rmse),
        "of Matern": lambda days: np.mean(days.rmse.values) / np.mean(matern),
        "of Matern, medians": lambda days: np.median(days.rmse) / np.median(matern)}
    table = {}
    for kind, label in (("track", "{}"), ("posterior", "{}, parameters integrated out")):
        for method in data[kind].method.values:
            name = label.format(method)
            table[name] = row(select_prefix(data[kind].sel({"method": method}), test), columns) | dict(zip(
                ("published RMSE", "published RMSE se", "published ELL", "published ELL se"),
                map(float, PUBLISHED[test].get(name, (np.nan,) * 4)), strict=True))
    return table


def marginalisation_gain(data: Data) -> dict[str, Any]:
    """Return the effect of marginalising the parameters, against the most likely ones, by method and test.

    ``gain`` is the gain in the log density of a day's queue, ``days`` the share of days with a gain, ``RMSE ratio`` the
    ratio of mean errors. ``k`` and ``least ESS`` are the largest Pareto index and the smallest effective sample size of
    the importance samples. ``several modes`` is the share of days with several modes, ``beyond`` the largest share of a
    posterior outside its highest mode.
    """
    table = {}
    for method, test in itertools.product(data["posterior"].method.values, problem.TEST_RATES):
        track, posterior = (data[kind].sel({"method": method}) for kind in ("track", "posterior"))
        likely, integrated = select_prefix(track, test), select_prefix(posterior, test)
        table[f"{method}, {test}"] = cell("gain", integrated.ell - likely.ell) | {
            "days": number(np.mean, integrated.ell > likely.ell),
            "RMSE ratio": number(np.mean, integrated.rmse) / number(np.mean, likely.rmse),
            "coverage, most likely": number(np.mean, likely.coverage),
            "coverage, integrated": number(np.mean, integrated.coverage), "k": number(np.max, posterior.k),
            "least ESS": number(np.min, posterior.ess), "several modes": number(np.mean, posterior.modes > 1),
            "beyond": number(np.max, posterior.beyond)}
    return table


def compare_with_nuts(data: Data) -> dict[str, Any]:
    """Return the agreement of importance samples with NUTS, by method, over the windows that have both.

    The columns are the largest differences of means and standard deviations, see `chains.agreement`; the gains in the
    log density of a day's queue over the most likely parameters, for both tests, by NUTS and by importance samples; and
    the diagnostics of NUTS, with CPU seconds for a window.
    """
    table = {}
    for method in data["nuts"].method.values:
        nuts = data["nuts"].sel({"method": method}).rename(first="dataset").dropna("parameter", how="all")
        selection = {name: slice(nuts.sizes[name]) for name in ("dataset", "parameter")}
        likely, weighted = (data[kind].sel({"method": method}).isel(selection) for kind in ("track", "posterior"))
        shift, ratio = chains.agreement(select_prefix(weighted, "posterior").assign(ess=weighted.ess), nuts)
        table[method] = {"windows": nuts.sizes["dataset"], "means apart (sd)": shift.value,
                         "ratio of sds": ratio.value}
        for test, (name, sampler) in itertools.product(problem.TEST_RATES, (("NUTS", nuts), ("weighted", weighted))):
            table[method] |= cell(f"gain {test}, {name}", sampler[f"{test}_ell"] - likely[f"{test}_ell"])
        table[method] |= {"R-hat": chains.largest_r_hat(nuts), "least ESS": chains.least_ess(nuts),
                          "divergences": int(nuts.divergences.sum()), "CPU s": number(np.mean, nuts.seconds)}
    return table


def median_parameters(settings: CallCentreSettings, data: Data) -> dict[str, Any]:
    """Return medians over windows of the most likely parameters, with log likelihood, evaluations and CPU seconds.

    Evaluations and CPU seconds are sums over all searches of a window.
    """
    table = {}
    for method in settings.methods:
        track = data["track"].sel({"method": method})
        names = problem.ArrivalModel(method.lower(), settings.link, settings.functions).names
        table[method] = dict(zip(names, np.exp(np.median(track.z.values, axis=0))[:len(names)], strict=True)) | {
            "log likelihood": number(np.mean, track.log_likelihood),
            "evaluations": number(np.mean, track.evaluations), "CPU s": number(np.median, track.seconds)}
    return table


def notes(settings: CallCentreSettings, data: Data) -> tuple[str, ...]:
    """Return comparisons of the queue's errors with the published ones, which are for Thursdays and the linear link."""
    is_comparable = settings.data is not None and settings.weekday == "Thursday" and settings.link == "linear"
    if not is_comparable or settings.days < published.FEWEST:
        return ()
    tests = {"constant": "RMSE of the queue, service rate 10", "changed": "RMSE of the queue, service rate 15, then 5"}
    sentences = []
    for test, title in tests.items():
        frame = StudyTable.from_rows(title, compare_methods(data, test)).frame
        comparisons = published.compare_with_published(frame, "RMSE", "published RMSE")
        sentences.append(published.describe_comparisons(title, comparisons))
    return tuple(sentences)


SCORES = ", ".join(f"{test}_{score}" for test in problem.TEST_RATES for score in (
    "rmse", "coverage", "ell", "rate_rmse", "rate_coverage"))
ESTIMATES = ", ".join(f"{test}_{name}" for test in problem.TEST_RATES for name in tracking.QueueEstimate._fields)

KINDS = {
    "track": TaskKind(tracking.track_most_likely, {
        "dataset": f"log_likelihood, evaluations, seconds, {SCORES}", "dataset parameter": "z", "time": ESTIMATES},
                      ("method",)),
    "posterior": TaskKind(tracking.track_marginalised, {
        "dataset": f"k, ess, modes, beyond, {SCORES}", "dataset parameter": "posterior_mean, posterior_sd",
        "time": "shapes, shapes_sd"}, ("method",)),
    "nuts": TaskKind(tracking.track_by_nuts, {
        "": f"divergences, seconds, {SCORES}", "parameter": "mean, sd, ess, r_hat"}, ("method", "first")),
}

STUDY = Study(CallCentreSettings, all_tasks, KINDS, tables, figures.draw, label="method", notes=notes, check=check)
