"""The comparison as the command line runs it."""

from __future__ import annotations

import pandas as pd

from lfm_ppl.experiments import scores
from lfm_ppl.experiments.catalogue import Report, Wanted
from lfm_ppl.experiments.gps import experiment

SUMMARY = "GPS orbits: predicted for days with and without latent forces, from SP3 files (--data) or simulated"


def run(wanted: Wanted) -> Report:
    """Run the comparison, or what is missing of it, and write tables and figures.

    Raises:
        ValueError: the folder holds results made with other settings; something is asked that it does not have; files
            or satellites that cannot be used.
        FileNotFoundError: there are no files.
    """
    make = experiment.quick if wanted.quick else experiment.Settings
    settings = make(**wanted.counts(data="data", satellites="satellites", train_days="train_days", axes="axes"))
    found = experiment.run(settings, wanted.folder, overwrite=wanted.overwrite, report=wanted.report,
                           workers=wanted.workers)
    written = experiment.save(found, wanted.folder)
    shown = {"Errors after training (m), pooled over satellites, and 95% coverage": scores.readable(found.pooled),
             "Each satellite: root mean square errors after training (m)": _few(found.satellites)}
    if len(found.learning):
        shown["Ways to learn the magnitudes of the forces: error after training (m)"] = scores.readable(found.learning)
    if found.refused:
        shown["Left out"] = pd.DataFrame({"reason": found.refused})
    return Report(shown, written)


def _few(frame: pd.DataFrame) -> pd.DataFrame:
    columns = ["eclipsed", "fit", "deterministic", "latest state", "LFM", "ratio", "coverage"]
    digits = {"fit": 2, "deterministic": 1, "latest state": 1, "LFM": 2, "ratio": 3, "coverage": 3}
    return pd.DataFrame({column: frame[column].map(f"{{:.{digits[column]}f}}".format) if column in digits
                         else frame[column] for column in columns}, index=frame.index)
