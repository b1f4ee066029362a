"""Everything that was measured, in three tables."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments.periodic_kernels import covariance, regression
from lfm_ppl.experiments.scores import Estimate, mean_of, pair

PUBLISHED = {regression.SPARSE: (0.36, 3.03, -6.9e4), regression.SPARSE_4: (0.23, 2.74, -1.2e4),
             regression.KPCA: (9.6e-5, 2.49, 75.0)}
"""Largest error of the covariance, error and expected log likelihood that the source publishes."""


def covariances(settings: Any, results: dict[str, Result]) -> pd.DataFrame:
    """Return one row for each kernel and method: the largest error of the covariance by the number of functions.

    Returns:
        Columns ``3``, ``5``, ...: numbers of functions. The row ``left out`` is the mean variance that the
        eigenfunctions miss. ``significant`` is the number at the default share of the largest eigenvalue, 1/100, and
        ``error there`` that of its covariance.
    """
    rows = {}
    for task in covariance.tasks(settings):
        if task.settings["what"] != "covariance":
            continue
        found = results[task.name]
        for method in (*covariance.METHODS, "left out"):
            if np.isfinite(found[method]).any():
                row = {str(count): float(value) for count, value in zip(settings.functions, found[method], strict=True)}
                if method == covariance.EIGENFUNCTIONS:
                    row |= {"significant": float(found["significant"]), "error there": float(found["at default"])}
                rows[f"{task.settings['kernel'].replace('_', '/')}, {method}"] = row
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)


def published(settings: Any, results: dict[str, Result]) -> pd.DataFrame:
    """Return the errors of 22 eigenfunctions by their quadrature points, and of random frequencies.

    Returns:
        ``error`` of the covariance, for random frequencies the mean over 100 draws, ``least`` of them, and what the
        source has.
    """
    found = results["quadrature"]
    rows: dict[str, dict[str, float]] = {}
    for points, error in zip(settings.points, found["error"], strict=True):
        rows[f"{min(22, points)} eigenfunctions, {points} points"] = pair("error", Estimate(float(error), np.nan))
    for label, key in ((regression.SPARSE, "sparse 22"), (regression.SPARSE_4, "sparse 88")):
        rows[label] = pair("error", mean_of(found[key])) | {"least": float(found[key].min()),
                                                            "published": PUBLISHED[label][0]}
    last = f"22 eigenfunctions, {settings.points[-1]} points"
    if last in rows:
        rows[last]["published"] = PUBLISHED[regression.KPCA][0]
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)


def predictions(settings: Any, results: dict[str, Result]) -> pd.DataFrame:
    """Return one row for each approximation, over the functions that were drawn.

    Returns:
        Means with standard errors: ``RMSE`` over the predicted points, ``root of sum``, the same without the division
        by their number, ``log likelihood``, the sum of the points' log densities, ``coverage`` of 95% bands; and the
        published figures, whose window and points the source does not state.
    """
    rows = {}
    for task in regression.tasks(settings):
        found, method = results[task.name], task.settings["method"]
        count = len(np.atleast_1d(found["mean"]))
        row = pair("RMSE", mean_of(found["rmse"])) | pair("root of sum", mean_of(found["rmse"] * np.sqrt(count)))
        row |= pair("log likelihood", mean_of(found["log likelihood"])) | pair("coverage", mean_of(found["coverage"]))
        if method in PUBLISHED:
            row |= {"published RMSE": PUBLISHED[method][1], "published log likelihood": PUBLISHED[method][2]}
        rows[method] = row
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)
