"""Data sets and models of three genes and one unmeasured factor, and the published errors.

1. A configuration is a link between the factor's force u and its activity, with a parameter gamma.
2. Draw rates and starts of the genes from uniform distributions, and u from its exact transition on a fine grid.
3. Integrate the expression exactly, with the production linear within each cell; add noise at 13 times (`data_set`).
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import lfm_ppl as lfm
from lfm_ppl.io import loading
from lfm_ppl.parallel.task import Task

from .. import tasks

GENES, END, OBSERVED, POINTS = 3, 15.0, 13, 363
SCALE, LENGTHSCALE, NOISE = 1.0, 2.0, 0.1
FACTOR = "transcription factor"
TIMES = np.linspace(0.0, END, OBSERVED)
GRID = np.linspace(0.0, END, POINTS)
DIVERGED = 3.0 * SCALE
"""Root mean squared error above which an estimate has diverged, as in the source."""

_REFINED = 6
"""Cells of the simulation in each cell of the grid. With six, the observation times are on the fine grid."""


class Configuration(NamedTuple):
    """Activity of the factor as a function of the force u.

    The links are "saturation" e^u / (gamma + e^u), "repression" 1 / (gamma + e^u), "exponential" e^u, "softplus"
    log(1 + e^u), and "linear" u, which has a Gaussian posterior.
    """

    link: str
    gamma: float | None = None

    @property
    def label(self) -> str:
        """Name in tables."""
        return self.link if self.gamma is None else f"{self.link} {self.gamma:g}"


CONFIGURATIONS = (*(Configuration(link, gamma) for link in ("saturation", "repression") for gamma in (0.1, 0.5, 1.0)),
                  Configuration("exponential"), Configuration("softplus"))

PUBLISHED = {
    "saturation 0.1": {"LA": (1.758, 0), "ESLS": (0.737, 0), "GFS": (0.720, 0)},
    "saturation 0.5": {"LA": (0.737, 0), "ESLS": (0.484, 0), "GFS": (0.483, 0)},
    "saturation 1": {"LA": (0.489, 0), "ESLS": (0.483, 0), "GFS": (0.484, 0)},
    "repression 0.1": {"LA": (1.933, 40), "ESLS": (0.327, 0), "GFS": (0.374, 0)},
    "repression 0.5": {"LA": (1.267, 1), "ESLS": (0.363, 0), "GFS": (0.367, 0)},
    "repression 1": {"LA": (0.483, 0), "ESLS": (0.476, 0), "GFS": (0.474, 0)},
    "exponential": {"LA": (0.300, 55), "ESLS": (0.290, 0), "GFS": (0.358, 9)},
}
"""Configuration -> method -> RMSE of the force and number of divergences among 100 data sets, table 1 of the source."""


def configuration(task: Task) -> Configuration:
    """Return the configuration of a task of the force or parameter study."""
    return Configuration(task.settings["link"], task.settings["gamma"])


slug = functools.partial(tasks.slug, removed=",")
"""Part of a task name for a label; names of stored tasks have parentheses."""


class Rates(NamedTuple):
    """Known rates and start of a data set: B, S, D and x(0), (3,) each."""

    basal: Any
    sensitivity: Any
    decay: Any
    start: Any


@functools.cache
def shipped() -> Mapping[str, Any]:
    """Return the functions of the shipped model."""
    return loading.load("transcription").definitions


def system(link: str, gamma: Any, rates: Rates, noise_sd: Any = NOISE, lengthscale: Any = LENGTHSCALE
           ) -> lfm.LatentForceModel:
    """Return the model dx_j/dt = B_j + S_j g(u) - D_j x_j; all but the link may be traced."""
    names = tuple(f"gene {index + 1}" for index in range(GENES))
    return shipped()["build"](rates.basal, rates.sensitivity, rates.decay, SCALE, lengthscale, noise_sd, names, link,
                              gamma, start=rates.start)


def on_grid(link: str, gamma: Any, rates: Rates, quadrature: str = "riemann") -> lfm.LatentGrid:
    """Return the model with its force on the grid, by default with the quadrature of the source."""
    return lfm.LatentGrid(system(link, gamma, rates), TIMES, GRID, quadrature)


@dataclass(frozen=True)
class DataSet:
    """A simulated data set.

    Attributes:
        rates: rates and start, known to all methods.
        y: (13, 3) observations at TIMES.
        u: (363,) force on GRID.
        fine: (K,) times of the simulation.
        state: (K, 3) expression at these times.
    """

    rates: Rates
    y: np.ndarray
    u: np.ndarray
    fine: np.ndarray
    state: np.ndarray


@functools.lru_cache(maxsize=1024)
def data_set(configuration: Configuration, index: int, seed: int = 0) -> DataSet:
    """Return data set ``index``; rates, force and noise are the same for all configurations.

    B ~ U(0, 0.1), D ~ U(0, 2), A ~ U(-0.1, 0.1), S ~ U(0, 1), x(0) = A + B/D. The force has its exact transition on
    cells of 15/2172; within a cell the production is linear, and is integrated exactly.
    """
    random = np.random.default_rng([seed, index])
    basal, decay = random.uniform(0.0, 0.1, GENES), random.uniform(0.0, 2.0, GENES)
    excess, sensitivity = random.uniform(-0.1, 0.1, GENES), random.uniform(0.0, 1.0, GENES)
    fine = np.linspace(0.0, END, _REFINED * (POINTS - 1) + 1)
    h, rate = fine[1], np.sqrt(3.0) / LENGTHSCALE
    white = random.normal(size=(len(fine), 2))
    # Matern-3/2: u and its derivative start from the stationary distribution.
    transition = np.exp(-rate * h) * np.array([[1 + rate * h, h], [-(rate**2) * h, 1 - rate * h]])
    stationary = SCALE**2 * np.diag([1.0, rate**2])
    root = np.linalg.cholesky(stationary - transition @ stationary @ transition.T)
    path = [np.sqrt(np.diag(stationary)) * white[0]]
    for noise in white[1:]:
        path.append(transition @ path[-1] + root @ noise)
    u = np.stack(path)[:, 0]
    with jax.ensure_compile_time_eval():
        active = np.asarray(shipped()["activity"](jnp.asarray(u), *configuration))
    production, z = basal + sensitivity * active[:, None], -decay * h
    first = np.expm1(z) / z
    second = (first - 1.0) / z
    states = [excess + basal / decay]
    for gained in h * (first * production[:-1] + second * np.diff(production, axis=0)):
        states.append(np.exp(z) * states[-1] + gained)
    state = np.stack(states)
    observed = np.arange(OBSERVED) * (len(fine) - 1) // (OBSERVED - 1)
    y = state[observed] + NOISE * random.normal(size=(OBSERVED, GENES))
    return DataSet(Rates(basal, sensitivity, decay, state[0]), y, u[::_REFINED], fine, state)


def inputs(settings: Mapping[str, Any], data: Sequence[DataSet]) -> tuple[jax.Array, Rates, jax.Array]:
    """Return gamma (1 for links without gamma), and rates (N, 3) and observations (N, 13, 3) of data sets."""
    gamma = jnp.asarray(1.0 if settings["gamma"] is None else settings["gamma"])
    return gamma, *jax.tree.map(lambda *arrays: jnp.stack(arrays), *((entry.rates, entry.y) for entry in data))


def rows(tree: Any, index: Any) -> Any:
    """Return rows of every array of a tree."""
    return jax.tree.map(lambda array: array[index], tree)
