"""The number of integration steps between two observations, and their division into intervals."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.utils import checks

OVERHEAD, OVERHEAD_OF_EXACT = 2.0, 10.0
"""Cost of an interval besides its steps, in steps; steps of an exact model integrate known inputs only."""

_STEPS_OF_PULSE = 4
"""Number of steps over a short part of an interval with few breakpoints."""

_MOST_STEPS = 20.0
"""Bound on the number of steps with the default longest step, as a multiple of the number without one."""


@dataclass(frozen=True)
class Division:
    """How the time between two observations is divided into intervals.

    Attributes:
        steps: integration steps between two consecutive times.
        max_step: longest step; None: any.
        interval_per_step: whether every step is an interval.
        is_adaptive: whether the length of steps follows the moments.
        breakpoints: times at which known inputs jump or have a kink.
        traced_breakpoints: number of such times, and of events, that are traced.
        overhead: cost of an interval besides its steps, in steps.
        is_exact: whether the transition over any interval is exact, so that an interval needs no steps.
        scale: see `lfm_ppl.model.state_space.inset`.
    """

    steps: int
    max_step: float | None
    interval_per_step: bool
    is_adaptive: bool
    breakpoints: np.ndarray = field(default_factory=lambda: np.zeros(0))
    traced_breakpoints: int = 0
    overhead: float = OVERHEAD
    is_exact: bool = False
    scale: Any = 0.0

    def steps_needed(self, lengths: np.ndarray, whole_lengths: np.ndarray, cuts: np.ndarray) -> np.ndarray:
        """Return the least number of steps of intervals (N,).

        An interval between two breakpoints or requested times takes its share of the steps of the whole interval.

        Args:
            lengths: (N,) of the intervals.
            whole_lengths: (N,) of the intervals between observations that they are parts of.
            cuts: (N,) numbers of breakpoints and requested times in these.
        """
        if self.is_exact:
            return np.full(len(lengths), self.steps)
        pieces = np.ones(len(lengths), int)
        if self.max_step is not None:
            pieces = np.maximum(1, np.ceil(whole_lengths / (self.max_step * self.steps) * (1 - 1e-12)).astype(int))
        share = lengths / np.where(whole_lengths > 0, whole_lengths, 1.0)
        # A short pulse moves the state far; it takes more than one step where few breakpoints make that cheap.
        least = np.clip(self.steps // (cuts + 1), 1, _STEPS_OF_PULSE)
        partial = np.maximum(least, np.ceil(share * pieces * self.steps * (1 - 1e-9)).astype(int))
        return np.where(cuts > 0, partial, pieces * self.steps)

    def steps_per_interval(self, count: np.ndarray) -> int:
        """Return the number of steps of each interval that minimises the cost of ``count`` (N,) steps."""
        if self.interval_per_step:
            return 1
        if self.is_adaptive or self.is_exact or not (self.traced_breakpoints or np.any(count % self.steps)):
            return self.steps
        cost = [(np.ceil(count / steps).sum() + self.traced_breakpoints) * (steps + self.overhead)
                for steps in range(1, self.steps + 1)]
        return int(np.argmin(cost)) + 1


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
    if ssm.plan.has_exact_offset or checks.traced((times, origin)):
        return None
    gaps = np.diff(np.asarray(times, float), prepend=float(origin))
    gaps = gaps[gaps > 0]
    if not gaps.size:
        return None
    return max(2.0 * float(np.median(gaps)), float(np.mean(gaps)) / _MOST_STEPS) / steps
