"""The comparison as the command line runs it."""

from __future__ import annotations

from lfm_ppl.experiments import scores
from lfm_ppl.experiments.catalogue import Report, Wanted
from lfm_ppl.experiments.ginzburg_landau import experiment

SUMMARY = "double well: EKF, CKF, GHKF, particle filter and exact grid, in states and parameters"


def run(wanted: Wanted) -> Report:
    """Run the comparison, or what is missing of it, and write tables and figures.

    Raises:
        ValueError: the folder holds results made with other settings.
    """
    make = experiment.quick if wanted.quick else experiment.Settings
    settings = make(**wanted.counts(realisations="realisations", conditional="conditional"))
    found = experiment.run(settings, wanted.folder, overwrite=wanted.overwrite, report=wanted.report,
                           workers=wanted.workers)
    written = experiment.save(found, wanted.folder)
    return Report({
        f"Means over {settings.realisations} realisations (standard errors)": scores.readable(found.table),
        f"Truth outside the 99% interval of a conditional posterior, {settings.conditional} realisations":
            scores.readable(found.rates),
        f"Posteriors of the parameters, {settings.realisations} realisations": scores.readable(found.parameters),
    }, written)
