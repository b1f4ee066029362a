"""What pushes a satellite as far as it is known, over some days."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.orbits import frames, geopotential
from lfm_ppl.orbits.bodies import (
    ASTRONOMICAL_UNIT,
    GM_MOON,
    GM_SUN,
    attraction,
    positions,
    solid_tide,
    sunlight,
)
from lfm_ppl.orbits.earth import EarthRotation
from lfm_ppl.orbits.ephemerides import Ephemerides
from lfm_ppl.orbits.table import TimeTable

PER_HOUR2 = 3600.0**2
"""km/s^2 -> km/h^2."""
NANO = 1e-12 * PER_HOUR2
"""nm/s^2, in which the small forces are given, -> km/h^2."""


class Environment(eqx.Module):
    """Earth, Moon and Sun around a satellite, as functions of hours after an epoch.

    Positions are in km, in the celestial frame GCRS, which does not turn; time is in hours. It is a pytree, so one
    compiled program serves any days of the same number.

    Attributes:
        epoch: GPS seconds at time zero.
        rotation: of the Earth.
        table: of Sun and Moon.
        degree: and order of the Earth's field, from 0 (a point mass) to 8.
        bodies: whether Sun and Moon pull.

    Example:
        >>> import jax.numpy as jnp
        >>> from lfm_ppl.orbits import Environment, gps_seconds
        >>> around = Environment.over(gps_seconds(2019, 4, 7), hours=24.0)  # doctest: +SKIP
        >>> around.acceleration(jnp.array([26_560.0, 0.0, 0.0]), 0.0)  # km/h^2  # doctest: +SKIP
    """

    epoch: Any
    rotation: EarthRotation
    table: TimeTable
    degree: int = eqx.field(static=True, default=geopotential.DEGREE)
    bodies: bool = eqx.field(static=True, default=True)

    @classmethod
    def over(cls, epoch: float, hours: float, degree: int = geopotential.DEGREE, bodies: bool = True) -> Environment:
        """Tabulate what does not depend on the satellite.

        Args:
            epoch: GPS seconds.
            hours: how long it is needed.
            degree: see the class.
            bodies: see the class.

        Raises:
            ImportError: a library of the extra ``gps`` is not installed.
            ValueError: Earth orientation is not known there.
        """
        return cls(jnp.asarray(float(epoch)), EarthRotation.over(epoch, hours), positions(epoch, hours), degree, bodies)

    def celestial(self, orbits: Ephemerides) -> np.ndarray:
        """Return the positions (T, S, 3) in axes that do not turn, GCRS, in km.

        Args:
            orbits: in the frame that turns with the Earth; its epochs are counted in GPS time.
        """
        hours = (orbits.epochs - float(self.epoch)) / 3600.0
        turns = np.asarray(_turns(self.rotation, jnp.asarray(hours)))
        return np.einsum("tji,tsj->tsi", turns, orbits.positions)

    def sun(self, t: Any) -> jax.Array:
        """Return the Sun's position (3,) in km."""
        return self.table(t)[:3]

    def acceleration(self, r: jax.Array, t: Any) -> jax.Array:
        """Return what gravity does to a satellite (3,), km/h^2: Earth to degree 8, Sun, Moon, and the solid tide."""
        turn = self.rotation(t)
        sun, moon = jnp.split(self.table(t), 2)
        total = turn.T @ geopotential.acceleration(turn @ r, self.degree)
        for body, gm in ((sun, GM_SUN), (moon, GM_MOON)) if self.bodies else ():
            total = total + attraction(r, body, gm) + solid_tide(r, body, gm)
        return PER_HOUR2 * total

    def solar_pressure(self, r: jax.Array, t: Any) -> jax.Array:
        """Return the acceleration (3,), km/h^2, by sunlight for an amplitude of one nm/s^2.

            a = -(AU/s)^2 e_sun nu(r, t),

        s the distance of the Sun, e_sun the direction to it, and nu the part of its disc that the Earth leaves visible.
        """
        sun = self.sun(t)
        from_sun = r - sun
        square = (from_sun * from_sun).sum()
        light = sunlight(r, sun) * ASTRONOMICAL_UNIT**2 / square
        return NANO * light * from_sun / jnp.sqrt(square)

    def sunlit_axes(self, r: jax.Array, t: Any) -> jax.Array:
        """Return the axes D, Y and B (3, 3) as columns, times the visible part of the Sun's disc."""
        sun = self.sun(t)
        return sunlight(r, sun) * frames.dyb(r, sun)


@jax.jit
def _turns(rotation: EarthRotation, hours: jax.Array) -> jax.Array:
    return jax.vmap(lambda t: rotation(t))(hours)
