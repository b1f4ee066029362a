"""Data simulated from a shipped model, and the densities of the model's parameters.

1. Simulate data sets from the model file, at its true parameters or at parameters drawn from the prior.
2. Reduce states and forces to the paths of interest at the measurement times.
3. Bind the NumPyro model, with the file's default parameters fixed, to data; its posterior is a function of the
   logarithms z of the remaining parameters.

The model takes no known inputs. Programs are compiled once for a problem and serve all its data sets, for which the
functions are cached. Data set ``index`` is the one that ``lfm-ppl simulate`` writes for a seed that follows from it.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpyro import handlers

from lfm_ppl.inference.bind import bind
from lfm_ppl.inference.handlers.fixing import fix
from lfm_ppl.inference.log_posterior import LogPosterior
from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood
from lfm_ppl.io import loading
from lfm_ppl.io.data_set import Data
from lfm_ppl.model.simulate import simulate
from lfm_ppl.utils import checks

RECORDS_PER_SEED = 10_000
"""Number of data sets for one seed of a study."""


@dataclass(frozen=True)
class SimulationProblem:
    """A shipped model that simulates data, and the quantities that are estimated from them.

    Attributes:
        file: name of the model.
        names: names of the P unknown parameters. They are positive; all computations use their logarithms z. Other
            parameters have their default values.
        paths: names of the K estimated states and forces, in the order of the rows of every array of paths.
        units: units of the paths.
        medians: prior medians of the parameters, where searches start.
        steps: integration steps of the simulation between two times of the model file's truth.
    """

    file: str
    names: tuple[str, ...]
    paths: tuple[str, ...]
    units: tuple[str, ...]
    medians: tuple[float, ...]
    steps: int


class SimulatedRecord(NamedTuple):
    """One simulated data set.

    Attributes:
        times: times (T,) of the measurements.
        y: measurements (T, D).
        paths: true paths (K, T) at these times.
        z: logarithms (P,) of the true parameters.
    """

    times: np.ndarray
    y: np.ndarray
    paths: np.ndarray
    z: np.ndarray


@functools.lru_cache(maxsize=1024)
def simulate_record(problem: SimulationProblem, index: int, seed: int = 0) -> SimulatedRecord:
    """Return data set ``index`` at the true parameters, as ``lfm-ppl simulate`` with the seed 10000 seed + index."""
    data = model_file(problem.file).simulate(seed=RECORDS_PER_SEED * seed + index)
    truth: Any = data.truth
    paths = _true_paths(problem, data.times, truth["times"], truth["state"], truth["forces"])
    return SimulatedRecord(data.times, np.asarray(data.y), paths, np.asarray(true_z(problem)))


@functools.lru_cache(maxsize=1024)
def simulate_record_from_prior(problem: SimulationProblem, index: int, seed: int = 0) -> SimulatedRecord:
    """Return data set ``index`` whose parameters and initial state are drawn from their priors."""
    z, simulation = _prior_simulator(problem)(jax.random.fold_in(jax.random.key(seed), index))
    times = default_data(problem).times
    rows = np.searchsorted(np.asarray(simulation.times), times - 1e-9)
    paths = _true_paths(problem, times, simulation.times, simulation.state, simulation.forces)
    return SimulatedRecord(times, np.asarray(simulation.y)[rows], paths, np.asarray(z))


def _true_paths(problem: SimulationProblem, times: np.ndarray, fine_times: Any, state: Any, forces: Any) -> np.ndarray:
    """Return the true paths (K, T) at the measurement times, from states and forces at finer times."""
    names = true_likelihood(problem).model.state_names
    rows = np.searchsorted(np.asarray(fine_times), times - 1e-9)
    for name in problem.paths:
        checks.one_of("path", name, (*names, *forces))
    paths = [state[:, names.index(name)] if name in names else forces[name] for name in problem.paths]
    return np.stack([np.asarray(path)[rows] for path in paths])


@functools.cache
def _prior_simulator(problem: SimulationProblem) -> Any:
    """Return the compiled map from a random key to log parameters drawn from the prior and a simulation."""
    truth: Any = default_data(problem).truth

    def draw(key: jax.Array) -> tuple[jax.Array, Any]:
        keys = jax.random.split(key)
        trace = handlers.trace(handlers.seed(model(problem), keys[0])).get_trace(default_data(problem).times)
        z = jnp.log(jnp.stack([trace[name]["value"] for name in problem.names]))
        latent_force_model = posterior(problem).likelihood(z).model
        return z, simulate(keys[1], latent_force_model, np.asarray(truth["times"]), steps=problem.steps)

    return jax.jit(draw)


@functools.cache
def model_file(name: str) -> loading.ModelFile:
    """Return a shipped model; the cache keeps its compiled simulator."""
    return loading.load(name)


@functools.cache
def default_data(problem: SimulationProblem) -> Data:
    """Return the model's default data."""
    with jax.ensure_compile_time_eval():
        return model_file(problem.file).simulate()


def true_z(problem: SimulationProblem) -> np.ndarray:
    """Return the logarithms of the true parameters (P,)."""
    truth: Any = default_data(problem).truth
    scalars = {name: value for name, value in truth["parameters"].items() if np.ndim(value) == 0}
    for name in problem.names:
        checks.one_of("parameter", name, scalars)
    return np.log([scalars[name] for name in problem.names])


@functools.cache
def model(problem: SimulationProblem) -> Any:
    """Return the NumPyro model with its default parameters fixed."""
    file, data = model_file(problem.file), default_data(problem)
    with jax.ensure_compile_time_eval():
        return fix(file.model, dict(file.anchors(data)))


@functools.cache
def posterior(problem: SimulationProblem) -> LogPosterior:
    """Return the posterior of z, as a function of the data."""
    data = default_data(problem)
    with jax.ensure_compile_time_eval():
        return LogPosterior(bind(model(problem), data.times, data.y), problem.names)


@functools.cache
def true_likelihood(problem: SimulationProblem) -> MarginalLikelihood:
    """Return the likelihood at the true parameters; the cache keeps its compiled programs for all data sets."""
    with jax.ensure_compile_time_eval():
        return posterior(problem).likelihood(true_z(problem))
