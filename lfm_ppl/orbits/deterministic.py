"""Orbits without unknown forces: gravity, and sunlight of a constant amplitude.

1. Propagate position and velocity by the classical Runge-Kutta method in equal steps.
2. Fit state and amplitude to positions by the Gauss-Newton method; derivatives are taken in forward mode through the
   propagation.
3. Start at a polynomial through the first nine positions.

Source: Montenbruck and Gill (2000), Satellite Orbits, chapters 3, 4 and 8.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.orbits.environment import Environment
from lfm_ppl.orbits.satellite import SOLAR_PRESSURE, polynomial_state
from lfm_ppl.utils import checks

STEP = 1.0 / 120.0
"""Longest step of the Runge-Kutta method, in hours; its error is 5 cm after ten days of a GPS orbit."""
_STAGES = np.array([[0.0, 1 / 6], [0.5, 1 / 3], [0.5, 1 / 3], [1.0, 1 / 6]])
"""Nodes and weights of the Runge-Kutta method."""
_ITERATIONS = 12
_REACH = 6.0
"""Largest span of the first nine positions in hours, for a start near the solution."""


class Orbit(NamedTuple):
    """An orbit: its state at one time.

    Attributes:
        time: time of the state (h).
        state: (6,) position (km) and velocity (km/h).
        solar: amplitude of the pressure of sunlight (nm/s^2).
        residual: root mean square distance from the positions that it was fitted to (km).

    Example:
        >>> orbit = Orbit(0.0, np.array([26_560.0, 0.0, 0.0, 0.0, 8_000.0, 11_425.0]), solar=100.0, residual=0.0)
        >>> round(float(np.linalg.norm(orbit.state[3:])), 1)  # km/h
        13947.4
    """

    time: float
    state: np.ndarray
    solar: float
    residual: float


def propagate(environment: Environment, orbit: Orbit, times: Any) -> np.ndarray:
    """Return positions and velocities (T, 6) on an orbit.

    Args:
        environment: gravity, Earth rotation, Sun and Moon.
        orbit: the orbit, with its state at the first time.
        times: (T,) hours, equally spaced.

    Raises:
        ValueError: times that are not equally spaced, or do not start at the orbit's time.
    """
    times = np.asarray(times, float)
    interval = _interval(times)
    if abs(times[0] - orbit.time) > 1e-9:
        raise ValueError(f"times must start at the time of the orbit, {orbit.time:g} h, got {times[0]:g} h.")
    parameters = jnp.asarray(np.append(orbit.state, orbit.solar))
    return np.asarray(_path_compiled(environment, parameters, times[0], interval, len(times), _steps(interval)))


def fit_orbit(environment: Environment, times: Any, positions: Any, solar: float | None = None) -> Orbit:
    """Fit an orbit to positions by least squares, the Gauss-Newton method.

    Args:
        environment: gravity, Earth rotation, Sun and Moon.
        times: (T,) hours, equally spaced.
        positions: (T, 3) km in inertial axes; rows with NaN are ignored.
        solar: amplitude of the solar pressure (nm/s^2); None: estimated.

    Returns:
        The orbit, its state at the first time.

    Raises:
        ValueError: too few positions, or none in the first hours; times that are not equally spaced; no convergence.

    Example:
        >>> orbit = fit_orbit(environment, times, positions)  # doctest: +SKIP
        >>> path = propagate(environment, orbit, times)  # doctest: +SKIP
    """
    times, positions = np.asarray(times, float), np.asarray(checks.unmask(positions), float)
    interval = _interval(times)
    start, _, reach = polynomial_state(times, positions)
    if reach > _REACH:
        raise ValueError(f"the search for an orbit needs nine positions in its first {_REACH:g} hours; here they "
                         f"span {reach:g} h. Start the data at the first position.")
    parameters = jnp.asarray(np.append(start, SOLAR_PRESSURE if solar is None else solar))
    free = 7 if solar is None else 6
    for _ in range(_ITERATIONS):
        change, residual = _gauss_newton(environment, parameters, jnp.asarray(positions), times[0], interval,
                                         _steps(interval), free)
        parameters = parameters.at[:free].add(change)
        if float(jnp.abs(change[:3]).max()) < 1e-7:
            break
    else:
        raise ValueError(f"no orbit fits these positions: after {_ITERATIONS} steps of the search the distance is "
                         f"{float(residual):.3g} km and still changing. Do they contain a manoeuvre?")
    fitted = np.asarray(parameters)
    return Orbit(float(times[0]), fitted[:6], float(fitted[6]), float(residual))


def _interval(times: np.ndarray) -> float:
    checks.finite("times", times)
    steps = np.diff(times)
    if len(times) < 2 or not np.allclose(steps, steps[0], rtol=1e-6) or steps[0] <= 0:
        raise ValueError("times must be equally spaced and increase; leave a missing position NaN.")
    return float(steps.mean())


def _steps(interval: float) -> int:
    return int(np.ceil(interval / STEP - 1e-9))


def _path(environment: Environment, parameters: jax.Array, start: Any, interval: Any, count: int,
          steps: int) -> jax.Array:
    h = interval / steps

    def slope(x: jax.Array, t: jax.Array) -> jax.Array:
        pressure = parameters[6] * environment.solar_pressure(x[:3], t)
        return jnp.concatenate([x[3:], environment.acceleration(x[:3], t) + pressure])

    def step(x: jax.Array, t: jax.Array) -> tuple[jax.Array, None]:
        def stage(carry: tuple[jax.Array, jax.Array], of: jax.Array) -> tuple[tuple[jax.Array, jax.Array], None]:
            last, total = carry
            part, weight = of
            stage_slope = slope(x + part * h * last, t + part * h)
            return (stage_slope, total + weight * stage_slope), None

        # A loop, because the gravity of the Earth takes long to compile.
        (_, total), _ = jax.lax.scan(stage, (jnp.zeros_like(x), jnp.zeros_like(x)), jnp.asarray(_STAGES))
        return x + h * total, None

    def row(x: jax.Array, index: jax.Array) -> tuple[jax.Array, jax.Array]:
        next_state, _ = jax.lax.scan(step, x, start + interval * index + h * jnp.arange(steps))
        return next_state, x

    return jax.lax.scan(row, parameters[:6], jnp.arange(count))[1]


_path_compiled = jax.jit(_path, static_argnums=(4, 5))


@functools.partial(jax.jit, static_argnums=(5, 6))
def _gauss_newton(environment: Environment, parameters: jax.Array, positions: jax.Array, start: Any, interval: Any,
                  steps: int, free: int) -> tuple[jax.Array, jax.Array]:
    """Return the change of the free parameters, and the root mean square distance before it."""
    is_observed = jnp.isfinite(positions).all(axis=1)

    def residuals(some: jax.Array) -> tuple[jax.Array, jax.Array]:
        path = _path(environment, jnp.concatenate([some, parameters[free:]]), start, interval, positions.shape[0],
                     steps)
        distances = jnp.where(
            is_observed[:, None], path[:, :3] - jnp.where(is_observed[:, None], positions, 0.0), 0.0
        ).ravel()
        return distances, distances

    jacobian, residual = jax.jacfwd(residuals, has_aux=True)(parameters[:free])
    scale = jnp.sqrt((jacobian**2).sum(0))
    change = -jnp.linalg.lstsq(jacobian / scale, residual)[0] / scale
    return change, jnp.sqrt((residual**2).sum() / jnp.maximum(is_observed.sum(), 1))
