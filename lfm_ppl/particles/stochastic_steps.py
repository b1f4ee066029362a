r"""Time steps of particles: the physical state by a strong Runge-Kutta scheme, the forces exactly.

A step of length h from time t has four parts.

1. Draw DeltaB = B(t + h) - B(t) and J = int (B(s) - B(t)) ds of the Brownian motion B of the physical state, which are
   jointly Gaussian; s runs over the step.
2. Draw the forces' state z(t + h) and the integrals int z(s) ds given z(t) from their exact joint Gaussian
   distribution (`step_constants`).
3. Advance the physical state by one of the schemes
   "srk": Rössler's SRA1, strong order 1.5, additive noise;
   "milstein": strong order 1, commutative noise;
   "euler": strong order 1/2, any noise.
4. After the last step of a row, let the forces jump if a jump time is at its end, and apply an event there.

The scheme "exact" replaces parts 1 to 3 by one draw from the transition of a linear time-invariant model.

Source: Rössler (2010), SIAM J. Numer. Anal. 48(3), for SRA1; Kloeden and Platen (1992), Numerical Solution of
Stochastic Differential Equations, chapter 10, for the others.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.integrators.exact import exact_offset
from lfm_ppl.filtering.intervals import Intervals, TimeGrid, by_length
from lfm_ppl.filtering.transition import Exact, exact
from lfm_ppl.forces.discretise import discretise
from lfm_ppl.model.state_space import Span, StateSpaceModel
from lfm_ppl.model.structure import pattern
from lfm_ppl.particles.normals import normals
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import matmul
from lfm_ppl.utils.semidefinite import semidefinite_root

SCHEMES = ("exact", "srk", "milstein", "euler")


class StepConstants(eqx.Module):
    """Matrices that all steps of one length share.

    Attributes:
        transition: (nz, nz), of the forces' state z.
        integral: (K, nz), map from z(t) to the mean of the integral of ``averaged z(s)`` over the step; ``averaged``
            are the combinations (K, nz) of `_averaged_combinations`.
        root: factor of the noise covariance of (z(t + h), integral); of the joint state for the scheme "exact".
        joint: for "exact", the transition of the joint state over the row.
    """

    transition: jax.Array
    integral: jax.Array
    root: jax.Array
    joint: Exact | None = None


def choose_scheme(ssm: StateSpaceModel, scheme: str) -> str:
    """Return the integration scheme, with "auto" replaced.

    "auto" is "exact" for a linear time-invariant model, "srk" (strong order 1.5) if the dispersion does not depend on
    the state, "milstein" (1) for one noise source, and "euler" (1/2) otherwise.

    Raises:
        ValueError: an unknown scheme, or one that the model does not allow.
    """
    checks.one_of("scheme", scheme, ("auto", *SCHEMES))
    noise = ssm.model.process_noise
    is_additive = not callable(noise) or not _has_state_dependent_noise(ssm)
    if scheme == "auto":
        if ssm.plan.has_exact_noise:
            return "exact"
        if is_additive:
            return "srk"
        return "milstein" if _noise_sources(ssm) == 1 else "euler"
    if scheme == "exact" and not ssm.plan.has_exact_noise:
        raise ValueError('scheme "exact" is for linear time-invariant models; use "auto".')
    if scheme == "srk" and not is_additive:
        raise ValueError('scheme "srk" needs additive noise, but process_noise depends on the state or on a force; '
                         'use "auto".')
    return scheme


def step_constants(ssm: StateSpaceModel, scheme: str, length: jax.Array, steps: int) -> StepConstants:
    """Return the matrices that the steps of a row of ``length`` share."""
    empty = jnp.zeros((0, 0))
    if scheme == "exact":
        joint = exact(ssm, length, steps)
        return StepConstants(empty, empty, semidefinite_root(joint.process_cov), joint)
    size, h = ssm.force_dim, length / steps
    if size == 0:
        return StepConstants(empty, empty, empty)
    # Force state and integral together are one linear SDE: d(integral)/dt = averaged z.
    averaged = _averaged_combinations(ssm)
    dispersion = ssm.stack.dispersion()
    joint_size = size + averaged.shape[0]
    feedback = jnp.zeros((joint_size, joint_size))
    feedback = feedback.at[:size, :size].set(ssm.stack.feedback()).at[size:, :size].set(averaged)
    diffusion = jnp.zeros((joint_size, joint_size)).at[:size, :size].set(matmul(dispersion, dispersion.T))
    transition, noise = discretise(feedback, diffusion, h)
    # The closed forms of the forces are more accurate than the matrix exponential.
    force_transition, force_noise = ssm.stack.discretise(h)
    noise = noise.at[:size, :size].set(force_noise)
    return StepConstants(force_transition, transition[size:, :size], semidefinite_root(noise))


def initial_particles(key: jax.Array, mean: jax.Array, covariance: jax.Array, count: int) -> jax.Array:
    """Draw ``count`` particles (n, N) from a Gaussian."""
    return mean[:, None] + matmul(semidefinite_root(covariance), normals(key, mean.shape[0], count))


class ParticleTransition:
    """Transition of particles over the rows of a time grid.

    Attributes:
        ssm: the model.
        scheme: one of `SCHEMES`.
        grid: the time grid.
        step_constants: maps a row to the `StepConstants` of its length.
        jumps: tables of the forces' jumps, `Stack.jump_roots`; None without jumps.
    """

    def __init__(self, ssm: StateSpaceModel, scheme: str, grid: TimeGrid):
        self.ssm, self.scheme, self.grid = ssm, scheme, grid
        self.step_constants = by_length(grid, lambda length: step_constants(ssm, scheme, length, grid.steps))
        self.jumps = ssm.stack.jump_roots()

    def move(self, interval: Intervals, constants: StepConstants, move_key: jax.Array, jump_key: jax.Array,
             state: jax.Array) -> jax.Array:
        """Move particles (n, N) over a row, and apply the jump and the event at its end."""
        size = self.ssm.physical_dim

        def advance(state: jax.Array) -> jax.Array:
            return self._advance(interval, constants, move_key, state)

        def jump(state: jax.Array) -> jax.Array:
            gain, root = (table[interval.jump] for table in self.jumps or ())
            noise = matmul(root, normals(jump_key, self.ssm.force_dim, state.shape[1]))
            return jnp.concatenate([state[:size], matmul(gain, state[size:]) + noise])

        def identity(state: jax.Array) -> jax.Array:
            return state

        state = jax.lax.cond(interval.length > 0, advance, identity, state) if self.grid.replicated else advance(state)
        if self.jumps is not None:
            state = jax.lax.cond(interval.jump >= 0, jump, identity, state)
        return state if interval.state_map is None else interval.state_map.apply(state.T).T

    def _advance(self, interval: Intervals, constants: StepConstants, key: jax.Array, state: jax.Array) -> jax.Array:
        """Integrate particles (n, N), one in each column, over a row of positive length."""
        ssm, steps, span = self.ssm, self.grid.steps, interval.span
        count = state.shape[1]
        if constants.joint is not None:
            offset = exact_offset(ssm, constants.joint, steps, span, interval.length)
            noise = normals(key, ssm.state_dim, count)
            return (_small_matmul(constants.joint.phi, state) + _small_matmul(constants.root, noise)
                    + offset[:, None])
        scheme = {"srk": srk, "milstein": milstein, "euler": euler}[self.scheme]
        sources = _noise_sources(ssm)
        h = interval.length / steps
        # Only SRK needs J, the second normal number of each noise source.
        physical = 2 * sources if self.scheme == "srk" else sources
        normals_per_step = physical + constants.root.shape[0]
        # Normal numbers come in pairs: an odd number per step is drawn for two steps at once.
        steps_per_draw = 2 if normals_per_step % 2 and steps % 2 == 0 else 1

        def integrate_step(state: jax.Array, step_span: Span, noise: jax.Array) -> jax.Array:
            increment_noise, integral_noise = noise[:sources], noise[physical - sources:physical]
            force_noise = _small_matmul(constants.root, noise[physical:])

            def integrate_particle(s: jax.Array, physical_noise: tuple[jax.Array, jax.Array],
                                   force_noise: jax.Array) -> jax.Array:
                return scheme(ssm, constants, h, step_span, s, physical_noise, force_noise)

            return jax.vmap(integrate_particle, in_axes=-1, out_axes=-1)(
                state, (increment_noise, integral_noise), force_noise)

        def body(state: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
            first_step, step_key = inputs
            noise = normals(step_key, steps_per_draw * normals_per_step, count)
            for index in range(steps_per_draw):
                state = integrate_step(state, span.shifted((first_step + index) * h),
                                       noise[index * normals_per_step:(index + 1) * normals_per_step])
            return state, None

        first_steps = jnp.arange(0, steps, steps_per_draw)
        return jax.lax.scan(body, state, (first_steps, jax.random.split(key, len(first_steps))))[0]


def srk(ssm: StateSpaceModel, constants: StepConstants, h: jax.Array, span: Span, s: jax.Array,
        noise: tuple[jax.Array, jax.Array], force_noise: jax.Array) -> jax.Array:
    r"""Take a step of Rössler's SRA1, of strong order 1.5 for additive noise.

        K_1 = f(x, u, t),    K_2 = f(x + 3/4 h K_1 + 3/2 G J/h, u + 3/2 (mean of u - u), t + 3/4 h),
        x + h (K_1 + 2 K_2) / 3 + G(t + h) (DeltaB - J/h) + G(t) J/h.

    A force enters like one more component of the state. In the second stage, the exact average of the force over the
    step replaces the drift and J of that component.

    Args:
        ssm: the model.
        constants: of steps of length h.
        h: step size.
        span: times from the start of the step.
        s: (n,), one particle.
        noise: two vectors of standard normal numbers, one number for each noise source, for DeltaB and J.
        force_noise: (nz + K,), noise of the forces' state and integral.
    """
    size = ssm.physical_dim
    x, z = s[:size], s[size:]
    next_z, w, stage2_force = force_inputs(ssm, constants, h, span, x, z, force_noise)
    stage1 = ssm.drift(w, span.time())
    stage2_state = x + 0.75 * h * stage1
    noise_term = jnp.zeros(size)
    if ssm.model.process_noise is not None:
        increment = jnp.sqrt(h) * noise[0]
        mean_increment = 0.5 * increment + jnp.sqrt(h / 12.0) * noise[1]  # J / h
        start_dispersion, end_dispersion = ssm.dispersion(w, span.time()), ssm.dispersion(w, span.time(h))
        assert start_dispersion is not None and end_dispersion is not None
        stage2_state = stage2_state + 1.5 * _matvec(start_dispersion, mean_increment)
        noise_term = (_matvec(end_dispersion, increment - mean_increment)
                      + _matvec(start_dispersion, mean_increment))
    stage2 = ssm.drift(jnp.concatenate([stage2_state, stage2_force]), span.time(0.75 * h))
    return jnp.concatenate([x + h / 3.0 * (stage1 + 2.0 * stage2) + noise_term, next_z])


def milstein(ssm: StateSpaceModel, constants: StepConstants, h: jax.Array, span: Span, s: jax.Array,
             noise: tuple[jax.Array, jax.Array], force_noise: jax.Array) -> jax.Array:
    """Add half of (dG/dx G) (DeltaB DeltaB' - h I) to Euler's step: strong order 1 for commutative noise.

    A dispersion that depends on a force adds no term if the force is smooth (Matern of order 1 and more). Arguments
    as in `srk`.
    """
    size = ssm.physical_dim
    x, z = s[:size], s[size:]
    t = span.time()
    next_z, w, _ = force_inputs(ssm, constants, h, span, x, z, force_noise)
    u = w[size:]

    def dispersion_at(x: jax.Array) -> jax.Array:
        value = ssm.dispersion(jnp.concatenate([x, u]), t)
        return jnp.zeros((size, 0)) if value is None else value

    dispersion = dispersion_at(x)
    increment = jnp.sqrt(h) * noise[0]
    noise_term = _matvec(dispersion, increment)
    _, correction = jax.jvp(lambda x: _matvec(dispersion_at(x), increment), (x,), (noise_term,))
    for source in range(_noise_sources(ssm)):
        _, derivative = jax.jvp(lambda x, j=source: dispersion_at(x)[:, j], (x,), (dispersion[:, source],))
        correction = correction - h * derivative
    return jnp.concatenate([x + h * ssm.drift(w, t) + noise_term + 0.5 * correction, next_z])


def euler(ssm: StateSpaceModel, constants: StepConstants, h: jax.Array, span: Span, s: jax.Array,
          noise: tuple[jax.Array, jax.Array], force_noise: jax.Array) -> jax.Array:
    """Take a step of Euler and Maruyama: strong order 1/2, and 1 for additive noise. Arguments as in `srk`."""
    size = ssm.physical_dim
    x, z = s[:size], s[size:]
    t = span.time()
    next_z, w, _ = force_inputs(ssm, constants, h, span, x, z, force_noise)
    next_x = x + h * ssm.drift(w, t)
    dispersion = ssm.dispersion(w, t)
    if dispersion is not None:
        next_x = next_x + _matvec(dispersion, jnp.sqrt(h) * noise[0])
    return jnp.concatenate([next_x, next_z])


def force_inputs(ssm: StateSpaceModel, constants: StepConstants, h: jax.Array, span: Span, x: jax.Array, z: jax.Array,
                 force_noise: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return z at the end, the inputs w = (x, u) at the start, and u of the second stage of `srk`."""
    if ssm.force_dim == 0:
        return z, x, jnp.zeros(0)
    size, t = ssm.force_dim, span.time()
    next_z = _matvec(constants.transition, z) + force_noise[:size]
    u = _matvec(ssm.stack.measurement(t), z) + ssm.stack.mean_at(t)
    # A row between equal times has h = 0: no division by zero there, so that values and derivatives stay finite.
    inverse = jnp.where(h > 0, 1.0 / jnp.where(h > 0, h, 1.0), 0.0)
    average = inverse * (_matvec(constants.integral, z) + force_noise[size:])
    stage2_time = span.time(0.75 * h)
    if ssm.constant_measurement:
        start = _matvec(ssm.stack.measurement(t), z)
        stage2_force = start + 1.5 * (average - start)
    else:
        stage2_force = _matvec(ssm.stack.measurement(stage2_time), z + 1.5 * (average - z))
    return next_z, jnp.concatenate([x, u]), stage2_force + ssm.stack.mean_at(stage2_time)


def _averaged_combinations(ssm: StateSpaceModel) -> jax.Array:
    """Return the combinations (K, nz) of the forces' state whose integrals are drawn: the forces, or all states."""
    return ssm.stack.measurement(0.0) if ssm.constant_measurement else jnp.eye(ssm.force_dim)


def _noise_sources(ssm: StateSpaceModel) -> int:
    """Return the number of Brownian motions of the physical state."""
    if ssm.model.process_noise is None:
        return 0
    shape = jax.eval_shape(lambda w: ssm.dispersion(w, 0.0), jnp.zeros(ssm.input_dim)).shape
    return shape[1]


def _has_state_dependent_noise(ssm: StateSpaceModel) -> bool:
    """Return whether the dispersion depends on states or forces, not on time alone."""
    structure = pattern(lambda v: jnp.ravel(ssm.dispersion(v[:-1], v[-1])),  # type: ignore[arg-type]
                        ssm.input_dim + 1)
    return bool(np.asarray(structure.jacobian)[:, :ssm.input_dim].any())


def _matvec(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    return matmul(matrix, vector[:, None])[:, 0]


def _small_matmul(matrix: jax.Array, columns: jax.Array) -> jax.Array:
    """Return the product of a small matrix (k, n) with (n, N), as sums of rows, which XLA fuses."""
    if matrix.shape[1] == 0:
        return jnp.zeros((matrix.shape[0], columns.shape[1]))
    if matrix.shape[1] > 8:
        return jnp.matmul(matrix, columns)
    return jnp.stack([sum(matrix[i, j] * columns[j] for j in range(matrix.shape[1]))
                      for i in range(matrix.shape[0])])
