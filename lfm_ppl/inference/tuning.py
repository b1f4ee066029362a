"""The number of iterations of posterior linearisation that a posterior needs, found before it is sampled.

1. Draws of the Laplace approximation at the posterior mode stand for the posterior.
2. At these draws, the log likelihood after each of a few numbers of iterations from the smoothed moments at the mode is
   compared with that after the largest number. The number is an argument of one program without derivatives.
3. The smallest number is taken whose difference has a standard deviation over the draws below `TOLERATED_ERROR`: an
   error that is the same at all draws does not change the posterior. If the largest one has not converged, it is taken,
   and the check after the sampling (`lfm_ppl.accuracy.approximation`) warns.

Source: García-Fernández, Svensson and Särkkä (2017), IEEE Transactions on Signal Processing 65(21), for the iterations.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.laplace_start import Laplace
from lfm_ppl.inference.problem import Problem
from lfm_ppl.likelihoods.series_likelihood import SeriesLikelihood
from lfm_ppl.utils.programs import Program

ANCHOR = "anchor"
"""Attribute of a result, as JSON: the unconstrained parameters ("point") at whose smoothed moments iterations start,
see `BoundModel.anchored`, and what was tuned at each site ("sites")."""

TOLERATED_ERROR = 0.1
"""Standard deviation over the posterior of an error of the log likelihood that is not worth another iteration."""

_DRAWS = 20

_COUNTS, _FINEST = (0, 1, 2, 3, 6), 12
"""Numbers of iterations that are tried, and the one that they are compared with."""


class Tuning(NamedTuple):
    """Settings of the likelihood of a site.

    Attributes:
        iterations: of posterior linearisation, from the moments at the mode.
        error: standard deviation over the posterior of the error of its log likelihood.
    """

    iterations: int
    error: float

    def __str__(self) -> str:
        """Return the settings in words."""
        count = {0: "about the moments at the mode", 1: "one iteration from the mode"}.get(
            self.iterations, f"{self.iterations} iterations from the mode")
        return f"{count}; error {self.error:.2g}"


def tune_iterations(key: jax.Array, bound: BoundModel, laplace: Laplace) -> dict[str, Tuning]:
    """Return the settings of each likelihood site whose iterations start at the mode and whose model leaves them open.

    Args:
        key: a JAX random key, for the draws.
        bound: the model, anchored at the mode.
        laplace: the approximation of its posterior.
    """
    normals = np.asarray(jax.random.normal(key, (_DRAWS, bound.size)))
    draws = laplace.mode + normals @ np.linalg.cholesky(laplace.covariance).T
    tunings = {name: _tune_site(model, draws) for name, model in bound.site_models.items()
               if name in bound.problem.anchors and "iterations" not in model.site.example.given}
    return {name: tuning for name, tuning in tunings.items() if tuning is not None}


def _tune_site(bound: BoundModel, draws: np.ndarray) -> Tuning | None:
    """Return the settings of a site; None where the filter breaks down at most draws."""
    def log_likelihoods(draws: jax.Array, iterations: jax.Array, problem: Problem) -> jax.Array:
        def log_likelihood(z: jax.Array) -> jax.Array:
            def of_series(series: SeriesLikelihood, y: Any) -> jax.Array:
                return series.log_likelihood_after(y, iterations)

            return bound.likelihood(z, problem).mapped(of_series, bound.data(problem)).sum()

        return jax.lax.map(log_likelihood, draws)

    run = bound.program("log likelihoods after iterations", lambda: Program(log_likelihoods))
    finest = np.asarray(run(jnp.asarray(draws), jnp.asarray(_FINEST), bound.problem))
    is_possible = np.isfinite(finest)  # the approximation may reach where the filter breaks down
    if 2 * is_possible.sum() < len(draws):
        return None
    for count in _COUNTS:
        values = np.asarray(run(jnp.asarray(draws), jnp.asarray(count), bound.problem))
        error = finite_sd(values[is_possible] - finest[is_possible])
        if error <= TOLERATED_ERROR:
            break
    return Tuning(count, error)


def anchor_at_mode(key: jax.Array, bound: BoundModel, laplace: Laplace) -> tuple[BoundModel, dict[str, Tuning]]:
    """Return the model whose iterations start at the posterior mode, as few as it needs; and what was tuned, by site.

    Args:
        key: a JAX random key, for the draws.
        bound: the model and its data.
        laplace: the approximation of its posterior.
    """
    anchored = bound.anchored(laplace.mode)
    tunings = tune_iterations(key, anchored, laplace)
    return _with_iterations(anchored, {name: tuning.iterations for name, tuning in tunings.items()}), tunings


def anchor_attribute(bound: BoundModel, tunings: Mapping[str, Tuning]) -> dict[str, str]:
    """Return the attribute of a result from which `anchored` finds its likelihood; none without an anchor."""
    if bound.anchor_point is None:
        return {}
    sites = {name: tunings[name]._asdict() if name in tunings else {} for name in bound.problem.anchors}
    return {ANCHOR: json.dumps({"point": bound.anchor_point.tolist(), "sites": sites})}


def anchored(bound: BoundModel, attributes: Mapping[str, Any]) -> BoundModel:
    """Return the model with the likelihood of a fit, from the attributes of its result."""
    if ANCHOR not in attributes:
        return bound
    stored = json.loads(str(attributes[ANCHOR]))
    iterations = {name: tuning["iterations"] for name, tuning in stored["sites"].items() if tuning}
    return _with_iterations(bound, iterations).anchored(np.array(stored["point"]), stored["sites"])


def finite_sd(values: np.ndarray) -> float:
    """Return the standard deviation; infinite where a value is not finite."""
    return float(values.std()) if np.isfinite(values).all() else np.inf


def _with_iterations(bound: BoundModel, iterations: Mapping[str, int]) -> BoundModel:
    for name, count in iterations.items():
        model = bound.site_models[name]
        if model.site.example.settings.iterations != count:
            bound = model.approximate(iterations=count).with_all_sites()
    return bound
