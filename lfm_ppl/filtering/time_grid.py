"""The time grid: the intervals of the scans, decided before compilation.

1. Subtract the initial time in float64 on the host, so that results do not depend on the origin of time.
2. End an interval at each observation, jump of a force, event, requested time and breakpoint of a known input. At equal
   times jumps of forces come first, then events before the observation, the observation, and all other events.
3. Divide an interval into as many steps as its length and the longest step need; a part between two breakpoints or
   requested times takes its share of the steps.
4. All intervals have the same number of steps, chosen to minimise the cost; a long part is several intervals.
5. Group the lengths of the intervals, up to their rounding, so that their transitions are tabulated.
6. Breakpoints and events at a traced lag are merged into the intervals by sorting, in the same order at equal times.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.division import OVERHEAD, OVERHEAD_OF_EXACT, Division, longest_step
from lfm_ppl.filtering.grid_layout import (
    BEFORE_JUMP,
    EVENT_AFTER,
    EVENT_BEFORE,
    JUMP,
    OBSERVATION,
    GridLayout,
    time_scale,
)
from lfm_ppl.filtering.intervals import TimeGrid, intervals_between
from lfm_ppl.model.events import EventTable, check_start, event_table
from lfm_ppl.model.inputs import InputRead, breakpoints_within
from lfm_ppl.model.state_space import StateSpaceModel, check_times
from lfm_ppl.utils import checks

_LARGEST_TABLE = 1024
"""Largest number of interval lengths whose transitions are tabulated."""

_REPLICATED = 0.2
"""Share of intervals of length zero above which a branch costs less than the predictions that it saves."""

LONGEST_FORECAST = 10_000
"""Largest number of intervals of a forecast, each as long as the usual distance of two observations."""


def build_time_grid(ssm: StateSpaceModel, times: Any, steps: int, max_step: float | None = None,
                    requested_times: Any = None, initial_time: Any = None, interval_per_step: bool = False,
                    tolerance: float | None = None) -> TimeGrid:
    """Return the intervals of the scan; arguments and errors as `lay_out_time_grid`."""
    layout, reads, events = lay_out_time_grid(ssm, times, steps, max_step, requested_times, initial_time,
                                              interval_per_step, tolerance)
    return layout.complete(reads, events)


def lay_out_time_grid(ssm: StateSpaceModel, times: Any, steps: int, max_step: float | None = None,
                      requested_times: Any = None, initial_time: Any = None, interval_per_step: bool = False,
                      tolerance: float | None = None) -> tuple[GridLayout, list[InputRead], EventTable]:
    """Lay out the intervals of the scan.

    Args:
        ssm: the model; its events, the jumps of its forces, and the jumps and kinks of its known inputs end intervals.
        times: (T,) observation times, non-decreasing.
        steps: integration steps between two consecutive times.
        max_step: longest step; a longer interval gets more steps, in intervals of ``steps`` each. None: see
            `longest_step`.
        requested_times: (K,), in any order; None: the observation times. Traced ones are for traced times; there are
            then ``steps`` integration steps between two consecutive ones of all times.
        initial_time: overrides that of the model (when the scan starts from a filter's state).
        interval_per_step: make every integration step an interval, for a particle smoother.
        tolerance: of the error of a step, see `TimeGrid`.

    Returns:
        The layout, the reads of the known inputs and the events. Where times or the initial time are traced, so is the
        layout.

    Raises:
        ValueError, TypeError: see `lfm_ppl.model.state_space.check_times`; non-positive steps or tolerance; a requested
            time or an event before the initial time; traced times where concrete ones are needed.
    """
    checks.positive_integer("steps", steps, "It is the number of integration steps between two times.")
    checks.refuse_dates("at", requested_times)
    if max_step is not None:
        checks.positive("max_step", max_step)
    if tolerance is not None:
        checks.positive("tolerance", tolerance)
    events = event_table(ssm.model.events)
    if initial_time is not None:
        events = events._replace(start=initial_time)
    initial_time = ssm.model.initial_time if initial_time is None else initial_time
    concrete_times = check_times(times, initial_time)
    start = concrete_times[0] if initial_time is None and concrete_times is not None else initial_time
    origin = None if start is None else checks.concrete(start)
    is_adaptive = tolerance is not None and not ssm.plan.has_exact_transition
    if concrete_times is None and _refuses_traced_times.get():
        raise ValueError("a time grid of traced times differs from that of their values.")
    if concrete_times is None or origin is None:
        division = Division(steps, max_step, interval_per_step, is_adaptive)
        layout, reads = _traced_layout(ssm, times, concrete_times, initial_time, requested_times, division, events)
    else:
        longest = max_step
        if max_step is None and not is_adaptive:
            longest = longest_step(ssm, concrete_times, float(origin), steps)
        division = Division(steps, longest, interval_per_step, is_adaptive)
        layout, reads = _concrete_layout(ssm, concrete_times, float(origin), requested_times, division, events)
    if tolerance is not None:
        layout = layout._replace(grid=layout.grid._replace(tolerance=float(tolerance)))
    return layout, reads, events


_refuses_traced_times: ContextVar[bool] = ContextVar("_refuses_traced_times", default=False)


@contextlib.contextmanager
def refuse_traced_times() -> Iterator[None]:
    """Raise ValueError for a grid of traced times within the context: it may have other steps than the values have."""
    token = _refuses_traced_times.set(True)
    try:
        yield
    finally:
        _refuses_traced_times.reset(token)


def _concrete_layout(ssm: StateSpaceModel, times: np.ndarray, origin: float, requested_times: Any,
                     division: Division, events: EventTable) -> tuple[GridLayout, list[InputRead]]:
    """Return the layout for times that are known before compilation, and the reads of known inputs."""
    requested = None if requested_times is None else checks.time_vector(
        "at", requested_times, origin, remedy="; set the model's initial_time earlier to look further back")
    end = float(times[-1] if requested is None else requested.max(initial=times[-1]))
    ssm.model.check_inputs(origin, end)
    reads = ssm.model.input_reads(origin, end)
    breakpoints, traced_breakpoints = breakpoints_within(reads, origin, end)
    scale = time_scale(reads)
    division = replace(
        division, breakpoints=breakpoints, traced_breakpoints=len(traced_breakpoints) + int(events.is_traced.sum()),
        scale=0.0 if checks.traced(scale) else scale,
        overhead=OVERHEAD_OF_EXACT if ssm.plan.has_exact_noise else OVERHEAD,
        is_exact=ssm.plan.has_exact_offset and division.max_step is None and not division.interval_per_step)
    check_start(events.times[~np.asarray(events.is_past(events.times))], origin)
    grid = _divide_times(times, origin, ssm.stack.jump_times, requested, division, events)
    is_lagged = tuple(checks.traced(read.breakpoints()) for read in reads)
    return GridLayout(grid, tuple(read.breakpoint_rows for read in reads), is_lagged,
                      tuple(events.is_traced.tolist())), reads


def _traced_layout(ssm: StateSpaceModel, times: Any, concrete_times: np.ndarray | None, initial_time: Any,
                   requested_times: Any, division: Division,
                   events: EventTable) -> tuple[GridLayout, list[InputRead]]:
    """Return the layout for times, or an initial time, that are traced: all breakpoints and events are inserted."""
    span = (0.0, 1.0) if concrete_times is None else (float(concrete_times[0]), float(concrete_times[-1]))
    reads = ssm.model.input_reads(*span)
    rows = tuple(read.breakpoint_rows for read in reads)
    division = replace(division, traced_breakpoints=sum(map(len, rows)) + len(events.times))
    jumps, steps = ssm.stack.jump_times, division.steps
    is_concrete_request = requested_times is not None and not checks.traced(requested_times)
    if concrete_times is not None and jumps and division.max_step is None and requested_times is None:
        grid = _grid_from_traced_origin(concrete_times, initial_time, jumps, steps, division.interval_per_step)
    else:
        if division.max_step is not None or is_concrete_request or jumps:
            raise ValueError("max_step, requested times and forces with jumps need times (the first two also an "
                             "initial_time or `start`) that are known before compilation; pass NumPy arrays rather "
                             "than traced values, and do not convert them with jnp inside the model.")
        part = division.steps_per_interval(np.full(np.shape(times)[0], steps))
        pieces = -(-steps // part)
        grid = (_grid_from_traced_times(times, pieces, part, initial_time) if requested_times is None
                else _grid_from_traced_request(times, pieces, part, initial_time, requested_times))
    return GridLayout(grid, rows, (True,) * len(rows), (True,) * len(events.times)), reads


def _grid_from_traced_request(times: Any, pieces: int, steps: int, initial_time: Any, requested_times: Any) -> TimeGrid:
    """Return ``pieces`` intervals of ``steps`` steps each between two observations or requested times."""
    count = np.shape(times)[0]
    nodes = jnp.concatenate([jnp.asarray(times, float), jnp.asarray(requested_times, float)])
    order = jnp.argsort(nodes, stable=True)  # an observation comes before a request of the same time
    grid = _grid_from_traced_times(nodes[order], pieces, steps, times[0] if initial_time is None else initial_time)
    node = jnp.asarray(grid.intervals.observation)
    observation = jnp.where((node >= 0) & (order[node] < count), order[node], -1)
    last = jnp.asarray(grid.observed)[jnp.argsort(order)]
    return grid._replace(intervals=grid.intervals._replace(observation=observation), observed=last[:count],
                         requested=last[count:], requested_times=nodes[count:])


def _grid_from_traced_times(times: Any, pieces: int, steps: int, initial_time: Any) -> TimeGrid:
    """Return ``pieces`` intervals of ``steps`` steps each between two times."""
    times = jnp.asarray(times, float)
    origin = times[:1] if initial_time is None else jnp.reshape(jnp.asarray(initial_time, float), (1,))
    start = jnp.concatenate([origin, times[:-1]])
    width = jnp.repeat((times - start) / pieces, pieces)
    offset = width * np.tile(np.arange(pieces), times.shape[0])
    since = jnp.repeat(start - origin, pieces) + offset
    start = jnp.repeat(start, pieces) + offset
    end = jnp.concatenate([start[1:], times[-1:]])
    observation = np.full(times.shape[0] * pieces, -1)
    last = np.arange(times.shape[0]) * pieces + pieces - 1
    observation[last] = np.arange(times.shape[0])
    intervals = intervals_between(start, end, width, observation, np.full(observation.shape, -1))
    return TimeGrid(intervals, None, last, last, times, steps, origin[0], since=since)


def _grid_from_traced_origin(times: np.ndarray, origin: Any, jumps: tuple[float, ...], steps: int,
                             interval_per_step: bool) -> TimeGrid:
    """Return the intervals for concrete times and forces that jump, from a traced initial time.

    Every jump up to the last time has an interval. Those at or before the initial time have length zero and do not
    jump.
    """
    if interval_per_step:
        raise ValueError("an interval for each step, with forces that jump, needs an initial_time that is known before "
                         "compilation.")
    origin = jnp.asarray(origin, float)
    indices = [index for index, jump in enumerate(jumps) if jump <= times[-1]]
    time = np.concatenate([np.asarray(jumps, float)[indices], times])
    jump = np.concatenate([indices, np.full(len(times), -1)]).astype(int)
    observation = np.concatenate([np.full(len(indices), -1), np.arange(len(times))])
    # At equal times a jump comes before an observation.
    order = np.lexsort((observation, time))
    time, jump, observation = time[order], jump[order], observation[order]
    end = jnp.where(jump >= 0, jnp.maximum(time, origin), time)
    begin = jnp.concatenate([origin[None], jnp.maximum(end[:-1], origin)])
    intervals = intervals_between(begin, end, end - begin, observation, jnp.where(time > origin, jump, -1))
    observed = np.flatnonzero(observation >= 0)
    return TimeGrid(intervals, None, observed, observed, times, steps, origin, since=begin - origin)


def _divide_times(times: np.ndarray, origin: float, jumps: tuple[float, ...], requested_times: np.ndarray | None,
                  division: Division, events: EventTable) -> TimeGrid:
    """Return the intervals between concrete times.

    1. An interval ends at each observation, at each event, and at each jump of a force after the initial time.
    2. Breakpoints of known inputs and requested times divide these intervals, and their steps with them.
    3. Each part gets as many intervals of equal length as its steps need.
    """
    requested = times if requested_times is None else requested_times
    extra = np.setdiff1d(requested, times)
    end = max(times[-1], requested.max(initial=-np.inf))
    jump_index = [index for index, jump in enumerate(jumps) if origin < jump <= end]
    jump_time = np.asarray(jumps, float)[jump_index]
    extra = np.setdiff1d(extra, jump_time)
    # A particle smoother looks at each step: a jump has an interval of its own, so that the state just before it is a
    # node.
    before_jump = jump_time if division.interval_per_step else jump_time[:0]
    is_past = np.asarray(events.is_past(events.times))
    event_index = np.flatnonzero((events.times <= end) & ~is_past)
    event_rank = np.where(events.observation_first[event_index], EVENT_AFTER, EVENT_BEFORE)
    time = np.concatenate([before_jump, jump_time, times, events.times[event_index]])
    rank = np.append(np.repeat([BEFORE_JUMP, JUMP, OBSERVATION], [len(before_jump), len(jump_time), len(times)]),
                     event_rank)
    observation, jump, event = (np.full(len(time), -1) for _ in range(3))
    observation[rank == OBSERVATION] = np.arange(len(times))
    jump[rank == JUMP] = jump_index
    event[len(time) - len(event_index):] = event_index
    order = np.lexsort((observation, rank, time))
    time, rank, observation, jump, event = (a[order] for a in (time, rank, observation, jump, event))
    whole_lengths = np.diff(time, prepend=origin)
    separate = _separate_breakpoints(division.breakpoints, np.sort(np.concatenate([[origin], time, extra])),
                                     division.scale)
    cut = np.union1d(separate, extra)
    cuts = np.zeros(len(time), int)
    if len(cut):
        index = np.searchsorted(time, cut)
        cuts = np.bincount(index, minlength=len(time) + 1)
        # After the last observation a whole interval is as long as the usual distance of two observations.
        whole_lengths = np.append(whole_lengths, _forecast_interval(times, float(cut[-1] - time[-1])))
        time, rank, observation, jump, event, whole_lengths, cuts = (np.insert(a, index, b) for a, b in (
            (time, cut), (rank, OBSERVATION), (observation, -1), (jump, -1), (event, -1),
            (whole_lengths, whole_lengths[index]), (cuts, cuts[index])))
        whole_lengths, cuts = whole_lengths[:len(time)], cuts[:len(time)]
    begin = np.append(origin, time[:-1])
    length = time - begin
    count = division.steps_needed(length, whole_lengths, cuts)
    steps = division.steps_per_interval(count)
    pieces = np.where((length > 0) | (not division.interval_per_step), -(-count // steps), 1)
    node = np.repeat(np.arange(len(time)), pieces)
    piece = np.arange(len(node)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    width = (length / pieces)[node]
    last = piece == pieces[node] - 1
    lengths, length_index = _group_lengths(width)
    start = begin[node] + piece * width
    end = np.where(last, time[node], np.append(start[1:], time[-1]))
    observation_at_end, jump_at_end, event_at_end = (np.where(last, a[node], -1) for a in (observation, jump, event))
    intervals = intervals_between(start, end, width, observation_at_end, jump_at_end, length_index, division.scale,
                                  event_at_end)
    row_of_node = np.flatnonzero(last)
    observed = np.empty(len(times), int)
    observed[observation[observation >= 0]] = row_of_node[observation >= 0]
    interval = observed
    if requested_times is not None:
        candidates = np.flatnonzero(rank < EVENT_AFTER)
        interval = row_of_node[candidates[np.searchsorted(time[candidates], requested, side="right") - 1]]
    replicated = bool(np.mean(width == 0) >= _REPLICATED)
    return TimeGrid(intervals, lengths, observed, interval, requested, steps, np.asarray(origin), replicated,
                    since=(begin - origin)[node] + piece * width)


def _forecast_interval(times: np.ndarray, length: float) -> float:
    """Return the length of an interval after the last observation, for a forecast over ``length``."""
    gaps = np.diff(times)
    usual = float(np.median(gaps[gaps > 0])) if np.any(gaps > 0) else length
    return max(usual, length / LONGEST_FORECAST)


def _separate_breakpoints(breakpoints: np.ndarray, times: np.ndarray, scale: Any) -> np.ndarray:
    """Return the breakpoints that differ from all times and from each other by more than rounding."""
    if not len(breakpoints):
        return breakpoints
    concrete_scale = checks.concrete(scale)
    # The rounding of t + lag, and no more: at unix times a short pulse has a width of some units of rounding.
    rounding = np.finfo(float).eps * max(np.abs(times).max(), 0.0 if concrete_scale is None else float(concrete_scale))
    right = np.searchsorted(times, breakpoints).clip(1, len(times) - 1)
    is_time = np.minimum(np.abs(times[right] - breakpoints), np.abs(times[right - 1] - breakpoints)) <= rounding
    separate = breakpoints[~is_time]
    return separate[np.diff(separate, prepend=-np.inf) > rounding]


def _group_lengths(length: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
    """Group lengths that agree to their own rounding, whatever the size of the times.

    Each is compared with the shortest of its group, so that a chain of neighbours is no group. Regular times whose
    differences are rounded have few distinct lengths, as many as the digits that rounding takes from them.
    """
    values, position = np.unique(length, return_inverse=True)
    following = np.searchsorted(values, values * (1.0 + 8 * np.finfo(float).eps), side="right")
    firsts = []
    index = 0
    while index < len(values):
        firsts.append(index)
        index = int(following[index])
        if len(firsts) > _LARGEST_TABLE:
            return None, np.zeros(len(length), int)
    return values[firsts], (np.searchsorted(firsts, position, side="right") - 1).reshape(-1)


