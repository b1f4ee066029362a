"""Simulation-based calibration of a sampler on a latent force model.

For parameters theta* drawn from the prior and data drawn from the model at theta*, theta* is one more draw from the
posterior. Its rank among L independent posterior draws is therefore uniform on 0..L, for every scalar function of
parameters and data. A sampler that is too wide, too narrow or shifted shows in the ranks.

Source: Talts et al. (2018), Validating Bayesian inference algorithms with simulation-based calibration; Modrak et al.
(2023), Bayesian Analysis, for the log likelihood as a test quantity.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpyro import handlers
from numpyro.infer.util import log_likelihood


def ranks(model: Callable, times: Any, kernel: Callable, key: jax.Array, *, data_sets: int, draws: int = 63,
          thin: int = 10, warmup: int = 500, batch: int | None = None) -> dict[str, np.ndarray]:
    """Return ranks in 0..draws, name of a scalar -> (data_sets,), from one compiled program.

    Args:
        model: NumPyro model ``model(times, y=None)`` whose site "y" is the likelihood.
        times: (T,).
        kernel: maps a NumPyro model to an MCMC kernel, such as ``lfm.RAM``.
        key: a JAX random key.
        data_sets: number of replications.
        draws: posterior draws that are ranked against.
        thin: steps of the chain between two of these; the draws must be nearly independent.
        warmup: steps before the first.
        batch: data sets that run side by side; all by default. (NUTS side by side takes as long as its longest tree.)
    """
    times = np.asarray(times, float)
    truth_keys, chain_keys = jax.random.split(key)

    def one(keys: tuple[jax.Array, jax.Array]) -> dict[str, jax.Array]:
        trace = handlers.trace(handlers.seed(model, keys[0])).get_trace(times)
        y = trace["y"]["value"]
        truth = {n: s["value"] for n, s in trace.items() if s["type"] == "sample" and n != "y"}
        posterior = _chain(model, times, y, kernel(model), keys[1], draws, thin, warmup)
        truth["log likelihood"] = _score(model, times, y, truth)
        posterior["log likelihood"] = jax.lax.map(lambda theta: _score(model, times, y, theta), posterior)
        return {n: (posterior[n] < truth[n]).sum(0) for n in truth}

    keys = (jax.random.split(truth_keys, data_sets), jax.random.split(chain_keys, data_sets))
    found = jax.jit(lambda k: jax.lax.map(one, k, batch_size=batch or data_sets))(keys)
    return _scalars({name: np.asarray(value) for name, value in found.items()})


def _chain(model: Callable, times: Any, y: Any, kernel: Any, key: jax.Array, draws: int, thin: int,
           warmup: int) -> dict[str, jax.Array]:
    arguments = (times, y)
    state = kernel.init(key, warmup, None, arguments, {})
    advance = lambda count, state: jax.lax.fori_loop(  # noqa: E731
        0, count, lambda _, s: kernel.sample(s, arguments, {}), state)
    state = advance(warmup, state)

    def step(state: Any, _: None) -> tuple[Any, Any]:
        state = advance(thin, state)
        return state, state.z

    _, collected = jax.lax.scan(step, state, length=draws)
    return jax.vmap(kernel.postprocess_fn(arguments, {}))(collected)


def _score(model: Callable, times: Any, y: Any, theta: Mapping[str, Any]) -> jax.Array:
    return log_likelihood(model, jax.tree.map(lambda a: a[None], dict(theta)), times, y)["y"].sum()


def _scalars(found: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    flat = {}
    for name, value in found.items():
        for index in np.ndindex(value.shape[1:]):
            flat[f"{name}[{','.join(map(str, index))}]" if index else name] = value[(slice(None), *index)]
    return flat


def chi_square(rank: np.ndarray, draws: int, bins: int) -> float:
    """Pearson's statistic of the ranks in ``bins`` bins of equal width; draws + 1 is a multiple of bins."""
    counts = np.bincount(rank * bins // (draws + 1), minlength=bins)
    expected = len(rank) / bins
    return float(((counts - expected) ** 2 / expected).sum())


def ecdf_distance(rank: np.ndarray, draws: int) -> float:
    """Largest distance of the empirical distribution function of the ranks from the uniform one."""
    counts = np.bincount(rank, minlength=draws + 1)
    uniform = np.arange(1, draws + 2) / (draws + 1)
    return float(np.abs(counts.cumsum() / len(rank) - uniform).max())


def p_values(rank: np.ndarray, draws: int, bins: int, simulations: int = 20_000) -> dict[str, float]:
    """Return p-values of both statistics, from their distribution under uniform ranks (no asymptotics)."""
    random = np.random.default_rng(0)
    null = random.integers(0, draws + 1, (simulations, len(rank)))
    found = {}
    for name, statistic in (("chi-square", lambda r: chi_square(r, draws, bins)),
                            ("ecdf", lambda r: ecdf_distance(r, draws))):
        simulated = np.array([statistic(row) for row in null])
        # The observed one counts among the simulated, so that no p-value is zero
        found[name] = (1 + (simulated >= statistic(rank) - 1e-12).sum()) / (simulations + 1)
    return found


def save(name: str, found: Mapping[str, np.ndarray], draws: int) -> None:
    """Write the ranks to LFM_SBC_OUT/name.npz, where that variable names a folder."""
    folder = os.environ.get("LFM_SBC_OUT")
    if folder:
        Path(folder).mkdir(parents=True, exist_ok=True)
        np.savez(Path(folder) / f"{name}.npz", draws=draws, **found)
