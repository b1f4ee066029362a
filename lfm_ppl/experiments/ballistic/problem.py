"""The problem: a target on reentry, observed by a radar.

The target starts at the mean of the smoothers' prior, 65 km and 3 km/s, as in the source, whose filter uses cubature
points of the whole state.
"""

from lfm_ppl.experiments.simulated.problem import SimulationProblem

TARGETS = SimulationProblem("ballistic", ("alpha", "scale", "lengthscale"), ("altitude", "speed", "u"),
                            ("m", "m/s", "m/s^2"), medians=(5e-4, 30.0, 5.0), steps=5)
"""Estimate altitude, speed and acceleration from distances (m), with unknown drag and unknown scale and lengthscale of
the force."""
