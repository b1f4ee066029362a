"""Orbits of satellites: positions as the analysis centres publish them, read from SP3 files.

>>> from lfm_ppl.orbits import read_sp3                   # doctest: +SKIP
>>> orbits = read_sp3("data/gps", satellites=["G05"])     # doctest: +SKIP
"""

from lfm_ppl.orbits.ephemerides import Ephemerides, Gap, calendar, gps_seconds
from lfm_ppl.orbits.sp3 import read_sp3

__all__ = ["Ephemerides", "Gap", "calendar", "gps_seconds", "read_sp3"]
