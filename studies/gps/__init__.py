"""OrbitPrediction of satellite orbits with and without unmeasured forces."""
