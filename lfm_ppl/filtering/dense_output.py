"""Smoothed marginals between the nodes of a scan, which they leave alone."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.filter import integrate, step_transition
from lfm_ppl.filtering.jumps import after_jump
from lfm_ppl.filtering.predict import Moments, Prediction
from lfm_ppl.filtering.rts import at_start
from lfm_ppl.filtering.smoothing_kernel import smoothed_moments, smoothing_kernel
from lfm_ppl.filtering.time_grid import Intervals, TimeGrid, as_arrays
from lfm_ppl.filtering.transition import linear_part
from lfm_ppl.linalg import congruence, matmul
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.state_space import StateSpaceModel


class Places(NamedTuple):
    """Where requested times lie among the intervals.

    Attributes:
        interval: (K,) the interval that contains the time.
        time: (K,).
        at_end: (K,) whether it is the interval's end.
    """

    interval: Any
    time: Any
    at_end: Any


def places(grid: TimeGrid, times: Any) -> Places:
    """Find times among the intervals of a time grid that is known before compilation."""
    times = np.asarray(times, float)
    ends = np.append(np.asarray(grid.intervals.start)[1:], grid.intervals.start[-1] + grid.intervals.length[-1])
    tolerance = 1e-13 * (1.0 + np.abs(times))
    row = np.minimum(np.searchsorted(ends, times - tolerance, side="left"), len(ends) - 1)
    at_end = np.abs(times - ends[row]) <= tolerance
    # Of several intervals that end at this time (replicates), the last.
    last = np.searchsorted(ends, ends[row] + tolerance, side="right") - 1
    return Places(np.where(at_end, last, row), times, at_end)


class Branches(NamedTuple):
    """Intervals from whose starts the marginals within them branch off.

    Attributes:
        grid: the time grid.
        filtered: (N, ...) at their ends.
        smoothed: (N + 1, ...) at the nodes.
        adjoint: r and Lambda at the intervals' ends.
        linearization_point: moments (N, ...) at the intervals' starts and ends to linearise about; None: the filter's
            own.
    """

    grid: TimeGrid
    filtered: Moments
    smoothed: Moments
    adjoint: tuple[jax.Array, jax.Array]
    linearization_point: tuple[Moments, Moments] | None


def dense_output(ssm: StateSpaceModel, rule: Rule, given: Branches, start: Moments, where: Places) -> Moments:
    """Return smoothed moments at any times within the intervals.

    Each time branches off on its own: the filter's moments at the start of its interval are predicted up to it, and on
    to the end of the interval, whence what the later observations say comes back through the second piece. The steps of
    the scan itself are not cut, so that asking for times changes nothing, neither there nor at other requested times.

    The pieces therefore differ from the interval by an integration error, which `smoothed_moments` keeps from being
    magnified.

    Args:
        ssm: the model.
        rule: the linearisation rule.
        given: the intervals, and what is known of them.
        start: moments at the initial time.
        where: the requested times.
    """
    grid, filtered, smoothed, adjoint, linearization_point = given
    linear, jumps = linear_part(ssm, jnp.asarray(grid.initial_time, float)), ssm.stack.jump_table()
    before = at_start(filtered, start)
    intervals = as_arrays(grid.intervals)

    def piece(begin: jax.Array, length: jax.Array, moments: Moments, points: Any, with_map: bool) -> Prediction:
        factor = step_transition(ssm, rule, linear, grid, length)
        return integrate(ssm, rule, grid, linear, factor, begin, length, moments, points, with_map)

    def one(index: jax.Array, t: jax.Array, exactly: jax.Array) -> Moments:
        here: Intervals = _entry(intervals, index)
        first, last = _entry(smoothed, index), _entry(smoothed, index + 1)
        length = jnp.clip(t - here.start, 0.0, here.length)
        points: tuple[Any, Any] = (None, None)
        if linearization_point is not None:
            left, right = _entry(linearization_point, index)
            share = jnp.where(here.length > 0, length / jnp.where(here.length > 0, here.length, 1.0), 0.0)
            middle = jax.tree_util.tree_map(lambda a, b: a + share * (b - a), left, right)
            pair = lambda *ends: jax.tree_util.tree_map(lambda a, b: jnp.stack([a, b]), *ends)  # noqa: E731
            points = pair(left, middle), pair(middle, right)
        now = piece(here.start, length, _entry(before, index), points[0], False).moments
        rest = piece(here.start + length, here.length - length, now, points[1], True)
        if jumps is not None:
            rest = after_jump(ssm, jumps, here.jump, rest, with_map=True)
        gain, conditional = smoothing_kernel(now, rest.moments, rest.phi, rest.process_cov)
        r, curvature = adjoint[0][index], adjoint[1][index]
        back = matmul(rest.phi.T, r[:, None])[:, 0], congruence(rest.phi.T, curvature)
        inside = smoothed_moments(now, rest.moments, last, gain, conditional, *back)
        begins = length == 0
        return jax.tree_util.tree_map(
            lambda inside, node, end: jnp.where(exactly, end, jnp.where(begins, node, inside)), inside, first, last)

    places = tuple(jnp.asarray(a) for a in where)
    if grid.tolerance is not None:
        # Side by side, every piece would make as many steps as may be tried.
        return jax.lax.map(lambda place: one(*place), places)
    return jax.vmap(one)(*places)


def _entry(tree: Any, index: jax.Array) -> Any:
    return jax.tree_util.tree_map(lambda a: a[index], tree)
