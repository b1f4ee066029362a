"""The problem: simulated targets, their true parameters, and the densities of these."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpyro import handlers

from lfm_ppl import loading
from lfm_ppl.inference.bound_model import bind
from lfm_ppl.inference.handlers.fixing import fix
from lfm_ppl.inference.log_posterior import LogPosterior
from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood
from lfm_ppl.model.simulate import simulate

NAMES = ("alpha", "scale", "lengthscale")
"""The unknown parameters; everything here is in their logarithms z."""

PATHS = ("altitude", "speed", "u")
"""What is estimated, in the order of the rows of every array of paths."""

UNITS = ("m", "m/s", "m/s^2")
"""Theirs."""

_FINER = 10
"""Cells of the simulation between two measurements, those of the model file."""

MOST = 10_000
"""Targets for one seed of the experiment."""


class Target(NamedTuple):
    """One simulated target and its measurements.

    Attributes:
        times: (T,) of the measurements (s).
        y: (T, 1) distances (m).
        paths: (3, T) true altitude (m), speed (m/s) and acceleration u (m/s^2) at these times.
        z: (3,) logarithms of the true parameters.
    """

    times: np.ndarray
    y: np.ndarray
    paths: np.ndarray
    z: np.ndarray


@functools.cache
def model_file() -> loading.ModelFile:
    """Return the shipped model."""
    return loading.load("ballistic")


@functools.lru_cache(maxsize=1024)
def target(index: int, seed: int = 0) -> Target:
    """Return target ``index``: what ``lfm-ppl simulate ballistic`` writes for the seed 10000 seed + index.

    It starts at the means of the smoothers' prior, 65 km and 3 km/s, as in the source.
    """
    with jax.ensure_compile_time_eval():  # compiled code may be the first to ask
        data = model_file().simulate(seed=MOST * seed + index)
    truth: Any = data.truth
    at = np.searchsorted(np.asarray(truth["times"]), data.times - 1e-9)
    state = np.asarray(truth["state"])[at]
    paths = np.stack([state[:, 0], state[:, 1], np.asarray(truth["forces"]["u"])[at]])
    return Target(data.times, data.y, paths, true_z())


@functools.lru_cache(maxsize=1024)
def drawn_target(index: int, seed: int = 0) -> Target:
    """Return a target whose parameters and start are drawn from their priors, too."""
    with jax.ensure_compile_time_eval():
        z, found = _drawing()(jax.random.fold_in(jax.random.key(seed), index))
    at = np.searchsorted(np.asarray(found.times), target(0).times - 1e-9)
    paths = np.stack([found.state[:, 0], found.state[:, 1], found.forces["u"]])[:, at]
    return Target(target(0).times, np.asarray(found.y)[at], paths, np.asarray(z))


@functools.cache
def _drawing() -> Any:
    """Return what draws parameters and simulates, compiled once."""
    fine = np.linspace(0.0, target(0).times[-1], _FINER * (len(target(0).times) - 1) + 1)

    def draw(key: jax.Array) -> tuple[jax.Array, Any]:
        keys = jax.random.split(key)
        trace = handlers.trace(handlers.seed(model(), keys[0])).get_trace(target(0).times)
        z = jnp.log(jnp.stack([trace[name]["value"] for name in NAMES]))
        return z, simulate(keys[1], posterior().likelihood(z).model, fine, steps=5)

    return jax.jit(draw)


@functools.cache
def true_z() -> np.ndarray:
    """Return the logarithms of the true parameters (3,)."""
    with jax.ensure_compile_time_eval():
        truth: Any = model_file().simulate().truth
    return np.log([truth["parameters"][name] for name in NAMES])


@functools.cache
def model() -> Any:
    """Return the NumPyro model with the levels of the noise at their known values, as it is by default."""
    file = model_file()
    with jax.ensure_compile_time_eval():
        known = dict(file.anchors(file.simulate()))
    return fix(file.model, known)


@functools.cache
def posterior() -> LogPosterior:
    """Return the posterior of a target; what is compiled for it serves all of them."""
    with jax.ensure_compile_time_eval():
        return LogPosterior(bind(model(), target(0).times, target(0).y), NAMES)


@functools.cache
def true_likelihood() -> MarginalLikelihood:
    """Return the likelihood at the truth: one object, so that what is compiled for it serves all targets."""
    with jax.ensure_compile_time_eval():
        return posterior().likelihood(true_z())


def paths_of(found: Any) -> tuple[jax.Array, jax.Array]:
    """Return means and standard deviations (3, T) of `PATHS` from a smoother's result."""
    force = found.force("u")
    mean = jnp.stack([found.mean[:, 0], found.mean[:, 1], force.mean])
    return mean, jnp.stack([jnp.sqrt(found.covariance[:, 0, 0]), jnp.sqrt(found.covariance[:, 1, 1]), force.sd])
