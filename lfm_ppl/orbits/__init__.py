"""Satellites: their orbits as the analysis centres publish them, and what is known of the forces on them.

>>> from lfm_ppl.orbits import Environment, read_sp3      # doctest: +SKIP
>>> orbits = read_sp3("data/gps", satellites=["G05"])     # doctest: +SKIP
>>> around = Environment.over(orbits.epochs[0], hours=24 * orbits.days)  # doctest: +SKIP
>>> around.celestial(orbits)  # the positions, in axes that do not turn  # doctest: +SKIP
"""

from lfm_ppl.orbits.bodies import sunlight
from lfm_ppl.orbits.deterministic import STEP, Orbit, fit_orbit, propagate
from lfm_ppl.orbits.deviations import Neighbourhood, departure
from lfm_ppl.orbits.environment import NANO, Environment
from lfm_ppl.orbits.ephemerides import Ephemerides, Gap, calendar, check_satellites, gps_seconds
from lfm_ppl.orbits.frames import AXES, dyb, rtn
from lfm_ppl.orbits.geopotential import GM
from lfm_ppl.orbits.satellite import (
    GPS_PERIOD,
    HARMONICS,
    SOLAR_PRESSURE,
    START_SD,
    period_of,
    satellite,
    small_forces,
    start_near,
    wide_start,
)
from lfm_ppl.orbits.sp3 import read_sp3

__all__ = [
    "AXES",
    "GM",
    "GPS_PERIOD",
    "HARMONICS",
    "NANO",
    "SOLAR_PRESSURE",
    "START_SD",
    "STEP",
    "Environment",
    "Ephemerides",
    "Gap",
    "Neighbourhood",
    "Orbit",
    "calendar",
    "check_satellites",
    "departure",
    "dyb",
    "fit_orbit",
    "gps_seconds",
    "period_of",
    "propagate",
    "read_sp3",
    "rtn",
    "satellite",
    "small_forces",
    "start_near",
    "sunlight",
    "wide_start",
]
