"""Satellites: their precise orbits as files, and what is known of the forces on them."""

from lfm_ppl.orbits.environment import NANO, Environment
from lfm_ppl.orbits.frames import AXES, dyb, rtn
from lfm_ppl.orbits.times import gps_date, gps_seconds

__all__ = ["AXES", "NANO", "Environment", "dyb", "gps_date", "gps_seconds", "rtn"]
