"""From times to the intervals of the one forward scan, decided before compilation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.model.inputs import InputRead, breakpoints_within
from lfm_ppl.model.state_space import Span, StateSpaceModel, check_times, inset

_LARGEST_TABLE = 1024
"""Most interval lengths whose transitions are tabulated ahead of the scan; more are computed interval by interval."""

_OVERHEAD, _OVERHEAD_OF_EXACT = 2.0, 10.0
"""What an interval costs besides its steps, in steps; those of an exact model integrate known inputs alone."""

_STEPS_OF_PULSE = 4
"""Steps over a short part of an interval, where breakpoints are few."""

_REPLICATED = 0.2
"""Share of intervals of length zero from which a branch costs less than the predictions that it saves."""

LONGEST_FORECAST = 10_000
"""Largest number of intervals of a forecast, each as long as the usual distance of two observations."""

_MOST_STEPS = 20.0
"""Steps, as a multiple of those without a longest step, that the default of the longest step adds at most."""


class Intervals(NamedTuple):
    """The intervals of the scan, one entry each: a prediction, perhaps a jump, perhaps an observation.

    Attributes:
        start: (N,) time at which the interval starts.
        length: (N,) its length, >= 0.
        observation: (N,) index of the observation at its end, -1 where there is none.
        jump: (N,) index of the jump of the forces at its end, before the observation; -1 where there is none.
        length_index: (N,) index of its length in `TimeGrid.lengths`; zero where that is None.
        end: (N,) time at which the interval ends; that of its observation to the last digit.
        inset: (N,) how far inside of the interval functions of time are evaluated at its ends, see `Span`.
    """

    start: Any
    length: Any
    observation: Any
    jump: Any
    length_index: Any
    end: Any
    inset: Any

    @property
    def span(self) -> Span:
        """The times of one interval as functions of time see them."""
        return Span(self.start, self.start + self.inset, self.end - self.inset)


def intervals_between(start: Any, end: Any, length: Any, observation: Any, jump: Any, length_index: Any = None,
                      scale: Any = 0.0) -> Intervals:
    """Return intervals; arguments as in `Intervals`, and ``scale`` as in `lfm_ppl.model.state_space.inset`."""
    length_index = np.zeros(np.shape(length), int) if length_index is None else length_index
    return Intervals(start, length, observation, jump, length_index, end, inset(start, end, length, scale))


class TimeGrid(NamedTuple):
    """The intervals, and where results are found among them.

    Attributes:
        intervals: the scan's intervals.
        lengths: (U,) distinct lengths, None where there are too many or they are traced.
        observed: (T,) interval of each observation.
        requested: (K,) interval of each requested time.
        requested_times: (K,).
        steps: integration steps in each interval.
        initial_time: when the scan starts.
        replicated: whether so many intervals have length zero that it pays to branch around their prediction.
        tolerance: of the error of a step, in standard deviations, where their length follows it; None for ``steps``
            of equal length.
        since: (N,) starts of the intervals, counted from the initial time. Differences of times that are close keep
            all their digits, which sums of large times do not.
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
    since: Any = None


def build_time_grid(ssm: StateSpaceModel, times: Any, steps: int, max_step: float | None = None, at: Any = None,
                    initial_time: Any = None, interval_per_step: bool = False,
                    tolerance: float | None = None, until: float | None = None) -> TimeGrid:
    """Lay out the intervals of the scan.

    Args:
        ssm: the model; the jumps of its forces, and the jumps and kinks of its known inputs, end intervals.
        times: (T,) observation times, non-decreasing.
        steps: integration steps between two consecutive times.
        max_step: longest step; a longer interval gets more steps, in intervals of ``steps`` each. None: see
            `longest_step`.
        at: (K,) further times at which the state is wanted, in any order.
        initial_time: overrides the model's (when the scan starts from a filter's state).
        interval_per_step: give every integration step an interval of its own, so that a particle smoother reaches each.
        tolerance: of the error of a step, see `TimeGrid`.
        until: up to which time known inputs have to reach; None: the last of all times.

    Raises:
        ValueError, TypeError: see `lfm_ppl.model.state_space.check_times`; non-positive steps or tolerance; a requested
            time before the initial time; traced times together with what needs them concrete.
    """
    checks.positive_integer("steps", steps, "It is the number of integration steps between two times.")
    checks.refuse_dates("at", at)
    if max_step is not None:
        checks.positive("max_step", max_step)
    if tolerance is not None:
        checks.positive("tolerance", tolerance)
    grid = _laid_out(ssm, times, steps, max_step, at, initial_time, interval_per_step, until, tolerance is not None)
    return grid if tolerance is None else grid._replace(tolerance=float(tolerance))


def _laid_out(ssm: StateSpaceModel, times: Any, steps: int, max_step: float | None, at: Any, initial_time: Any,
              interval_per_step: bool, until: float | None, adaptive: bool) -> TimeGrid:
    """Return the time grid of `build_time_grid`; the length of ``adaptive`` steps follows the moments."""
    initial_time = ssm.model.initial_time if initial_time is None else initial_time
    known = check_times(times, initial_time)
    start = known[0] if initial_time is None and known is not None else initial_time
    origin = None if start is None else checks.concrete(start)
    if known is not None and origin is not None:
        requested = None if at is None else checks.concrete(at)
        last = known[-1] if requested is None else max(known[-1], requested.max(initial=known[-1]))
        ssm.model.check_inputs(float(origin), float(last if until is None else until))
    if known is None or origin is None:
        reads = ssm.model.input_reads(*(0.0, 1.0) if known is None else (float(known[0]), float(known[-1])))
        jumps = ssm.stack.jump_times
        moving = jnp.concatenate([jnp.zeros(0), *(jnp.asarray(read.breakpoints(), float) for read in reads)])
        cutting = Cutting(steps, None, interval_per_step, np.zeros(0), len(moving), _OVERHEAD, adaptive, False,
                          _scale(reads))
        if known is not None and jumps and max_step is None and at is None:
            grid = _traced_origin(known, start, jumps, steps, interval_per_step)
        else:
            part = cutting.steps_per_interval(np.full(np.shape(times)[0], steps))
            grid = _traced(ssm, times, -(-steps // part), part, max_step, at, initial_time)
        row = grid.intervals
        grid = grid._replace(intervals=row._replace(inset=inset(row.start, row.end, row.length, cutting.scale)))
        return _divided(grid, moving, cutting.scale)
    end = float(known[-1] if at is None else _requested(at, float(origin)).max(initial=known[-1]))
    reads = ssm.model.input_reads(float(origin), end)
    breakpoints, moving = breakpoints_within(reads, float(origin), end)
    longest = longest_step(ssm, known, float(origin), steps) if max_step is None and not adaptive else max_step
    overhead = _OVERHEAD_OF_EXACT if ssm.time_invariant else _OVERHEAD
    is_exact = ssm.mean_invariant and longest is None and not interval_per_step
    cutting = Cutting(steps, longest, interval_per_step, breakpoints, len(moving), overhead, adaptive, is_exact,
                      _scale(reads))
    return _divided(_concrete(known, float(origin), ssm.stack.jump_times, at, cutting), moving, _scale(reads))


class Cutting(NamedTuple):
    """How the time between two observations is cut into intervals.

    Attributes:
        steps: integration steps between two consecutive times.
        max_step: longest step; None: any.
        interval_per_step: give every step an interval of its own.
        breakpoints: times at which known inputs jump or have a kink.
        moving: number of such times that are traced.
        overhead: cost of an interval besides its steps, in steps.
        adaptive: whether the length of steps follows the moments.
        is_exact: whether the transition over any interval is exact, so that one interval needs no steps.
        scale: see `lfm_ppl.model.state_space.inset`.
    """

    steps: int
    max_step: float | None
    interval_per_step: bool
    breakpoints: np.ndarray
    moving: int
    overhead: float
    adaptive: bool
    is_exact: bool
    scale: Any

    def steps_of(self, gap: np.ndarray, base: np.ndarray, cuts: np.ndarray) -> np.ndarray:
        """Return how many steps intervals (N,) take at least.

        An interval between two breakpoints or requested times takes its share of the steps of the whole interval.

        Args:
            gap: (N,) lengths of the intervals.
            base: (N,) lengths of the intervals between observations that they are parts of.
            cuts: (N,) numbers of breakpoints and requested times in these.
        """
        if self.is_exact:
            return np.full(len(gap), self.steps)
        pieces = np.ones(len(gap), int)
        if self.max_step is not None:
            pieces = np.maximum(1, np.ceil(base / (self.max_step * self.steps) * (1 - 1e-12)).astype(int))
        share = gap / np.where(base > 0, base, 1.0)
        # A short pulse moves the state far; it takes more than one step where few breakpoints make that cheap.
        least = np.clip(self.steps // (cuts + 1), 1, _STEPS_OF_PULSE)
        partial = np.maximum(least, np.ceil(share * pieces * self.steps * (1 - 1e-9)).astype(int))
        return np.where(cuts > 0, partial, pieces * self.steps)

    def steps_per_interval(self, count: np.ndarray) -> int:
        """Return the number of steps of each interval at which intervals that need ``count`` (N,) steps cost least."""
        if self.interval_per_step:
            return 1
        if self.adaptive or self.is_exact or not (self.moving or np.any(count % self.steps)):
            return self.steps
        cost = [(np.ceil(count / steps).sum() + self.moving) * (steps + self.overhead)
                for steps in range(1, self.steps + 1)]
        return int(np.argmin(cost)) + 1


def _scale(reads: Sequence[InputRead]) -> Any:
    """Return the size of the numbers that inputs compare times with."""
    sizes = [read.scale for read in reads]
    return sum(sizes) if sizes else 0.0


def _divided(grid: TimeGrid, breakpoints: Any, scale: Any) -> TimeGrid:
    """Return a time grid whose intervals end at traced breakpoints (K,), too.

    Their number is that of all breakpoints, wherever they lie: those outside of the grid's times end intervals of
    length zero. The sorted times are continuous in the breakpoints, and differentiable but where two meet.
    """
    if not np.shape(breakpoints)[0]:
        return grid
    row, origin = grid.intervals, jnp.asarray(grid.initial_time, float)
    ends = jnp.append(jnp.asarray(grid.since)[1:], jnp.asarray(grid.since)[-1] + row.length[-1])
    within = jnp.clip(breakpoints - origin, 0.0, ends[-1])
    every = jnp.concatenate([ends, within])
    order = jnp.argsort(jax.lax.stop_gradient(every), stable=True)
    position = jnp.argsort(order)
    since_end = every[order]
    since = jnp.concatenate([jnp.zeros(1), since_end[:-1]])
    end = jnp.concatenate([jnp.asarray(row.end), origin + within])[order]
    start = jnp.concatenate([jnp.reshape(origin, (1,)), end[:-1]])
    nothing = np.full(np.shape(breakpoints)[0], -1)
    observation, jump = (jnp.concatenate([jnp.asarray(a), nothing])[order] for a in (row.observation, row.jump))
    intervals = intervals_between(start, end, since_end - since, observation, jump, scale=scale)
    return grid._replace(intervals=intervals, lengths=None, observed=position[jnp.asarray(grid.observed)],
                         requested=position[jnp.asarray(grid.requested)], since=since)


def longest_step(ssm: StateSpaceModel, times: Any, origin: Any, steps: int) -> float | None:
    """Return the default longest step, twice the median step; None for an exact model, and for traced times.

    The number of steps is the same between any two times, so that a gap in the data would be crossed in steps that are
    too long for a force or for the dynamics. In bursts of readings with long pauses the median is that of the bursts:
    the limit is at least a twentieth of the mean step, so that the number of steps stays within about twenty times.

    Args:
        ssm: the model.
        times: (T,) observation times.
        origin: the initial time; the gap from there to the first observation counts as well.
        steps: integration steps between two consecutive times.
    """
    if ssm.mean_invariant or checks.traced((times, origin)):
        return None
    gaps = np.diff(np.asarray(times, float), prepend=float(origin))
    gaps = gaps[gaps > 0]
    if not gaps.size:
        return None
    return max(2.0 * float(np.median(gaps)), float(np.mean(gaps)) / _MOST_STEPS) / steps


def _traced(ssm: StateSpaceModel, times: Any, pieces: int, steps: int, max_step: Any, at: Any,
            initial_time: Any) -> TimeGrid:
    """Lay out ``pieces`` intervals of ``steps`` each between two times."""
    if max_step is not None or at is not None or ssm.stack.jump_times:
        raise ValueError("max_step, requested times and forces with jumps need times (the first two also an "
                         "initial_time or `start`) that are known before compilation; pass NumPy arrays rather than "
                         "traced values, and do not convert them with jnp inside the model.")
    times = jnp.asarray(times, float)
    origin = times[:1] if initial_time is None else jnp.reshape(jnp.asarray(initial_time, float), (1,))
    start = jnp.concatenate([origin, times[:-1]])
    width = jnp.repeat((times - start) / pieces, pieces)
    before = width * np.tile(np.arange(pieces), times.shape[0])
    since = jnp.repeat(start - origin, pieces) + before
    start = jnp.repeat(start, pieces) + before
    end = jnp.concatenate([start[1:], times[-1:]])
    observation = np.full(times.shape[0] * pieces, -1)
    ends = np.arange(times.shape[0]) * pieces + pieces - 1
    observation[ends] = np.arange(times.shape[0])
    intervals = intervals_between(start, end, width, observation, np.full(observation.shape, -1))
    return TimeGrid(intervals, None, ends, ends, times, steps, origin[0], since=since)


def _traced_origin(times: np.ndarray, origin: Any, jumps: tuple[float, ...], steps: int,
                   interval_per_step: bool) -> TimeGrid:
    """Lay out the intervals for times that are known and forces that jump, where the initial time is not known.

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


def _concrete(times: np.ndarray, origin: float, jumps: tuple[float, ...], at: Any, cutting: Cutting) -> TimeGrid:
    """Lay out the intervals for times that are known before compilation.

    1. An interval ends at each observation and at each jump of a force after the initial time.
    2. Breakpoints of known inputs and requested times divide these intervals, and their steps with them.
    3. Each part gets as many intervals of equal length as its steps need.
    """
    requested = times if at is None else _requested(at, origin)
    extra = np.setdiff1d(requested, times)
    end = max(times[-1], requested.max(initial=-np.inf))
    jump_index = [index for index, jump in enumerate(jumps) if origin < jump <= end]
    jump_time = np.asarray(jumps, float)[jump_index]
    extra = np.setdiff1d(extra, jump_time)
    # A particle smoother looks at each step: a jump has an interval of its own, so that the state just before it is a
    # node.
    before_jump = jump_time if cutting.interval_per_step else jump_time[:0]
    time = np.concatenate([before_jump, jump_time, times])
    # At equal times a jump comes before an observation.
    rank = np.repeat([0, 1, 2], [len(before_jump), len(jump_time), len(times)])
    observation = np.full(len(time), -1)
    observation[rank == 2] = np.arange(len(times))
    jump = np.full(len(time), -1)
    jump[rank == 1] = jump_index
    order = np.lexsort((observation, rank, time))
    time, observation, jump = time[order], observation[order], jump[order]
    base = np.diff(time, prepend=origin)
    apart = _apart(cutting.breakpoints, np.sort(np.concatenate([[origin], time, extra])), cutting.scale)
    cut = np.union1d(apart, extra)
    cuts = np.zeros(len(time), int)
    if len(cut):
        place = np.searchsorted(time, cut)
        cuts = np.bincount(place, minlength=len(time) + 1)
        # Beyond the last interval a whole one is as long as the usual distance of two observations.
        base = np.append(base, _forecast_interval(times, float(cut[-1] - time[-1])))
        time, observation, jump, base, cuts = (np.insert(a, place, b) for a, b in (
            (time, cut), (observation, -1), (jump, -1), (base, base[place]), (cuts, cuts[place])))
        base, cuts = base[:len(time)], cuts[:len(time)]
    begin = np.append(origin, time[:-1])
    gap = time - begin
    count = cutting.steps_of(gap, base, cuts)
    steps = cutting.steps_per_interval(count)
    pieces = np.where((gap > 0) | (not cutting.interval_per_step), -(-count // steps), 1)
    event = np.repeat(np.arange(len(time)), pieces)
    piece = np.arange(len(event)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    width = (gap / pieces)[event]
    last = piece == pieces[event] - 1
    lengths, length_index = _distinct(width)
    start = begin[event] + piece * width
    end = np.where(last, time[event], np.append(start[1:], time[-1]))
    intervals = intervals_between(start, end, width, np.where(last, observation[event], -1),
                                  np.where(last, jump[event], -1), length_index, cutting.scale)
    row_of_event = np.flatnonzero(last)
    observed = np.empty(len(times), int)
    observed[observation[observation >= 0]] = row_of_event[observation >= 0]
    interval = observed if at is None else row_of_event[np.searchsorted(time, requested, side="right") - 1]
    replicated = bool(np.mean(width == 0) >= _REPLICATED)
    return TimeGrid(intervals, lengths, observed, interval, requested, steps, np.asarray(origin), replicated,
                    since=(begin - origin)[event] + piece * width)


def _forecast_interval(times: np.ndarray, length: float) -> float:
    """Return the length of an interval after the last observation, for a forecast over ``length``."""
    gaps = np.diff(times)
    usual = float(np.median(gaps[gaps > 0])) if np.any(gaps > 0) else length
    return max(usual, length / LONGEST_FORECAST)


def _apart(breakpoints: np.ndarray, times: np.ndarray, scale: Any) -> np.ndarray:
    """Return the breakpoints that are not a time, or another breakpoint, up to rounding."""
    if not len(breakpoints):
        return breakpoints
    known = checks.concrete(scale)
    # No more than that of t + lag: at unix times a short pulse has a width of some units of rounding.
    rounding = np.finfo(float).eps * max(np.abs(times).max(), 0.0 if known is None else float(known))
    after = np.searchsorted(times, breakpoints).clip(1, len(times) - 1)
    near = np.minimum(np.abs(times[after] - breakpoints), np.abs(times[after - 1] - breakpoints)) <= rounding
    apart = breakpoints[~near]
    return apart[np.diff(apart, prepend=-np.inf) > rounding]


def _requested(at: Any, origin: float) -> np.ndarray:
    return checks.time_vector("at", at, origin, remedy="; set the model's initial_time earlier to look further back")


def _distinct(length: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
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


def as_arrays(intervals: Intervals) -> Intervals:
    """Return the intervals as JAX arrays, which a scan can run over."""
    return jax.tree_util.tree_map(jnp.asarray, intervals)


class _Table:
    """A function of the interval length, tabulated: all arrays that it returns make one row for each length.

    The interval is read, and in reverse mode written, at once; array by array that took many more operations to
    compile.

    Args:
        function: of a length, a scalar, to a pytree of arrays.
        lengths: (U,).
    """

    def __init__(self, function: Callable[[jax.Array], Any], lengths: jax.Array) -> None:
        leaves, self._tree = jax.tree_util.tree_flatten(jax.vmap(function)(lengths))
        self._shapes = [leaf.shape[1:] for leaf in leaves]
        self._rows = jnp.concatenate([leaf.reshape(len(lengths), -1) for leaf in leaves], axis=1) if leaves else None

    def at(self, index: jax.Array) -> Any:
        """Return what the function gave at one of the lengths."""
        if self._rows is None:
            return jax.tree_util.tree_unflatten(self._tree, [])
        row = jax.lax.dynamic_index_in_dim(self._rows, index, keepdims=False)
        parts = jnp.split(row, np.cumsum([math.prod(shape) for shape in self._shapes])[:-1])
        return jax.tree_util.tree_unflatten(
            self._tree, [part.reshape(shape) for part, shape in zip(parts, self._shapes, strict=True)])


def by_length(grid: TimeGrid, make: Callable[[jax.Array], Any]) -> Callable[[Intervals], Any]:
    """Return what gives ``make(length)`` of an interval, computed once for each distinct length where these are few."""
    if grid.lengths is None:
        return lambda row: make(row.length)
    table = _Table(make, jnp.asarray(grid.lengths))
    return lambda row: table.at(row.length_index)


def with_observations(intervals: Intervals, y: Any) -> tuple[Intervals, jax.Array]:
    """Return the intervals as JAX arrays, and the entry of ``y`` (T, ...) at the end of each, NaN where it has none."""
    y = jnp.asarray(y, float)
    # The index -1 of an interval without an observation is that of the last entry.
    padded = jnp.concatenate([y, jnp.full((1, *y.shape[1:]), jnp.nan)])
    intervals = as_arrays(intervals)
    return intervals, padded[intervals.observation]
