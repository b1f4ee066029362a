"""The problem that all passes of a filter share: a model, a rule, a time grid, and what is computed once for all.

`filter_problem` chooses the integrator of the model, lets it tabulate what depends on the length of an interval only,
where distinct lengths are few, and takes the constant parts of the Jacobians. Passes of one problem (iterations, sweeps
of expectation propagation) share them, so that their derivatives are taken once.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.dynamics import Dynamics
from lfm_ppl.filtering.integrators.integrator import Integrator, Stepping
from lfm_ppl.filtering.integrators.methods import choose_integrator
from lfm_ppl.filtering.intervals import Intervals, TimeGrid, by_length, with_state_maps, with_transitions
from lfm_ppl.filtering.moments import Moments
from lfm_ppl.filtering.transition import LinearPart, constant_jacobian, linear_part
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.state_space import StateSpaceModel

_FEW_LENGTHS = 16
"""Number of distinct interval lengths up to which tables with all nodes cost nothing."""

_INTERVALS_PER_LENGTH = 32
"""Intervals for each distinct length from which such tables cost little: regular times, rounded."""


class SharedTransitions(NamedTuple):
    """Quantities that all intervals share.

    Attributes:
        linear: the constant linear part of the dynamics.
        observation_jacobian: (D, M + R), the constant part of the observation's Jacobian.
        table: maps an interval to what the integrator tabulates for its length.
        jumps: G and Q of the forces' jumps; None without any.
    """

    linear: LinearPart
    observation_jacobian: jax.Array
    table: Callable[[Intervals], Any]
    jumps: tuple[jax.Array, jax.Array] | None


class FilterProblem(NamedTuple):
    """A model, a rule, a time grid and the integrator that they need, with what all intervals share."""

    ssm: StateSpaceModel
    rule: Rule
    grid: TimeGrid
    integrator: Integrator
    shared: SharedTransitions

    @property
    def has_jumps(self) -> bool:
        """Whether the state may jump at the end of an interval."""
        return self.shared.jumps is not None or bool(self.ssm.model.events)

    @property
    def dynamics(self) -> Dynamics:
        """Model, rule and linear part, as a prediction needs them."""
        return Dynamics(self.ssm, self.rule, self.shared.linear)

    def initial(self, initial: Moments | None = None) -> Moments:
        """Return moments at the initial time, by default the model's."""
        return Moments(*self.ssm.initial()) if initial is None else initial


def filter_problem(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid) -> FilterProblem:
    """Compute what all intervals share."""
    integrator = choose_integrator(ssm, rule, grid.method, grid.tolerance)
    linear = linear_part(ssm, jnp.asarray(grid.initial_time, float))
    count = np.shape(grid.intervals.length)[0]
    is_tabulated = grid.lengths is not None and len(grid.lengths) <= max(_FEW_LENGTHS, count // _INTERVALS_PER_LENGTH)

    def tabulate(length: jax.Array) -> Any:
        return integrator.tabulate(Dynamics(ssm, rule, linear), length, grid.steps, is_tabulated)

    grid = with_state_maps(ssm, grid)
    if grid.lengths is None and integrator.stepping is Stepping.NONE:
        grid = with_transitions(grid, tabulate)
        table: Callable[[Intervals], Any] = operator.attrgetter("transition")
    else:
        table = by_length(grid, tabulate)
    shared = SharedTransitions(linear, _observation_jacobian(ssm, grid), table, ssm.stack.jump_table())
    return FilterProblem(ssm, rule, grid, integrator, shared)


def _observation_jacobian(ssm: StateSpaceModel, grid: TimeGrid) -> jax.Array:
    """Return the constant part of the observation's Jacobian, the same at every point and time."""
    t = jnp.asarray(grid.initial_time, float)
    w = ssm.inputs(ssm.initial()[0], t)
    return constant_jacobian(lambda v: (ssm.observe(v, t), ()), w, ssm.observation_structure, ssm.output_dim)


def at_intervals(tree: Any, intervals: Any) -> Any:
    """Return the entries of arrays (N, ...) at intervals; all of them without a gather, a scatter in reverse mode."""

    def entries(a: jax.Array) -> jax.Array:
        is_whole = isinstance(intervals, np.ndarray) and np.array_equal(intervals, np.arange(a.shape[0]))
        return a if is_whole else a[jnp.asarray(intervals)]

    return jax.tree.map(entries, tree)
