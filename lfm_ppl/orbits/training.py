"""The training of a satellite as a linear regression, for which the magnitudes of the small forces change quickly.

1. Departures from an orbit are linear in the joint state s_0 at the first time and in the noise that drives the forces.
   Neither response depends on the magnitudes.
2. The positions, all in one vector, are therefore

       y = m + O S s_0 + e,    s_0 ~ N(0, I),    e ~ N(0, sum_j q_j^2 K_j + NOISE^2 I),

   with m the response to the means of the forces, S the standard deviations at the start and q the noises.
3. m, O and K_j come from the affine maps of the filter, once.
4. Densities are algebra with matrices of 3 T rows: six to ten times as fast as the filter for three days, as fast for
   nine, since the cost is cubic in T. K takes 24 MB for three days and 215 MB for nine.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular

from lfm_ppl.filtering.forward import forward
from lfm_ppl.filtering.moments import Record, compose
from lfm_ppl.filtering.problem import filter_problem
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.filtering.update import GaussianUpdate
from lfm_ppl.forces import Force, RandomWalk, Resonator
from lfm_ppl.forces.sde import Sum
from lfm_ppl.linearisation.taylor import Taylor
from lfm_ppl.model.gaussian import Gaussian
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation import GaussianObservation
from lfm_ppl.model.state_space import state_space
from lfm_ppl.orbits import magnitudes
from lfm_ppl.orbits.arc import NOISE, Arc
from lfm_ppl.orbits.deterministic import Orbit
from lfm_ppl.orbits.deviations import Neighbourhood, departure
from lfm_ppl.orbits.environment import NANO
from lfm_ppl.orbits.satellite import START_SD
from lfm_ppl.utils import gaussian_residuals
from lfm_ppl.utils.gaussian_residuals import masked
from lfm_ppl.utils.linalg import matmul, solve_lower

_LONGEST = 0.5
"""Hours between positions in learning; closer positions add little information."""
_LARGEST = 60.0
"""Logarithm of a magnitude that counts as infinite: a force of 1e26 nm/s^2."""
_STEP = 0.25
"""Longest integration step of a departure (h): its error is 3e-3 of the departure after two days, a quarter of the
step one of 3e-6."""


class Training(NamedTuple):
    """The training as departures from an orbit.

    Attributes:
        neighbourhood: the orbit, at these times.
        times: (T,) hours.
        y: (T, 3) km, NaN where missing.
        axes: axes of the small forces.
        mean: (3 T,), m, the expected departures.
        start: (3 T, n), the response O of all positions to the joint state at the first time: position and velocity,
            the levels of all axes, then two states for each resonator.
        noise: (J, 3 T, 3 T), covariances K_j of all positions by noises of size one: the white noise of the
            acceleration, the drifts of the levels that have one, then the noise of each resonator.
    """

    neighbourhood: Neighbourhood
    times: np.ndarray
    y: np.ndarray
    axes: str
    mean: jax.Array
    start: jax.Array
    noise: jax.Array

    @classmethod
    def of(cls, arc: Arc, orbit: Orbit, axes: str) -> Training:
        """Return the training of a satellite, thinned to half an hour from one position to the next."""
        interval = float(arc.times[1] - arc.times[0])
        thin = max(1, int(_LONGEST / interval + 1e-9))
        times = arc.times[:arc.train:thin]
        neighbourhood = Neighbourhood.of(arc.environment, orbit, times, axes, nodes=2 * steps_of(times))
        y = arc.positions[:arc.train:thin] - np.asarray(neighbourhood.path[:, :3])
        return cls.along(neighbourhood, times, y, axes)

    @classmethod
    def along(cls, neighbourhood: Neighbourhood, times: np.ndarray, y: np.ndarray, axes: str) -> Training:
        """Return the training on these departures y (T, 3)."""
        return cls(neighbourhood, times, y, axes, *_responses(neighbourhood, times, axes))

    @property
    def regression(self) -> Regression:
        """The arrays that densities of positions depend on."""
        return Regression(self.start, self.noise, jnp.asarray(self.y) - self.mean.reshape(-1, 3))


class Regression(NamedTuple):
    """The arrays of `Training` for compiled code, and the positions (T, 3) minus their mean."""

    start: jax.Array
    noise: jax.Array
    y: jax.Array


def steps_of(times: np.ndarray, step: float = _STEP) -> int:
    """Return integration steps between two times."""
    return max(1, int(np.ceil((times[1] - times[0]) / step - 1e-9)))


def departing(logarithms: jax.Array, neighbourhood: Neighbourhood, axes: str) -> LatentForceModel:
    """Return the model of departures with these magnitudes."""
    forces, white = magnitudes.forces(logarithms, axes, neighbourhood.period)
    return departure(neighbourhood, forces, white, NOISE)


def _terms(forces: dict[str, Force]) -> tuple[list[tuple[int, Any]], list[tuple[int, Any]]]:
    """Return the levels and the resonators of which the small forces are sums, each with the index of its axis."""
    terms = [(axis, term) for axis, force in enumerate(forces.values())
             for term in (force.forces if isinstance(force, Sum) else (force,))]
    resonators = [(axis, term) for axis, term in terms if isinstance(term, Resonator)]
    return [(axis, term) for axis, term in terms if not isinstance(term, Resonator)], resonators


def scales(logarithms: jax.Array, axes: str) -> tuple[jax.Array, jax.Array]:
    """Return the standard deviations S (n,) at the first time, and the noises q (J,), in the order of `Training`."""
    forces, white = magnitudes.forces(logarithms, axes, period=1.0)  # sizes do not depend on it
    levels, resonators = _terms(forces)
    start = [*np.repeat(START_SD, 3)]
    start += [force.initial_sd if isinstance(force, RandomWalk) else force.scale for _, force in levels]
    start += [force.scale for _, force in resonators for _ in range(2)]
    drifts = [force.scale for _, force in levels if isinstance(force, RandomWalk)]
    return jnp.stack(start), jnp.stack([white, *drifts, *(force.noise for _, force in resonators)])


def _responses(neighbourhood: Neighbourhood, times: np.ndarray, axes: str) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return m, O and K of `Training`, one force at a time: forces do not interact."""
    levels, resonators = _terms(
        magnitudes.forces(jnp.asarray(magnitudes.wide(axes).mean), axes, neighbourhood.period)[0]
    )
    along = np.eye(len(neighbourhood.on_orbit))
    fixed = tuple(times)
    # White noise goes first, with a level that does not drift.
    noises = np.array([0.0, *(1.0 for _ in levels)])
    by_level, level_noise = _response(
        neighbourhood, along[[0, *(axis for axis, _ in levels)]], None, noises, 1.0 - noises, fixed
    )
    periods = np.array([float(force.period) for _, force in resonators])
    by_resonator, resonator_noise = _response(neighbourhood, along[[axis for axis, _ in resonators]], periods,
                                              np.ones(len(periods)), np.zeros(len(periods)), fixed)
    start = [by_level[0, :, :6], *by_level[1:, :, 6:], *by_resonator[:, :, 6:]]
    drifting = [index for index, (_, force) in enumerate(levels, 1) if isinstance(force, RandomWalk)]
    # A level responds to its mean, minus the force of the orbit, as to its first state.
    means = jnp.stack([force.mean_at(times[0]) - neighbourhood.on_orbit[axis] for axis, force in levels])
    return (jnp.tensordot(means, by_level[1:, :, 6], axes=1), jnp.concatenate(start, axis=1),
            jnp.concatenate([level_noise[np.array([0, *drifting])], resonator_noise]))


@functools.partial(jax.jit, static_argnums=(5,))
def _response(neighbourhood: Neighbourhood, axes: jax.Array, periods: jax.Array | None, noises: jax.Array,
              whites: jax.Array, times: tuple) -> tuple[jax.Array, jax.Array]:
    """Return, for several forces of unit magnitude, the responses (K, 3 T, n) and the covariances (K, 3 T, 3 T).

    Args:
        neighbourhood: the orbit.
        axes: (K, R), directions of the forces.
        periods: (K,) of resonators; None: levels.
        noises: (K,) of the forces.
        whites: (K,) of the acceleration.
        times: hours.
    """
    time_array = np.array(times)

    def respond(inputs: tuple) -> tuple[jax.Array, jax.Array]:
        axis, period, noise, white = inputs
        force = RandomWalk(noise, 1.0) if period is None else Resonator(period, 1.0, noise)
        push = jnp.concatenate([jnp.zeros((3, 3)), NANO * white * jnp.eye(3)])
        system = LatentForceModel(
            lambda x, u, t: neighbourhood(x, neighbourhood.on_orbit + axis * u[0], t), {"force": force},
            GaussianObservation(lambda x, u, t: x[:3], sd=1.0), Gaussian(jnp.zeros(6), jnp.eye(6)),
            process_noise=push)
        return _position_covariances(system, time_array)

    return jax.lax.map(respond, (axes, periods, noises, whites))


def _position_covariances(system: LatentForceModel, times: np.ndarray) -> tuple[jax.Array, jax.Array]:
    """Return the response (3 T, n) of all positions to the first state, and their covariance (3 T, 3 T) by noise."""
    ssm = state_space(system)
    grid = build_time_grid(ssm, times, steps_of(times), None)
    nothing_observed = GaussianUpdate(jnp.full((len(times), 3), jnp.nan))
    trace = forward(filter_problem(ssm, Taylor(), grid), nothing_observed, record=Record.SMOOTHER)
    size, count = ssm.state_dim, len(times)

    def step(carry: tuple, row: tuple) -> tuple[tuple, tuple]:
        phi_so_far, covariance, cross = carry  # cross: covariances of the state with all positions up to now
        phi, noise, index = row
        phi_so_far, covariance = compose((phi_so_far, covariance), (phi, noise))
        cross = matmul(phi, cross.reshape(size, -1)).reshape(size, count, 3).at[:, index].set(covariance[:, :3])
        return (phi_so_far, covariance, cross), (phi_so_far[:3], cross[:3])

    first = (jnp.eye(size), jnp.zeros((size, size)), jnp.zeros((size, count, 3)))
    _, (response, lower) = jax.lax.scan(step, first, (trace.phi, trace.process_cov, jnp.arange(count)))
    lower = lower.reshape(3 * count, 3 * count)  # zero above the diagonal blocks, which are whole
    late = np.repeat(np.arange(count), 3)
    return response.reshape(3 * count, size), jnp.where(late[:, None] >= late[None, :], lower, lower.T)


class _Whitened(NamedTuple):
    """The first entries of the positions, whitened by the covariance of the noise.

    Attributes:
        chol: Cholesky factor L of the covariance.
        present: whether an entry is observed.
        start: L^-1 O S.
        y: L^-1 y.
        usable: whether L exists; if not, the factor of the identity takes its place.
    """

    chol: jax.Array
    present: jax.Array
    start: jax.Array
    y: jax.Array
    usable: jax.Array


def _root(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the Cholesky factor and whether it exists; if not, the identity, for finite gradients."""
    usable = jnp.isfinite(jnp.linalg.cholesky(jax.lax.stop_gradient(matrix))).all()
    return jnp.linalg.cholesky(jnp.where(usable, matrix, jnp.eye(len(matrix)))), usable


def _moments(logarithms: jax.Array, data: Regression, axes: str) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return O S (3 T, n), the covariance of the noise (3 T, 3 T), and whether the magnitudes are finite."""
    usable = (logarithms < _LARGEST).all()
    start, noise = scales(jnp.where(usable, logarithms, 0.0), axes)
    return data.start * start, jnp.tensordot(noise**2, data.noise, axes=1), usable


def _whitened(data: Regression, start: jax.Array, covariance: jax.Array, count: int) -> _Whitened:
    """Whiten the first ``count`` entries of the positions."""
    y = data.y.ravel()[:count]
    present = jnp.isfinite(y)
    y, covariance = masked(y, covariance[:count, :count] + NOISE**2 * jnp.eye(count), present)
    chol, usable = _root(covariance)
    columns = jnp.concatenate([start[:count], y[:, None]], axis=1)
    solved = solve_triangular(chol, jnp.where(present[:, None], columns, 0.0), lower=True)
    return _Whitened(chol, present, solved[:, :-1], solved[:, -1], usable)


def log_likelihood(logarithms: jax.Array, data: Regression, axes: str) -> jax.Array:
    """Return the log density of all positions; -inf, with gradient zero, where it cannot be computed."""
    start, covariance, usable = _moments(logarithms, data, axes)
    white = _whitened(data, start, covariance, data.y.size)
    root, is_factorised = _root(jnp.eye(start.shape[1]) + white.start.T @ white.start)
    state = solve_triangular(root, solve_triangular(root, white.start.T @ white.y, lower=True), lower=True, trans=1)
    residual = white.y - white.start @ state
    value = (gaussian_residuals.log_density(residual, white.chol, white.present)
             + gaussian_residuals.log_density(state, root, jnp.zeros(state.shape)))
    return jnp.where(usable & white.usable & is_factorised, value, -jnp.inf)


def held_out(logarithms: jax.Array, data: Regression, axes: str) -> jax.Array:
    """Return the mean log density of a predicted position: from the first third, plus from two thirds.

    Where it cannot be computed it is -inf, with gradient zero.
    """
    start, covariance, usable = _moments(logarithms, data, axes)
    count = len(data.y)
    folds = count // 3, 2 * count // 3
    white = _whitened(data, start, covariance, 3 * folds[-1])
    is_observed = jnp.isfinite(data.y).all(axis=1)
    early = 3 * folds[0]
    across = solve_triangular(white.chol, jnp.where(white.present[:, None], covariance[:3 * folds[-1], early:], 0.0),
                              lower=True)
    own_covariance = jnp.moveaxis(jnp.diagonal(covariance.reshape(count, 3, count, 3), axis1=0, axis2=2), 2, 0)
    total, usable = jnp.zeros(()), usable & white.usable
    for seen in folds:  # what is seen first is whitened alike in both
        some = slice(None, 3 * seen)
        later, first, y = across[some, 3 * seen - early:], white.start[some], white.y[some]
        root, is_factorised = _root(jnp.eye(start.shape[1]) + first.T @ first)
        state_factor = solve_triangular(root, (start[3 * seen:] - later.T @ first).T, lower=True)
        mean = later.T @ y + state_factor.T @ solve_triangular(root, first.T @ y, lower=True)
        reduced, added = (part.reshape(-1, count - seen, 3) for part in (later, state_factor))
        held_out_covariance = (own_covariance[seen:] - jnp.einsum("mti,mtj->tij", reduced, reduced)
                               + jnp.einsum("mti,mtj->tij", added, added))
        error = jnp.where(is_observed[seen:, None], data.y[seen:], 0.0) - mean.reshape(-1, 3)
        density = jnp.where(is_observed[seen:], log_density(error, held_out_covariance), 0.0)
        total, usable = total + density.sum() / jnp.maximum(is_observed[seen:].sum(), 1), usable & is_factorised
    return jnp.where(usable & jnp.isfinite(total), total, -jnp.inf)


def log_density(error: jax.Array, covariance: jax.Array) -> jax.Array:
    """Return the log density (T,) of errors (T, 3) whose covariance is (T, 3, 3) and that of the positions."""
    chol = jnp.linalg.cholesky(covariance + NOISE**2 * jnp.eye(3))
    return gaussian_residuals.log_density(jax.vmap(solve_lower)(chol, error), chol)


slope_of_log_likelihood: Any = functools.partial(jax.jit, static_argnums=(2,))(jax.value_and_grad(log_likelihood))
slope_of_held_out: Any = functools.partial(jax.jit, static_argnums=(2,))(jax.value_and_grad(held_out))
