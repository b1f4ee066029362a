"""A model with a one-dimensional state on the cells of a grid: rates, masses and likelihoods as arrays.

1. Drift and diffusion at the faces of the cells give the rates of a birth-death process (`finite_volume`).
2. Rates that depend on time are evaluated at the middle of each step.
3. Observation function and noise are evaluated at the nodes of each cell.
4. A jump of a force is a transition matrix between cells.

Source: Chang and Cooper (1970), Journal of Computational Physics 6.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.intervals import TimeGrid, as_arrays
from lfm_ppl.fokker_planck_grid.finite_volume import BirthDeathProcess, Grid, birth_death_process, gaussian_masses
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.model.structure import pattern

NODES, WEIGHTS = np.polynomial.legendre.leggauss(5)
"""Gauss-Legendre rule on [-1, 1] for averages of likelihoods over a cell."""


class Cells(eqx.Module):
    """A model on the cells of a grid.

    Attributes:
        process: rates (N,), or (rows, steps, N) if drift or dispersion depend on time.
        jumps: (J, N, N), transition matrices of the jumps of the forces; None without jumps.
        initial: (N,), masses at the initial time, without the probability outside of the grid.
        value: (T, N, G, D), observation function h at G nodes in each cell; (1, N, G, D) if it is the same for all
            observations.
        noise: (T, N, G, D, D), noise covariance R at the nodes, with axes of length one where it does not vary.
        angular: (D,), whether a component of y is an angle.
        period: period of the angles.
    """

    process: BirthDeathProcess
    jumps: Any
    initial: jax.Array
    value: jax.Array
    noise: jax.Array
    angular: jax.Array
    period: Any


def varies_with_time(ssm: StateSpaceModel) -> bool:
    """Return whether drift or dispersion depend on time."""
    if ssm.physical_dim == 0:
        return False
    noise = ssm.model.process_noise
    size = ssm.physical_dim
    if ssm.drift_structure.offset_varies or not callable(noise):
        return ssm.drift_structure.offset_varies
    structure = pattern(lambda v: jnp.ravel(jnp.asarray(noise(v[:size], v[size:size], v[size]), float)), size + 1)
    return bool(structure.jacobian[:, size].any())


def on_grid(ssm: StateSpaceModel, time_grid: TimeGrid, grid: Grid, padded_cells: int = 0) -> Cells:
    """Evaluate a model with a one-dimensional state on a grid.

    Args:
        ssm: the model, of state dimension one.
        time_grid: the time grid of the scan.
        grid: the cells.
        padded_cells: pad the grid to this number of cells before the model's functions are evaluated, and drop the
            padding afterwards. Outside compiled code, grids of different sizes then share their compiled operations.
    """
    mean, covariance = ssm.initial()
    jumps = None
    if ssm.stack.jump_times:
        jumps = jnp.stack([_jump(grid, *ssm.stack.jump(index)) for index in range(len(ssm.stack.jump_times))])
    value, noise = _observations(ssm, time_grid, grid, padded_cells)
    angular = np.isin(np.arange(ssm.output_dim), ssm.model.observation.angular)
    return Cells(_processes(ssm, time_grid, grid, padded_cells), jumps,
                 gaussian_masses(grid, mean[0], covariance[0, 0]), value, noise, jnp.asarray(angular),
                 jnp.asarray(ssm.model.observation.period, float))


def drift_and_diffusion(ssm: StateSpaceModel, s: jax.Array, t: Any) -> tuple[jax.Array, jax.Array]:
    """Return b and D = g^2 / 2 of the one-dimensional state, scalars."""
    if ssm.physical_dim == 0:
        return ssm.stack.feedback()[0, 0] * s, 0.5 * (ssm.stack.dispersion() ** 2).sum() + 0.0 * s
    w = jnp.reshape(s, (1,))
    dispersion = ssm.dispersion(w, t)
    assert dispersion is not None  # models without process noise are rejected before
    return ssm.drift(w, t)[0], 0.5 * (jnp.asarray(dispersion, float) ** 2).sum() + 0.0 * s


def _pad(points: np.ndarray, size: int) -> jax.Array:
    """Pad points to at least ``size`` entries by copies of the last one."""
    return jnp.asarray(np.pad(points, (0, max(size - len(points), 0)), mode="edge"))


def _processes(ssm: StateSpaceModel, time_grid: TimeGrid, grid: Grid, padded_cells: int) -> BirthDeathProcess:
    """Return the rates (N,), or (rows, steps, N) at the middle of each step if they depend on time."""
    faces = _pad(grid.edges[1:-1], padded_cells)

    def process_at(t: jax.Array) -> BirthDeathProcess:
        def velocity_and_diffusion(s: jax.Array) -> tuple[jax.Array, jax.Array]:
            diffusion, derivative = jax.jvp(lambda s: drift_and_diffusion(ssm, s, t)[1], (s,), (jnp.ones_like(s),))
            return drift_and_diffusion(ssm, s, t)[0] - derivative, diffusion

        velocity, diffusion = (a[: grid.cells - 1] for a in jax.vmap(velocity_and_diffusion)(faces))
        return birth_death_process(velocity, diffusion, grid.width)

    if not varies_with_time(ssm):
        return process_at(jnp.asarray(time_grid.initial_time, float))
    rows = as_arrays(time_grid.intervals)
    middle = (np.arange(time_grid.steps) + 0.5) / time_grid.steps
    times = jax.vmap(lambda row: row.span.time(row.length * middle))(rows)
    return jax.vmap(jax.vmap(process_at))(times)


def _observations(ssm: StateSpaceModel, time_grid: TimeGrid, grid: Grid,
                  padded_cells: int) -> tuple[jax.Array, jax.Array]:
    """Return observation function and noise covariance at the nodes, ``value`` and ``noise`` of `Cells`."""
    intervals, observed = as_arrays(time_grid.intervals), jnp.asarray(time_grid.observed)
    times, rows = intervals.end[observed], jnp.arange(observed.shape[0])
    nodes = _pad(grid.centres, padded_cells)[:, None] + 0.5 * grid.width * NODES
    observation = ssm.model.observation
    has_constant_inputs = ssm.constant_measurement and ssm.constant_mean
    is_value_per_row = ssm.observation_structure.offset_varies or not has_constant_inputs
    is_noise_per_node = observation.varies_with_state
    if is_noise_per_node:
        is_noise_per_row = not has_constant_inputs or _is_noise_time_dependent(ssm)
    else:
        is_noise_per_row = jnp.ndim(observation.covariance) == 3

    def inputs(s: jax.Array, t: jax.Array) -> jax.Array:
        matrix, offset = ssm.input_map(t)
        return matrix[:, 0] * s + offset

    def evaluate(function: Any, is_per_row: bool, is_per_node: bool) -> jax.Array:
        points = nodes if is_per_node else nodes[:1, :1]

        def at_nodes(t: jax.Array, row: jax.Array) -> jax.Array:
            return jax.vmap(jax.vmap(lambda s: function(inputs(s, t), t, row)))(points)

        return jax.vmap(at_nodes)(*((times, rows) if is_per_row else (times[:1], rows[:1])))[:, : grid.cells]

    value = evaluate(lambda w, t, row: ssm.observe(w, t), is_value_per_row, True)
    return value, evaluate(ssm.obs_cov, is_noise_per_row, is_noise_per_node)


def _is_noise_time_dependent(ssm: StateSpaceModel) -> bool:
    """Return whether the observation covariance, a function of (x, u, t), depends on t."""
    size, total = ssm.physical_dim, ssm.input_dim
    covariance = ssm.model.observation.covariance
    structure = pattern(
        lambda v: jnp.ravel(jnp.asarray(covariance(v[:size], v[size:total], v[total]), float)), total + 1)
    return bool(structure.jacobian[:, total].any())


def _jump(grid: Grid, gain: jax.Array, noise: jax.Array) -> jax.Array:
    """Return the transition matrix of s <- G s + N(0, Q); probability outside of the grid goes to the end cells."""
    centres = jnp.clip(gain[0, 0] * jnp.asarray(grid.centres), grid.centres[0], grid.centres[-1])
    masses = jax.vmap(lambda m: gaussian_masses(grid, m, noise[0, 0]), out_axes=1)(centres)
    sd = jnp.sqrt(jnp.where(noise[0, 0] > 0, noise[0, 0], 1.0))
    mass_below, mass_above = (jnp.where(noise[0, 0] > 0, jax.scipy.stats.norm.cdf(distance / sd), 0.0)
                              for distance in (grid.low - centres, centres - grid.high))
    masses = masses.at[0].add(mass_below).at[-1].add(mass_above)
    return masses / masses.sum(axis=0)
