"""Paths of the joint state of a simulation.

1. The rows, and between them breakpoints of known inputs (where these jump or have a kink) and events, are nodes
   (`_time_nodes`), with the same number of steps from each to the next.
2. Integrate from node to node in a scan: from the initial time (`simulate_states`), or between given states
   (`simulate_missing_states`).
3. Each step draws the forces at its end from their exact transition and process noise.
4. The physical state follows by the classical Runge-Kutta method, with the forces linear in time over the step.
5. Process noise enters with the dispersion at the start of the step (Ito), spread evenly over the step.
   A stiff model takes, where a step is longer than the fastest time constant, the exact solution of the SDE that is
   linearised at the start of the step (`exponential_change`).
6. At the end of a step that crosses a jump of a force, draw the jump. Events apply their maps at their nodes.

Source: Kloeden and Platen (1992), Numerical Solution of Stochastic Differential Equations, section 9.1; Jimenez, Shoji
and Ozaki (1999), Journal of Statistical Physics 94, for the linearised SDE.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.model.events import NO_EVENT, StateMap, event_table
from lfm_ppl.model.state_space import Span, StateSpaceModel
from lfm_ppl.model.stiff_simulation import exponential_change
from lfm_ppl.utils.linalg import fastest_rate, matmul
from lfm_ppl.utils.random_keys import split_by_name
from lfm_ppl.utils.semidefinite import semidefinite_root

LONGEST_PRODUCT = 1.0
"""Largest product of step and fastest rate of an explicit step.

It is stable up to 2.8, but may stop at fixed points that the model does not have.
"""


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


class StepExtremes(NamedTuple):
    """The fastest rate along a path, and its largest product with a step; infinite where the path is not finite."""

    rate: jax.Array
    product: jax.Array


def simulate_states(ssm: StateSpaceModel, initial_key: jax.Array, path_key: jax.Array, times: jax.Array,
                     start: jax.Array, steps: int, breakpoints: Any,
                     is_stiff: bool) -> tuple[jax.Array, jax.Array]:
    """Simulate the joint states (T, n) from the initial time on; return the fastest rate along the path, too.

    Arguments as in `lfm_ppl.model.simulate.simulate_on`.
    """
    mean, covariance = ssm.initial()
    first = mean + matmul(semidefinite_root(covariance), jax.random.normal(initial_key, (ssm.state_dim, 1)))[:, 0]
    nodes = _time_nodes(ssm, start, times, breakpoints, steps)
    starts = jnp.concatenate([jnp.reshape(start, (1,)), nodes.times[:-1]])
    integrate = _interval_integrator(ssm, nodes.steps, is_stiff)

    def integrate_to_node(state: jax.Array, interval: tuple) -> tuple[jax.Array, tuple]:
        *arguments, state_map = interval
        state, extremes = integrate(state, *arguments)
        state = state if state_map is None else state_map.apply(state)
        return state, (state, extremes.rate)

    keys = jax.random.split(path_key, nodes.times.shape[0])
    _, (states, rates) = jax.lax.scan(integrate_to_node, first, (starts, nodes.times, keys, nodes.state_map))
    return states[nodes.rows], jnp.max(rates)


def simulate_missing_states(ssm: StateSpaceModel, key: jax.Array, states: jax.Array, times: jax.Array,
                            is_given: jax.Array, steps: int, breakpoints: Any = (),
                            is_stiff: bool = False) -> tuple[jax.Array, jax.Array]:
    """Simulate the joint state at times without a given state, from the last given state; for compiled code.

    Args:
        ssm: the state-space model.
        key: a JAX random key.
        states: (K, n), joint states; only the given ones are used.
        times: (K,), non-decreasing.
        is_given: (K,), whether the state at a time is given; the first state always is.
        steps: integration steps between two consecutive times.
        breakpoints: breakpoints of known inputs, see `input_breakpoints`.
        is_stiff: whether steps that are longer than the fastest time constant are exponential.

    Returns:
        (K, n), the given states; every other state is simulated from its predecessor. And the largest product of a
        simulated step and the fastest rate.
    """
    nodes = _time_nodes(ssm, times[0], times, breakpoints, steps, has_state=True)
    integrate = _interval_integrator(ssm, nodes.steps, is_stiff)
    if nodes.origin.shape[0] > times.shape[0]:
        is_row = nodes.origin < times.shape[0]
        index = jnp.minimum(nodes.origin, times.shape[0] - 1)
        states, is_given, times = states[index], is_given[index] & is_row, nodes.times

    def state_at_node(state: jax.Array, interval: tuple) -> tuple[jax.Array, tuple]:
        start, end, interval_key, given_state, has_state, state_map = interval
        none = StepExtremes(jnp.zeros_like(start), jnp.zeros_like(start))
        state, extremes = jax.lax.cond(has_state, lambda: (given_state, none),
                                       lambda: integrate(state, start, end, interval_key))
        state = state if state_map is None else state_map.apply(state)
        return state, (state, extremes.product)

    keys = jax.random.split(key, times.shape[0] - 1)
    later_maps = jax.tree.map(lambda a: a[1:], nodes.state_map)
    _, (later_states, products) = jax.lax.scan(state_at_node, states[0], (times[:-1], times[1:], keys, states[1:],
                                                                         is_given[1:], later_maps))
    return jnp.concatenate([states[:1], later_states])[nodes.rows], jnp.max(products, initial=0.0)


def _interval_integrator(ssm: StateSpaceModel, steps: int, is_stiff: bool) -> Callable[..., tuple]:
    """Return the function from a joint state, the start and end of an interval and a key to the state at the end."""
    jumps = ssm.stack.jump_roots()

    def integrate(state: jax.Array, start: jax.Array, end: jax.Array,
                  interval_key: jax.Array) -> tuple[jax.Array, StepExtremes]:
        h = (end - start) / steps
        transition, covariance = ssm.stack.discretise(h)
        root = semidefinite_root(covariance)
        span = Span.between(start, end, end - start)

        def step(state: jax.Array, index: jax.Array) -> tuple[jax.Array, jax.Array]:
            keys = split_by_name(jax.random.fold_in(interval_key, index), ("forces", "process noise", "jumps"))
            state, rate = _simulation_step(ssm, state, span.shifted(index * h), h, transition, root, keys, is_stiff)
            # The last step must end exactly at the end of the interval, so that a jump there is crossed once.
            step_end = jnp.where(index == steps - 1, end, start + (index + 1) * h)
            return _cross_jumps(ssm, jumps, state, start + index * h, step_end, keys["jumps"]), rate

        state, rates = jax.lax.scan(step, state, jnp.arange(steps))
        is_finite = jnp.isfinite(state).all() & jnp.isfinite(rates).all()
        # Between equal times there is no step.
        rate = jnp.where(h > 0, jnp.where(is_finite, jnp.max(rates), jnp.inf), 0.0)
        return state, StepExtremes(rate, jnp.where(h > 0, rate * jnp.where(h > 0, h, 1.0), 0.0))

    return integrate


def _simulation_step(ssm: StateSpaceModel, state: jax.Array, span: Span, h: jax.Array, transition: jax.Array,
                     root: jax.Array, keys: Mapping[str, jax.Array], is_stiff: bool) -> tuple[jax.Array, jax.Array]:
    """Return the joint state (n,) after one integration step of length h, and the fastest rate at its start.

    Args:
        ssm: the state-space model.
        state: (n,), at the start.
        span: times from the start of the step on.
        h: length of the step.
        transition: of the forces over the step.
        root: square root of their process noise.
        keys: random keys of "forces" and "process noise".
        is_stiff: whether a step that is longer than the fastest time constant is exponential.
    """
    size = ssm.physical_dim
    white_noise = jax.random.normal(keys["forces"], (ssm.force_dim, 1))
    forces = (matmul(transition, state[size:, None]) + matmul(root, white_noise))[:, 0]

    x, t = state[:size], span.time()
    inputs = ssm.inputs(state, t)
    stage1 = ssm.drift(inputs, t)
    dispersion = ssm.dispersion(inputs, t)
    jacobian = jax.jacfwd(lambda x: ssm.drift(jnp.concatenate([x, inputs[size:]]), t))(x)
    rate = fastest_rate(jacobian)

    def explicit() -> jax.Array:
        return _runge_kutta_change(ssm, state, forces, span, h, stage1, dispersion, keys["process noise"])

    def exponential() -> jax.Array:
        end = span.time(h)
        at_end = ssm.drift(ssm.inputs(jnp.concatenate([x, forces]), end), end)
        return exponential_change(h, jacobian, stage1, at_end, dispersion, keys["process noise"])

    change = jax.lax.cond(rate * h <= LONGEST_PRODUCT, explicit, exponential) if is_stiff else explicit()
    return jnp.concatenate([x + change, forces]), rate


def _runge_kutta_change(ssm: StateSpaceModel, state: jax.Array, forces: jax.Array, span: Span, h: jax.Array,
                        stage1: jax.Array, dispersion: jax.Array | None, key: jax.Array) -> jax.Array:
    """Return the change of the physical state in an explicit step, with ``forces`` at its end."""
    size = ssm.physical_dim
    x, end = state[:size], span.time(h)
    noise = jnp.zeros(size)
    if dispersion is not None:
        noise = jnp.sqrt(h) * matmul(dispersion, jax.random.normal(key, (dispersion.shape[1], 1)))[:, 0]
    midpoint_forces = 0.5 * (state[size:] + forces)

    def drift(change: jax.Array, z: jax.Array, time: jax.Array) -> jax.Array:
        return ssm.drift(ssm.inputs(jnp.concatenate([x + change, z]), time), time)

    stage2 = drift(0.5 * (h * stage1 + noise), midpoint_forces, span.time(0.5 * h))
    stage3 = drift(0.5 * (h * stage2 + noise), midpoint_forces, span.time(0.5 * h))
    stage4 = drift(h * stage3 + noise, forces, end)
    return h / 6 * (stage1 + 2 * stage2 + 2 * stage3 + stage4) + noise


def _cross_jumps(ssm: StateSpaceModel, jumps: Any, state: jax.Array, start: jax.Array, end: jax.Array,
                 key: jax.Array) -> jax.Array:
    """Apply the jumps of the forces in (start, end] to the state at the end of the step."""
    if jumps is None:
        return state
    size = ssm.physical_dim
    times = jnp.asarray(ssm.stack.jump_times, float)
    crossed = (times > start) & (times <= end)

    def apply_jump(forces: jax.Array, jump: tuple) -> tuple[jax.Array, None]:
        is_crossed, jump_key, transition, root = jump
        white_noise = jax.random.normal(jump_key, (ssm.force_dim, 1))
        jumped = (matmul(transition, forces[:, None]) + matmul(root, white_noise))[:, 0]
        return jnp.where(is_crossed, jumped, forces), None

    def apply_jumps(forces: jax.Array) -> jax.Array:
        keys = jax.random.split(key, len(times))
        return jax.lax.scan(apply_jump, forces, (crossed, keys, *(a[:-1] for a in jumps)))[0]

    forces = jax.lax.cond(crossed.any(), apply_jumps, lambda forces: forces, state[size:])
    return jnp.concatenate([state[:size], forces])
