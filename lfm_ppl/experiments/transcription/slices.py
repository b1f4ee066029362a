"""The force by elliptical slice sampling, many data sets and chains side by side."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from lfm_ppl.analysis import arviz_data
from lfm_ppl.comparators.elliptical_slice import SliceState, elliptical_slice_step
from lfm_ppl.comparators.latent_grid import LatentGrid
from lfm_ppl.comparators.normals import normals
from lfm_ppl.experiments.timing import timed
from lfm_ppl.experiments.transcription import problem
from lfm_ppl.experiments.transcription.smoothers import rates, saturation

CHAINS = 4
RULE = "riemann"
"""Integration rule, the source's."""

KEPT = 500
"""Draws that are kept of each chain, evenly spaced, more if it goes on. Means and standard deviations are of all."""

MONITORED = np.arange(6, problem.POINTS, 13)
"""The 28 points of the grid for which R-hat and effective sample sizes are computed."""

R_HAT = 1.01
_LONGEST = 8
"""A data set whose chains have not mixed goes on until they are this many times as long."""


def compute(settings: Any, data: list[problem.DataSet], keys: jax.Array) -> dict[str, np.ndarray]:
    """Return ``mean``, ``sd``, ``low``, ``high`` (N, 363), and ``r_hat``, ``ess``, ``length`` and ``seconds`` (N,).

    ``keys`` (N,) are those of the data sets. The draws of all chains together number ``settings["draws"]``, of which
    ``settings["burn_in"]`` are left out. Where R-hat of a data set is above 1.01 its chains go on, as long as
    everything before once more each time; all draws after the burn-in count.
    """
    length = settings["draws"] // CHAINS
    count = len(data)
    known, y = rates(data), jnp.stack([jnp.asarray(one.y) for one in data])
    gamma = saturation(settings)
    outcome: dict[str, np.ndarray] = {}
    seconds, lengths = np.zeros(count), np.zeros(count, int)
    burn_in = settings["burn_in"] // CHAINS
    states, _ = _go(settings["link"], burn_in, 0, gamma, known, y, _unstarted(keys), seconds, np.arange(count))
    kept: list[list[np.ndarray]] = [[] for _ in range(count)]
    sums = np.zeros((count, 2, problem.POINTS))
    open_, ahead = np.arange(count), length - burn_in
    while True:
        rates_left, y_left = jax.tree_util.tree_map(lambda a, o=open_: a[o], (known, y))
        share = KEPT * ahead // (length - burn_in)
        states, (paths, moments) = _go(
            settings["link"], ahead, share, gamma, rates_left, y_left, states, seconds, open_)
        lengths[open_] += ahead
        sums[open_] += moments
        for place, index in enumerate(open_):
            kept[index].append(paths[place])
        diagnosed = {index: diagnose(np.concatenate(kept[index], axis=1)) for index in open_}
        for index, (r_hat, ess) in diagnosed.items():
            outcome.setdefault("r_hat", np.zeros(count))[index] = r_hat
            outcome.setdefault("ess", np.zeros(count))[index] = ess
        going = np.array([diagnosed[index][0] > R_HAT and lengths[index] < _LONGEST * (length - burn_in)
                          for index in open_], bool)
        if not going.any():
            break
        states = jax.tree_util.tree_map(lambda a, g=going: a[np.flatnonzero(g)], states)
        open_, ahead = open_[going], int(lengths[open_[going][0]])
    mean = sums[:, 0] / (CHAINS * lengths[:, None])
    sd = np.sqrt(np.maximum(sums[:, 1] / (CHAINS * lengths[:, None]) - mean**2, 0.0))
    quantiles = np.stack([np.quantile(np.concatenate(one, axis=1).reshape(-1, problem.POINTS), [0.025, 0.975], axis=0)
                          for one in kept])
    return outcome | {"mean": mean, "sd": sd, "low": quantiles[:, 0], "high": quantiles[:, 1],
                      "length": CHAINS * lengths, "seconds": seconds}


def _unstarted(keys: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return keys (N, chains), and positions (N, chains, 363) and log likelihoods that the first segment replaces."""
    count = len(keys)
    own = jax.vmap(lambda key: jax.random.split(key, CHAINS))(keys)
    return own, jnp.zeros((count, CHAINS, problem.POINTS)), jnp.full((count, CHAINS), jnp.nan)


def diagnose(draws: np.ndarray) -> tuple[float, float]:
    """Return the largest R-hat and the smallest bulk effective sample size of kept draws (chains, K, 363).

    At `MONITORED` points. The effective size cannot exceed the number of kept draws by much; that of all is larger.
    """
    dataset = xr.Dataset({"u": (("chain", "draw", "point"), draws[..., MONITORED])})
    summary = arviz_data.summary(arviz_data.build({"posterior": dataset}))
    return float(summary["r_hat"].max()), float(summary["ess_bulk"].min())


def _go(link: str, steps: int, kept: int, gamma: jax.Array, known: problem.Rates, y: jax.Array, states: Any,
        seconds: np.ndarray, index: np.ndarray) -> tuple[Any, Any]:
    """Take steps from ``states``; return the new ones, and what `_program` gives of the draws.

    The CPU time, shared equally, is added to ``seconds`` at ``index``.
    """
    count = len(index)
    run = _program(link, count, steps, kept)
    keys, position, value = states
    taken, (after, paths, moments) = timed(run, gamma, known, y, jax.random.key_data(keys), position, value)
    seconds[index] += taken / count
    data, position, value = after
    return (jax.random.wrap_key_data(data), position, value), (np.asarray(paths), np.asarray(moments))


@functools.cache
def _program(link: str, count: int, steps: int, kept: int) -> Callable:
    """Compile ``steps`` steps of every chain; the first of all draws its start from the prior."""
    outer = max(kept, 1)
    inner = [steps // outer + (place < steps % outer) for place in range(outer)]
    most = max(inner)

    def chain(latent: LatentGrid, y: jax.Array, key: jax.Array, position: jax.Array, value: jax.Array) -> tuple:
        log_likelihood = lambda u: latent.log_likelihood(u[None], y)  # noqa: E731
        key, first = jax.random.split(key)
        fresh = jnp.isnan(value)
        position = jnp.where(fresh, latent.root[0] @ normals(first, problem.POINTS, 2)[:, 0], position)
        state = SliceState(position, log_likelihood(position), jnp.zeros((), int))

        def step(index: jax.Array, carry: tuple) -> tuple:
            key, state, sums = carry
            key, draw, move = jax.random.split(key, 3)
            white = normals(draw, 2, (problem.POINTS + 1) // 2).ravel()[: problem.POINTS]
            state = elliptical_slice_step(move, state, latent.root[0] @ white, log_likelihood)
            return key, state, sums + jnp.stack([state.position, state.position**2])

        def segment(carry: tuple, length: jax.Array) -> tuple[tuple, jax.Array]:
            carry = jax.lax.fori_loop(0, most, lambda i, c: jax.lax.cond(i < length, lambda: step(i, c), lambda: c),
                                      carry)
            return carry, carry[1].position

        (key, state, sums), paths = jax.lax.scan(
            segment, (key, state, jnp.zeros((2, problem.POINTS))), jnp.asarray(inner))
        return (key, state.position, state.log_likelihood), paths, sums

    def run(gamma: jax.Array, known: problem.Rates, y: jax.Array, data: jax.Array, position: jax.Array,
            value: jax.Array) -> tuple:
        keys = jax.random.wrap_key_data(data)
        # One factor of the prior for all data sets, so that prior draws are one product of matrices.
        shared = LatentGrid(problem.system(link, gamma, jax.tree_util.tree_map(lambda a: a[0], known)),
                            problem.TIMES, problem.GRID, RULE).root

        def one(own: problem.Rates, y: jax.Array, keys: jax.Array, position: jax.Array, value: jax.Array) -> tuple:
            latent = LatentGrid(problem.system(link, gamma, own), problem.TIMES, problem.GRID, RULE)
            latent = eqx.tree_at(lambda grid: grid.root, latent, shared)
            return jax.vmap(lambda k, p, v: chain(latent, y, k, p, v))(keys, position, value)

        (keys, position, value), paths, sums = jax.vmap(one)(known, y, keys, position, value)
        return (jax.random.key_data(keys), position, value), paths, sums.sum(axis=1)

    shape = jax.ShapeDtypeStruct((count, problem.GENES), float)
    y = jax.ShapeDtypeStruct((count, problem.OBSERVED, problem.GENES), float)
    keys = jax.eval_shape(lambda: jax.random.key_data(jax.random.split(jax.random.key(0), (count, CHAINS))))
    position = jax.ShapeDtypeStruct((count, CHAINS, problem.POINTS), float)
    value = jax.ShapeDtypeStruct((count, CHAINS), float)
    return jax.jit(run).lower(jax.ShapeDtypeStruct((), float), problem.Rates(*[shape] * 4), y, keys, position,
                              value).compile()
