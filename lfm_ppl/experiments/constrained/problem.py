"""The problems: forces of four shapes with their records, targets, patients, and the models that estimate them."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from scipy.signal import lfilter

from lfm_ppl.forces import Matern
from lfm_ppl.inference.bind import bind
from lfm_ppl.inference.likelihood_site import likelihood_site
from lfm_ppl.inference.log_posterior import LogPosterior
from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood
from lfm_ppl.io import loading
from lfm_ppl.linearisation.sigma_points import Cubature, GaussHermite
from lfm_ppl.model.gaussian import Gaussian
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation import GaussianObservation
from lfm_ppl.model.simulate import simulate

MOST = 10_000
"""Records of a shape, targets and patients for one seed of the experiment."""

# --- transcription: x' = 0.25 l - 0.6 x + w

SENSITIVITY, DECAY, PROCESS_SD, NOISE_SD = 0.25, 0.6, 1e-3, 0.025
FACTOR = "factor"
WINDOW = 60
"""Samples from which the source learns the lengthscale, which do not count in errors, and intervals of its window."""
TIMES = np.linspace(0.0, 15.0, 1501)
"""Seconds. The source has 1,500 samples."""
SHAPES = ("pulses", "half sines", "rectified GP", "softplus of a GP")
"""The source does not say what its force is; the largest value of these is about 2."""
ARRIVAL = 1e-2
"""P = 1e-2 I, the weight of the source's arrival cost."""
GUESSED = 1.0
"""Lengthscale (s) from which a search or an arrival cost of it starts; the source does not say."""
PUBLISHED = {"smoother": 0.0192, "delayed MHE": 0.0103}
"""Mean squared errors of the force in the source, of one realisation."""
_FINE = 10
"""Cells of the simulation between two samples."""


class Record(NamedTuple):
    """The measured concentration ``y`` (T, 1), and the true ``force`` (T,)."""

    y: np.ndarray
    force: np.ndarray


def record(shape: str, index: int, seed: int = 0) -> Record:
    """Return record ``index`` of a shape."""
    random = np.random.default_rng((seed, index, SHAPES.index(shape)))
    fine = np.linspace(0.0, TIMES[-1], _FINE * (len(TIMES) - 1) + 1)
    force = _force(shape, fine, random)
    step = fine[1]
    pushed = (SENSITIVITY * force + PROCESS_SD * random.normal(size=len(fine)) / np.sqrt(step))[:-1]
    gain = -np.expm1(-DECAY * step) / DECAY
    state = np.concatenate([[0.0], lfilter([gain], [1.0, -np.exp(-DECAY * step)], pushed)])[::_FINE]
    return Record((state + NOISE_SD * random.normal(size=len(TIMES)))[:, None], force[::_FINE])


def _force(shape: str, t: np.ndarray, random: np.random.Generator) -> np.ndarray:
    if shape == "pulses":
        place, width = random.uniform(0.0, TIMES[-1], (6, 1)), random.uniform(0.4, 0.8, (6, 1))
        return (random.uniform(0.5, 1.5, (6, 1)) * np.exp(-0.5 * ((t - place) / width) ** 2)).sum(axis=0)
    if shape == "half sines":
        return np.maximum(random.uniform(0.7, 1.5) * np.sin(2 * np.pi * t / random.uniform(3.0, 7.0)
                                                            + random.uniform(0.0, 2 * np.pi)), 0.0)
    frequency = random.normal(size=(200, 1)) / 1.5  # of a squared exponential kernel of lengthscale 1.5 s
    draw = np.sqrt(2.0 / 200) * np.cos(frequency * t + random.uniform(0.0, 2 * np.pi, (200, 1))).sum(axis=0)
    return np.maximum(draw, 0.0) if shape == "rectified GP" else np.logaddexp(0.0, 1.5 * draw)


def _state(x: jax.Array, u: jax.Array, t: jax.Array) -> jax.Array:
    return x[:1]


def transcription(lengthscale: Any, scale: Any = 1.0, *, softplus: bool = False) -> LatentForceModel:
    """Return the model with a Matern-3/2 force of these parameters, through a softplus link where that is asked."""
    link = jax.nn.softplus if softplus else lambda u: u
    return LatentForceModel(
        lambda x, u, t: SENSITIVITY * link(u) - DECAY * x, {FACTOR: Matern(scale, lengthscale, 1)},
        GaussianObservation(_state, jnp.array([NOISE_SD**2])), Gaussian(jnp.zeros(1), 0.01 * jnp.eye(1)),
        process_noise=PROCESS_SD * jnp.eye(1), initial_time=0.0)


class Companion(eqx.Module):
    """Dynamics of (x, l, l') in equation 7 of the source; where the rate sqrt(3)/lengthscale is None it is a state."""

    rate: Any

    def __call__(self, x: jax.Array, u: jax.Array, t: jax.Array) -> jax.Array:
        """Return the rates of change (3,) or (4,), of which the last is zero."""
        rate = x[3] if self.rate is None else self.rate
        changes = [SENSITIVITY * x[1] - DECAY * x[0], x[2], -(rate**2) * x[1] - 2.0 * rate * x[2], jnp.zeros(())]
        return jnp.stack(changes[: len(x)])


def companion(lengthscale: Any, mean: Any, weighted: Any = None, learnt: bool = False) -> LatentForceModel:
    """Return the model of a window of the source: the force of scale 1 among the states, from an arrival mean (3,).

    Its cost 2 |chi - mean|^2_P + sum of 2 |w|^2_Q + |y - x|^2_R, with P = 1e-2 I and Q and R the inverses of the
    noises' variances, is twice that of an arrival covariance I / (2 P) and half the process covariance. Q is that of
    the lengthscale ``weighted``, or of the force's. Where that is ``learnt``, its rate is a constant state of unknown
    value, whose arrival mean is that of ``lengthscale``.
    """
    rate = np.sqrt(3.0) / lengthscale
    weight = rate if weighted is None else np.sqrt(3.0) / weighted
    variances = jnp.array([PROCESS_SD**2, 0.0, 4.0 * weight**3, *[0.0] * learnt])
    return LatentForceModel(
        Companion(None if learnt else rate), {}, GaussianObservation(_state, jnp.array([NOISE_SD**2])),
        Gaussian(jnp.append(mean, rate) if learnt else mean, 0.5 / ARRIVAL * jnp.eye(3 + learnt)),
        process_noise=jnp.sqrt(jnp.diag(variances) / 2.0), initial_time=0.0,
        state_names=("x", FACTOR, "derivative", *["rate"] * learnt))


@functools.cache
def learning(kind: str) -> LogPosterior:
    """Return the posterior of hyperparameters: of "early" samples, in which the scale is 1, "all", or "softplus"."""
    early, softplus = kind == "early", kind == "softplus"
    count, rule = WINDOW if early else len(TIMES), GaussHermite(5) if softplus else Cubature()

    def model(times: Any, y: Any = None) -> None:
        lengthscale = numpyro.sample("lengthscale", dist.LogNormal(0.0, 1.0))
        scale = 1.0 if early else numpyro.sample("scale", dist.LogNormal(0.0, 1.0))
        system = transcription(lengthscale, scale, softplus=softplus)
        numpyro.sample("y", MarginalLikelihood(system, times, rule, steps=1, iterations=0), obs=y)

    with jax.ensure_compile_time_eval():
        bound = bind(model, TIMES[:count], np.zeros((count, 1)))
        return LogPosterior(bound, ("lengthscale",) if early else ("lengthscale", "scale"))


# --- ballistic target, section 4.2 of the source

TARGET_TIMES = np.linspace(0.0, 25.0, 51)
TRUE_START, GUESS = (65_000.0, 3_000.0), (55_000.0, 2_000.0)
TARGET_PATHS = {"altitude": "m", "speed": "m/s", "u": "m/s^2"}


def ballistic(start: Any, variance: Any) -> LatentForceModel:
    """Return the model file's target with the process covariance diag(50, 10) and a start of this mean and variance."""
    file = loading.load("ballistic")
    truth: Any = {"alpha": 4.49e-4, "scale": 50.0, "lengthscale": 5.0, "q_r": np.sqrt(50.0), "q_v": np.sqrt(10.0),
                  "noise_sd": 30.0}
    system = likelihood_site(file.model, (TARGET_TIMES,), {}, jax.random.key(0), truth).distribution.model
    return eqx.tree_at(lambda m: m.initial_state, system, Gaussian(jnp.array(start), variance * jnp.eye(2)))


@functools.cache
def _target_simulator() -> Any:
    fine = np.linspace(0.0, TARGET_TIMES[-1], 501)
    return jax.jit(lambda key: simulate(key, ballistic(TRUE_START, 0.0), fine, steps=2))


def target(index: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return distances (T, 1) of a target, and its true altitude, speed and acceleration (3, T)."""
    drawn = _target_simulator()(jax.random.key(MOST * seed + index))
    paths = np.stack([drawn.state[:, 0], drawn.state[:, 1], drawn.forces["u"]])[:, ::10]
    return np.asarray(drawn.y)[::10], paths


# --- pituitary and thyroid

HORMONE = "TRH"


@functools.cache
def thyroid() -> loading.ModelFile:
    """Return the shipped model."""
    return loading.load("thyroid")


@functools.lru_cache(maxsize=1024)
def patient(index: int, seed: int = 0) -> Any:
    """Return the data of a patient, what ``lfm-ppl simulate thyroid`` writes for the seed 10000 seed + index."""
    return thyroid().simulate(seed=MOST * seed + index)


@functools.cache
def thyroid_learning() -> LogPosterior:
    """Return the posterior of the model's parameters, compiled once for all patients."""
    with jax.ensure_compile_time_eval():
        return LogPosterior(bind(thyroid().model, patient(0).times, patient(0).y), tuple(thyroid().parameters))
