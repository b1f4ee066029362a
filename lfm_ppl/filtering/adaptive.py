"""Prediction in steps whose length follows the moments, by the usual accept/reject controller.

1. Where the fifth stage, which is the next step's first, replaces the fourth, Runge-Kutta's formula has order three.
   The difference of the two results, e = h (k_4 - k_5) / 6, estimates the error of a step at no cost, in the mean and
   in the covariance, in standard deviations. An exponential step predicts its end with order two as well; the estimate
   is the difference of the two predictions. Where only the forces enter non-linearly, both stages are equal; the step
   is then taken as two by Simpson's rule (`simpson`), whose weights resolve a fast linear part, and the estimate is the
   difference from one such step.
2. A step with an error above the tolerance is repeated with a shorter length.
3. The next length is that at which the error would be a little below the tolerance.
4. Attempts run in blocks; `jax.lax.cond` skips attempts and blocks after the end of the interval.

The choice of lengths is not differentiated: a derivative is that of the integration on the accepted steps, the last of
which ends with the interval.

Source: Hairer, Nørsett and Wanner (1993), Solving Ordinary Differential Equations I, section II.4.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.dynamics import (
    DriftLinearization,
    Dynamics,
    covariance_of,
    is_nonlinear_in_forces_only,
    linearize_drift,
    minimum_sd,
)
from lfm_ppl.filtering.exponential import exponential_step
from lfm_ppl.filtering.intervals import EXPONENTIAL
from lfm_ppl.filtering.moments import Moments, Prediction, Record, compose
from lfm_ppl.filtering.predict import identity_prediction, interval_factor, predict_interval
from lfm_ppl.filtering.runge_kutta import FourthStage, runge_kutta_step
from lfm_ppl.filtering.transition import IntegratingFactor, integrating_factor
from lfm_ppl.model.state_space import Span
from lfm_ppl.utils.linalg import congruence, diagonal, fastest_rate, matmul

_INITIAL_FRACTION = 1 / 8
"""First trial length, as a fraction of the interval."""

_SAFETY, _MIN_GROWTH, _MAX_GROWTH = 0.9, 0.2, 5.0
"""The next length is this fraction of the one at which the error would be the tolerance, within these factors."""

_STABILITY_LIMIT = 10.0
"""Longest step, in units of one over the fastest rate: Runge-Kutta is unstable from 2.8 on and overflows far above."""

_ALWAYS_ACCEPTED = 1e-3
"""Steps below this fraction of the interval are accepted whatever their error: near zero variance the relative error
never passes."""

_MEAN_FRACTION = 1e-3
"""Fraction of the mean that bounds the standard deviation in the error from below: a known state has none."""

_ATTEMPTS_PER_STEP = 5
"""Largest number of attempts, as a multiple of the number of equal steps."""

_BLOCK = 8
"""Attempts in a block."""


class _Position(NamedTuple):
    """State of the integration.

    Attributes:
        remaining: length of the interval that is left.
        trial: length of the next attempt.
        prediction: up to here.
        stage: linearised dynamics here, the first stage of the next Runge-Kutta step; None for other steps.
    """

    remaining: jax.Array
    trial: jax.Array
    prediction: Prediction
    stage: DriftLinearization | None


def predict_interval_adaptively(dynamics: Dynamics, steps: int, tolerance: float, span: Span, length: jax.Array,
                                moments: Moments, record: Record = Record.LIKELIHOOD) -> Prediction:
    """Predict over an interval in steps whose errors are below a tolerance.

    Args:
        dynamics: the model and the rule.
        steps: a fifth of the largest number of attempts; the moments are NaN where these do not suffice.
        tolerance: of the error of a step in the mean and the covariance, in standard deviations.
        span: the interval's times.
        length: its length.
        moments: at its start.
        record: recorded output; the map of the interval for `Record.SMOOTHER`.
    """
    ssm, has_map, stop = dynamics.ssm, record is Record.SMOOTHER, jax.lax.stop_gradient
    factor_of_interval = integrating_factor(ssm, dynamics.linear, length)
    min_sd = minimum_sd(dynamics, factor_of_interval, span.time(), length, moments)

    is_exponential = dynamics.method == EXPONENTIAL
    is_quadrature = not is_exponential and is_nonlinear_in_forces_only(ssm, dynamics.rule)
    is_runge_kutta = not (is_exponential or is_quadrature)
    # The estimated error of a step is of order h^3, h^5 or h^4.
    exponent = -1 / 3 if is_exponential else -1 / 5 if is_quadrature else -1 / 4

    def linearize_at(t: jax.Array, moments: Moments) -> DriftLinearization:
        return linearize_drift(dynamics, t, moments.mean, covariance_of(moments), min_sd)

    def attempt(position: _Position) -> _Position:
        trial = position.trial
        if position.stage is not None:
            # Where this is shorter, a rejected step stays finite, and so does its derivative, which is not used.
            trial = stop(jnp.minimum(trial, _STABILITY_LIMIT / fastest_rate(position.stage.jacobian)))
        is_last = trial >= position.remaining
        h = jnp.where(is_last, position.remaining, trial)
        rest_of_span = span.shifted(length - position.remaining)
        previous = position.prediction
        stage5 = None
        if is_exponential:
            # A fast state settles during the interval.
            min_sd_of_step = minimum_sd(dynamics, factor_of_interval, rest_of_span.time(), h, previous.moments)
            step, step_error = exponential_step(dynamics, rest_of_span, h, previous.moments, min_sd_of_step)
            assert step_error is not None
            mean_error, covariance_error = step_error
        elif is_quadrature:
            step, mean_error, covariance_error = _simpson_step(dynamics, rest_of_span, h, previous.moments, record)
        else:
            assert position.stage is not None
            factor = integrating_factor(ssm, dynamics.linear, h)
            step, stage4 = runge_kutta_step(dynamics, factor, rest_of_span, h, previous.moments, min_sd,
                                            stage1=position.stage)
            stage5 = linearize_at(rest_of_span.time(h), step.moments)
            mean_error, covariance_error = jax.tree.map(
                _larger, _runge_kutta_error(h, step.moments, stage4, stage5),
                _linear_part_error(dynamics, factor, h, previous.moments, position.stage))
        error = stop(_in_standard_deviations(mean_error, covariance_error, previous.moments, step.moments)) / tolerance
        # A step that is not finite is far too long, and is repeated.
        error = jnp.where(jnp.isfinite(error), error, jnp.inf)
        growth = jnp.clip(_SAFETY * jnp.maximum(error, 1e-12) ** exponent, _MIN_GROWTH, _MAX_GROWTH)
        phi, process_cov = previous.phi, previous.process_cov
        if has_map:
            phi, process_cov = compose((phi, process_cov), (step.phi, step.process_cov))
        accepted = _Position(jnp.where(is_last, 0.0, position.remaining - h), stop(h * growth),
                             Prediction(step.moments, phi, process_cov), stage5)
        rejected = position._replace(trial=stop(h * growth))
        is_accepted = (error <= 1.0) | (jnp.isfinite(error) & (h < _ALWAYS_ACCEPTED * length))
        return jax.lax.cond(is_accepted, lambda: accepted, lambda: rejected)

    def unless_finished(body):
        def step(position, _):
            return jax.lax.cond(position.remaining > 0, body, lambda finished: finished, position), None

        return step

    def block(position: _Position) -> _Position:
        return jax.lax.scan(unless_finished(attempt), position, None, length=_BLOCK)[0]

    # After a breakdown every step would fail.
    is_finite = jnp.isfinite(moments.mean).all() & jnp.isfinite(moments.covariance).all()
    start = _Position(jnp.where(is_finite, length, 0.0), stop(_INITIAL_FRACTION * length),
                      identity_prediction(dynamics, moments, Record.SMOOTHER if has_map else Record.LIKELIHOOD),
                      linearize_at(span.time(), moments) if is_runge_kutta else None)
    body = jax.checkpoint(unless_finished(block), prevent_cse=False)
    end, _ = jax.lax.scan(body, start, None, length=-(-_ATTEMPTS_PER_STEP * steps // _BLOCK))
    reached = jax.tree.map(lambda a: jnp.where(end.remaining > 0, jnp.nan, a), end.prediction.moments)
    return end.prediction._replace(moments=reached)


def _simpson_step(dynamics: Dynamics, span: Span, h: jax.Array, moments: Moments,
                  record: Record) -> tuple[Prediction, jax.Array, jax.Array]:
    """Return the prediction in two steps by Simpson's rule, and its difference (M,), (M, n) from that in one."""
    def predict(steps: int, record: Record) -> Prediction:
        factor = interval_factor(dynamics.ssm, dynamics.rule, dynamics.linear, h, steps)
        return predict_interval(dynamics, factor, steps, span, h, moments, record=record)

    fine, coarse = predict(2, record), predict(1, Record.LIKELIHOOD)
    size = dynamics.ssm.physical_dim
    error = jax.tree.map(lambda a, b: (a - b)[:size], fine.moments, coarse.moments)
    return fine, error.mean, error.covariance


def _runge_kutta_error(h: jax.Array, end: Moments, stage4: FourthStage,
                       stage5: DriftLinearization) -> tuple[jax.Array, jax.Array]:
    """Return the estimated errors of the mean (M,) and of the rows (M, n) of the covariance at the end of a step."""
    size = stage5.remainder.shape[0]
    mean = stage4.drift.remainder - stage5.remainder
    covariance = matmul(stage4.drift.jacobian, stage4.covariance) - matmul(stage5.jacobian, end.covariance)
    covariance = covariance.at[:, :size].add(covariance[:, :size].T)
    if stage5.diffusion is not None and stage4.drift.diffusion is not None:
        covariance = covariance.at[:, :size].add(stage4.drift.diffusion - stage5.diffusion)
    return h / 6 * mean, h / 6 * covariance


def _linear_part_error(dynamics: Dynamics, factor: IntegratingFactor, h: jax.Array, start: Moments,
                       stage1: DriftLinearization) -> tuple[jax.Array, jax.Array]:
    """Return the errors of the mean (M,) and the covariance (M, n) due to a fast linear part.

    The step replaces the integral of exp(A s) r ds, of the remainder r of the dynamics, by Simpson's rule W r. Its
    error e obeys A e = A W r - (exp(A h) - 1) r, and each row of e is about that over the state's own rate. The noise D
    obeys the same with A D + D A'.
    """
    size = dynamics.ssm.physical_dim
    matrix = dynamics.linear.rows[:, :size]
    full, half, identity = factor.full[:size, :size], factor.half[:size, :size], jnp.eye(size)
    remainder = jnp.concatenate([matmul(stage1.jacobian, start.covariance), stage1.remainder[:, None]], axis=1)
    residual = matmul(h / 6 * matmul(matrix, full + 4.0 * half + identity) - (full - identity), remainder)
    rate = jnp.abs(diagonal(matrix))
    error = residual / (rate + 1.0 / h)[:, None]
    covariance = error[:, :-1].at[:, :size].add(error[:, :size].T)
    if stage1.diffusion is not None:
        at_start = congruence(full, stage1.diffusion)
        noise = h / 6 * (at_start + 4.0 * congruence(half, stage1.diffusion) + stage1.diffusion)
        drift = matmul(matrix, noise)
        noise_residual = drift + drift.T - (at_start - stage1.diffusion)
        covariance = covariance.at[:, :size].add(noise_residual / (rate[:, None] + rate + 1.0 / h))
    return error[:, -1], covariance


def _larger(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the entry of the larger modulus."""
    return jnp.where(jnp.abs(a) >= jnp.abs(b), a, b)


def _in_standard_deviations(mean: jax.Array, covariance: jax.Array, start: Moments, end: Moments) -> jax.Array:
    """Return the largest error of the mean (k,) and the covariance (k, n) of the first k states in a step."""
    variance = jnp.maximum(jnp.diagonal(start.covariance), jnp.diagonal(end.covariance))
    sd = jnp.sqrt(jnp.maximum(variance, (_MEAN_FRACTION * end.mean) ** 2) + 1e-300)
    rows = sd[:mean.shape[0]]
    return jnp.maximum(jnp.max(jnp.abs(mean) / rows), jnp.max(jnp.abs(covariance) / (rows[:, None] * sd[None, :])))
