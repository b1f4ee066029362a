"""A model with a one-dimensional state, put on the cells of a grid: rates, masses and likelihoods as arrays."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.time_grid import TimeGrid, as_arrays
from lfm_ppl.fokker_planck_grid.finite_volume import Chain, Grid, chain, gaussian_masses
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.model.structure import pattern

NODES, WEIGHTS = np.polynomial.legendre.leggauss(5)
"""Gauss-Legendre rule on [-1, 1] with which likelihoods are averaged over a cell."""


class Cells(NamedTuple):
    """Everything of a model that a filter on the grid needs, as arrays.

    Attributes:
        chain: rates (N,) each, or (rows, steps, N) where drift or dispersion depend on time.
        jumps: (J, N, N), transition matrices of the jumps of the forces; None without any.
        initial: (N,) masses at the initial time; what lies outside the grid is left out.
        value: (T, N, G, D), or (1, ...) where it is the same for all observations: h at G nodes in each cell.
        noise: (T, N, G, D, D) R there, with axes of length one where it does not vary.
        angular: (D,), whether a component of y is an angle.
    """

    chain: Chain
    jumps: Any
    initial: jax.Array
    value: jax.Array
    noise: jax.Array
    angular: jax.Array


def varies_with_time(ssm: StateSpaceModel) -> bool:
    """Whether drift or dispersion depend on time."""
    if ssm.physical_dim == 0:
        return False
    noise = ssm.model.process_noise
    size = ssm.physical_dim
    if ssm.drift_structure.offset_varies or not callable(noise):
        return ssm.drift_structure.offset_varies
    found = pattern(lambda v: jnp.ravel(jnp.asarray(noise(v[:size], v[size:size], v[size]), float)), size + 1)
    return bool(found.jacobian[:, size].any())


def on_grid(ssm: StateSpaceModel, time_grid: TimeGrid, grid: Grid, room: int = 0) -> Cells:
    """Put a model with a one-dimensional state on a grid.

    Args:
        ssm: the model, of state dimension one.
        time_grid: the time grid of the scan.
        grid: the cells.
        room: evaluate the model's functions for as many cells at least, and drop the superfluous ones: outside
            compiled code, grids of different sizes then share their compiled operations.
    """
    mean, covariance = ssm.initial()
    jumps = None
    if ssm.stack.jump_times:
        jumps = jnp.stack([_jump(grid, *ssm.stack.jump(index)) for index in range(len(ssm.stack.jump_times))])
    value, noise = _observations(ssm, time_grid, grid, room)
    angular = np.isin(np.arange(ssm.output_dim), ssm.model.observation.angular)
    return Cells(_chains(ssm, time_grid, grid, room), jumps, gaussian_masses(grid, mean[0], covariance[0, 0]), value,
                 noise, jnp.asarray(angular))


def drift_and_diffusion(ssm: StateSpaceModel, s: jax.Array, t: Any) -> tuple[jax.Array, jax.Array]:
    """Return b and D = g^2 / 2 of the one-dimensional state, scalars."""
    if ssm.physical_dim == 0:
        return ssm.stack.feedback()[0, 0] * s, 0.5 * (ssm.stack.dispersion() ** 2).sum() + 0.0 * s
    w = jnp.reshape(s, (1,))
    dispersion = ssm.dispersion(w, t)
    assert dispersion is not None  # such models are turned away before
    return ssm.drift(w, t)[0], 0.5 * (jnp.asarray(dispersion, float) ** 2).sum() + 0.0 * s


def _padded(points: np.ndarray, room: int) -> jax.Array:
    return jnp.asarray(np.pad(points, (0, max(room - len(points), 0)), mode="edge"))


def _chains(ssm: StateSpaceModel, time_grid: TimeGrid, grid: Grid, room: int) -> Chain:
    faces = _padded(grid.edges[1:-1], room)

    def at(t: jax.Array) -> Chain:
        def one(s: jax.Array) -> tuple[jax.Array, jax.Array]:
            diffusion, derivative = jax.jvp(lambda s: drift_and_diffusion(ssm, s, t)[1], (s,), (jnp.ones_like(s),))
            return drift_and_diffusion(ssm, s, t)[0] - derivative, diffusion

        return chain(*(a[: grid.cells - 1] for a in jax.vmap(one)(faces)), grid.width)

    if not varies_with_time(ssm):
        return at(jnp.asarray(time_grid.initial_time, float))
    rows = as_arrays(time_grid.intervals)
    middle = (np.arange(time_grid.steps) + 0.5) / time_grid.steps
    times = jax.vmap(lambda row: row.span.time(row.length * middle))(rows)
    return jax.vmap(jax.vmap(at))(times)


def _observations(ssm: StateSpaceModel, time_grid: TimeGrid, grid: Grid, room: int) -> tuple[jax.Array, jax.Array]:
    rows, observed = as_arrays(time_grid.intervals), jnp.asarray(time_grid.observed)
    times = rows.end[observed]
    nodes = _padded(grid.centres, room)[:, None] + 0.5 * grid.width * NODES
    observation = ssm.model.observation
    constant_inputs = ssm.constant_measurement and ssm.constant_mean
    per_time = ssm.observation_structure.offset_varies or not constant_inputs
    varying = observation.varies_with_state
    if varying:
        per_row = not constant_inputs or _noise_depends_on_time(ssm)
    else:
        per_row = jnp.ndim(observation.covariance) == 3
    several = jnp.arange(observed.shape[0])

    def inputs(s: jax.Array, t: jax.Array) -> jax.Array:
        matrix, offset = ssm.input_map(t)
        return matrix[:, 0] * s + offset

    def over(function: Any, by_row: bool, by_node: bool) -> jax.Array:
        points = nodes if by_node else nodes[:1, :1]
        on_nodes = lambda t, row: jax.vmap(jax.vmap(lambda s: function(inputs(s, t), t, row)))(points)  # noqa: E731
        return jax.vmap(on_nodes)(*((times, several) if by_row else (times[:1], several[:1])))[:, : grid.cells]

    value = over(lambda w, t, row: ssm.observe(w, t), per_time, True)
    return value, over(ssm.obs_cov, per_row, varying)


def _noise_depends_on_time(ssm: StateSpaceModel) -> bool:
    size, total = ssm.physical_dim, ssm.input_dim
    covariance = ssm.model.observation.covariance
    found = pattern(lambda v: jnp.ravel(jnp.asarray(covariance(v[:size], v[size:total], v[total]), float)), total + 1)
    return bool(found.jacobian[:, total].any())


def _jump(grid: Grid, gain: jax.Array, noise: jax.Array) -> jax.Array:
    """Transition matrix of s <- G s + N(0, Q); the end cells take what would leave the grid."""
    centres = jnp.clip(gain[0, 0] * jnp.asarray(grid.centres), grid.centres[0], grid.centres[-1])
    masses = jax.vmap(lambda m: gaussian_masses(grid, m, noise[0, 0]), out_axes=1)(centres)
    sd = jnp.sqrt(jnp.where(noise[0, 0] > 0, noise[0, 0], 1.0))
    outside = [jnp.where(noise[0, 0] > 0, jax.scipy.stats.norm.cdf(distance / sd), 0.0)
               for distance in (grid.low - centres, centres - grid.high)]
    masses = masses.at[0].add(outside[0]).at[-1].add(outside[1])
    return masses / masses.sum(axis=0)
