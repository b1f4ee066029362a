"""A latent force model for each value of a discrete input, and the affine maps of linear ones.

1. `build_models`: one state-space model for each value of the input; only coefficients may differ between them.
2. `decision_grid`: rows of the scan between observations and decisions, and which rows end with a decision.
3. `initial_moments`, `initial_indices`: state and input at the start.
4. `make_interval_map`: for linear models, the map s -> Phi s + offset + N(0, Q) over a row, and the affine functions
   that give observation and reading at its end.
5. `is_input_additive`: whether the input only adds to dynamics and outputs. Then Phi, Q and all covariances are equal
   for all values of the input, and particles share them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.filter import FilterState
from lfm_ppl.filtering.intervals import Intervals, TimeGrid
from lfm_ppl.filtering.moments import Moments, Record
from lfm_ppl.filtering.predict import predict
from lfm_ppl.filtering.problem import filter_problem
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.forces.shared_state import in_state_of, structure_of
from lfm_ppl.linearisation.taylor import Taylor
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation_noise import require_gaussian
from lfm_ppl.model.state_space import StateSpaceModel, state_space
from lfm_ppl.model.structure import pattern
from lfm_ppl.switching.controller import Controller
from lfm_ppl.utils import checks

Build = Callable[[Any], LatentForceModel]
"""Function from a value of the discrete input to the model that holds while the input has this value."""


class SwitchedProblem(eqx.Module):
    """Models, controller, time grid and initial values of a filter or a simulation.

    Attributes:
        ssms: the model for each value of the input.
        controller: of the input.
        grid: the time grid.
        is_decision: (K,), whether a row ends with a decision.
        start: moments of the joint state at the initial time.
        initial_index: (N,), index of the input of each particle at the initial time.
    """

    ssms: tuple[StateSpaceModel, ...]
    controller: Controller
    grid: TimeGrid
    is_decision: jax.Array
    start: Moments
    initial_index: jax.Array


class SwitchedMap(NamedTuple):
    """Affine maps of one row for one value of the input.

    Attributes:
        phi, offset, process_cov: (n, n), (n,), (n, n), of the transition s -> phi s + offset + N(0, process_cov).
        jacobian, observation_offset, obs_cov: (D, n), (D,), (D, D), of the observation at the end of the row,
            y = jacobian s + observation_offset + N(0, obs_cov).
        reading_jacobian, reading_offset: (p, n), (p,), of the controller's reading without its error.
    """

    phi: jax.Array
    offset: jax.Array
    process_cov: jax.Array
    jacobian: jax.Array
    observation_offset: jax.Array
    obs_cov: jax.Array
    reading_jacobian: jax.Array
    reading_offset: jax.Array


def build_models(build: Build, controller: Controller) -> tuple[StateSpaceModel, ...]:
    """Return the model for each value of the input.

    Raises:
        TypeError: ``controller`` is not a controller.
        ValueError: the models differ in their states, outputs, jump times or initial state.
    """
    if not isinstance(controller, Controller):
        raise TypeError("controller must be an lfm.Controller such as lfm.Thermostat(20.0), got "
                        f"{type(controller).__name__}.")
    models = [build(value) for value in controller.values]
    ssms = tuple(state_space(model) for model in models)
    check_structure({f"build({value:g})": ssm for value, ssm in zip(controller.values, ssms, strict=True)})
    if any(ssm.model.events for ssm in ssms):
        raise ValueError("the models have events, which a model with a controller does not support; leave them "
                         "out.")
    starts = [[checks.concrete(entry) for entry in (*ssm.initial(), ssm.model.initial_time)] for ssm in ssms]
    for value, start in zip(controller.values, starts, strict=True):
        pairs = zip(start, starts[0], strict=True)
        if any(a is not None and b is not None and not np.array_equal(a, b) for a, b in pairs):
            first = controller.values[0]
            raise ValueError(f"build({value:g}) has another initial state or time than build({first:g}); the "
                             "input acts from the initial time on, so both models must start alike.")
    return tuple(state_space(with_forces_of(model, models[0])) for model in models)


def check_structure(ssms: Mapping[str, StateSpaceModel]) -> None:
    """Raise ValueError unless the models, by their names in messages, differ in coefficients only."""
    first, *_ = names = list(ssms)
    structures = [{"states": ssm.model.state_names, "forces": ssm.model.force_names,
                   "types of forces": [structure_of(force) for force in ssm.model.force_list],
                   "outputs": ssm.model.output_names, "deterministics": ssm.model.deterministic_names,
                   "angular outputs": ssm.model.observation.angular,
                   "a period of angles": ssm.model.observation.period, "a joint state of size": ssm.state_dim,
                   "jump times": ssm.stack.jump_times} for ssm in ssms.values()]
    for name, structure in zip(names, structures, strict=True):
        for kind, value in structure.items():
            if value != structures[0][kind]:
                raise ValueError(f"{name} has {kind} {value}, and {first} has {structures[0][kind]}; models between "
                                 "which the system switches may differ in coefficients only.")


def with_forces_of(model: LatentForceModel, reference: LatentForceModel) -> LatentForceModel:
    """Return the model with forces in the state of the reference's, so that a switch keeps their derivatives."""
    if model is reference:
        return model
    forces = {name: in_state_of(force, reference.forces[name]) for name, force in model.forces.items()}
    return eqx.tree_at(lambda model: model.forces, model, forces)


def decision_grid(ssm: StateSpaceModel, times: Any, decisions: Any, start: FilterState | None, steps: int,
                  max_step: float | None) -> tuple[TimeGrid, np.ndarray]:
    """Return the time grid, and whether each of its K rows ends with a decision, (K,)."""
    grid = build_time_grid(ssm, times, steps, max_step, times if decisions is None else decisions,
                           initial_time=None if start is None else start.time)
    if checks.traced(grid.since):
        raise ValueError("a known input is read at t minus a traced value (a lag), but decisions need intervals that "
                         "are known before compilation; give the lag as a number.")
    is_decision = np.zeros(len(np.asarray(grid.intervals.observation)), bool)
    is_decision[grid.requested] = True
    ssm.model.check_at(grid.initial_time, len(grid.observed))
    return grid, is_decision


def initial_moments(ssm: StateSpaceModel, start: FilterState | None) -> Moments:
    """Return the moments of the joint state at the start: of ``start`` if given, else of the model."""
    if start is None:
        return Moments(*ssm.initial())
    if np.shape(start.mean) != (ssm.state_dim,):
        raise ValueError(f"start has {np.shape(start.mean)[0]} entries, but the joint state of this model has "
                         f"{ssm.state_dim}.")
    return Moments(start.mean, start.covariance)


def initial_indices(initial: Any, controller: Controller, particles: int) -> jax.Array:
    """Check the index of the input at the start, one or one for each particle, and return it as (N,)."""
    if np.shape(initial) not in ((), (particles,)):
        raise ValueError(f"initial must be one index or one for each of the {particles} particles, got shape "
                         f"{np.shape(initial)}.")
    index = checks.concrete(initial)
    last = len(controller.values) - 1
    if index is not None and (index.dtype.kind not in "biu" or np.any((index < 0) | (index > last))):
        raise ValueError(f"initial must be an index in controller.values = {controller.values}, 0 to {last}, got "
                         f"{initial!r}.")
    return jnp.broadcast_to(jnp.asarray(initial, int), (particles,))


def check_linear(ssm: StateSpaceModel, controller: Controller) -> None:
    """Raise ValueError unless model and reading are linear in states and forces."""
    require_gaussian(ssm, "the Rao-Blackwellised particle filter", "lfm.particle_filter")
    names = (*ssm.model.state_names, *ssm.model.force_names)
    for label, structure in (("dynamics", ssm.drift_structure), ("observation", ssm.observation_structure)):
        if structure.nonlinear:
            raise ValueError(f"the {label} is not linear in {names[structure.nonlinear[0]]!r}, so that the state is "
                             "not Gaussian given the discrete input. Use lfm.simulate_switched, which draws whole "
                             "states.")
    size = len(names)
    hessian = pattern(lambda v: controller.reading(*ssm.split(v[:size]), v[size]), size + 1).hessian[:size, :size]
    if hessian.any():
        name = names[int(np.argmax(hessian.any(axis=1)))]
        raise ValueError(f"the reading of the controller is not linear in {name!r}. Use lfm.simulate_switched, which "
                         "draws whole states.")


def is_input_additive(build: Build) -> bool:
    """Return whether the input only adds to dynamics and outputs, so that no covariance depends on it."""

    def coefficients(v: jax.Array) -> jax.Array:
        ssm, t = state_space(build(v[0])), v[1]
        w, stack = jnp.zeros(ssm.input_dim), ssm.stack
        matrices = [jax.jacfwd(lambda w: ssm.drift(w, t))(w), jax.jacfwd(lambda w: ssm.observe(w, t))(w),
                    ssm.obs_cov(w, t, 0), ssm.dispersion(w, t), stack.feedback(), stack.dispersion(),
                    stack.measurement(t),
                    *(matrix for index in range(len(stack.jump_times)) for matrix in stack.jump(index))]
        return jnp.concatenate([jnp.ravel(matrix) for matrix in matrices if matrix is not None])

    try:
        return not pattern(coefficients, 2).jacobian[:, 0].any()
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError,
            jax.errors.TracerIntegerConversionError, TypeError):
        return False  # build branches in Python on the value of the input, so that anything may depend on it


def make_interval_map(ssm: StateSpaceModel, controller: Controller,
                      grid: TimeGrid) -> Callable[[Intervals], SwitchedMap]:
    """Return a traceable function from a row to the affine maps of a linear model."""
    size = ssm.state_dim
    origin = Moments(jnp.zeros(size), jnp.zeros((size, size)))
    problem = filter_problem(ssm, Taylor(), grid)

    def interval_map(interval: Intervals) -> SwitchedMap:
        # The predicted mean is the offset, because the prediction starts from the known state zero.
        prediction = predict(problem, interval, origin, record=Record.SMOOTHER)
        end, zero = interval.end, origin.mean

        def observe(s: jax.Array) -> jax.Array:
            return ssm.observe(ssm.inputs(s, end), end)

        def read(s: jax.Array) -> jax.Array:
            return controller.reading(*ssm.split(ssm.inputs(s, end)), end)

        obs_cov = ssm.obs_cov(ssm.inputs(zero, end), end, jnp.maximum(interval.observation, 0))
        return SwitchedMap(prediction.phi, prediction.moments.mean, prediction.process_cov,
                           jax.jacfwd(observe)(zero), observe(zero), obs_cov, jax.jacfwd(read)(zero), read(zero))

    return interval_map
