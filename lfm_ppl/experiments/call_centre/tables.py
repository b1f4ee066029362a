"""What was measured, in the form of the published tables and beside their numbers."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pandas as pd

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments.call_centre import posterior, tracking
from lfm_ppl.experiments.scores import mean_of, pair

PUBLISHED = {
    "constant": {"SQM": (4.6, 2.2, -146, 22), "CQM": (4.4, 1.3, -142, 15), "WQM": (1.8, 0.2, -139, 20),
                 "periodic": (2.2, 0.4, -276, 60), "Matern": (10.6, 5.9, -209, 29)},
    "changed": {"SQM": (7.2, 1.8, -183, 21), "CQM": (15.2, 4.0, -205, 24), "WQM": (3.3, 0.6, -152, 15),
                "periodic": (5.7, 1.2, -725, 301), "Matern": (11.6, 1.1, -305, 49)},
}
"""Test -> method -> RMSE, its error, expected log likelihood, its error: tables 2 and 3 of the source."""

INTEGRATED = "{}, parameters integrated out"


def by_method(settings: Any, results: dict[str, Result]) -> dict[str, Result]:
    """Return the results of tracking by method, and those with the parameters integrated out."""
    found = {task.settings["method"]: results[task.name] for task in tracking.tasks(settings)}
    for task in posterior.tasks(settings):
        found[INTEGRATED.format(task.settings["method"])] = results[task.name]
    return found


def tracked(settings: Any, results: dict[str, Result], test: str) -> pd.DataFrame:
    """Return one row for each method.

    Args:
        settings: of the experiment.
        results: of its tasks.
        test: "constant" or "changed".

    Returns:
        Means over test days, ``name se`` their standard errors, and what the source has: root mean squared error of
        the queue over the ends of the day's 168 counts; the sum of the log densities of the true queue at these times
        (ELL; the source does not give its number of times, so that only the order can be compared); coverage of 95%
        bands; the same error and coverage of the arrivals; the median error of a day, since the mean is that of few
        days with long queues; and both relative to those of Matern.
    """
    rows = {}
    found = by_method(settings, results)
    reference = found.get("Matern")
    for method, one in found.items():
        row = pair("RMSE", mean_of(one[f"{test}_rmse"])) | pair("ELL", mean_of(one[f"{test}_ell"]))
        row |= pair("coverage", mean_of(one[f"{test}_coverage"]))
        row |= pair("RMSE arrivals", mean_of(one[f"{test}_rate_rmse"]))
        row |= pair("coverage arrivals", mean_of(one[f"{test}_rate_coverage"]))
        row["median RMSE"] = float(np.median(one[f"{test}_rmse"]))
        for name, middle in (("of Matern", np.mean), ("of Matern, medians", np.median)):
            row[name] = np.nan if reference is None else float(
                middle(one[f"{test}_rmse"]) / middle(reference[f"{test}_rmse"]))
        values = PUBLISHED[test].get(method, (np.nan,) * 4)
        rows[method] = row | dict(zip(("published RMSE", "published RMSE se", "published ELL", "published ELL se"),
                                      map(float, values), strict=True))
    return pd.DataFrame.from_dict(rows, orient="index")


def gain(settings: Any, results: dict[str, Result]) -> pd.DataFrame:
    """Return what integrating the parameters out adds to the most likely ones, one row for each method and test.

    Returns:
        The gain in log density of a day's queue, ``days`` the share of days on which there is one, the RMSE as a share
        of that of the most likely parameters, both coverages; the largest Pareto index and the least effective number
        of the weighted draws; the share of days whose posterior has ``several modes``, and the largest share of a
        posterior ``beyond`` its highest mode.
    """
    found, rows = by_method(settings, results), {}
    for method, test in itertools.product(settings.integrated, ("constant", "changed")):
        plain, whole = found[method], found[INTEGRATED.format(method)]
        difference = whole[f"{test}_ell"] - plain[f"{test}_ell"]
        rows[f"{method}, {test}"] = pair("gain", mean_of(difference)) | {
            "days": float(np.mean(difference > 0)),
            "RMSE ratio": float(whole[f"{test}_rmse"].mean() / plain[f"{test}_rmse"].mean()),
            "coverage, most likely": float(plain[f"{test}_coverage"].mean()),
            "coverage, integrated": float(whole[f"{test}_coverage"].mean()),
            "k": float(np.max(whole["k"])), "least ESS": float(np.min(whole["ess"])),
            "several modes": float(np.mean(whole["modes"] > 1)), "beyond": float(np.max(whole["beyond"]))}
    return pd.DataFrame.from_dict(rows, orient="index")


def agreement(settings: Any, results: dict[str, Result]) -> pd.DataFrame:
    """Return how well weighted draws and NUTS agree, one row for each method, over the windows that have both.

    Returns:
        The largest distance of two means in standard deviations of NUTS, over parameters and windows, and the ratio of
        two standard deviations furthest from one; the gains in log density of a day's queue over the most likely
        parameters, both tests, by NUTS and by weighted draws of the same windows; the largest R-hat, the least
        effective number of draws, divergences, and CPU seconds of a window.
    """
    found, rows = by_method(settings, results), {}
    for method in settings.integrated:
        chains = [results[task.name] for task in posterior.nuts_tasks(settings) if task.settings["method"] == method]
        plain, whole, count = found[method], found[INTEGRATED.format(method)], len(chains)
        mean, sd = (np.array([one[name] for one in chains]) for name in ("mean", "sd"))
        ratio = (whole["posterior_sd"][:count] / sd).ravel()
        rows[method] = {"windows": count,
                        "means apart (sd)": float((np.abs(whole["posterior_mean"][:count] - mean) / sd).max()),
                        "ratio of sds": float(ratio[np.argmax(np.abs(np.log(ratio)))])}
        for test in ("constant", "changed"):
            before = plain[f"{test}_ell"][:count]
            by_nuts = np.array([one[f"{test}_ell"] for one in chains])
            rows[method] |= pair(f"gain {test}, NUTS", mean_of(by_nuts - before))
            rows[method] |= pair(f"gain {test}, weighted", mean_of(whole[f"{test}_ell"][:count] - before))
        rows[method] |= {"R-hat": float(max(one["r_hat"].max() for one in chains)),
                         "least ESS": float(min(one["ess"].min() for one in chains)),
                         "divergences": int(sum(one["divergences"] for one in chains)),
                         "CPU s": float(np.mean([one["seconds"] for one in chains]))}
    return pd.DataFrame.from_dict(rows, orient="index")


def learnt(settings: Any, results: dict[str, Result]) -> pd.DataFrame:
    """Return the most likely parameters: medians over windows, the log likelihood, and what a window took.

    Evaluations and CPU seconds are those of all its searches.
    """
    rows = {}
    for task in tracking.tasks(settings):
        one = results[task.name]
        names = tracking.method_of(task).names
        rows[task.settings["method"]] = {
            **dict(zip(names, np.exp(np.median(one["z"], axis=0)), strict=True)),
            "log likelihood": float(np.mean(one["log_likelihood"])),
            "evaluations": float(np.mean(one["evaluations"])), "CPU s": float(np.median(one["seconds"]))}
    return pd.DataFrame.from_dict(rows, orient="index")
