"""The force by Laplace's approximation: with the source's Newton method, and with a search that does not fail."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.experiments.timing import timed
from lfm_ppl.experiments.transcription import problem
from lfm_ppl.experiments.transcription.smoothers import rates, saturation
from lfm_ppl.latent_grid import laplace
from lfm_ppl.latent_grid.latent_grid import LatentGrid

ITERATIONS, TOLERANCE = 300, 1e-6


class Search(NamedTuple):
    """How the mode is sought, and the integration rule of the grid."""

    method: str
    rule: str


SEARCHES = {"LA": Search("newton", "riemann"), "LA, trust region": Search("trust-region", "linear")}


def compute(settings: Any, data: list[problem.DataSet]) -> dict[str, np.ndarray]:
    """Return ``mean`` and ``sd`` (N, 363), ``stopped``, ``converged`` and ``iterations`` (N,), and ``seconds`` (N,)."""
    run = _program(settings["method"], settings["link"])
    known, found = rates(data), []
    for index, one in enumerate(data):
        own = jax.tree_util.tree_map(lambda a, index=index: a[index], known)
        found.append(timed(run, saturation(settings), own, jnp.asarray(one.y)))
    columns = zip(*(result for _, result in found), strict=True)
    names = ("mean", "sd", "stopped", "converged", "iterations")
    return {name: np.stack([np.asarray(value) for value in column]) for name, column in zip(names, columns, strict=True)
            } | {"seconds": np.array([seconds for seconds, _ in found])}


@functools.cache
def _program(method: str, link: str) -> Callable:
    chosen = SEARCHES[method]

    def one(gamma: jax.Array, known: problem.Rates, y: jax.Array) -> tuple[jax.Array, ...]:
        latent = LatentGrid(problem.system(link, gamma, known), problem.TIMES, problem.GRID, chosen.rule)
        found = laplace.run(latent, y, chosen.method, ITERATIONS, TOLERANCE)
        return found.mode[0], found.sd[0], found.stopped, found.converged, found.iterations

    number, shape = jax.ShapeDtypeStruct((), float), jax.ShapeDtypeStruct((problem.GENES,), float)
    y = jax.ShapeDtypeStruct((problem.OBSERVED, problem.GENES), float)
    return jax.jit(one).lower(number, problem.Rates(*[shape] * 4), y).compile()
