"""The command line in an empty folder, and a small model file."""

import shlex
import shutil

import pytest

from lfm_ppl.cli import main

WELL = '''"""A double well in noise."""
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist

import lfm_ppl as lfm

OUTPUTS = ("x",)
UNITS = {"x": "nm"}
OPTIONS = {"noise": (0.3, float, "standard deviation of the noise")}
PARAMETERS = {"depth": "depth of the wells (1/h)"}


def model(times, y=None, noise=0.3, units=None):
    depth = numpyro.sample("depth", dist.LogNormal(0.0, 0.4))
    system = lfm.LatentForceModel(
        lambda x, u, t: depth * (x - x**3), {}, lfm.GaussianObservation(lambda x, u, t: x, noise**2 * jnp.ones(1)),
        lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.array([[0.7]]), output_names=OUTPUTS, units=units)
    numpyro.sample("y", lfm.MarginalLikelihood(system, times, steps=10), obs=y)


def simulate(seed=0, noise=0.3):
    y = jnp.array([[0.9], [1.1], [jnp.nan], [-0.8], [-1.2], [-0.7]])
    return lfm.Data(jnp.arange(6.0), y, OUTPUTS, truth={"parameters": {"depth": 1.0}})
'''


@pytest.fixture
def run(capsys, monkeypatch, tmp_path):
    """Run the command line in an empty folder; return (exit status, output, errors)."""
    monkeypatch.chdir(tmp_path)

    def run_line(line):
        status = main(shlex.split(line))
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return run_line


@pytest.fixture(scope="session")
def well(tmp_path_factory):
    """The path of the model file."""
    path = tmp_path_factory.mktemp("model") / "well.py"
    path.write_text(WELL)
    return str(path)


@pytest.fixture(scope="session")
def original(well, tmp_path_factory):
    """The folder of a fit by chains of RAM, with predictions; tests copy it before they change it."""
    folder = tmp_path_factory.mktemp("fit") / "result"
    line = (f"fit {well} --sampler ram --chains 2 --warmup 100 --samples 100 --seed 1 --option noise=0.25 --steps 12 "
            f"--quiet --until 8 --at 6.25 --out {folder}")
    assert main(shlex.split(line)) == 0
    return folder


@pytest.fixture
def fitted(original, tmp_path):
    """A copy of the results folder."""
    return shutil.copytree(original, tmp_path / "result")
