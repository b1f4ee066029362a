"""Simulation of the exact, non-linear model.

1. Draw the joint state at the initial time and a path from it through the rows (`lfm_ppl.model.simulated_path`).
2. Draw the observations at the rows from the noise or the observation family.
3. `SimulationProgram.resolved` bounds the steps: a pilot path, of a fixed key, finds the fastest rate. Where a step
   would be too long for it, further breakpoints divide the time between rows, whatever rows are requested.

Source: Kloeden and Platen (1992), Numerical Solution of Stochastic Differential Equations, section 9.1.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.model.events import check_start, event_table
from lfm_ppl.model.inputs import breakpoints_within
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation_noise import noisy_observation
from lfm_ppl.model.simulated_path import LONGEST_PRODUCT, simulate_states
from lfm_ppl.model.state_space import StateSpaceModel, check_times, state_space
from lfm_ppl.model.stiff_simulation import divide_steps, warn_of_infinite_states
from lfm_ppl.utils import checks
from lfm_ppl.utils.programs import Program

_LONGEST_WITH_NOISE = 0.25
"""`LONGEST_PRODUCT` with process noise, whose even spread over a step biases variances."""


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
    states, rate = simulate_states(ssm, initial_key, path_key, times, start, steps, breakpoints, is_stiff)
    inputs = jax.vmap(ssm.inputs)(states, times)
    y = jax.vmap(lambda w, t, k, index: noisy_observation(ssm, w, t, k, index))(
        inputs, times, jax.random.split(noise_key, times.shape[0]), jnp.arange(times.shape[0]))
    size = ssm.physical_dim
    forces = {name: inputs[:, size + index] for index, name in enumerate(ssm.model.force_names)}
    return Simulation(times, inputs[:, :size], forces, y), rate


