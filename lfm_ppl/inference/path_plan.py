"""The times of paths: requested times, times between them, and the times of the data.

1. Where a path is simulated beyond the data, or known inputs of a linear model are integrated there, rows after the
   data are at most as far apart as the data usually are.
2. The number of steps of a row follows from the longest row: none is longer than a step between the observations
   there, and than the longest step of the fit, divided as simulations divide steps.
3. Series of a panel that have their own times have rows of their own, padded to a common number.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import numpy as np

from lfm_ppl.filtering.division import longest_step
from lfm_ppl.filtering.time_grid import LONGEST_FORECAST, build_time_grid
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.likelihoods.marginal_likelihood import SIMULATION_STEPS
from lfm_ppl.likelihoods.series_likelihood import SeriesLikelihood
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.utils import checks

_MOST_STEPS_OF_ROW = 100
"""Largest number of steps of a row, as a multiple of those between two observations."""

_ADAPTIVE_FACTOR = 5
"""Largest number of adaptive steps, as a multiple of the number of equal steps."""


@dataclass(frozen=True)
class PathPlan:
    """Times of the paths.

    Attributes:
        times: (L,), requested times, times between them, and times of the data, or (B, L) where series have their own;
            None: the times of the data.
        requested: (K,), rows of the requested times.
        data: (T,), rows of the data.
        steps: steps of the simulation in each row.
        smoother_steps: steps of the smoother between two times of a series with its own times; None: the model's.
    """

    times: np.ndarray | None
    requested: np.ndarray
    data: np.ndarray
    steps: int
    smoother_steps: int | None = None

    @property
    def is_of_series(self) -> bool:
        """Whether each series has times of its own."""
        return self.times is not None and self.times.ndim == 2

    @property
    def rows(self) -> int:
        """Number of times."""
        return len(self.data) if self.times is None else self.times.shape[-1]


def plan_paths(bound: BoundModel, requested_times: np.ndarray | None, simulated: bool, since: np.ndarray) -> PathPlan:
    """Return the rows, of which rows after ``since`` are simulated, if any are.

    After the data, rows are at most as far apart as the data usually are where a simulation or the known inputs of a
    linear model are integrated.

    Args:
        bound: the model and its data.
        requested_times: (K,), or (B, K) for each series; None: the times of the data.
        simulated: whether paths are simulated.
        since: time, or times (B,) where series have their own.
    """
    if requested_times is None or bound.times.ndim == 1:
        return _plan_of(bound.site.example, bound.times, requested_times, simulated, float(np.min(since)))
    requested_times = np.broadcast_to(requested_times, (len(bound.times), requested_times.shape[-1]))
    members = bound.site.members
    plans = [_plan_of(series, times, requested, simulated, float(start))
             for series, times, requested, start in zip(members, bound.times, requested_times, since, strict=True)]
    length = max(plan.rows for plan in plans)
    count, data = requested_times.shape[1], plans[0].data.size
    # The first requested time pads the times between requested ones, of which series have different numbers.
    rows = [np.insert(times, count, np.repeat(times[0], length - len(times)))
            for times in (plan.times for plan in plans) if times is not None]
    smoother_steps = [_steps_per_interval(series.ssm, times, row, series.settings.integration_steps)
                      for series, times, row in zip(members, bound.times, rows, strict=True)]
    return PathPlan(np.array(rows), plans[0].requested, np.arange(length - data, length),
                 max(plan.steps for plan in plans), max(smoother_steps))


def _plan_of(series: SeriesLikelihood, times: np.ndarray, requested_times: np.ndarray | None, simulated: bool,
             since: float) -> PathPlan:
    """Return the rows of a series, or of all series with common times; arguments as in `plan_paths`."""
    gaps = np.diff(times, axis=-1)
    base = series.settings.steps
    if series.settings.max_step is not None:
        base = max(base, int(np.ceil(gaps.max(initial=0.0) / series.settings.max_step * (1 - 1e-12))))
    factor = SIMULATION_STEPS * (1 if series.settings.tolerance is None else _ADAPTIVE_FACTOR)
    fine = factor * base
    longest = _longest_step(series, times) / factor
    rows = np.arange(times.shape[-1])
    if requested_times is None:
        steps = max(_steps_per_interval(series.ssm, row, row, fine, since, longest)
                    for row in np.atleast_2d(times)) if simulated else fine
        return PathPlan(None, rows, rows, steps)
    beyond = np.array([])
    needs_steps = simulated or not series.ssm.plan.has_exact_offset or len(series.ssms) > 1
    if needs_steps and requested_times.max() > times[-1] and (gaps > 0).any():
        gap = np.median(gaps[gaps > 0])
        count = min(int(np.ceil((requested_times.max() - times[-1]) / gap * (1 - 1e-12))), LONGEST_FORECAST)
        beyond = np.linspace(times[-1], requested_times.max(), count + 1)[1:-1]
    path_times = np.concatenate([requested_times, beyond])
    steps = _steps_per_interval(series.ssm, times, path_times, fine, since, longest) if simulated else fine
    first = len(path_times)
    return PathPlan(np.concatenate([path_times, times]), np.arange(len(requested_times)), first + rows, steps)


def has_forecast(bound: BoundModel, requested_times: np.ndarray | None) -> bool:
    """Return whether a time of the trajectories lies after the last observation of a series."""
    is_observed = np.isfinite(np.asarray(bound.y)).any(axis=-1)
    if requested_times is not None and np.any(requested_times > bound.times[..., -1:]):
        return True
    return not bool(np.all(is_observed[..., -1]))


def first_simulated_times(bound: BoundModel) -> np.ndarray:
    """Return the time of the last observation of each series."""
    is_observed = np.isfinite(np.asarray(bound.y)).any(axis=-1)
    return np.where(is_observed, bound.times, -np.inf).max(axis=-1)


def _steps_per_interval(ssm: StateSpaceModel, times: Any, requested_times: Any, steps: int,
                        since: float = -np.inf, longest: float = np.inf) -> int:
    """Return the number of steps of rows after ``since`` with which no step is longer than between two observations.

    Nor is it longer than ``longest``, up to a number of steps.
    """
    concrete_times = checks.concrete(times)
    if requested_times is None or concrete_times is None:
        return steps
    grid = build_time_grid(ssm, concrete_times, 1, sys.float_info.max, requested_times)
    if checks.traced(grid.since):  # breakpoints of a known input that are read at a lag
        return steps
    rows, origin = grid.intervals, np.asarray(grid.initial_time)
    # Counted from the initial time, so that the origin of time does not matter.
    end, first = grid.since + rows.length, since - origin
    marks = np.unique(np.append(concrete_times - origin, 0.0))
    if len(marks) == 1:
        return steps
    gaps = np.diff(marks)
    # A row after the last observation is compared with the usual distance between two observations.
    index = np.searchsorted(marks, end - 1e-12 * np.abs(end), side="left") - 1
    gap = np.where(index < len(gaps), gaps[np.clip(index, 0, len(gaps) - 1)], np.median(gaps))
    step_count = (rows.length / np.minimum(gap / steps, longest))[end > first].max(initial=0.0)
    return max(1, int(np.ceil(min(float(step_count), _MOST_STEPS_OF_ROW * steps) - 1e-9)))


def _longest_step(series: SeriesLikelihood, times: np.ndarray) -> float:
    """Return the longest step of the fit of a series."""
    if series.settings.max_step is not None:
        return series.settings.max_step
    origin = series.model.initial_time
    first = np.atleast_2d(times)[0]
    start = first[0] if origin is None or checks.traced(origin) else float(origin)
    longest = longest_step(series.ssm, first, start, series.settings.steps)
    return np.inf if longest is None else longest
