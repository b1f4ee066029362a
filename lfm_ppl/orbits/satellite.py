"""A satellite as a latent force model: known gravity, and small unmeasured forces.

1. The state is position and velocity; the acceleration is the gravity of Earth, Moon and Sun plus small forces along
   axes that turn with the satellite.
2. Each small force is a level plus resonators at multiples of the orbital frequency.
3. The prior of the initial state comes from a polynomial through the first positions.

Source: Hartikainen, Seppänen and Särkkä (2012), section 6.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.forces import Constant, Force, RandomWalk, Resonator
from lfm_ppl.model.gaussian import Gaussian
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation import GaussianObservation
from lfm_ppl.orbits import frames
from lfm_ppl.orbits.environment import NANO, Environment
from lfm_ppl.orbits.geopotential import GM
from lfm_ppl.utils import checks

SOLAR_PRESSURE = 100.0
"""Prior mean of the acceleration of a GPS satellite by sunlight, in nm/s^2."""
GPS_PERIOD = 23.9344696 / 2
"""Orbital period of a GPS satellite in hours: half a sidereal day."""
HARMONICS: dict[str, Mapping[str, Sequence[int]]] = {
    "DYB": {"solar": (1, 2, 3, 4), "panel": (1, 2, 3, 4), "remaining": (1, 2, 3, 4)},
    "RTN": {"radial": range(1, 8), "tangential": range(1, 8), "normal": range(1, 11)},
}
"""Axes -> force -> multiples of the base frequency: of the orbital frequency for DYB, of half of it for RTN."""
STATES = ("x", "y", "z", "vx", "vy", "vz")
START_SD = (0.1, 0.1)
"""Prior standard deviations of position and velocity at the first time (km, km/h), much wider than the data."""
_NEAR = 9


class Motion(eqx.Module):
    """The dynamics of `satellite`: d(r, v) = (v, a(r, t) + u_solar a_solar(r, t) + R u)."""

    environment: Environment
    axes: str = eqx.field(static=True)

    def __call__(self, x: jax.Array, u: jax.Array, t: Any) -> jax.Array:
        """Return the derivatives (6,) in km/h and km/h^2; the first force is the sunlight."""
        return jnp.concatenate([x[3:], self.acceleration(x, u, t)])

    def acceleration(self, x: jax.Array, u: jax.Array, t: Any) -> jax.Array:
        """Return the acceleration (3,) in km/h^2."""
        r, v = x[:3], x[3:]
        total = self.environment.acceleration(r, t) + u[0] * self.environment.solar_pressure(r, t)
        other_axes = self.environment.sunlit_axes(r, t)[:, 1:] if self.axes == "DYB" else frames.rtn(r, v)
        return total + NANO * other_axes @ u[1:]


def satellite(environment: Environment, start: Gaussian, forces: Mapping[str, Force], axes: str = "DYB",
              white: Any = 0.0, noise_sd: Any = 5e-5, units: Mapping[str, str] | None = None) -> LatentForceModel:
    """Return the model of a satellite with unknown small forces, whose position is observed.

        dr = v dt,    dv = (a(r, t) + u_1(t) a_solar(r, t) + R (u_2, ...)) dt + white dB,    y_k = r(t_k) + e_k,

    with a(r, t) the gravity of Earth, Moon and Sun, a_solar a solar pressure of one nm/s^2, zero in the Earth's shadow,
    and R the other axes: Y and B of `dyb`, in sunlight, or all three of `rtn`. The small forces are in
    nm/s^2, distances in km, times in hours. Only position and velocity enter non-linearly, so that a sigma-point rule
    needs twelve points for any number of states of the forces.

    Args:
        environment: gravity, Earth rotation, Sun and Moon.
        start: position (km) and velocity (km/h) at the first time, (6,).
        forces: name -> force, in nm/s^2: the sunlight first, then one for each other axis, such as `small_forces`.
        axes: "DYB" or "RTN".
        white: dispersion of white noise on the acceleration, in nm/s^2 sqrt(h).
        noise_sd: standard deviation of the error of a coordinate (km).
        units: name -> unit, for results and plots.

    Raises:
        ValueError: unknown axes, or a wrong number of forces.

    Source: Hartikainen, Seppanen and Sarkka (2012), section 6.
    """
    checks.one_of("axes", axes, tuple(frames.AXES))
    return pushed(Motion(environment, axes), start, forces, axes, white, noise_sd, units)


def pushed(dynamics: Callable, start: Gaussian, forces: Mapping[str, Force], axes: str, white: Any, noise_sd: Any,
           units: Mapping[str, str] | None) -> LatentForceModel:
    """Return the model of a position and a velocity with these dynamics; arguments as for `satellite`."""
    force_count = 3 if axes == "DYB" else 4
    if len(forces) != force_count:
        raise ValueError(f"a satellite with axes {axes} has {force_count} forces, the sunlight first; got "
                         f"{list(forces)}.")
    push = jnp.concatenate([jnp.zeros((3, 3)), NANO * jnp.asarray(white) * jnp.eye(3)])
    return LatentForceModel(
        dynamics, dict(forces), GaussianObservation(_position, sd=noise_sd), start,
        process_noise=push, state_names=STATES, output_names=STATES[:3], units=units)


def _position(x: jax.Array, u: jax.Array, t: Any) -> jax.Array:
    return x[:3]


def small_forces(axes: str = "DYB", amplitude: Any = 1.0, wander: Any = 0.01, drift: Any = 0.003,
                 level: Any = (10.0, 2.0), harmonics: Mapping[str, Sequence[int]] | None = None,
                 period: Any = GPS_PERIOD) -> dict[str, Force]:
    """Return quasi-periodic forces for `satellite`, in nm/s^2: on each axis a level and resonators.

        u(t) = b(t) + sum_n c_n(t),    db = drift dbeta,    c_n'' = -(2 pi n f)^2 c_n + white noise,

    c_n with standard deviation amplitude / n at the start, and wander / n gained per square root of an hour.

    Args:
        axes: "DYB", with f the orbital frequency, or "RTN", with half of it: once a day for GPS.
        amplitude: nm/s^2; or force -> one number for each of its multiples n, not divided by n.
        wander: nm/s^2 / sqrt(h); or force -> numbers, as amplitude.
        drift: nm/s^2 / sqrt(h); or force -> number.
        level: standard deviation of the sunlight's acceleration, and of the levels b on the other axes (nm/s^2); or
            force -> number.
        harmonics: force -> multiples of the base frequency; None: `HARMONICS`.
        period: orbital period (h), as from `period_of`; by default of a GPS satellite.

    Raises:
        ValueError: unknown axes, or a period that is not positive.

    Example:
        >>> {name: force.state_dim for name, force in small_forces().items()}
        {'solar': 9, 'panel': 9, 'remaining': 9}
    """
    checks.one_of("axes", axes, tuple(HARMONICS))
    base = period if axes == "DYB" else 2 * period
    levels = level if isinstance(level, Mapping) else {}
    sunlight, other_level = (0.0, 0.0) if levels else level
    forces: dict[str, Force] = {}
    if axes == "RTN":
        forces["solar"] = Constant(levels.get("solar", sunlight), SOLAR_PRESSURE)
    for name, multiples in (harmonics or HARMONICS[axes]).items():
        sunward = name == "solar"
        walk = drift[name] if isinstance(drift, Mapping) else drift
        force: Force = RandomWalk(walk, levels.get(name, sunlight if sunward else other_level),
                                  mean=SOLAR_PRESSURE if sunward else 0.0)
        sizes = zip(
            multiples, _magnitudes(amplitude, name, multiples), _magnitudes(wander, name, multiples), strict=True
        )
        for n, size, gain in sizes:
            force = force + Resonator(base / n, size, gain)
        forces[name] = force
    return forces


def period_of(path: Any) -> jax.Array:
    """Return the orbital period (h) from the mean of the semi-major axis along a path.

        1/a = 2/|r| - |v|^2/GM,    period = 2 pi (a^3/GM)^(1/2)

    Args:
        path: (T, 6) position (km) and velocity (km/h).

    Raises:
        ValueError: another shape, or a velocity above the escape velocity.

    Example:
        >>> round(float(period_of(jnp.array([[29_600.0, 0.0, 0.0, 0.0, 13_210.7, 0.0]]))), 2)  # as of Galileo
        14.08
    """
    gm = GM * 3600.0**2
    path = jnp.asarray(path)
    if path.ndim != 2 or path.shape[1] != 6:
        raise ValueError(f"path must have shape (times, 6), position and velocity, got {path.shape}.")
    inverse = 2.0 / jnp.linalg.norm(path[:, :3], axis=1) - (path[:, 3:] ** 2).sum(axis=1) / gm
    concrete_inverse = checks.concrete(inverse)
    if concrete_inverse is not None and not (concrete_inverse > 0).all():
        raise ValueError("this is no orbit around the Earth: the velocity (km/h) exceeds the escape velocity.")
    return 2.0 * jnp.pi * jnp.sqrt((1.0 / inverse).mean() ** 3 / gm)


def _magnitudes(magnitude: Any, name: str, multiples: Sequence[int]) -> Sequence[Any]:
    """Return one magnitude for each multiple of a force."""
    return magnitude[name] if isinstance(magnitude, Mapping) else [magnitude / n for n in multiples]


def start_near(times: Any, positions: Any) -> Gaussian:
    """Return a wide prior of the state at the first time, about a polynomial through nine positions.

    The polynomial has degree eight. Over two hours of a GPS orbit the error of its velocity is 1e-4 km/h, over three
    hours 0.01 km/h; the standard deviations of the prior are 0.1 km and 0.1 km/h.

    Args:
        times: (T,) hours.
        positions: (T, 3) km; rows with NaN are ignored.

    Raises:
        ValueError: fewer than nine positions, none at the first time, or a span above three hours.

    Example:
        >>> times = 0.25 * np.arange(9)
        >>> start_near(times, 8000.0 * times[:, None] * np.ones(3)).mean[3:].round(6).tolist()
        [8000.0, 8000.0, 8000.0]
    """
    mean, missing, reach = polynomial_state(times, positions)
    if missing or reach > 3.0:
        reason = "the first position is missing" if missing else f"nine positions span {reach:g} h"
        raise ValueError("the start of an orbit needs nine positions within three hours, the first of them at the "
                         f"first time; {reason}. Start the data at the first position.")
    return wide_start(mean)


def wide_start(state: Any) -> Gaussian:
    """Return a wide prior about a state (6,), in km and km/h, with standard deviations `START_SD`.

    Example:
        >>> wide_start(jnp.zeros(6)).covariance.diagonal().round(6).tolist()
        [0.01, 0.01, 0.01, 0.01, 0.01, 0.01]
    """
    return Gaussian(jnp.asarray(state), jnp.diag(jnp.repeat(jnp.asarray(START_SD) ** 2, 3)))


def polynomial_state(times: Any, positions: Any) -> tuple[jax.Array, bool, float]:
    """Return the state (6,) at the first time from a polynomial through nine positions, with its quality.

    Args:
        times: (T,) hours.
        positions: (T, 3) km; rows with NaN are ignored.

    Returns:
        The state; whether the first position is missing; the hours between the first time and the ninth position.

    Raises:
        ValueError: fewer than nine positions.
    """
    times = np.asarray(times, float)
    concrete_positions = checks.concrete(positions)
    rows = (
        np.arange(len(times))
        if concrete_positions is None
        else np.flatnonzero(np.isfinite(concrete_positions).all(axis=1))
    )
    rows = rows[np.concatenate([[True], np.diff(times[rows]) > 0])][:_NEAR] if len(rows) else rows
    if len(rows) < _NEAR:
        raise ValueError(f"the start of an orbit needs {_NEAR} positions; there are {len(rows)}.")
    node_times, first = times[rows], times[0]
    vandermonde = np.vander((node_times - first) / (node_times[-1] - first), _NEAR, increasing=True)
    weights = np.linalg.inv(vandermonde)[:2] / np.array([[1.0], [node_times[-1] - first]])
    state = (jnp.asarray(weights) @ jnp.asarray(positions)[rows]).ravel()
    return state, bool(node_times[0] > first), float(node_times[-1] - first)
