"""What is simulated from a shipped model, and the densities of its parameters.

Everything that is compiled for a problem serves all its data sets. The model takes no known inputs, and its data are
simulated with the values at which some of its parameters are fixed.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpyro import handlers

from lfm_ppl import checks, loading
from lfm_ppl.data import Data
from lfm_ppl.inference.bound_model import bind
from lfm_ppl.inference.handlers.fixing import fix
from lfm_ppl.inference.log_posterior import LogPosterior
from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood
from lfm_ppl.model.simulate import simulate

MOST = 10_000
"""Data sets for one seed of a study."""


@dataclass(frozen=True)
class Problem:
    """Data simulated from a shipped model, and what is estimated.

    Attributes:
        file: the name of the model.
        names: of its P unknown parameters, positive numbers; everything is in their logarithms z. Others are fixed by
            default.
        paths: the K states and forces that are estimated, in the order of the rows of every array of paths.
        units: theirs.
        medians: of the priors of the parameters, where searches start.
        steps: of the simulation between two times of the model file's truth.
    """

    file: str
    names: tuple[str, ...]
    paths: tuple[str, ...]
    units: tuple[str, ...]
    medians: tuple[float, ...]
    steps: int


class Record(NamedTuple):
    """One simulated data set.

    Attributes:
        times: (T,) of the measurements.
        y: (T, D) measurements.
        paths: (K, T) the problem's true paths at these times.
        z: (P,) logarithms of the true parameters.
    """

    times: np.ndarray
    y: np.ndarray
    paths: np.ndarray
    z: np.ndarray


@functools.lru_cache(maxsize=1024)
def record(problem: Problem, index: int, seed: int = 0) -> Record:
    """Return data set ``index``: what ``lfm-ppl simulate`` writes of the model for the seed 10000 seed + index."""
    data = model_file(problem.file).simulate(seed=MOST * seed + index)
    truth: Any = data.truth
    return _record(problem, data.times, data.y, truth["times"], truth["state"], truth["forces"], true_z(problem))


@functools.lru_cache(maxsize=1024)
def drawn_record(problem: Problem, index: int, seed: int = 0) -> Record:
    """Return a data set whose parameters and start are drawn from their priors, too."""
    z, found = _drawing(problem)(jax.random.fold_in(jax.random.key(seed), index))
    times = default(problem).times
    at = np.searchsorted(np.asarray(found.times), times - 1e-9)
    return _record(problem, times, np.asarray(found.y)[at], found.times, found.state, found.forces, z)


def _record(problem: Problem, times: np.ndarray, y: Any, fine: Any, state: Any, forces: Any, z: Any) -> Record:
    names, at = true_likelihood(problem).model.state_names, np.searchsorted(np.asarray(fine), times - 1e-9)
    for name in problem.paths:
        checks.one_of("path", name, (*names, *forces))
    paths = [state[:, names.index(name)] if name in names else forces[name] for name in problem.paths]
    return Record(times, np.asarray(y), np.stack([np.asarray(path)[at] for path in paths]), np.asarray(z))


@functools.cache
def _drawing(problem: Problem) -> Any:
    """Return what draws parameters and simulates, compiled once."""
    truth: Any = default(problem).truth

    def draw(key: jax.Array) -> tuple[jax.Array, Any]:
        keys = jax.random.split(key)
        trace = handlers.trace(handlers.seed(model(problem), keys[0])).get_trace(default(problem).times)
        z = jnp.log(jnp.stack([trace[name]["value"] for name in problem.names]))
        given = posterior(problem).likelihood(z).model
        return z, simulate(keys[1], given, np.asarray(truth["times"]), steps=problem.steps)

    return jax.jit(draw)


@functools.cache
def model_file(name: str) -> loading.ModelFile:
    """Return a shipped model, loaded once, so that its simulator is compiled once."""
    return loading.load(name)


@functools.cache
def default(problem: Problem) -> Data:
    """Return the model's default data."""
    with jax.ensure_compile_time_eval():
        return model_file(problem.file).simulate()


def true_z(problem: Problem) -> np.ndarray:
    """Return the logarithms of the true parameters (P,)."""
    truth: Any = default(problem).truth
    known = {name: value for name, value in truth["parameters"].items() if np.ndim(value) == 0}
    for name in problem.names:
        checks.one_of("parameter", name, known)
    return np.log([known[name] for name in problem.names])


@functools.cache
def model(problem: Problem) -> Any:
    """Return the NumPyro model with what is fixed by default."""
    file, data = model_file(problem.file), default(problem)
    with jax.ensure_compile_time_eval():
        return fix(file.model, dict(file.anchors(data)))


@functools.cache
def posterior(problem: Problem) -> LogPosterior:
    """Return the posterior of z given a data set."""
    with jax.ensure_compile_time_eval():
        return LogPosterior(bind(model(problem), default(problem).times, default(problem).y), problem.names)


@functools.cache
def true_likelihood(problem: Problem) -> MarginalLikelihood:
    """Return the likelihood at the truth: one object, so that what is compiled for it serves all data sets."""
    with jax.ensure_compile_time_eval():
        return posterior(problem).likelihood(true_z(problem))
