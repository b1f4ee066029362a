"""The problem: three genes, one unseen factor, eight ways in which it acts, and what was published."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.engine.task import Result, Task
from lfm_ppl.forces import Matern
from lfm_ppl.model.gaussian import Gaussian
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation import GaussianObservation

GENES, END, OBSERVED, POINTS = 3, 15.0, 13, 363
SCALE, LENGTHSCALE, NOISE = 1.0, 2.0, 0.1
FACTOR = "transcription factor"
TIMES = np.linspace(0.0, END, OBSERVED)
GRID = np.linspace(0.0, END, POINTS)
DIVERGED = 3.0 * SCALE
"""A root mean squared error above this counts as divergence, as in the source."""

_REFINED = 6
"""Cells of the simulation in one of the grid. Six of them make observation times part of it, too."""


class Configuration(NamedTuple):
    """How the factor acts.

    Attributes:
        link: "saturation" e^u / (gamma + e^u), "repression" 1 / (gamma + e^u), "exponential" e^u, or "softplus"
            log(1 + e^u).
        gamma: of the first two.
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


def slug(label: str) -> str:
    """Return a label as part of the name of a task or a file."""
    return label.replace(", ", "-").replace(" ", "-")


def by_cell(tasks: Iterable[Task], results: Mapping[str, Result], by: str) -> dict[tuple[str, str], list[Result]]:
    """Return (label of the configuration, setting ``by``) -> results of all its tasks, in their order."""
    cells: dict[tuple[str, str], list[Result]] = {}
    for task in tasks:
        label = Configuration(task.settings["link"], task.settings["gamma"]).label
        cells.setdefault((label, task.settings[by]), []).append(results[task.name])
    return cells


def activity(u: jax.Array, link: str, gamma: Any) -> jax.Array:
    """Return g(u), the activity of the factor.

    Raises:
        ValueError: an unknown link, or a gamma that is not positive.
    """
    checks.one_of("link", link, ("saturation", "repression", "exponential", "softplus"))
    if link == "exponential":
        return jnp.exp(u)
    if link == "softplus":
        return jax.nn.softplus(u)
    checks.positive("gamma", gamma)
    if link == "saturation":
        return jax.nn.sigmoid(u - jnp.log(gamma))
    return jax.nn.sigmoid(jnp.log(gamma) - u) / gamma


class Genes(eqx.Module):
    """dx_j/dt = B_j + S_j g(u) - D_j x_j, with rates that compiled code takes as arguments."""

    basal: Any
    sensitivity: Any
    decay: Any
    gamma: Any
    link: str = eqx.field(static=True)

    def __call__(self, x: jax.Array, u: jax.Array, t: Any) -> jax.Array:
        """Return the derivatives (3,)."""
        return self.basal + self.sensitivity * activity(u[0], self.link, self.gamma) - self.decay * x


def expression(x: jax.Array, u: jax.Array, t: Any) -> jax.Array:
    """Return what is observed."""
    return x


class Rates(NamedTuple):
    """What is known of a data set besides the observations; each (3,).

    Attributes:
        basal: B.
        sensitivity: S.
        decay: D.
        start: x(0).
    """

    basal: Any
    sensitivity: Any
    decay: Any
    start: Any


def system(link: str, gamma: Any, rates: Rates, noise_sd: Any = NOISE, lengthscale: Any = LENGTHSCALE
           ) -> LatentForceModel:
    """Return the model; all but the link may be traced."""
    names = tuple(f"gene {index + 1}" for index in range(GENES))
    return LatentForceModel(
        Genes(rates.basal, rates.sensitivity, rates.decay, gamma, link), {FACTOR: Matern(SCALE, lengthscale, 1)},
        GaussianObservation(expression, noise_sd**2 * jnp.ones(GENES)),
        Gaussian(rates.start, jnp.zeros((GENES, GENES))), state_names=names, output_names=names, initial_time=0.0)


class DataSet(NamedTuple):
    """One simulated data set.

    Attributes:
        rates: known to all methods.
        y: (13, 3) observations at TIMES.
        u: (363,) the force on GRID.
        fine: (K,) the times of the simulation.
        state: (K, 3) expression at these.
    """

    rates: Rates
    y: np.ndarray
    u: np.ndarray
    fine: np.ndarray
    state: np.ndarray


@functools.lru_cache(maxsize=1024)
def data_set(configuration: Configuration, index: int, seed: int = 0) -> DataSet:
    """Return data set ``index``; rates, force and noise are the same for all configurations.

    B ~ U(0, 0.1), D ~ U(0, 2), A ~ U(-0.1, 0.1), S ~ U(0, 1), x(0) = A + B/D. The force is drawn from its exact
    transition on cells of 15/2172; within a cell the production is taken as linear, and integrated exactly.
    """
    random = np.random.default_rng([seed, index])
    basal, decay = random.uniform(0.0, 0.1, GENES), random.uniform(0.0, 2.0, GENES)
    away, sensitivity = random.uniform(-0.1, 0.1, GENES), random.uniform(0.0, 1.0, GENES)
    fine = np.linspace(0.0, END, _REFINED * (POINTS - 1) + 1)
    h = fine[1]
    rate = np.sqrt(3.0) / LENGTHSCALE
    white = random.normal(size=(len(fine), 2))
    # Matern-3/2: u and its derivative, from their stationary distribution on.
    transition = np.exp(-rate * h) * np.array([[1 + rate * h, h], [-(rate**2) * h, 1 - rate * h]])
    stationary = SCALE**2 * np.diag([1.0, rate**2])
    root = np.linalg.cholesky(stationary - transition @ stationary @ transition.T)
    path = np.empty((len(fine), 2))
    path[0] = np.sqrt(np.diag(stationary)) * white[0]
    for step in range(1, len(fine)):
        path[step] = transition @ path[step - 1] + root @ white[step]
    u = path[:, 0]
    with jax.ensure_compile_time_eval():
        active = np.asarray(activity(jnp.asarray(u), configuration.link, configuration.gamma))
    made = basal + sensitivity * active[:, None]
    z = -decay * h
    first = np.expm1(z) / z
    second = (first - 1.0) / z
    state = np.empty((len(fine), GENES))
    state[0] = away + basal / decay
    for step in range(1, len(fine)):
        change = made[step] - made[step - 1]
        state[step] = np.exp(z) * state[step - 1] + h * (first * made[step - 1] + second * change)
    observed = np.arange(OBSERVED) * (len(fine) - 1) // (OBSERVED - 1)
    y = state[observed] + NOISE * random.normal(size=(OBSERVED, GENES))
    return DataSet(Rates(basal, sensitivity, decay, state[0]), y, u[::_REFINED], fine, state)
