"""Times of satellites: GPS time against UTC, UT1 and terrestrial time.

Epochs are seconds of GPS time since its start, 6 January 1980, 0 h. GPS time has no leap seconds. It is 19 s behind
international atomic time, and was 18 s ahead of UTC in 2019. With it,

    TAI = GPS + 19 s,    TT = TAI + 32.184 s,    UTC = TAI - leap seconds,    UT1 = UTC + (UT1 - UTC).
"""

from __future__ import annotations

import datetime

import numpy as np

GPS_START = 2_444_244.5
"""Julian date of the start of GPS time."""
TAI_MINUS_GPS = 19.0
TT_MINUS_TAI = 32.184
DAY = 86_400.0


def gps_seconds(year: int, month: int, day: int, hour: int = 0, minute: int = 0, second: float = 0.0) -> float:
    """Return seconds since the start of GPS time; the calendar date is one of GPS time.

    Example:
        >>> gps_seconds(2019, 4, 7) / (7 * 86_400)
        2048.0
    """
    days = (datetime.date(year, month, day) - datetime.date(1980, 1, 6)).days
    return DAY * days + 3600.0 * hour + 60.0 * minute + second


def gps_date(seconds: float) -> str:
    """Return the calendar date and time of GPS seconds, for messages.

    Example:
        >>> gps_date(gps_seconds(2019, 4, 7, 12))
        '2019-04-07 12:00:00 GPS'
    """
    moment = datetime.datetime(1980, 1, 6) + datetime.timedelta(seconds=float(seconds))
    return f"{moment:%Y-%m-%d %H:%M:%S} GPS"


def terrestrial(seconds: np.ndarray) -> tuple[float, np.ndarray]:
    """Return terrestrial time as a Julian date in two parts, as ERFA wants it."""
    return GPS_START, (np.asarray(seconds, float) + TAI_MINUS_GPS + TT_MINUS_TAI) / DAY


def utc(seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return UTC as a quasi Julian date in two parts.

    Raises:
        ImportError: pyerfa is not installed.
    """
    erfa = library("erfa")
    return erfa.taiutc(GPS_START, (np.asarray(seconds, float) + TAI_MINUS_GPS) / DAY)


def library(name: str):
    """Import a library of the extra ``gps``.

    Raises:
        ImportError: it is not installed; the message has the command.
    """
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"satellite orbits need {name.split('.')[0]}: pip install 'lfm_ppl[gps]'.") from error
