"""The study: its settings, the tasks of all satellites, and the tables that follow from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from lfm_ppl import orbits
from lfm_ppl.engine.task import Task
from lfm_ppl.experiments import study
from lfm_ppl.experiments.datasets import TaskKind
from lfm_ppl.experiments.gps import figures, problem, satellite, ways
from lfm_ppl.experiments.gps.figures import METRE, rms
from lfm_ppl.experiments.gps.satellite import REFUSED, attempt
from lfm_ppl.experiments.scores import estimate_cells, mean_of
from lfm_ppl.experiments.study import Data, Results, Study, StudyTable, setting
from lfm_ppl.orbits import learning, magnitudes
from lfm_ppl.orbits.arc import NOISE, Unusable

_WINDOW = 0.25
"""Days in which positions come in after training."""
_POOLED = ("deterministic", "latest state", "LFM", "LFM radial", "LFM tangential", "LFM normal")
_PRINTED = {"eclipsed": "{}", "fit": "{:.2f}", "deterministic": "{:.1f}", "latest state": "{:.1f}", "LFM": "{:.2f}",
            "ratio": "{:.3f}", "coverage": "{:.3f}"}


@dataclass(frozen=True)
class GpsSettings(study.StudySettings):
    """What is asked of the comparison."""

    data: str | None = setting(None, "folder of SP3 files (default: simulated satellites)", metavar="FOLDER")
    satellites: tuple[str, ...] | None = setting(None, "as in G05 G20 (default: all)", metavar="NAME")
    train_days: float = setting(3.0, "days to learn from; the others are predicted", metavar="D")
    axes: str = setting("DYB", "of the small forces, Sun-oriented or of the orbit", choices=tuple(orbits.AXES))
    alternatives: int = setting(4, "satellites whose magnitudes are learnt in every way", quick=1, least=0)
    most: int | None = setting(None, "satellites where none are named (default: all)", quick=2)


def plan(settings: GpsSettings) -> list[Task]:
    """Return the first tasks: each satellite is learnt by itself.

    Raises:
        ValueError, FileNotFoundError: as `problem.arcs` and `problem.Arcs.arc`; a satellite that there is not.
    """
    data = problem.arcs(settings.data, settings.seed)
    names = tuple(data.positions)[:settings.most]
    if settings.satellites is not None:
        files = () if data.published is None else data.published.files
        names = orbits.check_satellites(settings.satellites, tuple(data.positions), files)
    shared = {"data": settings.data and str(Path(settings.data).resolve()), "train_days": settings.train_days,
              "axes": settings.axes, "noise": NOISE, "weight": learning.WEIGHT}
    tasks = []
    for name in names:
        try:
            digest = data.arc(name, settings.train_days).digest
        except Unusable:
            digest = None
        tasks.append(Task(f"learn/{name}", settings.seed, {**shared, "satellite": name, "positions": digest}))
    return tasks


def plan_predictions(settings: GpsSettings, results: Results) -> list[Task]:
    """Return the tasks that follow: the predictions, and the ways to learn on the first satellites.

    Raises:
        ValueError: no satellite can be predicted.
    """
    learnt = [(task.settings, results[task.name]) for task in plan(settings) if REFUSED not in results[task.name]]
    if not learnt:
        raise _none_left(results)
    groups: dict[str, list[np.ndarray]] = {}
    for asked, result in learnt:
        groups.setdefault(_group(asked["satellite"], result["orbit"]), []).append(result["logarithms"])
    priors = {group: magnitudes.common(logarithms, settings.axes) for group, logarithms in groups.items()}
    usable = [{**asked, "orbit": result["orbit"].tolist(), "alone": result["logarithms"].tolist(),
               "prior": [values.tolist() for values in priors[_group(asked["satellite"], result["orbit"])]]}
              for asked, result in learnt]
    tasks = [Task(f"predict/{asked['satellite']}", settings.seed, asked) for asked in usable]
    tasks += [Task(f"ways/{asked['satellite']}", settings.seed, asked) for asked in usable[:settings.alternatives]]
    # Two windows of a quarter of a day, at two and at four sevenths of what is left.
    left = problem.arcs(settings.data, settings.seed).times[-1] / 24.0 - settings.train_days
    windows = [[begin, begin + _WINDOW] for begin in (settings.train_days + share * left for share in (2 / 7, 4 / 7))]
    return tasks + [Task(f"online/{asked['satellite']}", settings.seed, {**asked, "windows": windows})
                    for asked in usable[:settings.alternatives and 1] if left > 10 * _WINDOW]


def _group(name: str, orbit: Any) -> str:
    """Return the constellation of a satellite, and in how many hours it turns: BeiDou has orbits of 13 and of 24."""
    return f"{problem.system(name)} {float(orbits.period_of(np.asarray(orbit)[None, :6])):.0f} h"


def _left_out(results: Results) -> dict[str, str]:
    """Return satellite -> why it was left out."""
    return {name.partition("/")[2]: str(result[REFUSED]) for name, result in results.items()
            if name.startswith(("learn/", "predict/")) and REFUSED in result}


def _none_left(results: Results) -> ValueError:
    return ValueError("no satellite can be predicted. " + " ".join(_left_out(results).values()))


class SatelliteStudy(Study):
    """A study of the satellites that can be predicted; its data say what groups have in common, and who is left out."""

    def collect(self, settings: GpsSettings, results: Results, tasks: Sequence[Task] | None = None) -> Data:
        """Return the results by satellite, without those refused, the ``prior`` of each group, and who is ``left out``.

        Raises:
            ValueError: no satellite can be predicted.
        """
        data, asked = {}, self.tasks_by_kind(settings, results, tasks)
        for what, own in asked.items():
            if usable := [task for task in own if REFUSED not in results[task.name]]:
                data[what] = self.kinds[what].collect(usable, results)
        if "predict" not in data:
            raise _none_left(results)
        found = data["predict"]
        data["predict"] = found.assign_coords(system=("satellite", [*map(problem.system, found.satellite.values)]))
        priors = {_group(task.settings["satellite"], task.settings["orbit"]): task.settings["prior"]
                  for task in asked["predict"]}
        data["prior"] = xr.DataArray(list(priors.values()), {
            "group": list(priors), "moment": ["mean", "sd"], "magnitude": list(magnitudes.names(settings.axes))}
            ).to_dataset("moment")
        if reasons := _left_out(results):
            data["left out"] = xr.Dataset({"reason": ("satellite", list(reasons.values()))},
                                          {"satellite": list(reasons)})
        return data


def tables(settings: GpsSettings, data: Data) -> dict[str, StudyTable]:
    """Return the tables."""
    each = satellites(data)
    found = {"pooled": StudyTable.from_rows("Errors after training (m), pooled over satellites, and 95% coverage",
                                            pooled(data["predict"], each)),
             "satellites": StudyTable("Each satellite: root mean square errors after training (m)", each, pd.DataFrame(
                 {name: each[name].map(form.format) for name, form in _PRINTED.items()})),
             "magnitudes": StudyTable("", magnitudes_of(data))}
    if "ways" in data:
        found["learning"] = StudyTable.from_rows("Ways to learn the magnitudes of the forces: error after training (m)",
                                                 ways.table(data["ways"]))
    if "left out" in data:
        reasons = pd.DataFrame({"reason": data["left out"].reason.values}, data["left out"].satellite.values)
        found["left out"] = StudyTable("Left out", reasons, reasons, stored=False)
    return found


def satellites(data: Data) -> pd.DataFrame:
    """Return one row a satellite: errors after training in metres, and what was chosen."""
    found = data["predict"]
    deterministic, lfm = rms(found, "fitted"), rms(found, "lfm")
    columns = {
        "fit": found.residual / METRE, "deterministic": deterministic, "latest state": rms(found, "latest"), "LFM": lfm,
        **{f"LFM {name}": rms(found, "lfm", slice(index, index + 1))
           for index, name in enumerate(("radial", "tangential", "normal"))},
        "LFM at the end": np.sqrt((found.lfm[:, -1] ** 2).sum("direction", skipna=False)) / METRE,
        "ratio": lfm / deterministic, "coverage": found.coverage,
        "CPU s": found.cpu_s + data["learn"].cpu_s.sel(satellite=found.satellite)}
    return pd.DataFrame({"eclipsed": np.where(found.eclipsed, "yes", "no")}
                        | {name: column.values for name, column in columns.items()}, found.satellite.values)


def pooled(found: xr.Dataset, each: pd.DataFrame) -> dict[str, Any]:
    """Return one row a group of `satellites`: pooled errors in metres, ratios and coverage.

    Satellites with gaps stand apart: a gap is often a manoeuvre, which no model of small forces predicts. Several
    constellations are pooled each by itself, too.
    """
    rows: dict[str, Any] = {}
    complete, eclipsed, system = (found[name].values for name in ("complete", "eclipsed", "system"))
    groups = {"without gaps": complete, "without gaps, never in shadow": complete & ~eclipsed,
              "without gaps, in shadow": complete & eclipsed, "with gaps": ~complete}
    systems = {"": np.full(len(each), True)}
    if len(set(system)) > 1:
        systems |= {f"{name}, ": system == name for name in dict.fromkeys(system)}
    for prefix, inside in systems.items():
        for group, members in groups.items():
            if (members & inside).any():
                rows[f"{prefix}{group}"] = _together(each[members & inside])
    return rows


def _together(own: pd.DataFrame) -> dict[str, Any]:
    errors = {name: float(np.sqrt((own[name] ** 2).mean())) for name in _POOLED}
    return {"satellites": len(own), "fit, median": own["fit"].median(), **errors, "median": own["LFM"].median(),
            "ratio": errors["LFM"] / errors["deterministic"], "ratio, latest": errors["LFM"] / errors["latest state"],
            "improved": int((own["LFM"] < own["deterministic"]).sum()),
            **estimate_cells("coverage", mean_of(own["coverage"]))}


def magnitudes_of(data: Data) -> pd.DataFrame:
    """Return one row a magnitude of the small forces, in nm/s^2 and hours: what is common, and each satellite's."""
    prior, found = data["prior"], data["predict"]
    columns: dict[str, np.ndarray] = {}
    for group in prior.group.values:
        of = f", {group}" if prior.sizes["group"] > 1 else ""
        columns |= {f"{label}{of}": np.exp(prior[moment].sel(group=group).values)
                    for label, moment in (("common", "mean"), ("factor", "sd"))}
    columns |= dict(zip(found.satellite.values, np.exp(found.logarithms.values), strict=True))
    return pd.DataFrame(columns, prior.magnitude.values)


_BY = ("satellite",)
STUDY = SatelliteStudy(
    GpsSettings, plan,
    {"learn": TaskKind(partial(attempt, satellite.learn), {
        "element": "orbit", "magnitude": "logarithms", "": "cpu_s"}, _BY),
     "predict": TaskKind(partial(attempt, satellite.predict), {
         "time direction": "fitted, latest, lfm, sd", "time force": "forces, forces_sd, seen", "time": "times",
         "": "train, residual, solar, eclipsed, complete, coverage, cpu_s", "force": "force_names",
         "magnitude": "logarithms"}, _BY),
     "ways": TaskKind(partial(attempt, ways.compare), {
         "way": "error, coverage", "way magnitude": "logarithms", "": "cpu_s"}, _BY),
     "online": TaskKind(partial(attempt, satellite.online), {
         "time direction": "lfm, sd, restarted", "time": "times, observed", "": "cpu_s"}, _BY)},
    tables, figures.draw, label="", follow_up_tasks=plan_predictions)
