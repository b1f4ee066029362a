"""Small departures from a known orbit: a linear latent force model, much cheaper than the satellite itself.

1. Differentiate the acceleration by state and forces along the orbit, by automatic differentiation.
2. Tabulate the derivatives at equally spaced nodes, as means over an interval where the Earth's shadow makes them jump.
3. The departure is linear in state and forces, with coefficients that depend on time.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.forces import Force
from lfm_ppl.model.gaussian import Gaussian
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.orbits import frames
from lfm_ppl.orbits.deterministic import Orbit, propagate
from lfm_ppl.orbits.environment import Environment
from lfm_ppl.orbits.satellite import Motion, period_of, pushed, wide_start
from lfm_ppl.orbits.table import TimeTable
from lfm_ppl.utils import checks

_FINEST = 1 / 120
"""Spacing of the points on the orbit over which means are taken (h): 30 s, half as long as a penumbra lasts."""


class Neighbourhood(eqx.Module):
    """How the acceleration changes near an orbit, with place, velocity and small forces: the dynamics of `departure`.

    Attributes:
        path: (T, 6) position (km) and velocity (km/h) on the orbit, at the times it was made for.
        slopes: table of the derivatives (3, 6 + R) of the acceleration by position, velocity and small forces.
        on_orbit: (R,) the small forces on the orbit itself: sunlight of constant amplitude, and nothing else.
        axes: of the small forces.
        period: hours in which the orbit turns once.
    """

    path: jax.Array
    slopes: TimeTable
    on_orbit: jax.Array
    axes: str = eqx.field(static=True)
    period: Any

    @classmethod
    def of(cls, environment: Environment, orbit: Orbit, times: Any, axes: str = "DYB", nodes: int = 2
           ) -> Neighbourhood:
        """Tabulate along an orbit.

        Args:
            environment: what surrounds the satellite.
            orbit: where it is at the first of the times, and the sunlight's amplitude.
            times: (T,) hours, equally spaced.
            axes: of the small forces, "DYB" or "RTN".
            nodes: of the table from one time to the next, two for each integration step. The table is cubic between
                them; of the derivatives by forces it holds means over the steps around them, so that integrals over
                the edges of the Earth's shadow are right.

        Raises:
            ValueError: unknown axes; times as for `propagate`.
        """
        checks.one_of("axes", axes, tuple(frames.AXES))
        checks.positive_integer("nodes", nodes)
        times = np.asarray(times, float)
        spacing = float(times[1] - times[0]) / nodes if len(times) > 1 else 1.0
        finer = 2 * max(1, int(np.ceil(spacing / (2 * _FINEST) - 1e-9)))
        count = nodes * finer
        fine = np.interp(np.arange(count * (len(times) - 1) + 1) / count, np.arange(len(times)), times)
        path = propagate(environment, orbit, fine)
        on_orbit = jnp.zeros(3 if axes == "DYB" else 4).at[0].set(orbit.solar)
        slopes = _slopes(Motion(environment, axes), jnp.asarray(path), on_orbit, jnp.asarray(fine))
        # Only forces switch with the shadow. The pull's own slope must stay as it is: an error of it adds up with time.
        values = np.asarray(slopes).reshape(len(fine), 3, -1)
        by_force = _means(values[:, :, 6:].reshape(len(fine), -1), finer).reshape(-1, 3, len(on_orbit))
        table = np.concatenate([values[::finer, :, :6], by_force], axis=2)
        return cls(
            jnp.asarray(path[::count]),
            TimeTable(fine[0], spacing, table.reshape(len(table), -1)),
            on_orbit,
            axes,
            period_of(path),
        )

    def __call__(self, x: jax.Array, u: jax.Array, t: Any) -> jax.Array:
        """Return the derivatives (6,) of a departure x (6,) under the small forces u (R,)."""
        slopes = self.slopes(t).reshape(3, -1)
        return jnp.concatenate([x[3:], slopes[:, :6] @ x + slopes[:, 6:] @ (u - self.on_orbit)])


@jax.jit
def _slopes(motion: Motion, path: jax.Array, u: jax.Array, times: jax.Array) -> jax.Array:
    def slopes_at(inputs: tuple[jax.Array, jax.Array]) -> jax.Array:
        x, t = inputs
        by_state, by_force = jax.jacfwd(motion.acceleration, argnums=(0, 1))(x, u, t)
        return jnp.concatenate([by_state, by_force], axis=1).ravel()

    return jax.lax.map(slopes_at, (path, times))


def _means(values: np.ndarray, finer: int) -> np.ndarray:
    """Return local means of values (K finer + 1, C) around every ``finer``-th of them; there are none near both ends.

    A step samples its beginning, its middle and its end. Where the function jumps in between, the sum of such samples
    is wrong by a share of the jump times the step; that of means over one step is not, but flattens whatever is curved.
    Means over one and over two steps are combined so that polynomials of degree three are left as they are.
    """
    nodes = values[::finer].copy()
    if len(nodes) < 5:
        return nodes
    half_means, full_means = (_mean_over(values, half) for half in (finer, 2 * finer))
    inner = slice(2, len(nodes) - 2)
    narrow, wide = (half**2 / 3 + 1 / 6 for half in (finer, 2 * finer))  # second moments of the trapezoidal rule
    nodes[inner] = (wide * half_means[::finer][inner] - narrow * full_means[::finer][inner]) / (wide - narrow)
    return nodes


def _mean_over(values: np.ndarray, half: int) -> np.ndarray:
    """Return means of the linear interpolant of the values (K, C) over ``half`` intervals to each side; NaN at ends."""
    below = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(0.5 * (values[1:] + values[:-1]), axis=0)])
    hourly_means = np.full_like(values, np.nan)
    hourly_means[half:len(values) - half] = (below[2 * half:] - below[:len(values) - 2 * half]) / (2 * half)
    return hourly_means


def departure(near: Neighbourhood, forces: Mapping[str, Force], white: Any = 0.0, noise_sd: Any = 5e-5,
              start: Gaussian | None = None, units: Mapping[str, str] | None = None) -> LatentForceModel:
    """Return the departure from an orbit as a latent force model, linear and with coefficients that depend on time.

        d(dr) = dv dt,    d(dv) = (A(t) dr + B(t) dv + C(t) (u - u_0)) dt + white dB,    y_k = dr(t_k) + e_k,

    with A, B and C the derivatives of the acceleration on the orbit and u_0 the forces there. It is what `satellite`
    is for small departures, with steps thirty times as long: a departure changes as slowly as the orbit turns, and
    one step of a quarter of an hour is good to 1e-6 of it in sunlight, 1e-4 with the Earth's shadow. What is left out
    is of the order of the departure squared over the radius, 0.4 mm for 100 m. Observations are positions less
    `near.path`.

    Args:
        near: an orbit and what is around it.
        forces: as for `satellite`.
        white: as for `satellite`.
        noise_sd: standard deviation of a coordinate's error (km).
        start: departure at the first time; None: wide about none.
        units: name -> unit.

    Raises:
        ValueError: a wrong number of forces.

    Example:
        >>> import lfm_ppl as lfm
        >>> near = Neighbourhood.of(environment, orbit, times)  # doctest: +SKIP
        >>> nowhere = TimeTable(0.0, 1.0, np.zeros((4, 27)))  # no gravity, no sunlight
        >>> near = Neighbourhood(jnp.zeros((4, 6)), nowhere, jnp.zeros(3), "DYB", lfm.orbits.GPS_PERIOD)
        >>> model = departure(near, lfm.orbits.small_forces("DYB"))
        >>> found = lfm.filter(model, np.arange(2.0), np.zeros((2, 3)), lfm.Taylor(), steps=1)
        >>> bool(abs(found.predicted_mean[1, :6]).max() < 1e-12)
        True
    """
    start = wide_start(jnp.zeros(6)) if start is None else start
    return pushed(near, start, forces, near.axes, white, noise_sd, units)
