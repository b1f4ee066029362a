"""The particle filter against its bounds, and against the `particles` package on the same model and machine."""

import os
import subprocess
import sys
import venv
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lfm_ppl as lfm

pytestmark = pytest.mark.performance

PARTICLES, OBSERVATIONS, STEPS = 40_000, 25, 100


def ours(scheme):
    model = lfm.LatentForceModel(
        lambda x, u, t: x - 0.1 * x * x * x, {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.01])),
        lfm.Gaussian(jnp.zeros(1), jnp.array([10.0])), process_noise=jnp.array([[2.0]]))
    y = 3.0 * np.sign(np.sin(0.4 * np.arange(OBSERVATIONS) + 0.1))[:, None]
    times = 2.0 * np.arange(OBSERVATIONS)
    return lambda: lfm.particle_filter(jax.random.key(0), model, times, y, particles=PARTICLES, steps=STEPS,
                                       scheme=scheme).log_likelihood.sum().block_until_ready()


@pytest.fixture(scope="session")
def peer(tmp_path_factory):
    """A Python with `particles` and NumPy 1: LFM_PARTICLES_PYTHON, or an environment made here."""
    if python := os.environ.get("LFM_PARTICLES_PYTHON"):
        return python
    folder = tmp_path_factory.mktemp("particles")
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    subprocess.run([python, "-m", "pip", "install", "-q", "particles==0.4", "numpy<2"], check=True)
    return str(python)


@pytest.mark.parametrize("scheme", ["srk", "euler"])
def test_particle_steps_per_second(benchmark, peer, scheme):
    """Two cores: under 6 s, and at least three times as fast as the other package with the same scheme."""
    run = ours(scheme)
    run()
    script = Path(__file__).with_name("peer_particles.py")
    sizes = [str(size) for size in (PARTICLES, OBSERVATIONS, STEPS)]
    printed = subprocess.run([peer, str(script), scheme, *sizes], check=True, capture_output=True, text=True).stdout
    theirs, their_log_likelihood = map(float, printed.split())
    value = benchmark.pedantic(run, rounds=3)
    seconds = benchmark.stats.stats.min
    benchmark.extra_info.update(theirs=theirs, ratio=theirs / seconds, python=sys.version)
    print(f"\n{scheme}: {seconds:.2f} s, particles {theirs:.2f} s, {theirs / seconds:.1f} times as fast")
    assert abs(value - their_log_likelihood) < 1.0  # the same model: estimates of one number, each within about 0.15
    assert seconds < 6.0
    assert theirs / seconds > 3.0
