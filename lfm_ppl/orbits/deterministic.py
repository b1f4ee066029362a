"""Orbits without unknown forces: gravity, and sunlight of a constant amplitude."""

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
"""Of the Runge-Kutta method: where in the step, and its weight."""
_ITERATIONS = 12
_REACH = 6.0
"""Hours in which the first nine positions must lie for the search to start near enough."""


class Orbit(NamedTuple):
    """What determines an orbit.

    Attributes:
        time: of the state (h).
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
        environment: what surrounds the satellite.
        orbit: where it is at the first of the times.
        times: (T,) hours, equally spaced.

    Raises:
        ValueError: times that are not equally spaced, or do not begin at the orbit's.
    """
    times = np.asarray(times, float)
    interval = _interval(times)
    if abs(times[0] - orbit.time) > 1e-9:
        raise ValueError(f"times must begin with that of the orbit, {orbit.time:g} h, got {times[0]:g} h.")
    parameters = jnp.asarray(np.append(orbit.state, orbit.solar))
    return np.asarray(_path_compiled(environment, parameters, times[0], interval, len(times), _steps(interval)))


def fit_orbit(environment: Environment, times: Any, positions: Any, solar: float | None = None) -> Orbit:
    """Fit an orbit to positions by least squares, the Gauss-Newton method.

    Args:
        environment: what surrounds the satellite.
        times: (T,) hours, equally spaced.
        positions: (T, 3) km in axes that do not turn; rows with NaN do not count.
        solar: amplitude of the pressure of sunlight (nm/s^2); None: fitted, too.

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
        raise ValueError(f"the search for an orbit begins with nine positions in its first {_REACH:g} hours; here they "
                         f"take {reach:g} h. Begin where the positions begin.")
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
                         f"{float(residual):.3g} km and still changing. Is there a manoeuvre among them?")
    found = np.asarray(parameters)
    return Orbit(float(times[0]), found[:6], float(found[6]), float(residual))


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
            found = slope(x + part * h * last, t + part * h)
            return (found, total + weight * found), None

        # In a loop, as the pull of the Earth is long to compile.
        (_, total), _ = jax.lax.scan(stage, (jnp.zeros_like(x), jnp.zeros_like(x)), jnp.asarray(_STAGES))
        return x + h * total, None

    def row(x: jax.Array, index: jax.Array) -> tuple[jax.Array, jax.Array]:
        after, _ = jax.lax.scan(step, x, start + interval * index + h * jnp.arange(steps))
        return after, x

    return jax.lax.scan(row, parameters[:6], jnp.arange(count))[1]


_path_compiled = jax.jit(_path, static_argnums=(4, 5))


@functools.partial(jax.jit, static_argnums=(5, 6))
def _gauss_newton(environment: Environment, parameters: jax.Array, positions: jax.Array, start: Any, interval: Any,
                  steps: int, free: int) -> tuple[jax.Array, jax.Array]:
    """Return the change of the free parameters, and the distance that the present ones leave."""
    known = jnp.isfinite(positions).all(axis=1)

    def residuals(some: jax.Array) -> tuple[jax.Array, jax.Array]:
        path = _path(environment, jnp.concatenate([some, parameters[free:]]), start, interval, positions.shape[0],
                     steps)
        found = jnp.where(known[:, None], path[:, :3] - jnp.where(known[:, None], positions, 0.0), 0.0).ravel()
        return found, found

    jacobian, left = jax.jacfwd(residuals, has_aux=True)(parameters[:free])
    scale = jnp.sqrt((jacobian**2).sum(0))
    change = -jnp.linalg.lstsq(jacobian / scale, left)[0] / scale
    return change, jnp.sqrt((left**2).sum() / jnp.maximum(known.sum(), 1))
