"""The comparison on all satellites: one task each, and the tables that follow from them."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from lfm_ppl import checks, orbits
from lfm_ppl.experiments import output, tasks
from lfm_ppl.experiments.gps import figures, learning, prediction, problem
from lfm_ppl.experiments.gps.figures import METRE, rms
from lfm_ppl.experiments.scores import mean_of, pair
from lfm_ppl.experiments.tasks import Result, Task

_REFUSED = "refused"
_WINDOW = 0.25


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is asked of the comparison.

    Attributes:
        data: folder of SP3 files; None: simulated satellites.
        satellites: names; None: all GPS satellites, or all that are simulated.
        train_days: days to learn from; the others are predicted.
        axes: of the small forces, "DYB" or "RTN".
        alternatives: number of satellites whose magnitudes are learnt in every way.
        most: number of satellites where none are named; None: all.
        seed: of the simulation.
    """

    data: str | None = None
    satellites: tuple[str, ...] | None = None
    train_days: float = 3.0
    axes: str = "DYB"
    alternatives: int = 4
    most: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the numbers."""
        checks.positive("train_days", self.train_days, "Give the days to learn from (--train-days).")
        checks.one_of("axes", self.axes, tuple(orbits.AXES))


class Found(NamedTuple):
    """What the comparison found.

    Attributes:
        settings: what was asked.
        results: satellite -> its result.
        refused: satellite -> why it was left out.
        satellites: one row a satellite.
        pooled: one row a group of satellites.
        learning: one row a way to choose the magnitudes; empty where there are none.
        online: satellite -> result of its prediction as positions come in.
    """

    settings: Settings
    results: dict[str, Result]
    refused: dict[str, str]
    satellites: pd.DataFrame
    pooled: pd.DataFrame
    learning: pd.DataFrame
    online: dict[str, Result]


def quick(**given: Any) -> Settings:
    """Return settings that show in a few minutes that everything runs: two satellites."""
    return Settings(**{"most": 2, "alternatives": 1} | given)


def plan(settings: Settings) -> list[Task]:
    """Return the tasks: the prediction of each satellite, and the alternatives of the first ones.

    Raises:
        ValueError, FileNotFoundError: as `problem.arcs` and `prediction.arc`; a satellite that there is not.
    """
    data = problem.arcs(settings.data, settings.seed)
    names = tuple(data.positions)[:settings.most]
    if settings.satellites is not None:
        files = () if data.published is None else data.published.files
        names = orbits.check_satellites(settings.satellites, tuple(data.positions), files)
    shared = {"data": settings.data and str(Path(settings.data).resolve()), "train_days": settings.train_days,
              "axes": settings.axes, "candidates": [list(one) for one in problem.CANDIDATES]}
    found = [Task(f"predict/{name}", settings.seed, {**shared, "satellite": name}) for name in names]
    usable = [name for name in names if _refusal(data, name, settings.train_days) is None]
    found += [Task(f"learn/{name}", settings.seed, {**shared, "satellite": name})
              for name in usable[:settings.alternatives]]
    days = data.times[-1] / 24.0
    # Two windows of a quarter of a day, at two and at four sevenths of what is left.
    left = days - settings.train_days
    windows = [[begin, begin + _WINDOW] for begin in (settings.train_days + share * left for share in (2 / 7, 4 / 7))]
    return found + [Task(f"online/{name}", settings.seed, {**shared, "satellite": name, "windows": windows})
                    for name in usable[:settings.alternatives and 1] if left > 10 * _WINDOW]


def _refusal(data: problem.Arcs, name: str, train_days: float) -> str | None:
    try:
        prediction.arc(data, name, train_days)
    except prediction.Unusable as reason:
        return str(reason)
    return None


def compute(task: Task) -> Result:
    """Compute one task."""
    asked = task.settings
    data = problem.arcs(asked["data"], task.seed)
    try:
        one = prediction.arc(data, asked["satellite"], asked["train_days"])
    except prediction.Unusable as reason:
        return {_REFUSED: str(reason)}
    started = time.process_time()
    try:
        paths = prediction.deterministic(one)
    except ValueError as reason:
        return {_REFUSED: f"{asked['satellite']}: {reason}"}
    if task.name.startswith("learn/"):
        return learning.compare(one, paths, asked["axes"])
    chosen = prediction.validate(one, paths.orbit, asked["axes"])
    best = int(np.argmax(chosen.score))
    magnitudes = problem.CANDIDATES[best]
    if task.name.startswith("online/"):
        try:
            return _online(one, paths.orbit, magnitudes, asked)
        except ValueError as reason:  # a window without positions
            return {_REFUSED: f"{asked['satellite']}: {reason}"}
    found = prediction.predict(one, paths.orbit, magnitudes, asked["axes"])
    everything = prediction.predict(one, paths.orbit, magnitudes, asked["axes"], one.positions)
    axes = problem.axes_of(paths.fitted)
    lfm, sd, coverage = prediction.judge(one, found.state[:, :3], found.covariance, axes)

    def error(path: np.ndarray) -> np.ndarray:
        return np.einsum("tji,tj->ti", axes, path[:, :3] - one.positions)

    return {
        "times": one.times, "train": one.train, "residual": paths.orbit.residual, "solar": paths.orbit.solar,
        "eclipsed": problem.eclipsed(one.environment, one.times[:one.train], paths.fitted[:one.train]),
        "complete": np.isfinite(one.positions).all(), "fitted": error(paths.fitted), "latest": error(paths.latest),
        "lfm": lfm, "sd": sd, "coverage": coverage.mean(),
        "forces": found.forces, "forces_sd": found.forces_sd, "seen": everything.forces,
        "force_names": np.array(list(orbits.small_forces(asked["axes"]))), "scores": chosen.score,
        "held_out": chosen.rmse, "candidate": best, "log_likelihood": found.log_likelihood,
        "cpu_s": time.process_time() - started}


def _online(one: prediction.Arc, orbit: orbits.Orbit, magnitudes: problem.Magnitudes, asked: Mapping[str, Any]
            ) -> Result:
    mean, variance, observed, restarted = prediction.online(one, orbit, magnitudes, asked["axes"], asked["windows"])
    return {"times": one.times, "observed": observed, "lfm": mean - one.positions,
            "sd": np.sqrt(variance + problem.NOISE**2), "restarted": restarted[:, :3] - one.positions}


def run(settings: Settings, folder: str | Path, *, overwrite: bool = False,
        report: Callable[[str], None] | None = None, workers: int = 1) -> Found:
    """Run the comparison, or what is missing of it.

    Args:
        settings: what is asked.
        folder: of the tasks.
        overwrite: compute again what was stored with other settings.
        report: what to do with a line of progress; None: nothing.
        workers: processes that compute.

    Raises:
        ValueError: data that cannot be used, an unknown satellite, no satellite that can be predicted, or stored
            results of other settings.
        FileNotFoundError: there are no files.
    """
    planned = plan(settings)
    results = tasks.run_tasks(planned, compute, Path(folder) / "tasks", overwrite=overwrite, report=report,
                              workers=workers)
    predicted = {task.settings["satellite"]: results[task.name] for task in planned if task.name[:8] == "predict/"}
    refused = {name: str(result[_REFUSED]) for name, result in predicted.items() if _REFUSED in result}
    kept = {name: result for name, result in predicted.items() if name not in refused}
    if not kept:
        raise ValueError("no satellite can be predicted. " + " ".join(refused.values()))
    learnt, online = ({task.settings["satellite"]: results[task.name] for task in planned
                       if task.name.startswith(kind) and _REFUSED not in results[task.name]}
                      for kind in ("learn/", "online/"))
    return Found(settings, kept, refused, satellites(kept), pooled(kept), learning.table(learnt), online)


def satellites(results: dict[str, Result]) -> pd.DataFrame:
    """Return one row a satellite: errors after training in metres, and what was chosen."""
    rows = {}
    for name, one in results.items():
        after = slice(int(one["train"]), None)
        lfm = one["lfm"][after]
        magnitudes = problem.CANDIDATES[int(one["candidate"])]
        rows[name] = {
            "eclipsed": "yes" if one["eclipsed"] else "no", "fit": float(one["residual"]) / METRE,
            "deterministic": rms(one["fitted"][after]), "latest state": rms(one["latest"][after]),
            "LFM": rms(lfm), "LFM radial": rms(lfm[:, :1]), "LFM tangential": rms(lfm[:, 1:2]),
            "LFM normal": rms(lfm[:, 2:]), "LFM at the end": float(np.linalg.norm(lfm[-1])) / METRE,
            "ratio": rms(lfm) / rms(one["fitted"][after]), "coverage": float(one["coverage"]),
            **magnitudes._asdict(), "held out": float(one["held_out"][int(one["candidate"])]) / METRE,
            "CPU s": float(one["cpu_s"])}
    return pd.DataFrame.from_dict(rows, orient="index")


def pooled(results: dict[str, Result]) -> pd.DataFrame:
    """Return one row a group of satellites: pooled errors in metres, ratios and coverage.

    Satellites with gaps stand apart: a gap is often a manoeuvre, which no model of small forces predicts.
    """
    complete = [name for name, one in results.items() if one["complete"]]
    groups = {"without gaps": complete,
              "without gaps, never in shadow": [name for name in complete if not results[name]["eclipsed"]],
              "without gaps, in shadow": [name for name in complete if results[name]["eclipsed"]],
              "with gaps": [name for name in results if name not in complete]}
    rows = {}
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
    return pd.DataFrame.from_dict(rows, orient="index")


def save(found: Found, folder: str | Path) -> list[Path]:
    """Write tables and figures, and return their paths."""
    named = {"satellites": found.satellites, "pooled": found.pooled}
    if len(found.learning):
        named["learning"] = found.learning
    return output.save(folder, named, figures.draw(found.results, found.online), "")
