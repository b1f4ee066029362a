r"""One Runge-Kutta step of the mean and the transition matrix of the linearised system.

The filter's moments obey dm/dt = E[f] and dP/dt = A P + P A' + E[G G']. The covariance is carried as

    P(t) = Phi(t) (P0 + W(t)) Phi(t)',    dPhi/dt = A Phi,    dW/dt = Phi^-1 D Phi^-T,

and the classical Runge-Kutta method integrates (m, Phi, W):

1. Remove the constant linear part of A by its exact exponential E, an integrating factor (`transition`).
2. Linearise the rest of the dynamics at the four stages, about the moments there or about given moments.
3. Sum the increments of Phi and of the mean, side by side as the columns of one matrix.
4. Sum the noise at the stages, carried to the end of the step, with the positive weights of the method. W, and with it
   P, is positive semi-definite at every stage and at the end, and the order is four.
5. Replace the part of the forces' own noise by its exact value: the noise that reaches x through the stages is
   regressed on it, plus a semi-definite remainder.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.dynamics import (
    Congruence,
    DriftLinearisation,
    Dynamics,
    covariance_of,
    linearise_drift,
    minimum_sd,
)
from lfm_ppl.filtering.integrators.integrator import Attempt, RepeatedStep, Section
from lfm_ppl.filtering.moments import Moments, Prediction, Record
from lfm_ppl.filtering.transition import IntegratingFactor, integrating_factor
from lfm_ppl.utils.linalg import congruence, diagonal, fastest_rate, matmul, outer_square, safe_sqrt, symmetric

WEIGHTS = np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6])
"""Weights of the four stages, in units of the step."""

_STABILITY_LIMIT = 10.0
"""Longest attempt, in units of one over the fastest rate: steps are unstable from 2.8 on and overflow far above."""


class FourthStage(NamedTuple):
    """The stage at the end of a step, and the covariance (n, n) about which it was linearised."""

    drift: DriftLinearisation
    covariance: jax.Array


@dataclass(frozen=True)
class RungeKutta(RepeatedStep):
    """The classical Runge-Kutta method.

    Where the fifth stage, which is the next step's first, replaces the fourth, the formula has order three. The
    difference of the two results, e = h (k_4 - k_5) / 6, estimates the error of a step at no cost.
    """

    is_explicit: ClassVar[bool] = True
    error_order: ClassVar[int] = 4

    def step(self, dynamics: Dynamics, table: Any, step: Section, min_sd: jax.Array) -> Prediction:
        """Predict over one step."""
        return _runge_kutta_step(dynamics, table, step, min_sd)[0]

    def attempts(self, dynamics: Dynamics, interval: Section,
                 record: Record) -> tuple[DriftLinearisation, Callable[[Section, Any], Attempt]]:
        """Return the linearised dynamics at the start of an interval, and the function (step, stage) -> `Attempt`."""
        ssm, span = dynamics.ssm, interval.span
        factor_of_interval = integrating_factor(ssm, dynamics.linear, interval.length)
        min_sd = minimum_sd(dynamics, factor_of_interval, span.time(), interval.length, interval.moments)

        def linearise_at(t: jax.Array, moments: Moments) -> DriftLinearisation:
            return linearise_drift(dynamics, t, moments.mean, covariance_of(moments), min_sd)

        def attempt(step: Section, stage: Any) -> Attempt:
            factor = integrating_factor(ssm, dynamics.linear, step.length)
            prediction, stage4 = _runge_kutta_step(dynamics, factor, step, min_sd, stage)
            stage5 = linearise_at(step.span.time(step.length), prediction.moments)
            error = jax.tree.map(_larger, _stage_error(step.length, prediction.moments, stage4, stage5),
                                 _linear_part_error(dynamics, factor, step, stage))
            return Attempt(prediction, error, stage5)

        return linearise_at(span.time(), interval.moments), attempt

    def longest_step(self, stage: Any) -> jax.Array | None:
        """Return the longest step that stays finite where it is rejected, with its derivative, which is not used."""
        return _STABILITY_LIMIT / fastest_rate(stage.jacobian)


def _runge_kutta_step(dynamics: Dynamics, factor: IntegratingFactor, step: Section, min_sd: jax.Array,
                      stage1: DriftLinearisation | None = None) -> tuple[Prediction, FourthStage]:
    """Predict over one step.

    Args:
        dynamics: the model and the rule.
        factor: the integrating factor of the step.
        step: the step.
        min_sd: see `lfm_ppl.filtering.dynamics.minimum_sd`.
        stage1: the first stage, where it is known from the step before.
    """
    span, h, (m, p), about = step
    size = dynamics.ssm.physical_dim
    half, full, back_half, back_full = factor.half, factor.full, factor.back_half, factor.back_full
    half_x, full_x = half[:size], full[:size]
    identity = jnp.eye(dynamics.ssm.state_dim)

    def linearise_stage(node: int, t: jax.Array, mean: jax.Array, covariance: Congruence) -> DriftLinearisation:
        point = jax.tree.map(lambda a: a[node], about)
        return linearise_drift(dynamics, t, mean, covariance, min_sd, point)

    # Increments of the transition matrix and of the mean are columns of one matrix (M, n + 1).
    def increment(stage: DriftLinearisation, phi: jax.Array) -> jax.Array:
        return jnp.concatenate([matmul(stage.jacobian, phi), stage.remainder[:, None]], axis=1)

    start = jnp.concatenate([identity, m[:, None]], axis=1)
    to_half, to_full = matmul(half, start), matmul(full, start)

    def add_increment(base: jax.Array, change: jax.Array) -> tuple[jax.Array, jax.Array]:
        state = jnp.concatenate([base[:size] + change, base[size:]])
        return state[:, :-1], state[:, -1]

    if stage1 is None:
        stage1 = linearise_stage(0, span.time(), m, covariance_of(step.moments))
    k1 = increment(stage1, identity)
    phi2, m2 = add_increment(to_half, 0.5 * h * matmul(half[:size, :size], k1))

    def process_cov_at_stage2() -> jax.Array:
        return process_cov_at(factor, 0, phi2[:size][None], stack_diffusions(stage1.diffusion),
                              jnp.reshape(0.5 * h, 1), size)

    stage2 = linearise_stage(1, span.time(0.5 * h), m2,
                             _propagated_covariance(p, phi2, process_cov_at_stage2, factor.force_cov_half, size))
    k2 = increment(stage2, phi2)
    z2 = 0.5 * h * stage1.jacobian

    phi3, m3 = add_increment(to_half, 0.5 * h * k2)
    transport3 = identity[:size] + matmul(_increment_after(phi3[:size] - half_x, phi3, z2, size), back_half)

    def process_cov_at_stage3() -> jax.Array:
        return process_cov_at(factor, 1, transport3[None], stack_diffusions(stage2.diffusion),
                              jnp.reshape(0.5 * h, 1), size)

    stage3 = linearise_stage(1, span.time(0.5 * h), m3,
                             _propagated_covariance(p, phi3, process_cov_at_stage3, factor.force_cov_half, size))
    k3 = increment(stage3, phi3)
    z3 = _inverse_transition(0.5 * h, z2, back_half, stage2.jacobian, half, size)

    phi4, m4 = add_increment(to_full, h * matmul(half[:size, :size], k3))
    transport4 = half_x + matmul(_increment_after(phi4[:size] - full_x, phi4, z3, size), back_half)

    def process_cov_at_stage4() -> jax.Array:
        return process_cov_at(factor, 2, transport4[None], stack_diffusions(stage3.diffusion), jnp.reshape(h, 1), size)

    covariance4 = _propagated_covariance(p, phi4, process_cov_at_stage4, factor.force_cov_full, size)
    stage4 = linearise_stage(2, span.time(h), m4, covariance4)
    k4 = increment(stage4, phi4)
    z4 = _inverse_transition(h, z3, back_half, stage3.jacobian, half, size)

    weighted = matmul(full[:size, :size], k1) + 2.0 * matmul(half[:size, :size], k2 + k3) + k4
    phi, mean = add_increment(to_full, h / 6 * weighted)
    change = phi[:size] - full_x
    transports = jnp.stack([phi[:size], half_x + matmul(_increment_after(change, phi, z2, size), back_half),
                            half_x + matmul(_increment_after(change, phi, z3, size), back_half),
                            identity[:size] + matmul(_increment_after(change, phi, z4, size), back_full)])
    diffusions = stack_diffusions(*(stage.diffusion for stage in (stage1, stage2, stage3, stage4)))
    process_cov = process_cov_at(factor, -1, transports, diffusions, h * WEIGHTS, size)
    moments = Moments(mean, congruence(phi, p) + process_cov)
    return Prediction(moments, phi, process_cov), FourthStage(stage4, covariance4(identity, False))


def stack_diffusions(*diffusions: jax.Array | None) -> jax.Array | None:
    """Return the diffusions of K stages as (K, M, M); None without process noise, where all of them are None."""
    present = [diffusion for diffusion in diffusions if diffusion is not None]
    return jnp.stack(present) if present else None


def _propagated_covariance(p: jax.Array, phi: jax.Array, process_cov: Callable[[], jax.Array], force_cov: jax.Array,
                           size: int) -> Congruence:
    """Return the function C -> C (Phi P Phi' + Q) C' of a stage."""

    def covariance(rows: jax.Array, reads_forces_only: bool) -> jax.Array:
        if reads_forces_only:
            force_rows = rows[:, size:]
            propagated = congruence(matmul(force_rows, phi[size:, size:]), p[size:, size:])
            return propagated + congruence(force_rows, force_cov)
        return congruence(matmul(rows, phi), p) + congruence(rows, process_cov())

    return covariance


def _increment_after(change: jax.Array, phi: jax.Array, inverse: jax.Array, size: int) -> jax.Array:
    """Return the rows of E(c_i) (Phi~_i Psi~_j - I): the change of the transition matrix after the node j."""
    return change - matmul(phi[:size, :size], inverse)


def _inverse_transition(scale: jax.Array, previous: jax.Array, backward: jax.Array, jacobian: jax.Array,
                        half: jax.Array, size: int) -> jax.Array:
    """Return the next stage of Z, where Psi~ = I - Z is the inverse transition in the interaction picture."""
    pulled = matmul(backward[:size, :size], matmul(jacobian, half))
    return scale * (pulled - matmul(previous[:, :size], pulled))


def process_cov_at(factor: IntegratingFactor, stage: int, transports: jax.Array, diffusions: jax.Array | None,
                   weights: jax.Array, size: int) -> jax.Array:
    """Return Q (n, n) at a stage: noise at K nodes, carried there by ``transports`` (K, M, n).

    The forces' noise at the nodes, ``columns``, is a quadrature of the exact noise. The noise that reaches x together
    with it is regressed on the exact noise: N_x = G N_z + remainder, semi-definite for any G.

    Args:
        factor: the integrating factor of the step.
        stage: index of the stage after the first one; -1: the end of the step.
        transports: (K, M, n), transition from each node to the stage, rows of the physical state.
        diffusions: (K, M, M), at the nodes; None without process noise.
        weights: (K,), of the nodes.
        size: M.
    """
    exact = factor.force_cov_half if stage in (0, 1) else factor.force_cov_full
    quadrature = safe_sqrt(weights)[:, None, None] * matmul(transports[:, :, size:], factor.inputs)
    quadrature = jnp.moveaxis(quadrature, 0, 1).reshape(size, factor.columns[stage].shape[1])
    gain = matmul(quadrature, factor.regressions[stage])
    cross = matmul(gain, exact)
    remainder = quadrature - matmul(gain, factor.columns[stage])
    state_cov = symmetric(matmul(cross, gain.T)) + outer_square(remainder)
    if diffusions is not None:
        state_cov = state_cov + (weights[:, None, None] * congruence(transports[:, :, :size], diffusions)).sum(0)
    return jnp.concatenate([jnp.concatenate([state_cov, cross], axis=1),
                            jnp.concatenate([cross.T, exact], axis=1)])


def _stage_error(h: jax.Array, end: Moments, stage4: FourthStage, stage5: DriftLinearisation) -> Moments:
    """Return the estimated errors of the mean (M,) and of the rows (M, n) of the covariance at the end of a step."""
    size = stage5.remainder.shape[0]
    mean = stage4.drift.remainder - stage5.remainder
    covariance = matmul(stage4.drift.jacobian, stage4.covariance) - matmul(stage5.jacobian, end.covariance)
    covariance = covariance.at[:, :size].add(covariance[:, :size].T)
    if stage5.diffusion is not None and stage4.drift.diffusion is not None:
        covariance = covariance.at[:, :size].add(stage4.drift.diffusion - stage5.diffusion)
    return Moments(h / 6 * mean, h / 6 * covariance)


def _linear_part_error(dynamics: Dynamics, factor: IntegratingFactor, step: Section,
                       stage1: DriftLinearisation) -> Moments:
    """Return the errors of the mean (M,) and the covariance (M, n) due to a fast linear part.

    The step replaces the integral of exp(A s) r ds, of the remainder r of the dynamics, by Simpson's rule W r. Its
    error e obeys A e = A W r - (exp(A h) - 1) r, and each row of e is about that over the state's own rate. The noise D
    obeys the same with A D + D A'.
    """
    size, h = dynamics.ssm.physical_dim, step.length
    matrix = dynamics.linear.rows[:, :size]
    full, half, identity = factor.full[:size, :size], factor.half[:size, :size], jnp.eye(size)
    remainder = jnp.concatenate([matmul(stage1.jacobian, step.moments.covariance), stage1.remainder[:, None]], axis=1)
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
    return Moments(error[:, -1], covariance)


def _larger(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the entry of the larger modulus."""
    return jnp.where(jnp.abs(a) >= jnp.abs(b), a, b)
