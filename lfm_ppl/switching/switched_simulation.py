"""Simulation of models with a discrete input under a known controller."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike

from lfm_ppl.filtering.filter import FilterState
from lfm_ppl.filtering.intervals import Intervals, as_arrays
from lfm_ppl.model.observation_noise import noisy_observation
from lfm_ppl.particles.normals import normals
from lfm_ppl.particles.stochastic_steps import ParticleTransition, choose_scheme, initial_particles
from lfm_ppl.switching.controller import Controller
from lfm_ppl.switching.switched_model import (
    Build,
    SwitchedProblem,
    build_models,
    decision_grid,
    initial_indices,
    initial_moments,
)
from lfm_ppl.utils import checks
from lfm_ppl.utils.programs import shared_jit
from lfm_ppl.utils.semidefinite import semidefinite_root


class SwitchedSimulation(eqx.Module):
    """Paths of a model with a discrete input.

    Attributes:
        times: (T,), times of the observations.
        state: (T, N, M), the physical state.
        forces: name -> (T, N).
        inputs: (T, N), values of the discrete input after each time.
        y: (T, N, D), observations with their noise, each before the decision at the same time.
    """

    times: jax.Array
    state: jax.Array
    forces: dict[str, jax.Array]
    inputs: jax.Array
    y: jax.Array


def simulate_switched(key: jax.Array, build: Build, controller: Controller, times: ArrayLike, *, paths: int = 1,
                      start: FilterState | None = None, initial: Any = 0, decisions: Any = None, steps: int = 10,
                      max_step: float | None = None, scheme: str = "auto") -> SwitchedSimulation:
    """Draw paths of a latent force model with a discrete input under a known controller.

    The model may be non-linear. For linear models, the averages of `lfm_ppl.rao_blackwellised` have less variance than
    averages over paths. Outside of ``jax.jit`` each call compiles, because ``build`` returns new functions: put
    repeated calls under ``jax.jit``.

    Args:
        key: a JAX random key.
        build: function from a value of the input to the `LatentForceModel` that holds while the input has this value.
        controller: controller of the input, such as `lfm.Thermostat`.
        times: (T,), non-decreasing.
        paths: number of paths N.
        start: the ``state`` of a filter's result, from which to continue; None: the model's initial state.
        initial: index in ``controller.values`` of the input at the start, or (N,), one for each path.
        decisions: times of its decisions; None: ``times``.
        steps: integration steps between two consecutive times.
        max_step: longest step; a longer interval gets more steps.
        scheme: integration scheme, as in `lfm_ppl.particle_filter`.

    Returns:
        States, forces, inputs and observations at ``times``.

    Raises:
        ValueError, TypeError: as `lfm_ppl.rao_blackwellised`; non-linear models are allowed.

    Example:
        >>> import jax, jax.numpy as jnp, lfm_ppl as lfm
        >>> def house(heater):
        ...     return lfm.LatentForceModel(
        ...         lambda x, u, t: 0.1 * (5.0 - x) + 2.0 * heater + u, {"rest": lfm.Matern(0.3, 2.0)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, sd=0.1),
        ...         lfm.Gaussian(jnp.array([18.0]), jnp.eye(1)))
        >>> simulate_switched(jax.random.key(0), house, lfm.Thermostat(20.0), jnp.arange(24.0), paths=5).state.shape
        (24, 5, 1)
    """
    checks.random_key(key)
    checks.positive_integer("paths", paths)
    ssms = build_models(build, controller)
    schemes = tuple(choose_scheme(ssm, scheme) for ssm in ssms)
    grid, is_decision = decision_grid(ssms[0], times, decisions, start, steps, max_step)
    problem = SwitchedProblem(ssms, controller, grid, jnp.asarray(is_decision), initial_moments(ssms[0], start),
                              initial_indices(initial, controller, paths))
    return _simulate(problem, schemes, jnp.asarray(times, float), key)


@shared_jit
def _simulate(problem: SwitchedProblem, schemes: tuple[str, ...], times: jax.Array,
              key: jax.Array) -> SwitchedSimulation:
    """Simulate all paths; ``schemes`` are the integration schemes of the models."""
    ssm, values = problem.ssms[0], jnp.asarray(problem.controller.values)
    w, y, _, next_indices = simulate_paths(problem, schemes, times, key)
    size = ssm.physical_dim
    forces = {name: w[:, :, size + number] for number, name in enumerate(ssm.model.force_names)}
    return SwitchedSimulation(times, w[:, :, :size], forces, values[next_indices], y)


def simulate_paths(problem: SwitchedProblem, schemes: tuple[str, ...], times: jax.Array,
                   key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Simulate all paths: inputs (T, N, M + R), observations (T, N, D), indices (T, N) before and after the decisions.

    Args:
        problem: models, controller, time grid and initial values.
        schemes: integration schemes of the models.
        times: (T,), times of the observations.
        key: a JAX random key.
    """
    ssms, controller, grid = problem.ssms, problem.controller, problem.grid
    paths = problem.initial_index.shape[0]
    initial_key, rows_key, noise_key = jax.random.split(key, 3)
    initial_state = initial_particles(initial_key, problem.start.mean, problem.start.covariance, paths)
    reading_root = semidefinite_root(jnp.diag(controller.variance()))
    transitions = [ParticleTransition(ssm, scheme, grid) for ssm, scheme in zip(ssms, schemes, strict=True)]

    def step(carry: tuple[jax.Array, jax.Array], inputs: tuple[Intervals, jax.Array, jax.Array]) -> tuple[tuple, tuple]:
        state, index = carry
        interval, is_decision, row_key = inputs
        move_key, jump_key, reading_key = jax.random.split(row_key, 3)
        end = interval.end
        # All models move all paths, with the same random numbers; each path takes the result for its input.
        next_states = [transition.move(interval, transition.step_constants(interval), move_key, jump_key, state)
                       for transition in transitions]
        state = jnp.take_along_axis(jnp.stack(next_states), index[None, None, :], axis=0)[0]

        def reading_of(s: jax.Array, index: jax.Array) -> jax.Array:
            return jnp.stack([controller.reading(*ssm.split(ssm.inputs(s, end)), end) for ssm in ssms])[index]

        reading = jax.vmap(reading_of, in_axes=(1, 0))(state, index)
        reading = reading + normals(reading_key, reading.shape[1], paths).T @ reading_root.T
        decision = jax.vmap(lambda d, r: controller.decide(d, r, end))(index, reading).astype(index.dtype)
        next_index = jnp.where(is_decision, decision, index)
        return (state, next_index), (state, index, next_index)

    rows = as_arrays(grid.intervals)
    keys = jax.random.split(rows_key, problem.is_decision.shape[0])
    _, row_results = jax.lax.scan(step, (initial_state, problem.initial_index), (rows, problem.is_decision, keys))
    states, observed_indices, next_indices = (result[jnp.asarray(grid.observed)] for result in row_results)

    def observe(s: jax.Array, t: jax.Array, index: jax.Array, key: jax.Array, row: jax.Array) -> tuple:
        inputs = [ssm.inputs(s, t) for ssm in ssms]
        y = [noisy_observation(ssm, w, t, key, row) for ssm, w in zip(ssms, inputs, strict=True)]
        return jnp.stack(inputs)[index], jnp.stack(y)[index]

    keys = jax.random.split(noise_key, (times.shape[0], paths))
    # Observations precede the decision at the same time, and depend on the input before it.
    w, y = jax.vmap(jax.vmap(observe, (1, None, 0, 0, None)))(states, times, observed_indices, keys,
                                                             jnp.arange(times.shape[0]))
    return w, y, observed_indices, next_indices
