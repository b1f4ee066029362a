"""The force by elliptical slice sampling, vectorised over data sets and chains.

1. Sample the force by elliptical slices of the likelihood L, with ellipses of the prior N(0, C), as in the source.
2. Stop for data sets whose R-hat is at most 1.01.
3. For the others, approximate L by a Gaussian likelihood l(u) = N(y; H u + b, S), linearised over the draws
   (`linearise_posterior`). Let N(m, P) be the posterior of the force under l.
4. Continue with ellipses of N(m, P) and slices of L/l. This leaves the posterior invariant, since N(u; 0, C) L(u) is
   proportional to N(u; m, P) L(u)/l(u). Steps are longer the closer l is to L.
5. Repeat from step 2, up to five stages in total.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import lfm_ppl as lfm
from lfm_ppl.inference.kernels.elliptical_slice import SliceState, elliptical_slice_step
from lfm_ppl.parallel.task import Result
from lfm_ppl.particles.normals import normals

from .. import scores
from ..tasks import stack_results
from ..timing import time_call
from . import problem

CHAINS = 4
STORED_DRAWS = 625
"""Stored draws of each chain, evenly spaced. Means and standard deviations use all draws."""

MONITORED = np.arange(6, problem.POINTS, 13)
"""The 28 grid points at which R-hat and effective sample sizes are computed."""

R_HAT, _STAGES = 1.01, 5
"""Largest R-hat of mixed chains, and largest number of stages."""

_LINEARIZATION_THINNING = 10
"""Distance of the stored draws that are used in the linearisation."""


class PosteriorApproximation(NamedTuple):
    """The Gaussian N(m, P) of a data set, and its likelihood l.

    Attributes:
        slope: H (39, 363).
        residual: y - b (39,).
        noise_root: lower triangular factor of S (39, 39).
        mean: m (363,).
        gain: C H' (H C H' + S)^-1 (363, 39).
    """

    slope: Any
    residual: Any
    noise_root: Any
    mean: Any
    gain: Any


class Point(NamedTuple):
    """A force u with the product H u, which avoids a matrix product at each point of an ellipse."""

    force: jax.Array
    linear: jax.Array


class Ellipses(NamedTuple):
    """Operations of a slice step: the `Point` of a force, its log L or log L/l, random draws, and the mean."""

    point: Callable[[jax.Array], Point]
    log_ratio: Callable[[Point], jax.Array]
    draw: Callable[[jax.Array], Point]
    mean: Point


def ellipses(latent: lfm.LatentGrid, y: jax.Array, gaussian: PosteriorApproximation | None) -> Ellipses:
    """Return the ellipses of a Gaussian approximation, or of the prior if there is none."""
    def point(u: jax.Array) -> Point:
        return Point(u, jnp.zeros(0) if gaussian is None else gaussian.slope @ u)

    def log_ratio(position: Point) -> jax.Array:
        value = latent.log_likelihood(position.force[None], y)
        if gaussian is None:
            return value
        z = jax.scipy.linalg.solve_triangular(gaussian.noise_root, gaussian.residual - position.linear, lower=True)
        return value + 0.5 * z @ z

    def white_noise(key: jax.Array, count: int) -> jax.Array:
        return normals(key, 2, (count + 1) // 2).ravel()[:count]

    def draw(key: jax.Array) -> Point:
        if gaussian is None:
            return point(latent.root[0] @ white_noise(key, problem.POINTS))
        # Matheron's rule: correct a draw of the prior by its simulated observation.
        first, second = jax.random.split(key)
        u = latent.root[0] @ white_noise(first, problem.POINTS)
        observation = gaussian.slope @ u + gaussian.noise_root @ white_noise(second, y.size)
        return point(u + gaussian.gain @ (gaussian.residual - observation))

    return Ellipses(point, log_ratio, draw, point(jnp.zeros(problem.POINTS) if gaussian is None else gaussian.mean))


def linearise_posterior(latent: lfm.LatentGrid, y: jax.Array, draws: jax.Array) -> PosteriorApproximation:
    """Return the Gaussian approximation by linearisation over draws (S, 363).

    H is the mean Jacobian of the expression x(u) at the observation times, b the mean of x(u) - H u, and S the
    observation noise and the covariance of x(u) - H u.
    """
    def output(u: jax.Array) -> jax.Array:
        return latent.state(u[None]).ravel()

    slope = jax.lax.map(jax.jacrev(output), draws).mean(axis=0)
    remainder = jax.vmap(output)(draws) - draws @ slope.T
    offset = remainder.mean(axis=0)
    noise = (remainder - offset).T @ (remainder - offset) / len(draws) + problem.NOISE**2 * jnp.eye(y.size)
    cross_covariance = latent.root[0] @ (slope @ latent.root[0]).T
    gain = jnp.linalg.solve(slope @ cross_covariance + noise, cross_covariance.T).T
    residual = y.ravel() - offset
    return PosteriorApproximation(slope, residual, jnp.linalg.cholesky(noise), gain @ residual, gain)


@eqx.filter_jit
def _linearise_posteriors(draws: jax.Array, link: str, gamma: jax.Array, rates: problem.Rates,
                          y: jax.Array) -> PosteriorApproximation:
    """Return `linearise_posterior` for N data sets with draws (N, S, 363)."""
    def linearise(rates: problem.Rates, *arrays: jax.Array) -> PosteriorApproximation:
        return linearise_posterior(problem.on_grid(link, gamma, rates), *arrays)

    return jax.vmap(linearise)(rates, y, draws)


def compute(settings: Mapping[str, Any], data: list[problem.DataSet], keys: jax.Array) -> Result:
    """Return posterior summaries of the force for N data sets, with one random key (N,) each.

    All chains of a data set together make ``settings["draws"]`` draws, including ``settings["burn_in"]`` discarded
    ones; both parts are rounded up to multiples of 2,500. Each further stage of the algorithm makes as many draws, and
    the draws before it become burn-in.

    Returns:
        ``mean``, ``sd``, ``low``, ``high`` (N, 363); ``draws``, the number of all draws; ``r_hat``, the largest R-hat,
        and ``ess``, the smallest bulk effective sample size, of stored draws at `MONITORED` points (all draws have a
        larger one); ``r_hat_first`` and CPU ``seconds`` of the first stage, without compilation; ``seconds_more`` of
        the other stages; (N,) each.
    """
    burn_in, recorded = (math.ceil(number / CHAINS / STORED_DRAWS)
                         for number in (settings["burn_in"], settings["draws"] - settings["burn_in"]))
    link, (gamma, *inputs) = settings["link"], problem.inputs(settings, data)
    remaining, gaussian, shape = np.arange(len(data)), None, (len(data), CHAINS)
    states = (jax.vmap(lambda key: jax.random.split(key, CHAINS))(keys), jnp.zeros((*shape, problem.POINTS)),
              jnp.full(shape, jnp.nan, float))
    result = {name: np.zeros(len(data)) for name in ("draws", "seconds", "seconds_more")}
    for stage in range(_STAGES):
        model = gamma, *problem.rows(inputs, remaining), gaussian
        time_call(_run, link, jnp.asarray(0), *model, *states)  # compiles
        burn_in_time, (states, _, _) = time_call(_run, link, jnp.asarray(burn_in), *model, *states)
        draw_time, (states, draws, sums) = time_call(_run, link, jnp.asarray(recorded), *model, *states)
        result["seconds_more" if stage else "seconds"][remaining] += (burn_in_time + draw_time) / len(remaining)
        result["draws"][remaining] += CHAINS * STORED_DRAWS * (burn_in + recorded)
        draws = np.asarray(draws)
        summary = _summarize(draws, np.asarray(sums) / (CHAINS * STORED_DRAWS * recorded))
        for name, value in summary.items():
            result.setdefault(name, np.zeros_like(value))[remaining] = value
        result.setdefault("r_hat_first", summary["r_hat"])
        unmixed = np.flatnonzero(~(summary["r_hat"] <= R_HAT))
        remaining, states = remaining[unmixed], problem.rows(states, unmixed)
        if not remaining.size or stage == _STAGES - 1:
            break
        sample = draws[unmixed].reshape(len(unmixed), -1, problem.POINTS)[:, ::_LINEARIZATION_THINNING]
        gaussian = _linearise_posteriors(jnp.asarray(sample), link, gamma, *problem.rows(inputs, remaining))
    return result


def _summarize(draws: np.ndarray, moments: np.ndarray) -> Result:
    """Return posterior summaries for stored draws (N, 4, 625, 363) and the first two moments (N, 2, 363) of all."""
    mean, square = np.moveaxis(moments, 1, 0)
    low, high = np.quantile(draws.reshape(len(draws), -1, problem.POINTS), [0.025, 0.975], axis=1)
    names = [*map(str, MONITORED)]
    diagnostics = stack_results([scores.diagnose(names, np.moveaxis(chains[..., MONITORED], -1, 0))
                                 for chains in draws])
    return {"mean": mean, "sd": np.sqrt(np.maximum(square - mean**2, 0.0)), "low": low, "high": high,
            "r_hat": diagnostics["r_hat"].max(axis=1), "ess": diagnostics["ess"].min(axis=1)}


@eqx.filter_jit
def _run(link: str, spacing: jax.Array, gamma: jax.Array, rates: problem.Rates, y: jax.Array,
         gaussian: PosteriorApproximation | None, *states: jax.Array) -> tuple:
    """Take ``spacing`` steps of every chain for each stored draw; new chains start from the prior.

    ``states`` are keys, positions and log ratios (N, 4, ...); the log ratio of a new chain is NaN.

    Returns:
        The states after the steps, stored draws (N, 4, 625, 363), and sums of all draws and of their squares (N, 2,
        363).
    """
    # All data sets share one factor of the prior covariance, so that prior draws are one matrix product.
    root = problem.on_grid(link, gamma, problem.rows(rates, 0)).root

    def run_data_set(rates: problem.Rates, y: jax.Array, gaussian: PosteriorApproximation | None,
                     *states: jax.Array) -> tuple:
        latent = eqx.tree_at(lambda grid: grid.root, problem.on_grid(link, gamma, rates), root)
        target = ellipses(latent, y, gaussian)

        def step(_: jax.Array, carry: tuple) -> tuple:
            key, state, sums = carry
            key, draw_key, step_key = jax.random.split(key, 3)
            state = elliptical_slice_step(step_key, state, target.draw(draw_key), target.log_ratio, target.mean)
            u = state.position.force
            return key, state, sums + jnp.stack([u, u**2])

        def segment(carry: tuple, _: None) -> tuple[tuple, jax.Array]:
            carry = jax.lax.fori_loop(0, spacing, step, carry)
            return carry, carry[1].position.force

        def chain(key: jax.Array, position: jax.Array, value: jax.Array) -> tuple:
            key, start_key = jax.random.split(key)
            prior_draw = root[0] @ normals(start_key, problem.POINTS, 2)[:, 0]
            start = target.point(jnp.where(jnp.isnan(value), prior_draw, position))
            state = SliceState(start, target.log_ratio(start), jnp.zeros((), int))
            (key, state, sums), paths = jax.lax.scan(
                segment, (key, state, jnp.zeros((2, problem.POINTS))), None, length=STORED_DRAWS)
            return (key, state.position.force, state.log_likelihood), paths, sums

        return jax.vmap(chain)(*states)

    states, paths, sums = jax.vmap(run_data_set)(rates, y, gaussian, *states)
    return states, paths, sums.sum(axis=1)
