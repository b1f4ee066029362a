"""The comparison as the command line runs it."""

from __future__ import annotations

from lfm_ppl.experiments import scores
from lfm_ppl.experiments.catalogue import Report, Wanted
from lfm_ppl.experiments.transcription import experiment, tables, verdict

SUMMARY = "transcription factors: Laplace, elliptical slice sampling and Gaussian smoothers, eight links, table 1"


def run(wanted: Wanted) -> Report:
    """Run the comparison, or what is missing of it, and write tables and figures.

    Raises:
        ValueError: the folder holds results made with other settings; something is asked that it does not have.
    """
    make = experiment.quick if wanted.quick else experiment.Settings
    settings = make(**wanted.counts(realisations="datasets"))
    found = experiment.run(settings, wanted.folder, overwrite=wanted.overwrite, report=wanted.report,
                           workers=wanted.workers)
    written = experiment.save(found, wanted.folder)
    return Report({
        f"RMSE of the force and divergences, {settings.datasets} data sets, beside the published table":
            scores.readable(found.published),
        f"Means over {settings.datasets} data sets (standard errors)": scores.readable(found.table),
        "Against elliptical slice sampling on the same data sets": scores.readable(found.paired),
    }, written, (verdict.summary(tables.verdicts(found.published).values()), verdict.TRUST))
