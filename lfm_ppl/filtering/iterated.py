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
5. Iterations may start from smoothed moments at another point of the parameters (`Anchor`) instead of from a first
   pass. Step 4 then takes the share of the variance of each pass that was its limit at that point.
6. The caller makes the final forward pass about the result: n iterations are n forward and n backward scans, and one
   forward scan more.

The gradient is that of the unrolled iterations, since a fixed number of them is a smooth function of the parameters.

Source: García-Fernández, Svensson and Särkkä (2017), IEEE Transactions on Signal Processing 65(21).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.backward import SmootherTrace, at_interval_starts, backward
from lfm_ppl.filtering.dynamics import columns, linearisation_indices
from lfm_ppl.filtering.forward import FilterTrace, LinearisationPoints, forward
from lfm_ppl.filtering.intervals import TimeGrid
from lfm_ppl.filtering.moments import Moments, Record, matvec
from lfm_ppl.filtering.predict import NodeRecord
from lfm_ppl.filtering.problem import FilterProblem
from lfm_ppl.filtering.update import Updater
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.utils.linalg import congruence, safe_sqrt

DEFAULT_ITERATIONS = 3
"""Iterations of posterior linearisation of models that are not linear."""

_MOST_ITERATIONS, _SETTLED = 100, 1e-9
"""Iterations of an anchor, and the change of its means, in standard deviations, below which they end."""

_NEGLIGIBLE_STEP = 1e-8
"""Square of a step, in standard deviations, below which the secant method has no information."""


class Anchor(NamedTuple):
    """Smoothed moments at one point of the parameters, from which the iterations at other points start.

    Attributes:
        initial_time: of the grid on which they were computed.
        since, length: (N,) starts of the intervals, counted from the initial time, and their lengths.
        points: moments about which the first pass is linearised.
        variance_share: (N, J + 1, k), share of the variance that a pass predicts at the nodes, to which step 4 limits
            the variances there; None where nodes are not recorded.
        change: of the last iteration, largest of all means, in standard deviations.
    """

    initial_time: jax.Array
    since: jax.Array
    length: jax.Array
    points: LinearisationPoints
    variance_share: jax.Array | None
    change: jax.Array

    def on_grid(self, grid: TimeGrid, is_own: bool = False) -> Anchor:
        """Return the moments at the nodes of another time grid, interpolated within the intervals.

        Args:
            grid: the time grid.
            is_own: whether it has the times for which the moments were computed, and no requested ones.
        """
        count, steps = np.shape(self.points.nodes.mean)[0], np.shape(self.points.nodes.mean)[1] - 1
        # Distinct lengths are known where no interval ends at a time that depends on the parameters.
        if is_own and grid.lengths is not None and (count, steps) == (np.shape(grid.intervals.length)[0], grid.steps):
            return self
        since, length = jnp.asarray(grid.since), jnp.asarray(grid.intervals.length)
        node_times = (since + grid.initial_time - self.initial_time)[:, None] + (
            length[:, None] * jnp.linspace(0.0, 1.0, grid.steps + 1))
        # The interval of the anchor in which a node lies. Moments jump at its end, and the first node is after a jump.
        end_times, rounding = self.since + self.length, 1e-9 * length[:, None]
        first_row, later_rows = (jnp.searchsorted(end_times, times) for times in (
            node_times[:, :1] + rounding, node_times[:, 1:] - rounding))
        first_row = jnp.minimum(first_row, later_rows[:, :1])
        row = jnp.minimum(jnp.concatenate([first_row, later_rows], axis=1), count - 1)
        own_length = self.length[row]
        position = (node_times - self.since[row]) / jnp.where(own_length > 0.0, own_length, 1.0)
        position = steps * jnp.clip(position, 0.0, 1.0)
        lower = jnp.minimum(position.astype(int), steps - 1)

        def interpolate(a: jax.Array) -> jax.Array:
            weight = (position - lower).reshape(position.shape + (1,) * (a.ndim - 2))
            return (1.0 - weight) * a[row, lower] + weight * a[row, lower + 1]

        nodes, share = jax.tree.map(interpolate, (self.points.nodes, self.variance_share))
        end_moments = jax.tree.map(lambda a: a[row[:, -1]], self.points.end_moments)
        return Anchor(jnp.asarray(grid.initial_time, float), since, length, LinearisationPoints(nodes, end_moments),
                      share, self.change)


class IterationResult(NamedTuple):
    """Result of the iterations.

    Attributes:
        points: moments about which the last pass is linearised; None: the filter's.
        change: largest change of a mean in the last iteration, in standard deviations; NaN with fewer than two.
        log_likelihood: of the pass of the last iteration, about the points before the last ones; NaN with fewer than
            two.
    """

    points: LinearisationPoints | None
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


class _Iterations(NamedTuple):
    """State of the iterations.

    Attributes:
        iterates: at the nodes and, where the observation is not linear, at the intervals' ends.
        log_likelihood: of the last pass; NaN before the first one.
    """

    iterates: tuple[_Iterate, _Iterate | None]
    log_likelihood: jax.Array

    @property
    def points(self) -> LinearisationPoints:
        """The moments of the iterates."""
        nodes, end_moments = self.iterates
        return LinearisationPoints(nodes.moments, None if end_moments is None else end_moments.moments)

    @property
    def change(self) -> jax.Array:
        """Largest change of a mean in the last iteration, in standard deviations."""
        return jnp.max(jnp.stack([iterate.change for iterate in self.iterates if iterate is not None]))


def number_of_iterations(iterations: int | None, ssm: StateSpaceModel, tolerance: float | None) -> int:
    """Return the number of iterations of the smoother and of the likelihood, the default for None.

    A linear model, an observation family and steps that follow a tolerance take none by default.
    """
    if iterations is not None:
        return iterations
    is_family = isinstance(ssm.model.observation, ObservationFamily)
    return 0 if is_family or tolerance is not None or ssm.plan.is_linear else DEFAULT_ITERATIONS


def posterior_linearisation(problem: FilterProblem, updater: Updater, iterations: Any, damping: float,
                            anchor: Anchor | None = None) -> IterationResult:
    """Return the moments after a fixed number of iterations, so that they are smooth in the parameters.

    Args:
        problem: the model, the rule and the time grid.
        updater: how observations update the moments.
        iterations: number of backward scans; a traced one, from an anchor, leaves no derivative in reverse mode.
        damping: largest fraction of the new marginals that is taken, in (0, 1].
        anchor: moments on this grid to start from; None: the filter's.

    Raises:
        ValueError: the anchor has moments of other states.
    """
    unknown = jnp.asarray(jnp.nan)
    if anchor is None and isinstance(iterations, int) and iterations == 0:
        return IterationResult(None, unknown, unknown)
    if anchor is not None:
        _check_states(problem, anchor)
    state, largest = _first_state(problem, updater, damping, anchor)
    count = iterations - 1 if anchor is None else iterations
    if not (isinstance(count, int) and count == 0):
        share = None if anchor is None else anchor.variance_share
        # With a fixed count this is a scan, which has a derivative in reverse mode.
        state = jax.lax.fori_loop(0, count, lambda _, state: _iterate(
            problem, updater, damping, state, largest, share), state)
    if isinstance(iterations, int) and iterations < 2:
        return IterationResult(state.points, unknown, unknown)
    return IterationResult(state.points, state.change, state.log_likelihood)


def converged_anchor(problem: FilterProblem, updater: Updater, damping: float, anchor: Anchor | None = None) -> Anchor:
    """Return the moments after as many iterations as they change; it has no derivative in reverse mode.

    Args:
        problem: the model, the rule and the time grid.
        updater: how observations update the moments.
        damping: largest fraction of the new marginals that is taken, in (0, 1].
        anchor: moments on this grid to start from; None: the filter's.
    """
    state, largest = _first_state(problem, updater, damping, anchor)
    share = None if anchor is None else anchor.variance_share

    def is_moving(counted: tuple[jax.Array, _Iterations]) -> jax.Array:
        count, state = counted
        return (count < _MOST_ITERATIONS) & ~(state.change < _SETTLED)

    def iterate(counted: tuple[jax.Array, _Iterations]) -> tuple[jax.Array, _Iterations]:
        count, state = counted
        return count + 1, _iterate(problem, updater, damping, state, largest, share)

    _, state = jax.lax.while_loop(is_moving, iterate, (jnp.asarray(0), state))
    initial_time, since, length = (jnp.asarray(part, float) for part in (
        problem.grid.initial_time, problem.grid.since, problem.grid.intervals.length))
    if anchor is not None or largest is None:
        return Anchor(initial_time, since, length, state.points, share, state.change)
    predicted = predicted_variance(problem, forward(problem, updater, about=state.points, record=Record.LINEARIZATION))
    assert predicted is not None
    is_known = predicted <= 0.0
    share = jnp.where(is_known, 1.0, largest / jnp.where(is_known, 1.0, predicted))
    return Anchor(initial_time, since, length, state.points, share, state.change)


def _check_states(problem: FilterProblem, anchor: Anchor) -> None:
    expected = len(linearisation_indices(problem.ssm, problem.rule))
    if (count := np.shape(anchor.points.nodes.mean)[-1]) != expected:
        raise ValueError(f"about has moments of {count} states, and this model with this rule is linearised about "
                         f"{expected}; take the anchor of a likelihood of the same model and rule.")


def _first_state(problem: FilterProblem, updater: Updater, damping: float,
                 anchor: Anchor | None) -> tuple[_Iterations, jax.Array | None]:
    """Return the moments of an anchor, or those after a first pass with the variances that limit all later ones."""
    largest = None
    if anchor is None:
        single_pass = forward(problem, updater, record=Record.LINEARIZATION)
        largest = predicted_variance(problem, single_pass)
        points = _smoothed(problem, single_pass)
        if largest is not None:
            points = points._replace(nodes=limit_variance(points.nodes, largest))
    else:
        points = anchor.points

    def first(moments: Moments) -> _Iterate:
        return _Iterate(moments, jnp.zeros_like(moments.mean), jnp.full(moments.mean.shape[:-1], damping),
                        jnp.asarray(jnp.nan))

    iterates = first(points.nodes), None if points.end_moments is None else first(points.end_moments)
    return _Iterations(iterates, jnp.asarray(jnp.nan)), largest


def _iterate(problem: FilterProblem, updater: Updater, damping: float, state: _Iterations, largest: jax.Array | None,
             variance_share: jax.Array | None) -> _Iterations:
    """Return the state after one iteration.

    Variances at the nodes are at most ``largest``, or the share of those that the pass predicts.
    """
    trace = forward(problem, updater, about=state.points, record=Record.LINEARIZATION)
    if variance_share is not None and (predicted := predicted_variance(problem, trace)) is not None:
        largest = variance_share * predicted
    smoothed = _smoothed(problem, trace)
    nodes, end_moments = state.iterates
    nodes = _damped_update(nodes, smoothed.nodes, damping)
    if largest is not None:
        nodes = nodes._replace(moments=limit_variance(nodes.moments, largest))
    if end_moments is not None:
        assert smoothed.end_moments is not None
        end_moments = _damped_update(end_moments, smoothed.end_moments, damping)
    return _Iterations((nodes, end_moments), trace.log_likelihood.sum())


def _smoothed(problem: FilterProblem, trace: FilterTrace) -> LinearisationPoints:
    return smoothed_points(problem, trace, backward(problem, trace, adjoint_only=True))


def predicted_variance(problem: FilterProblem, single_pass: FilterTrace) -> jax.Array | None:
    """Return the variances (N, J + 1, k) that the first pass predicts at the nodes; None where it records no steps.

    At the start of an interval it is the filtered variance there.
    """
    if single_pass.nodes is None:
        return None
    indices = linearisation_indices(problem.ssm, problem.rule)

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


def smoothed_points(problem: FilterProblem, trace: FilterTrace, smoothed: SmootherTrace) -> LinearisationPoints:
    """Return the smoothed moments about which the next pass is linearised.

    With the adjoint (r, Lambda) at the end of the interval in which a node lies they are

        m + W r,    P - W Lambda W',    W = Cov(node, state at the interval's end).

    Args:
        problem: the model, the rule and the time grid.
        trace: a forward pass with `Record.LINEARIZATION`.
        smoothed: its backward scan, at least the adjoint.
    """
    ssm, grid = problem.ssm, problem.grid
    indices = linearisation_indices(ssm, problem.rule)
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

    return LinearisationPoints(jax.tree.map(join, first, after_jump, inner), end_moments)
