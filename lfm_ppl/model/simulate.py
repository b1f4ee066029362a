"""Simulation of the exact, non-linear model.

1. Draw the joint state at the initial time, physical states and forces.
2. Between two rows, take ``steps`` steps; where known inputs jump or have a kink between rows, divide the interval at
   these breakpoints (`_time_nodes`).
3. Each step draws the forces at its end from their exact transition and process noise.
4. The physical state follows by the classical Runge-Kutta method, with the forces linear in time over the step.
5. Process noise enters with the dispersion at the start of the step (Ito), spread evenly over the step.
6. At the end of a step that crosses a jump of a force, draw the jump. Events end intervals, like breakpoints.
7. Draw the observations at the rows from the noise or the observation family.

Source: Kloeden and Platen (1992), Numerical Solution of Stochastic Differential Equations, section 9.1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.model.events import NO_EVENT, StateMap, check_start, event_table
from lfm_ppl.model.inputs import breakpoints_within
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation_noise import noisy_observation
from lfm_ppl.model.state_space import Span, StateSpaceModel, check_times, state_space
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import matmul, semidefinite_root


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

    The forces are exact at the ends of integration steps and linear in between. The state follows by the classical
    Runge-Kutta method along this path. Process noise enters each step with the dispersion at the start of the step
    (Ito), spread evenly over the step: the strong order is 1 for additive noise and 1/2 otherwise.

    Args:
        key: a JAX random key.
        model: the latent force model.
        times: (T,), non-decreasing; equal times have the same state and independent observations.
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
    concrete_times = check_times(times, model.initial_time)
    if concrete_times is not None and not checks.traced(model.initial_time):
        first = concrete_times[0] if model.initial_time is None else model.initial_time
        model.check_inputs(float(first), float(concrete_times[-1]))
        check_start(event_table(model.events).times, float(first))
    model.check_at(times[0] if model.initial_time is None else model.initial_time, np.shape(times)[0])
    times = jnp.asarray(times, float)
    start = times[0] if model.initial_time is None else jnp.asarray(model.initial_time, float)
    breakpoints = input_breakpoints(model, concrete_times, start)

    def run(key: jax.Array, times: jax.Array, start: jax.Array) -> Simulation:
        return simulate_on(ssm, key, times, start, steps, breakpoints)

    is_traced = checks.traced((model, times, key, breakpoints))
    return (run if is_traced else jax.jit(run))(key, times, start)


def input_breakpoints(model: LatentForceModel, times: Any, start: Any) -> Any:
    """Return the times (K,) at which known inputs of a model jump or have a kink.

    Args:
        model: the latent force model.
        times: (T,), in order, or None. If times and start are concrete, breakpoints outside of them are omitted.
        start: initial time.
    """
    if times is None or checks.traced((times, start)):
        reads = model.input_reads(0.0, 1.0)
        return jnp.concatenate([jnp.zeros(0), *(jnp.asarray(read.breakpoints(), float) for read in reads)])
    first, last = float(np.min(start)), float(times[-1])
    fixed, traced = breakpoints_within(model.input_reads(first, last), first, last)
    return jnp.concatenate([fixed, traced]) if len(traced) else fixed


@dataclass(frozen=True)
class TimeNodes:
    """Times at which the integration of a simulation is divided, including the rows.

    Attributes:
        times: (N,), in order.
        rows: (T,), indices of the rows among the nodes.
        origin: (N,), index of each node in the concatenation of rows, subdivisions and breakpoints; a row if below T.
        steps: integration steps between neighbouring nodes.
        state_map: maps (N, n) of the events at the nodes; None without events.
    """

    times: jax.Array
    rows: Any
    origin: Any
    steps: int
    state_map: StateMap | None = None


def _time_nodes(ssm: StateSpaceModel, start: jax.Array, times: jax.Array, breakpoints: Any, steps: int,
                has_state: bool = False) -> TimeNodes:
    """Return the rows, the breakpoints of known inputs and the events as nodes.

    ``has_state``: whether the state at the start is given, so that events before an observation there have happened.
    """
    events = event_table(ssm.model.events)._replace(start=start if has_state else None)
    event_times, entries = events.entries_within(start, times[-1])
    breakpoints = jnp.concatenate([jnp.asarray(breakpoints, float), event_times])
    count, breakpoint_count = times.shape[0], breakpoints.shape[0]
    if not breakpoint_count:
        return TimeNodes(times, np.arange(count), np.arange(count), steps)
    # Every interval between nodes takes the same number of steps, also one that a breakpoint has divided. Subdividing
    # the intervals between rows into several pieces of fewer steps makes many breakpoints cheaper.
    cost = [(count * -(-steps // part) + breakpoint_count) * (part + 1) for part in range(1, steps + 1)]
    steps_per_piece = int(np.argmin(cost)) + 1
    pieces = -(-steps // steps_per_piece)
    interval_starts = jnp.concatenate([jnp.reshape(start, (1,)), times[:-1]])
    fractions = np.arange(1, pieces) / pieces
    subdivisions = (interval_starts[:, None] + (times - interval_starts)[:, None] * fractions).ravel()
    nodes = jnp.concatenate([times, subdivisions, jnp.clip(breakpoints, start, times[-1])])
    other_count = nodes.shape[0] - event_times.shape[0]
    is_first = np.logical_not(events.observation_first) & (entries >= 0)
    rank = jnp.append(np.zeros(other_count, int), jnp.where(is_first, -1, 1))
    order = jnp.lexsort((rank, jax.lax.stop_gradient(nodes)))
    maps = ssm.state_maps()
    if maps is not None:
        index = jnp.append(np.full(other_count, NO_EVENT), entries)[order]
        maps = jax.tree.map(lambda a: a[index], maps)
    return TimeNodes(nodes[order], jnp.argsort(order)[:count], order, steps_per_piece, maps)


def simulate_on(ssm: StateSpaceModel, key: jax.Array, times: jax.Array, start: jax.Array, steps: int,
                breakpoints: Any = ()) -> Simulation:
    """Simulate a state-space model without checks, for compiled code; arguments as in `simulate`.

    ``breakpoints`` (K,) is the result of `input_breakpoints`.
    """
    initial_key, path_key, noise_key = jax.random.split(key, 3)
    mean, covariance = ssm.initial()
    first = mean + matmul(semidefinite_root(covariance), jax.random.normal(initial_key, (ssm.state_dim, 1)))[:, 0]
    nodes = _time_nodes(ssm, start, times, breakpoints, steps)
    starts = jnp.concatenate([jnp.reshape(start, (1,)), nodes.times[:-1]])
    integrate = _interval_integrator(ssm, nodes.steps)

    def integrate_to_node(state: jax.Array, interval: tuple) -> tuple[jax.Array, jax.Array]:
        *arguments, state_map = interval
        state = integrate(state, *arguments)
        state = state if state_map is None else state_map.apply(state)
        return state, state

    keys = jax.random.split(path_key, nodes.times.shape[0])
    _, states = jax.lax.scan(integrate_to_node, first, (starts, nodes.times, keys, nodes.state_map))
    states = states[nodes.rows]
    inputs = jax.vmap(ssm.inputs)(states, times)
    y = jax.vmap(lambda w, t, k, index: noisy_observation(ssm, w, t, k, index))(
        inputs, times, jax.random.split(noise_key, times.shape[0]), jnp.arange(times.shape[0]))
    size = ssm.physical_dim
    forces = {name: inputs[:, size + index] for index, name in enumerate(ssm.model.force_names)}
    return Simulation(times, inputs[:, :size], forces, y)


def simulate_missing_states(ssm: StateSpaceModel, key: jax.Array, states: jax.Array, times: jax.Array,
                            is_given: jax.Array, steps: int, breakpoints: Any = ()) -> jax.Array:
    """Simulate the joint state at times without a given state, from the last given state; for compiled code.

    Args:
        ssm: the state-space model.
        key: a JAX random key.
        states: (K, n), joint states; only the given ones are used.
        times: (K,), non-decreasing.
        is_given: (K,), whether the state at a time is given; the first state always is.
        steps: integration steps between two consecutive times.
        breakpoints: breakpoints of known inputs, see `input_breakpoints`.

    Returns:
        (K, n), the given states; every other state is simulated from its predecessor.
    """
    nodes = _time_nodes(ssm, times[0], times, breakpoints, steps, has_state=True)
    integrate = _interval_integrator(ssm, nodes.steps)
    if nodes.origin.shape[0] > times.shape[0]:
        is_row = nodes.origin < times.shape[0]
        index = jnp.minimum(nodes.origin, times.shape[0] - 1)
        states, is_given, times = states[index], is_given[index] & is_row, nodes.times

    def state_at_node(state: jax.Array, interval: tuple) -> tuple[jax.Array, jax.Array]:
        start, end, interval_key, given_state, has_state, state_map = interval
        state = jax.lax.cond(has_state, lambda: given_state, lambda: integrate(state, start, end, interval_key))
        state = state if state_map is None else state_map.apply(state)
        return state, state

    keys = jax.random.split(key, times.shape[0] - 1)
    later_maps = jax.tree.map(lambda a: a[1:], nodes.state_map)
    _, later_states = jax.lax.scan(state_at_node, states[0],
                                   (times[:-1], times[1:], keys, states[1:], is_given[1:], later_maps))
    return jnp.concatenate([states[:1], later_states])[nodes.rows]


def _interval_integrator(ssm: StateSpaceModel, steps: int) -> Callable[..., jax.Array]:
    """Return the function from a joint state, the start and end of an interval and a key to the state at the end."""
    jumps = ssm.stack.jump_roots()

    def integrate(state: jax.Array, start: jax.Array, end: jax.Array, interval_key: jax.Array) -> jax.Array:
        h = (end - start) / steps
        transition, covariance = ssm.stack.discretise(h)
        root = semidefinite_root(covariance)
        span = Span.between(start, end, end - start)

        def step(state: jax.Array, index: jax.Array) -> tuple[jax.Array, None]:
            step_key = jax.random.fold_in(interval_key, index)
            state = _simulation_step(ssm, state, span.shifted(index * h), h, transition, root, step_key)
            # The last step must end exactly at the end of the interval, so that a jump there is crossed once.
            step_end = jnp.where(index == steps - 1, end, start + (index + 1) * h)
            return _cross_jumps(ssm, jumps, state, start + index * h, step_end, step_key), None

        return jax.lax.scan(step, state, jnp.arange(steps))[0]

    return integrate


def _simulation_step(ssm: StateSpaceModel, state: jax.Array, span: Span, h: jax.Array, transition: jax.Array,
                     root: jax.Array, key: jax.Array) -> jax.Array:
    """Return the joint state (n,) after one integration step of length h from the start of ``span``.

    ``transition`` is that of the forces over the step, ``root`` a square root of their process noise.
    """
    size = ssm.physical_dim
    force_key, state_key = jax.random.split(key)
    white_noise = jax.random.normal(force_key, (ssm.force_dim, 1))
    forces = (matmul(transition, state[size:, None]) + matmul(root, white_noise))[:, 0]

    x, t = state[:size], span.time()
    inputs = ssm.inputs(state, t)
    stage1 = ssm.drift(inputs, t)
    dispersion = ssm.dispersion(inputs, t)
    noise = jnp.zeros(size)
    if dispersion is not None:
        noise = jnp.sqrt(h) * matmul(dispersion, jax.random.normal(state_key, (dispersion.shape[1], 1)))[:, 0]
    end = span.time(h)
    midpoint_forces = 0.5 * (state[size:] + forces)

    def drift(change: jax.Array, z: jax.Array, time: jax.Array) -> jax.Array:
        return ssm.drift(ssm.inputs(jnp.concatenate([x + change, z]), time), time)

    stage2 = drift(0.5 * (h * stage1 + noise), midpoint_forces, span.time(0.5 * h))
    stage3 = drift(0.5 * (h * stage2 + noise), midpoint_forces, span.time(0.5 * h))
    stage4 = drift(h * stage3 + noise, forces, end)
    return jnp.concatenate([x + h / 6 * (stage1 + 2 * stage2 + 2 * stage3 + stage4) + noise, forces])


def _cross_jumps(ssm: StateSpaceModel, jumps: Any, state: jax.Array, start: jax.Array, end: jax.Array,
                 key: jax.Array) -> jax.Array:
    """Apply the jumps of the forces in (start, end] to the state at the end of the step."""
    if jumps is None:
        return state
    size = ssm.physical_dim
    times = jnp.asarray(ssm.stack.jump_times, float)
    crossed = (times > start) & (times <= end)

    def apply_jump(forces: jax.Array, jump: tuple) -> tuple[jax.Array, None]:
        is_crossed, index, transition, root = jump
        white_noise = jax.random.normal(jax.random.fold_in(key, index + 1), (ssm.force_dim, 1))
        jumped = (matmul(transition, forces[:, None]) + matmul(root, white_noise))[:, 0]
        return jnp.where(is_crossed, jumped, forces), None

    def apply_jumps(forces: jax.Array) -> jax.Array:
        return jax.lax.scan(apply_jump, forces, (crossed, jnp.arange(len(times)), *(a[:-1] for a in jumps)))[0]

    forces = jax.lax.cond(crossed.any(), apply_jumps, lambda forces: forces, state[size:])
    return jnp.concatenate([state[:size], forces])
