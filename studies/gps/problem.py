"""Positions of satellites, from files or simulated."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import lfm_ppl as lfm
from lfm_ppl import orbits
from lfm_ppl.orbits.arc import Arc
from lfm_ppl.orbits.prediction import LATEST

SIMULATED = tuple(f"S{number:02d}" for number in range(1, 13))
_TRUE_FORCES: dict[str, Any] = {"amplitude": 0.5, "wander": 0.02, "drift": 0.005}
_TRUE_WHITE, _TRUE_NOISE = 0.03, 5e-5
_DAYS, _INTERVAL = 10, 900.0
SYSTEMS = {"G": "GPS", "R": "GLONASS", "E": "Galileo", "C": "BeiDou", "J": "QZSS", "I": "NavIC"}
"""First letter of a satellite's name -> constellation."""


@dataclass(frozen=True)
class Arcs:
    """Positions in celestial axes.

    Attributes:
        environment: Earth, Moon and Sun during the data.
        times: (T,) hours after the first epoch.
        positions: satellite -> (T, 3) km, NaN where missing.
        published: contents of the files; None for simulated satellites.
    """

    environment: orbits.Environment
    times: np.ndarray
    positions: dict[str, np.ndarray]
    published: orbits.Ephemerides | None

    def arc(self, satellite: str, train_days: float) -> Arc:
        """Return the arc of a satellite with all epochs of the data.

        Raises:
            Unusable: there are too few positions in training, or none after it.
            ValueError: the training period is too short, or longer than the data.
        """
        days = float(self.times[-1] - self.times[0] + np.median(np.diff(self.times))) / 24.0
        train = int(np.searchsorted(self.times, 24.0 * train_days - 1e-9))
        if 24.0 * train_days < 2 * LATEST:
            raise ValueError(f"the training period has {train_days:g} days; use at least half a day (--train-days).")
        if train >= len(self.times):
            raise ValueError(f"the training period has {train_days:g} days, but the data have {days:g}, with the last "
                             f"position {self.times[-1] / 24.0:.6g} days after the first; use fewer (--train-days), so "
                             "that days remain for the evaluation.")
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


def _sort_key(satellite: str) -> tuple[int, str]:
    """Return a sort key with the constellations in the order of `SYSTEMS`."""
    letters = [*SYSTEMS, satellite[:1]]
    return letters.index(satellite[:1]), satellite


@functools.lru_cache(maxsize=2)
def arcs(folder: str | None, seed: int = 0, include: Sequence[str] = ()) -> Arcs:
    """Return positions of all satellites in a folder of SP3 files, or of twelve simulated satellites on GPS orbits.

    Args:
        folder: folder of SP3 files; their satellites are ordered by constellation, GPS first. None simulates ten days.
        seed: seed of the simulation.
        include: flagged positions of the files to use, see `lfm_ppl.orbits.read_sp3`.

    Raises:
        FileNotFoundError, ValueError: there are no files, or a file is invalid; the message has file and line.
    """
    if folder is None:
        return _simulated(seed)
    ephemerides = orbits.read_sp3(Path(folder), include=include)
    environment = orbits.Environment.over(ephemerides.epochs[0], 24.0 * ephemerides.days)
    positions = environment.celestial(ephemerides)
    times = (ephemerides.epochs - ephemerides.epochs[0]) / 3600.0
    by_satellite = {name: positions[:, ephemerides.satellites.index(name)]
                    for name in sorted(ephemerides.satellites, key=_sort_key)}
    return Arcs(environment, times, by_satellite, ephemerides)


def _simulated(seed: int) -> Arcs:
    epoch = orbits.gps_seconds(2019, 4, 7)
    environment = orbits.Environment.over(epoch, 24.0 * _DAYS)
    times = _INTERVAL / 3600.0 * np.arange(int(_DAYS * 86_400 / _INTERVAL))
    random = np.random.default_rng(seed)
    angles = 2 * np.pi * np.stack([np.arange(len(SIMULATED)) % 6 / 6, random.uniform(size=len(SIMULATED))], axis=1)

    @jax.jit
    def draw(key: jax.Array, start: jax.Array) -> jax.Array:
        system = orbits.satellite(environment, lfm.Gaussian(start, jnp.zeros((6, 6))),
                                  orbits.small_forces(**_TRUE_FORCES), white=_TRUE_WHITE, noise_sd=_TRUE_NOISE)
        return lfm.simulate(key, system, times, steps=int(_INTERVAL / 30)).y

    keys = jax.random.split(jax.random.key(seed), len(SIMULATED))
    by_satellite = {name: np.asarray(draw(key, jnp.asarray(circular(*angle))))
                    for name, key, angle in zip(SIMULATED, keys, angles, strict=True)}
    return Arcs(environment, times, by_satellite, None)


def circular(node: float, along: float, radius: float = 26_560.0, degrees: float = 55.0) -> np.ndarray:
    """Return a state (6,) on a circular orbit with angles in radians; the default radius (km) is that of GPS."""
    inclination, speed = np.radians(degrees), 3600.0 * np.sqrt(orbits.GM / radius)
    first = np.array([np.cos(node), np.sin(node), 0.0])
    second = np.array([-np.sin(node) * np.cos(inclination), np.cos(node) * np.cos(inclination), np.sin(inclination)])
    return np.concatenate([radius * (np.cos(along) * first + np.sin(along) * second),
                           speed * (np.cos(along) * second - np.sin(along) * first)])
