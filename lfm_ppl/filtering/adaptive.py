"""Prediction in steps whose length follows the moments: short where these move fast, long where they rest.

Where the fifth stage, which is the next step's first, takes the place of the fourth, Runge-Kutta's formula has order
three. The difference of the two results,

    e = h (k_4 - k_5) / 6,

therefore estimates the error of a step at no cost. It is taken of the mean and of the covariance, in standard
deviations. A step whose error is larger than the tolerance is made again with a shorter length; the next one has the
length at which its error would be a little below it.

How the interval is divided is not differentiated: a derivative is that of the integration on the steps that were made,
the last of which ends with the interval.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.predict import (
    LastStage,
    Moments,
    Prediction,
    Stage,
    compose,
    linearised,
    minimum_sd,
    step_on,
    unmoved,
)
from lfm_ppl.filtering.transition import LinearPart, integrating_factor
from lfm_ppl.linalg import matmul
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.state_space import Span, StateSpaceModel

_FIRST = 1 / 8
"""Length of the first step that is tried, as a share of the interval."""

_SAFETY, _SHORTEST, _LONGEST = 0.9, 0.2, 5.0
"""The next step is this share of the one whose error would be the tolerance, within these factors of the last."""

_STABLE = 10.0
"""Longest step, in units of one over the fastest rate: Runge-Kutta is unstable from 2.8 on and overflows far above."""

_SHORT = 1e-3
"""Share of an interval made whatever its error, which of a state that starts from a known zero is never small."""

_SHARE_OF_MEAN = 1e-3
"""Share of the mean below which a standard deviation counts as no smaller: a state that is known has none."""

_MOST = 5
"""Most steps that are tried, as a multiple of the number of equal ones."""

_BLOCK = 8
"""Steps in a block; a block in which nothing is left to do is left out as a whole."""


class _Position(NamedTuple):
    """Where an integration stands: what is left of the interval, the next length to try, and the affine map so far."""

    left: jax.Array
    length: jax.Array
    moments: Moments
    phi: jax.Array
    process_cov: jax.Array
    stage: Stage


def predict_interval_adaptively(ssm: StateSpaceModel, rule: Rule, linear: LinearPart, steps: int, tolerance: float,
                                span: Span, length: jax.Array, moments: Moments,
                                with_map: bool = False) -> Prediction:
    """Predict over an interval in Runge-Kutta steps whose errors are below a tolerance.

    Args:
        ssm: the model.
        rule: the linearisation rule.
        linear: its constant linear part.
        steps: a fifth of the steps that are tried at most; the moments are NaN where these do not suffice.
        tolerance: of the error of a step in the mean and the covariance, in standard deviations.
        span: the interval's times.
        length: of the interval.
        moments: at its start.
        with_map: whether phi and process_cov of the interval are wanted (for the smoother).
    """
    min_sd = minimum_sd(ssm, rule, integrating_factor(ssm, linear, length), span.time(), length, moments)
    stop = jax.lax.stop_gradient

    def attempt(now: _Position) -> _Position:
        # Where this is shorter, a rejected step stays finite, and so does its derivative, which is not used.
        trial = stop(jnp.minimum(now.length, _STABLE / _fastest_rate(now.stage.jacobian)))
        last = trial >= now.left
        h = jnp.where(last, now.left, trial)
        rest = span.after(length - now.left)
        factor = integrating_factor(ssm, linear, h)
        one, fourth = step_on(ssm, rule, linear, factor, rest, h, now.moments, min_sd, first=now.stage)
        fifth = linearised(ssm, rule, linear, rest.time(h), one.moments, min_sd)
        error = stop(_error(h, now.moments, one.moments, fourth, fifth)) / tolerance
        # A step that is not finite is far too long, and is made again.
        error = jnp.where(jnp.isfinite(error), error, jnp.inf)
        growth = jnp.clip(_SAFETY * jnp.maximum(error, 1e-12) ** -0.25, _SHORTEST, _LONGEST)
        phi, process_cov = now.phi, now.process_cov
        if with_map:
            phi, process_cov = compose((phi, process_cov), (one.phi, one.process_cov))
        made = _Position(jnp.where(last, 0.0, now.left - h), stop(h * growth), one.moments, phi, process_cov, fifth)
        again = now._replace(length=stop(h * growth))
        accepted = (error <= 1.0) | (jnp.isfinite(error) & (h < _SHORT * length))
        return jax.lax.cond(accepted, lambda: made, lambda: again)

    def unless_done(body):
        return lambda now, _: (jax.lax.cond(now.left > 0, body, lambda same: same, now), None)

    def block(now: _Position) -> _Position:
        return jax.lax.scan(unless_done(attempt), now, None, length=_BLOCK)[0]

    still = unmoved(moments, with_map)
    # After a breakdown every step would fail.
    possible = jnp.isfinite(moments.mean).all() & jnp.isfinite(moments.covariance).all()
    first = _Position(jnp.where(possible, length, 0.0), stop(_FIRST * length), moments, still.phi, still.process_cov,
                      linearised(ssm, rule, linear, span.time(), moments, min_sd))
    body = jax.checkpoint(unless_done(block), prevent_cse=False)
    end, _ = jax.lax.scan(body, first, None, length=-(-_MOST * steps // _BLOCK))
    reached = jax.tree_util.tree_map(lambda a: jnp.where(end.left > 0, jnp.nan, a), end.moments)
    return Prediction(reached, end.phi, end.process_cov)


def _fastest_rate(jacobian: jax.Array) -> jax.Array:
    """Estimate the largest modulus of an eigenvalue of the Jacobian (M, n) in the physical state, |K^8|^(1/8).

    The units of the states matter little: a ratio of 1,000 between them makes it 2.4 times as large at most.
    """
    size = jacobian.shape[0]
    largest = jnp.maximum(jnp.max(jnp.abs(jacobian[:, :size]), initial=0.0), 1e-300)
    power = jacobian[:, :size] / largest
    for _ in range(3):
        power = matmul(power, power)
    return largest * jnp.maximum(jnp.max(jnp.abs(power), initial=0.0), 1e-100) ** 0.125


def _error(h: jax.Array, before: Moments, after: Moments, fourth: LastStage, fifth: Stage) -> jax.Array:
    """Return the largest estimated error of the mean and the covariance of a step, in standard deviations."""
    size = fifth.rest.shape[0]
    variance = jnp.maximum(jnp.diagonal(before.covariance), jnp.diagonal(after.covariance))
    sd = jnp.sqrt(jnp.maximum(variance, (_SHARE_OF_MEAN * after.mean) ** 2) + 1e-300)
    mean = (fourth.stage.rest - fifth.rest) / sd[:size]
    change = matmul(fourth.stage.jacobian, fourth.covariance) - matmul(fifth.jacobian, after.covariance)
    change = change.at[:, :size].add(change[:, :size].T)
    if fifth.diffusion is not None and fourth.stage.diffusion is not None:
        change = change.at[:, :size].add(fourth.stage.diffusion - fifth.diffusion)
    covariance = change / (sd[:size, None] * sd[None, :])
    return h / 6 * jnp.maximum(jnp.max(jnp.abs(mean)), jnp.max(jnp.abs(covariance)))
