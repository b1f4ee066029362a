"""The study: its settings, tasks, tables and figures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import study, weighting
from lfm_ppl.experiments.constrained import estimators, figures, problem, tables
from lfm_ppl.experiments.study import Results, Study, Table, blocks, setting
from lfm_ppl.inference.optimise import newton, quasi_newton

_SEARCH = {"ftol": 1e-10, "gtol": 1e-4}
_FURTHEST = float(np.log(problem.TIMES[-1] / 2.0))
"""Largest logarithm of the lengthscale that is learnt from 60 samples, whose likelihood often has no maximum."""


@dataclass(frozen=True)
class Settings(study.Settings):
    """How much is computed."""

    runs: int = setting(100, "records of each shape of the transcription factor", quick=2,
                        aliases=study.REALISATIONS, per_seed=problem.MOST)
    patients: int = setting(50, "simulated days of TSH, FT3 and FT4", quick=2, per_seed=problem.MOST)
    targets: int = setting(20, "on reentry", quick=2, per_seed=problem.MOST)
    draws: int = setting(16, "of a patient's parameters, over which bands are averaged")
    weighted: int = setting(150, "draws from which these are taken")
    shapes: tuple[str, ...] = setting(problem.SHAPES, "of the force", quick=problem.SHAPES[:1], choices=problem.SHAPES)
    methods: tuple[str, ...] = setting(
        tuple(estimators.METHODS), "estimators, with full information and EP among them",
        quick=(estimators.SMOOTHER, estimators.FULL, estimators.BANDS), choices=tuple(estimators.METHODS))
    block: int = setting(25, "records that are computed in one go, and stored in one file")

    def __post_init__(self) -> None:
        """Check what a user gives."""
        super().__post_init__()
        for method in (estimators.FULL, estimators.BANDS):
            if method not in self.methods:
                raise ValueError(f"--methods must hold {method!r}, which figures and tables are about; it names "
                                 f"{', '.join(self.methods)}.")


def all_tasks(settings: Settings) -> list[Task]:
    """Return a task for each block of records of a shape, of targets and of patients."""
    kinds = [("ballistic", "", settings.targets), ("thyroid", "", settings.patients)]
    kinds += [("transcription", shape, settings.runs) for shape in settings.shapes]
    own: dict[str, dict[str, Any]] = {
        "ballistic": {}, "thyroid": {"draws": settings.draws, "weighted": settings.weighted},
        "transcription": {"methods": list(settings.methods)}}
    return [
        Task("/".join([what, *filter(None, [shape.replace(" ", "-")]), f"{first:04d}"]), settings.seed,
             {"experiment": "constrained", "what": what, "shape": shape, "first": first,
              "count": last - first + 1, **own[what]})
        for what, shape, count in kinds for first, last in blocks(count, settings.block)]


def _indices(task: Task) -> range:
    return range(task.settings["first"], task.settings["first"] + task.settings["count"])


def posterior_mode(posterior: Any, y: np.ndarray, prior: float = 1.0, furthest: float = np.inf) -> np.ndarray:
    """Return the logarithms of parameters at the mode, where the density is that of the logarithms."""
    medians = dict(zip(posterior.bound.names, posterior.bound.draw(jax.random.key(0)), strict=True))
    start = np.array([medians[name] for name in posterior.names])
    bounds = np.stack([start - furthest, start + furthest], axis=1)
    return quasi_newton(posterior.objective(y, prior), start, bounds=bounds, options=_SEARCH).point


def drawn(posterior: Any, y: np.ndarray, mode: np.ndarray, seed: int, draws: int,
          weighted: int) -> tuple[np.ndarray, float]:
    """Return draws (draws, P) of the logarithms of parameters from their posterior, and the weights' Pareto index.

    They are taken at equal distances from weighted draws about the mode. Where there is no curvature, all are at the
    mode, and the index is infinite.
    """
    minimum = newton(posterior.objective(y), mode)
    if minimum.curvature is None:
        return np.tile(mode, (draws, 1)), np.inf
    found = weighting.weighted(lambda z: np.sum(posterior.log_densities_of(z, y), axis=0), [minimum], weighted, seed)
    share = np.cumsum(np.exp(found.weights.log_weight[0]))
    chosen = np.searchsorted(share / share[-1], (np.arange(draws) + 0.5) / draws)
    return found.draws[chosen], found.weights.k


def _transcription(task: Task) -> Result:
    """Return by estimator, ``{method}/``: ``mse``, ``minimum``, ``coverage`` (N,), and the ``first`` record's paths."""
    records = [problem.record(task.settings["shape"], index, task.seed) for index in _indices(task)]
    y, truth = (np.stack([getattr(one, name) for one in records]) for name in ("y", "force"))
    values: dict[str, np.ndarray] = {}
    methods = {method: estimators.METHODS[method] for method in task.settings["methods"]}
    for kind in dict.fromkeys(methods.values()):
        if kind in estimators.STATES:
            values[kind] = estimators.states(kind, y)
            continue
        posterior = problem.learning(kind)
        count = len(posterior.bound.times)
        # The source maximises the likelihood of the first samples.
        how = {"prior": 0.0, "furthest": _FURTHEST} if kind == "early" else {}
        values[kind] = np.exp([posterior_mode(posterior, one[:count], **how) for one in y])
    result: Result = {f"hyperparameters/{kind}": found for kind, found in values.items()} | {"truth": truth[0]}
    for method, kind in methods.items():
        rows = estimators.ROWS[method]
        estimate, low, high = (np.asarray(a) for a in estimators.transcription(method)(values[kind], y))
        exact, after = truth[:, ::rows], slice(problem.WINDOW // rows, None)
        covered = np.where(np.isfinite(low), (low <= exact) & (exact <= high), np.nan)
        result |= {f"{method}/mse": ((estimate - exact)[:, after] ** 2).mean(axis=1),
                   f"{method}/minimum": estimate.min(axis=1), f"{method}/coverage": covered[:, after].mean(axis=1),
                   f"{method}/first": np.stack([estimate[0], low[0], high[0]]),
                   f"{method}/failed": ~np.isfinite(estimate).all(axis=1) | np.isinf(low).any(axis=1)}
    return result


def _ballistic(task: Task) -> Result:
    """Return ``rmse`` (N, 3) and ``converged`` (N,), and the first target's ``estimate`` and ``truth`` (3, T)."""
    pairs = [problem.target(index, task.seed) for index in _indices(task)]
    y, truth = (np.stack(part) for part in zip(*pairs, strict=True))
    paths, converged = (np.asarray(a) for a in estimators.ballistic()(y))
    return {"rmse": np.sqrt(((paths - truth) ** 2).mean(axis=2)), "converged": converged, "estimate": paths[0],
            "truth": truth[0]}


def _thyroid(task: Task) -> Result:
    """Return what `estimators.thyroid` does, and ``rmse``, ``coverage`` (N,), ``peak`` (N, 2) in h, ``truth`` (N, K).

    A peak is the greatest value and the maximum of the wave of 24 h that fits best; errors of both are returned.
    """
    patients = [problem.patient(index, task.seed) for index in _indices(task)]
    posterior = problem.thyroid_learning()
    z = np.stack([posterior_mode(posterior, one.y) for one in patients])
    y = np.stack([one.y for one in patients])
    seeds = [problem.MOST * task.seed + index for index in _indices(task)]
    counts = task.settings["draws"], task.settings["weighted"]
    draws, k = zip(*(drawn(posterior, *one, *counts) for one in zip(y, z, seeds, strict=True)), strict=True)
    full, bands = estimators.thyroid()
    found = {name: np.asarray(value) for name, value in (full(z, y) | bands(np.stack(draws), y)).items()}
    times = found.pop("times")[0]
    truth = np.stack([np.interp(times, one.truth["times"], one.truth["forces"][problem.HORMONE]) for one in patients])
    held = (found["low"] <= truth) & (truth <= found["high"])
    errors = np.stack([_apart(peak(times, found["mode"]), peak(times, truth)), _apart(
        acrophase(times, found["mode"]), acrophase(times, truth))], axis=1)
    return found | {"times": times, "truth": truth, "z": z, "draws": np.stack(draws), "k": np.array(k),
                    "coverage": held.mean(axis=1), "peak": errors,
                    "rmse": np.sqrt(((found["mode"] - truth) ** 2).mean(axis=1)), "y": y[0],
                    "measured": patients[0].times}


def peak(times: np.ndarray, paths: np.ndarray) -> np.ndarray:
    """Return when paths (N, K) are greatest."""
    return times[paths.argmax(axis=1)]


def acrophase(times: np.ndarray, paths: np.ndarray) -> np.ndarray:
    """Return when the wave of 24 h that fits paths (N, K) best is greatest, in h."""
    angle = 2.0 * np.pi * times / 24.0
    wave = np.stack([np.ones_like(times), np.cos(angle), np.sin(angle)], axis=1)
    _, cosine, sine = np.linalg.lstsq(wave, paths.T, rcond=None)[0]
    return np.arctan2(sine, cosine) * 12.0 / np.pi % 24.0


def _apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the distance of times of day."""
    return np.abs((a - b + 12.0) % 24.0 - 12.0)


def tabulated(settings: Settings, results: Results) -> dict[str, Table]:
    """Return the tables."""
    return {"transcription": Table(
                f"Transcription, {len(settings.shapes)} shapes of force by {settings.runs} records",
                tables.transcription(settings, results)),
            "shapes": Table("By the shape of the force", tables.shapes(settings, results)),
            "others": Table(f"{settings.targets} targets on reentry and {settings.patients} patients",
                            tables.others(settings, results))}


KINDS = {"transcription": _transcription, "ballistic": _ballistic, "thyroid": _thyroid}
"""What the tasks are."""

STUDY = Study(Settings, all_tasks, KINDS, tabulated, figures.draw, label="estimator")
