"""A model file that names its fields: the command line stores and draws them."""

import pytest

import lfm_ppl as lfm
from lfm_ppl.results.result_view import ResultView

ROD = '''"""Heat in a rod."""
import jax
import numpy as np
import numpyro
import numpyro.distributions as dist
import lfm_ppl as lfm

BASIS = lfm.LaplaceBasis((0.0, 1.0), 3)
SENSORS = np.array([0.3, 0.6])


def source(parameters):
    return lfm.SpectralField(BASIS, lfm.Matern(parameters["scale"], 0.5), lfm.Matern(1.0, 2.0))


def model(times, y=None):
    scale = numpyro.sample("scale", dist.LogNormal(0.0, 0.5))
    system = lfm.heat(source({"scale": scale}), 0.1, 0.1, sensors=SENSORS, covariance=0.1, output_names=("a", "b"))
    numpyro.sample("y", lfm.MarginalLikelihood(system, times), obs=y)


def fields(data):
    return {"source": {"field": source, "sensors": SENSORS}}


def simulate(seed=0):
    return lfm.Data(np.arange(6.0), np.random.default_rng(seed).normal(size=(6, 2)), ("a", "b"))
'''


@pytest.mark.thorough
def test_fields_are_stored_and_drawn_again(run, tmp_path):
    (tmp_path / "rod.py").write_text(ROD)
    status, output, errors = run("fit ./rod.py --sampler map --samples 20 --out rod --quiet")
    assert status == 0, errors
    assert "field-source.png" in output and "field_source" in ResultView.of(lfm.load("rod")).groups
    assert "field-source" in (tmp_path / "rod" / "report.html").read_text()
    assert run("plot rod --out again")[0] == 0 and (tmp_path / "again" / "field-source.png").is_file()


@pytest.mark.parametrize(("old", "new", "words"), [
    ("def fields(data)", "def fields()", "fields must take the data"),
    ('return {"source": {"field": source, "sensors": SENSORS}}', "return 3", "fields in")])
def test_a_wrong_function_is_refused_before_the_fit(run, tmp_path, old, new, words):
    (tmp_path / "rod.py").write_text(ROD.replace(old, new))
    status, _, errors = run("fit ./rod.py --sampler map --samples 20 --out rod --quiet")
    assert status != 0 and words in errors and not (tmp_path / "rod" / "posterior.nc").exists()
