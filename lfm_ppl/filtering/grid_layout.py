"""Layouts: what of a time grid is decided before compilation, so that its arrays may be arguments of a program.

1. The host divides the time between observations (`lfm_ppl.filtering.time_grid`). The intervals that result are arrays,
   and so are the rows of tables of known inputs that are breakpoints.
2. `GridLayout.complete` merges breakpoints and events at a traced lag into the intervals by sorting.
3. `GridLayout.padded` appends intervals of length zero, so that similar times have arrays of the same shapes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.intervals import Intervals, TimeGrid, intervals_between
from lfm_ppl.model.events import NO_EVENT, EventTable
from lfm_ppl.model.inputs import InputRead
from lfm_ppl.model.state_space import inset

BEFORE_JUMP, JUMP, EVENT_BEFORE, OBSERVATION, EVENT_AFTER = range(5)
"""Order of what happens at one time."""


def padded_size(count: int) -> int:
    """Return the next larger of few sizes: 16, 24, 32, 40, 48, 56, 64, 80, ..., at most a quarter more from 32 on."""
    step = max(8, 2 ** (int(count - 1).bit_length() - 3))
    return max(16, -(-count // step) * step)


class GridLayout(NamedTuple):
    """What of a time grid is decided on the host, so that its arrays may be arguments of a compiled program.

    Attributes:
        grid: the time grid without breakpoints and events at a traced lag.
        rows: for each read of a known input, the rows of its table that are breakpoints.
        is_lagged: for each read, whether its breakpoints are at a traced lag, or all times are traced.
        is_event_lagged: for each event, whether its time is traced, so that it is not in the grid.
    """

    grid: TimeGrid
    rows: tuple[Any, ...] = ()
    is_lagged: tuple[bool, ...] = ()
    is_event_lagged: tuple[bool, ...] = ()

    def padded(self) -> GridLayout:
        """Return a layout of few different sizes, so that similar times share a compiled program.

        Intervals of length zero are appended where there are more intervals than observations, and lengths where that
        costs little.
        """
        grid, fields = self.grid, self.grid.intervals._asdict()
        count, lengths = len(fields["length"]), grid.lengths
        extra = 0 if count == len(grid.observed) else padded_size(count) - count
        if extra:
            tail = {**dict.fromkeys(fields, -1), "start": fields["end"][-1], "end": fields["end"][-1], "length": 0.0,
                    "inset": 0.0, "length_index": 0 if lengths is None else len(lengths)}
            fields = {name: None if field is None else np.append(field, np.full(extra, tail[name]))
                      for name, field in fields.items()}
            since = np.append(grid.since, np.full(extra, grid.intervals.end[-1] - grid.initial_time))
            grid = grid._replace(intervals=Intervals(**fields), since=since)
            lengths = None if lengths is None else np.append(lengths, 0.0)
        if lengths is not None:
            size = _padded_lengths(len(lengths), count + extra)
            lengths = np.append(lengths, np.full(size - len(lengths), lengths[-1]))
        return self._replace(grid=grid._replace(lengths=lengths))

    def breakpoints(self, reads: Sequence[InputRead], only_lagged: bool = False) -> jax.Array:
        """Return the times (K,) of the breakpoints, given the reads of the known inputs."""
        times = [jnp.asarray(read.breakpoints(rows), float) for read, rows, is_lagged in zip(
            reads, self.rows, self.is_lagged, strict=True) if is_lagged or not only_lagged]
        return jnp.concatenate([jnp.zeros(0), *times])

    def complete(self, reads: Sequence[InputRead], events: EventTable) -> TimeGrid:
        """Return the time grid with all breakpoints and events, given the reads of the known inputs and the events."""
        if not any(self.is_lagged + self.is_event_lagged):
            return self.grid
        scale, intervals = time_scale(reads), self.grid.intervals
        inner = inset(intervals.start, intervals.end, intervals.length, scale)
        return insert_traced_times(self.grid._replace(intervals=intervals._replace(inset=inner)),
                                   self.breakpoints(reads, only_lagged=True), events,
                                   np.asarray(self.is_event_lagged, bool), scale)


def _padded_lengths(count: int, intervals: int) -> int:
    """Return the size of a table of interval lengths: of irregular times, or where the table is small.

    Larger tables grow by at most a third, so that the default trajectory times of similar series share a program.
    """
    if count > 16 or 4 * count > intervals:
        return min(padded_size(count), intervals)
    size = 2 ** (count - 1).bit_length()
    return size if 8 * size <= intervals else count


def time_scale(reads: Sequence[InputRead]) -> Any:
    """Return the size of the numbers that inputs compare times with."""
    sizes = [read.scale for read in reads]
    return sum(sizes) if sizes else 0.0


def insert_traced_times(grid: TimeGrid, breakpoints: Any, events: EventTable, is_inserted: np.ndarray,
                        scale: Any) -> TimeGrid:
    """Return a time grid whose intervals end at traced breakpoints (K,) and at some of the events (E,) as well.

    Their number is that of all breakpoints and events, wherever they lie: those outside of the grid's times end
    intervals of length zero. Events after the last time do not happen; see `EventTable.entries_within` for those before
    the initial time. At equal times the order is that of concrete times. The sorted times are continuous in the
    inserted times, and differentiable but where two meet.
    """
    index = np.flatnonzero(is_inserted)
    count = np.shape(breakpoints)[0]
    if not count + len(index):
        return grid
    intervals, origin = grid.intervals, jnp.asarray(grid.initial_time, float)
    # The last one exactly as the times of events are counted, so that an event at the last time is not past it.
    since_end = jnp.append(jnp.asarray(grid.since)[1:], intervals.end[-1] - origin)
    event_times, entries = (a[index] for a in events.entries_within(origin, intervals.end[-1]))
    inserted = jnp.concatenate([jnp.clip(breakpoints - origin, 0.0, since_end[-1]), event_times - origin])
    merged = jnp.concatenate([since_end, inserted])
    order = jnp.lexsort((*_order_at_equal_times(intervals, events, index, count), jax.lax.stop_gradient(merged)))
    position = jnp.argsort(order)
    since_end = merged[order]
    since = jnp.concatenate([jnp.zeros(1), since_end[:-1]])
    end = jnp.concatenate([jnp.asarray(intervals.end), origin + inserted])[order]
    start = jnp.concatenate([jnp.reshape(origin, (1,)), end[:-1]])
    no_index = np.full(count + len(index), -1)
    observation, jump, event = (
        jnp.concatenate([jnp.asarray(a), b])[order]
        for a, b in ((intervals.observation, no_index), (intervals.jump, no_index),
                     (intervals.event, jnp.append(no_index[:count], entries))))
    intervals = intervals_between(start, end, since_end - since, observation, jump, scale=scale, event=event)
    return grid._replace(intervals=intervals, lengths=None, observed=position[jnp.asarray(grid.observed)],
                         requested=position[jnp.asarray(grid.requested)], since=since)


def _order_at_equal_times(intervals: Intervals, events: EventTable, index: np.ndarray,
                          count: int) -> tuple[jax.Array, jax.Array]:
    """Return the event at the end of each interval, and its rank beside an observation, as keys of a sort.

    The intervals of the grid come first, then ``count`` that end at breakpoints, then those at the inserted events
    ``index``. Events of one rank keep the order of the model. A jump of the forces needs no rank, because it commutes
    with the events of the states.
    """
    event = jnp.concatenate([jnp.asarray(intervals.event), np.full(count, NO_EVENT), index])
    rank_of_event = np.append(np.where(events.observation_first, EVENT_AFTER, EVENT_BEFORE), OBSERVATION)
    return event, jnp.asarray(rank_of_event)[event]
