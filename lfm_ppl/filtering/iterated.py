"""Iterated posterior linearisation: smooth, linearise about the smoothed marginals, repeat."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.filter import Pass, Points, Preparation, bends, columns, forward, needed
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.rts import Smoothed, backward
from lfm_ppl.filtering.time_grid import TimeGrid
from lfm_ppl.linalg import congruence, matmul, safe_sqrt
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.state_space import StateSpaceModel

_NO_STEP = 1e-8
"""Square of a step, in standard deviations, that is too small to learn from."""


class Iterated(NamedTuple):
    """What the iterations leave.

    Attributes:
        points: about which the last linearisation is made.
        change: largest change of a mean in the last iteration, in standard deviations.
    """

    points: Points
    change: jax.Array


def posterior_linearisation(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, start: Moments,
                            iterations: int, damping: float, prepared: Preparation) -> Iterated:
    r"""Iterate: smooth, linearise about the smoothed marginals, smooth again.

    Where an iteration moves the means m of a time by r and the one before, of which the share s was taken, moved them
    by r', the share that is taken now is that of the secant method,

        s / (1 - lambda),    lambda = sum_i r_i r'_i / v_i  /  sum_i r'_i^2 / v_i,

    with the variances v, and at most the damping: means that go back and forth between two values meet between them.

    Args:
        ssm: the model.
        rule: the linearisation rule.
        grid: the time grid.
        y: (T, D), NaN where missing.
        start: moments at the initial time.
        iterations: fixed number, so that the result is a smooth function of the parameters.
        damping: largest share of the new marginals that is taken, in (0, 1].
        prepared: what the intervals of all passes share, so that its derivative is taken once.

    Source: García-Fernández, Svensson and Särkkä (2017), IEEE Transactions on Signal Processing 65(21).
    """
    def smoothed(linearization_point: Points | None) -> Points:
        passed = forward(ssm, rule, grid, y, start=start, linearization_point=linearization_point, keep="inside",
                         prepared=prepared)
        return smoothed_points(ssm, rule, grid, passed, backward(passed, start, grid, moments=False), start)

    def iterate(now: tuple, _: None) -> tuple[tuple, None]:
        new = smoothed(Points(*_each(lambda part: part.moments, now)))
        return _each(lambda part, new: _moved(part, new, damping), now, new), None

    first = _each(lambda moments: _Iterate(moments, jnp.zeros_like(moments.mean),
                                           jnp.full(moments.mean.shape[:-1], damping), jnp.asarray(jnp.nan)),
                  smoothed(None))
    last, _ = jax.lax.scan(iterate, first, None, length=iterations - 1)
    change = jnp.max(jnp.stack([part.change for part in last if part is not None]))
    return Iterated(Points(*_each(lambda part: part.moments, last)), change)


class _Iterate(NamedTuple):
    """Moments about which a pass is linearised, and how the last iteration moved them.

    Attributes:
        moments: (..., n) and (..., n, n).
        step: (..., n) difference of the smoothed means from those about which they were linearised.
        share: (...) of it that was taken.
        change: largest step of a mean, in standard deviations.
    """

    moments: Moments
    step: jax.Array
    share: jax.Array
    change: jax.Array


def _each(function: Callable, *points: tuple) -> tuple:
    """Apply a function to the nodes, and to the ends where there are any."""
    return tuple(None if parts[0] is None else function(*parts) for parts in zip(*points, strict=True))


def _moved(now: _Iterate, new: Moments, damping: float) -> _Iterate:
    """Return the iterate between the present moments and those that were smoothed about them."""
    step = new.mean - now.moments.mean
    variance = jnp.diagonal(new.covariance, axis1=-2, axis2=-1)
    # The derivative of 1 / variance must not overflow.
    known = variance <= jnp.finfo(variance.dtype).tiny ** 0.25
    precision = jnp.where(known, 0.0, 1.0 / jnp.where(known, 1.0, variance))
    both, square = (jnp.sum(precision * now.step * each, axis=-1) for each in (step, now.step))
    share = now.share / jnp.maximum(1.0 - both / (square + _NO_STEP), now.share / damping)
    by = lambda a: share.reshape(share.shape + (1,) * (a.ndim - share.ndim))  # noqa: E731
    moments = jax.tree_util.tree_map(lambda a, b: a + by(a) * (b - a), now.moments, new)
    return _Iterate(moments, step, share, jnp.max(jnp.abs(step) * safe_sqrt(precision), initial=0.0))


def smoothed_points(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, passed: Pass, smoothed: Smoothed,
                    start: Moments) -> Points:
    """Return the smoothed moments about which the next pass is linearised, of a pass that kept what is "inside".

    They are those of the adjoint at the end of the interval that a node lies in,

        m + W r,    P - W Lambda W',    W = Cov(node, state at the interval's end).
    """
    used = needed(ssm, rule)
    r, adjoint = smoothed.adjoint

    def row(moments: Moments, cross: jax.Array, r: jax.Array, adjoint: jax.Array) -> Moments:
        return Moments(moments.mean + matmul(cross, r[:, None])[..., 0],
                       moments.covariance - congruence(cross, adjoint))

    ends = None
    if bends(ssm):
        ends = jax.vmap(row)(passed.predicted, passed.predicted.covariance, r, adjoint)

    def marginal(moments: Moments) -> tuple[Moments, jax.Array]:
        cross = columns(moments.covariance, used).mT
        return Moments(columns(moments.mean, used), columns(cross, used)), cross

    back = matmul(passed.phi[0].T, r[0][:, None])[:, 0], congruence(passed.phi[0].T, adjoint[0])
    first = row(*marginal(start), *back)
    inside = passed.steps
    if inside is None or not used.size or ssm.stack.jump_table() is not None:
        after = jax.vmap(row)(*marginal(passed.predicted), r, adjoint)
    if inside is None or not used.size:
        inside = jax.tree_util.tree_map(lambda a: jnp.broadcast_to(a[:, None], (len(a), grid.steps, *a.shape[1:])),
                                        after)
    else:
        # Interval by interval: XLA makes one small program of an interval, where it treats all intervals at once
        # operation by operation.
        inside = jax.lax.map(lambda at: row(*at), (*passed.steps, r, adjoint))
        if ssm.stack.jump_table() is None:
            after = jax.tree_util.tree_map(lambda a: a[:, -1], inside)
    nodes = jax.tree_util.tree_map(
        lambda first, after, inside: jnp.concatenate(
            [jnp.concatenate([first[None], after[:-1]])[:, None], inside], axis=1), first, after, inside)
    return Points(nodes, ends)
