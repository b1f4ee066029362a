"""The force by Gaussian smoothers: the source's, a cheaper one, and one that is iterated."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.experiments.timing import timed
from lfm_ppl.experiments.transcription import problem
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.linearisation.sigma_points import Cubature, GaussHermite


class Smoother(NamedTuple):
    """A rule with its settings.

    Attributes:
        rule: of linearisation.
        steps: Runge-Kutta steps between two observations.
        iterations: of posterior linearisation.
        damping: largest share of each new iterate that is taken.
    """

    rule: Rule
    steps: int
    iterations: int = 0
    damping: float = 1.0


SMOOTHERS = {
    "GFS": Smoother(Cubature(full_state=True), 10),
    "GHS(7)": Smoother(GaussHermite(7), 10),
    "iterated GHS(7)": Smoother(GaussHermite(7), 10, 25, 0.5),
}
"""The source's: cubature in the whole state. Gauss-Hermite in the force alone. The same, iterated."""


def compute(settings: Any, data: list[problem.DataSet]) -> dict[str, np.ndarray]:
    """Return ``mean`` and ``sd`` (N, 363) of the force, ``change`` (N,) of the last iteration, and ``seconds``."""
    run = _program(settings["method"], settings["link"], len(data))
    arguments = (saturation(settings), rates(data), jnp.stack([jnp.asarray(one.y) for one in data]))
    run(*arguments)[0].block_until_ready()  # to touch the memory for the first time takes longer than the rest
    seconds, (mean, sd, change) = timed(run, *arguments)
    return {"mean": np.asarray(mean), "sd": np.asarray(sd), "change": np.asarray(change),
            "seconds": np.full(len(data), seconds / len(data))}


def rates(data: list[problem.DataSet]) -> problem.Rates:
    """Return the rates of data sets, stacked."""
    return problem.Rates(*(jnp.stack([jnp.asarray(value) for value in values])
                           for values in zip(*(one.rates for one in data), strict=True)))


def saturation(settings: Any) -> jax.Array:
    """Return gamma; any number where the link has none."""
    return jnp.asarray(1.0 if settings["gamma"] is None else settings["gamma"])


@functools.cache
def _program(method: str, link: str, count: int) -> Callable:
    chosen = SMOOTHERS[method]

    def one(gamma: jax.Array, known: problem.Rates, y: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        found = smooth(problem.system(link, gamma, known), problem.TIMES, y, chosen.rule, chosen.steps,
                       at=problem.GRID, iterations=chosen.iterations, damping=chosen.damping)
        force = found.force(problem.FACTOR)
        return force.mean, force.sd, found.change

    shape = jax.ShapeDtypeStruct((count, problem.GENES), float)
    y = jax.ShapeDtypeStruct((count, problem.OBSERVED, problem.GENES), float)
    vectorised = jax.jit(jax.vmap(one, in_axes=(None, 0, 0)))
    return vectorised.lower(jax.ShapeDtypeStruct((), float), problem.Rates(*[shape] * 4), y).compile()
