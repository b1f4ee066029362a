"""How far each method is from the reference, and how well it predicts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.counts import problem
from lfm_ppl.experiments.counts.methods import METHODS, REFERENCE
from lfm_ppl.experiments.scores import Estimate, mean_of, pair, rate_of


def accuracy(settings: Any, results: dict[str, Result]) -> pd.DataFrame:
    """Return one row for each problem and method, with the same parameters.

    Returns:
        ``log Z``, with a standard error where it is one of importance sampling; ``less reference``; ``mean`` and
        ``sd``: largest error of the predictor's posterior means, in posterior sds, and of its sds, as a share;
        ``covered``: share of the true predictor in 95% bands, where there is one; ``seconds`` of CPU time, of an
        evidence with its gradient, or of all draws.
    """
    rows = {}
    for name in settings.problems:
        exact = results[f"{name}/{REFERENCE}"]
        truth = problem.problem(name, settings.size, settings.seed, settings.data).truth
        for method, label in (METHODS | {REFERENCE: REFERENCE}).items():
            found, is_exact = results[f"{name}/{method}"], method == REFERENCE
            mean, sd = found["mean"], found["sd"]
            error = float(exact["log evidence error"])
            row = pair("log Z", Estimate(float(found["log evidence"]), error if is_exact else np.nan))
            if not is_exact:
                row |= pair("less reference", Estimate(float(found["log evidence"] - exact["log evidence"]), error))
                row |= {"mean": float(np.abs((mean - exact["mean"]) / exact["sd"]).max()),
                        "sd": float(np.abs(sd / exact["sd"] - 1.0).max())}
            if truth is not None:
                row["covered"] = scores.covered(mean - scores.Z * sd, mean + scores.Z * sd, truth)
            rows[f"{name}, {label}"] = row | {"seconds": float(found["seconds"])}
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)


def prediction(settings: Any, results: dict[str, Result]) -> pd.DataFrame:
    """Return one row for each problem and method: means over all data, each held out with its fold.

    Returns:
        ``NLPD``, the negative log predictive density; ``less reference``, with the standard error of the differences;
        ``covered``: share of data in their 95% predictive intervals, left out where data are yes or no.
    """
    rows = {}
    for name in settings.problems:
        exact = results[f"{name}/{REFERENCE}"]
        y = problem.problem(name, settings.size, settings.seed, settings.data).y[:, 0]
        for method, label in (METHODS | {REFERENCE: REFERENCE}).items():
            found = results[f"{name}/{method}"]
            row = pair("NLPD", mean_of(-found["log density"]))
            if method != REFERENCE:
                row |= pair("less reference", mean_of(exact["log density"] - found["log density"]))
            if name != "bernoulli":
                row |= pair("covered", rate_of((found["low"] <= y) & (y <= found["high"])))
            rows[f"{name}, {label}"] = row
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)


def reference(settings: Any, results: dict[str, Result]) -> pd.DataFrame:
    """Return what there is to say about the reference: one row for each problem.

    Returns:
        ``ess`` and ``r_hat``, the worst of 40 entries of the predictor; ``share``, the effective share of the draws of
        importance sampling.
    """
    rows = {name: {key: float(results[f"{name}/{REFERENCE}"][key]) for key in ("ess", "r_hat", "share")}
            for name in settings.problems}
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)
