"""The filter: moments of state and forces given the observations so far.

1. `filter` checks the arguments and lays out the intervals of the scan.
2. One forward scan predicts and updates (`lfm_ppl.filtering.forward`); an observation family is filtered by assumed
   density filtering.
3. The last moments are a `FilterState`, from which a later call continues.

Source: Särkkä and Sarmavuori (2013), Signal Processing 93.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from lfm_ppl.filtering.arguments import as_rule, check_observations, warn_single_precision
from lfm_ppl.filtering.breakdown import warn_of_breakdown
from lfm_ppl.filtering.ep.moment_matching import assumed_density_filter, quantile_residuals
from lfm_ppl.filtering.forward import FilterTrace, forward
from lfm_ppl.filtering.integrators.methods import DEFAULT_METHOD, METHODS
from lfm_ppl.filtering.intervals import TimeGrid
from lfm_ppl.filtering.moments import Moments, Record
from lfm_ppl.filtering.problem import at_intervals, filter_problem
from lfm_ppl.filtering.stiffness import warn_of_long_steps
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.filtering.update import GaussianUpdate
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.resolution import check_resolution
from lfm_ppl.model.state_space import StateSpaceModel, state_space
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import solve_lower
from lfm_ppl.utils.programs import shared_jit


class FilterState(NamedTuple):
    """Time and moments of the joint state after a filter pass; the ``start`` of the next one."""

    time: Any
    mean: jax.Array
    covariance: jax.Array


class FilterResult(eqx.Module):
    """Result of `filter`.

    Attributes:
        times: (T,).
        log_likelihood: (T,), log p(y_k | y_1:k-1) of the entries that are present; -inf where the filter breaks down.
        predicted_mean, predicted_covariance: (T, n), (T, n, n) of the joint state, before each observation.
        filtered_mean, filtered_covariance: after it.
        whitened_innovation: (T, D), innovations whitened by their Cholesky factor: independent standard normals for a
            true linear model, and so are the randomised quantile residuals of an observation family; NaN where missing.
        state: time and moments after the last observation.
    """

    times: jax.Array
    log_likelihood: jax.Array
    predicted_mean: jax.Array
    predicted_covariance: jax.Array
    filtered_mean: jax.Array
    filtered_covariance: jax.Array
    whitened_innovation: jax.Array
    state: FilterState


def filter(model: LatentForceModel, times: ArrayLike, y: ArrayLike, rule: Rule | None = None, steps: int = 10,
           max_step: float | None = None, start: FilterState | None = None,
           tolerance: float | None = None, method: str = DEFAULT_METHOD) -> FilterResult:
    """Run the continuous-discrete Gaussian filter.

    Between observations the moments obey dm/dt = E[f], dP/dt = A P + P A' + E[G G'] with the rule's A; at an
    observation they are conditioned on it. For an observation family, the predictor given an observation has the
    moments of its tilted prediction (assumed density filtering).

    The filter is a single pass. The log likelihood of a model that is not linear therefore differs from that of
    `lfm_ppl.MarginalLikelihood` and `lfm_ppl.smooth`, which iterate by default, and is that of ``iterations=0``.

    Args:
        model: the latent force model; its functions are read once for each model, as by `jax.jit`.
        times: (T,), non-decreasing; equal times are replicates.
        y: (T, D), NaN where missing.
        rule: linearisation rule; `Cubature()` by default.
        steps: integration steps between two consecutive times.
        max_step: longest step, in units of time; longer intervals get more steps. None: twice the median step. A linear
            model without known inputs is exact, and needs no steps.
        start: the ``state`` of an earlier result, to continue with new observations at later times; all of them may be
            missing (a prediction). Results equal a single pass over all times, and calls with equally many new times
            share one compilation. An observation covariance for each time has the entries of the new times.
        tolerance: largest error of an integration step, in standard deviations, as in `lfm_ppl.MarginalLikelihood`.
        method: of integration, as in `lfm_ppl.MarginalLikelihood`.

    Returns:
        Log likelihoods, moments and residuals, by observation.

    Raises:
        ValueError, TypeError: unsorted times, a wrong shape of y, and so on; each says what to do.

    Warns:
        FilterWarning: outside of compiled code, where a log likelihood is -inf or not finite: which row and step breaks
            down, and how; or where an explicit step is too long for a fast decay: which state and row, and the remedy.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, sd=0.3), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        >>> lfm.filter(model, jnp.arange(3.0), jnp.zeros((3, 1))).log_likelihood.shape
        (3,)

    Source: Särkkä and Sarmavuori (2013), Signal Processing 93; Hartikainen et al. (2012), section 4.
    """
    rule = as_rule(rule)
    checks.one_of("method", method, METHODS)
    ssm = state_space(model)
    if start is not None:
        _check_start(start, times, ssm.state_dim)
    grid = build_time_grid(ssm, times, steps, max_step, initial_time=None if start is None else start.time,
                           tolerance=tolerance)._replace(method=method)
    model.check_at(grid.initial_time, len(grid.observed))
    check_resolution(model, times, y)
    y = check_observations(y, len(grid.observed), ssm.output_dim, start is not None, model)
    warn_single_precision()
    initial = None if start is None else Moments(start.mean, start.covariance)
    result = filter_on(ssm, rule, grid, y, jnp.asarray(times, float), initial)
    concrete_times = checks.concrete(times)
    if concrete_times is not None:
        # A number also inside a trace, so that another call there can continue with its own time grid.
        last = np.asarray(concrete_times[-1], float)
        result = eqx.tree_at(lambda r: r.state.time, result, last)
    warn_of_breakdown(ssm, rule, grid, y, initial, result.log_likelihood)
    warn_of_long_steps(ssm, rule, grid, steps, result.filtered_mean, result.log_likelihood,
                       None if initial is None else initial.mean)
    return result


def _check_start(start: Any, times: Any, size: int) -> None:
    if not isinstance(start, FilterState):
        hint = " Pass result.state." if isinstance(start, FilterResult) else ""
        raise TypeError(f"start must be the state of an earlier filter result, got {type(start).__name__}.{hint}")
    checks.refuse_dates("times", times)
    if np.shape(start.mean) != (size,):
        raise ValueError(f"start has {np.shape(start.mean)[0]} entries, but the joint state of this model has {size}.")
    start_time, concrete_times = checks.concrete(start.time), checks.concrete(times)
    if start_time is not None and concrete_times is not None and concrete_times.size:
        first = concrete_times.flat[0]
        if first < start_time:
            raise ValueError(f"times[0] = {first:g} lies before {float(start_time):g}, the time of `start`.")


@shared_jit
def filter_on(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, times: jax.Array,
              initial: Moments | None = None) -> FilterResult:
    """Filter observations (T, D) at ``times`` on the intervals of a time grid; see `filter`."""
    problem = filter_problem(ssm, rule, grid)
    family = ssm.model.observation
    if isinstance(family, ObservationFamily):
        _, trace, prediction = assumed_density_filter(problem, y, initial)
    else:
        trace = forward(problem, GaussianUpdate(y), initial=initial, record=Record.MOMENTS)
    at_data = at_intervals(trace._replace(initial=None), grid.observed)
    residual = (quantile_residuals(family, prediction, y) if isinstance(family, ObservationFamily)
                else whitened_innovations(at_data, y))
    state = FilterState(times[-1], at_data.filtered.mean[-1], at_data.filtered.covariance[-1])
    log_likelihood = jnp.where(jnp.isnan(at_data.log_likelihood), -jnp.inf, at_data.log_likelihood)
    return FilterResult(times, log_likelihood, at_data.predicted.mean, at_data.predicted.covariance,
                        at_data.filtered.mean, at_data.filtered.covariance, residual, state)


def whitened_innovations(at_data: FilterTrace, y: jax.Array) -> jax.Array:
    """Return innovations whitened by their Cholesky factor, (T, D), NaN where missing."""
    white = jax.vmap(solve_lower)(at_data.update.chol, at_data.update.innovation)
    return jnp.where(jnp.isfinite(y), white, jnp.nan)
