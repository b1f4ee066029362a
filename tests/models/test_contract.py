"""What every model file owes: its names, its data, its documentation, and a finite density."""

import functools
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
from lfm_ppl.inference.likelihood_site import likelihood_site
from lfm_ppl.io import loading
from lfm_ppl.io.data import read_csv, write_csv
from lfm_ppl.io.data_set import Data

MODELS = sorted(loading.available())


def choices(name):
    """Return every combination of the choices that a model offers, as keyword arguments."""
    options = loading.load(name).options
    listed = {key: accepted for key, (_, accepted, _) in options.items() if type(accepted) is tuple}
    return [dict(zip(listed, values, strict=True)) for values in itertools.product(*listed.values())]


COSTLY = ("gps", "home-heating", "ballistic-3d", "epidemic")
"""Models whose other variants take long to compile; these are run with -m slow."""

ALL_BUT_GPS = [pytest.param(name, marks=[pytest.mark.slow] if name == "gps" else []) for name in MODELS]

CASES = [
    pytest.param(name, options, id="-".join([name, *map(str, options.values())]),
                 marks=[pytest.mark.slow] if name in COSTLY and (name == "gps" or options != choices(name)[0]) else [])
    for name in MODELS
    for options in choices(name)
]


@functools.cache
def simulated(name, *options):
    """Return the default data of a model, simulated once for all tests."""
    return loading.load(name).simulate(**dict(options))


def sites(file, data, options):
    """Return the trace of one run of the model."""
    keywords = file.keywords(data, options)
    seeded = numpyro.handlers.seed(file.model, jax.random.key(0))
    return numpyro.handlers.trace(seeded).get_trace(data.times, data.y, **keywords)


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
def test_default_data_fit_the_model_and_carry_their_truth(name, options):
    file = loading.load(name)
    data = simulated(name, *options.items())
    assert isinstance(data, Data)
    assert file.outputs is None or data.outputs == file.outputs
    check_observations(data.y, len(data.times), len(data.outputs))
    truth = data.truth
    assert set(file.parameters) <= set(truth["parameters"])
    assert np.asarray(truth["state"]).shape[0] == len(truth["times"])
    assert all(np.shape(force) == np.shape(truth["times"]) for force in truth["forces"].values())
    assert set(data.times) <= set(np.asarray(truth["times"])), "the truth is known at the data"


@pytest.mark.parametrize("name", ALL_BUT_GPS)
def test_default_data_depend_on_the_seed_alone(name):
    file = loading.load(name)
    first = file.simulate(seed=123)
    np.testing.assert_array_equal(file.simulate(seed=123).y, first.y)
    assert not np.array_equal(first.y, simulated(name).y)


@pytest.mark.parametrize(("name", "options"), CASES)
def test_sites_are_those_that_the_file_documents(name, options):
    file = loading.load(name)
    data = simulated(name, *options.items())
    result = sites(file, data, options)
    sampled = [key for key, site in result.items() if site["type"] == "sample" and not site["is_observed"]]
    assert sampled == list(file.parameters)
    for key in sampled:
        value = np.asarray(data.truth["parameters"][key])
        assert value.shape == result[key]["fn"].shape(), key
        assert np.all(result[key]["fn"].support(value)), f"the true {key} is possible"


@pytest.mark.parametrize(("name", "options"), CASES)
def test_the_density_at_the_truth_is_finite_and_near_its_best(name, options):
    """A true parameter explains its data: not 30 nats worse than halved or doubled ones."""
    file = loading.load(name)
    data = simulated(name, *options.items())
    keywords = file.keywords(data, options)

    @jax.jit
    def density(values):
        return log_density(file.model, (data.times, data.y), keywords, values)[0]

    truth = {key: np.asarray(data.truth["parameters"][key], float) for key in file.parameters}
    best = float(density(truth))
    assert np.isfinite(best)
    for factor in (0.5, 2.0):
        others = {key: value * factor for key, value in truth.items()}
        assert best > float(density(others)) - 30.0


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=[pytest.mark.slow] if name in COSTLY else []) for name in MODELS])
def test_prior_predictive_has_the_shape_of_the_data(name):
    file = loading.load(name)
    data = simulated(name)
    predictive = Predictive(file.model, num_samples=3)
    draws = predictive(jax.random.key(1), data.times, **file.keywords(data, {}))
    assert draws["y"].shape == (3, *data.y.shape)
    assert np.all(np.isfinite(draws["y"]))


@pytest.mark.parametrize("name", ALL_BUT_GPS)
def test_default_data_survive_a_file(name, tmp_path):
    file = loading.load(name)
    data = simulated(name)
    write_csv(data, tmp_path / "data.csv")
    prepared = file.prepare(read_csv(tmp_path / "data.csv", file.outputs, inputs=file.inputs))
    assert prepared.outputs == data.outputs
    assert np.all(np.isnan(prepared.y) == np.isnan(data.y))
    if not prepared.note:
        np.testing.assert_array_equal(prepared.y, data.y)


@pytest.mark.parametrize("name", ALL_BUT_GPS)
def test_units_of_the_data_reach_the_model(name):
    file = loading.load(name)
    data = replace(simulated(name), units={**file.units, "time": "fortnight"})
    site = likelihood_site(file.model, (data.times, data.y), file.keywords(data, {}), jax.random.key(0))
    assert site.example.ssm.model.units["time"] == "fortnight"
