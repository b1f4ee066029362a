"""The experiment as the command line runs it."""

from __future__ import annotations

from lfm_ppl.experiments import scores
from lfm_ppl.experiments.catalogue import Report, Wanted
from lfm_ppl.experiments.counts import experiment, tables

SUMMARY = "counts, gross errors, yes and no: EP, variational and Laplace against exact draws"


def run(wanted: Wanted) -> Report:
    """Run the experiment, or what is missing of it, and write tables and figures.

    Raises:
        FileNotFoundError: data that are not there.
        ValueError: the folder holds results made with other settings; something is asked that it does not have.
    """
    make = experiment.quick if wanted.quick else experiment.Settings
    settings = make(**wanted.counts(data="data"))
    found = experiment.run(settings, wanted.folder, overwrite=wanted.overwrite, report=wanted.report,
                           workers=wanted.workers)
    written = experiment.save(found, wanted.folder)
    checked = tables.reference(settings, found.results)
    return Report({
        "Posterior of the predictor (mean: largest error in sds; sd: largest relative error)":
            scores.readable(found.accuracy),
        f"Held-out data, {settings.size.folds} folds": scores.readable(found.prediction),
    }, written, (
        f"Reference: elliptical slices, at least {checked['ess'].min():.0f} effective draws, R-hat at most "
        f"{checked['r_hat'].max():.3f}; log Z by importance sampling, effective share of the draws at least "
        f"{checked['share'].min():.2f}.",
        "Parameters are those at the mode of the posterior with EP's evidence, or the true ones of simulated data; all "
        "methods take the same."))
