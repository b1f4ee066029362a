"""Times of satellites: GPS time against UTC, UT1 and terrestrial time.

Epochs are seconds of GPS time since its start, 6 January 1980, 0 h. GPS time has no leap seconds. It is 19 s behind
international atomic time, and was 18 s ahead of UTC in 2019. With it,

    TAI = GPS + 19 s,    TT = TAI + 32.184 s,    UTC = TAI - leap seconds,    UT1 = UTC + (UT1 - UTC).
"""

from __future__ import annotations

import importlib
from types import ModuleType

import numpy as np

from lfm_ppl.orbits.ephemerides import DAY

GPS_START = 2_444_244.5
"""Julian date of the start of GPS time."""
TAI_MINUS_GPS = 19.0
TT_MINUS_TAI = 32.184


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


def library(name: str) -> ModuleType:
    """Import a library of the extra ``gps``.

    Raises:
        ImportError: it is not installed; the message has the command.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"satellite orbits need the library {name}: pip install 'lfm_ppl[gps]'.") from error
