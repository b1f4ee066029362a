"""Exact transitions of the linear part of a model, computed once for every interval length.

The joint linear part

    d(x, z) = Lin (x, z) dt + noise,    Lin = [[J, B], [0, F]],

consists of the constant linear part of the dynamics and the forces.

1. `linear_part` evaluates the constant Jacobian J, B of the drift.
2. `exact` gives the transition of a model without any other part.
3. `input_weights` gives the weights with which a step adds up known inputs, exact for inputs quadratic in time;
   `dispersion_noise` the process noise of a dispersion that is quadratic in time.
4. `integrating_factor` gives the transitions over half and full steps, and the regressions of the noise of the steps on
   the noise of the forces, for a Runge-Kutta step over the rest.

Source: Hochbruck and Ostermann (2010), Acta Numerica 19, section 2, for the weights.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.forces.discretise import discretise, discretise_dispersion, discretise_steps
from lfm_ppl.forces.phi_functions import phi_functions, scalar_phi_functions
from lfm_ppl.linearisation.input_selection import InputStructure
from lfm_ppl.linearisation.rule import Function, partial_jacobian, selection
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.utils.linalg import congruence, diagonal, matmul, safe_sqrt
from lfm_ppl.utils.semidefinite import solve_semidefinite


class LinearPart(NamedTuple):
    """The constant linear part of the dynamics.

    Attributes:
        jacobian: (M, M + R), Jacobian in the constant inputs, zero in the others.
        rows: (M, n), the rows [J, B] of ``Lin``.
    """

    jacobian: jax.Array
    rows: jax.Array


class InputWeights(NamedTuple):
    r"""Weights of known inputs b(s), additive terms of dx/dt = J x + b(s), over a step of length h.

        int_0^h exp(J (h - s)) b(s) ds = first b(0) + middle b(h/2) + last b(h)

    for b quadratic in time, however large J h is. For a small J h they are the weights of Simpson's rule.

    Attributes:
        transition: exp(J h) (M, M).
        first, middle, last: (M, M).
    """

    transition: jax.Array
    first: jax.Array
    middle: jax.Array
    last: jax.Array

    def integrate(self, first: jax.Array, middle: jax.Array, last: jax.Array) -> jax.Array:
        """Return the integral (M, K) of inputs whose values (M, K) at start, middle and end of the step are given."""
        return matmul(self.first, first) + matmul(self.middle, middle) + matmul(self.last, last)


class Exact(NamedTuple):
    """Transition of a model with constant coefficients over an interval: s -> phi s + offset + N(0, process_cov).

    An offset or a dispersion that varies with time is not included: a filter integrates it in steps with the weights
    ``inputs``, which are None where nothing varies.
    """

    phi: jax.Array
    process_cov: jax.Array
    offset: jax.Array
    inputs: InputWeights | None = None


class IntegratingFactor(NamedTuple):
    """What a Runge-Kutta step of length h needs of the linear part.

    ``half`` and ``full`` are E(h/2) and E(h), the exponential of ``Lin``. ``back_half`` and ``back_full`` approximate
    their inverses by 4 - 6 E + 4 E^2 - E^3 and its square: to the order of the step where it resolves ``Lin``, and
    bounded where it does not, while the true inverses of fast decays overflow. ``force_cov_half`` and
    ``force_cov_full`` are the exact covariances of the forces' noise, ``inputs`` (nz, S) its dispersion. ``columns``
    (nz, K) stand for the forces' noise at the nodes of each later stage (not by quadrature) and, the last, of the whole
    step; ``regressions`` (K, nz) regress them on the exact noise. ``halves`` are the transitions and the noise (2 J +
    1, nz, nz) of the forces over 0, 1, ..., 2 J halves of a step; None where they are chained. Where the rest of the
    dynamics is known at all nodes, ``weights`` integrate it, and ``state_noise`` (M, M) is the exact noise of a
    constant dispersion; None otherwise.
    """

    half: jax.Array
    full: jax.Array
    back_half: jax.Array
    back_full: jax.Array
    force_cov_half: jax.Array
    force_cov_full: jax.Array
    inputs: jax.Array
    columns: tuple[jax.Array, ...]
    regressions: tuple[jax.Array, ...]
    halves: tuple[jax.Array, jax.Array] | None = None
    weights: InputWeights | None = None
    state_noise: jax.Array | None = None


def constant_jacobian(function: Function, point: jax.Array, structure: InputStructure, outputs: int) -> jax.Array:
    """Return the Jacobian (D, N) in the constant inputs, zero elsewhere; it is the same at every point."""
    if not structure.constant:
        return jnp.zeros((outputs, point.shape[0]))
    part = partial_jacobian(function, point, structure.constant)
    return matmul(part, selection(structure.constant, point.shape[0]).T)


def linear_part(ssm: StateSpaceModel, t: jax.Array) -> LinearPart:
    """Return the constant linear part of the dynamics; ``t`` is any time."""
    mean, _ = ssm.initial()
    matrix, offset = ssm.input_map(t)

    def function(w: jax.Array) -> tuple[jax.Array, tuple]:
        return ssm.drift(w, t), ()

    jacobian = constant_jacobian(function, matmul(matrix, mean[:, None])[:, 0] + offset, ssm.drift_structure,
                                 ssm.physical_dim)
    usable = jacobian if ssm.constant_measurement else jacobian * (np.arange(ssm.input_dim) < ssm.physical_dim)
    return LinearPart(jacobian, matmul(usable, matrix) if ssm.physical_dim else jnp.zeros((0, ssm.state_dim)))


def feedback(ssm: StateSpaceModel, linear: LinearPart) -> jax.Array:
    """Return ``Lin`` (n, n)."""
    size = ssm.physical_dim
    below = jnp.concatenate([jnp.zeros((ssm.force_dim, size)), ssm.stack.feedback()], axis=1)
    return jnp.concatenate([linear.rows, below])


def input_weights(ssm: StateSpaceModel, linear: LinearPart, step: jax.Array) -> InputWeights:
    """Return the weights of known inputs over a step, for the constant Jacobian J of the physical state in itself."""
    size = ssm.physical_dim
    jacobian = step * linear.rows[:, :size]
    if _pattern(ssm)[:, :size][~np.eye(size, dtype=bool)].any():
        exponential, phi1, phi2, phi3 = phi_functions(jacobian)
    else:
        exponential, phi1, phi2, phi3 = jax.vmap(jnp.diag)(scalar_phi_functions(diagonal(jacobian)))
    # The Lagrange polynomials of the nodes 0, 1/2, 1, and int_0^1 exp(X (1 - s)) s^k ds = k! phi_(k+1)(X).
    return InputWeights(exponential, step * (phi1 - 3.0 * phi2 + 4.0 * phi3), step * (4.0 * phi2 - 8.0 * phi3),
                        step * (4.0 * phi3 - phi2))


def dispersion_noise(jacobian: jax.Array, step: jax.Array, first: jax.Array, middle: jax.Array,
                     last: jax.Array) -> jax.Array:
    r"""Return the process noise (M, M) of dx = J x dt + G(s) dB over a step of length h.

        Q = int_0^h exp(J r) G(h - r) G(h - r)' exp(J r)' dr,

    for the dispersion G quadratic in time, however large J h is. The columns Y_k = exp(J r) d^k G(h - r)/dr^k obey the
    linear ODE Y_k' = J Y_k + Y_(k+1), so that one discretisation of three times the size gives Q as a sum of squares.

    Args:
        jacobian: J (M, M).
        step: h.
        first: G (M, S) at the start of the step.
        middle: G at its middle.
        last: G at its end.
    """
    size = jacobian.shape[0]
    slope, curvature = 4.0 * middle - 3.0 * last - first, 4.0 * (first - 2.0 * middle + last)
    chain = jnp.kron(jnp.eye(3), step * jacobian) + np.kron(np.diag(np.ones(2), 1), np.eye(size))
    _, noise = discretise_dispersion(chain, jnp.concatenate([last, slope, curvature]), 1.0)
    return step * noise[:size, :size]


def exact(ssm: StateSpaceModel, length: jax.Array, steps: int, linear: LinearPart | None = None) -> Exact:
    """Return the transition of a model with constant coefficients over an interval of ``length``, or of many (B,).

    Its ``linear`` part is that of any time. The offset is zero, and the process noise that of the forces, where they
    vary with time.
    """
    size, total = ssm.physical_dim, ssm.state_dim
    is_block = jnp.ndim(length) == 1
    discretise_joint = discretise_steps if is_block else discretise
    discretise_forces = jax.vmap(ssm.stack.discretise) if is_block else ssm.stack.discretise
    if size == 0:
        phi, process_cov = discretise_forces(length)
        return Exact(phi, process_cov, jnp.zeros(phi.shape[:-1]))
    t = jnp.zeros(())
    linear = linear_part(ssm, t) if linear is None else linear
    matrix, shift = ssm.input_map(t)
    constant = jnp.zeros(total).at[:size].set(ssm.drift(shift, t)) if ssm.plan.has_exact_offset else jnp.zeros(total)
    lin = feedback(ssm, linear)
    dispersion = ssm.model.process_noise
    is_constant = dispersion is not None and not callable(dispersion)
    diffusion = None
    if is_constant or ssm.force_dim or not is_block:
        diffusion = jax.scipy.linalg.block_diag(
            matmul(dispersion, dispersion.T) if is_constant else jnp.zeros((size, size)),
            matmul(ssm.stack.dispersion(), ssm.stack.dispersion().T), jnp.zeros((1, 1)))
    # One more state that is constantly one carries the offset.
    augmented = jnp.zeros((total + 1, total + 1)).at[:total, :total].set(lin).at[:total, total].set(constant)
    phi, process_cov = discretise_joint(augmented, diffusion, length)
    forces, force_cov = discretise_forces(length)
    phi = phi.at[..., size:total, size:total].set(forces)
    process_cov = process_cov.at[..., size:total, size:total].set(force_cov) if size else process_cov
    inputs = None
    if not ssm.plan.has_exact_offset:
        weights_of = functools.partial(input_weights, ssm, linear)
        inputs = (jax.vmap(weights_of) if is_block else weights_of)(length / steps)
    return Exact(phi[..., :total, :total], process_cov[..., :total, :total], phi[..., :total, total], inputs)


def integrating_factor(ssm: StateSpaceModel, linear: LinearPart, step: jax.Array, stages: bool = True,
                       halves_of: int | None = None) -> IntegratingFactor:
    """Return what a step of length ``step`` needs of the linear part.

    Args:
        ssm: the model.
        linear: its constant linear part.
        step: length.
        stages: whether the step has stages whose covariance is needed; not so where it is one of a quadrature.
        halves_of: number of steps for which ``halves`` are wanted.
    """
    halves = None
    if halves_of is not None:
        halves = jax.vmap(ssm.stack.discretise)(0.5 * step * np.arange(2 * halves_of + 1))
    forces, force_cov_half = ssm.stack.discretise(0.5 * step) if halves is None else (halves[0][1], halves[1][1])
    half = _half_step(ssm, linear, 0.5 * step, forces)
    full = matmul(half, half)
    identity = jnp.eye(ssm.state_dim)
    back_half = 4.0 * identity - 6.0 * half + 4.0 * full - matmul(full, half)
    size = ssm.physical_dim
    half_z, full_z = half[size:, size:], full[size:, size:]
    force_cov_full = congruence(half_z, force_cov_half) + force_cov_half
    inputs = ssm.stack.dispersion()
    at_half, at_full = matmul(half_z, inputs), matmul(full_z, inputs)

    def root(weight: float) -> jax.Array:
        return safe_sqrt(weight * step)

    columns: tuple[jax.Array, ...] = (jnp.concatenate(
        [root(1 / 6) * at_full, root(1 / 3) * at_half, root(1 / 3) * at_half, root(1 / 6) * inputs], axis=1),)
    if stages:
        columns = (root(0.5) * at_half, root(0.5) * inputs, root(1.0) * at_half, *columns)
    back_full = matmul(back_half, back_half)
    regressions = _regressions(columns, force_cov_half, force_cov_full)
    factor = IntegratingFactor(half, full, back_half, back_full, force_cov_half, force_cov_full, inputs, columns,
                               regressions, halves)
    if stages:
        return factor
    jacobian, dispersion = linear.rows[:, :size], ssm.model.process_noise
    state_noise = None
    if dispersion is not None and not callable(dispersion):
        _, state_noise = discretise(jacobian, matmul(dispersion, dispersion.T), step)
    return factor._replace(weights=input_weights(ssm, linear, step), state_noise=state_noise)


def _regressions(columns: tuple[jax.Array, ...], force_cov_half: jax.Array,
                 force_cov_full: jax.Array) -> tuple[jax.Array, ...]:
    """Regress columns (nz, K) on the exact noise of half a step, the first two of four, and of a step: (K, nz) each."""
    if not force_cov_half.shape[0]:
        return tuple(column.T for column in columns)
    if len(columns) == 1:
        return (solve_semidefinite(force_cov_full, columns[0]).T,)
    widths = [column.shape[1] for column in columns]
    sides = [jnp.concatenate(columns[:2], axis=1), jnp.concatenate(columns[2:], axis=1)]
    # Side by side: one factorisation in the program.
    sides[0] = jnp.pad(sides[0], ((0, 0), (0, sides[1].shape[1] - sides[0].shape[1])))
    solved = jax.vmap(solve_semidefinite)(jnp.stack([force_cov_half, force_cov_full]), jnp.stack(sides)).mT
    column_ends = np.cumsum(widths[:2]), np.cumsum(widths[2:])
    return tuple(solved[side, end - width:end] for side in (0, 1)
                 for end, width in zip(column_ends[side], widths[2 * side:2 * side + 2], strict=True))


def _pattern(ssm: StateSpaceModel) -> np.ndarray:
    """Return whether an output of the dynamics depends on a constant input, (M, M + R)."""
    structure = ssm.drift_structure
    pattern = np.array(structure.jacobian, bool).reshape(ssm.physical_dim, ssm.input_dim)
    return pattern & np.isin(np.arange(ssm.input_dim), structure.constant)


def _half_step(ssm: StateSpaceModel, linear: LinearPart, dt: jax.Array, forces: jax.Array) -> jax.Array:
    """Return E(dt) (n, n) from the transition of the forces."""
    size, pattern = ssm.physical_dim, _pattern(ssm)
    coupled = pattern[:, size:].any() and ssm.constant_measurement
    state_pattern = pattern[:, :size]
    if coupled or state_pattern[~np.eye(size, dtype=bool)].any():
        lin = feedback(ssm, linear)
        phi, _ = discretise(lin, jnp.zeros_like(lin), dt)
        return phi.at[size:, size:].set(forces)
    decay = jnp.exp(diagonal(linear.rows[:, :size]) * dt) if state_pattern.any() else jnp.ones(size)
    return jax.scipy.linalg.block_diag(jnp.diag(decay), forces)
