"""Computations for one satellite: learn its magnitudes, then predict with the common prior of its group."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from lfm_ppl import orbits
from lfm_ppl.orbits import learning, magnitudes, prediction
from lfm_ppl.orbits.arc import NOISE, Arc, Unusable
from lfm_ppl.orbits.frames import rtn_along
from lfm_ppl.orbits.training import Training
from lfm_ppl.parallel.task import Result, Task

from . import problem

REFUSED = "refused"
"""Only entry of the result of a satellite that the study leaves out: the reason."""
_MIN_PERIOD = 5.0
"""Smallest orbital period (h)."""


def compute_or_refuse(compute: Callable[[Arc, Task], Result], task: Task) -> Result:
    """Return the result of a task and its CPU seconds, or the reason why the study leaves the satellite out."""
    settings, started = task.settings, time.process_time()
    data = problem.arcs(settings["data"], task.seed, settings.get("include", ()))
    try:
        arc = data.arc(settings["satellite"], settings["train_days"])
    except Unusable as reason:
        return {REFUSED: str(reason)}
    try:
        result = compute(arc, task)
    except ValueError as reason:  # an orbit that does not fit: a gap, or a manoeuvre; a window without positions
        return {REFUSED: f"{settings['satellite']}: {reason}"}
    return {**result, "cpu_s": time.process_time() - started}


def learn(arc: Arc, task: Task) -> Result:
    """Return the orbit fitted to the training data (8,), with sunlight and residual, and logarithms of magnitudes."""
    axes = task.settings["axes"]
    orbit = orbits.fit_orbit(arc.environment, arc.times[:arc.train], arc.positions[:arc.train])
    prediction.latest_orbit(arc, arc.train, orbit.solar)
    period = float(orbits.period_of(orbit.state[None]))
    if period < _MIN_PERIOD:
        raise ValueError(f"its period is {period:.1f} h; positions and steps are too far apart for periods below "
                         f"{_MIN_PERIOD:g} h, and the model has no drag of the air.")
    target = learning.held_out(Training.of(arc, orbit, axes), magnitudes.wide(axes))
    return {"orbit": np.array([*orbit.state, orbit.solar, orbit.residual]), "logarithms": target.mode()}


def restore_training(arc: Arc, task: Task) -> tuple[orbits.Orbit, Training, magnitudes.Prior]:
    """Return the fitted orbit, the training data along it, and the common prior of the satellite's group."""
    *state, solar, residual = task.settings["orbit"]
    orbit = orbits.Orbit(float(arc.times[0]), np.array(state), solar, residual)
    prior = magnitudes.Prior(*map(np.array, task.settings["prior"]))
    return orbit, Training.of(arc, orbit, task.settings["axes"]), prior


def predict(arc: Arc, task: Task) -> Result:
    """Return errors (km) of all models, predicted ``forces`` (nm/s^2), and the smoothed forces ``seen``."""
    orbit, data, prior = restore_training(arc, task)
    target = learning.held_out(data, prior)
    mode = target.mode(np.array(task.settings["alone"]))
    draws = target.draws(mode, learning.DRAWS)
    paths = prediction.deterministic(arc, orbit)
    neighbourhood = prediction.surroundings(arc, orbit, data.axes)
    forecast = prediction.predict(arc, neighbourhood, draws)
    directions = rtn_along(paths.fitted)
    lfm, sd, coverage = prediction.judge(arc, forecast, directions)
    return {
        "times": arc.times, "train": arc.train, "residual": orbit.residual, "solar": orbit.solar,
        "eclipsed": arc.eclipsed(paths.fitted), "complete": np.isfinite(arc.positions).all(),
        "fitted": prediction.errors(arc, paths.fitted, directions),
        "latest": prediction.errors(arc, paths.latest, directions), "lfm": lfm, "sd": sd, "coverage": coverage.mean(),
        "forces": forecast.forces, "forces_sd": forecast.forces_sd,
        "seen": prediction.predict(arc, neighbourhood, mode[None], arc.positions).forces,
        "force_names": np.array(list(orbits.small_forces(data.axes))), "logarithms": mode}


def online(arc: Arc, task: Task) -> Result:
    """Return errors (km) of online predictions of both models, with observations in training and in ``windows``."""
    orbit, data, prior = restore_training(arc, task)
    mode = learning.held_out(data, prior).mode(np.array(task.settings["alone"]))
    mean, variance, observed, restarted = prediction.online(arc, orbit, mode, data.axes, task.settings["windows"])
    return {"times": arc.times, "observed": observed, "lfm": mean - arc.positions,
            "sd": np.sqrt(variance + NOISE**2), "restarted": restarted[:, :3] - arc.positions}
