"""What is computed for one satellite: it is learnt by itself, then predicted with what all have in common."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from lfm_ppl import orbits
from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments.gps import problem
from lfm_ppl.orbits import learning, magnitudes, prediction
from lfm_ppl.orbits.arc import NOISE, Arc, Unusable
from lfm_ppl.orbits.frames import rtn_along
from lfm_ppl.orbits.training import Training

REFUSED = "refused"
"""The only entry of the result of a satellite that is left out: why."""
_SHORTEST = 5.0
"""Hours in which a satellite turns at least."""


def attempt(compute: Callable[[Arc, Task], Result], task: Task) -> Result:
    """Return the result of a task and the CPU seconds it took, or why its satellite is left out."""
    asked, started = task.settings, time.process_time()
    data = problem.arcs(asked["data"], task.seed)
    try:
        arc = data.arc(asked["satellite"], asked["train_days"])
    except Unusable as reason:
        return {REFUSED: str(reason)}
    try:
        result = compute(arc, task)
    except ValueError as reason:  # an orbit that does not fit: a gap, or a manoeuvre; a window without positions
        return {REFUSED: f"{asked['satellite']}: {reason}"}
    return {**result, "cpu_s": time.process_time() - started}


def learn(arc: Arc, task: Task) -> Result:
    """Return the orbit that fits the training, (8,) with sunlight and residual, and the satellite's own magnitudes."""
    axes = task.settings["axes"]
    orbit = orbits.fit_orbit(arc.environment, arc.times[:arc.train], arc.positions[:arc.train])
    prediction.latest_orbit(arc, arc.train, orbit.solar)
    period = float(orbits.period_of(orbit.state[None]))
    if period < _SHORTEST:
        raise ValueError(f"it turns in {period:.1f} h; positions and steps are too far apart for less than "
                         f"{_SHORTEST:g} h, and the drag of the air is left out.")
    target = learning.held_out(Training.of(arc, orbit, axes), magnitudes.wide(axes))
    return {"orbit": np.array([*orbit.state, orbit.solar, orbit.residual]), "logarithms": target.mode()}


def given(arc: Arc, task: Task) -> tuple[orbits.Orbit, Training, magnitudes.Prior]:
    """Return the orbit that was fitted, the training along it, and the prior that satellites of its group share."""
    *state, solar, residual = task.settings["orbit"]
    orbit = orbits.Orbit(float(arc.times[0]), np.array(state), solar, residual)
    prior = magnitudes.Prior(*map(np.array, task.settings["prior"]))
    return orbit, Training.of(arc, orbit, task.settings["axes"]), prior


def predict(arc: Arc, task: Task) -> Result:
    """Return errors (km) of all models, the forces (nm/s^2) predicted and as all positions show them (`seen`)."""
    orbit, data, prior = given(arc, task)
    target = learning.held_out(data, prior)
    mode = target.mode(np.array(task.settings["alone"]))
    draws = target.draws(mode, learning.DRAWS)
    paths = prediction.deterministic(arc, orbit)
    near = prediction.surroundings(arc, orbit, data.axes)
    predicted = prediction.predict(arc, near, draws)
    directions = rtn_along(paths.fitted)
    lfm, sd, coverage = prediction.judge(arc, predicted, directions)
    return {
        "times": arc.times, "train": arc.train, "residual": orbit.residual, "solar": orbit.solar,
        "eclipsed": arc.eclipsed(paths.fitted), "complete": np.isfinite(arc.positions).all(),
        "fitted": prediction.errors(arc, paths.fitted, directions),
        "latest": prediction.errors(arc, paths.latest, directions), "lfm": lfm, "sd": sd, "coverage": coverage.mean(),
        "forces": predicted.forces, "forces_sd": predicted.forces_sd,
        "seen": prediction.predict(arc, near, mode[None], arc.positions).forces,
        "force_names": np.array(list(orbits.small_forces(data.axes))), "logarithms": mode}


def online(arc: Arc, task: Task) -> Result:
    """Return errors (km) of both models as positions come in, in training and in ``windows`` after it."""
    orbit, data, prior = given(arc, task)
    mode = learning.held_out(data, prior).mode(np.array(task.settings["alone"]))
    mean, variance, observed, restarted = prediction.online(arc, orbit, mode, data.axes, task.settings["windows"])
    return {"times": arc.times, "observed": observed, "lfm": mean - arc.positions,
            "sd": np.sqrt(variance + NOISE**2), "restarted": restarted[:, :3] - arc.positions}
