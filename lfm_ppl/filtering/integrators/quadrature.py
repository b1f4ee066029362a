r"""Prediction over an interval in which the dynamics is non-linear in the forces only.

1. The forces obey a linear SDE, so that their moments at all nodes of the interval follow from its start.
2. Linearise the dynamics at all nodes at once; no stage changes the moments that another stage is linearised about.
3. The Runge-Kutta method is then a quadrature. With the exponential E of the linear part, the Jacobians K_i and the
   weights W_i of `lfm_ppl.filtering.transition.InputWeights`,

       Phi = E(h) + W_1 K_1 + W_2 K_2 E(h/2) + W_3 K_3 E(h),

   where h/6 E(h), 4 h/6 E(h/2) and h/6 would be Simpson's rule. The weights differ from these in the fifth order of h
   where the step resolves the linear part, and are right where a state decays within the step.
4. Compose the maps of the steps in one scan.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.dynamics import DriftLinearisation, Dynamics, linearise_drift, minimum_sd
from lfm_ppl.filtering.integrators.integrator import (
    EqualSteps,
    Section,
    StepRecord,
    advance,
    insert_midpoints,
    start_of_steps,
)
from lfm_ppl.filtering.integrators.runge_kutta import WEIGHTS, process_cov_at, stack_diffusions
from lfm_ppl.filtering.moments import Moments, Prediction, Record, matvec, transform
from lfm_ppl.filtering.transition import IntegratingFactor, integrating_factor
from lfm_ppl.forces.sde import block_diagonal
from lfm_ppl.utils.linalg import congruence, matmul

_LARGEST_TABULATED = 8
"""Largest number of force states whose transitions to all nodes of an interval are tabulated; others are chained."""

_FIRST_MIDDLE_LAST = slice(None, -2, 2), slice(1, None, 2), slice(2, None, 2)
"""First, middle and last node of each of J steps, among the 2 J + 1 nodes."""


class _Node(NamedTuple):
    """The dynamics at a node, as a function of the forces.

    Attributes:
        remainder: (M, nz + 1), Jacobian in the forces' states, and the remainder of the drift as the last column.
        diffusion: (M, M), expectation of G G'; None without process noise.
    """

    remainder: jax.Array
    diffusion: jax.Array | None


class _StepMap(NamedTuple):
    """The affine map of one step about the mean m at its start, with the transition E(h) of the linear part.

    It is s -> E(h) m + (offset, 0) + phi (s - m) + N(0, process_cov), with an offset (M,).
    """

    phi: jax.Array
    offset: jax.Array
    process_cov: jax.Array


@dataclass(frozen=True)
class Quadrature(EqualSteps):
    """Simpson's rule with exponential weights, where the dynamics is linearised in forces only."""

    error_order: ClassVar[int] = 5

    def tabulate(self, dynamics: Dynamics, length: jax.Array, steps: int, is_shared: bool = False) -> IntegratingFactor:
        """Return the integrating factor of a step, with the transitions to all nodes where many intervals share it."""
        has_nodes = is_shared and dynamics.ssm.force_dim <= _LARGEST_TABULATED
        return integrating_factor(dynamics.ssm, dynamics.linear, length / steps, False, steps if has_nodes else None)

    def predict(self, dynamics: Dynamics, table: Any, interval: Section, steps: int, record: Record) -> Prediction:
        """Predict over an interval in ``steps`` steps."""
        h = interval.length / steps
        min_sd = minimum_sd(dynamics, table, interval.span.time(), h, interval.moments)
        initial = start_of_steps(interval.moments, record)
        maps = _step_maps(dynamics, table, interval, h, steps, min_sd)

        def apply(previous: Prediction, step_map: _StepMap) -> tuple[Prediction, StepRecord | None]:
            return advance(dynamics, previous, _apply_step_map(previous.moments, step_map, table.full), record)

        last, nodes = jax.lax.scan(apply, initial, maps)
        return last._replace(nodes=nodes)


def _step_maps(dynamics: Dynamics, factor: IntegratingFactor, interval: Section, h: jax.Array, steps: int,
               min_sd: jax.Array) -> _StepMap:
    """Return the maps (J, ...) of the steps of an interval.

    Args:
        dynamics: the model and the rule.
        factor: the integrating factor of a step.
        interval: the interval.
        h: length of a step.
        steps: J.
        min_sd: see `lfm_ppl.filtering.dynamics.minimum_sd`.
    """
    span, moments, about = interval.span, interval.moments, interval.about
    ssm = dynamics.ssm
    size = ssm.physical_dim
    forces = _force_moments(factor, steps, _forces_of(moments, size), size)
    point = forces if about is None else jax.tree.map(insert_midpoints, _forces_of(about, size))

    def linearise_node(t: jax.Array, mean: jax.Array, point: Moments) -> _Node:
        # The drift without its constant linear part does not depend on the physical state here: any value will do.
        centre = jnp.concatenate([jnp.zeros(size), point.mean])

        def covariance(rows: jax.Array, reads_forces_only: bool) -> jax.Array:
            return congruence(rows[:, size:], point.covariance)

        drift: DriftLinearisation = linearise_drift(dynamics, t, centre, covariance, min_sd)
        jacobian, remainder = drift.jacobian[:, size:], drift.remainder
        if about is not None:
            remainder = remainder + matvec(jacobian, mean - point.mean)
        return _Node(jnp.concatenate([jacobian, remainder[:, None]], axis=1), drift.diffusion)

    if ssm.plan.is_autonomous:
        times = span.time(0.5 * h * jnp.arange(2 * steps + 1))
        nodes = jax.vmap(linearise_node)(times, forces.mean, point)
        first_middle_last = [jax.tree.map(lambda a, part=part: a[part], nodes) for part in _FIRST_MIDDLE_LAST]
    else:
        # The last node of a step and the first of the next one are at different sides of a jump of an input.
        offsets = jnp.arange(steps) * h
        times = jnp.stack([span.time(offsets), span.time(offsets + 0.5 * h), span.time(offsets + h)])
        nodes = jax.vmap(jax.vmap(linearise_node))(times, _by_node(forces.mean), jax.tree.map(_by_node, point))
        first_middle_last = [jax.tree.map(lambda a, index=index: a[index], nodes) for index in range(3)]
    # All steps at once: a loop would store its intermediate results step by step for the derivative.
    return jax.vmap(lambda *nodes: _simpson_step(factor, h, nodes, size))(*first_middle_last)


def _apply_step_map(moments: Moments, step_map: _StepMap, full: jax.Array) -> Prediction:
    """Return the prediction over one step; ``full`` is E(h), the transition of the linear part."""
    size = step_map.offset.shape[0]
    mean = matvec(full, moments.mean)
    mean = jnp.concatenate([mean[:size] + step_map.offset, mean[size:]])
    covariance = congruence(step_map.phi, moments.covariance) + step_map.process_cov
    return Prediction(Moments(mean, covariance), step_map.phi, step_map.process_cov)


def _force_moments(factor: IntegratingFactor, steps: int, start: Moments, size: int) -> Moments:
    """Return the moments (2 J + 1, ...) of the forces' states at the nodes."""
    if factor.halves is not None:
        transitions, covariances = factor.halves
        return Moments(matvec(transitions, start.mean), congruence(transitions, start.covariance) + covariances)
    half = factor.half[size:, size:]

    def half_step(moments: Moments, _: None) -> tuple[Moments, Moments]:
        return transform(moments, half, factor.force_cov_half), moments

    last, previous = jax.lax.scan(half_step, start, None, length=2 * steps)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), previous, last)


def _forces_of(moments: Moments, size: int) -> Moments:
    """Return the moments of the forces' states, which follow ``size`` physical ones."""
    return Moments(moments.mean[..., size:], moments.covariance[..., size:, size:])


def _by_node(a: jax.Array) -> jax.Array:
    return jnp.stack([a[part] for part in _FIRST_MIDDLE_LAST])


def _simpson_step(factor: IntegratingFactor, h: jax.Array, nodes: tuple[_Node, ...], size: int) -> _StepMap:
    """Return the map of a step from its first, middle and last node.

    The middle node is both the second and the third Runge-Kutta stage; their Z, where Psi~ = I - Z is the inverse
    transition to a stage's node, differ.
    """
    half, full = factor.half, factor.full
    full_x = full[:size, :size]

    # The remainder of the drift is one more column, which the forces' transition leaves alone.
    def with_remainder(transition: jax.Array) -> jax.Array:
        return block_diagonal([transition, np.eye(1)])

    first, second, third = (node.remainder for node in nodes)
    middle = matmul(second, with_remainder(half[size:, size:]))
    last = matmul(third, with_remainder(full[size:, size:]))
    assert factor.weights is not None
    increment = factor.weights.integrate(first, middle, last)
    jacobian, offset = increment[:, :-1], increment[:, -1]
    pulled = matmul(factor.back_half[:size, :size], middle[:, :-1])
    inverse = h * jnp.stack([0.5 * first[:, :-1], 0.5 * pulled, pulled])
    linear = jnp.stack([full[:size], half[:size], half[:size], jnp.eye(size, full.shape[0])])
    backward = jnp.stack([factor.back_half, factor.back_half, factor.back_full])[:, size:, size:]
    nonlinear = jnp.concatenate([jacobian[None], matmul(jacobian - matmul(full_x, inverse), backward)])
    transports = jnp.concatenate([linear[:, :, :size], linear[:, :, size:] + nonlinear], axis=2)
    start, midpoint, end = (node.diffusion for node in nodes)
    diffusions = stack_diffusions(start, midpoint, midpoint, end) if factor.state_noise is None else None
    process_cov = process_cov_at(factor, -1, transports, diffusions, h * WEIGHTS, size)
    if factor.state_noise is not None:
        process_cov = process_cov.at[:size, :size].add(factor.state_noise)
    return _StepMap(jnp.concatenate([transports[0], full[size:]]), offset, process_cov)
