"""A latent force model under each value of a discrete input, and the affine maps that it then is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.filtering.filter import FilterState, predict, preparation
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.time_grid import Intervals, TimeGrid, build_time_grid
from lfm_ppl.linearisation.taylor import Taylor
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation_noise import require_gaussian
from lfm_ppl.model.state_space import StateSpaceModel, state_space
from lfm_ppl.model.structure import pattern
from lfm_ppl.switching.rule import SwitchingRule

Build = Callable[[Any], LatentForceModel]


class SwitchedMap(NamedTuple):
    """A row under one value of the input: s -> phi s + offset + N(0, noise), and what is seen and read at its end.

    Attributes:
        phi, offset, noise: (n, n), (n,), (n, n).
        jacobian, shift, variance: (D, n), (D,), (D, D) of the observation, y = jacobian s + shift + N(0, variance).
        reads, read_shift: (p, n), (p,) of the reading of the rule, without its error.
    """

    phi: jax.Array
    offset: jax.Array
    noise: jax.Array
    jacobian: jax.Array
    shift: jax.Array
    variance: jax.Array
    reads: jax.Array
    read_shift: jax.Array


def switched(build: Build, rule: SwitchingRule) -> tuple[StateSpaceModel, ...]:
    """Return the model under each value of the input.

    Raises:
        TypeError: ``rule`` is no rule.
        ValueError: the input changes what states, outputs or jumps there are, or the initial state.
    """
    if not isinstance(rule, SwitchingRule):
        raise TypeError(f"rule must be an lfm.SwitchingRule such as lfm.Thermostat(20.0), got {type(rule).__name__}.")
    ssms = tuple(state_space(build(value)) for value in rule.values)
    kinds = [(ssm.model.state_names, ssm.model.force_names, ssm.model.output_names, ssm.state_dim,
              ssm.stack.jump_times) for ssm in ssms]
    for value, kind in zip(rule.values, kinds, strict=True):
        if kind != kinds[0]:
            raise ValueError(f"build({value:g}) has other states, outputs or jump times than build({rule.values[0]:g});"
                             " the discrete input may change coefficients only.")
    starts = [[checks.concrete(part) for part in (*ssm.initial(), ssm.model.initial_time)] for ssm in ssms]
    for value, start in zip(rule.values, starts, strict=True):
        pairs = zip(start, starts[0], strict=True)
        if any(a is not None and b is not None and not np.array_equal(a, b) for a, b in pairs):
            raise ValueError(f"build({value:g}) has another initial state or time than build({rule.values[0]:g}); what "
                             "the input does begins there, so both must be alike.")
    return ssms


def decision_grid(ssm: StateSpaceModel, times: Any, decisions: Any, start: FilterState | None, steps: int,
                  max_step: float | None) -> tuple[TimeGrid, np.ndarray]:
    """Return the rows, and which of them (K,) end with a decision."""
    grid = build_time_grid(ssm, times, steps, max_step, at=times if decisions is None else decisions,
                           initial_time=None if start is None else start.time)
    if checks.traced(grid.since):
        raise ValueError("a known input is read at t minus a traced value (a lag), but decisions need intervals that "
                         "are known before compilation; give the lag as a number.")
    decides = np.zeros(len(np.asarray(grid.intervals.observation)), bool)
    decides[grid.requested] = True
    ssm.model.check_at(grid.initial_time, len(grid.observed))
    return grid, decides


def first_moments(ssm: StateSpaceModel, start: FilterState | None) -> Moments:
    """Return the moments at the start, the model's own or those of a filter's state."""
    if start is None:
        return Moments(*ssm.initial())
    if np.shape(start.mean) != (ssm.state_dim,):
        raise ValueError(f"start has {np.shape(start.mean)[0]} entries, but the joint state of this model has "
                         f"{ssm.state_dim}.")
    return Moments(start.mean, start.covariance)


def check_initial(initial: Any, rule: SwitchingRule, particles: int) -> jax.Array:
    """Return the index of the input at the start, (N,), after checking it."""
    if np.shape(initial) not in ((), (particles,)):
        raise ValueError(f"initial must be one index or one for each of the {particles} particles, got shape "
                         f"{np.shape(initial)}.")
    known = checks.concrete(initial)
    last = len(rule.values) - 1
    if known is not None and (known.dtype.kind not in "biu" or np.any((known < 0) | (known > last))):
        raise ValueError(f"initial must be an index in rule.values = {rule.values}, 0 to {last}, got {initial!r}.")
    return jnp.broadcast_to(jnp.asarray(initial, int), (particles,))


def check_linear(ssm: StateSpaceModel, rule: SwitchingRule) -> None:
    """Raise ValueError unless model and reading are linear in states and forces."""
    require_gaussian(ssm, "the Rao-Blackwellised particle filter", "lfm.particle_filter")
    names = (*ssm.model.state_names, *ssm.model.force_names)
    for what, structure in (("dynamics", ssm.drift_structure), ("observation", ssm.observation_structure)):
        if structure.points:
            raise ValueError(f"the {what} is not linear in {names[structure.points[0]]!r}, so that the state is not "
                             "Gaussian given the discrete input. Use lfm.simulate_switched, which draws whole states.")
    total = len(names)
    curved = pattern(lambda v: rule.reading(*ssm.split(v[:total]), v[total]), total + 1).hessian[:total, :total]
    if curved.any():
        raise ValueError(f"what the rule reads is not linear in {names[int(np.argmax(curved.any(axis=1)))]!r}. Use "
                         "lfm.simulate_switched, which draws whole states.")


def only_adds(build: Build) -> bool:
    """Return whether the input only adds to dynamics and outputs, so that no covariance depends on it."""

    def coefficients(v: jax.Array) -> jax.Array:
        ssm, t = state_space(build(v[0])), v[1]
        w, stack = jnp.zeros(ssm.input_dim), ssm.stack
        parts = [jax.jacfwd(lambda w: ssm.drift(w, t))(w), jax.jacfwd(lambda w: ssm.observe(w, t))(w),
                 ssm.obs_cov(w, t, 0), ssm.dispersion(w, t), stack.feedback(), stack.dispersion(),
                 stack.measurement(t), *(part for index in range(len(stack.jump_times)) for part in stack.jump(index))]
        return jnp.concatenate([jnp.ravel(part) for part in parts if part is not None])

    try:
        return not pattern(coefficients, 2).jacobian[:, 0].any()
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError,
            jax.errors.TracerIntegerConversionError, TypeError):
        return False  # build asks in Python for the value of the input: it may do anything


def interval_maps(ssm: StateSpaceModel, rule: SwitchingRule, grid: TimeGrid) -> Callable[[Intervals], SwitchedMap]:
    """Return what makes the affine maps of a row, for a model that is linear; traceable."""
    total = ssm.state_dim
    nothing = Moments(jnp.zeros(total), jnp.zeros((total, total)))
    prepared = preparation(ssm, Taylor(), grid)

    def make(row: Intervals) -> SwitchedMap:
        # From a state that is zero and known, the mean at the end is the offset.
        one = predict(ssm, Taylor(), grid, prepared, row, nothing, with_map=True)
        end = row.end
        observe = lambda s: ssm.observe(ssm.inputs(s, end), end)  # noqa: E731
        read = lambda s: rule.reading(*ssm.split(ssm.inputs(s, end)), end)  # noqa: E731
        zero = nothing.mean
        variance = ssm.obs_cov(ssm.inputs(zero, end), end, jnp.maximum(row.observation, 0))
        return SwitchedMap(one.phi, one.moments.mean, one.process_cov, jax.jacfwd(observe)(zero), observe(zero),
                           variance, jax.jacfwd(read)(zero), read(zero))

    return make
