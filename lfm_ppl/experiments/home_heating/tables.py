"""Everything that was measured beside what is published, in one table for each data set and model."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments.home_heating import learning
from lfm_ppl.experiments.scores import Estimate, mean_of, pair, rate_of

PUBLISHED: dict[str, dict[str, tuple[float, float, float, float]]] = {
    "table 5": {"SQM": (0.67, 0.13, -116, 15), "CQM": (0.87, 0.11, -157, 13), "WQM": (1.06, 0.11, -227, 18),
                "periodic": (0.52, 0.05, -106, 13), "none": (0.61, 0.06, -142, 25), "matern": (0.92, 0.12, -162, 16),
                "resonator": (1.15, 0.22, -1373, 1027)},
    "table 6": {"SQM": (0.22, 0.02, 56, 15), "CQM": (0.22, 0.02, 34, 15), "WQM": (0.27, 0.04, 21, 26),
                "periodic": (0.24, 0.02, 35, 21), "none": (0.25, 0.02, 31, 14), "matern": (0.23, 0.02, 55, 14),
                "resonator": (0.82, 0.24, -251, 101)},
    "table 7": {"SQM": (1.00, 0.16, -190, 28), "CQM": (1.37, 0.17, -268, 37), "WQM": (1.45, 0.21, -239, 21),
                "periodic": (1.16, 0.19, -364, 97), "none": (1.66, 0.26, -367, 77), "matern": (1.43, 0.19, -279, 54),
                "resonator": (1.43, 0.19, -279, 54)},
    "table 8": {"SQM": (0.22, 0.02, 51, 14), "CQM": (0.29, 0.05, 4, 19), "WQM": (0.23, 0.02, 29, 21),
                "periodic": (0.25, 0.02, 23, 18), "none": (0.27, 0.04, 19, 18)},
}
"""RMSE (K) and expected log likelihood with what the source gives after them, over both of its homes."""

REFERENCES = ("none", "matern")
"""What a residual that repeats is compared with, day by day."""


def slug(store: str) -> str:
    """Return the name of a model in those of tasks and files."""
    return store.replace(" ", "-")


def of(results: dict[str, Result], what: str, store: str, method: str) -> Result:
    """Return the result of a task."""
    return results[f"{what}/{slug(store)}/{method}"]


def every(settings: Any, results: dict[str, Result]) -> dict[str, pd.DataFrame]:
    """Return all tables by name."""
    found = {}
    for index, store in enumerate(settings.stores):
        if settings.data is not None:
            found[f"house-{slug(store)}"] = house(settings, results, store)
        found[f"homes-{slug(store)}"] = homes(settings, results, store)
        if settings.data is not None and index == 0:
            found["posterior"] = posterior(settings, results)
    return found


def house(settings: Any, results: dict[str, Result], store: str) -> pd.DataFrame:
    """Return a row for each residual: the fifth day of the real house, predicted and tracked, over all windows."""
    one = store == "one store"
    ahead = {method: of(results, "house", store, method) for method in settings.methods}
    rows = {}
    for method, found in ahead.items():
        rows[method] = {
            **pair("RMSE ahead (K)", mean_of(found["ahead_rmse"])), **pair("ELL ahead", mean_of(found["ahead_ell"])),
            "median ELL ahead": float(np.median(found["ahead_ell"])),
            **pair("coverage ahead", mean_of(found["ahead_inside"])),
            **_published("table 5" if one else "table 8", method, "ahead"),
            **pair("RMSE tracked (K)", mean_of(found["track_rmse"])),
            **pair("ELL tracked", mean_of(found["track_ell"])),
            **(_published("table 6", method, "tracked") if one else {}),
            **pair("RMSE ahead, weather unknown (K)", mean_of(found["blind_rmse"])),
            **_gains(found, ahead, "ahead_"), "CPU time (s)": float(found["cpu_s"]) / len(found["ahead_rmse"])}
    return pd.DataFrame.from_dict(rows, orient="index")


def homes(settings: Any, results: dict[str, Result], store: str) -> pd.DataFrame:
    """Return a row for each residual: the fifth day of simulated homes under their thermostats."""
    all_ = {method: of(results, "homes", store, method) for method in settings.methods}
    rows = {}
    for method, found in all_.items():
        rows[method] = {
            **pair("RMSE ahead (K)", mean_of(found["rmse"])), **pair("ELL ahead", mean_of(found["ell"])),
            "median ELL ahead": float(np.median(found["ell"])), **pair("coverage ahead", mean_of(found["inside"])),
            **(_published("table 7", method, "ahead") if store == "one store" else {}), **_gains(found, all_),
            "CPU time (s)": float(found["cpu_s"]) / len(found["rmse"])}
    return pd.DataFrame.from_dict(rows, orient="index")


def posterior(settings: Any, results: dict[str, Result]) -> pd.DataFrame:
    """Return what is gained where the parameters are integrated out, over some windows of the real house.

    How far a sampler's posterior is from that of RAM: the largest distance of two means in standard deviations of RAM,
    over parameters and windows.
    """
    several = {sampler: of(results, f"posterior/{sampler}", settings.stores[0], settings.integrated)
               for sampler in learning.SAMPLERS}
    first = several[learning.SAMPLERS[0]]
    rows = {"most likely parameters": {**pair("RMSE ahead (K)", mean_of(first["point_rmse"])),
                                       **pair("ELL ahead", mean_of(first["point_ell"]))}}
    for sampler, found in several.items():
        away = np.abs(found["mean"] - first["mean"]) / first["sd"]
        rows[f"integrated out by {sampler}"] = {
            **pair("RMSE ahead (K)", mean_of(found["rmse"])), **pair("ELL ahead", mean_of(found["ell"])),
            **pair("gain in ELL", mean_of(found["ell"] - found["point_ell"])),
            "median gain": float(np.median(found["ell"] - found["point_ell"])),
            f"means from {learning.SAMPLERS[0]} (sd)": float(away.max()) if found is not first else np.nan,
            "largest R-hat": float(found["r_hat"].max()), "smallest ESS": float(found["ess"].min()),
            "divergences": float(found["divergences"].sum()), "CPU time (s)": float(found["seconds"].mean())}
    return pd.DataFrame.from_dict(rows, orient="index")


def _published(table: str, method: str, what: str) -> dict[str, float]:
    rmse, rmse_se, ell, ell_se = PUBLISHED[table].get(method, (np.nan,) * 4)
    return {**pair(f"published RMSE {what} (K)", Estimate(rmse, rmse_se)),
            **pair(f"published ELL {what}", Estimate(ell, ell_se))}


def _gains(found: Result, all_: dict[str, Result], prefix: str = "") -> dict[str, float]:
    """Return paired differences from the references, positive where this residual is better, and how often it is.

    A few days with tiny log likelihoods rule the means, so the share of days with a higher one stands beside them.
    """
    gains: dict[str, float] = {}
    for reference in (one for one in REFERENCES if one in all_):
        other = all_[reference]
        gains |= pair(f"RMSE below {reference} (K)", mean_of(other[f"{prefix}rmse"] - found[f"{prefix}rmse"]))
        more = found[f"{prefix}ell"] - other[f"{prefix}ell"]
        gains |= pair(f"ELL above {reference}", mean_of(more))
        if other is not found:
            gains |= pair(f"share of days above {reference}", rate_of(more > 0))
    return gains
