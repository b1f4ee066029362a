"""The problem: positions of satellites, from files or simulated, and the model that predicts them."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import orbits
from lfm_ppl.model.gaussian import Gaussian
from lfm_ppl.model.simulate import simulate

NOISE = 1e-4
"""Standard deviation of a coordinate (km): of its error, and of what gravity leaves out here, such as the ocean tides.

Published positions are smoothed, so that their scatter says nothing. With half of it, most of the radial and normal
bands were too narrow, and forces were learnt that explain decimetres; chosen from 5 and 10 cm by the errors of the GPS
satellites, as `learning.WEIGHT`.
"""
SIMULATED = tuple(f"S{number:02d}" for number in range(1, 13))
_HIDDEN: dict[str, Any] = {"amplitude": 0.5, "wander": 0.02, "drift": 0.005}
_HIDDEN_WHITE, _HIDDEN_NOISE = 0.03, 5e-5
_DAYS, _INTERVAL = 10, 900.0
SYSTEMS = {"G": "GPS", "R": "GLONASS", "E": "Galileo", "C": "BeiDou", "J": "QZSS", "I": "NavIC"}
"""First letter of a satellite's name -> constellation."""


class Arcs(NamedTuple):
    """Positions in axes that do not turn.

    Attributes:
        environment: Earth, Moon and Sun over these days.
        times: (T,) hours after the first epoch.
        positions: satellite -> (T, 3) km, NaN where missing.
        published: what was read; None for simulated satellites.
    """

    environment: orbits.Environment
    times: np.ndarray
    positions: dict[str, np.ndarray]
    published: orbits.Ephemerides | None


class Arc(NamedTuple):
    """A satellite and the part of its positions that may be learnt from.

    Attributes:
        environment: Earth, Moon and Sun.
        times: (T,) hours, equally spaced.
        positions: (T, 3) km; NaN where missing.
        train: number of epochs to learn from.
    """

    environment: orbits.Environment
    times: np.ndarray
    positions: np.ndarray
    train: int

    def learnt(self, count: int | None = None) -> np.ndarray:
        """Return the positions (T, 3), NaN after the first ``count`` epochs, by default those of training."""
        return np.where((np.arange(len(self.times)) < (self.train if count is None else count))[:, None],
                        self.positions, np.nan)

    @property
    def digest(self) -> str:
        """What tells these positions from others."""
        return hashlib.sha256(np.ascontiguousarray(self.positions).tobytes()).hexdigest()[:16]


def system(satellite: str) -> str:
    """Return the constellation of a satellite.

    Example:
        >>> system("E12"), system("X01")
        ('Galileo', 'X')
    """
    return SYSTEMS.get(satellite[:1], satellite[:1])


def grouped(results: Mapping[str, Any], kind: Callable[[str], str] = system) -> dict[str, dict[str, Any]]:
    """Return kind of satellite, by default its constellation -> satellite -> what belongs to it.

    Example:
        >>> grouped({"G01": 1, "E12": 2, "G05": 3})
        {'GPS': {'G01': 1, 'G05': 3}, 'Galileo': {'E12': 2}}
    """
    found: dict[str, dict[str, Any]] = {}
    for name, one in results.items():
        found.setdefault(kind(name), {})[name] = one
    return found


def _place(satellite: str) -> tuple[int, str]:
    """GPS first, as in `SYSTEMS`."""
    letters = [*SYSTEMS, satellite[:1]]
    return letters.index(satellite[:1]), satellite


@functools.lru_cache(maxsize=2)
def arcs(folder: str | None, seed: int = 0) -> Arcs:
    """Return the positions of all satellites in a folder of SP3 files, or of twelve simulated ones like those of GPS.

    Args:
        folder: of SP3 files; their satellites are ordered by constellation, GPS first. None: simulate ten days.
        seed: of the simulation.

    Raises:
        FileNotFoundError, ValueError: no files, or files that cannot be read; the message has file and line.
    """
    if folder is None:
        return _simulated(seed)
    published = orbits.read_sp3(Path(folder))
    environment = orbits.Environment.over(published.epochs[0], 24.0 * published.days)
    positions = environment.celestial(published)
    order = sorted(range(len(published.satellites)), key=lambda index: _place(published.satellites[index]))
    times = (published.epochs - published.epochs[0]) / 3600.0
    found = {published.satellites[index]: positions[:, index] for index in order}
    return Arcs(environment, times, found, published)


def _simulated(seed: int) -> Arcs:
    epoch = orbits.gps_seconds(2019, 4, 7)
    environment = orbits.Environment.over(epoch, 24.0 * _DAYS)
    times = _INTERVAL / 3600.0 * np.arange(int(_DAYS * 86_400 / _INTERVAL))
    random = np.random.default_rng(seed)
    turns = 2 * np.pi * np.stack([np.arange(len(SIMULATED)) % 6 / 6, random.uniform(size=len(SIMULATED))], axis=1)

    @jax.jit
    def draw(key: jax.Array, start: jax.Array) -> jax.Array:
        system = orbits.satellite(environment, Gaussian(start, jnp.zeros((6, 6))), orbits.small_forces(**_HIDDEN),
                                  white=_HIDDEN_WHITE, noise_sd=_HIDDEN_NOISE)
        return simulate(key, system, times, steps=int(_INTERVAL / 30)).y

    keys = jax.random.split(jax.random.key(seed), len(SIMULATED))
    found = {name: np.asarray(draw(key, jnp.asarray(_circular(*turn))))
             for name, key, turn in zip(SIMULATED, keys, turns, strict=True)}
    return Arcs(environment, times, found, None)


def _circular(node: float, along: float) -> np.ndarray:
    """Return a state on a circular orbit of half a sidereal day, inclined by 55 degrees."""
    radius, inclination = 26_560.0, np.radians(55.0)
    speed = 3600.0 * np.sqrt(orbits.GM / radius)
    first = np.array([np.cos(node), np.sin(node), 0.0])
    second = np.array([-np.sin(node) * np.cos(inclination), np.cos(node) * np.cos(inclination), np.sin(inclination)])
    place = np.cos(along) * first + np.sin(along) * second
    return np.concatenate([radius * place, speed * (np.cos(along) * second - np.sin(along) * first)])


def axes_of(state: np.ndarray) -> np.ndarray:
    """Return the radial, tangential and normal directions (T, 3, 3), as columns, along states (T, 6)."""
    return np.asarray(_rtn(jnp.asarray(state)))


@jax.jit
def _rtn(state: jax.Array) -> jax.Array:
    return jax.vmap(lambda x: orbits.rtn(x[:3], x[3:]))(state)


def eclipsed(environment: orbits.Environment, times: np.ndarray, state: np.ndarray) -> bool:
    """Return whether the Earth's shadow falls on an orbit (T, 6) at any of the times."""
    return bool((np.asarray(_light(environment, jnp.asarray(times), jnp.asarray(state))) < 1.0).any())


@jax.jit
def _light(environment: orbits.Environment, times: jax.Array, state: jax.Array) -> jax.Array:
    return jax.vmap(lambda t, x: orbits.sunlight(x[:3], environment.sun(t)))(times, state)
