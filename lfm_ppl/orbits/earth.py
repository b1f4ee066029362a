"""Rotation of the Earth: from the celestial frame (GCRS) to the terrestrial one (ITRS).

1. Interpolate the measured Earth orientation (UT1 - UTC, polar motion, celestial pole) of the IERS.
2. Tabulate precession, nutation and rotation angle by the routines of the IAU at equally spaced nodes.
3. Compiled code interpolates the table and composes the rotation matrices.

Source: Petit and Luzum (2010), IERS Conventions, chapter 5.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicSpline

from lfm_ppl.orbits import times
from lfm_ppl.orbits.table import TimeTable

_SPACING = 3.0  # hours; the cubic through it is within 1e-12 rad for the nutation's fastest term
_MARGIN = 4


@dataclass(frozen=True)
class Orientation:
    """Earth orientation parameters at some epochs, each (K,).

    Attributes:
        ut1_minus_utc: s.
        x: of the pole (rad).
        y: of the pole (rad).
        dx: offset of the celestial pole (rad).
        dy: offset of the celestial pole (rad).
    """

    ut1_minus_utc: np.ndarray
    x: np.ndarray
    y: np.ndarray
    dx: np.ndarray
    dy: np.ndarray


def orientation(seconds: np.ndarray) -> Orientation:
    """Return what the International Earth Rotation Service measured, its series EOP 20 C04 or the one before it.

    The daily values are interpolated by a cubic spline. What the ocean's tides do within a day is left out, at most
    0.4 milliarcseconds, 5 cm at a GPS satellite.

    Args:
        seconds: epochs, in GPS seconds, (K,).

    Raises:
        ImportError: the library astropy-iers-data, which has the series, is not installed.
        ValueError: an epoch that the series does not cover.
    """
    first, second = times.utc(seconds)
    mjd = np.asarray(first - 2_400_000.5 + second)
    table_days, values = _daily_values()
    if mjd.min() < table_days[4] or mjd.max() > table_days[-5]:
        raise ValueError(f"Earth orientation is known from MJD {table_days[4]:.0f} to {table_days[-5]:.0f}; asked for "
                         f"{mjd.min():.1f} to {mjd.max():.1f}. A newer release of astropy-iers-data knows more.")
    is_near = (table_days >= mjd.min() - 4) & (table_days <= mjd.max() + 4)
    table_days, values = table_days[is_near], values[is_near].copy()
    leap = np.round(np.concatenate([[0.0], np.cumsum(np.diff(values[:, 0]))]))  # UT1 - UTC jumps with a leap second
    values[:, 0] -= leap
    smooth = CubicSpline(table_days, values)(mjd).T
    smooth[0] += leap[np.searchsorted(table_days, mjd, side="right") - 1]
    return Orientation(*smooth)


@functools.cache
def _daily_values() -> tuple[np.ndarray, np.ndarray]:
    """Return the days (MJD) and the columns of `Orientation`, (K, 5)."""
    rows = np.loadtxt(times.library("astropy_iers_data").IERS_B_FILE, comments="#")
    arcseconds = np.pi / 180 / 3600
    return rows[:, 4], rows[:, [7, 5, 6, 8, 9]] * np.array([1.0, *(4 * [arcseconds])])


class EarthRotation(eqx.Module):
    """The rotation from GCRS to ITRS as a function of time, for compiled code.

        r_itrs = W R3(ERA) Q r_gcrs,

    with the celestial pole in Q, the Earth rotation angle ERA and the terrestrial pole in W (IAU 2006/2000A).

    Attributes:
        table: of X, Y and s of the celestial pole (rad), x and y of the terrestrial one and s' (rad), and what the
            Earth rotation angle is ahead of one that grows at a constant rate (rad).
        angle: Earth rotation angle at the epoch, UT1 taken as GPS time (rad).
        rate: its growth (rad/h).
    """

    table: TimeTable
    angle: jax.Array
    rate: jax.Array

    @classmethod
    def over(cls, epoch: float, hours: float) -> EarthRotation:
        """Tabulate the rotation from ``epoch`` (GPS seconds) for ``hours``.

        Raises:
            ImportError: a library of the extra ``gps`` is not installed.
            ValueError: Earth orientation is not known there.
        """
        erfa = times.library("erfa")
        nodes = _SPACING * np.arange(-_MARGIN, int(np.ceil(hours / _SPACING)) + _MARGIN + 1)
        seconds = epoch + 3600.0 * nodes
        earth_orientation = orientation(seconds)
        tt = times.terrestrial(seconds)
        x, y, s = erfa.xys06a(*tt)
        first, second = times.utc(seconds)
        ut1 = erfa.utcut1(first, second, earth_orientation.ut1_minus_utc)
        rate = 2 * np.pi * 1.00273781191135448 / 24.0
        start = float(erfa.era00(times.GPS_START, epoch / times.DAY))
        rotation_excess = erfa.era00(*ut1) - start - rate * nodes
        values = np.stack(
            [
                x + earth_orientation.dx,
                y + earth_orientation.dy,
                s,
                earth_orientation.x,
                earth_orientation.y,
                erfa.sp00(*tt),
                np.unwrap(np.remainder(rotation_excess, 2 * np.pi)),
            ],
            axis=1,
        )
        return cls(TimeTable(nodes[0], _SPACING, values), jnp.asarray(start), jnp.asarray(rate))

    def __call__(self, t: jax.Array) -> jax.Array:
        """Return the matrix (3, 3) at ``t`` hours after the epoch; its transpose leads back."""
        x, y, s, px, py, sp, rotation_excess = self.table(t)
        era = self.angle + self.rate * t + rotation_excess
        # The celestial pole: Q' = [[1 - a x^2, -a x y, x], ...] R3(s), a = 1 / (1 + cos d).
        a = 1.0 / (1.0 + jnp.sqrt(1.0 - x * x - y * y))
        to_gcrs = jnp.stack([jnp.stack([1 - a * x * x, -a * x * y, x]), jnp.stack([-a * x * y, 1 - a * y * y, y]),
                             jnp.stack([-x, -y, 1 - a * (x * x + y * y)])])
        # The locators s and s' turn about the same axes as the angle.
        turned = _about_z(era - s) @ to_gcrs.T
        return _about_x(-py) @ (_about_y(-px) @ (_about_z(sp) @ turned))


def _about_x(angle: jax.Array) -> jax.Array:
    c, s, zero, unit = jnp.cos(angle), jnp.sin(angle), jnp.zeros(()), jnp.ones(())
    return jnp.stack([jnp.stack([unit, zero, zero]), jnp.stack([zero, c, s]), jnp.stack([zero, -s, c])])


def _about_y(angle: jax.Array) -> jax.Array:
    c, s, zero, unit = jnp.cos(angle), jnp.sin(angle), jnp.zeros(()), jnp.ones(())
    return jnp.stack([jnp.stack([c, zero, -s]), jnp.stack([zero, unit, zero]), jnp.stack([s, zero, c])])


def _about_z(angle: jax.Array) -> jax.Array:
    c, s, zero, unit = jnp.cos(angle), jnp.sin(angle), jnp.zeros(()), jnp.ones(())
    return jnp.stack([jnp.stack([c, s, zero]), jnp.stack([-s, c, zero]), jnp.stack([zero, zero, unit])])
