"""The force by Gaussian approximations: Laplace's on the grid, and Gaussian smoothers."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments.tasks import stack_results
from lfm_ppl.experiments.timing import time_call, time_compiled_call
from lfm_ppl.experiments.transcription import problem
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.latent_grid import laplace
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.linearisation.sigma_points import Cubature, GaussHermite

SEARCHES = {"LA": ("newton", "riemann"), "LA, trust region": ("trust-region", "linear")}
"""How the mode is sought, and the integration rule of the grid: the source's, and a search that does not fail."""

SMOOTHERS: dict[str, tuple[Rule, int, float]] = {
    "GFS": (Cubature(full_state=True), 0, 1.0), "GHS(7)": (GaussHermite(7), 0, 1.0),
    "iterated GHS(7)": (GaussHermite(7), 25, 0.5)}
"""Rule, iterations of posterior linearisation, and damping, the largest share of each new iterate that is taken. The
source's: cubature in the whole state. Gauss-Hermite in the force alone. The same, iterated."""

SEARCH_STEPS, TOLERANCE, RUNGE_KUTTA_STEPS = 300, 1e-6, 10
"""The last are those between two observations."""


def compute(settings: Mapping[str, Any], data: list[problem.DataSet]) -> Result:
    """Return ``mean`` and ``sd`` (N, 363) of the force, and CPU ``seconds`` (N,) without compilation.

    Laplace's approximation also says which searches ``stopped`` and ``converged``, and their ``iterations``; a smoother
    the ``change`` of a mean in the last iteration, in standard deviations. Smoothers take all data sets together, but
    searches of different lengths would wait for each other.
    """
    gamma, *given = problem.inputs(settings, data)
    fixed = settings["method"], settings["link"], gamma
    if settings["method"] in SMOOTHERS:
        time_call(_smooth, *fixed, *given)  # compiles, and touches the memory for the first time
        seconds, found = time_call(_smooth, *fixed, *given)
        return {name: np.asarray(value) for name, value in found.items()} | {
            "seconds": np.full(len(data), seconds / len(data))}
    rows = []
    for index in range(len(data)):
        search = functools.partial(_search, *fixed, *problem.rows(given, index))
        seconds, found = time_compiled_call(f"transcription, {settings['method']}, {settings['link']}", search)
        rows.append(found | {"seconds": seconds})
    return stack_results(rows)


@eqx.filter_jit
def _search(method: str, link: str, gamma: jax.Array, rates: problem.Rates, y: jax.Array) -> Result:
    search, rule = SEARCHES[method]
    found = laplace.run(problem.on_grid(link, gamma, rates, rule), y, search, SEARCH_STEPS, TOLERANCE)
    return {"mean": found.mode[0], "sd": found.sd[0], "stopped": found.stopped, "converged": found.converged,
            "iterations": found.iterations}


@eqx.filter_jit
def _smooth(method: str, link: str, gamma: jax.Array, rates: problem.Rates, y: jax.Array) -> Result:
    rule, iterations, damping = SMOOTHERS[method]

    def one(rates: problem.Rates, y: jax.Array) -> Result:
        found = smooth(problem.system(link, gamma, rates), problem.TIMES, y, rule, RUNGE_KUTTA_STEPS, at=problem.GRID,
                       iterations=iterations, damping=damping)
        force = found.force(problem.FACTOR)
        return {"mean": force.mean, "sd": force.sd, "change": found.change}

    return jax.vmap(one)(rates, y)
