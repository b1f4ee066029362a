"""Simulated targets on reentry, observed by a radar, and the densities of the model's parameters.

1. Simulate targets from the model file, at its true parameters or at parameters drawn from the prior. Target ``index``
   is the one that ``lfm-ppl simulate`` writes for a seed that follows from it.
2. Reduce the simulation to altitude, speed and acceleration at the measurement times.
3. Bind the NumPyro model, with the file's default parameters fixed, to data; its posterior is a function of the
   logarithms z of drag, and of scale and lengthscale of the force.

Programs are compiled once and serve all targets, for which the functions are cached. As in the source, targets start at
the mean of the smoothers' prior, 65 km and 3 km/s.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpyro import handlers

import lfm_ppl as lfm
from lfm_ppl.io import loading

from ..log_posterior import LogPosterior

NAMES = ("alpha", "scale", "lengthscale")
"""Unknown parameters: the drag, and two parameters of the force. All computations use their logarithms z."""

MEDIANS = (5e-4, 30.0, 5.0)
"""Prior medians of the parameters, where searches start."""

PATHS = {"altitude": "m", "speed": "m/s", "u": "m/s^2"}
"""States and force to estimate, in the order of the rows of every array of paths -> unit."""

STEPS = 5
"""Integration steps of the simulation between two times of the model file's truth."""

RECORDS_PER_SEED = 10_000
"""Number of targets for one seed of the study."""


@dataclass(frozen=True)
class SimulatedTarget:
    """A simulated target.

    Attributes:
        times: times (T,) of the measurements.
        y: measured distances (T, 1).
        paths: true paths (3, T) at these times.
        z: logarithms (3,) of the true parameters.
    """

    times: np.ndarray
    y: np.ndarray
    paths: np.ndarray
    z: np.ndarray


@functools.lru_cache(maxsize=1024)
def simulate_target(index: int, seed: int = 0) -> SimulatedTarget:
    """Return target ``index`` at the true parameters, as ``lfm-ppl simulate`` with the seed 10000 seed + index."""
    data = model_file().simulate(seed=RECORDS_PER_SEED * seed + index)
    truth: Any = data.truth
    paths = _true_paths(data.times, truth["times"], truth["state"], truth["forces"])
    return SimulatedTarget(data.times, np.asarray(data.y), paths, np.asarray(true_z()))


@functools.lru_cache(maxsize=1024)
def simulate_target_from_prior(index: int, seed: int = 0) -> SimulatedTarget:
    """Return target ``index`` with parameters and initial state drawn from their priors."""
    z, simulation = _prior_simulator()(jax.random.fold_in(jax.random.key(seed), index))
    times = default_data().times
    rows = np.searchsorted(np.asarray(simulation.times), times - 1e-9)
    paths = _true_paths(times, simulation.times, simulation.state, simulation.forces)
    return SimulatedTarget(times, np.asarray(simulation.y)[rows], paths, np.asarray(z))


def _true_paths(times: np.ndarray, fine_times: Any, state: Any, forces: Any) -> np.ndarray:
    """Return the true paths (3, T) at the measurement times, from states and force at finer times."""
    rows = np.searchsorted(np.asarray(fine_times), times - 1e-9)
    return np.stack([*np.asarray(state)[rows].T, np.asarray(forces["u"])[rows]])


@functools.cache
def _prior_simulator() -> Any:
    """Return the compiled map from a random key to log parameters drawn from the prior and a simulation."""
    truth: Any = default_data().truth

    def draw(key: jax.Array) -> tuple[jax.Array, Any]:
        keys = jax.random.split(key)
        trace = handlers.trace(handlers.seed(model(), keys[0])).get_trace(default_data().times)
        z = jnp.log(jnp.stack([trace[name]["value"] for name in NAMES]))
        return z, lfm.simulate(keys[1], posterior().likelihood(z).model, np.asarray(truth["times"]), steps=STEPS)

    return jax.jit(draw)


@functools.cache
def model_file() -> loading.ModelFile:
    """Return the shipped model; the cache keeps its compiled simulator."""
    return loading.load("ballistic")


@functools.cache
def default_data() -> lfm.Data:
    """Return the model's default data."""
    with jax.ensure_compile_time_eval():
        return model_file().simulate()


def true_z() -> np.ndarray:
    """Return the logarithms of the true parameters (3,)."""
    truth: Any = default_data().truth
    return np.log([truth["parameters"][name] for name in NAMES])


@functools.cache
def model() -> Any:
    """Return the NumPyro model with its default parameters fixed."""
    with jax.ensure_compile_time_eval():
        return lfm.fix(model_file().model, dict(model_file().anchors(default_data())))


@functools.cache
def posterior() -> LogPosterior:
    """Return the posterior of z, as a function of the data."""
    data = default_data()
    with jax.ensure_compile_time_eval():
        return LogPosterior(lfm.bind(model(), data.times, data.y), NAMES)


@functools.cache
def true_likelihood() -> lfm.MarginalLikelihood:
    """Return the likelihood at the true parameters; the cache keeps its compiled programs for all targets."""
    with jax.ensure_compile_time_eval():
        return posterior().likelihood(true_z())
