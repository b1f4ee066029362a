"""The numbers of iterations and integration steps that a posterior needs, found before it is sampled.

1. Draws of the Laplace approximation at the posterior mode stand for the posterior.
2. At these draws, the log likelihood after each of a few numbers of iterations from the smoothed moments at the mode is
   compared with that after the largest number.
3. With that number of iterations, half of the default number of steps is compared with the default. Where they agree,
   the default is the reference of fewer steps. Where they do not, the steps are halved twice for a finer reference.
4. The smallest numbers are taken whose difference from the finest has a standard deviation over the draws below
   `TOLERATED_ERROR`: an error that is the same at all draws does not change the posterior. If the largest ones have not
   converged, they are taken, and the check after the sampling (`lfm_ppl.accuracy.approximation`) warns.
5. Both numbers are arguments of one program without derivatives (`lfm_ppl.filtering.intervals.divide_intervals`). A
   finer reference needs another program.

Settings that the model names are not tuned. Steps are tuned for the filter and the smoother only: simulations and
particle filters, whose errors are larger, still take the default.

Source: García-Fernández, Svensson and Särkkä (2017), IEEE Transactions on Signal Processing 65(21), for the iterations.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.integrators.integrator import Stepping
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

_FEWER_STEPS = 3, 5
"""Numbers of steps that are tried below the default, the last one also to see whether the default has converged."""


class Tuning(NamedTuple):
    """Settings of the likelihood of a site.

    Attributes:
        iterations: of posterior linearisation, from the moments at the mode.
        steps: integration steps of the filter; None: they were not tuned.
        error: standard deviation over the posterior of the error of its log likelihood.
    """

    iterations: int
    steps: int | None
    error: float

    def __str__(self) -> str:
        """Return the settings in words."""
        count = {0: "about the moments at the mode", 1: "one iteration from the mode"}.get(
            self.iterations, f"{self.iterations} iterations from the mode")
        steps = "" if self.steps is None else f", {self.steps} steps"
        return f"{count}{steps}; error {self.error:.2g}"


def tune(key: jax.Array, bound: BoundModel, laplace: Laplace) -> dict[str, Tuning]:
    """Return the settings of each likelihood site whose iterations start at the mode and whose model leaves them open.

    Args:
        key: a JAX random key, for the draws.
        bound: the model, anchored at the mode.
        laplace: the approximation of its posterior.
    """
    normals = np.asarray(jax.random.normal(key, (_DRAWS, bound.size)))
    draws = laplace.mode + normals @ np.linalg.cholesky(laplace.covariance).T
    tunings = {name: _tune_site(model, draws) for name, model in bound.site_models.items()
               if name in bound.problem.anchors}
    return {name: tuning for name, tuning in tunings.items() if tuning is not None}


def _has_open_steps(bound: BoundModel) -> bool:
    """Return whether the model leaves the number of steps open, and takes it between any two times.

    Where known inputs or events divide many intervals between two times, each part takes fewer steps. Another number
    then divides the intervals in another way, so that one grid cannot stand for all numbers.
    """
    example, members = bound.site.example, bound.site.members
    has_steps = any(integrator.stepping is Stepping.EQUAL for integrator in example.integrators)
    if not has_steps or example.given & {"steps", "filter_steps", "max_step"}:
        return False
    if bound.times.ndim > 1 and any(series.model.events or series.model.input_reads(0.0, 1.0) for series in members):
        return False  # the grids of series with times of their own are laid out in the program
    return all(series.time_grid.steps == series.settings.steps for series in members)


def _tune_site(bound: BoundModel, draws: np.ndarray) -> Tuning | None:
    """Return the settings of a site; None where none are open, or where the filter breaks down at most draws."""
    example = bound.site.example
    has_open_steps, has_open_iterations = _has_open_steps(bound), "iterations" not in example.given
    if not (has_open_steps or has_open_iterations):
        return None
    steps, iterations = example.settings.steps, example.settings.iterations
    log_likelihoods = _log_likelihoods_at(bound, draws, steps if has_open_steps else None)
    finest = log_likelihoods(_FINEST if has_open_iterations else iterations, steps)
    is_possible = np.isfinite(finest)  # the approximation may reach where the filter breaks down
    if 2 * is_possible.sum() < len(draws):
        return None

    def difference(first: np.ndarray, second: np.ndarray) -> float:
        return finite_sd((first - second)[is_possible])

    iterated = finest
    for iterations in _COUNTS if has_open_iterations else ():
        iterated = log_likelihoods(iterations, steps)
        if difference(iterated, finest) <= TOLERATED_ERROR:
            break
    if not has_open_steps:
        return Tuning(iterations, None, difference(iterated, finest))
    half = log_likelihoods(iterations, _FEWER_STEPS[-1])
    candidates: tuple[int, ...] = (*_FEWER_STEPS, steps)
    if difference(half, iterated) > TOLERATED_ERROR:
        most = 4 * steps
        log_likelihoods = _log_likelihoods_at(bound, draws, most)
        # The error of the iterations remains that of the default steps.
        finest = finest - iterated + log_likelihoods(iterations, most)
        candidates = steps, 2 * steps
    for count in candidates:
        error = difference(log_likelihoods(iterations, count), finest)
        if error <= TOLERATED_ERROR:
            break
    return Tuning(iterations, count, error)


def _log_likelihoods_at(bound: BoundModel, draws: np.ndarray,
                        most_steps: int | None) -> Callable[[int, int], np.ndarray]:
    """Return the function from numbers of iterations and of steps to the log likelihoods (S,) at draws.

    Args:
        bound: the model with one site, and its anchor.
        draws: (S, d), unconstrained parameters.
        most_steps: largest number of steps; None: the steps of the likelihood, for any argument.
    """
    def log_likelihoods(draws: jax.Array, iterations: jax.Array, steps: jax.Array, problem: Problem) -> jax.Array:
        def log_likelihood(z: jax.Array) -> jax.Array:
            def of_series(series: SeriesLikelihood, y: Any) -> jax.Array:
                return series.log_likelihood_after(y, iterations, steps, most_steps)

            return bound.likelihood(z, problem).mapped(of_series, bound.data(problem)).sum()

        return jax.lax.map(log_likelihood, draws)

    run = bound.program(("log likelihoods after iterations", most_steps), lambda: Program(log_likelihoods))

    @functools.cache  # some numbers are asked for twice
    def at_draws(iterations: int, steps: int) -> np.ndarray:
        return np.asarray(run(jnp.asarray(draws), jnp.asarray(iterations), jnp.asarray(steps), bound.problem))

    return at_draws


def anchor_at_mode(key: jax.Array, bound: BoundModel, laplace: Laplace) -> tuple[BoundModel, dict[str, Tuning]]:
    """Return the model whose iterations start at the posterior mode, with as few iterations and steps as it needs.

    Args:
        key: a JAX random key, for the draws.
        bound: the model and its data.
        laplace: the approximation of its posterior.

    Returns:
        The model, and what was tuned, by site.
    """
    anchored = bound.anchored(laplace.mode)
    tunings = tune(key, anchored, laplace)
    return _with_settings(anchored, {name: tuning._asdict() for name, tuning in tunings.items()}), tunings


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
    # The moments are computed with the model's own steps, and interpolated at the tuned ones.
    return _with_settings(bound.anchored(np.array(stored["point"]), stored["sites"]), stored["sites"])


def finite_sd(values: np.ndarray) -> float:
    """Return the standard deviation; infinite where a value is not finite."""
    return float(values.std()) if np.isfinite(values).all() else np.inf


def _with_settings(bound: BoundModel, tunings: Mapping[str, Mapping[str, Any]]) -> BoundModel:
    """Return the model with what was tuned, by site; nothing where a site has no entries."""
    for name, tuning in tunings.items():
        model = bound.site_models[name]
        settings = model.site.example.settings
        new = {"iterations": tuning.get("iterations", settings.iterations),
               "filter_steps": tuning.get("steps") or settings.integration_steps}
        current = {"iterations": settings.iterations, "filter_steps": settings.integration_steps}
        changed = {key: value for key, value in new.items() if value != current[key]}
        if changed:
            bound = model.approximate(**changed).with_all_sites()
    return bound
