"""The problem: positions of satellites, from files or simulated."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import orbits
from lfm_ppl.model.gaussian import Gaussian
from lfm_ppl.model.simulate import simulate
from lfm_ppl.orbits.arc import Arc
from lfm_ppl.orbits.prediction import LATEST

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

    def arc(self, satellite: str, train_days: float) -> Arc:
        """Return the arc of a satellite, all epochs of the data.

        Raises:
            Unusable: too few positions to learn from, or none to judge by.
            ValueError: the training is longer than the data.
        """
        days = float(self.times[-1] - self.times[0] + np.median(np.diff(self.times))) / 24.0
        train = int(np.searchsorted(self.times, 24.0 * train_days - 1e-9))
        if 24.0 * train_days < 2 * LATEST:
            raise ValueError(f"training takes {train_days:g} days; half a day is the least (--train-days).")
        if train >= len(self.times):
            raise ValueError(f"training takes {train_days:g} days, but the data have {days:g}, the last position "
                             f"{self.times[-1] / 24.0:.6g} days after the first; take fewer (--train-days), so that "
                             "days are left to judge by.")
        arc = Arc(self.environment, self.times, self.positions[satellite], train)
        arc.check(satellite, "" if self.published is None else "; ".join(map(str, self.published.gaps(satellite))))
        return arc


def system(satellite: str) -> str:
    """Return the constellation of a satellite.

    Example:
        >>> system("E12"), system("X01")
        ('Galileo', 'X')
    """
    return SYSTEMS.get(satellite[:1], satellite[:1])


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
    times = (published.epochs - published.epochs[0]) / 3600.0
    found = {name: positions[:, published.satellites.index(name)]
             for name in sorted(published.satellites, key=_place)}
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
    found = {name: np.asarray(draw(key, jnp.asarray(circular(*turn))))
             for name, key, turn in zip(SIMULATED, keys, turns, strict=True)}
    return Arcs(environment, times, found, None)


def circular(node: float, along: float, radius: float = 26_560.0, degrees: float = 55.0) -> np.ndarray:
    """Return a state (6,) on a circular orbit: angles in radians, radius in km, by default of half a sidereal day."""
    slant, speed = np.radians(degrees), 3600.0 * np.sqrt(orbits.GM / radius)
    first = np.array([np.cos(node), np.sin(node), 0.0])
    second = np.array([-np.sin(node) * np.cos(slant), np.cos(node) * np.cos(slant), np.sin(slant)])
    return np.concatenate([radius * (np.cos(along) * first + np.sin(along) * second),
                           speed * (np.cos(along) * second - np.sin(along) * first)])
