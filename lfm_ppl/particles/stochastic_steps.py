r"""Steps of particles: the physical state by a strong Runge-Kutta scheme, the forces exactly.

Over a step of length h the Brownian motion B of the state enters through DeltaB = B(t + h) - B(t) and
J = int (B(s) - B(t)) ds, which are jointly Gaussian; the forces enter through their values at the start and through
their averages over the step, drawn together with their state at its end from the exact joint distribution.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.filtering.predict import exact_offset
from lfm_ppl.filtering.time_grid import Intervals, TimeGrid, by_length
from lfm_ppl.filtering.transition import Exact, exact
from lfm_ppl.forces.discretise import discretise
from lfm_ppl.linalg import matmul, semidefinite_root
from lfm_ppl.model.state_space import Span, StateSpaceModel
from lfm_ppl.model.structure import pattern
from lfm_ppl.particles.normals import normals

SCHEMES = ("exact", "srk", "milstein", "euler")


class Prepared(NamedTuple):
    """What all steps of one length share.

    Attributes:
        transition: (nz, nz) of the forces.
        average: (K, nz), the integral over the step of ``rows`` z(s), as a map of z(t).
        root: factor of the covariance of the noise of (z(t + h), int rows z ds); of the joint state for "exact".
        whole: for "exact", the transition of the joint state over the row.
    """

    transition: jax.Array
    average: jax.Array
    root: jax.Array
    whole: Exact | None = None


def choose_scheme(ssm: StateSpaceModel, wanted: str) -> str:
    """Return the scheme that ``wanted`` stands for.

    "auto" takes "exact" for a linear time-invariant model, "srk" (strong order 1.5) where the dispersion does not
    depend on the state, "milstein" (1) for one noise source, "euler" (1/2) otherwise.

    Raises:
        ValueError: an unknown scheme, or one that the model does not allow.
    """
    checks.one_of("scheme", wanted, ("auto", *SCHEMES))
    noise = ssm.model.process_noise
    additive = not callable(noise) or not _state_dependent(ssm)
    if wanted == "auto":
        if ssm.time_invariant:
            return "exact"
        if additive:
            return "srk"
        return "milstein" if _sources(ssm) == 1 else "euler"
    if wanted == "exact" and not ssm.time_invariant:
        raise ValueError('scheme "exact" is for linear time-invariant models; use "auto".')
    if wanted == "srk" and not additive:
        raise ValueError('scheme "srk" needs additive noise, but process_noise depends on the state or on a force; '
                         'use "auto".')
    return wanted


def prepare(ssm: StateSpaceModel, scheme: str, length: jax.Array, steps: int) -> Prepared:
    """Return what the steps of a row of ``length`` share."""
    if scheme == "exact":
        whole = exact(ssm, length, steps)
        nothing = jnp.zeros((0, 0))
        return Prepared(nothing, nothing, semidefinite_root(whole.process_cov), whole)
    size, h = ssm.force_dim, length / steps
    if size == 0:
        return Prepared(jnp.zeros((0, 0)), jnp.zeros((0, 0)), jnp.zeros((0, 0)))
    rows = _averaged_rows(ssm)
    dispersion = ssm.stack.dispersion()
    wide = size + rows.shape[0]
    feedback = jnp.zeros((wide, wide)).at[:size, :size].set(ssm.stack.feedback()).at[size:, :size].set(rows)
    diffusion = jnp.zeros((wide, wide)).at[:size, :size].set(matmul(dispersion, dispersion.T))
    transition, noise = discretise(feedback, diffusion, h)
    forces, force_noise = ssm.stack.discretise(h)
    noise = noise.at[:size, :size].set(force_noise)
    return Prepared(forces, transition[size:, :size], semidefinite_root(noise))


def first_particles(key: jax.Array, mean: jax.Array, covariance: jax.Array, count: int) -> jax.Array:
    """Draw particles (n, N) of a Gaussian."""
    return mean[:, None] + matmul(semidefinite_root(covariance), normals(key, mean.shape[0], count))


class Moves(NamedTuple):
    """How particles cross the rows of a time grid.

    Attributes:
        ssm: the model.
        scheme: one of `SCHEMES`.
        grid: the time grid.
        ready: from a row to what `prepare` gives for its length.
        jumps: of the forces, `Stack.jump_roots`.
    """

    ssm: StateSpaceModel
    scheme: str
    grid: TimeGrid
    ready: Callable[[Intervals], Prepared]
    jumps: tuple[jax.Array, jax.Array] | None

    @classmethod
    def over(cls, ssm: StateSpaceModel, scheme: str, grid: TimeGrid) -> Moves:
        """Prepare what the rows share."""
        ready = by_length(grid, lambda length: prepare(ssm, scheme, length, grid.steps))
        return cls(ssm, scheme, grid, ready, ssm.stack.jump_roots())

    def across(self, row: Intervals, ready: Prepared, move_key: jax.Array, jump_key: jax.Array,
               state: jax.Array) -> jax.Array:
        """Move particles (n, N) over a row, and let the forces jump at its end."""
        size = self.ssm.physical_dim

        def move(state: jax.Array) -> jax.Array:
            return advance(self.ssm, self.scheme, ready, normals, move_key, state, row.span, row.length,
                           self.grid.steps)

        def jump(state: jax.Array) -> jax.Array:
            gain, root = (table[row.jump] for table in self.jumps or ())
            noise = matmul(root, normals(jump_key, self.ssm.force_dim, state.shape[1]))
            return jnp.concatenate([state[:size], matmul(gain, state[size:]) + noise])

        stay = lambda state: state  # noqa: E731
        state = jax.lax.cond(row.length > 0, move, stay, state) if self.grid.replicated else move(state)
        return state if self.jumps is None else jax.lax.cond(row.jump >= 0, jump, stay, state)


def advance(ssm: StateSpaceModel, scheme: str, prepared: Prepared, draw: Callable, key: jax.Array, state: jax.Array,
            span: Span, length: jax.Array, steps: int) -> jax.Array:
    """Move particles over a row.

    Args:
        ssm: the model.
        scheme: one of `SCHEMES`.
        prepared: of this length.
        draw: ``draw(key, count, particles)`` gives standard normal numbers (count, particles).
        key: a JAX random key.
        state: (n, N), a particle in each column.
        span: the row's times.
        length: of the row.
        steps: of the row.

    Returns:
        (n, N).
    """
    count = state.shape[1]
    if prepared.whole is not None:
        offset = exact_offset(ssm, prepared.whole, steps, span, length)
        noise = draw(key, ssm.state_dim, count)
        return _columns(prepared.whole.phi, state) + _columns(prepared.root, noise) + offset[:, None]
    step = {"srk": srk, "milstein": milstein, "euler": euler}[scheme]
    sources, wide = _sources(ssm), prepared.root.shape[0]
    h = length / steps
    used = 2 * sources if scheme == "srk" else sources  # the others have no use for the average of the path
    rows = used + wide
    # Normal numbers come in pairs: an odd number of rows is drawn for two steps at once.
    together = 2 if rows % 2 and steps % 2 == 0 else 1

    def one_step(state: jax.Array, rest: Span, noise: jax.Array) -> jax.Array:
        # The forces' state at the end, and their average over the step, before the drift is asked for anything.
        kicked = _columns(prepared.root, noise[used:])
        one = lambda s, first, second, kick: step(ssm, prepared, h, rest, s, (first, second), kick)  # noqa: E731
        return jax.vmap(one, in_axes=-1, out_axes=-1)(state, noise[:sources], noise[used - sources:used], kicked)

    def body(state: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        first, step_key = inputs
        noise = draw(step_key, together * rows, count)
        for index in range(together):
            state = one_step(state, span.after((first + index) * h), noise[index * rows:(index + 1) * rows])
        return state, None

    firsts = jnp.arange(0, steps, together)
    return jax.lax.scan(body, state, (firsts, jax.random.split(key, len(firsts))))[0]


def srk(ssm: StateSpaceModel, prepared: Prepared, h: jax.Array, span: Span, s: jax.Array,
        noise: tuple[jax.Array, jax.Array], kick: jax.Array) -> jax.Array:
    r"""Rössler's SRA1, strong order 1.5 for additive noise.

        K_1 = f(x, u, t),    K_2 = f(x + 3/4 h K_1 + 3/2 G J/h, u + 3/2 (mean of u - u), t + 3/4 h),
        x + h (K_1 + 2 K_2) / 3 + G(t + h) (DeltaB - J/h) + G(t) J/h.

    A force enters like one more component of the state: its average over the step, which is known exactly, stands
    where the second stage has the drift and J of that component.
    """
    size = ssm.physical_dim
    x, z = s[:size], s[size:]
    later, w, second = force_inputs(ssm, prepared, h, span, x, z, kick)
    first = ssm.drift(w, span.time())
    middle = x + 0.75 * h * first
    end = jnp.zeros(size)
    if ssm.model.process_noise is not None:
        change = jnp.sqrt(h) * noise[0]
        mean = 0.5 * change + jnp.sqrt(h / 12.0) * noise[1]
        now, then = ssm.dispersion(w, span.time()), ssm.dispersion(w, span.time(h))
        assert now is not None and then is not None
        middle = middle + 1.5 * _times(now, mean)
        end = _times(then, change - mean) + _times(now, mean)
    inner = ssm.drift(jnp.concatenate([middle, second]), span.time(0.75 * h))
    return jnp.concatenate([x + h / 3.0 * (first + 2.0 * inner) + end, later])


def milstein(ssm: StateSpaceModel, prepared: Prepared, h: jax.Array, span: Span, s: jax.Array,
             noise: tuple[jax.Array, jax.Array], kick: jax.Array) -> jax.Array:
    """Add half of (dG/dx G) (DeltaB DeltaB' - h I) to Euler's step: strong order 1 for commutative noise.

    A dispersion that depends on a force adds no term where the force is smooth (Matern of order 1 and more).
    """
    size = ssm.physical_dim
    x, z = s[:size], s[size:]
    t = span.time()
    later, w, _ = force_inputs(ssm, prepared, h, span, x, z, kick)
    u = w[size:]

    def dispersion(x: jax.Array) -> jax.Array:
        found = ssm.dispersion(jnp.concatenate([x, u]), t)
        return jnp.zeros((size, 0)) if found is None else found

    now = dispersion(x)
    change = jnp.sqrt(h) * noise[0]
    shift = _times(now, change)
    _, along = jax.jvp(lambda x: _times(dispersion(x), change), (x,), (shift,))
    for source in range(_sources(ssm)):
        _, own = jax.jvp(lambda x, j=source: dispersion(x)[:, j], (x,), (now[:, source],))
        along = along - h * own
    return jnp.concatenate([x + h * ssm.drift(w, t) + shift + 0.5 * along, later])


def euler(ssm: StateSpaceModel, prepared: Prepared, h: jax.Array, span: Span, s: jax.Array,
          noise: tuple[jax.Array, jax.Array], kick: jax.Array) -> jax.Array:
    """Euler and Maruyama's step: strong order 1/2, and 1 for additive noise."""
    size = ssm.physical_dim
    x, z = s[:size], s[size:]
    t = span.time()
    later, w, _ = force_inputs(ssm, prepared, h, span, x, z, kick)
    moved = x + h * ssm.drift(w, t)
    dispersion = ssm.dispersion(w, t)
    if dispersion is not None:
        moved = moved + _times(dispersion, jnp.sqrt(h) * noise[0])
    return jnp.concatenate([moved, later])


def force_inputs(ssm: StateSpaceModel, prepared: Prepared, h: jax.Array, span: Span, x: jax.Array, z: jax.Array,
                 kick: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return z at the end, the inputs w = (x, u) at the start, and u of the second stage of `srk`."""
    if ssm.force_dim == 0:
        return z, x, jnp.zeros(0)
    size, t = ssm.force_dim, span.time()
    later = _times(prepared.transition, z) + kick[:size]
    u = _times(ssm.stack.measurement(t), z) + ssm.stack.mean_at(t)
    # At h = 0 the average is the value itself.
    inverse = jnp.where(h > 0, 1.0 / jnp.where(h > 0, h, 1.0), 0.0)
    mean = inverse * (_times(prepared.average, z) + kick[size:])
    node = span.time(0.75 * h)
    if ssm.constant_measurement:
        start = _times(ssm.stack.measurement(t), z)
        second = start + 1.5 * (mean - start)
    else:
        second = _times(ssm.stack.measurement(node), z + 1.5 * (mean - z))
    return later, jnp.concatenate([x, u]), second + ssm.stack.mean_at(node)


def _averaged_rows(ssm: StateSpaceModel) -> jax.Array:
    """The combinations (K, nz) of the forces' states whose averages are drawn: the forces, or all states."""
    return ssm.stack.measurement(0.0) if ssm.constant_measurement else jnp.eye(ssm.force_dim)


def _sources(ssm: StateSpaceModel) -> int:
    """Number of Brownian motions of the physical state."""
    if ssm.model.process_noise is None:
        return 0
    shape = jax.eval_shape(lambda w: ssm.dispersion(w, 0.0), jnp.zeros(ssm.input_dim)).shape
    return shape[1]


def _state_dependent(ssm: StateSpaceModel) -> bool:
    found = pattern(lambda v: jnp.ravel(ssm.dispersion(v[:-1], v[-1])), ssm.input_dim + 1)  # type: ignore[arg-type]
    return bool(np.asarray(found.jacobian)[:, :ssm.input_dim].any())


def _times(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    return matmul(matrix, vector[:, None])[:, 0]


def _columns(matrix: jax.Array, columns: jax.Array) -> jax.Array:
    """Return the product of a small matrix (k, n) with (n, N), as sums of rows, which fuse."""
    if matrix.shape[1] == 0:
        return jnp.zeros((matrix.shape[0], columns.shape[1]))
    if matrix.shape[1] > 8:
        return jnp.matmul(matrix, columns)
    return jnp.stack([sum(matrix[i, j] * columns[j] for j in range(matrix.shape[1]))
                      for i in range(matrix.shape[0])])
