"""Gaussian approximations of the force: Laplace's on the grid, and Gaussian smoothers."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np

import lfm_ppl as lfm
from lfm_ppl.latent_grid import laplace
from lfm_ppl.parallel.task import Result

from ..tasks import stack_results
from ..timing import time_call, time_compiled_call
from . import problem

SEARCHES = {"LA": ("newton", "riemann"), "LA, trust region": ("trust-region", "linear")}
"""Method -> search for the mode, and quadrature of the grid: the source's, and a robust search."""

SMOOTHERS: dict[str, tuple[lfm.Rule, int, float]] = {
    "GFS": (lfm.Cubature(full_state=True), 0, 1.0), "GHS(7)": (lfm.GaussHermite(7), 0, 1.0),
    "iterated GHS(7)": (lfm.GaussHermite(7), 25, 0.5)}
"""Method -> rule, iterations of posterior linearisation, and damping (weight of a new iterate). The source has cubature
in the full state; the others have Gauss-Hermite in the force alone, without and with iterations."""

SEARCH_STEPS, TOLERANCE, RUNGE_KUTTA_STEPS = 300, 1e-6, 10
"""Largest number of search steps, tolerance of the search, and integration steps between two observations."""


def compute(settings: Mapping[str, Any], data: list[problem.DataSet]) -> Result:
    """Return ``mean`` and ``sd`` (N, 363) of the force, and CPU ``seconds`` (N,) without compilation.

    Laplace's approximation adds ``stopped``, ``converged`` and ``iterations`` of its search; a smoother adds the
    largest ``change`` of a mean in the last iteration, in standard deviations. Smoothers are vectorised over data sets.
    Searches are not, since all would wait for the longest one.
    """
    gamma, *inputs = problem.inputs(settings, data)
    fixed = settings["method"], settings["link"], gamma
    if settings["method"] in SMOOTHERS:
        time_call(_smooth, *fixed, *inputs)  # compiles, and allocates memory
        seconds, result = time_call(_smooth, *fixed, *inputs)
        return {name: np.asarray(value) for name, value in result.items()} | {
            "seconds": np.full(len(data), seconds / len(data))}
    rows = []
    for index in range(len(data)):
        search = functools.partial(_search, *fixed, *problem.rows(inputs, index))
        seconds, result = time_compiled_call(f"transcription, {settings['method']}, {settings['link']}", search)
        rows.append(result | {"seconds": seconds})
    return stack_results(rows)


@eqx.filter_jit
def _search(method: str, link: str, gamma: jax.Array, rates: problem.Rates, y: jax.Array) -> Result:
    search, quadrature = SEARCHES[method]
    mode = laplace.run(problem.on_grid(link, gamma, rates, quadrature), y, search, SEARCH_STEPS, TOLERANCE)
    return {"mean": mode.mode[0], "sd": mode.sd[0], "stopped": mode.stopped, "converged": mode.converged,
            "iterations": mode.iterations}


@eqx.filter_jit
def _smooth(method: str, link: str, gamma: jax.Array, rates: problem.Rates, y: jax.Array) -> Result:
    rule, iterations, damping = SMOOTHERS[method]

    def smooth_data_set(rates: problem.Rates, y: jax.Array) -> Result:
        smoothed = lfm.smooth(problem.system(link, gamma, rates), problem.TIMES, y, rule, RUNGE_KUTTA_STEPS,
                              at=problem.GRID, iterations=iterations, damping=damping)
        force = smoothed.force(problem.FACTOR)
        return {"mean": force.mean, "sd": force.sd, "change": smoothed.change}

    return jax.vmap(smooth_data_set)(rates, y)
