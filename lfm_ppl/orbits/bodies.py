"""Sun and Moon: where they are, how they pull, and how the Sun shines."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.orbits import geopotential, times
from lfm_ppl.orbits.table import TimeTable

ASTRONOMICAL_UNIT = 149_597_870.7
"""km."""
GM_SUN = 1.32712440041e11
"""km^3/s^2."""
GM_MOON = 4902.800066
"""km^3/s^2."""
SUN_RADIUS = 696_000.0
"""km."""
LOVE_NUMBER = 0.3
"""k2, of the solid Earth's answer to a tide of degree two."""

_SPACING = 1.0
_MARGIN = 4


def positions(epoch: float, hours: float) -> TimeTable:
    """Tabulate Sun and Moon, (6,) in km from the Earth's centre in GCRS, against hours after the epoch.

    They come from ERFA's epv00 and moon98, good to about 5 km for the Earth's place around the Sun and 10 km for the
    Moon's around the Earth.

    Args:
        epoch: GPS seconds.
        hours: how long.

    Raises:
        ImportError: pyerfa is not installed.
    """
    erfa = times.library("erfa")
    nodes = _SPACING * np.arange(-_MARGIN, int(np.ceil(hours / _SPACING)) + _MARGIN + 1)
    tt = times.terrestrial(epoch + 3600.0 * nodes)  # dynamical time differs by milliseconds
    heliocentric, _ = erfa.epv00(*tt)
    return TimeTable(nodes[0], _SPACING,
                 ASTRONOMICAL_UNIT * np.concatenate([-heliocentric["p"], erfa.moon98(*tt)["p"]], axis=1))


def attraction(r: jax.Array, body: jax.Array, gm: float) -> jax.Array:
    """Return a body's pull on a satellite less its pull on the Earth (3,), km/s^2.

        a = GM ((s - r)/|s - r|^3 - s/|s|^3).

    Args:
        r: (3,) of the satellite (km).
        body: (3,) s, of the body (km).
        gm: km^3/s^2.
    """
    # Battin's form: the difference of two almost equal vectors is never taken.
    distance = jnp.sqrt((body * body).sum())
    q = (r * (r - 2.0 * body)).sum() / distance**2
    growth = (1.0 + q) ** 1.5
    f = q * (3.0 + 3.0 * q + q * q) / (1.0 + growth)
    return -gm / (distance**3 * growth) * (r + f * body)


def solid_tide(r: jax.Array, body: jax.Array, gm: float) -> jax.Array:
    """Return the pull (3,), km/s^2, of the bulge that a body raises on the solid Earth, of degree two.

        a = k2/2 GM/s^3 R^5/r^4 ((3 - 15 cos^2 theta) e_r + 6 cos theta e_s).

    Source: O. Montenbruck and E. Gill, Satellite Orbits (2005), section 3.7.
    """
    radius, distance = jnp.sqrt((r * r).sum()), jnp.sqrt((body * body).sum())
    e_r, e_s = r / radius, body / distance
    cosine = (e_r * e_s).sum()
    size = 0.5 * LOVE_NUMBER * gm * geopotential.RADIUS**5 / (distance**3 * radius**4)
    return size * ((3.0 - 15.0 * cosine**2) * e_r + 6.0 * cosine * e_s)


def sunlight(r: jax.Array, sun: jax.Array) -> jax.Array:
    """Return the part of the Sun's disc that the Earth leaves visible, from 0 (umbra) to 1.

    Seen from a satellite the limb of the Earth is almost a straight line across the Sun's disc. With z the
    distance of the disc's centre from it, in radii of the disc, 1 - (arccos z - z sqrt(1 - z^2)) / pi is visible.

    Args:
        r: (3,) of the satellite (km).
        sun: (3,) (km).
    """
    to_sun = sun - r
    distance, radius = jnp.sqrt((to_sun * to_sun).sum()), jnp.sqrt((r * r).sum())
    cross = jnp.cross(r, to_sun)
    angle = jnp.arctan2(jnp.sqrt((cross * cross).sum() + 1e-20), -(r * to_sun).sum())
    z = (angle - jnp.arcsin(geopotential.RADIUS / radius)) / jnp.arcsin(SUN_RADIUS / distance)
    partly = jnp.abs(z) < 1.0
    overlap_height = jnp.where(partly, z, 0.0)
    covered = (jnp.arccos(overlap_height) - overlap_height * jnp.sqrt(1.0 - overlap_height**2)) / jnp.pi
    return jnp.where(partly, 1.0 - covered, jnp.where(z > 0.0, 1.0, 0.0))
