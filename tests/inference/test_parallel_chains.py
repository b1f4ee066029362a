"""Chains of `lfm.fit` on devices of their own, in a process that has two."""

import pytest
from processes import on_two_devices

CODE = """
import sys
sys.path += ["tests", "."]
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import systems
import lfm_ppl as lfm
from lfm_ppl.inference import sampling
from compiled_programs import compilations

def model(times, y=None):
    decay = numpyro.sample("decay", dist.LogNormal(0.0, 0.3))
    system = systems.motif(systems.identity, decay=decay, genes=1, order=0)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)

assert jax.local_device_count() == 2
sampling.BLOCK_S = 0.02
y = jax.device_put(np.array([[0.4], [0.8], [0.9]]), jax.devices()[0])  # the other chain must find them, too
draws = []
for method in ("sequential", "parallel"):
    with compilations() as compiled:
        result = lfm.fit(model, np.arange(3.0), y, sampler="ram", chains=2, warmup=400, samples=400, thin=1,
                         trajectory_draws=0, progress=False, chain_method=method,
                         sampler_options={"initial_covariance": 0.1 * np.eye(1)})
    draws.append(np.asarray(result["posterior"]["decay"]))
blocks = [name for name in compiled if "jit(advance_on_device)" in name]
assert len(blocks) == 1, blocks
np.testing.assert_allclose(*draws, rtol=1e-6)
assert np.std(draws, axis=-1).min() > 0
print("same")
"""


@pytest.mark.thorough
def test_parallel_chains_are_compiled_once_and_are_those_of_a_sequence():
    result = on_two_devices(CODE)
    assert result.stdout.strip() == "same", result.stderr
