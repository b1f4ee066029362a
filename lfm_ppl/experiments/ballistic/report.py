"""The experiment as the command line runs it."""

from __future__ import annotations

from lfm_ppl.experiments import scores
from lfm_ppl.experiments.ballistic import experiment
from lfm_ppl.experiments.catalogue import Report, Wanted

SUMMARY = "target on reentry: Gaussian smoothers against particles, and the posterior of the drag"


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
    few = min(settings.runs, settings.particle_runs)
    return Report({
        f"Means over {settings.runs} targets (standard errors)": scores.readable(found.tracking),
        f"Particles against the Gaussian filter and smoother, {few} targets": scores.readable(found.particles),
        f"Parameters, in logarithms, {settings.runs} targets": scores.readable(found.parameters),
        f"Against NUTS, {min(settings.runs, settings.chain_runs)} targets": scores.readable(found.agreement),
    }, written)
