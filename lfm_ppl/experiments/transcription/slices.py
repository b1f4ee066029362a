"""The force by elliptical slice sampling, many data sets and chains side by side.

The ellipses are those of the prior, as in the source, or of a Gaussian like the posterior. A posterior proportional to
N(u; 0, C) L(u) is also proportional to N(u; m, P) L(u)/l(u) where N(u; m, P) is the posterior of a Gaussian likelihood
l(u) = N(y; H u + b, S). Slices of L/l on ellipses of that Gaussian leave the same posterior invariant, and the nearer l
is to L the farther a step goes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.tasks import stack_results
from lfm_ppl.experiments.timing import time_call
from lfm_ppl.experiments.transcription import problem
from lfm_ppl.inference.kernels.elliptical_slice import SliceState, elliptical_slice_step
from lfm_ppl.latent_grid.latent_grid import LatentGrid
from lfm_ppl.particles.normals import normals

CHAINS = 4
KEPT = 625
"""Draws that are kept of each chain, evenly spaced. Means and standard deviations are of all."""

MONITORED = np.arange(6, problem.POINTS, 13)
"""The 28 points of the grid for which R-hat and effective sample sizes are computed."""

R_HAT, _STAGES = 1.01, 5
"""Largest R-hat of chains that have mixed, and how often others are run at most, first on ellipses of the prior."""

_USED = 10
"""One in so many of the kept draws serves to find the Gaussian."""


class Gaussian(NamedTuple):
    """A Gaussian like the posterior of a data set, and the likelihood l that makes it from the prior.

    H (39, 363), y - b (39,), the lower triangular factor of S (39, 39), m (363,), and C H' (H C H' + S)^-1 (363, 39).
    """

    slope: Any
    residual: Any
    noise_root: Any
    mean: Any
    gain: Any


class Point(NamedTuple):
    """A force, and H times it, so that l costs no product of matrices at each point of an ellipse."""

    force: jax.Array
    linear: jax.Array


class Ellipses(NamedTuple):
    """How to slice: `Point` of a force, its log L or log L/l, draws, and the mean, of the prior or of the Gaussian."""

    point: Callable[[jax.Array], Point]
    log_ratio: Callable[[Point], jax.Array]
    draw: Callable[[jax.Array], Point]
    mean: Point


def ellipses(latent: LatentGrid, y: jax.Array, gaussian: Gaussian | None) -> Ellipses:
    """Return the ellipses of a Gaussian; without one, those of the prior."""
    def point(u: jax.Array) -> Point:
        return Point(u, jnp.zeros(0) if gaussian is None else gaussian.slope @ u)

    def log_ratio(at: Point) -> jax.Array:
        value = latent.log_likelihood(at.force[None], y)
        if gaussian is None:
            return value
        z = jax.scipy.linalg.solve_triangular(gaussian.noise_root, gaussian.residual - at.linear, lower=True)
        return value + 0.5 * z @ z

    def white(key: jax.Array, count: int) -> jax.Array:
        return normals(key, 2, (count + 1) // 2).ravel()[:count]

    def draw(key: jax.Array) -> Point:
        if gaussian is None:
            return point(latent.root[0] @ white(key, problem.POINTS))
        # Matheron's rule: a draw of the prior, corrected by its observation.
        first, second = jax.random.split(key)
        u = latent.root[0] @ white(first, problem.POINTS)
        noisy = gaussian.slope @ u + gaussian.noise_root @ white(second, y.size)
        return point(u + gaussian.gain @ (gaussian.residual - noisy))

    return Ellipses(point, log_ratio, draw, point(jnp.zeros(problem.POINTS) if gaussian is None else gaussian.mean))


def resembling(latent: LatentGrid, y: jax.Array, draws: jax.Array) -> Gaussian:
    """Return the Gaussian of the posterior linearisation over draws (S, 363).

    H is the mean Jacobian of the expression x(u) at the observation times, b the mean of x(u) - H u, and S the
    observation noise and the covariance of x(u) - H u.
    """
    def output(u: jax.Array) -> jax.Array:
        return latent.state(u[None]).ravel()

    slope = jax.lax.map(jax.jacrev(output), draws).mean(axis=0)
    rest = jax.vmap(output)(draws) - draws @ slope.T
    offset = rest.mean(axis=0)
    noise = (rest - offset).T @ (rest - offset) / len(draws) + problem.NOISE**2 * jnp.eye(y.size)
    across = latent.root[0] @ (slope @ latent.root[0]).T
    gain = jnp.linalg.solve(slope @ across + noise, across.T).T
    residual = y.ravel() - offset
    return Gaussian(slope, residual, jnp.linalg.cholesky(noise), gain @ residual, gain)


@eqx.filter_jit
def _gaussians(draws: jax.Array, link: str, gamma: jax.Array, rates: problem.Rates, y: jax.Array) -> Gaussian:
    """Return `resembling` of data sets; draws (N, S, 363)."""
    return jax.vmap(lambda known, *own: resembling(problem.on_grid(link, gamma, known), *own))(rates, y, draws)


def compute(settings: Mapping[str, Any], data: list[problem.DataSet], keys: jax.Array) -> Result:
    """Return ``mean``, ``sd``, ``low``, ``high`` (N, 363), and ``r_hat``, ``ess``, ``draws`` and ``seconds`` (N,).

    ``keys`` (N,) are those of the data sets. The draws of all chains together number ``settings["draws"]``, of which
    ``settings["burn_in"]`` are left out; both parts are rounded up to multiples of 2,500. The chains of a data set
    whose R-hat is above 1.01 then run as long once more, on ellipses of a Gaussian that resembles the posterior (see
    `resembling`), and what was before becomes burn-in. ``draws`` counts all of them, ``seconds`` is the CPU time of the
    first run, without compilation, and ``r_hat_first`` its R-hat, ``seconds_more`` the time of the others. R-hat is the
    largest and ``ess``, in bulk, the smallest of the kept draws at `MONITORED` points; that of all draws is larger.
    """
    burn_in, ahead = (math.ceil(number / CHAINS / KEPT)
                      for number in (settings["burn_in"], settings["draws"] - settings["burn_in"]))
    link, (gamma, *given) = settings["link"], problem.inputs(settings, data)
    left, around, shape = np.arange(len(data)), None, (len(data), CHAINS)
    states = (jax.vmap(lambda key: jax.random.split(key, CHAINS))(keys), jnp.zeros((*shape, problem.POINTS)),
              jnp.full(shape, jnp.nan, float))
    found = {name: np.zeros(len(data)) for name in ("draws", "seconds", "seconds_more")}
    for stage in range(_STAGES):
        fixed = gamma, *problem.rows(given, left), around
        time_call(_run, link, jnp.asarray(0), *fixed, *states)  # compiles
        first, (states, _, _) = time_call(_run, link, jnp.asarray(burn_in), *fixed, *states)
        second, (states, kept, sums) = time_call(_run, link, jnp.asarray(ahead), *fixed, *states)
        found["seconds_more" if stage else "seconds"][left] += (first + second) / len(left)
        found["draws"][left] += CHAINS * KEPT * (burn_in + ahead)
        kept, (mean, square) = np.asarray(kept), np.moveaxis(np.asarray(sums), 1, 0) / (CHAINS * KEPT * ahead)
        flat = kept.reshape(len(left), -1, problem.POINTS)
        low, high = np.quantile(flat, [0.025, 0.975], axis=1)
        checked = stack_results([scores.diagnose([*map(str, MONITORED)], np.moveaxis(draws[..., MONITORED], -1, 0))
                                 for draws in kept])
        r_hat = checked["r_hat"].max(axis=1)
        for name, value in {"mean": mean, "sd": np.sqrt(np.maximum(square - mean**2, 0.0)), "low": low, "high": high,
                            "r_hat": r_hat, "ess": checked["ess"].min(axis=1)}.items():
            found.setdefault(name, np.zeros_like(value))[left] = value
        found.setdefault("r_hat_first", r_hat)
        unmixed = np.flatnonzero(~(r_hat <= R_HAT))
        left, states = left[unmixed], problem.rows(states, unmixed)
        if not left.size or stage == _STAGES - 1:
            break
        around = _gaussians(jnp.asarray(flat[unmixed, ::_USED]), link, gamma, *problem.rows(given, left))
    return found


@eqx.filter_jit
def _run(link: str, apart: jax.Array, gamma: jax.Array, rates: problem.Rates, y: jax.Array, around: Gaussian | None,
         *states: jax.Array) -> tuple:
    """Take steps of every chain, ``apart`` of them to each of the kept draws; fresh chains start from the prior.

    ``states`` are keys, positions and log ratios (N, 4, ...), the last NaN where fresh. Returns the states after, kept
    draws (N, 4, 625, 363), and sums of all draws and of their squares (N, 2, 363).
    """
    # One factor of the prior for all data sets, so that prior draws are one product of matrices.
    root = problem.on_grid(link, gamma, problem.rows(rates, 0)).root

    def of_data_set(rates: problem.Rates, y: jax.Array, around: Gaussian | None, *states: jax.Array) -> tuple:
        latent = eqx.tree_at(lambda grid: grid.root, problem.on_grid(link, gamma, rates), root)
        own = ellipses(latent, y, around)

        def step(_: jax.Array, carry: tuple) -> tuple:
            key, state, sums = carry
            key, draw, move = jax.random.split(key, 3)
            state = elliptical_slice_step(move, state, own.draw(draw), own.log_ratio, own.mean)
            u = state.position.force
            return key, state, sums + jnp.stack([u, u**2])

        def segment(carry: tuple, _: None) -> tuple[tuple, jax.Array]:
            carry = jax.lax.fori_loop(0, apart, step, carry)
            return carry, carry[1].position.force

        def chain(key: jax.Array, position: jax.Array, value: jax.Array) -> tuple:
            key, first = jax.random.split(key)
            start = own.point(jnp.where(jnp.isnan(value), root[0] @ normals(first, problem.POINTS, 2)[:, 0], position))
            state = SliceState(start, own.log_ratio(start), jnp.zeros((), int))
            (key, state, sums), paths = jax.lax.scan(
                segment, (key, state, jnp.zeros((2, problem.POINTS))), None, length=KEPT)
            return (key, state.position.force, state.log_likelihood), paths, sums

        return jax.vmap(chain)(*states)

    states, paths, sums = jax.vmap(of_data_set)(rates, y, around, *states)
    return states, paths, sums.sum(axis=1)
