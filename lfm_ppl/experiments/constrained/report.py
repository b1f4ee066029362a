"""The experiment as the command line runs it."""

from __future__ import annotations

from lfm_ppl.experiments import scores
from lfm_ppl.experiments.catalogue import Report, Wanted
from lfm_ppl.experiments.constrained import experiment

SUMMARY = "forces that cannot be negative: moving horizon, full information and bands, also of TRH"


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
        f"Transcription, {len(settings.shapes)} shapes of force by {settings.runs} records":
            scores.readable(found.transcription),
        "By the shape of the force": scores.readable(found.shapes),
        f"{settings.targets} targets on reentry and {settings.patients} patients": scores.readable(found.others),
    }, written)
