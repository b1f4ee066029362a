"""Prediction: the moments, and the affine map if it is recorded, over one interval of the scan.

1. A linear model with constant coefficients has an exact transition, tabulated by interval length. Known inputs and a
   dispersion that varies with time are taken as quadratic in time over each step, and integrated exactly.
2. Any other model takes equal steps: Simpson's rule if only the forces enter non-linearly (`simpson`), else the
   covariance-preserving Runge-Kutta method (`runge_kutta`); exponential steps (`exponential`) where these are chosen;
   or steps that follow a tolerance (`adaptive`).
3. About given linearisation points the prediction is an affine map, which is stored or composed.
4. A jump of a force, or an event, at the end of the interval is one more affine map.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.dynamics import (
    Dynamics,
    columns,
    is_nonlinear_in_forces_only,
    linearization_indices,
    minimum_sd,
)
from lfm_ppl.filtering.exponential import exponential_step
from lfm_ppl.filtering.intervals import EXPONENTIAL
from lfm_ppl.filtering.moments import Moments, Prediction, Record, compose, matvec, transform
from lfm_ppl.filtering.runge_kutta import runge_kutta_step
from lfm_ppl.filtering.simpson import apply_step_map, insert_midpoints, step_maps
from lfm_ppl.filtering.transition import (
    Exact,
    InputWeights,
    IntegratingFactor,
    LinearPart,
    dispersion_noise,
    integrating_factor,
)
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.events import StateMap
from lfm_ppl.model.state_space import Span, StateSpaceModel
from lfm_ppl.utils.linalg import congruence, matmul

_LARGEST_TABULATED = 8
"""Largest number of force states whose transitions to all nodes of an interval are tabulated; others are chained."""


class StepRecord(NamedTuple):
    """Recorded steps of an interval, see `Record.LINEARIZATION`; k linearised states.

    Attributes:
        mean: (J, k), predicted at the end of each step.
        covariance: (J, k, n), with the whole state.
        phi: (J, n, n), of each step.
    """

    mean: jax.Array
    covariance: jax.Array
    phi: jax.Array


def predict_exact(ssm: StateSpaceModel, linear: LinearPart, transition: Exact, steps: int, span: Span,
                  length: jax.Array, moments: Moments) -> Prediction:
    """Predict by the exact transition of a linear model with constant coefficients."""
    process_cov = transition.process_cov
    if transition.inputs is not None and callable(ssm.model.process_noise):
        noise = _integrated_noise(ssm, linear, transition.inputs.transition, steps, span, length / steps)
        process_cov = process_cov.at[:ssm.physical_dim, :ssm.physical_dim].add(noise)
    mean, covariance = transform(moments, transition.phi, process_cov)
    offset = exact_offset(ssm, transition, steps, span, length)
    return Prediction(Moments(mean + offset, covariance), transition.phi, process_cov)


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


def interval_factor(ssm: StateSpaceModel, rule: Rule, linear: LinearPart, length: jax.Array, steps: int,
                    is_tabulated: bool = False) -> IntegratingFactor:
    """Return the integrating factor of an interval's steps; a tabulated one is shared by many intervals."""
    needs_stages = not is_nonlinear_in_forces_only(ssm, rule)
    has_nodes = not needs_stages and is_tabulated and ssm.force_dim <= _LARGEST_TABULATED
    return integrating_factor(ssm, linear, length / steps, needs_stages, steps if has_nodes else None)


def predict_interval(dynamics: Dynamics, factor: IntegratingFactor, steps: int, span: Span, length: jax.Array,
                     moments: Moments, about: Moments | None = None,
                     record: Record = Record.LIKELIHOOD) -> Prediction:
    """Predict over an interval in ``steps`` equal steps.

    Args:
        dynamics: the model and the rule.
        factor: the integrating factor of one step.
        steps: number of steps J.
        span: the interval's times.
        length: its length.
        moments: at its start.
        about: moments (J + 1, ...) at the ends of the steps to linearise about; None: the filter's moments.
        record: recorded output; ``nodes`` of the result is a `StepRecord` for `Record.LINEARIZATION`.
    """
    h = length / steps
    min_sd = minimum_sd(dynamics, factor, span.time(), h, moments)
    has_map = record is Record.SMOOTHER
    initial = identity_prediction(dynamics, moments, Record.SMOOTHER if has_map else Record.LIKELIHOOD)

    def advance(previous: Prediction, step: Prediction) -> tuple[Prediction, StepRecord | None]:
        phi, process_cov = previous.phi, previous.process_cov
        if has_map:
            phi, process_cov = compose((phi, process_cov), (step.phi, step.process_cov))
        return Prediction(step.moments, phi, process_cov), _step_record(dynamics, step, record)

    is_exponential = dynamics.method == EXPONENTIAL
    if is_nonlinear_in_forces_only(dynamics.ssm, dynamics.rule) and not is_exponential:
        maps = step_maps(dynamics, factor, steps, span, h, moments, min_sd, about)
        last, nodes = jax.lax.scan(
            lambda previous, step_map: advance(previous, apply_step_map(previous.moments, step_map, factor.full)),
            initial, maps)
        return last._replace(nodes=nodes)

    def integrate(previous: Prediction, inputs: tuple) -> tuple[Prediction, StepRecord | None]:
        index, points = inputs
        rest_of_span = span.shifted(index * h)
        if is_exponential:
            # A fast state settles during the interval.
            min_sd_of_step = minimum_sd(dynamics, factor, rest_of_span.time(), h, previous.moments)
            step, _ = exponential_step(dynamics, rest_of_span, h, previous.moments, min_sd_of_step, points)
        else:
            step, _ = runge_kutta_step(dynamics, factor, rest_of_span, h, previous.moments, min_sd, points)
        return advance(previous, step)

    points = jax.tree.map(lambda nodes: _by_steps(insert_midpoints(nodes)), about)
    last, nodes = jax.lax.scan(jax.checkpoint(integrate, prevent_cse=False), initial, (jnp.arange(steps), points))
    return last._replace(nodes=nodes)


def identity_prediction(dynamics: Dynamics, moments: Moments, record: Record, steps: int = 1) -> Prediction:
    """Predict over an interval of length zero, with the structure of `predict_interval`."""
    size = moments.mean.shape[0]
    prediction = Prediction(moments, jnp.eye(size), jnp.zeros((size, size)))
    nodes = jax.tree.map(lambda a: jnp.broadcast_to(a, (steps, *a.shape)), _step_record(dynamics, prediction, record))
    if record is not Record.SMOOTHER:
        prediction = prediction._replace(phi=jnp.zeros(0), process_cov=jnp.zeros(0))
    return prediction._replace(nodes=nodes)


def _step_record(dynamics: Dynamics, step: Prediction, record: Record) -> StepRecord | None:
    if record is not Record.LINEARIZATION:
        return None
    indices = linearization_indices(dynamics.ssm, dynamics.rule)
    return StepRecord(columns(step.moments.mean, indices), columns(step.moments.covariance, indices).T, step.phi)


def _by_steps(nodes: jax.Array) -> jax.Array:
    """Return first, middle and last node (J, 3, ...) of each step, from 2 J + 1 nodes."""
    return jnp.stack([nodes[:-2:2], nodes[1::2], nodes[2::2]], axis=1)


def jump_map(ssm: StateSpaceModel, jumps: tuple[jax.Array, jax.Array], index: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return phi and process_cov (n, n) of a jump of the forces, s -> phi s + N(0, process_cov).

    Args:
        ssm: the model.
        jumps: G and Q of all jumps, from `lfm_ppl.forces.sde.Stack.jump_table`.
        index: index of the jump; -1 for none.
    """
    size = ssm.physical_dim
    return (jax.scipy.linalg.block_diag(jnp.eye(size), jumps[0][index]),
            jax.scipy.linalg.block_diag(jnp.zeros((size, size)), jumps[1][index]))


def apply_jump(prediction: Prediction, jump: tuple[Any, Any], has_map: bool) -> Prediction:
    """Return the prediction after a jump at the end of the interval; its map, too, if it has one."""
    prediction = prediction._replace(moments=transform(prediction.moments, *jump))
    if not has_map:
        return prediction
    phi, process_cov = compose((prediction.phi, prediction.process_cov), jump)
    return prediction._replace(phi=phi, process_cov=process_cov)


def apply_event(prediction: Prediction, state_map: StateMap, has_map: bool) -> Prediction:
    """Return the prediction after an event at the end of the interval; its map, too, if it has one."""
    mean, covariance = prediction.moments
    keep, mean = state_map.keep, state_map.apply(mean)
    if keep is None:
        return prediction._replace(moments=Moments(mean, covariance))
    keep_pairs = keep[:, None] * keep
    prediction = prediction._replace(moments=Moments(mean, keep_pairs * covariance))
    if not has_map:
        return prediction
    return prediction._replace(phi=keep[:, None] * prediction.phi, process_cov=keep_pairs * prediction.process_cov)


def predict_by_map(moments: Moments, phi: jax.Array, process_cov: jax.Array, point: jax.Array,
                   mean: jax.Array) -> Prediction:
    """Predict by the affine map s -> mean + phi (s - point) + N(0, process_cov)."""
    covariance = transform(moments, phi, process_cov).covariance
    return Prediction(Moments(mean + matvec(phi, moments.mean - point), covariance), phi, process_cov)
