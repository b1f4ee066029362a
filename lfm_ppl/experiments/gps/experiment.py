"""The comparison on all satellites: one task each, and the tables that follow from them."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from lfm_ppl import checks, orbits
from lfm_ppl.engine.cluster import Workers, started
from lfm_ppl.engine.run import Reporter, run_tasks
from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import output
from lfm_ppl.experiments.gps import figures, learning, magnitudes, prediction, problem, ways
from lfm_ppl.experiments.gps.figures import METRE, rms
from lfm_ppl.experiments.gps.training import Training
from lfm_ppl.experiments.scores import mean_of, pair

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
        magnitudes: one row a magnitude of the small forces: what satellites have in common, and each of them.
        learning: one row a way to learn the magnitudes; empty where there are none.
        online: satellite -> result of its prediction as positions come in.
    """

    settings: Settings
    results: dict[str, Result]
    refused: dict[str, str]
    satellites: pd.DataFrame
    pooled: pd.DataFrame
    magnitudes: pd.DataFrame
    learning: pd.DataFrame
    online: dict[str, Result]


def quick(**given: Any) -> Settings:
    """Return settings that show in a few minutes that everything runs: two satellites."""
    return Settings(**{"most": 2, "alternatives": 1} | given)


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
              "axes": settings.axes}
    found = []
    for name in names:
        try:
            digest = prediction.arc(data, name, settings.train_days).digest
        except prediction.Unusable:
            digest = None
        found.append(Task(f"learn/{name}", settings.seed, {**shared, "satellite": name, "positions": digest}))
    return found


def plan_predictions(settings: Settings, learnt: Mapping[str, Result], tasks: list[Task]) -> list[Task]:
    """Return the tasks that follow: the predictions, and the ways to learn on the first satellites.

    Args:
        settings: what is asked.
        learnt: satellite -> result of its first task; those that can be predicted.
        tasks: the first ones.
    """
    data = problem.arcs(settings.data, settings.seed)
    prior = magnitudes.common([one["logarithms"] for one in learnt.values()], settings.axes)
    usable = [{**task.settings, "orbit": learnt[name]["orbit"].tolist(), "alone": learnt[name]["logarithms"].tolist(),
               "prior": [values.tolist() for values in prior]}
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


def run(settings: Settings, folder: str | Path, *, overwrite: bool = False,
        report: Reporter | None = None, workers: Workers = 1) -> Found:
    """Run the comparison, or what is missing of it.

    Args:
        settings: what is asked.
        folder: of the tasks.
        overwrite: compute again what was stored with other settings.
        report: what to do with a line of progress; None: nothing.
        workers: what computes; see `run_tasks`.

    Raises:
        ValueError: data that cannot be used, an unknown satellite, no satellite that can be predicted, or stored
            results of other settings.
        FileNotFoundError: there are no files.
    """
    first = plan(settings)
    refused: dict[str, str] = {}
    with started(workers) as running:  # once, for both rounds
        def done(planned: list[Task]) -> dict[str, Result]:
            return run_tasks(planned, compute, Path(folder) / "tasks", overwrite=overwrite, report=report,
                             workers=running or 1)

        learnt = _kept(first, done(first), "learn/", refused)
        if not learnt:
            raise ValueError("no satellite can be predicted. " + " ".join(refused.values()))
        second = plan_predictions(settings, learnt, first)
        results = done(second)
    predicted = _kept(second, results, "predict/", refused)
    compared, online = (_kept(second, results, kind, {}) for kind in ("ways/", "online/"))
    if not predicted:
        raise ValueError("no satellite can be predicted. " + " ".join(refused.values()))
    for name, result in predicted.items():
        result["cpu_s"] = result["cpu_s"] + learnt[name]["cpu_s"]
    prior = magnitudes.common([one["logarithms"] for one in learnt.values()], settings.axes)
    return Found(settings, predicted, refused, satellites(predicted), pooled(predicted),
                 magnitudes_of(predicted, prior, settings.axes), ways.table(compared), online)


def _kept(planned: list[Task], results: dict[str, Result], kind: str, refused: dict[str, str]) -> dict[str, Result]:
    """Return satellite -> result of one kind of task; why others were refused is added to ``refused``."""
    found = {}
    for task in planned:
        if task.name.startswith(kind):
            name, result = task.settings["satellite"], results[task.name]
            if _REFUSED in result:
                refused[name] = str(result[_REFUSED])
            else:
                found[name] = result
    return found


def magnitudes_of(results: dict[str, Result], prior: magnitudes.Prior, axes: str) -> pd.DataFrame:
    """Return one row a magnitude of the small forces, in nm/s^2 and hours: what is common, and each satellite's."""
    columns = {"common": np.exp(prior.mean), "factor": np.exp(prior.sd)}
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
    named = {"satellites": found.satellites, "pooled": found.pooled, "magnitudes": found.magnitudes}
    if len(found.learning):
        named["learning"] = found.learning
    return output.save(folder, named, figures.draw(found.results, found.online), "")
