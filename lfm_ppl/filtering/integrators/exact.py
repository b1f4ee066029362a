"""Exact transitions of linear models with constant coefficients, tabulated by the length of the interval.

Known inputs and a dispersion that varies with time are taken as quadratic in time over each step, and integrated
exactly, whatever the rates of the model (`lfm_ppl.filtering.transition`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.dynamics import Dynamics
from lfm_ppl.filtering.integrators.integrator import Integrator, Section, Stepping
from lfm_ppl.filtering.moments import Moments, Prediction, Record, transform
from lfm_ppl.filtering.transition import Exact, InputWeights, LinearPart, dispersion_noise, exact
from lfm_ppl.model.state_space import Span, StateSpaceModel
from lfm_ppl.utils.linalg import congruence, matmul


@dataclass(frozen=True)
class ExactTransition(Integrator):
    """The exact transition; steps integrate additive terms and a dispersion that vary with time."""

    stepping: ClassVar[Stepping] = Stepping.NONE

    def tabulate(self, dynamics: Dynamics, length: jax.Array, steps: int, is_shared: bool = False) -> Exact:
        """Return the transition over an interval of a length, or of many (B,)."""
        return exact(dynamics.ssm, length, steps, dynamics.linear)

    def predict(self, dynamics: Dynamics, table: Any, interval: Section, steps: int, record: Record) -> Prediction:
        """Predict over an interval; the map is there for every record, at no cost."""
        ssm, span, length = dynamics.ssm, interval.span, interval.length
        process_cov = table.process_cov
        if table.inputs is not None and not ssm.plan.has_exact_noise:
            noise = _integrated_noise(ssm, dynamics.linear, table.inputs.transition, steps, span, length / steps)
            process_cov = process_cov.at[:ssm.physical_dim, :ssm.physical_dim].add(noise)
        mean, covariance = transform(interval.moments, table.phi, process_cov)
        offset = exact_offset(ssm, table, steps, span, length)
        return Prediction(Moments(mean + offset, covariance), table.phi, process_cov)


def exact_offset(ssm: StateSpaceModel, transition: Exact, steps: int, span: Span, length: jax.Array) -> jax.Array:
    """Return the offset (n,) that an exact transition adds to phi s over an interval with the times ``span``."""
    if transition.inputs is None:
        return transition.offset
    return transition.offset.at[:ssm.physical_dim].set(
        _integrated_offset(ssm, transition.inputs, steps, span, length / steps))


def _integrated_offset(ssm: StateSpaceModel, weights: InputWeights, steps: int, span: Span, h: jax.Array) -> jax.Array:
    """Integrate the additive terms of the mean of the physical state (M,), quadratic in time over each step."""

    def additive_terms(t: jax.Array) -> jax.Array:
        return ssm.drift(ssm.input_map(t)[1], t)[:, None]

    def step(offset: jax.Array, index: jax.Array) -> tuple[jax.Array, None]:
        first, middle, last = (additive_terms(t) for t in _step_times(span, h, index))
        return matmul(weights.transition, offset) + weights.integrate(first, middle, last), None

    offset, _ = jax.lax.scan(step, jnp.zeros((ssm.physical_dim, 1)), jnp.arange(steps))
    return offset[:, 0]


def _integrated_noise(ssm: StateSpaceModel, linear: LinearPart, transition: jax.Array, steps: int, span: Span,
                      h: jax.Array) -> jax.Array:
    """Integrate the process noise (M, M) of a dispersion that varies with time, quadratic over each step.

    ``transition`` (M, M) is that of the physical state over a step.
    """
    jacobian = linear.rows[:, :ssm.physical_dim]

    def dispersion(t: jax.Array) -> jax.Array:
        value = ssm.dispersion(ssm.input_map(t)[1], t)
        assert value is not None
        return value

    def step(noise: jax.Array, index: jax.Array) -> tuple[jax.Array, None]:
        first, middle, last = (dispersion(t) for t in _step_times(span, h, index))
        return congruence(transition, noise) + dispersion_noise(jacobian, h, first, middle, last), None

    shape = (ssm.physical_dim, ssm.physical_dim)
    return jax.lax.scan(jax.checkpoint(step, prevent_cse=False), jnp.zeros(shape), jnp.arange(steps))[0]


def _step_times(span: Span, h: jax.Array, index: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the times of start, middle and end of a step."""
    rest_of_span = span.shifted(index * h)
    return rest_of_span.time(), rest_of_span.time(0.5 * h), rest_of_span.time(h)
