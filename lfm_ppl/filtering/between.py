"""Smoothed marginals between the nodes of a scan, which they leave alone."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.filter import integrate, step_transition
from lfm_ppl.filtering.jumps import after_jump
from lfm_ppl.filtering.predict import Moments, Prediction
from lfm_ppl.filtering.retrospect import combine, given_later
from lfm_ppl.filtering.rts import at_start
from lfm_ppl.filtering.schedule import Rows, Schedule, as_arrays
from lfm_ppl.filtering.transition import linear_part
from lfm_ppl.linalg import congruence, matmul
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.augment import StateSpaceModel


class Places(NamedTuple):
    """Where requested times lie among the rows.

    Attributes:
        row: (K,) the row that contains the time.
        time: (K,).
        at_end: (K,) whether it is the row's end.
    """

    row: Any
    time: Any
    at_end: Any


def places(plan: Schedule, times: Any) -> Places:
    """Find times among the rows of a plan that is known before compilation."""
    times = np.asarray(times, float)
    ends = np.append(np.asarray(plan.rows.start)[1:], plan.rows.start[-1] + plan.rows.length[-1])
    tolerance = 1e-13 * (1.0 + np.abs(times))
    row = np.minimum(np.searchsorted(ends, times - tolerance, side="left"), len(ends) - 1)
    at_end = np.abs(times - ends[row]) <= tolerance
    # Of several rows that end at this time (replicates), the last.
    last = np.searchsorted(ends, ends[row] + tolerance, side="right") - 1
    return Places(np.where(at_end, last, row), times, at_end)


class Branches(NamedTuple):
    """Rows from whose starts the marginals within them branch off.

    Attributes:
        plan: the rows.
        filtered: (N, ...) at their ends.
        smoothed: (N + 1, ...) at the nodes.
        adjoint: r and Lambda at the rows' ends.
        about: moments (N, ...) at the rows' starts and ends to linearise about; None: the filter's own.
    """

    plan: Schedule
    filtered: Moments
    smoothed: Moments
    adjoint: tuple[jax.Array, jax.Array]
    about: tuple[Moments, Moments] | None


def marginals_between(ssm: StateSpaceModel, rule: Rule, given: Branches, start: Moments, where: Places) -> Moments:
    """Return smoothed moments at any times within the rows.

    Each time branches off on its own: the filter's moments at the start of its row are predicted up to it, and on to
    the end of the row, whence what the later observations say comes back through the second piece. The steps of the
    scan itself are not cut, so that asking for times changes nothing, neither there nor at other requested times.

    The pieces therefore differ from the row by an integration error, which `combine` keeps from being magnified.

    Args:
        ssm: the model.
        rule: the linearisation rule.
        given: the rows, and what is known of them.
        start: moments at the initial time.
        where: the requested times.
    """
    plan, filtered, smoothed, adjoint, about = given
    linear, jumps = linear_part(ssm, jnp.asarray(plan.initial_time, float)), ssm.stack.jump_table()
    before = at_start(filtered, start)
    rows = as_arrays(plan.rows)

    def piece(begin: jax.Array, length: jax.Array, moments: Moments, nearby: Any, flow: bool) -> Prediction:
        factor = step_transition(ssm, rule, linear, plan, length)
        return integrate(ssm, rule, plan, linear, factor, begin, length, moments, nearby, flow)

    def one(index: jax.Array, t: jax.Array, exactly: jax.Array) -> Moments:
        here: Rows = _entry(rows, index)
        first, last = _entry(smoothed, index), _entry(smoothed, index + 1)
        length = jnp.clip(t - here.start, 0.0, here.length)
        nearby: tuple[Any, Any] = (None, None)
        if about is not None:
            left, right = _entry(about, index)
            share = jnp.where(here.length > 0, length / jnp.where(here.length > 0, here.length, 1.0), 0.0)
            middle = jax.tree_util.tree_map(lambda a, b: a + share * (b - a), left, right)
            pair = lambda *ends: jax.tree_util.tree_map(lambda a, b: jnp.stack([a, b]), *ends)  # noqa: E731
            nearby = pair(left, middle), pair(middle, right)
        now = piece(here.start, length, _entry(before, index), nearby[0], False).moments
        rest = piece(here.start + length, here.length - length, now, nearby[1], True)
        if jumps is not None:
            rest = after_jump(ssm, jumps, here.jump, rest, flow=True)
        gain, conditional = given_later(now, rest.moments, rest.phi, rest.noise)
        r, curvature = adjoint[0][index], adjoint[1][index]
        back = matmul(rest.phi.T, r[:, None])[:, 0], congruence(rest.phi.T, curvature)
        inside = combine(now, rest.moments, last, gain, conditional, *back)
        begins = length == 0
        return jax.tree_util.tree_map(
            lambda inside, node, end: jnp.where(exactly, end, jnp.where(begins, node, inside)), inside, first, last)

    places = tuple(jnp.asarray(a) for a in where)
    if plan.tolerance is not None:
        # Side by side, every piece would make as many steps as may be tried.
        return jax.lax.map(lambda place: one(*place), places)
    return jax.vmap(one)(*places)


def _entry(tree: Any, index: jax.Array) -> Any:
    return jax.tree_util.tree_map(lambda a: a[index], tree)
