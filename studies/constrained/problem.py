"""Simulated data and models: transcription records with forces of four shapes, targets, and patients.

1. A transcription record is the response of x' = 0.25 l - 0.6 x + w to a non-negative force l, simulated on cells a
   tenth of the sampling interval (`record`).
2. Its models are a latent force model (`transcription`), with hyperparameters learnt by `learning`, and the source's
   state-space form with an arrival cost (`companion`).
3. A target is the model file's ballistic target with the source's noise (`target`).
4. A patient is a simulation of the model file of pituitary and thyroid (`patient`).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from scipy.signal import lfilter

import lfm_ppl as lfm
from lfm_ppl.forces import Matern
from lfm_ppl.io import loading
from lfm_ppl.likelihoods.likelihood_site import likelihood_site

from ..log_posterior import LogPosterior

MAX_DATA_SETS = 10_000
"""Largest number of records of a shape, targets or patients for one seed of the study."""

# --- transcription: x' = 0.25 l - 0.6 x + w

SENSITIVITY, DECAY, PROCESS_SD, NOISE_SD = 0.25, 0.6, 1e-3, 0.025
FACTOR = "factor"
WINDOW = 60
"""Number of samples from which the source learns the lengthscale, and of intervals of its window. Errors do not include
these samples."""
TIMES = np.linspace(0.0, 15.0, 1501)
"""Sampling times (s); the source has 1,500 samples."""
SHAPES = ("pulses", "half sines", "rectified GP", "softplus of a GP")
"""Shapes of the force, with largest values near 2; the source does not state its shape."""
ARRIVAL = 1e-2
"""Weight of the source's arrival cost, P = 1e-2 I."""
INITIAL_LENGTHSCALE = 1.0
"""Lengthscale (s) in the arrival cost, and of a constant Q; the source does not state it."""
PUBLISHED = {"smoother": 0.0192, "delayed MHE": 0.0103}
"""Published mean squared errors of the force, for one realisation."""
_FINE = 10
"""Cells of the simulation between two samples."""


@dataclass(frozen=True)
class TranscriptionRecord:
    """A record: the measured concentration ``y`` (T, 1), and the true ``force`` (T,)."""

    y: np.ndarray
    force: np.ndarray


def record(shape: str, index: int, seed: int = 0) -> TranscriptionRecord:
    """Return record ``index`` of a shape."""
    random = np.random.default_rng((seed, index, SHAPES.index(shape)))
    fine = np.linspace(0.0, TIMES[-1], _FINE * (len(TIMES) - 1) + 1)
    force = _draw_force(shape, fine, random)
    step = fine[1]
    production = (SENSITIVITY * force + PROCESS_SD * random.normal(size=len(fine)) / np.sqrt(step))[:-1]
    gain = -np.expm1(-DECAY * step) / DECAY
    state = np.concatenate([[0.0], lfilter([gain], [1.0, -np.exp(-DECAY * step)], production)])[::_FINE]
    return TranscriptionRecord((state + NOISE_SD * random.normal(size=len(TIMES)))[:, None], force[::_FINE])


def _draw_force(shape: str, t: np.ndarray, random: np.random.Generator) -> np.ndarray:
    if shape == "pulses":
        centre, width = random.uniform(0.0, TIMES[-1], (6, 1)), random.uniform(0.4, 0.8, (6, 1))
        return (random.uniform(0.5, 1.5, (6, 1)) * np.exp(-0.5 * ((t - centre) / width) ** 2)).sum(axis=0)
    if shape == "half sines":
        return np.maximum(random.uniform(0.7, 1.5) * np.sin(2 * np.pi * t / random.uniform(3.0, 7.0)
                                                            + random.uniform(0.0, 2 * np.pi)), 0.0)
    # Random Fourier features of a squared exponential kernel with lengthscale 1.5 s.
    frequency = random.normal(size=(200, 1)) / 1.5
    draw = np.sqrt(2.0 / 200) * np.cos(frequency * t + random.uniform(0.0, 2 * np.pi, (200, 1))).sum(axis=0)
    return np.maximum(draw, 0.0) if shape == "rectified GP" else np.logaddexp(0.0, 1.5 * draw)


def _state(x: jax.Array, u: jax.Array, t: jax.Array) -> jax.Array:
    return x[:1]


def transcription(lengthscale: Any, scale: Any = 1.0, *, softplus: bool = False) -> lfm.LatentForceModel:
    """Return the model with a Matern-3/2 force, optionally with a softplus link."""
    return lfm.LatentForceModel(
        lambda x, u, t: SENSITIVITY * (jax.nn.softplus(u) if softplus else u) - DECAY * x,
        {FACTOR: Matern(scale, lengthscale, 1)},
        lfm.GaussianObservation(_state, sd=NOISE_SD), lfm.Gaussian(jnp.zeros(1), 0.01 * jnp.eye(1)),
        process_noise=PROCESS_SD * jnp.eye(1), initial_time=0.0)


class Companion(eqx.Module):
    """Dynamics of (x, l, l') in equation 7 of the source.

    Attributes:
        rate: sqrt(3) / lengthscale; None if it is the fourth state.
    """

    rate: Any

    def __call__(self, x: jax.Array, u: jax.Array, t: jax.Array) -> jax.Array:
        """Return the time derivatives (3,) or (4,)."""
        rate = x[3] if self.rate is None else self.rate
        changes = [SENSITIVITY * x[1] - DECAY * x[0], x[2], -(rate**2) * x[1] - 2.0 * rate * x[2], jnp.zeros(())]
        return jnp.stack(changes[: len(x)])


def companion(lengthscale: Any, mean: Any, weight_lengthscale: Any = None,
              learnt: bool = False) -> lfm.LatentForceModel:
    """Return the source's model of a window, with the force of scale 1 among the states.

    The source's cost is 2 |chi - mean|^2_P + sum of 2 |w|^2_Q + |y - x|^2_R, with P = 1e-2 I, and Q and R the inverse
    variances of the noise. An arrival covariance I / (2 P) and half the process covariance give half of this cost.

    Args:
        lengthscale: lengthscale of the force.
        mean: arrival mean (3,).
        weight_lengthscale: lengthscale in Q; by default that of the force.
        learnt: whether the rate sqrt(3) / lengthscale is a constant state, with the rate of ``lengthscale`` as its
            arrival mean.
    """
    rate = np.sqrt(3.0) / lengthscale
    weight = rate if weight_lengthscale is None else np.sqrt(3.0) / weight_lengthscale
    variances = jnp.array([PROCESS_SD**2, 0.0, 4.0 * weight**3, *[0.0] * learnt])
    return lfm.LatentForceModel(
        Companion(None if learnt else rate), {}, lfm.GaussianObservation(_state, sd=NOISE_SD),
        lfm.Gaussian(jnp.append(mean, rate) if learnt else mean, 0.5 / ARRIVAL * jnp.eye(3 + learnt)),
        process_noise=jnp.sqrt(jnp.diag(variances) / 2.0), initial_time=0.0,
        state_names=("x", FACTOR, "derivative", *["rate"] * learnt))


@functools.cache
def learning(kind: str) -> LogPosterior:
    """Return the posterior of hyperparameters.

    The kinds are "early", for the first samples and with scale 1, "all" samples, and "softplus", all with this link.
    """
    early, softplus = kind == "early", kind == "softplus"
    count, rule = WINDOW if early else len(TIMES), lfm.GaussHermite(5) if softplus else lfm.Cubature()

    def model(times: Any, y: Any = None) -> None:
        lengthscale = numpyro.sample("lengthscale", dist.LogNormal(0.0, 1.0))
        scale = 1.0 if early else numpyro.sample("scale", dist.LogNormal(0.0, 1.0))
        system = transcription(lengthscale, scale, softplus=softplus)
        numpyro.sample("y", lfm.MarginalLikelihood(system, times, rule, steps=1, iterations=0), obs=y)

    with jax.ensure_compile_time_eval():
        bound = lfm.bind(model, TIMES[:count], np.zeros((count, 1)))
        return LogPosterior(bound, ("lengthscale",) if early else ("lengthscale", "scale"))


# --- ballistic target, section 4.2 of the source

TARGET_TIMES = np.linspace(0.0, 25.0, 51)
TRUE_START, INITIAL_GUESS = (65_000.0, 3_000.0), (55_000.0, 2_000.0)
TARGET_PATHS = {"altitude": "m", "speed": "m/s", "u": "m/s^2"}


def ballistic(start: Any, variance: Any) -> lfm.LatentForceModel:
    """Return the model file's target with process covariance diag(50, 10), and a start with this mean and variance."""
    file = loading.load("ballistic")
    truth: Any = {"alpha": 4.49e-4, "scale": 50.0, "lengthscale": 5.0, "q_r": np.sqrt(50.0), "q_v": np.sqrt(10.0),
                  "noise_sd": 30.0}
    system = likelihood_site(file.model, (TARGET_TIMES,), {}, jax.random.key(0), truth).distribution.model
    return eqx.tree_at(lambda m: m.initial_state, system, lfm.Gaussian(jnp.array(start), variance * jnp.eye(2)))


@functools.cache
def _target_simulator() -> Any:
    fine = np.linspace(0.0, TARGET_TIMES[-1], 501)
    return jax.jit(lambda key: lfm.simulate(key, ballistic(TRUE_START, 0.0), fine, steps=2))


def target(index: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return distances (T, 1) of a target, and its true altitude, speed and acceleration (3, T)."""
    simulation = _target_simulator()(jax.random.key(MAX_DATA_SETS * seed + index))
    paths = np.stack([simulation.state[:, 0], simulation.state[:, 1], simulation.forces["u"]])[:, ::10]
    return np.asarray(simulation.y)[::10], paths


# --- pituitary and thyroid

HORMONE = "TRH"


@functools.cache
def thyroid() -> loading.ModelFile:
    """Return the shipped model."""
    return loading.load("thyroid")


@functools.lru_cache(maxsize=1024)
def patient(index: int, seed: int = 0) -> Any:
    """Return the data of a patient; ``lfm-ppl simulate thyroid`` writes the same for the seed 10000 seed + index."""
    return thyroid().simulate(seed=MAX_DATA_SETS * seed + index)


@functools.cache
def thyroid_learning() -> LogPosterior:
    """Return the posterior of the model's parameters, compiled once for all patients."""
    with jax.ensure_compile_time_eval():
        return LogPosterior(lfm.bind(thyroid().model, patient(0).times, patient(0).y), tuple(thyroid().parameters))
