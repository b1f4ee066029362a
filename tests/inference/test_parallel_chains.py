"""Chains on devices of their own, in a process that has two."""

from processes import on_two_devices

CODE = """
import sys
sys.path += ["tests", "tests/inference", "."]
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import linear_motif as motif
import lfm_ppl as lfm
from lfm_ppl.inference import sampling
from tests.inference.test_bound_model import compilations

assert jax.local_device_count() == 2
sampling.BLOCK_S = 0.02
draws = {}
for method in ("sequential", "parallel"):
    with compilations() as compiled:
        y = jax.device_put(motif.data(), jax.devices()[0])  # the other chain must find them, too
        found = lfm.fit(motif.model, motif.TIMES, y, sampler="ram", chains=2, warmup=400, samples=400,
                        thin=1, trajectory_draws=0, progress=False, chain_method=method,
                        sampler_options={"initial_covariance": 0.1 * np.eye(4)})
    draws[method] = np.asarray(lfm.results.arviz_data.group(found, "posterior")["decay"])
blocks = [name for name in compiled if "jit(advance_on_device)" in name]
assert len(blocks) == 1, blocks
np.testing.assert_allclose(draws["parallel"], draws["sequential"], rtol=1e-6)
assert np.std(draws["parallel"], axis=1).min() > 0
print("same")
"""


def test_parallel_chains_are_compiled_once_and_are_those_of_a_sequence():
    result = on_two_devices(CODE)
    assert result.stdout.strip() == "same", result.stderr
