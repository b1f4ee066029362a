"""Iterated posterior linearisation: smooth, linearise about the smoothed marginals, repeat.

Where a pass has its linearisation points given, the affine maps of its steps do not depend on one another: they are
made side by side and composed, so that the scans over time have one entry a row and not one a step.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.between import Branches
from lfm_ppl.filtering.filter import GivenRows, Pass, Preparation, forward, preparation, row_transition
from lfm_ppl.filtering.jumps import after_jump
from lfm_ppl.filtering.predict import Moments, Prediction, predict_exact, predict_row
from lfm_ppl.filtering.retrospect import combine, given_later
from lfm_ppl.filtering.rts import Smoothed, at_start, backward
from lfm_ppl.filtering.schedule import Rows, Schedule, as_arrays
from lfm_ppl.filtering.update import linearise_observation
from lfm_ppl.linalg import congruence, matmul, safe_sqrt
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.augment import StateSpaceModel


class Steps(NamedTuple):
    """The affine maps of the integration steps within the rows.

    Attributes:
        phi, noise: (N, J, n, n), s -> phi s + ... + N(0, noise) over each step.
        to_end: phi and noise (N, J + 1, n, n) from each node to the row's end, a jump there included.
    """

    phi: jax.Array
    noise: jax.Array
    to_end: tuple[jax.Array, jax.Array]


class Prefix(NamedTuple):
    """The rows' maps from their starts to the end of each step: s -> value + phi (s - point) + N(0, noise).

    ``value`` (N, J, n), ``phi`` and ``noise`` (N, J, n, n); the point is that of `GivenRows`.
    """

    value: jax.Array
    phi: jax.Array
    noise: jax.Array


class Iterated(NamedTuple):
    """What the iterations leave.

    Attributes:
        nodes: smoothed marginals (N, J + 1, ...) at the ends of the steps of each row, before a jump; the last
            linearisation is made about them.
        given: the rows of that linearisation.
        steps, prefix: its steps, and their compositions; None for a model whose rows are exact.
        change: largest change of a mean in the last iteration, in standard deviations.
    """

    nodes: Moments
    given: GivenRows
    steps: Steps | None
    prefix: Prefix | None
    change: jax.Array


def posterior_linearisation(ssm: StateSpaceModel, rule: Rule, plan: Schedule, y: jax.Array, start: Moments,
                            iterations: int, damping: float) -> Iterated:
    """Iterate: smooth, linearise about the smoothed marginals, smooth again.

    Args:
        ssm: the model.
        rule: the linearisation rule.
        plan: the rows.
        y: (T, D), NaN where missing.
        start: moments at the initial time.
        iterations: fixed number, so that the result is a smooth function of the parameters.
        damping: share of the new marginals that is taken, in (0, 1].

    Source: García-Fernández, Svensson and Särkkä (2017), IEEE Transactions on Signal Processing 65(21).
    """
    prepared = preparation(ssm, plan)
    passed = forward(ssm, rule, plan, y, start=start, keep="steps")
    steps: Steps | None = None
    filtered: Moments | None = None
    if passed.steps is not None:
        filtered = passed.steps.moments
        steps = _with_ends(ssm, plan, prepared, passed.steps.phi, passed.steps.noise)
    unknown = jnp.asarray(jnp.nan)
    points = _smoothed_points(plan, prepared, start, passed, steps, filtered)

    def iterate(carry: tuple[_Points, jax.Array], _: None) -> tuple[tuple[_Points, jax.Array], None]:
        points = carry[0]
        given, steps, prefix = _linearised(ssm, rule, plan, prepared, points)
        passed = forward(ssm, rule, plan, y, start=start, given=given, keep="all")
        filtered = None if prefix is None else _filtered_nodes(at_start(passed.filtered, start), given, prefix)
        new = _smoothed_points(plan, prepared, start, passed, steps, filtered)
        sd = safe_sqrt(jnp.diagonal(new.nodes.covariance, axis1=-2, axis2=-1))
        change = jnp.abs(new.nodes.mean - points.nodes.mean) / jnp.where(sd > 0, sd, 1.0)
        change = jnp.max(jnp.where(sd > 0, change, 0.0))
        return (jax.tree_util.tree_map(lambda a, b: a + damping * (b - a), points, new), change), None

    (points, change), _ = jax.lax.scan(jax.checkpoint(iterate), (points, unknown), None,
                                       length=iterations - 1)
    given, steps, prefix = _linearised(ssm, rule, plan, prepared, points)
    return Iterated(points.nodes, given, steps, prefix, change)


class _Points(NamedTuple):
    """Moments about which a pass is linearised: at the nodes (N, J + 1, ...) and after each row's jump (N, ...)."""

    nodes: Moments
    ends: Moments


def _linearised(ssm: StateSpaceModel, rule: Rule, plan: Schedule, prepared: Preparation,
                points: _Points) -> tuple[GivenRows, Steps | None, Prefix | None]:
    """Linearise all steps of all rows, and compose those of each row."""
    rows = as_arrays(plan.rows)
    nodes, ends = points

    def observe(row: Rows, end: Moments) -> Any:
        return linearise_observation(ssm, rule, prepared.jacobian, row.start + row.length,
                                     jnp.maximum(row.observation, 0), end)

    observation = jax.vmap(observe)(rows, ends)
    point = nodes.mean[:, 0]
    if ssm.time_invariant:
        def whole(row: Rows, at: jax.Array) -> Prediction:
            transition = row_transition(ssm, plan, prepared, row)
            moved = Moments(at, jnp.zeros((at.shape[0],) * 2))
            one = predict_exact(ssm, transition, plan.steps, row.start, row.length, moved)
            return one if prepared.jumps is None else after_jump(ssm, prepared.jumps, row.jump, one, flow=True)

        one = jax.vmap(whole)(rows, point)
        return GivenRows(point, one.moments.mean, one.phi, one.noise, observation, ends.mean), None, None

    def linearise(row: Rows, left: Moments, right: Moments) -> Prediction:
        factor = row_transition(ssm, plan, prepared, row)
        h = row.length / plan.steps

        def step(index: jax.Array, one: Moments, next_: Moments) -> Prediction:
            return predict_row(ssm, rule, prepared.linear, factor, 1, row.start + index * h, h, one, (one, next_),
                               flow=True)

        return jax.vmap(step)(jnp.arange(plan.steps), left, right)

    left = jax.tree_util.tree_map(lambda a: a[:, :-1], nodes)
    right = jax.tree_util.tree_map(lambda a: a[:, 1:], nodes)
    each = jax.vmap(linearise)(rows, left, right)
    prefix = _composed(each, left.mean)
    value, phi, noise = (a[:, -1] for a in prefix)
    if (jumps := prepared.jumps) is not None:
        whole_rows = Prediction(Moments(value, jnp.zeros_like(phi)), phi, noise)
        jumped = jax.vmap(lambda row, one: after_jump(ssm, jumps, row.jump, one, flow=True))(rows, whole_rows)
        value, phi, noise = jumped.moments.mean, jumped.phi, jumped.noise
    given = GivenRows(point, value, phi, noise, observation, ends.mean)
    return given, _with_ends(ssm, plan, prepared, each.phi, each.noise), prefix


def _composed(each: Prediction, point: jax.Array) -> Prefix:
    """Compose the maps of each row's steps from its start."""

    def step(carry: tuple, one: tuple) -> tuple[tuple, tuple]:
        value, phi, noise = carry
        moved, at, phi_step, noise_step = one
        value = moved + matmul(phi_step, (value - at)[..., None])[..., 0]
        carry = value, matmul(phi_step, phi), congruence(phi_step, noise) + noise_step
        return carry, carry

    identity = jnp.broadcast_to(jnp.eye(point.shape[-1]), each.phi[:, 0].shape)
    first = point[:, 0], identity, jnp.zeros_like(identity)
    along = tuple(jnp.moveaxis(a, 1, 0) for a in (each.moments.mean, point, each.phi, each.noise))
    _, found = jax.lax.scan(step, first, along)
    return Prefix(*(jnp.moveaxis(a, 0, 1) for a in found))


def _with_ends(ssm: StateSpaceModel, plan: Schedule, prepared: Preparation, phi: jax.Array,
               noise: jax.Array) -> Steps:
    """Compose the maps of each row's steps to its end, a jump there included."""
    identity = jnp.broadcast_to(jnp.eye(phi.shape[-1]), phi[:, 0].shape)
    last = identity, jnp.zeros_like(identity)
    if (jumps := prepared.jumps) is not None:
        still = Prediction(Moments(jnp.zeros(identity.shape[:2]), last[1]), *last)
        jumped = jax.vmap(lambda jump, one: after_jump(ssm, jumps, jump, one, flow=True))(
            jnp.asarray(plan.rows.jump), still)
        last = jumped.phi, jumped.noise

    def step(later: tuple, one: tuple) -> tuple[tuple, tuple]:
        now = matmul(later[0], one[0]), congruence(later[0], one[1]) + later[1]
        return now, now

    _, found = jax.lax.scan(step, last, tuple(jnp.moveaxis(a, 1, 0) for a in (phi, noise)), reverse=True)
    to_end = tuple(jnp.concatenate([jnp.moveaxis(a, 0, 1), b[:, None]], axis=1)
                   for a, b in zip(found, last, strict=True))
    return Steps(phi, noise, (to_end[0], to_end[1]))


def _filtered_nodes(before: Moments, given: GivenRows, prefix: Prefix) -> Moments:
    """Return the filtered moments (N, J, ...) at the ends of the steps, before a jump."""
    away = (before.mean - given.point)[:, None, :, None]
    mean = prefix.value + matmul(prefix.phi, away)[..., 0]
    return Moments(mean, congruence(prefix.phi, before.covariance[:, None]) + prefix.noise)


def _smoothed_points(plan: Schedule, prepared: Preparation, start: Moments, passed: Pass, steps: Steps | None,
                     filtered: Moments | None) -> _Points:
    """Smooth, and return the marginals at all nodes."""
    smoothed = backward(passed, start, plan)
    return _Points(smoothed_nodes(plan, prepared, passed, smoothed, steps, filtered),
                   jax.tree_util.tree_map(lambda a: a[1:], smoothed.moments))


def smoothed_nodes(plan: Schedule, prepared: Preparation, passed: Pass, smoothed: Smoothed, steps: Steps | None,
                   filtered: Moments | None) -> Moments:
    """Return the smoothed moments (N, J + 1, ...) at the ends of all steps, before a jump.

    Args:
        plan: the rows.
        prepared: what they share.
        passed: the forward scan.
        smoothed: the backward scan.
        steps: the steps within the rows; None: the rows' starts and ends are all there is.
        filtered: (N, J, ...) at the steps' ends.
    """
    first = jax.tree_util.tree_map(lambda a: a[:-1, None], smoothed.moments)
    ends = jax.tree_util.tree_map(lambda a: a[1:], smoothed.moments)
    last = jax.tree_util.tree_map(lambda a: a[:, None], ends)
    if steps is None or filtered is None:
        return _joined(first, last)
    still = jnp.asarray(plan.rows.length) == 0
    inner = slice(0, None if prepared.jumps is not None else -1)

    def row(now: Moments, to_end: tuple, predicted: Moments, end: Moments, r: jax.Array, adjoint: jax.Array) -> Moments:
        def node(now: Moments, phi: jax.Array, noise: jax.Array) -> Moments:
            gain, conditional = given_later(now, predicted, phi, noise)
            back = matmul(phi.T, r[:, None])[:, 0], congruence(phi.T, adjoint)
            return combine(now, predicted, end, gain, conditional, *back)

        return jax.vmap(node)(now, *to_end)

    inside = jax.vmap(row)(jax.tree_util.tree_map(lambda a: a[:, inner], filtered),
                           tuple(a[:, 1:][:, inner] for a in steps.to_end), passed.predicted, ends, *smoothed.adjoint)
    # In a row without length every node is its start, but for the observation and the jump at its end.
    inside = jax.tree_util.tree_map(
        lambda a, b: jnp.where(still.reshape(-1, *(1,) * (a.ndim - 1)), b, a), inside, first)
    return _joined(first, inside) if prepared.jumps is not None else _joined(first, inside, last)


def _joined(*parts: Moments) -> Moments:
    return jax.tree_util.tree_map(lambda *a: jnp.concatenate(a, axis=1), *parts)


def per_step(plan: Schedule) -> Schedule:
    """Return the plan with a row for each integration step."""
    rows, steps = plan.rows, plan.steps
    # In NumPy where the plan is known, so that requested times can be found in it before compilation.
    xp: Any = np if isinstance(rows.length, np.ndarray) else jnp
    index = np.tile(np.arange(steps), len(rows.length))
    start, length, observation, jump, kind = (xp.repeat(a, steps) for a in rows)
    last = index == steps - 1
    length = length / steps
    fine = Rows(start + index * length, length, xp.where(last, observation, -1), xp.where(last, jump, -1), kind)
    lengths = None if plan.lengths is None else plan.lengths / steps
    return plan._replace(rows=fine, lengths=lengths, steps=1, observed=plan.observed * steps + steps - 1,
                         requested=plan.requested * steps + steps - 1)


def refined(ssm: StateSpaceModel, plan: Schedule, start: Moments, found: Iterated, passed: Pass,
            smoothed: Smoothed) -> Branches:
    """Return the last pass of the iterations with a row for each integration step.

    Args:
        ssm: the model; its rows are not exact.
        plan: the rows.
        start: moments at the initial time.
        found: what the iterations left.
        passed: the forward scan over ``found.given``.
        smoothed: the backward scan over that.
    """
    assert found.steps is not None and found.prefix is not None
    filtered = _filtered_nodes(at_start(passed.filtered, start), found.given, found.prefix)
    nodes = smoothed_nodes(plan, preparation(ssm, plan), passed, smoothed, found.steps, filtered)
    r, adjoint = smoothed.adjoint
    phi = found.steps.to_end[0][:, 1:-1]
    flat = lambda a: a.reshape(-1, *a.shape[2:])  # noqa: E731
    tree = jax.tree_util.tree_map

    def by_steps(inside: jax.Array, end: jax.Array) -> jax.Array:
        return flat(jnp.concatenate([inside, end[:, None]], axis=1))

    within = matmul(phi.mT, r[:, None, :, None])[..., 0], congruence(phi.mT, adjoint[:, None])
    return Branches(
        per_step(plan), tree(lambda a, b: by_steps(a[:, :-1], b), filtered, passed.filtered),
        tree(lambda a, b: jnp.concatenate([flat(a[:, :-1]), b[-1:]]), nodes, smoothed.moments),
        (by_steps(within[0], r), by_steps(within[1], adjoint)),
        (tree(lambda a: flat(a[:, :-1]), found.nodes), tree(lambda a: flat(a[:, 1:]), found.nodes)))
