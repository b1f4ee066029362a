"""Everything that was measured, in three tables."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments.published import Verdict
from lfm_ppl.experiments.scores import mean_of, pair
from lfm_ppl.experiments.transcription import problem, slices

Cells = Mapping[tuple[str, str], Result]
"""(configuration, method) -> results of all data sets."""


def comparison(cells: Cells) -> pd.DataFrame:
    """Return one row for each configuration and method.

    Returns:
        ``RMSE`` of the force over the grid, without diverged data sets, and ``divergences``, their number; ``coverage``
        of the 95% band, pooled over data sets and points; ``NLPD``, the negative log predictive density of the force at
        a point; ``CPU s`` for one data set, compilation apart; of elliptical slice sampling ``mixed`` (the share of
        data sets whose R-hat is at most 1.01 at every monitored point of the grid), ``mixed at first`` (the same after
        the draws that ``CPU s`` is of), ``all CPU s`` (with those that followed where it was not) and ``ESS``, the
        smallest among these points, of the draws that are kept; of Laplace ``at a mode``, the share of data sets on
        which the search ended at one, which it may not and yet stop; of the iterated smoother ``last change``, the
        largest by which the last iteration moved a mean, in standard deviations. ``name se`` are standard errors over
        data sets.
    """
    rows = {}
    for (label, method), found in cells.items():
        sound = ~np.asarray(found["diverged"], bool)
        row = pair("RMSE", mean_of(found["rmse"][sound]))
        row["divergences"] = float((~sound).sum())
        for name, key in (("coverage", "coverage"), ("NLPD", "nlpd")):
            row |= pair(name, mean_of(found[key][sound]))
        row |= pair("CPU s", mean_of(found["seconds"]))
        if "r_hat" in found:
            row["mixed"] = float((found["r_hat"] <= slices.R_HAT).mean())
            row["mixed at first"] = float((found["r_hat_first"] <= slices.R_HAT).mean())
            row |= pair("all CPU s", mean_of(found["seconds"] + found["seconds_more"]))
            row |= pair("ESS", mean_of(found["ess"]))
        if "converged" in found:
            row["at a mode"] = float(np.mean(found["converged"]))
        if np.isfinite(found.get("change", np.nan)).any():
            row["last change"] = float(np.max(found["change"]))
        rows[f"{label}: {method}"] = row
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)


def beside_published(cells: Cells) -> pd.DataFrame:
    """Return one row for each configuration: RMSE and divergences of the source's methods beside the published ones.

    ``z`` is the difference of the RMSE in standard errors of ours; the published mean over 100 data sets has an error
    as large again. ``verdict`` says what that means, see `Verdict`. The source averages over the data sets on which no
    method failed. What Newton's method counts as a failure there is not said in full; ``at modes`` is ``z`` over the
    data sets on which ours ends at a mode, and ``no mode`` the number of others.
    """
    rows = {}
    for label, methods in problem.PUBLISHED.items():
        row: dict[str, float | str] = {}
        newton = cells.get((label, "LA"), {}).get("converged")
        at_modes = None if newton is None else np.asarray(newton, bool)
        if at_modes is not None:
            row["no mode"] = float((~at_modes).sum())
        for method, (error, diverged) in methods.items():
            found = cells.get((label, method))
            if found is None:
                continue
            sound = ~np.asarray(found["diverged"], bool)
            ours = mean_of(found["rmse"][sound])
            z = (ours.value - error) / ours.error
            row |= pair(method, ours)
            row |= {f"{method} published": error, f"{method} z": z, f"{method} verdict": str(Verdict(z)),
                    f"{method} div.": float((~sound).sum()), f"{method} div. published": float(diverged)}
            if at_modes is not None:
                chosen = mean_of(found["rmse"][sound & at_modes])
                row[f"{method} z at modes"] = (chosen.value - error) / chosen.error
        if any(label == one for one, _ in cells):
            rows[label] = row
    return pd.DataFrame.from_dict(rows, orient="index")


def verdicts(published: pd.DataFrame) -> dict[tuple[str, str], Verdict]:
    """Return (configuration, method) -> verdict on each cell of the table of `beside_published`."""
    return {(label, method): Verdict(float(row[f"{method} z"])) for label, row in published.iterrows()
            for method in problem.PUBLISHED[label] if f"{method} z" in row}


def against_slices(cells: Cells) -> pd.DataFrame:
    """Return one row for each configuration and method: the RMSE relative to elliptical slice sampling's, by pairs.

    Returns:
        ``RMSE ratio`` of the means over data sets on which neither diverged; ``difference`` of the RMSE, with its
        paired standard error; ``times as fast`` in CPU time for one data set.
    """
    rows = {}
    for (label, method), found in cells.items():
        reference = cells.get((label, "ESLS"))
        if reference is None or method == "ESLS":
            continue
        sound = ~(np.asarray(found["diverged"], bool) | np.asarray(reference["diverged"], bool))
        difference = mean_of((found["rmse"] - reference["rmse"])[sound])
        ratio = found["rmse"][sound].mean() / reference["rmse"][sound].mean() if sound.any() else np.nan
        rows[f"{label}: {method}"] = {
            "RMSE ratio": ratio, **pair("difference", difference),
            "times as fast": reference["seconds"].mean() / found["seconds"].mean()}
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)
