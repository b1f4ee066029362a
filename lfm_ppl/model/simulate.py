"""Simulation of the real, non-linear model."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.linalg import matmul, semidefinite_root
from lfm_ppl.model.inputs import breakpoints_within
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation_noise import noisy_observation
from lfm_ppl.model.state_space import Span, StateSpaceModel, check_times, state_space


class Simulation(NamedTuple):
    """A simulated data set.

    Attributes:
        times: (T,).
        state: (T, M), the physical state.
        forces: name -> (T,).
        y: (T, D).
    """

    times: jax.Array
    state: jax.Array
    forces: dict[str, jax.Array]
    y: jax.Array


def simulate(key: jax.Array, model: LatentForceModel, times: Any, steps: int = 50) -> Simulation:
    """Simulate a latent force model.

    The forces are exact at every integration step, and linear between two of them. The state follows by the classical
    Runge-Kutta method along this path. Process noise enters each step with the dispersion at its start, as Ito's
    integral has it, spread evenly over the step: the scheme is then of strong order 1 for additive noise, 1/2
    otherwise.

    Args:
        key: a JAX random key.
        model: the latent force model.
        times: (T,), non-decreasing; equal times get the same state and independent observations.
        steps: integration steps between two consecutive times.

    Returns:
        Times, state, forces and observations.

    Raises:
        ValueError: unsorted times, times before the initial time, non-positive steps.

    Example:
        >>> import jax, jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        >>> lfm.simulate(jax.random.key(0), model, jnp.arange(4.0)).y.shape
        (4, 1)

    Source: Kloeden and Platen (1992), section 9.1.
    """
    checks.random_key(key)
    checks.positive_integer("steps", steps)
    ssm = state_space(model)
    known = check_times(times, model.initial_time)
    if known is not None and not checks.traced(model.initial_time):
        model.check_inputs(float(known[0] if model.initial_time is None else model.initial_time), float(known[-1]))
    model.check_at(times[0] if model.initial_time is None else model.initial_time, np.shape(times)[0])
    times = jnp.asarray(times, float)
    start = times[0] if model.initial_time is None else jnp.asarray(model.initial_time, float)
    breakpoints = input_breakpoints(model, known, start)
    run = lambda key, times, start: simulate_on(ssm, key, times, start, steps, breakpoints)  # noqa: E731
    traced = checks.traced((model, times, key, breakpoints))
    return (run if traced else jax.jit(run))(key, times, start)


def input_breakpoints(model: LatentForceModel, times: Any, start: Any) -> Any:
    """Return the times (K,) at which known inputs of a model jump or have a kink.

    Args:
        model: the latent force model.
        times: (T,), in order; where they and the start are known, breakpoints outside of them are left out.
        start: initial time.
    """
    if times is None or checks.traced((times, start)):
        reads = model.input_reads(0.0, 1.0)
        return jnp.concatenate([jnp.zeros(0), *(jnp.asarray(read.breakpoints(), float) for read in reads)])
    first, last = float(np.min(start)), float(times[-1])
    known, moving = breakpoints_within(model.input_reads(first, last), first, last)
    return jnp.concatenate([known, moving]) if len(moving) else known


class _Nodes(NamedTuple):
    """Times of a simulation, those of the rows among them.

    Attributes:
        times: (N,), in order.
        rows: (T,) indices of the rows.
        origin: (N,) index of each among rows, pieces and breakpoints one after another; a row if below T.
        steps: integration steps up to each time.
    """

    times: jax.Array
    rows: Any
    origin: Any
    steps: int


def _nodes(start: jax.Array, times: jax.Array, breakpoints: Any, steps: int) -> _Nodes:
    """Return the rows, and the breakpoints of known inputs between them."""
    count, extra = times.shape[0], np.shape(breakpoints)[0]
    if not extra:
        return _Nodes(times, np.arange(count), np.arange(count), steps)
    # Rows in a few pieces of fewer steps each make it cheap to divide them at many breakpoints.
    cost = [(count * -(-steps // part) + extra) * (part + 1) for part in range(1, steps + 1)]
    part = int(np.argmin(cost)) + 1
    pieces = -(-steps // part)
    begin = jnp.concatenate([jnp.reshape(start, (1,)), times[:-1]])
    share = np.arange(1, pieces) / pieces
    between = (begin[:, None] + (times - begin)[:, None] * share).ravel()
    every = jnp.concatenate([times, between, jnp.clip(jnp.asarray(breakpoints), start, times[-1])])
    order = jnp.argsort(jax.lax.stop_gradient(every), stable=True)
    return _Nodes(every[order], jnp.argsort(order)[:count], order, part)


def simulate_on(ssm: StateSpaceModel, key: jax.Array, times: jax.Array, start: jax.Array, steps: int,
                breakpoints: Any = ()) -> Simulation:
    """The same for a state-space model, without checks; for compiled code.

    ``breakpoints`` (K,) are those of `input_breakpoints`.
    """
    initial, path, noise = jax.random.split(key, 3)
    mean, covariance = ssm.initial()
    first = mean + matmul(semidefinite_root(covariance), jax.random.normal(initial, (ssm.state_dim, 1)))[:, 0]
    nodes = _nodes(start, times, breakpoints, steps)
    starts = jnp.concatenate([jnp.reshape(start, (1,)), nodes.times[:-1]])
    advance = _interval(ssm, nodes.steps)

    def row(state: jax.Array, inputs: tuple) -> tuple[jax.Array, jax.Array]:
        state = advance(state, *inputs)
        return state, state

    _, states = jax.lax.scan(row, first, (starts, nodes.times, jax.random.split(path, nodes.times.shape[0])))
    states = states[nodes.rows]
    inputs = jax.vmap(ssm.inputs)(states, times)
    y = jax.vmap(lambda w, t, k, index: noisy_observation(ssm, w, t, k, index))(
        inputs, times, jax.random.split(noise, times.shape[0]), jnp.arange(times.shape[0]))
    size = ssm.physical_dim
    forces = {name: inputs[:, size + index] for index, name in enumerate(ssm.model.force_names)}
    return Simulation(times, inputs[:, :size], forces, y)


def simulate_onwards(ssm: StateSpaceModel, key: jax.Array, states: jax.Array, times: jax.Array, known: jax.Array,
                     steps: int, breakpoints: Any = ()) -> jax.Array:
    """Simulate the joint state on from where it is known; for compiled code.

    Args:
        ssm: the state-space model.
        key: a JAX random key.
        states: (K, n) joint states, of which those that are known are used.
        times: (K,), non-decreasing.
        known: (K,) Booleans; the first state counts as known.
        steps: integration steps between two consecutive times.
        breakpoints: of known inputs, see `input_breakpoints`.

    Returns:
        (K, n): the known states, and each of the others simulated from the one before it.
    """
    nodes = _nodes(times[0], times, breakpoints, steps)
    advance = _interval(ssm, nodes.steps)
    if np.shape(breakpoints)[0]:
        is_row = nodes.origin < times.shape[0]
        index = jnp.minimum(nodes.origin, times.shape[0] - 1)
        states, known, times = states[index], known[index] & is_row, nodes.times

    def row(state: jax.Array, inputs: tuple) -> tuple[jax.Array, jax.Array]:
        begin, end, row_key, given, is_known = inputs
        state = jax.lax.cond(is_known, lambda: given, lambda: advance(state, begin, end, row_key))
        return state, state

    keys = jax.random.split(key, times.shape[0] - 1)
    _, rest = jax.lax.scan(row, states[0], (times[:-1], times[1:], keys, states[1:], known[1:]))
    return jnp.concatenate([states[:1], rest])[nodes.rows]


def _interval(ssm: StateSpaceModel, steps: int) -> Callable[..., jax.Array]:
    """Return the map of a joint state, the interval's begin and end, and a key, to the state at the end."""
    jumps = ssm.stack.jump_roots()

    def advance(state: jax.Array, begin: jax.Array, end: jax.Array, row_key: jax.Array) -> jax.Array:
        h = (end - begin) / steps
        transition, covariance = ssm.stack.discretise(h)
        root = semidefinite_root(covariance)
        span = Span.between(begin, end, end - begin)

        def step(state: jax.Array, index: jax.Array) -> tuple[jax.Array, None]:
            keys = jax.random.fold_in(row_key, index)
            rest = span.after(index * h)
            state = _simulation_step(ssm, state, rest, h, transition, root, keys)
            # The last step ends at the row's end to the last bit: a jump there is crossed, and once only.
            until = jnp.where(index == steps - 1, end, begin + (index + 1) * h)
            return _cross_jumps(ssm, jumps, state, begin + index * h, until, keys), None

        return jax.lax.scan(step, state, jnp.arange(steps))[0]

    return advance


def _simulation_step(ssm: StateSpaceModel, state: jax.Array, span: Span, h: jax.Array, transition: jax.Array,
                     root: jax.Array, key: jax.Array) -> jax.Array:
    size = ssm.physical_dim
    force_key, state_key = jax.random.split(key)
    draw = jax.random.normal(force_key, (ssm.force_dim, 1))
    forces = (matmul(transition, state[size:, None]) + matmul(root, draw))[:, 0]

    x, t = state[:size], span.time()
    now = ssm.inputs(state, t)
    first = ssm.drift(now, t)
    dispersion = ssm.dispersion(now, t)
    kick = jnp.zeros(size)
    if dispersion is not None:
        kick = jnp.sqrt(h) * matmul(dispersion, jax.random.normal(state_key, (dispersion.shape[1], 1)))[:, 0]
    end = span.time(h)
    halfway = 0.5 * (state[size:] + forces)

    def drift(change: jax.Array, z: jax.Array, time: jax.Array) -> jax.Array:
        return ssm.drift(ssm.inputs(jnp.concatenate([x + change, z]), time), time)

    second = drift(0.5 * (h * first + kick), halfway, span.time(0.5 * h))
    third = drift(0.5 * (h * second + kick), halfway, span.time(0.5 * h))
    last = drift(h * third + kick, forces, end)
    return jnp.concatenate([x + h / 6 * (first + 2 * second + 2 * third + last) + kick, forces])


def _cross_jumps(ssm: StateSpaceModel, jumps: Any, state: jax.Array, begin: jax.Array, end: jax.Array,
                 key: jax.Array) -> jax.Array:
    """Apply the forces' jumps that fall into (begin, end], at the step's end."""
    if jumps is None:
        return state
    size = ssm.physical_dim
    times = jnp.asarray(ssm.stack.jump_times, float)
    crossed = (times > begin) & (times <= end)

    def one(forces: jax.Array, jump: tuple) -> tuple[jax.Array, None]:
        here, index, transition, root = jump
        draw = jax.random.normal(jax.random.fold_in(key, index + 1), (ssm.force_dim, 1))
        jumped = (matmul(transition, forces[:, None]) + matmul(root, draw))[:, 0]
        return jnp.where(here, jumped, forces), None

    def all_crossed(forces: jax.Array) -> jax.Array:
        return jax.lax.scan(one, forces, (crossed, jnp.arange(len(times)), *(a[:-1] for a in jumps)))[0]

    forces = jax.lax.cond(crossed.any(), all_crossed, lambda forces: forces, state[size:])
    return jnp.concatenate([state[:size], forces])
