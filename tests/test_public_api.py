"""The public names: where they are, and what they have in common."""

import importlib
import inspect
import pkgutil

import jax
import numpy as np
import pytest

import lfm_ppl as lfm
from lfm_ppl import orbits
from lfm_ppl.results import calibration

KEYS = ("key", "rng_key")


def public():
    """Yield (name, function) of every public function, and of every public method of a public class."""
    for module in (lfm, lfm.forces, orbits, calibration):
        for name in getattr(module, "__all__", ("calibrate",)):
            value = getattr(module, name)
            if inspect.isclass(value) and value.__module__.startswith("lfm_ppl"):
                yield name, value.__init__
                for method, function in inspect.getmembers(value, inspect.isfunction):
                    if not method.startswith("_") and function.__module__.startswith("lfm_ppl"):
                        yield f"{name}.{method}", function
            elif inspect.isfunction(value):
                yield name, value


TAKE_A_KEY = {name: function for name, function in public() if set(KEYS) & set(inspect.signature(function).parameters)}


def test_functions_that_draw_are_found():
    assert {"simulate", "particle_filter", "particle_smoother", "rao_blackwellised", "simulate_switched", "calibrate",
            "random_frequencies", "MarginalLikelihood.sample", "LatentGrid.observe", "RAM.init"} <= set(TAKE_A_KEY)


@pytest.mark.parametrize("name", TAKE_A_KEY)
def test_the_random_key_comes_first(name):
    first, *_ = (parameter for parameter in inspect.signature(TAKE_A_KEY[name]).parameters if parameter != "self")
    assert first in KEYS


def test_every_method_that_samples_takes_the_key_first():
    """Also those of results, which are no public names of their own."""
    result = set()
    for module in pkgutil.walk_packages(lfm.__path__, "lfm_ppl."):
        if module.name.startswith(("lfm_ppl.experiments", "lfm_ppl.__main__")):
            continue
        for name, value in inspect.getmembers(importlib.import_module(module.name), inspect.isclass):
            if value.__module__ == module.name and "sample" in vars(value):
                parameters = list(inspect.signature(value.sample).parameters)
                if "key" in parameters:
                    result.add(name)
                    assert parameters[1] == "key", f"{module.name}.{name}.sample"
    assert {"SmootherResult", "MAPResult", "LaplaceResult", "MarginalLikelihood"} <= result


@pytest.mark.parametrize("call", [
    lambda: lfm.simulate("model", [0.0], jax.random.key(0)),
    lambda: lfm.particle_filter("model", [0.0], [[1.0]], jax.random.key(0)),
    lambda: lfm.particle_smoother("model", [0.0], [[1.0]], jax.random.key(0)),
    lambda: lfm.rao_blackwellised("build", "rule", [0.0], jax.random.key(0)),
    lambda: lfm.simulate_switched("build", "rule", [0.0], jax.random.key(0)),
    lambda: lfm.forces.random_frequencies("prior", jax.random.key(0), 1),
    lambda: calibration.calibrate("model", [0.0], lfm.RAM, jax.random.key(0)),
], ids=["simulate", "particle_filter", "particle_smoother", "rao_blackwellised", "simulate_switched",
        "random_frequencies", "calibrate"])
def test_a_key_elsewhere_is_an_error_that_says_where_it_goes(call):
    with pytest.raises(TypeError, match=r"key, the first argument, must be a JAX random key, .* got str\."):
        call()


def test_several_keys_are_no_key():
    with pytest.raises(TypeError, match=r"got PRNGKeyArray of shape \(3,\)"):
        lfm.simulate(jax.random.split(jax.random.key(0), 3), None, np.zeros(1))
