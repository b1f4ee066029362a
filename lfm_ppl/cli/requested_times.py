"""Times that --until and --at request, as numbers or dates."""

from __future__ import annotations

import numpy as np

from lfm_ppl.cli.options import Times
from lfm_ppl.io.data_set import Data
from lfm_ppl.utils import calendar_time
from lfm_ppl.workflows.fit_results import pad_grids, subdivide

_TRAJECTORY_TIMES = 241
"""Number of times of the trajectories between the first and the last one: enough for a smooth line."""

_MOST_FORECAST_TIMES = 1000
"""Largest number of times between the last observation and --until."""


def trajectory_times(observed: Data, requests: Times) -> np.ndarray | None:
    """Return the times of the trajectories; None without --until and --at, for the library's grid."""
    if requests == Times():
        return None
    requested = requested_times(observed, requests)
    grids = [subdivide(np.union1d(times, requested), _TRAJECTORY_TIMES) for times in np.atleast_2d(observed.times)]
    return pad_grids(grids) if observed.series else grids[0]


def requested_times(observed: Data, requests: Times) -> np.ndarray:
    """Return the times of --at, and times at the median spacing of the data up to --until, sorted.

    Raises:
        ValueError: neither a number nor a date; --until is not after the last observation.
    """
    times = [_parse_time("--at", text, observed) for text in (requests.at or "").split(",") if requests.at]
    if not np.isfinite(times).all():
        raise ValueError(f"--at takes finite times, separated by commas, got {requests.at}.")
    if requests.until is None:
        return np.unique(times)
    last, end = observed.times.max(), _parse_time("--until", requests.until, observed)
    if not (np.isfinite(end) and end > last):
        last_time = f"{last:g}" if observed.origin is None else calendar_time.clock(
            last, observed.origin, observed.units["time"], "T")
        raise ValueError(f"--until takes a time after the last observation, at {last_time}, got {requests.until}.")
    gaps = np.diff(observed.times)
    spacing = np.median(gaps[gaps > 0]) if (gaps > 0).any() else end - last
    spacing *= np.ceil((end - last) / spacing / _MOST_FORECAST_TIMES)
    # An end that is a multiple of the spacing up to rounding is no second time.
    later = last + spacing * np.arange(1, np.floor((end - last) / spacing * (1 - 1e-9)) + 1)
    return np.union1d(times, [*later, end])


def _parse_time(flag: str, text: str, observed: Data) -> float:
    try:
        return calendar_time.position(text, observed.origin, observed.units.get("time", ""))
    except ValueError as error:
        hint = " Separate times by commas." if flag == "--at" else ""
        raise ValueError(f"{flag}: {str(error).rstrip('.')}.{hint}") from None
