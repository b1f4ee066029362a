"""Smoothed marginals between the nodes of a scan, which they leave alone."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.filter import integrate, step_transition
from lfm_ppl.filtering.jumps import after_jump, jump_map
from lfm_ppl.filtering.predict import Moments, Prediction, compose
from lfm_ppl.filtering.rts import at_start
from lfm_ppl.filtering.smoothing_kernel import smoothed_moments, smoothing_kernel
from lfm_ppl.filtering.time_grid import Intervals, TimeGrid, as_arrays
from lfm_ppl.filtering.transition import linear_part
from lfm_ppl.linalg import congruence, matmul
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.state_space import Span, StateSpaceModel


class Places(NamedTuple):
    """Where requested times lie among the intervals.

    Attributes:
        interval: (K,) the interval that contains the time.
        step: (K,) the integration step of it.
        offset: (K,) the time, counted from the start of the interval.
        at_end: (K,) whether it is the interval's end.
    """

    interval: Any
    step: Any
    offset: Any
    at_end: Any


def places(grid: TimeGrid, times: Any) -> Places:
    """Find times among the intervals of a time grid that is known before compilation."""
    # Counted from the initial time, so that the origin of time does not matter.
    times = np.asarray(times, float) - np.asarray(grid.initial_time)
    begins, lengths = (np.asarray(a) for a in (grid.since, grid.intervals.length))
    ends = np.append(begins[1:], begins[-1] + lengths[-1])
    tolerance = 1e-13 * np.abs(times)
    row = np.minimum(np.searchsorted(ends, times - tolerance, side="left"), len(ends) - 1)
    at_end = np.abs(times - ends[row]) <= tolerance
    # Of several intervals that end at this time (replicates), the last.
    last = np.searchsorted(ends, ends[row] + tolerance, side="right") - 1
    row = np.where(at_end, last, row)
    offset = times - begins[row]
    share = offset / np.where(lengths[row] > 0, lengths[row], 1.0)
    return Places(row, np.clip((share * grid.steps).astype(int), 0, grid.steps - 1), offset, at_end)


class Steps(NamedTuple):
    """The integration steps of each interval.

    Attributes:
        moments: predicted, (N, J, n) and (N, J, n, n) at their ends, before a jump.
        to_end: phi and process_cov (N, J, n, n) from there to the interval's end, a jump there included.
    """

    moments: Moments
    to_end: tuple[jax.Array, jax.Array]


class Branches(NamedTuple):
    """Intervals, from within which the marginals branch off.

    Attributes:
        grid: the time grid.
        predicted: (N, ...) at their ends.
        filtered: (N, ...) at their ends.
        smoothed: (N + 1, ...) at the nodes.
        adjoint: r and Lambda at the intervals' ends.
        steps: from whose starts the marginals branch off; None: from those of the intervals.
        linearization_point: moments (N, J + 1, ...) at the ends of the steps to linearise about; None: the filter's
            own, as always without steps.
    """

    grid: TimeGrid
    predicted: Moments
    filtered: Moments
    smoothed: Moments
    adjoint: tuple[jax.Array, jax.Array]
    steps: Steps | None = None
    linearization_point: Moments | None = None


def dense_output(ssm: StateSpaceModel, rule: Rule, given: Branches, start: Moments, where: Places) -> Moments:
    """Return smoothed moments at any times within the intervals.

    Each time branches off on its own: the filter's moments at the start of its integration step are predicted up to it,
    and on to the end of the step and, by its map, of the interval, whence what the later observations say comes back.
    The steps of the scan itself are not cut, so that asking for times changes nothing, neither there nor at other
    requested times. Without steps (of which one interval may make many) both pieces are those of the interval.

    The pieces therefore differ from the interval by an integration error, which `smoothed_moments` keeps from being
    magnified.

    Args:
        ssm: the model.
        rule: the linearisation rule.
        given: the intervals, and what is known of them.
        start: moments at the initial time.
        where: the requested times.
    """
    grid, steps = given.grid, given.steps
    linear, jumps = linear_part(ssm, jnp.asarray(grid.initial_time, float)), ssm.stack.jump_table()
    before = at_start(given.filtered, start)
    intervals = as_arrays(grid.intervals)
    pieces = grid if steps is None else grid._replace(steps=1)

    def piece(span: Span, length: jax.Array, moments: Moments, points: Any, with_map: bool) -> Prediction:
        factor = step_transition(ssm, rule, linear, pieces, length)
        return integrate(ssm, rule, pieces, linear, factor, span, length, moments, points, with_map)

    def one(index: jax.Array, step: jax.Array, offset: jax.Array, exactly: jax.Array) -> Moments:
        here: Intervals = _entry(intervals, index)
        first, last = _entry(given.smoothed, index), _entry(given.smoothed, index + 1)
        origin, begin, whole = _entry(before, index), jnp.zeros(()), here.length
        if steps is not None:
            whole = here.length / grid.steps
            begin = step * whole
            inside = jax.tree_util.tree_map(lambda a: a[index, jnp.maximum(step - 1, 0)], steps.moments)
            origin = jax.tree_util.tree_map(lambda a, b: jnp.where(step > 0, a, b), inside, origin)
        length = jnp.clip(offset - begin, 0.0, whole)
        points: tuple[Any, Any] = (None, None)
        if given.linearization_point is not None:
            left, right = (jax.tree_util.tree_map(lambda a: a[index, step + k], given.linearization_point)  # noqa: B023
                           for k in (0, 1))
            share = jnp.where(whole > 0, length / jnp.where(whole > 0, whole, 1.0), 0.0)
            middle = jax.tree_util.tree_map(lambda a, b: a + share * (b - a), left, right)
            pair = lambda *ends: jax.tree_util.tree_map(lambda a, b: jnp.stack([a, b]), *ends)  # noqa: E731
            points = pair(left, middle), pair(middle, right)
        now = piece(here.span.after(begin), length, origin, points[0], False).moments
        rest = piece(here.span.after(begin + length), whole - length, now, points[1], True)
        if steps is not None:
            rest = _to_end(rest, _entry(given.predicted, index),
                           *jax.tree_util.tree_map(lambda a: a[index, step], steps))
        elif jumps is not None:
            rest = after_jump(ssm, jumps, here.jump, rest, with_map=True)
        kernel = smoothing_kernel(now, rest.moments, rest.phi, rest.process_cov)
        r, curvature = given.adjoint[0][index], given.adjoint[1][index]
        back = matmul(rest.phi.T, r[:, None])[:, 0], congruence(rest.phi.T, curvature)
        inside = smoothed_moments(now, rest.moments, last, kernel, *back)
        begins = offset <= 0
        return jax.tree_util.tree_map(
            lambda inside, node, end: jnp.where(exactly, end, jnp.where(begins, node, inside)), inside, first, last)

    places = tuple(jnp.asarray(a) for a in where)
    if grid.tolerance is not None:
        # Side by side, every piece would make as many steps as may be tried.
        return jax.lax.map(lambda place: one(*place), places)
    return jax.vmap(one)(*places)


def _to_end(rest: Prediction, predicted: Moments, end_of_step: Moments,
            to_end: tuple[jax.Array, jax.Array]) -> Prediction:
    """Carry a prediction on from the end of its step to the interval's, where the filter predicts ``predicted``."""
    on, added = to_end
    phi, process_cov = compose((rest.phi, rest.process_cov), to_end)
    mean = predicted.mean + matmul(on, (rest.moments.mean - end_of_step.mean)[:, None])[:, 0]
    return Prediction(Moments(mean, congruence(on, rest.moments.covariance) + added), phi, process_cov)


def steps_to_end(ssm: StateSpaceModel, grid: TimeGrid, made: Prediction) -> Steps:
    """Return the steps of intervals from their predictions (N, J, ...)."""
    last = jnp.eye(ssm.state_dim), jnp.zeros((ssm.state_dim,) * 2)
    last = jax.tree_util.tree_map(lambda a: jnp.broadcast_to(a, (made.phi.shape[0], *a.shape)), last)
    if (jumps := ssm.stack.jump_table()) is not None:
        last = jax.vmap(lambda index: jump_map(ssm, jumps, index))(jnp.asarray(grid.intervals.jump))

    def step(later: tuple, one: tuple) -> tuple[tuple, tuple]:
        return compose(one, later), later

    by_step = lambda a: jnp.moveaxis(a, 1, 0)  # noqa: E731
    _, found = jax.lax.scan(step, last, (by_step(made.phi), by_step(made.process_cov)), reverse=True)
    return Steps(made.moments, jax.tree_util.tree_map(by_step, found))


def _entry(tree: Any, index: jax.Array) -> Any:
    return jax.tree_util.tree_map(lambda a: a[index], tree)
