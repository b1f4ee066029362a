"""Times that --until and --at request, as numbers or dates."""

from __future__ import annotations

import numpy as np

from lfm_ppl.io.data_set import Data
from lfm_ppl.utils import calendar_time

_TRAJECTORY_TIMES = 241
"""Number of times of the trajectories between the first and the last one: enough for a smooth line."""


def trajectory_times(observed: Data, until: str | None, at: str | None) -> np.ndarray | None:
    """Return the times of the trajectories; None without --until and --at, for the library's grid."""
    if until is None and at is None:
        return None
    times = observed.times
    time_requests = requested_times(observed, until, at, 2, times)
    return np.union1d(np.linspace(times[0], max(time_requests[-1], times[-1]), _TRAJECTORY_TIMES), time_requests)


def requested_times(observed: Data, until: str | None, at: str | None, grid: int,
                    further: np.ndarray) -> np.ndarray:
    """Return the times of --until and --at, numbers or dates, and ``further`` times, sorted.

    Raises:
        ValueError: neither a number nor a date; --until is not after the last observation.
    """
    last = observed.times[-1]
    hint = ". Separate times by commas."
    at_times = [_parse_time("--at", text, observed, hint) for text in (at or "").split(",") if at]
    if not np.isfinite(at_times).all():
        raise ValueError(f"--at takes finite times, separated by commas, got {at}.")
    groups = [further, np.array(at_times)]
    if until is not None:
        end = _parse_time("--until", until, observed)
        if not (np.isfinite(end) and end > last):
            last_time = f"{last:g}"
            if observed.origin is not None:
                last_time = calendar_time.clock(last, observed.origin, observed.units["time"], "T")
            raise ValueError(f"--until takes a time after the last observation, at {last_time}, got {until}.")
        groups.append(np.linspace(last, end, grid))
    return np.unique(np.concatenate(groups))


def _parse_time(flag: str, text: str, observed: Data, hint: str = "") -> float:
    try:
        return calendar_time.position(text, observed.origin, observed.units.get("time", ""))
    except ValueError as error:
        raise ValueError(f"{flag}: {str(error).rstrip('.')}{hint or '.'}") from None
