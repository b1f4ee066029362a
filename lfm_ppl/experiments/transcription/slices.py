"""The force by elliptical slice sampling, many data sets and chains side by side."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from lfm_ppl.experiments.timing import timed
from lfm_ppl.experiments.transcription import ellipses, problem
from lfm_ppl.experiments.transcription.smoothers import rates, saturation
from lfm_ppl.inference.kernels.elliptical_slice import SliceState, elliptical_slice_step
from lfm_ppl.latent_grid.latent_grid import LatentGrid
from lfm_ppl.particles.normals import normals
from lfm_ppl.results import arviz_data

CHAINS = 4
KEPT = 625
"""Draws that are kept of each chain, evenly spaced. Means and standard deviations are of all."""

MONITORED = np.arange(6, problem.POINTS, 13)
"""The 28 points of the grid for which R-hat and effective sample sizes are computed."""

R_HAT = 1.01
_STAGES = 5
"""Times that the chains of a data set are run at most, the first time on ellipses of the prior."""


def compute(settings: Any, data: list[problem.DataSet], keys: jax.Array) -> dict[str, np.ndarray]:
    """Return ``mean``, ``sd``, ``low``, ``high`` (N, 363), and ``r_hat``, ``ess``, ``draws`` and ``seconds`` (N,).

    ``keys`` (N,) are those of the data sets. The draws of all chains together number ``settings["draws"]``, of which
    ``settings["burn_in"]`` are left out; both parts are rounded up to multiples of 2,500. The chains of a data set
    whose R-hat is above 1.01 then run as long once more, on ellipses of a Gaussian that resembles the posterior (see
    `ellipses.resembling`), and what was before becomes burn-in. ``draws`` counts all of them, ``seconds`` is the time
    of the first run and ``r_hat_first`` its R-hat, ``seconds_more`` the time of the others.
    """
    burn_in, ahead = (math.ceil(number / CHAINS / KEPT)
                      for number in (settings["burn_in"], settings["draws"] - settings["burn_in"]))
    count, link, gamma = len(data), settings["link"], saturation(settings)
    known, y = rates(data), jnp.stack([jnp.asarray(one.y) for one in data])
    found = {name: np.zeros(count) for name in ("r_hat", "ess", "seconds", "seconds_more", "draws")}
    found |= {name: np.zeros((count, problem.POINTS)) for name in ("mean", "sd", "low", "high")}
    left, states, around = np.arange(count), _unstarted(keys), None
    for stage in range(_STAGES):
        own = (gamma, *jax.tree_util.tree_map(lambda a, i=left: a[i], (known, y)), around)
        taken_first, (states, _, _) = timed(_program(link, len(left), stage > 0), jnp.asarray(burn_in), *own, *states)
        taken, (states, kept, sums) = timed(_program(link, len(left), stage > 0), jnp.asarray(ahead), *own, *states)
        found["seconds_more" if stage else "seconds"][left] += (taken_first + taken) / len(left)
        found["draws"][left] += CHAINS * KEPT * (burn_in + ahead)
        kept, (mean, square) = np.asarray(kept), np.moveaxis(np.asarray(sums), 1, 0) / (CHAINS * KEPT * ahead)
        found["mean"][left], found["sd"][left] = mean, np.sqrt(np.maximum(square - mean**2, 0.0))
        flat = kept.reshape(len(left), -1, problem.POINTS)
        found["low"][left], found["high"][left] = np.quantile(flat, [0.025, 0.975], axis=1)
        found["r_hat"][left], found["ess"][left] = np.transpose([diagnose(one) for one in kept])
        if stage == 0:
            found["r_hat_first"] = found["r_hat"].copy()
        open_ = np.flatnonzero(~(found["r_hat"][left] <= R_HAT))
        left, states = left[open_], jax.tree_util.tree_map(lambda a, i=open_: a[i], states)
        if not left.size or stage == _STAGES - 1:
            break
        around = ellipses.program(link)(
            gamma, *jax.tree_util.tree_map(lambda a, i=left: a[i], (known, y)), jnp.asarray(flat[open_]))
    return found


def _unstarted(keys: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return key data (N, chains, 2), and positions (N, chains, 363) and likelihoods that the first steps replace."""
    count = len(keys)
    own = jax.vmap(lambda key: jax.random.split(key, CHAINS))(keys)
    return jax.random.key_data(own), jnp.zeros((count, CHAINS, problem.POINTS)), jnp.full((count, CHAINS), jnp.nan)


def diagnose(draws: np.ndarray) -> tuple[float, float]:
    """Return the largest R-hat and the smallest bulk effective sample size of kept draws (chains, K, 363).

    At `MONITORED` points. The effective size cannot exceed the number of kept draws by much; that of all is larger.
    """
    dataset = xr.Dataset({"u": (("chain", "draw", "point"), draws[..., MONITORED])})
    summary = arviz_data.summary(arviz_data.build({"posterior": dataset}))
    return float(summary["r_hat"].max(skipna=False)), float(summary["ess_bulk"].min(skipna=False))


@functools.cache
def _program(link: str, count: int, informed: bool) -> Callable:
    """Compile steps of every chain, any number of them to a draw that is kept. Fresh chains start from the prior.

    ``informed``: the ellipses are those of a Gaussian that is given.
    """
    def chain(latent: LatentGrid, y: jax.Array, around: ellipses.Gaussian | None, apart: jax.Array, key: jax.Array,
              position: jax.Array, value: jax.Array) -> tuple:
        key, first = jax.random.split(key)
        position = jnp.where(jnp.isnan(value), latent.root[0] @ normals(first, problem.POINTS, 2)[:, 0], position)
        own = ellipses.around(latent, y, around)
        begun = own.point(position)
        state = SliceState(begun, own.log_ratio(begun), jnp.zeros((), int))

        def step(_: jax.Array, carry: tuple) -> tuple:
            key, state, sums = carry
            key, draw, move = jax.random.split(key, 3)
            state = elliptical_slice_step(move, state, own.draw(draw), own.log_ratio, own.mean)
            u = state.position.force
            return key, state, sums + jnp.stack([u, u**2])

        def segment(carry: tuple, _: None) -> tuple[tuple, jax.Array]:
            carry = jax.lax.fori_loop(0, apart, step, carry)
            return carry, carry[1].position.force

        (key, state, sums), paths = jax.lax.scan(
            segment, (key, state, jnp.zeros((2, problem.POINTS))), None, length=KEPT)
        return (key, state.position.force, state.log_likelihood), paths, sums

    def run(apart: jax.Array, gamma: jax.Array, known: problem.Rates, y: jax.Array, around: ellipses.Gaussian | None,
            data: jax.Array, position: jax.Array, value: jax.Array) -> tuple:
        keys = jax.random.wrap_key_data(data)
        # One factor of the prior for all data sets, so that prior draws are one product of matrices.
        shared = ellipses.on_grid(link, gamma, jax.tree_util.tree_map(lambda a: a[0], known)).root

        def one(own: problem.Rates, y: jax.Array, around: ellipses.Gaussian | None, keys: jax.Array,
                position: jax.Array, value: jax.Array) -> tuple:
            latent = eqx.tree_at(lambda grid: grid.root, ellipses.on_grid(link, gamma, own), shared)
            return jax.vmap(lambda k, p, v: chain(latent, y, around, apart, k, p, v))(keys, position, value)

        (keys, position, value), paths, sums = jax.vmap(one)(known, y, around, keys, position, value)
        return (jax.random.key_data(keys), position, value), paths, sums.sum(axis=1)

    shapes = ellipses.shapes(count)
    chains = (jax.eval_shape(lambda: jax.random.key_data(jax.random.split(jax.random.key(0), (count, CHAINS)))),
              jax.ShapeDtypeStruct((count, CHAINS, problem.POINTS), float),
              jax.ShapeDtypeStruct((count, CHAINS), float))
    return jax.jit(run).lower(jax.ShapeDtypeStruct((), int), *shapes[:3], shapes[3] if informed else None,
                              *chains).compile()
