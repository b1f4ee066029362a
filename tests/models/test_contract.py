"""What every model file owes: its names, its data, its documentation, and a finite density."""

import itertools
import re
from dataclasses import replace

import jax
import numpy as np
import numpyro
import pytest
from numpyro.infer import Predictive
from numpyro.infer.util import log_density

from lfm_ppl.filtering.arguments import check_observations
from lfm_ppl.io import loading
from lfm_ppl.io.data import read_csv, write_csv
from lfm_ppl.io.data_set import Data
from lfm_ppl.likelihoods.likelihood_site import likelihood_site

MODELS = sorted(loading.available())
CHEAP = ("spring", "ginzburg-landau", "ballistic", "room")
"""Models that are simulated by default; of others the density alone is asked for."""

COSTLY = ("ballistic-3d", "call-centre", "epidemic", "gps", "home-heating", "thyroid")
"""Models whose density takes long to compile; it is run with -m slow."""


def choices(name):
    """Return every combination of the choices that a model offers, as keyword arguments, the default first."""
    listed = {key: (default, *(value for value in accepted if value != default))
              for key, (default, accepted, _) in loading.load(name).options.items() if type(accepted) is tuple}
    return [dict(zip(listed, values, strict=True)) for values in itertools.product(*listed.values())]


CASES = [pytest.param(name, options, id="-".join([name, *map(str, options.values())]),
                      marks=[pytest.mark.slow] if name in COSTLY or options != choices(name)[0] else [])
         for name in MODELS for options in choices(name)]


@pytest.mark.parametrize("name", MODELS)
def test_documentation(name):
    file = loading.load(name)
    assert file.summary.endswith("."), "the first line of the docstring is the list's line"
    assert re.search(r"^Sources?:", file.description, re.MULTILINE)
    assert re.search(r"^ {4}\S.* = ", file.description, re.MULTILINE), "the equations"
    for option, (default, accepted, help_) in file.options.items():
        assert help_ and (default in accepted if type(accepted) is tuple else type(default) is accepted)
        assert option in file.model.__code__.co_varnames
    for parameter, help_ in file.parameters.items():
        assert re.search(r"\(.+\)$", help_), f"the help of {parameter} ends with its unit"


@pytest.mark.parametrize(("name", "options"), CASES)
def test_the_truth_of_the_default_data_is_possible_and_near_the_best(name, options):
    """A true parameter explains its data: not 30 nats worse than halved or doubled ones."""
    file = loading.load(name)
    data = file.simulate(**options)
    keywords, parameters = file.keywords(data, options), data.truth["parameters"]
    check_observations(data.y, len(data.times), len(data.outputs))
    assert file.outputs is None or data.outputs == file.outputs
    assert np.asarray(data.truth["state"]).shape[0] == len(data.truth["times"])
    assert all(np.shape(force) == np.shape(data.truth["times"]) for force in data.truth["forces"].values())
    assert set(data.times) <= set(np.asarray(data.truth["times"])), "the truth is known at the data"
    seeded = numpyro.handlers.seed(file.model, jax.random.key(0))
    trace = numpyro.handlers.trace(seeded).get_trace(data.times, data.y, **keywords)
    sampled = [key for key, site in trace.items() if site["type"] == "sample" and not site["is_observed"]]
    assert sampled == [key for key in file.parameters if key in sampled]
    assert len(sampled) == len(file.parameters) or options, "an option leaves out parameters"
    for key in sampled:
        assert np.shape(parameters[key]) == trace[key]["fn"].shape(), key
        assert np.all(trace[key]["fn"].support(np.asarray(parameters[key]))), f"the true {key} is possible"
    density = jax.jit(lambda values: log_density(file.model, (data.times, data.y), keywords, values)[0])
    truth = {key: np.asarray(parameters[key], float) for key in sampled}
    best, *other_densities = (float(density({key: value * factor for key, value in truth.items()}))
                              for factor in (1, 0.5, 2))
    assert np.isfinite(best) and best > max(other_densities) - 30.0


@pytest.mark.parametrize("name", CHEAP)
def test_draws_of_the_prior_have_the_shape_of_the_data(name):
    file = loading.load(name)
    data = file.simulate()
    draws = Predictive(file.model, num_samples=3)(jax.random.key(1), data.times, **file.keywords(data, {}))
    assert draws["y"].shape == (3, *data.y.shape) and np.all(np.isfinite(draws["y"]))


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=[] if name in CHEAP else [pytest.mark.slow] if name == "gps" else [pytest.mark.thorough])
    for name in MODELS])
def test_default_data_depend_on_the_seed_alone_and_survive_a_file_and_other_units(name, tmp_path):
    file = loading.load(name)
    data = file.simulate(seed=123)
    np.testing.assert_array_equal(file.simulate(seed=123).y, data.y)
    assert not np.array_equal(file.simulate(seed=124).y, data.y)
    write_csv(data, tmp_path / "data.csv")
    prepared = file.prepare(read_csv(tmp_path / "data.csv", file.outputs, inputs=file.inputs))
    assert prepared.outputs == data.outputs and isinstance(data, Data)
    np.testing.assert_array_equal(np.isnan(prepared.y), np.isnan(data.y))
    if not prepared.note:
        np.testing.assert_array_equal(prepared.y, data.y)
    data = replace(data, units={**file.units, "time": "fortnight"})
    site = likelihood_site(file.model, (data.times, data.y), file.keywords(data, {}), jax.random.key(0))
    assert site.example.ssm.model.units["time"] == "fortnight"
