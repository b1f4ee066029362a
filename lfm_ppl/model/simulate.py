"""Simulation of the exact, non-linear model.

1. Draw the joint state at the initial time, physical states and forces.
2. Between two rows, take ``steps`` steps; where known inputs jump or have a kink between rows, divide the interval at
   these breakpoints (`_time_nodes`).
3. Each step draws the forces at its end from their exact transition and process noise.
4. The physical state follows by the classical Runge-Kutta method, with the forces linear in time over the step.
5. Process noise enters with the dispersion at the start of the step (Ito), spread evenly over the step.
   A stiff model takes, where a step is longer than the fastest time constant, the exact solution of the SDE that is
   linearised at the start of the step (`exponential_change`).
6. At the end of a step that crosses a jump of a force, draw the jump. Events end intervals, like breakpoints.
7. Draw the observations at the rows from the noise or the observation family.
8. `SimulationProgram.resolved` bounds the steps: a pilot path, of a fixed key, finds the fastest rate. Where a step
   would be too long for it, further breakpoints divide the time between rows, whatever rows are requested.

Source: Kloeden and Platen (1992), Numerical Solution of Stochastic Differential Equations, section 9.1; Jimenez, Shoji
and Ozaki (1999), Journal of Statistical Physics 94, for the linearised SDE.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.model.events import NO_EVENT, StateMap, check_start, event_table
from lfm_ppl.model.inputs import breakpoints_within
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation_noise import noisy_observation
from lfm_ppl.model.state_space import Span, StateSpaceModel, check_times, state_space
from lfm_ppl.model.stiff_simulation import divide_steps, exponential_change, warn_of_infinite_states
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import fastest_rate, matmul
from lfm_ppl.utils.programs import Program
from lfm_ppl.utils.random_keys import split_by_name
from lfm_ppl.utils.semidefinite import semidefinite_root

LONGEST_PRODUCT = 1.0
"""Largest product of step and fastest rate of an explicit step.

It is stable up to 2.8, but may stop at fixed points that the model does not have.
"""

_LONGEST_WITH_NOISE = 0.25
"""The same with process noise, whose even spread over a step biases variances."""


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

    Outside of compiled code, where a step would be longer than the time constant of the fastest decay (a quarter of it
    with process noise), it is divided, so that paths between sparse times have the law of those at dense times. What is
    too stiff for that takes exponential steps.

    Args:
        key: a JAX random key.
        model: the latent force model.
        times: (T,), non-decreasing; equal times have the same state and independent observations.
        steps: integration steps between two consecutive times, at least.

    Returns:
        Times, state, forces and observations.

    Raises:
        ValueError: unsorted times, times before the initial time, non-positive steps.

    Warns:
        UserWarning: outside of compiled code, where a state is not finite.

    Example:
        >>> import jax, jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, sd=0.3), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        >>> lfm.simulate(jax.random.key(0), model, jnp.arange(4.0)).y.shape
        (4, 1)

    Source: Kloeden and Platen (1992), section 9.1.
    """
    checks.random_key(key)
    checks.positive_integer("steps", steps)
    ssm = state_space(model)
    concrete_times = check_times(times, model.initial_time)
    first = None
    if concrete_times is not None and not checks.traced(model.initial_time):
        first = float(concrete_times[0] if model.initial_time is None else model.initial_time)
        model.check_inputs(first, float(concrete_times[-1]))
        check_start(event_table(model.events).times, first)
    model.check_at(times[0] if model.initial_time is None else model.initial_time, np.shape(times)[0])
    times = jnp.asarray(times, float)
    start = times[0] if model.initial_time is None else jnp.asarray(model.initial_time, float)
    breakpoints = input_breakpoints(model, concrete_times, start if first is None else first)
    program = SimulationProgram(ssm, steps, breakpoints)
    if concrete_times is not None and first is not None:
        program = program.resolved(concrete_times, first)
    if checks.traced((model, times, key, breakpoints)):
        return program.run(key, times, start)[0]
    simulation, _ = program.compiled(key, times, start)
    warn_of_infinite_states(simulation.state, times, model.state_names)
    return simulation


@dataclass(frozen=True, eq=False)
class SimulationProgram:
    """A simulation as a function of the key, the times and the initial time.

    Attributes:
        ssm: the state-space model.
        steps: integration steps between two consecutive times.
        breakpoints: (K,), see `input_breakpoints` and `divide_steps`.
        is_stiff: whether steps that are longer than the fastest time constant are exponential.
    """

    ssm: StateSpaceModel
    steps: int
    breakpoints: Any = ()
    is_stiff: bool = False

    def run(self, key: jax.Array, times: jax.Array, start: jax.Array) -> tuple[Simulation, jax.Array]:
        """Return the simulation, and the fastest rate along its path."""
        return simulate_on(self.ssm, key, times, start, self.steps, self.breakpoints, self.is_stiff)

    @functools.cached_property
    def compiled(self) -> Callable[..., tuple[Simulation, jax.Array]]:
        """`run`, compiled."""
        return Program(self.run)

    def resolved(self, times: np.ndarray, start: float) -> SimulationProgram:
        """Return the program with breakpoints between which its steps resolve the fastest rate.

        The rate is that of a pilot path with a fixed key, so that the steps do not depend on the simulated path. The
        program is unchanged where the model holds traced values.
        """
        ssm, size = self.ssm, self.ssm.physical_dim
        if not size or checks.traced((ssm, self.breakpoints)) or _has_traced_functions(ssm):
            return self
        row_times = np.unique(np.append(times, start))
        limit = LONGEST_PRODUCT if ssm.model.process_noise is None else _LONGEST_WITH_NOISE
        if self._pilot_rate(times, start) * float(np.max(np.diff(row_times), initial=0.0)) / self.steps <= limit:
            return self
        # The explicit pilot path may have diverged; a stiff one does not.
        stiff = replace(self, is_stiff=True)
        longest = limit / max(stiff._pilot_rate(times, start), 1e-300)
        return replace(stiff, breakpoints=divide_steps(times, start, self.steps, self.breakpoints, longest))

    def _pilot_rate(self, times: np.ndarray, start: float) -> float:
        with jax.ensure_compile_time_eval():  # the key of the simulation may be traced
            rate = self.compiled(jax.random.key(0), jnp.asarray(times, float), jnp.asarray(start, float))[1]
            return float(jnp.where(jnp.isfinite(rate), rate, jnp.inf))


def _has_traced_functions(ssm: StateSpaceModel) -> bool:
    """Return whether the functions of a model close over traced values."""
    def functions(w: jax.Array, t: jax.Array, key: jax.Array) -> Any:
        return ssm.drift(w, t), ssm.dispersion(w, t), noisy_observation(ssm, w, t, key, 0)

    with jax.ensure_compile_time_eval():
        arguments = jnp.zeros(ssm.input_dim), jnp.zeros(()), jax.random.key(0)
    return checks.traced(jax.make_jaxpr(functions)(*arguments).consts)


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
                breakpoints: Any = (), is_stiff: bool = False) -> tuple[Simulation, jax.Array]:
    """Simulate a state-space model without checks, for compiled code; return the fastest rate along the path, too.

    Args:
        ssm: the state-space model.
        key: a JAX random key.
        times: (T,).
        start: initial time.
        steps: integration steps between two consecutive times.
        breakpoints: (K,), see `input_breakpoints` and `divide_steps`.
        is_stiff: whether steps that are longer than the fastest time constant are exponential.
    """
    initial_key, path_key, noise_key = jax.random.split(key, 3)
    states, rate = _simulate_states(ssm, initial_key, path_key, times, start, steps, breakpoints, is_stiff)
    inputs = jax.vmap(ssm.inputs)(states, times)
    y = jax.vmap(lambda w, t, k, index: noisy_observation(ssm, w, t, k, index))(
        inputs, times, jax.random.split(noise_key, times.shape[0]), jnp.arange(times.shape[0]))
    size = ssm.physical_dim
    forces = {name: inputs[:, size + index] for index, name in enumerate(ssm.model.force_names)}
    return Simulation(times, inputs[:, :size], forces, y), rate


class StepExtremes(NamedTuple):
    """The fastest rate along a path, and its largest product with a step; infinite where the path is not finite."""

    rate: jax.Array
    product: jax.Array


def _simulate_states(ssm: StateSpaceModel, initial_key: jax.Array, path_key: jax.Array, times: jax.Array,
                     start: jax.Array, steps: int, breakpoints: Any,
                     is_stiff: bool) -> tuple[jax.Array, jax.Array]:
    """Simulate the joint states (T, n), and return the fastest rate along the path; arguments as in `simulate_on`."""
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
