"""The problem: a target on reentry, seen by a radar.

It starts at the means of the smoothers' prior, 65 km and 3 km/s, as in the source, whose filter takes cubature points
of the whole state.
"""

from lfm_ppl.experiments.simulated.problem import Problem

TARGETS = Problem("ballistic", ("alpha", "scale", "lengthscale"), ("altitude", "speed", "u"), ("m", "m/s", "m/s^2"),
                  medians=(5e-4, 30.0, 5.0), steps=5)
"""Altitude, speed and acceleration from distances (m), with unknown drag, and scale and lengthscale of the force."""
