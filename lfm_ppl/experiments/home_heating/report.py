"""The experiment as the command line runs it."""

from __future__ import annotations

import pandas as pd

from lfm_ppl.experiments import scores
from lfm_ppl.experiments.catalogue import Report, Wanted
from lfm_ppl.experiments.home_heating import experiment, problem

SUMMARY = "home heating: a day ahead with residual heat that nearly repeats, under a thermostat and in a real house"
_TITLES = {"house": "Real house, {}: the fifth day, means over {} windows (standard errors)",
           "homes": "Simulated homes under a thermostat, {}: the fifth day, means over {} homes (standard errors)",
           "posterior": "Real house, {}: what it gains to integrate the parameters out, {} windows"}


def run(wanted: Wanted) -> Report:
    """Run the experiment, or what is missing of it, and write tables and figures.

    Raises:
        ValueError: the folder holds results made with other settings; something is asked that it does not have.
        FileNotFoundError: the given folder has no real house.
    """
    make = experiment.quick if wanted.quick else experiment.Settings
    folder = problem.data_folder(wanted.data)
    given = {**wanted.counts(realisations="homes", data="data"), "data": None if folder is None else str(folder)}
    if folder is None and wanted.report:
        wanted.report(f"no {problem.FILE} in $LFM_DATA/house or ../shared/data/house: simulated homes only")
    settings = make(**given)
    found = experiment.run(settings, wanted.folder, overwrite=wanted.overwrite, report=wanted.report,
                           workers=wanted.workers)
    written = experiment.save(found, wanted.folder)
    shown = {title(settings, name): scores.readable(table) for name, table in found.tables.items()}
    if folder is None:
        shown["Left out"] = pd.DataFrame({"reason": [f"no {problem.FILE}; give its folder with --data"]},
                                         ["real house"])
    return Report(shown, written)


def title(settings: experiment.Settings, name: str) -> str:
    """Return what a table shows."""
    what, _, store = name.partition("-")
    count = settings.homes if what == "homes" else settings.window_count
    if what == "posterior":
        store, count = settings.stores[0], -(-count // settings.every)
    return _TITLES[what].format(store.replace("-", " "), count)
