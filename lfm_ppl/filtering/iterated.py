r"""Iterated posterior linearisation: smooth, linearise about the smoothed marginals, repeat.

1. A first pass is linearised about the filter's own moments.
2. The backward scan of Bryson and Frazier's adjoint, the variable (r, Lambda) of the smoother and not that of automatic
   differentiation, gives the smoothed moments at the ends of all integration steps (`smoothed_points`).
3. Each further pass is linearised about them, damped: where an iteration moves the means m of a time by r and the one
   before, of which the fraction s was taken, moved them by r', the fraction that is taken now is that of the secant
   method,

       s / (1 - lambda),    lambda = sum_i r_i r'_i / v_i  /  sum_i r'_i^2 / v_i,

   with the variances v, and at most the damping: means that alternate between two values meet between them.
4. The standard deviations at the nodes are at most those that the first pass predicts there (`predicted_variance`). In
   a linear model smoothed variances never exceed them. Where a path crosses an unstable point they do: the linearised
   flow grows between two observations, as the model's own does not, and rules that average over such a variance give
   rates that explicit steps do not resolve.
5. The caller makes the final forward pass about the result: n iterations are n forward and n backward scans, and one
   forward scan more.

The gradient is that of the unrolled iterations, since a fixed number of them is a smooth function of the parameters.

Source: García-Fernández, Svensson and Särkkä (2017), IEEE Transactions on Signal Processing 65(21).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.backward import SmootherTrace, at_interval_starts, backward
from lfm_ppl.filtering.dynamics import columns, linearization_indices
from lfm_ppl.filtering.forward import FilterTrace, LinearizationPoints, forward
from lfm_ppl.filtering.moments import Moments, Record, matvec
from lfm_ppl.filtering.predict import NodeRecord
from lfm_ppl.filtering.problem import FilterProblem
from lfm_ppl.filtering.update import Updater
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.utils.linalg import congruence, safe_sqrt

DEFAULT_ITERATIONS = 3
"""Iterations of posterior linearisation of models that are not linear."""

_NEGLIGIBLE_STEP = 1e-8
"""Square of a step, in standard deviations, below which the secant method has no information."""


class IterationResult(NamedTuple):
    """Result of the iterations.

    Attributes:
        points: moments about which the last pass is linearised.
        change: largest change of a mean in the last iteration, in standard deviations; NaN with one iteration.
        log_likelihood: of the pass of the last iteration, about the points before the last ones; NaN with one.
    """

    points: LinearizationPoints
    change: jax.Array
    log_likelihood: jax.Array


class _Iterate(NamedTuple):
    """Moments about which a pass is linearised, and how the last iteration moved them.

    Attributes:
        moments: (..., n) and (..., n, n).
        step: (..., n), difference of the smoothed means from those about which they were linearised.
        fraction: (...), of the step that was taken.
        change: largest step of a mean, in standard deviations.
    """

    moments: Moments
    step: jax.Array
    fraction: jax.Array
    change: jax.Array


def number_of_iterations(iterations: int | None, ssm: StateSpaceModel, tolerance: float | None) -> int:
    """Return the number of iterations of the smoother and of the likelihood, the default for None.

    A linear model, an observation family and steps that follow a tolerance take none by default.
    """
    if iterations is not None:
        return iterations
    is_family = isinstance(ssm.model.observation, ObservationFamily)
    return 0 if is_family or tolerance is not None or ssm.plan.is_linear else DEFAULT_ITERATIONS


def posterior_linearisation(problem: FilterProblem, updater: Updater, iterations: int,
                            damping: float) -> IterationResult:
    """Return the moments after a fixed number of iterations, so that they are smooth in the parameters.

    Args:
        problem: the model, the rule and the time grid.
        updater: how observations update the moments.
        iterations: number of forward and backward scans.
        damping: largest fraction of the new marginals that is taken, in (0, 1].
    """
    def smooth(trace: FilterTrace) -> LinearizationPoints:
        return smoothed_points(problem, trace, backward(problem, trace, adjoint_only=True))

    single_pass = forward(problem, updater, record=Record.LINEARIZATION)
    largest = predicted_variance(problem, single_pass)

    def limit(nodes: _Iterate) -> _Iterate:
        return nodes if largest is None else nodes._replace(moments=limit_variance(nodes.moments, largest))

    def iterate(iterates: list[_Iterate | None], _: None) -> tuple[list[_Iterate | None], jax.Array]:
        trace = forward(problem, updater, about=_points_of(iterates), record=Record.LINEARIZATION)
        smoothed = smooth(trace)
        nodes, end_moments = (None if old is None or new is None else _damped_update(old, new, damping)
                              for old, new in zip(iterates, smoothed, strict=True))
        assert nodes is not None
        return [limit(nodes), end_moments], trace.log_likelihood.sum()

    nodes, end_moments = (
        None if moments is None else _Iterate(moments, jnp.zeros_like(moments.mean),
                                              jnp.full(moments.mean.shape[:-1], damping), jnp.asarray(jnp.nan))
        for moments in smooth(single_pass))
    assert nodes is not None
    last, log_likelihoods = jax.lax.scan(iterate, [limit(nodes), end_moments], None, length=iterations - 1)
    change = jnp.max(jnp.stack([iterate.change for iterate in last if iterate is not None]))
    log_likelihood = log_likelihoods[-1] if iterations > 1 else jnp.asarray(jnp.nan)
    return IterationResult(_points_of(last), change, log_likelihood)


def predicted_variance(problem: FilterProblem, single_pass: FilterTrace) -> jax.Array | None:
    """Return the variances (N, J + 1, k) that the first pass predicts at the nodes; None where it records no steps.

    At the start of an interval it is the filtered variance there.
    """
    if single_pass.nodes is None:
        return None
    indices = linearization_indices(problem.ssm, problem.rule)

    def variance(covariance: jax.Array) -> jax.Array:
        return jnp.diagonal(covariance, axis1=-2, axis2=-1)

    at_start = at_interval_starts(single_pass.filtered, single_pass.initial).covariance
    inner = variance(single_pass.nodes.moments.covariance)
    return jnp.concatenate([columns(variance(at_start), indices)[:, None], inner], axis=1)


def limit_variance(moments: Moments, largest: jax.Array) -> Moments:
    """Return the moments with variances of at most ``largest``; correlations, and what is below it, are unchanged."""
    variance = jnp.diagonal(moments.covariance, axis1=-2, axis2=-1)
    is_above = variance > largest
    # Both branches of a derivative must be finite.
    ratio = jnp.where(is_above, largest, 1.0) / jnp.where(is_above, variance, 1.0)
    factor = jnp.where(is_above, safe_sqrt(ratio), 1.0)
    return moments._replace(covariance=factor[..., :, None] * moments.covariance * factor[..., None, :])


def _points_of(iterates: list[_Iterate | None]) -> LinearizationPoints:
    nodes, end_moments = (None if iterate is None else iterate.moments for iterate in iterates)
    assert nodes is not None
    return LinearizationPoints(nodes, end_moments)


def _damped_update(old: _Iterate, smoothed: Moments, damping: float) -> _Iterate:
    """Return the iterate between the present moments and those that were smoothed about them."""
    step = smoothed.mean - old.moments.mean
    variance = jnp.diagonal(smoothed.covariance, axis1=-2, axis2=-1)
    # The derivative of 1 / variance must not overflow.
    is_known = variance <= jnp.finfo(variance.dtype).tiny ** 0.25
    precision = jnp.where(is_known, 0.0, 1.0 / jnp.where(is_known, 1.0, variance))
    cross = jnp.sum(precision * old.step * step, axis=-1)
    squared = jnp.sum(precision * old.step * old.step, axis=-1)
    fraction = old.fraction / jnp.maximum(1.0 - cross / (squared + _NEGLIGIBLE_STEP), old.fraction / damping)

    def interpolate(a: jax.Array, b: jax.Array) -> jax.Array:
        return a + fraction.reshape(fraction.shape + (1,) * (a.ndim - fraction.ndim)) * (b - a)

    moments = jax.tree.map(interpolate, old.moments, smoothed)
    change = jnp.max(jnp.abs(step) * safe_sqrt(precision), initial=0.0)
    return _Iterate(moments, step, fraction, change)


def smoothed_points(problem: FilterProblem, trace: FilterTrace, smoothed: SmootherTrace) -> LinearizationPoints:
    """Return the smoothed moments about which the next pass is linearised.

    With the adjoint (r, Lambda) at the end of the interval in which a node lies they are

        m + W r,    P - W Lambda W',    W = Cov(node, state at the interval's end).

    Args:
        problem: the model, the rule and the time grid.
        trace: a forward pass with `Record.LINEARIZATION`.
        smoothed: its backward scan, at least the adjoint.
    """
    ssm, grid = problem.ssm, problem.grid
    indices = linearization_indices(ssm, problem.rule)
    r, adjoint = smoothed.adjoint
    has_jumps = problem.has_jumps

    def smooth_row(moments: Moments, cross: jax.Array, r: jax.Array, adjoint: jax.Array) -> Moments:
        return Moments(moments.mean + matvec(cross, r), moments.covariance - congruence(cross, adjoint))

    end_moments = None
    if not ssm.plan.has_exact_update:
        end_moments = jax.vmap(smooth_row)(trace.predicted, trace.predicted.covariance, r, adjoint)

    def marginal(moments: Moments) -> tuple[Moments, jax.Array]:
        cross = columns(moments.covariance, indices).mT
        return Moments(columns(moments.mean, indices), columns(cross, indices)), cross

    at_start = matvec(trace.phi[0].T, r[0]), congruence(trace.phi[0].T, adjoint[0])
    first = smooth_row(*marginal(trace.initial), *at_start)
    nodes: NodeRecord | None = trace.nodes
    if nodes is None or not indices.size or has_jumps:
        after_jump = jax.vmap(smooth_row)(*marginal(trace.predicted), r, adjoint)
    if nodes is None or not indices.size:
        inner = jax.tree.map(lambda a: jnp.broadcast_to(a[:, None], (len(a), grid.steps, *a.shape[1:])), after_jump)
    else:
        # Interval by interval: XLA fuses the operations of one interval, but not operations on all intervals.
        inner = jax.lax.map(lambda row: smooth_row(*row), (*nodes, r, adjoint))
        if not has_jumps:
            after_jump = jax.tree.map(lambda a: a[:, -1], inner)

    def join(first: jax.Array, after_jump: jax.Array, inner: jax.Array) -> jax.Array:
        starts = jnp.concatenate([first[None], after_jump[:-1]])
        return jnp.concatenate([starts[:, None], inner], axis=1)

    return LinearizationPoints(jax.tree.map(join, first, after_jump, inner), end_moments)
