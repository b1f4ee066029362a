"""Prediction in steps whose length follows the moments, by the usual accept/reject controller.

1. An integrator of equal steps attempts a step, and estimates the error of mean and covariance at its end
   (`EqualSteps.attempts`).
2. A step with an error above the tolerance, in standard deviations, is repeated with a shorter length.
3. The next length is that at which the error would be a little below the tolerance.
4. Attempts run in blocks; `jax.lax.cond` skips attempts and blocks after the end of the interval.

The choice of lengths is not differentiated: a derivative is that of the integration on the accepted steps, the last of
which ends with the interval.

Source: Hairer, Nørsett and Wanner (1993), Solving Ordinary Differential Equations I, section II.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.dynamics import Dynamics
from lfm_ppl.filtering.integrators.integrator import (
    EqualSteps,
    Integrator,
    Section,
    Stepping,
    advance,
    start_of_steps,
)
from lfm_ppl.filtering.moments import Moments, Prediction, Record

_INITIAL_FRACTION = 1 / 8
"""First trial length, as a fraction of the interval."""

_SAFETY, _MIN_GROWTH, _MAX_GROWTH = 0.9, 0.2, 5.0
"""The next length is this fraction of the one at which the error would be the tolerance, within these factors."""

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
        stage: what the next step takes over from the last one.
    """

    remaining: jax.Array
    trial: jax.Array
    prediction: Prediction
    stage: Any


@dataclass(frozen=True)
class AdaptiveSteps(Integrator):
    """Prediction in steps of an integrator whose errors are below a tolerance.

    Attributes:
        integrator: of the steps.
        tolerance: of the error of a step in the mean and the covariance, in standard deviations.
    """

    integrator: EqualSteps
    tolerance: float
    stepping: ClassVar[Stepping] = Stepping.ADAPTIVE

    def tabulate(self, dynamics: Dynamics, length: jax.Array, steps: int, is_shared: bool = False) -> None:
        """Return None: the lengths of the steps are not known."""

    def predict(self, dynamics: Dynamics, table: Any, interval: Section, steps: int, record: Record) -> Prediction:
        """Predict over an interval; the moments are NaN where five times ``steps`` attempts do not suffice."""
        length, moments, stop = interval.length, interval.moments, jax.lax.stop_gradient
        first_stage, attempt_step = self.integrator.attempts(dynamics, interval, record)
        exponent = -1 / self.integrator.error_order

        def attempt(position: _Position) -> _Position:
            trial = position.trial
            if (longest := self.integrator.longest_step(position.stage)) is not None:
                trial = stop(jnp.minimum(trial, longest))
            is_last = trial >= position.remaining
            h = jnp.where(is_last, position.remaining, trial)
            previous = position.prediction
            step = Section(interval.span.shifted(length - position.remaining), h, previous.moments)
            prediction, step_error, stage = attempt_step(step, position.stage)
            error = _in_standard_deviations(*step_error, previous.moments, prediction.moments)
            error = stop(error) / self.tolerance
            # A step that is not finite is far too long, and is repeated.
            error = jnp.where(jnp.isfinite(error), error, jnp.inf)
            growth = jnp.clip(_SAFETY * jnp.maximum(error, 1e-12) ** exponent, _MIN_GROWTH, _MAX_GROWTH)
            advanced, _ = advance(dynamics, previous, prediction, record)
            accepted = _Position(jnp.where(is_last, 0.0, position.remaining - h), stop(h * growth), advanced, stage)
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
                          start_of_steps(moments, record), first_stage)
        body = jax.checkpoint(unless_finished(block), prevent_cse=False)
        end, _ = jax.lax.scan(body, start, None, length=-(-_ATTEMPTS_PER_STEP * steps // _BLOCK))
        reached = jax.tree.map(lambda a: jnp.where(end.remaining > 0, jnp.nan, a), end.prediction.moments)
        return end.prediction._replace(moments=reached)


def _in_standard_deviations(mean: jax.Array, covariance: jax.Array, start: Moments, end: Moments) -> jax.Array:
    """Return the largest error of the mean (k,) and the covariance (k, n) of the first k states in a step."""
    variance = jnp.maximum(jnp.diagonal(start.covariance), jnp.diagonal(end.covariance))
    sd = jnp.sqrt(jnp.maximum(variance, (_MEAN_FRACTION * end.mean) ** 2) + 1e-300)
    rows = sd[:mean.shape[0]]
    return jnp.maximum(jnp.max(jnp.abs(mean) / rows), jnp.max(jnp.abs(covariance) / (rows[:, None] * sd[None, :])))
