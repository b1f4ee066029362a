"""The tables: errors, feasibility and coverage."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments.constrained import estimators, problem
from lfm_ppl.experiments.scores import mean_of, pair, rate_of
from lfm_ppl.results.importance import LARGEST_K

_PUBLISHED = {estimators.EARLY: problem.PUBLISHED["smoother"]} | dict.fromkeys(
    (estimators.HORIZON, estimators.HORIZON_RATE), problem.PUBLISHED["delayed MHE"])
NEAR = 1.0
"""Hours within which a peak counts as found."""


def gathered(results: dict[str, Result], begins: str, entry: str) -> np.ndarray:
    """Return one entry of all tasks whose name begins so, (N, ...)."""
    return np.concatenate([found[entry] for name, found in results.items() if name.startswith(f"{begins}/")])


def transcription(settings: Any, results: dict[str, Result]) -> pd.DataFrame:
    """Return one row an estimator, over all records.

    Returns:
        ``median MSE`` of the force without the first 60 samples, ``largest MSE``, the one ``published`` (of one
        realisation), ``above 0.0103``, the share of records whose error is above the published one of the delayed
        estimator; ``lengthscale (s)``, the median one; ``least``, the lowest estimate; ``coverage`` of the 95% bands;
        ``failed``, records without an estimate, which do not count in the others.
    """
    rows = {}
    for method in settings.methods:
        failed = gathered(results, "transcription", f"{method}/failed")
        mse, least, covered = (gathered(results, "transcription", f"{method}/{name}")[~failed]
                               for name in ("mse", "minimum", "coverage"))
        learnt = gathered(results, "transcription", f"hyperparameters/{estimators.METHODS[method]}")[:, 0]
        rows[method] = {"median MSE": np.median(mse), "largest MSE": mse.max(),
                        "published": _PUBLISHED.get(method, np.nan),
                        **pair("above 0.0103", rate_of(mse > problem.PUBLISHED["delayed MHE"])),
                        "lengthscale (s)": np.median(learnt), "least": least.min(),
                        **pair("coverage", mean_of(covered)), "failed": float(failed.sum())}
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)


def shapes(settings: Any, results: dict[str, Result]) -> pd.DataFrame:
    """Return one row an estimator: median MSE and coverage of each shape of the force."""
    rows: dict[str, dict[str, float]] = {}
    for method in settings.methods:
        rows[method] = {}
        for shape in settings.shapes:
            begins = f"transcription/{shape.replace(' ', '-')}"
            rows[method][f"median MSE, {shape}"] = np.median(gathered(results, begins, f"{method}/mse"))
            rows[method] |= pair(f"coverage, {shape}", mean_of(gathered(results, begins, f"{method}/coverage")))
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)


def others(settings: Any, results: dict[str, Result]) -> pd.DataFrame:
    """Return errors of the target's altitude, speed and acceleration, and what is found of patients' TRH."""
    rmse = gathered(results, "ballistic", "rmse")
    rows = {f"target, RMSE of {path} ({unit})": mean_of(rmse[:, index])
            for index, (path, unit) in enumerate(problem.TARGET_PATHS.items())}
    rows["target, converged"] = rate_of(gathered(results, "ballistic", "converged"))
    peaks = gathered(results, "thyroid", "peak")
    rows |= {"patients, RMSE of TRH (nmol/l)": mean_of(gathered(results, "thyroid", "rmse")),
             "patients, coverage of TRH": mean_of(gathered(results, "thyroid", "coverage")),
             "patients, greatest TRH within 1 h": rate_of(peaks[:, 0] <= NEAR),
             "patients, peak of the day's wave of TRH within 1 h": rate_of(peaks[:, 1] <= NEAR),
             "patients, Pareto k above 0.7": rate_of(~(gathered(results, "thyroid", "k") <= LARGEST_K)),
             "patients, converged": rate_of(gathered(results, "thyroid", "converged")),
             "patients, bands converged": rate_of(gathered(results, "thyroid", "bands_converged"))}
    return pd.DataFrame.from_dict({name: pair("value", found) for name, found in rows.items()}, orient="index")
