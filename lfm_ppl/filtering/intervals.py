"""Intervals of the scans, and quantities that are tabulated by the length of the interval."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.integrators.methods import DEFAULT_METHOD
from lfm_ppl.model.state_space import Span, StateSpaceModel, inset

_BLOCK = 128
"""Largest number of intervals whose transitions are computed at once."""


class Intervals(NamedTuple):
    """The intervals of the scan, one entry each: a prediction, perhaps a jump, perhaps an observation.

    Attributes:
        start: (N,) time at which the interval starts.
        length: (N,) its length, >= 0.
        observation: (N,) index of the observation at its end, -1 where there is none.
        jump: (N,) index of the jump of the forces at its end, before the observation; -1 where there is none.
        length_index: (N,) index of its length in `TimeGrid.lengths`; zero where that is None.
        end: (N,) time at which the interval ends, exactly the time of its observation.
        inset: (N,) how far inside of the interval functions of time are evaluated at its ends, see `Span`.
        event: (N,) index of the event of the model at its end, before the observation; `NO_EVENT`, which is -1, where
            there is none.
        state_map: the maps of these events; None where they are not needed, or without events.
        transition: exact transition of each interval, see `with_transitions`; None where it is tabulated by length.
    """

    start: Any
    length: Any
    observation: Any
    jump: Any
    length_index: Any
    end: Any
    inset: Any
    event: Any
    state_map: Any = None
    transition: Any = None

    @property
    def span(self) -> Span:
        """Times of one interval at which functions of time are evaluated."""
        return Span(self.start, self.start + self.inset, self.end - self.inset)


def intervals_between(start: Any, end: Any, length: Any, observation: Any, jump: Any, length_index: Any = None,
                      scale: Any = 0.0, event: Any = None) -> Intervals:
    """Return intervals; arguments as in `Intervals`, and ``scale`` as in `lfm_ppl.model.state_space.inset`."""
    length_index = np.zeros(np.shape(length), int) if length_index is None else length_index
    event = np.full(np.shape(length), -1) if event is None else event
    return Intervals(start, length, observation, jump, length_index, end, inset(start, end, length, scale), event)


class TimeGrid(NamedTuple):
    """The intervals, and the indices of results among them.

    Attributes:
        intervals: the scan's intervals.
        lengths: (U,) distinct lengths, None where there are too many or they are traced.
        observed: (T,) interval of each observation.
        requested: (K,) interval of each requested time.
        requested_times: (K,).
        steps: integration steps in each interval.
        initial_time: start of the scan.
        replicated: whether intervals of length zero are so many that a branch around their prediction is faster.
        tolerance: of the error of an adaptive step, in standard deviations; None for ``steps`` equal steps.
        method: of integration, one of `lfm_ppl.filtering.integrators.methods.METHODS`.
        since: (N,) starts of the intervals, counted from the initial time, so that small differences of large times
            keep all their digits.
    """

    intervals: Intervals
    lengths: Any
    observed: Any
    requested: Any
    requested_times: Any
    steps: int
    initial_time: Any
    replicated: bool = False
    tolerance: float | None = None
    method: str = DEFAULT_METHOD
    since: Any = None


def divide_intervals(grid: TimeGrid, count: Any, most: int) -> TimeGrid:
    """Return the grid whose intervals are ``count`` intervals of one step each, of equal lengths.

    The number may be traced: each interval becomes ``most`` of them, the last ones of length zero, so that one program
    serves all numbers.

    Args:
        grid: the time grid.
        count: steps in each interval, at most ``most``.
        most: number of intervals for each.
    """
    old = as_arrays(grid.intervals)
    part = jnp.arange(most)
    is_step, is_last = part < count, part == most - 1
    step = (jnp.asarray(old.length, float) / count)[:, None]
    start = jnp.where(is_step, old.start[:, None] + part * step, old.end[:, None])
    end = jnp.where(part + 1 < count, old.start[:, None] + (part + 1) * step, old.end[:, None])
    since = jnp.asarray(grid.since)[:, None] + jnp.minimum(part, count) * step
    length = jnp.where(is_step, step, 0.0)
    depth = jnp.minimum(jnp.asarray(old.inset)[:, None], 0.5 * length)
    lengths, length_index = grid.lengths, jnp.zeros(length.shape, int)
    if lengths is not None:
        length_index = jnp.where(is_step, old.length_index[:, None], len(lengths))
        lengths = jnp.append(jnp.asarray(lengths) / count, 0.0)
    observation, jump, event = (jnp.where(is_last, index[:, None], -1) for index in (
        old.observation, old.jump, old.event))
    fields = (start, length, observation, jump, length_index, end, depth, event)
    intervals = Intervals(*(jnp.reshape(field, -1) for field in fields))
    observed, requested = (jnp.asarray(index) * most + most - 1 for index in (grid.observed, grid.requested))
    # Without a branch, intervals of length zero would take the time of a step.
    return grid._replace(intervals=intervals, lengths=lengths, observed=observed, requested=requested, steps=1,
                         replicated=True, since=since.reshape(-1))


def as_arrays(intervals: Intervals) -> Intervals:
    """Return the intervals as JAX arrays, which a scan can run over."""
    return jax.tree.map(jnp.asarray, intervals)


def with_state_maps(ssm: StateSpaceModel, grid: TimeGrid) -> TimeGrid:
    """Return the grid with the maps of the events at the ends of its intervals."""
    maps = ssm.state_maps()
    if maps is None:
        return grid
    # Gathered outside of the scan: its derivative with respect to the amounts is then linear in the number of events.
    index = jnp.asarray(grid.intervals.event)
    return grid._replace(intervals=grid.intervals._replace(state_map=jax.tree.map(lambda a: a[index], maps)))


def by_length(grid: TimeGrid, make: Callable[[jax.Array], Any]) -> Callable[[Intervals], Any]:
    """Return the function interval -> ``make(length)``, tabulated for the distinct lengths where these are few."""
    if grid.lengths is None:
        return lambda interval: make(interval.length)
    leaves, tree = jax.tree.flatten(jax.vmap(make)(jnp.asarray(grid.lengths)))
    if not leaves:
        return lambda interval: jax.tree.unflatten(tree, [])
    shapes = [leaf.shape[1:] for leaf in leaves]
    offsets = np.cumsum([math.prod(shape) for shape in shapes])
    # One row for each length is read at once, and written at once in reverse mode; array by array that took many more
    # operations to compile.
    rows = jnp.concatenate([leaf.reshape(len(leaf), -1) for leaf in leaves], axis=1)

    def read(interval: Intervals) -> Any:
        row = jax.lax.dynamic_index_in_dim(rows, interval.length_index, keepdims=False)
        parts = jnp.split(row, offsets[:-1])
        return jax.tree.unflatten(tree, [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)])

    return read


def with_transitions(grid: TimeGrid, make: Callable[[jax.Array], Any]) -> TimeGrid:
    """Return the grid with the result of ``make``, from lengths (B,), for each interval.

    A block of lengths at once takes a fraction of the time of one length after another in the scan. Reverse mode stores
    no more than the result.
    """
    lengths = jnp.asarray(grid.intervals.length)
    count = lengths.shape[0]
    size = min(_BLOCK, count)
    blocks = jnp.pad(lengths, (0, -count % size)).reshape(-1, size)
    transitions = jax.lax.map(jax.checkpoint(make, prevent_cse=False), blocks)
    transitions = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:count], transitions)
    return grid._replace(intervals=grid.intervals._replace(transition=transitions))


def with_observations(intervals: Intervals, y: Any) -> tuple[Intervals, jax.Array]:
    """Return the intervals as JAX arrays, and the entry of ``y`` (T, ...) at the end of each, NaN where it has none."""
    y = jnp.asarray(y, float)
    # The index -1 of an interval without an observation is that of the last entry.
    padded = jnp.concatenate([y, jnp.full((1, *y.shape[1:]), jnp.nan)])
    intervals = as_arrays(intervals)
    return intervals, padded[intervals.observation]
