"""Everything that was measured, in three tables."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments.ginzburg_landau import conditional, problem, sampling
from lfm_ppl.experiments.scores import SE, Estimate, mean_of, pair, rate_of

PUBLISHED = {"RAM, EKF": 0.895, "RAM, CKF": 0.935}
"""RMSE of the smoothed state in the source's figure 2.5, for its one realisation."""


def comparison(results: dict[str, Result]) -> pd.DataFrame:
    """Return one row for each method, with means over realisations and their standard errors.

    Args:
        results: of the tasks, by name.

    Returns:
        Columns ``name`` and ``name se``: root mean squared error of filter and smoother over the fine times; the share
        of these times at which the 95% band holds the path; for MCMC the share of realisations in which the 95%
        interval of a parameter (all three pooled) holds the truth, the smallest bulk effective sample size of the three
        per second of CPU time of warm-up and draws, and the largest R-hat; CPU seconds, of all threads, for one
        realisation, without compilation.
    """
    rows: dict[str, dict[str, float]] = {}
    for method in problem.METHODS:
        own = _of(results, f"state/{problem.slug(method)}/")
        if own:
            rows[f"{method}, true parameters"] = _row(own, {
                "RMSE filter": "filter_rmse", "coverage filter": "filter_coverage", "RMSE smoother": "smoother_rmse",
                "coverage smoother": "smoother_coverage", "CPU s": "seconds"})
    for label in sampling.SAMPLERS:
        own = _of(results, f"mcmc/{sampling.slug(label)}/")
        if own:
            rows[label] = _row(own, {
                "RMSE smoother": "smoother_rmse", "coverage smoother": "smoother_coverage",
                "coverage parameters": _covers, "ESS/CPU s": lambda one: one["ess"].min() / one["seconds"],
                "CPU s": "seconds", "R-hat": lambda one: one["r_hat"].max()})
            rows[label]["RMSE published"] = PUBLISHED.get(label, np.nan)
    order = [f"{name}{end}" for name in (
        "RMSE filter", "coverage filter", "RMSE smoother", "coverage smoother", "coverage parameters", "ESS/CPU s",
        "CPU s", "R-hat") for end in ("", SE)] + ["RMSE published"]
    frame = pd.DataFrame.from_dict(rows, orient="index", dtype=float)
    return frame.reindex(columns=[name for name in order if name in frame])


def rates(results: dict[str, Result]) -> pd.DataFrame:
    """Return how often the truth lies outside the central 99% interval of a conditional posterior.

    The standard errors are binomial; those of the pooled rate are of the mean over realisations, since the three
    posteriors of a realisation are not independent. ``cut`` is the share of posteriors that an end of the flat prior's
    interval cuts off, ``differs`` the share of intervals that decide otherwise than the grid's.
    """
    found = conditional.outcomes(results)
    rows: dict[str, dict[str, float]] = {}
    for method, one in found.items():
        outside = one["outside"]
        row: dict[str, float] = {}
        for index, name in enumerate(problem.NAMES):
            row |= pair(name, rate_of(outside[:, index]))
        # Realisations are independent of each other, and the three parameters of one are not.
        pooled = mean_of(outside.mean(axis=1))
        error = pooled.error if outside.any() and len(outside) > 1 else rate_of(outside).error
        row |= pair("pooled", Estimate(pooled.value, error))
        row["cut"] = one["cut"].mean()
        exact = found.get(problem.GRID)
        row["differs"] = np.nan if exact is None else float((outside != exact["outside"]).mean())
        row["CPU s"] = one["seconds"][0] / len(outside)
        rows[method] = row
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)


def parameters(results: dict[str, Result]) -> pd.DataFrame:
    """Return posterior means and standard deviations by MCMC, averaged over realisations, and the coverage of each."""
    rows: dict[str, dict[str, float]] = {}
    for label in sampling.SAMPLERS:
        own = _of(results, f"mcmc/{sampling.slug(label)}/")
        row: dict[str, float] = {}
        for index, name in enumerate(problem.NAMES if own else ()):
            truth = problem.TRUTH[index]
            inside = [one["low"][index] <= truth <= one["high"][index] for one in own]
            row |= pair(f"mean {name}", mean_of([one["mean"][index] for one in own]))
            row |= pair(f"sd {name}", mean_of([one["sd"][index] for one in own]))
            row |= pair(f"coverage {name}", rate_of(inside))
        if own:
            row["divergences"] = float(np.mean([one["divergences"] for one in own]))
            rows[label] = row
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)


def _of(results: dict[str, Result], prefix: str) -> list[Result]:
    return [results[name] for name in sorted(results) if name.startswith(prefix)]


def _row(results: list[Result], columns: dict[str, str | Callable[[Result], Any]]) -> dict[str, float]:
    row: dict[str, float] = {}
    for name, of in columns.items():
        values = [of(one) if callable(of) else one[of] for one in results]
        row |= pair(name, mean_of(values))
    return row


def _covers(one: Result) -> float:
    truth = np.asarray(problem.TRUTH)
    return float(np.mean((one["low"] <= truth) & (truth <= one["high"])))
