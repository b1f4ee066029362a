"""A million observations: memory. Time is measured in tests/performance."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
from pathlib import Path
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp, numpy as np
import lfm_ppl as lfm

empty = jnp.zeros((0, 0))
model = lfm.LatentForceModel(
    lambda x, u, t: x, {"u": lfm.Matern(1.0, 5.0, 1)}, lfm.GaussianObservation(lambda x, u, t: u, jnp.array([0.1])),
    lfm.Gaussian(jnp.zeros(0), empty))
value = jax.jit(lambda times, y: lfm.MarginalLikelihood(model, times).log_prob(y))
times = 0.1 * np.arange(1_000_000)
y = np.sin(times)[:, None] + 0.3 * np.random.default_rng(0).normal(size=(len(times), 1))
result = value(jnp.asarray(times), jnp.asarray(y))
assert np.isfinite(result)
filtered = lfm.filter(model, times, y)
assert np.isclose(filtered.log_likelihood.sum(), result, rtol=1e-9)
# Not `ru_maxrss`, which a process inherits from the one that starts it.
(peak,) = [line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")]
print(int(peak) / 2**20)
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read from /proc")
def test_a_million_observations():
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True, timeout=500)
    gibibytes = float(done.stdout.splitlines()[-1])
    assert gibibytes < 2.0, gibibytes
