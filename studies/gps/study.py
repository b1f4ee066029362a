"""The study of satellite orbits: settings, tasks and tables.

1. Learn the magnitudes of the small forces for each satellite separately (`learning_tasks`). Leave out satellites with
   too few positions, or with an orbit that does not fit.
2. Derive a common prior of the magnitudes for each group of satellites with equal constellation and period.
3. Predict every satellite with this prior. Compare learning methods on the first satellites, and predict the first one
   online, with observations in two short windows after training (`prediction_tasks`).
4. Collect errors by satellite (`SatelliteStudy.collect`), and pool them by constellation, shadow and gaps.
"""

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
from lfm_ppl.orbits import learning, magnitudes
from lfm_ppl.orbits.arc import NOISE, Unusable
from lfm_ppl.parallel.task import Task

from ..datasets import TaskKind
from ..declaration import Data, Results, Study, StudySettings, StudyTable, setting
from ..scores import estimate_cells, estimate_mean
from . import figures, learning_methods, problem, satellite
from .figures import METRE, rms
from .satellite import REFUSED, compute_or_refuse

_WINDOW = 0.25
"""Length in days of a window with observations after training."""
_POOLED = ("deterministic", "latest state", "LFM", "LFM radial", "LFM tangential", "LFM normal")
_PRINTED = {"eclipsed": "{}", "fit": "{:.2f}", "deterministic": "{:.1f}", "latest state": "{:.1f}", "LFM": "{:.2f}",
            "ratio": "{:.3f}", "coverage": "{:.3f}"}


@dataclass(frozen=True)
class GpsSettings(StudySettings):
    """Data and sizes of the study."""

    data: str | None = setting(None, "folder of SP3 files (default: simulated satellites)", metavar="FOLDER")
    include: tuple[str, ...] | None = setting(None, "flagged positions of the files to use (default: none)",
                                              choices=("predicted", "manoeuvres"), metavar="FLAG")
    satellites: tuple[str, ...] | None = setting(None, "names such as G05 G20 (default: all)", metavar="NAME")
    train_days: float = setting(3.0, "days of training data; the study predicts the remaining days", metavar="D")
    axes: str = setting("DYB", "axes of the small forces, oriented to the Sun or to the orbit",
                        choices=tuple(orbits.AXES))
    alternatives: int = setting(4, "satellites on which all learning methods are compared", quick=1, least=0)
    most: int | None = setting(None, "number of satellites if no names are set (default: all)", quick=2)


def learning_tasks(settings: GpsSettings) -> list[Task]:
    """Return the first tasks, which learn the magnitudes of each satellite separately.

    Raises:
        ValueError, FileNotFoundError: as in `problem.arcs` and `problem.Arcs.arc`, or for an unknown satellite.
    """
    data = problem.arcs(settings.data, settings.seed, settings.include or ())
    names = tuple(data.positions)[:settings.most]
    if settings.satellites is not None:
        files = () if data.published is None else data.published.files
        names = orbits.check_satellites(settings.satellites, tuple(data.positions), files)
    shared = {"data": settings.data and str(Path(settings.data).resolve()), "train_days": settings.train_days,
              "axes": settings.axes, "noise": NOISE, "weight": learning.WEIGHT,
              **({"include": list(settings.include)} if settings.include else {})}
    tasks = []
    for name in names:
        try:
            digest = data.arc(name, settings.train_days).digest
        except Unusable:
            digest = None
        tasks.append(Task(f"learn/{name}", settings.seed, {**shared, "satellite": name, "positions": digest}))
    return tasks


def prediction_tasks(settings: GpsSettings, results: Results) -> list[Task]:
    """Return the second tasks: predictions, and the comparison of learning methods on the first satellites.

    Raises:
        ValueError: no satellite can be predicted.
    """
    fitted = {task.settings["satellite"]: (task.settings, results[task.name])
              for task in learning_tasks(settings) if REFUSED not in results[task.name]}
    if not fitted:
        raise _no_satellite_error(results)
    groups = {name: _group(name, result["orbit"]) for name, (_, result) in fitted.items()}
    logarithms: dict[str, list[np.ndarray]] = {}
    for name, (_, result) in fitted.items():
        logarithms.setdefault(groups[name], []).append(result["logarithms"])
    priors = {group: magnitudes.common(values, settings.axes) for group, values in logarithms.items()}
    inputs = {name: {**learning_settings, "orbit": result["orbit"].tolist(), "alone": result["logarithms"].tolist(),
                     "prior": [values.tolist() for values in priors[groups[name]]]}
              for name, (learning_settings, result) in fitted.items()}
    compared = list(inputs)[:settings.alternatives]
    tasks = [Task(f"predict/{name}", settings.seed, inputs[name]) for name in inputs]
    tasks += [Task(f"ways/{name}", settings.seed, inputs[name]) for name in compared]
    data = problem.arcs(settings.data, settings.seed, settings.include or ())
    remaining_days = data.times[-1] / 24.0 - settings.train_days
    if remaining_days > 10 * _WINDOW:
        # Two windows of a quarter of a day, at two and at four sevenths of the remaining time.
        starts = [settings.train_days + share * remaining_days for share in (2 / 7, 4 / 7)]
        windows = [[start, start + _WINDOW] for start in starts]
        tasks += [Task(f"online/{name}", settings.seed, {**inputs[name], "windows": windows}) for name in compared[:1]]
    return tasks


def _group(name: str, orbit: Any) -> str:
    """Return the constellation and the period in hours of a satellite; BeiDou has orbits of 13 and of 24 hours."""
    return f"{problem.system(name)} {float(orbits.period_of(np.asarray(orbit)[None, :6])):.0f} h"


def _refusal_reasons(results: Results) -> dict[str, str]:
    """Return satellite -> reason why the study leaves it out."""
    return {name.partition("/")[2]: str(result[REFUSED]) for name, result in results.items()
            if name.startswith(("learn/", "predict/")) and REFUSED in result}


def _no_satellite_error(results: Results) -> ValueError:
    return ValueError("no satellite can be predicted. " + " ".join(_refusal_reasons(results).values()))


class SatelliteStudy(Study):
    """A study that leaves out satellites without usable data; its datasets hold group priors and refusal reasons."""

    def collect(self, settings: GpsSettings, results: Results, tasks: Sequence[Task] | None = None) -> Data:
        """Return results by satellite, the ``prior`` of each group, and the ``left out`` satellites with reasons.

        Raises:
            ValueError: no satellite can be predicted.
        """
        data, by_kind = {}, self.tasks_by_kind(settings, results, tasks)
        for kind, kind_tasks in by_kind.items():
            if usable := [task for task in kind_tasks if REFUSED not in results[task.name]]:
                data[kind] = self.kinds[kind].collect(usable, results)
        if "predict" not in data:
            raise _no_satellite_error(results)
        predictions = data["predict"]
        systems = [problem.system(name) for name in predictions.satellite.values]
        data["predict"] = predictions.assign_coords(system=("satellite", systems))
        priors = {_group(task.settings["satellite"], task.settings["orbit"]): task.settings["prior"]
                  for task in by_kind["predict"]}
        data["prior"] = xr.DataArray(list(priors.values()), {
            "group": list(priors), "moment": ["mean", "sd"], "magnitude": list(magnitudes.names(settings.axes))}
            ).to_dataset("moment")
        if reasons := _refusal_reasons(results):
            data["left out"] = xr.Dataset({"reason": ("satellite", list(reasons.values()))},
                                          {"satellite": list(reasons)})
        return data


def tables(settings: GpsSettings, data: Data) -> dict[str, StudyTable]:
    """Return the tables."""
    table = satellite_table(data)
    result = {"pooled": StudyTable.from_rows("Errors after training (m), pooled over satellites, and 95% coverage",
                                             pooled_rows(data["predict"], table)),
              "satellites": StudyTable(
                 "Each satellite: root mean square errors after training (m)", table,
                 pd.DataFrame({name: table[name].map(text.format) for name, text in _PRINTED.items()})),
              "magnitudes": StudyTable("", magnitude_table(data))}
    if "ways" in data:
        result["learning"] = StudyTable.from_rows(
            "Ways to learn the magnitudes of the forces: error after training (m)",
            learning_methods.method_rows(data["ways"]))
    if "left out" in data:
        reasons = pd.DataFrame({"reason": data["left out"].reason.values}, data["left out"].satellite.values)
        result["left out"] = StudyTable("Left out", reasons, reasons, stored=False)
    return result


def satellite_table(data: Data) -> pd.DataFrame:
    """Return one row for each satellite: errors after training in metres, coverage and CPU time."""
    predictions = data["predict"]
    deterministic, lfm = rms(predictions, "fitted"), rms(predictions, "lfm")
    columns = {
        "fit": predictions.residual / METRE, "deterministic": deterministic,
        "latest state": rms(predictions, "latest"), "LFM": lfm,
        **{f"LFM {name}": rms(predictions, "lfm", slice(index, index + 1))
           for index, name in enumerate(("radial", "tangential", "normal"))},
        "LFM at the end": np.sqrt((predictions.lfm[:, -1] ** 2).sum("direction", skipna=False)) / METRE,
        "ratio": lfm / deterministic, "coverage": predictions.coverage,
        "CPU s": predictions.cpu_s + data["learn"].cpu_s.sel(satellite=predictions.satellite)}
    return pd.DataFrame({"eclipsed": np.where(predictions.eclipsed, "yes", "no")}
                        | {name: column.values for name, column in columns.items()}, predictions.satellite.values)


def pooled_rows(predictions: xr.Dataset, by_satellite: pd.DataFrame) -> dict[str, Any]:
    """Return one row for each group of satellites: pooled errors in metres, ratios and coverage.

    Satellites with gaps form separate groups: a gap is often a manoeuvre, which no model of small forces predicts. If
    there are several constellations, each one also has separate groups.
    """
    rows: dict[str, Any] = {}
    complete, eclipsed, system = (predictions[name].values for name in ("complete", "eclipsed", "system"))
    groups = {"without gaps": complete, "without gaps, never in shadow": complete & ~eclipsed,
              "without gaps, in shadow": complete & eclipsed, "with gaps": ~complete}
    systems = {"": np.full(len(by_satellite), True)}
    if len(set(system)) > 1:
        systems |= {f"{name}, ": system == name for name in dict.fromkeys(system)}
    for prefix, is_member in systems.items():
        for group, members in groups.items():
            if (members & is_member).any():
                rows[f"{prefix}{group}"] = _pool_errors(by_satellite[members & is_member])
    return rows


def _pool_errors(table: pd.DataFrame) -> dict[str, Any]:
    errors = {name: float(np.sqrt((table[name] ** 2).mean())) for name in _POOLED}
    return {"satellites": len(table), "fit, median": table["fit"].median(), **errors, "median": table["LFM"].median(),
            "ratio": errors["LFM"] / errors["deterministic"], "ratio, latest": errors["LFM"] / errors["latest state"],
            "improved": int((table["LFM"] < table["deterministic"]).sum()),
            **estimate_cells("coverage", estimate_mean(table["coverage"]))}


def magnitude_table(data: Data) -> pd.DataFrame:
    """Return one row for each magnitude of the small forces, in nm/s^2 and hours: the prior, and every satellite."""
    prior, predictions = data["prior"], data["predict"]
    columns: dict[str, np.ndarray] = {}
    for group in prior.group.values:
        suffix = f", {group}" if prior.sizes["group"] > 1 else ""
        columns |= {f"{label}{suffix}": np.exp(prior[moment].sel(group=group).values)
                    for label, moment in (("common", "mean"), ("factor", "sd"))}
    columns |= dict(zip(predictions.satellite.values, np.exp(predictions.logarithms.values), strict=True))
    return pd.DataFrame(columns, prior.magnitude.values)


_BY = ("satellite",)
STUDY = SatelliteStudy(
    GpsSettings, learning_tasks,
    {"learn": TaskKind(partial(compute_or_refuse, satellite.learn), {
        "element": "orbit", "magnitude": "logarithms", "": "cpu_s"}, _BY),
     "predict": TaskKind(partial(compute_or_refuse, satellite.predict), {
         "time direction": "fitted, latest, lfm, sd", "time force": "forces, forces_sd, seen", "time": "times",
         "": "train, residual, solar, eclipsed, complete, coverage, cpu_s", "force": "force_names",
         "magnitude": "logarithms"}, _BY),
     "ways": TaskKind(partial(compute_or_refuse, learning_methods.compare), {
         "method": "error, coverage", "method magnitude": "logarithms", "": "cpu_s"}, _BY),
     "online": TaskKind(partial(compute_or_refuse, satellite.online), {
         "time direction": "lfm, sd, restarted", "time": "times, observed", "": "cpu_s"}, _BY)},
    tables, figures.draw, label="", follow_up_tasks=prediction_tasks)
