"""The experiment as the command line runs it."""

from __future__ import annotations

from lfm_ppl.experiments import scores
from lfm_ppl.experiments.call_centre import experiment
from lfm_ppl.experiments.catalogue import Report, Wanted

SUMMARY = "queues of a call centre tracked by forces that nearly repeat, from real counts (--data) or simulated"


def run(wanted: Wanted) -> Report:
    """Run the experiment, or what is missing of it, and write tables and figures.

    Raises:
        ValueError: the folder holds results made with other settings; something is asked that it does not have; counts
            that cannot be used.
        FileNotFoundError: there are no counts.
    """
    make = experiment.quick if wanted.quick else experiment.Settings
    settings = make(**wanted.counts(realisations="days", data="data"))
    found = experiment.run(settings, wanted.folder, overwrite=wanted.overwrite, report=wanted.report,
                           workers=wanted.workers)
    written = experiment.save(found, wanted.folder)
    source = "simulated counts" if settings.data is None else f"counts in {settings.data}"
    both = min(settings.days, settings.nuts_days)
    return Report({
        f"Service rate 10 as in training, {settings.days} test days, {source}": scores.readable(found.constant),
        f"Service rate 15, then 5, {settings.days} test days, {source}": scores.readable(found.changed),
        "Gain in the log density of a day by integrating the parameters out": scores.readable(found.gain),
        f"Weighted draws against NUTS, test days: {both}": scores.readable(found.agreement),
        "Most likely parameters (medians)": scores.readable(found.learnt),
    }, written)
