"""A satellite over ten days: run with ``pytest -m performance tests/performance/test_gps_speed.py -n 0``."""

from __future__ import annotations

import resource

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl import orbits
from lfm_ppl.orbits import magnitudes

pytestmark = pytest.mark.performance
pytest.importorskip("erfa", reason="needs the extra gps")


@pytest.mark.parametrize("rule", [lfm.Taylor(), lfm.Cubature()], ids=["taylor", "cubature"])
def test_ten_days_of_33_states(benchmark, rule):
    """Filter and likelihood of 960 positions, in steps of 30 s: under 10 s, in less than 4 GiB."""
    environment = orbits.Environment.over(orbits.gps_seconds(2019, 4, 7), 240.0)
    times = 0.25 * np.arange(960)
    state = np.concatenate([[26_560.0, 0.0, 0.0], [0.0, 8_000.0, 11_425.0]])
    y = orbits.propagate(environment, orbits.Orbit(0.0, state, 101.0, 0.0), times)[:, :3]
    start = lfm.Gaussian(jnp.asarray(state), 1e-2 * jnp.eye(6))

    @jax.jit
    def likelihood(logarithms, y):
        forces, white = magnitudes.forces(logarithms, "DYB", orbits.GPS_PERIOD)
        system = orbits.satellite(environment, start, forces, white=white)
        result = lfm.filter(system, times, y, rule=rule, steps=30)
        return result.log_likelihood.sum(), result.filtered_mean

    logarithms = jnp.asarray(magnitudes.wide("DYB").mean)
    value, mean = jax.block_until_ready(likelihood(logarithms, y))
    assert np.isfinite(value) and mean.shape == (960, 33)
    benchmark.pedantic(lambda: jax.block_until_ready(likelihood(logarithms, y)), rounds=3)
    assert benchmark.stats.stats.median < 10.0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 4 * 2**20  # KiB
