"""The training of a satellite as a linear regression, in which the magnitudes of the small forces are quick to change.

Departures from an orbit are linear in the joint state s_0 at the first time and in the noise that drives the forces,
and neither response depends on the magnitudes. So the positions, all in one vector, are

    y = m + O S s_0 + e,    s_0 ~ N(0, I),    e ~ N(0, sum_j q_j^2 K_j + NOISE^2 I),

with m what the forces' means make, S the standard deviations at the start and q the noises. m, O and K_j come from the
affine maps of the filter, once for a satellite; what follows is algebra with matrices of a few hundred rows, ten times
as fast as the filter itself.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular

from lfm_ppl import orbits
from lfm_ppl.experiments.gps import magnitudes
from lfm_ppl.experiments.gps.problem import NOISE, Arc
from lfm_ppl.filtering.filter import forward
from lfm_ppl.filtering.schedule import schedule
from lfm_ppl.forces import Constant, Force, RandomWalk, Resonator
from lfm_ppl.forces.sum import Sum
from lfm_ppl.linalg import congruence, matmul, solve_lower
from lfm_ppl.linearisation.taylor import Taylor
from lfm_ppl.model.augment import state_space
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation import Gaussian, GaussianObservation

_LONGEST = 0.5
"""Hours from one position to the next in learning; closer ones say the same."""
_STEP = 0.25
"""Longest integration step of a departure (h): its error is 3e-3 of the departure after two days, a quarter of the
step one of 3e-6."""


class Training(NamedTuple):
    """The training as departures from an orbit.

    Attributes:
        near: the orbit, at these times.
        times: (T,) hours.
        y: (T, 3) km, NaN where missing.
        axes: of the small forces.
        mean: (3 T,), m: all positions where nothing is but the means of the forces.
        start: (3 T, n), the response O of all positions to the joint state at the first time.
        noise: (J, 3 T, 3 T), their covariances K by noise.
    """

    near: orbits.Neighbourhood
    times: np.ndarray
    y: np.ndarray
    axes: str
    mean: jax.Array
    start: jax.Array
    noise: jax.Array

    @property
    def regression(self) -> Regression:
        """What the densities of positions depend on."""
        return Regression(self.start, self.noise, jnp.asarray(self.y) - self.mean.reshape(-1, 3))


class Regression(NamedTuple):
    """The part of `Training` that compiled code takes, and the positions (T, 3) less their mean."""

    start: jax.Array
    noise: jax.Array
    y: jax.Array


def training(one: Arc, orbit: orbits.Orbit, axes: str) -> Training:
    """Return the training of a satellite, thinned to half an hour from one position to the next."""
    interval = float(one.times[1] - one.times[0])
    thin = max(1, int(_LONGEST / interval + 1e-9))
    times = one.times[:one.train:thin]
    near = orbits.Neighbourhood.of(one.environment, orbit, times, axes, nodes=2 * steps_of(times))
    y = one.positions[:one.train:thin] - np.asarray(near.path[:, :3])
    return Training(near, times, y, axes, *_responses(near, times, axes))


def steps_of(times: np.ndarray, step: float = _STEP) -> int:
    """Return integration steps between two times."""
    return max(1, int(np.ceil((times[1] - times[0]) / step - 1e-9)))


def departing(logarithms: jax.Array, near: orbits.Neighbourhood, axes: str) -> LatentForceModel:
    """Return the model of departures with these magnitudes."""
    forces, white = magnitudes.forces(logarithms, axes)
    return orbits.departure(near, forces, white, NOISE)


def _members(forces: dict[str, Force]) -> Iterator[tuple[int, Force]]:
    """Yield the index of an axis and a force along it, a level or a resonator: all levels first."""
    every = [(axis, one) for axis, force in enumerate(forces.values())
             for one in (force.forces if isinstance(force, Sum) else (force,))]
    yield from (pair for pair in every if not isinstance(pair[1], Resonator))
    yield from (pair for pair in every if isinstance(pair[1], Resonator))


def scales(logarithms: jax.Array, axes: str) -> tuple[jax.Array, jax.Array]:
    """Return the standard deviations S (n,) at the first time, and the noises q (J,), in the order of `Training`."""
    forces, white = magnitudes.forces(logarithms, axes)
    start, noise = [*np.repeat(orbits.START_SD, 3)], [white]
    for _, force in _members(forces):
        if isinstance(force, Resonator):
            start, noise = [*start, force.scale, force.scale], [*noise, force.noise]
        elif isinstance(force, RandomWalk):
            start, noise = [*start, force.initial_sd], [*noise, force.scale]
        elif isinstance(force, Constant):
            start = [*start, force.scale]
        else:
            raise TypeError(f"a small force is a level or a resonator, got {type(force).__name__}.")
    return jnp.stack(start), jnp.stack(noise)


def _responses(near: orbits.Neighbourhood, times: np.ndarray, axes: str) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return m, O and K of `Training`: those of one force at a time, as forces do not see one another."""
    members = list(_members(magnitudes.forces(jnp.asarray(magnitudes.wide(axes).mean), axes)[0]))
    along = np.eye(len(near.on_orbit))
    levels = [(axis, force) for axis, force in members if not isinstance(force, Resonator)]
    resonators = [(axis, force) for axis, force in members if isinstance(force, Resonator)]
    fixed = tuple(times)
    # The white noise goes with a level that has none: the first one, whose noise is taken out.
    axis_of = along[[0, *(axis for axis, _ in levels)]]
    quiet = np.array([0.0, *(1.0 for _ in levels)])
    by_level, level_noise = _response(near, axis_of, None, quiet, 1.0 - quiet, fixed)
    periods = np.array([float(force.period) for _, force in resonators])
    by_resonator, resonator_noise = _response(near, along[[axis for axis, _ in resonators]], periods,
                                              np.ones(len(periods)), np.zeros(len(periods)), fixed)
    start = [by_level[0, :, :6], *by_level[1:, :, 6:], *by_resonator[:, :, 6:]]
    drifting = [index for index, (_, force) in enumerate(levels, 1) if isinstance(force, RandomWalk)]
    # A level responds to its mean, less what pushes on the orbit already, as it does to its first state.
    means = jnp.stack([force.mean_at(times[0]) - near.on_orbit[axis] for axis, force in levels])
    return (jnp.tensordot(means, by_level[1:, :, 6], axes=1), jnp.concatenate(start, axis=1),
            jnp.concatenate([level_noise[np.array([0, *drifting])], resonator_noise]))


@functools.partial(jax.jit, static_argnums=(5,))
def _response(near: orbits.Neighbourhood, axes: jax.Array, periods: jax.Array | None, noises: jax.Array,
              whites: jax.Array, times: tuple) -> tuple[jax.Array, jax.Array]:
    """Return, for several forces of unit magnitude, the responses (K, 3 T, n) and the covariances (K, 3 T, 3 T).

    Args:
        near: the orbit.
        axes: (K, R), directions of the forces.
        periods: (K,) of resonators; None: levels.
        noises: (K,) of the forces.
        whites: (K,) of the acceleration.
        times: hours.
    """
    at = np.array(times)

    def one(inputs: tuple) -> tuple[jax.Array, jax.Array]:
        axis, period, noise, white = inputs
        force = RandomWalk(noise, 1.0) if period is None else Resonator(period, 1.0, noise)
        push = jnp.concatenate([jnp.zeros((3, 3)), orbits.NANO * white * jnp.eye(3)])
        system = LatentForceModel(
            lambda x, u, t: near(x, near.on_orbit + axis * u[0], t), {"force": force},
            GaussianObservation(lambda x, u, t: x[:3], jnp.ones(3)), Gaussian(jnp.zeros(6), jnp.eye(6)),
            process_noise=push)
        return _spread(system, at)

    return jax.lax.map(one, (axes, periods, noises, whites))


def _spread(system: LatentForceModel, times: np.ndarray) -> tuple[jax.Array, jax.Array]:
    """Return the response (3 T, n) of all positions to the first state, and their covariance (3 T, 3 T) by noise."""
    ssm = state_space(system)
    plan = schedule(ssm, times, steps_of(times), None)
    passed = forward(ssm, Taylor(), plan, jnp.full((len(times), 3), jnp.nan), keep="all")
    size, count = ssm.state_dim, len(times)

    def step(carry: tuple, row: tuple) -> tuple[tuple, tuple]:
        flow, spread, cross = carry
        phi, noise, observed = row
        flow, spread = matmul(phi, flow), congruence(phi, spread) + noise
        cross = matmul(phi, cross.reshape(size, -1)).reshape(size, count, 3)
        cross = cross.at[:, observed].set(spread[:, :3], mode="drop")
        return (flow, spread, cross), (flow[:3], cross[:3])

    observed = np.full(len(passed.log_likelihood), count)
    observed[np.asarray(plan.observed)] = np.arange(count)
    first = (jnp.eye(size), jnp.zeros((size, size)), jnp.zeros((size, count, 3)))
    _, (response, lower) = jax.lax.scan(step, first, (passed.phi, passed.noise, jnp.asarray(observed)))
    rows = np.asarray(plan.observed)
    lower = lower[rows].reshape(3 * count, 3 * count)  # zero above the diagonal blocks, which are whole
    late = np.repeat(np.arange(count), 3)
    covariance = jnp.where(late[:, None] >= late[None, :], lower, lower.T)
    return response[rows].reshape(3 * count, size), covariance


class _Whitened(NamedTuple):
    """Some positions with the noise's covariance divided out: its root, and O S and y in its units."""

    chol: jax.Array
    start: jax.Array
    y: jax.Array


def _noise_covariance(data: Regression, noise: jax.Array) -> jax.Array:
    return jnp.tensordot(noise**2, data.noise, axes=1)


def _whitened(data: Regression, covariance: jax.Array, start: jax.Array, count: int) -> tuple[_Whitened, jax.Array]:
    """Whiten the first ``count`` entries of the positions; return also which of them there are."""
    y = data.y.ravel()[:count]
    present = jnp.isfinite(y)
    both = present[:, None] & present[None, :]
    chol = jnp.linalg.cholesky(jnp.where(both, covariance[:count, :count] + NOISE**2 * jnp.eye(count), jnp.eye(count)))
    known = jnp.concatenate([data.start[:count] * start, jnp.where(present, y, 0.0)[:, None]], axis=1)
    solved = solve_triangular(chol, jnp.where(present[:, None], known, 0.0), lower=True)
    return _Whitened(chol, solved[:, :-1], solved[:, -1]), present


def log_likelihood(logarithms: jax.Array, data: Regression, axes: str) -> jax.Array:
    """Return the log density of all positions, -inf where it cannot be computed."""
    start, noise = scales(logarithms, axes)
    white, present = _whitened(data, _noise_covariance(data, noise), start, data.y.size)
    root = jnp.linalg.cholesky(jnp.eye(len(start)) + white.start.T @ white.start)
    state = _solve_twice(root, white.start.T @ white.y)
    left = white.y - white.start @ state
    value = (-0.5 * (left @ left + state @ state) - jnp.log(jnp.diagonal(white.chol)).sum()
             - jnp.log(jnp.diagonal(root)).sum() - 0.5 * present.sum() * jnp.log(2 * jnp.pi))
    return jnp.where(jnp.isfinite(value), value, -jnp.inf)


def held_out(logarithms: jax.Array, data: Regression, axes: str) -> jax.Array:
    """Return the mean log density of a position that is predicted: from the first third, plus from two thirds."""
    start, noise = scales(logarithms, axes)
    covariance = _noise_covariance(data, noise)
    count = len(data.y)
    folds = count // 3, 2 * count // 3
    white, present = _whitened(data, covariance, start, 3 * folds[-1])
    known = jnp.isfinite(data.y).all(axis=1)
    early = 3 * folds[0]
    across = solve_triangular(white.chol, jnp.where(present[:, None], covariance[:3 * folds[-1], early:], 0.0),
                              lower=True)
    own = jnp.diagonal(covariance.reshape(count, 3, count, 3), axis1=0, axis2=2)  # (3, 3, T)
    total = jnp.zeros(())
    for seen in folds:  # what is seen first is whitened alike in both
        some = slice(None, 3 * seen)
        later = across[some, 3 * seen - early:]
        root = jnp.linalg.cholesky(jnp.eye(len(start)) + white.start[some].T @ white.start[some])
        left = solve_triangular(root, (data.start[3 * seen:] * start - later.T @ white.start[some]).T, lower=True)
        mean = later.T @ white.y[some] + left.T @ solve_triangular(root, white.start[some].T @ white.y[some],
                                                                  lower=True)
        reduced, added = (part.reshape(-1, count - seen, 3) for part in (later, left))
        spread = (jnp.moveaxis(own[:, :, seen:], 2, 0) - jnp.einsum("mti,mtj->tij", reduced, reduced)
                  + jnp.einsum("mti,mtj->tij", added, added))
        error = jnp.where(known[seen:, None], data.y[seen:], 0.0) - mean.reshape(-1, 3)
        density = jnp.where(known[seen:], log_density(error, spread), 0.0)
        total = total + density.sum() / jnp.maximum(known[seen:].sum(), 1)
    return total


def log_density(error: jax.Array, covariance: jax.Array) -> jax.Array:
    """Return the log density (T,) of errors (T, 3) whose covariance is (T, 3, 3) and that of the positions."""
    chol = jnp.linalg.cholesky(covariance + NOISE**2 * jnp.eye(3))
    white = jax.vmap(solve_lower)(chol, error)
    return (-0.5 * (white**2).sum(1) - jnp.log(jnp.diagonal(chol, axis1=1, axis2=2)).sum(1)
            - 1.5 * jnp.log(2 * jnp.pi))


def _solve_twice(root: jax.Array, right: jax.Array) -> jax.Array:
    return solve_triangular(root, solve_triangular(root, right, lower=True), lower=True, trans=1)


slope_of_log_likelihood: Any = functools.partial(jax.jit, static_argnums=(2,))(jax.value_and_grad(log_likelihood))
slope_of_held_out: Any = functools.partial(jax.jit, static_argnums=(2,))(jax.value_and_grad(held_out))
