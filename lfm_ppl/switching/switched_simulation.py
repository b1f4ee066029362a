"""Simulation of models with a discrete input that follows a known rule: particles that draw the whole state."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from lfm_ppl import checks
from lfm_ppl.filtering.filter import FilterState
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.time_grid import Intervals, TimeGrid, as_arrays
from lfm_ppl.linalg import semidefinite_root
from lfm_ppl.model.observation_noise import noisy_observation
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.particles.normals import normals
from lfm_ppl.particles.stochastic_steps import Moves, choose_scheme, first_particles
from lfm_ppl.switching.rule import SwitchingRule
from lfm_ppl.switching.switched_model import Build, check_initial, decision_grid, first_moments, switched


class SwitchedSimulation(NamedTuple):
    """Paths of a model with a discrete input.

    Attributes:
        times: (T,).
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


def simulate_switched(key: jax.Array, build: Build, rule: SwitchingRule, times: Any, *, paths: int = 1,
                      start: FilterState | None = None, initial: Any = 0, decisions: Any = None, steps: int = 10,
                      max_step: float | None = None, scheme: str = "auto") -> SwitchedSimulation:
    """Draw whole paths of a latent force model with a discrete input that follows a known rule.

    Averages over many paths are a plain particle prediction, of which `lfm_ppl.rao_blackwellised` is the version with
    less variance for linear models. The model may be non-linear here. Each call outside ``jax.jit`` compiles anew,
    since ``build`` makes new functions: compile what is called repeatedly.

    Args:
        key: a JAX random key.
        build: from a value of the input to the `LatentForceModel` that holds while it has that value.
        rule: of the input, such as `lfm.Thermostat`.
        times: (T,), non-decreasing.
        paths: N.
        start: the ``state`` of a filter's result, to go on from there; None: the model's initial state.
        initial: index in ``rule.values`` of the input at the start, or (N,), one for each path.
        decisions: times at which the rule is applied; None: ``times``.
        steps: integration steps between two consecutive times.
        max_step: longest step; longer intervals get more.
        scheme: of the steps, as in `lfm_ppl.particle_filter`.

    Returns:
        States, forces, inputs and observations at ``times``.

    Raises:
        ValueError, TypeError: as `lfm_ppl.rao_blackwellised`, but for models that are not linear.

    Example:
        >>> import jax, jax.numpy as jnp, lfm_ppl as lfm
        >>> def house(heater):
        ...     return lfm.LatentForceModel(
        ...         lambda x, u, t: 0.1 * (5.0 - x) + 2.0 * heater + u, {"rest": lfm.Matern(0.3, 2.0)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.01])),
        ...         lfm.Gaussian(jnp.array([18.0]), jnp.eye(1)))
        >>> simulate_switched(jax.random.key(0), house, lfm.Thermostat(20.0), jnp.arange(24.0), paths=5).state.shape
        (24, 5, 1)
    """
    checks.random_key(key)
    checks.positive_integer("paths", paths)
    ssms = switched(build, rule)
    schemes = tuple(choose_scheme(ssm, scheme) for ssm in ssms)
    grid, decides = decision_grid(ssms[0], times, decisions, start, steps, max_step)
    return _run(ssms, schemes, rule, grid, jnp.asarray(decides), jnp.asarray(times, float),
                first_moments(ssms[0], start), check_initial(initial, rule, paths), key)


@eqx.filter_jit
def _run(ssms: tuple[StateSpaceModel, ...], schemes: tuple[str, ...], rule: SwitchingRule, grid: TimeGrid,
         decides: jax.Array, times: jax.Array, begin: Moments, initial: jax.Array,
         key: jax.Array) -> SwitchedSimulation:
    ssm, paths = ssms[0], initial.shape[0]
    size = ssm.physical_dim
    first_key, rows_key, noise_key = jax.random.split(key, 3)
    first = first_particles(first_key, *begin, paths)
    error = semidefinite_root(jnp.diag(rule.variance()))
    moves = [Moves.over(own, scheme, grid) for own, scheme in zip(ssms, schemes, strict=True)]

    def row(carry: tuple[jax.Array, jax.Array], inputs: tuple[Intervals, jax.Array, jax.Array]) -> tuple[tuple, tuple]:
        state, index = carry
        one, decide, row_key = inputs
        move_key, jump_key, read_key = jax.random.split(row_key, 3)
        end = one.end
        moved = [move.across(one, move.ready(one), move_key, jump_key, state) for move in moves]
        state = jnp.take_along_axis(jnp.stack(moved), index[None, None, :], axis=0)[0]
        before = index

        def reading(s: jax.Array, index: jax.Array) -> jax.Array:
            return jnp.stack([rule.reading(*own.split(own.inputs(s, end)), end) for own in ssms])[index]

        read = jax.vmap(reading, in_axes=(1, 0))(state, index)
        read = read + normals(read_key, read.shape[1], paths).T @ error.T
        chosen = jax.vmap(lambda d, r: rule.decide(d, r, end))(index, read).astype(index.dtype)
        index = jnp.where(decide, chosen, index)
        return (state, index), (state, before, index)

    rows = as_arrays(grid.intervals)
    keys = jax.random.split(rows_key, decides.shape[0])
    _, kept = jax.lax.scan(row, (first, initial), (rows, decides, keys))
    states, before, indices = (part[jnp.asarray(grid.observed)] for part in kept)

    def observe(s: jax.Array, t: jax.Array, index: jax.Array, key: jax.Array, row: jax.Array) -> tuple:
        inputs = [own.inputs(s, t) for own in ssms]
        y = [noisy_observation(own, w, t, key, row) for own, w in zip(ssms, inputs, strict=True)]
        return jnp.stack(inputs)[index], jnp.stack(y)[index]

    keys = jax.random.split(noise_key, (times.shape[0], paths))
    w, y = jax.vmap(jax.vmap(observe, (1, None, 0, 0, None)))(states, times, before, keys, jnp.arange(times.shape[0]))
    forces = {name: w[:, :, size + number] for number, name in enumerate(ssm.model.force_names)}
    return SwitchedSimulation(times, w[:, :, :size], forces, jnp.asarray(rule.values)[indices], y)
