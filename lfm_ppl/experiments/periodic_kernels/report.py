"""The experiment as the command line runs it."""

from __future__ import annotations

from lfm_ppl.experiments import scores
from lfm_ppl.experiments.catalogue import Report, Wanted
from lfm_ppl.experiments.periodic_kernels import experiment

SUMMARY = "periodic kernels as forces: eigenfunctions against random frequencies and resonators"


def run(wanted: Wanted) -> Report:
    """Run the experiment, or what is missing of it, and write tables and figures.

    Raises:
        ValueError: the folder holds results made with other settings; something is asked that it does not have.
    """
    make = experiment.quick if wanted.quick else experiment.Settings
    settings = make(**wanted.counts(realisations="runs"))
    found = experiment.run(settings, wanted.folder, overwrite=wanted.overwrite, report=wanted.report,
                           workers=wanted.workers)
    written = experiment.save(found, wanted.folder)
    return Report({
        "Largest error of the covariance, by the number of functions": scores.readable(found.covariance),
        "Squared exponential of scale 10, on a window of 130": scores.readable(found.published),
        f"Means over {settings.runs} functions (standard errors)": scores.readable(found.regression),
    }, written)
