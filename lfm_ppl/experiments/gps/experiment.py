"""The study: its settings, the tasks of all satellites, and the tables and figures that follow from them."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from lfm_ppl import orbits
from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import study
from lfm_ppl.experiments.gps import figures, learning, magnitudes, prediction, problem, ways
from lfm_ppl.experiments.gps.figures import METRE, rms
from lfm_ppl.experiments.gps.training import Training
from lfm_ppl.experiments.scores import mean_of, pair
from lfm_ppl.experiments.study import Results, Study, Table, setting

_REFUSED = "refused"
_WINDOW = 0.25
_SHORTEST = 5.0
"""Hours in which a satellite turns at least."""


@dataclasses.dataclass(frozen=True)
class Settings(study.Settings):
    """What is asked of the comparison."""

    data: str | None = setting(None, "folder of SP3 files (default: simulated satellites)", metavar="FOLDER")
    satellites: tuple[str, ...] | None = setting(None, "as in G05 G20 (default: all)", metavar="NAME")
    train_days: float = setting(3.0, "days to learn from; the others are predicted", metavar="D")
    axes: str = setting("DYB", "of the small forces, Sun-oriented or of the orbit", choices=tuple(orbits.AXES))
    alternatives: int = setting(4, "satellites whose magnitudes are learnt in every way", quick=1, least=0)
    most: int | None = setting(None, "satellites where none are named (default: all)", quick=2)


class Outcome(NamedTuple):
    """What became of the satellites, each satellite -> result of its task.

    Attributes:
        predicted: their predictions.
        priors: constellation and hours of a turn -> the magnitudes that such satellites have in common.
        compared: ways to learn the magnitudes.
        online: predictions as positions come in.
        refused: satellite -> why it was left out.
    """

    predicted: dict[str, Result]
    priors: dict[str, magnitudes.Prior]
    compared: dict[str, Result]
    online: dict[str, Result]
    refused: dict[str, str]


def plan(settings: Settings) -> list[Task]:
    """Return the first tasks: each satellite is learnt by itself.

    Raises:
        ValueError, FileNotFoundError: as `problem.arcs` and `prediction.arc`; a satellite that there is not.
    """
    data = problem.arcs(settings.data, settings.seed)
    names = tuple(data.positions)[:settings.most]
    if settings.satellites is not None:
        files = () if data.published is None else data.published.files
        names = orbits.check_satellites(settings.satellites, tuple(data.positions), files)
    shared = {"data": settings.data and str(Path(settings.data).resolve()), "train_days": settings.train_days,
              "axes": settings.axes, "noise": problem.NOISE, "weight": learning.WEIGHT}
    found = []
    for name in names:
        try:
            digest = prediction.arc(data, name, settings.train_days).digest
        except prediction.Unusable:
            digest = None
        found.append(Task(f"learn/{name}", settings.seed, {**shared, "satellite": name, "positions": digest}))
    return found


def plan_predictions(settings: Settings, results: Results) -> list[Task]:
    """Return the tasks that follow: the predictions, and the ways to learn on the first satellites.

    Args:
        settings: what is asked.
        results: of the first tasks.

    Raises:
        ValueError: no satellite can be predicted.
    """
    refused: dict[str, str] = {}
    tasks, learnt = plan(settings), _kept(results, "learn/", refused)
    if not learnt:
        raise ValueError("no satellite can be predicted. " + " ".join(refused.values()))
    data = problem.arcs(settings.data, settings.seed)
    priors = _priors(learnt, settings.axes)
    usable = [{**task.settings, "orbit": learnt[name]["orbit"].tolist(), "alone": learnt[name]["logarithms"].tolist(),
               "prior": [values.tolist() for values in priors[_kind(name, learnt[name])]]}
              for task in tasks if (name := task.settings["satellite"]) in learnt]
    found = [Task(f"predict/{one['satellite']}", settings.seed, one) for one in usable]
    found += [Task(f"ways/{one['satellite']}", settings.seed, one) for one in usable[:settings.alternatives]]
    # Two windows of a quarter of a day, at two and at four sevenths of what is left.
    left = data.times[-1] / 24.0 - settings.train_days
    windows = [[begin, begin + _WINDOW] for begin in (settings.train_days + share * left for share in (2 / 7, 4 / 7))]
    return found + [Task(f"online/{one['satellite']}", settings.seed, {**one, "windows": windows})
                    for one in usable[:settings.alternatives and 1] if left > 10 * _WINDOW]


def compute(task: Task) -> Result:
    """Compute one task."""
    asked, started = task.settings, time.process_time()
    data = problem.arcs(asked["data"], task.seed)
    try:
        one = prediction.arc(data, asked["satellite"], asked["train_days"])
    except prediction.Unusable as reason:
        return {_REFUSED: str(reason)}
    try:
        found = _compute(task.name.split("/")[0], one, task)
    except ValueError as reason:  # an orbit that does not fit: a gap, or a manoeuvre; a window without positions
        return {_REFUSED: f"{asked['satellite']}: {reason}"}
    return {**found, "cpu_s": time.process_time() - started}


def _compute(kind: str, one: problem.Arc, task: Task) -> Result:
    asked = task.settings
    if kind == "learn":
        return _learn(one, asked["axes"])
    orbit = orbits.Orbit(float(one.times[0]), np.array(asked["orbit"][:6]), *asked["orbit"][6:])
    prior = magnitudes.Prior(*map(np.array, asked["prior"]))
    if kind == "ways":
        return ways.compare(one, prediction.deterministic(one, orbit), asked["axes"], prior, task.key)
    target = learning.held_out(Training.of(one, orbit, asked["axes"]), prior)
    mode = target.mode(np.array(asked["alone"]))
    if kind == "online":
        return _online(one, orbit, mode, asked)
    draws = target.draws(mode, learning.DRAWS)
    return _predict(one, prediction.deterministic(one, orbit), mode, draws, asked["axes"])


def _learn(one: problem.Arc, axes: str) -> Result:
    orbit = orbits.fit_orbit(one.environment, one.times[:one.train], one.positions[:one.train])
    prediction.latest_orbit(one, one.train, orbit.solar)
    period = float(orbits.period_of(orbit.state[None]))
    if period < _SHORTEST:
        raise ValueError(f"it turns in {period:.1f} h; positions and steps are too far apart for less than "
                         f"{_SHORTEST:g} h, and the drag of the air is left out.")
    target = learning.held_out(Training.of(one, orbit, axes), magnitudes.wide(axes))
    return {"orbit": np.array([*orbit.state, orbit.solar, orbit.residual]), "logarithms": target.mode()}


def _predict(one: problem.Arc, paths: prediction.Deterministic, mode: np.ndarray, draws: np.ndarray, axes: str
             ) -> Result:
    near = prediction.surroundings(one, paths.orbit, axes)
    found = prediction.predict(one, near, draws)
    everything = prediction.predict(one, near, mode[None], one.positions)
    frame = problem.axes_of(paths.fitted)
    lfm, sd, coverage = prediction.judge(one, found.state[:, :3], found.covariance, frame)

    def error(path: np.ndarray) -> np.ndarray:
        return np.einsum("tji,tj->ti", frame, path[:, :3] - one.positions)

    return {
        "times": one.times, "train": one.train, "residual": paths.orbit.residual, "solar": paths.orbit.solar,
        "eclipsed": problem.eclipsed(one.environment, one.times, paths.fitted),
        "complete": np.isfinite(one.positions).all(), "fitted": error(paths.fitted), "latest": error(paths.latest),
        "lfm": lfm, "sd": sd, "coverage": coverage.mean(),
        "forces": found.forces, "forces_sd": found.forces_sd, "seen": everything.forces,
        "force_names": np.array(list(orbits.small_forces(axes))), "logarithms": mode}


def _online(one: problem.Arc, orbit: orbits.Orbit, logarithms: np.ndarray, asked: Mapping[str, Any]
            ) -> Result:
    mean, variance, observed, restarted = prediction.online(one, orbit, logarithms, asked["axes"], asked["windows"])
    return {"times": one.times, "observed": observed, "lfm": mean - one.positions,
            "sd": np.sqrt(variance + problem.NOISE**2), "restarted": restarted[:, :3] - one.positions}


def outcome(settings: Settings, results: Results) -> Outcome:
    """Return what became of the satellites.

    Raises:
        ValueError: no satellite can be predicted.
    """
    refused: dict[str, str] = {}
    learnt, predicted = (_kept(results, kind, refused) for kind in ("learn/", "predict/"))
    if not predicted:
        raise ValueError("no satellite can be predicted. " + " ".join(refused.values()))
    predicted = {name: one | {"cpu_s": one["cpu_s"] + learnt[name]["cpu_s"]} for name, one in predicted.items()}
    return Outcome(predicted, _priors(learnt, settings.axes), _kept(results, "ways/", {}),
                   _kept(results, "online/", {}), refused)


def _priors(learnt: Mapping[str, Result], axes: str) -> dict[str, magnitudes.Prior]:
    """Return what the satellites of each constellation have in common that turn in about the same time."""
    groups = problem.grouped(learnt, lambda name: _kind(name, learnt[name]))
    return {kind: magnitudes.common([one["logarithms"] for one in own.values()], axes) for kind, own in groups.items()}


def _kind(satellite: str, learnt: Result) -> str:
    """Return the constellation of a satellite, and in how many hours it turns: BeiDou has orbits of 13 and of 24."""
    return f"{problem.system(satellite)} {float(orbits.period_of(learnt['orbit'][None, :6])):.0f} h"


def _kept(results: Results, kind: str, refused: dict[str, str]) -> dict[str, Result]:
    """Return satellite -> result of one kind of task; why others were refused is added to ``refused``."""
    own = {name.removeprefix(kind): one for name, one in results.items() if name.startswith(kind)}
    refused |= {name: str(one[_REFUSED]) for name, one in own.items() if _REFUSED in one}
    return {name: one for name, one in own.items() if _REFUSED not in one}


def magnitudes_of(results: dict[str, Result], priors: Mapping[str, magnitudes.Prior], axes: str) -> pd.DataFrame:
    """Return one row a magnitude of the small forces, in nm/s^2 and hours: what is common, and each satellite's."""
    columns: dict[str, np.ndarray] = {}
    for system, prior in priors.items():
        of = f", {system}" if len(priors) > 1 else ""
        columns |= {f"common{of}": np.exp(prior.mean), f"factor{of}": np.exp(prior.sd)}
    columns |= {name: np.exp(one["logarithms"]) for name, one in results.items()}
    return pd.DataFrame(columns, index=list(magnitudes.names(axes)))


def satellites(results: dict[str, Result]) -> pd.DataFrame:
    """Return one row a satellite: errors after training in metres, and what was chosen."""
    rows = {}
    for name, one in results.items():
        after = slice(int(one["train"]), None)
        lfm = one["lfm"][after]
        rows[name] = {
            "eclipsed": "yes" if one["eclipsed"] else "no", "fit": float(one["residual"]) / METRE,
            "deterministic": rms(one["fitted"][after]), "latest state": rms(one["latest"][after]),
            "LFM": rms(lfm), "LFM radial": rms(lfm[:, :1]), "LFM tangential": rms(lfm[:, 1:2]),
            "LFM normal": rms(lfm[:, 2:]), "LFM at the end": float(np.linalg.norm(lfm[-1])) / METRE,
            "ratio": rms(lfm) / rms(one["fitted"][after]), "coverage": float(one["coverage"]),
            "CPU s": float(one["cpu_s"])}
    return pd.DataFrame.from_dict(rows, orient="index")


def pooled(results: dict[str, Result]) -> pd.DataFrame:
    """Return one row a group of satellites: pooled errors in metres, ratios and coverage.

    Satellites with gaps stand apart: a gap is often a manoeuvre, which no model of small forces predicts. Several
    constellations are pooled each by itself, too.
    """
    rows, systems = _pooled(results), problem.grouped(results)
    if len(systems) > 1:
        for system, own in systems.items():
            rows |= {f"{system}, {group}": row for group, row in _pooled(own).items()}
    return pd.DataFrame.from_dict(rows, orient="index")


def _pooled(results: dict[str, Result]) -> dict[str, dict[str, Any]]:
    complete = [name for name, one in results.items() if one["complete"]]
    groups = {"without gaps": complete,
              "without gaps, never in shadow": [name for name in complete if not results[name]["eclipsed"]],
              "without gaps, in shadow": [name for name in complete if results[name]["eclipsed"]],
              "with gaps": [name for name in results if name not in complete]}
    rows: dict[str, dict[str, Any]] = {}
    for group, names in groups.items():
        if not names:
            continue
        own = satellites({name: results[name] for name in names})
        together = {column: float(np.sqrt((own[column] ** 2).mean())) for column in
                    ("deterministic", "latest state", "LFM", "LFM radial", "LFM tangential", "LFM normal")}
        rows[group] = {
            "satellites": len(own), "fit, median": own["fit"].median(), **together,
            "median": own["LFM"].median(), "ratio": together["LFM"] / together["deterministic"],
            "ratio, latest": together["LFM"] / together["latest state"],
            "improved": int((own["LFM"] < own["deterministic"]).sum()), **pair("coverage", mean_of(own["coverage"]))}
    return rows


def tabulated(settings: Settings, results: Results) -> dict[str, Table]:
    """Return the tables."""
    one = outcome(settings, results)
    each = satellites(one.predicted)
    found = {"pooled": Table("Errors after training (m), pooled over satellites, and 95% coverage",
                             pooled(one.predicted)),
             "satellites": Table("Each satellite: root mean square errors after training (m)", each, _few(each)),
             "magnitudes": Table("", magnitudes_of(one.predicted, one.priors, settings.axes))}
    if one.compared:
        found["learning"] = Table("Ways to learn the magnitudes of the forces: error after training (m)",
                                  ways.table(one.compared))
    if one.refused:
        reasons = pd.DataFrame({"reason": one.refused})
        found["left out"] = Table("Left out", reasons, reasons, stored=False)
    return found


def _few(frame: pd.DataFrame) -> pd.DataFrame:
    columns = ["eclipsed", "fit", "deterministic", "latest state", "LFM", "ratio", "coverage"]
    digits = {"fit": 2, "deterministic": 1, "latest state": 1, "LFM": 2, "ratio": 3, "coverage": 3}
    return pd.DataFrame({column: frame[column].map(f"{{:.{digits[column]}f}}".format) if column in digits
                         else frame[column] for column in columns}, index=frame.index)


def drawn(settings: Settings, results: Results) -> dict[str, Figure]:
    """Return the figures."""
    one = outcome(settings, results)
    return figures.draw(one.predicted, one.online)


STUDY = Study(Settings, plan, compute, tabulated, drawn, label="", then=plan_predictions)
