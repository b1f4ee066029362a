r"""One exponential step of the moments, for stiff dynamics: stable however fast a state decays.

1. Linearise the dynamics at start, middle and end of the step: ds = (A_i s + b_i) dt + noise of the rate D_i.
2. Interpolate them quadratically. Take a constant matrix on each half of the step,

       A_1 = (3 A_start + 4 A_middle - A_end) / 6,    A_2 = (-A_start + 4 A_middle + 3 A_end) / 6,

   so that Phi = exp(A_2 h/2) exp(A_1 h/2) is the commutator-free Magnus integrator of order four. On each half b is
   linear in time, with the mean of the interpolant, so that a fast state follows what drives it.
3. Discretise both halves exactly (`lfm_ppl.forces.discretise`). Phi, the mean and Q are exact for a linear model with
   constant noise, forces included, and Q is a sum of congruences: P <- Phi P Phi' + Q is positive semi-definite.
4. D has the positive weights of Simpson's rule, (D_start + 2 D_middle) / 3 and (2 D_middle + D_end) / 3.
5. The filter's own moments at middle and end are predicted with exponentials of lower order, so that the step has order
   three (two in a rate D that varies).
6. The difference from a step of order two estimates the error. That step takes the linearisation at the middle, and b
   linear in time between its values at the start and the end for the same state: both steps follow what drives a fast
   state, so that the difference decreases with its rate. A constant b would be off by the change of b.

Source: Blanes and Moan (2006), Applied Numerical Mathematics 56(12), for the integrator; Hochbruck and Ostermann
(2010), Acta Numerica 19, for exponential integrators of stiff problems.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.dynamics import Dynamics, covariance_of, linearise_drift, minimum_sd
from lfm_ppl.filtering.integrators.integrator import Attempt, RepeatedStep, Section
from lfm_ppl.filtering.moments import Moments, Prediction, Record, compose, matvec, transform
from lfm_ppl.filtering.transition import feedback, integrating_factor
from lfm_ppl.forces.phi_functions import discretise_driven
from lfm_ppl.utils.linalg import outer_square


class LinearSDE(NamedTuple):
    """The linear SDE dr = (A r + b) dt + noise of r = s - m, with the mean m at the start of the step.

    Attributes:
        feedback: A (n, n).
        offset: (n,), mean of b.
        change: (n,), of b from the start to the end.
        diffusion: D (n, n), rate of the noise.
    """

    feedback: jax.Array
    offset: jax.Array
    change: jax.Array
    diffusion: jax.Array


class _Flow(NamedTuple):
    """The map r -> phi r + offset + N(0, process_cov) of a linear SDE over a part of the step."""

    offset: jax.Array
    phi: jax.Array
    process_cov: jax.Array


# Weights of start, middle and end of the step in the fields of the SDE of a part of it.
_FIRST_HALF = LinearSDE(*np.array([[6, 8, -2], [5, 8, -1], [-12, 12, 0], [4, 8, 0]]) / 12)
_SECOND_HALF = LinearSDE(*np.array([[-2, 8, 6], [-1, 8, 5], [0, -12, 12], [0, 8, 4]]) / 12)
# The first factor of the integrator does not lead to the middle; the average over the first half does.
_TO_MIDDLE = LinearSDE(*np.array([[5, 8, -1], [5, 8, -1], [-12, 12, 0], [6, 6, 0]]) / 12)


@dataclass(frozen=True)
class Exponential(RepeatedStep):
    """Exponential steps: stable however fast a state decays."""

    error_order: ClassVar[int] = 3

    def step(self, dynamics: Dynamics, table: Any, step: Section, min_sd: jax.Array) -> Prediction:
        """Predict over one step."""
        return _exponential_step(dynamics, step, min_sd)[0]

    def attempts(self, dynamics: Dynamics, interval: Section,
                 record: Record) -> tuple[None, Callable[[Section, Any], Attempt]]:
        """Return None, because a step needs no stage of the one before, and the function (step, stage) -> `Attempt`."""
        factor_of_interval = integrating_factor(dynamics.ssm, dynamics.linear, interval.length)

        def attempt(step: Section, stage: Any) -> Attempt:
            # A fast state settles during the interval.
            min_sd = minimum_sd(dynamics, factor_of_interval, step.span.time(), step.length, step.moments,
                                settles=True)
            prediction, error = _exponential_step(dynamics, step, min_sd)
            assert error is not None
            return Attempt(prediction, error)

        return None, attempt


def _exponential_step(dynamics: Dynamics, step: Section, min_sd: jax.Array) -> tuple[Prediction, Moments | None]:
    """Predict over one step, and return the estimated error of the moments at its end, too.

    There is no estimate about given moments.

    Args:
        dynamics: the model and the rule.
        step: the step.
        min_sd: see `lfm_ppl.filtering.dynamics.minimum_sd`.
    """
    span, h, moments, about = step

    def linearise_at(node: int, point: Moments) -> LinearSDE:
        return linear_sde(dynamics, span.time(0.5 * node * h), moments.mean, point, min_sd)

    def predict(flow: _Flow) -> Prediction:
        covariance = transform(moments, flow.phi, flow.process_cov).covariance
        return Prediction(Moments(moments.mean + flow.offset, covariance), flow.phi, flow.process_cov)

    if about is not None:
        nodes = [linearise_at(node, jax.tree.map(lambda a, node=node: a[node], about)) for node in range(3)]
    else:
        start = linearise_at(0, moments)
        midpoint = predict(_flow(start, 0.5 * h)).moments
        middle = linearise_at(1, midpoint)
        second_order = predict(_flow(middle, h)).moments
        end = linearise_at(2, second_order)
        if not dynamics.ssm.plan.is_autonomous:
            # XLA removes this where the error is not used.
            deviation = midpoint.mean - moments.mean
            offsets = [matvec(sde.feedback - middle.feedback, deviation) + sde.offset
                       for sde in (linearise_at(0, midpoint), linearise_at(2, midpoint))]
            driven = middle._replace(offset=0.5 * (offsets[0] + offsets[1]), change=offsets[1] - offsets[0])
            second_order = predict(_flow(driven, h)).moments
        nodes = [start, linearise_at(1, predict(_flow(_combine(_TO_MIDDLE, start, middle, end), 0.5 * h)).moments), end]
    first, second = (_flow(_combine(weights, *nodes), 0.5 * h) for weights in (_FIRST_HALF, _SECOND_HALF))
    offset = matvec(second.phi, first.offset) + second.offset
    prediction = predict(_Flow(offset, *compose(first[1:], second[1:])))
    return prediction, None if about is not None else jax.tree.map(jnp.subtract, prediction.moments, second_order)


def linear_sde(dynamics: Dynamics, t: jax.Array, origin: jax.Array, point: Moments, min_sd: jax.Array) -> LinearSDE:
    """Linearise the dynamics about moments at a time, as a constant SDE of the deviation from ``origin`` (n,)."""
    ssm, size = dynamics.ssm, dynamics.ssm.physical_dim
    drift = linearise_drift(dynamics, t, origin, covariance_of(point), min_sd, point)
    matrix = feedback(ssm, dynamics.linear)
    offset = matvec(matrix, origin).at[:size].add(drift.remainder)
    state_noise = jnp.zeros((size, size)) if drift.diffusion is None else drift.diffusion
    return LinearSDE(matrix.at[:size].add(drift.jacobian), offset, jnp.zeros_like(offset),
                     jax.scipy.linalg.block_diag(state_noise, outer_square(ssm.stack.dispersion())))


def _combine(weights: LinearSDE, start: LinearSDE, middle: LinearSDE, end: LinearSDE) -> LinearSDE:
    """Return the SDE of a part of the step from those at its nodes, which are constant."""
    nodes = (sde._replace(change=sde.offset) for sde in (start, middle, end))
    return jax.tree.map(lambda w, a, b, c: w[0] * a + w[1] * b + w[2] * c, weights, *nodes)


def _flow(sde: LinearSDE, duration: jax.Array) -> _Flow:
    """Discretise a linear SDE over a part of the step."""
    input_ends = sde.offset + jnp.stack([-0.5 * sde.change, 0.5 * sde.change])
    phi, offset, process_cov = discretise_driven(sde.feedback, input_ends, sde.diffusion, duration)
    return _Flow(offset, phi, process_cov)
