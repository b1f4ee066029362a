"""Conventions of the arguments of public names: one name for one thing, one order, one default.

`tests/test_docs.py` asks that each name stands in the reference, and that a random key is the first argument.
"""

import inspect

import pytest

import lfm_ppl as lfm
from lfm_ppl.likelihoods.filter_settings import FilterSettings

MODULES = (lfm, lfm.forces, lfm.priors)
CALLABLES = {name: value for module in MODULES for name in module.__all__ if callable(value := getattr(module, name))
             and not (inspect.isclass(value) and issubclass(value, Warning))}
SIGNATURES = {name: inspect.signature(value).parameters for name, value in CALLABLES.items()}

ORDER = ("key", "result", "numpyro_model", "model", "parameters", "times", "y")
"""Random key, what is modelled, times, data: an argument of a later place does not stand before one of an earlier."""

OTHER_NAMES = {
    "fn": "numpyro_model",
    "variance": "sd or covariance", "noise_sd": "sd", "std": "sd", "cov": "covariance", "sigma": "sd",
    "out": "checkpoint", "folder": "checkpoint", "store": "checkpoint",
    "keywords": "model_kwargs", "kwargs": "model_kwargs", "observations": "y", "data": "y or times",
    "initial_value_sd": "initial_sd", "requested_times": "at", "rng": "key or seed", "verbose": "progress",
}
"""Names that are not used -> the name of the same thing."""

DEFAULTS = {
    "progress": True, "seed": 0, "level": 0.95, "overwrite": False, "resume": False, "checkpoint": None, "at": None,
    "model_kwargs": None, "rule": None, "max_step": None, "lower": None, "upper": None, "constraints": (), "lag": 0.0,
    "observation_first": True, "events": (), "fixed": None, "truth": None, "trajectory_draws": 400, "workers": 1,
    "scheme": "auto", "resampling": "systematic", "threshold": 0.5, "exposure": 1.0, "full_state": False,
    "initial_sd": 0.0, "initial_velocity_sd": 0.0, "time_column": None, "time_unit": None, "report": None,
}
"""Argument -> its default wherever it is optional."""

LINKS = {"BernoulliObservation": "logit", "BinomialObservation": "logit", "NegativeBinomialObservation": "exp",
         "PoissonObservation": "exp"}


@pytest.mark.parametrize("name", SIGNATURES)
def test_one_name_for_one_thing(name):
    used = {argument: OTHER_NAMES[argument] for argument in SIGNATURES[name] if argument in OTHER_NAMES}
    assert not used, "take the name on the right"


@pytest.mark.parametrize("name", SIGNATURES)
def test_model_times_and_data_come_in_this_order(name):
    arguments = [argument for argument, parameter in SIGNATURES[name].items()
                 if argument in ORDER and parameter.kind is not inspect.Parameter.KEYWORD_ONLY]
    if not {"times", "y"} & set(arguments) or name in ("Data", "Simulation"):
        return
    assert arguments == sorted(arguments, key=ORDER.index)
    settings = [argument for argument, parameter in SIGNATURES[name].items()
                if parameter.default is not inspect.Parameter.empty and argument not in ORDER]
    positions = list(SIGNATURES[name])
    assert all(positions.index(argument) < positions.index(setting) for argument in arguments for setting in settings)


@pytest.mark.parametrize("name", SIGNATURES)
def test_an_argument_has_one_default(name):
    optional = {argument: parameter.default for argument, parameter in SIGNATURES[name].items()
                if parameter.default is not inspect.Parameter.empty}
    wrong = {argument: default for argument, default in optional.items() if DEFAULTS.get(argument, default) != default}
    assert not wrong
    assert name not in LINKS or optional["link"] == LINKS[name]


@pytest.mark.parametrize("name", ["MarginalLikelihood", "panel", "filter", "smooth", "Switching"])
def test_a_filter_and_a_likelihood_have_the_same_settings(name):
    """None: the default of `FilterSettings`, which is the other one as well; `filter` is a single pass."""
    settings = FilterSettings()
    for argument in ("steps", "max_step", "damping", "tolerance", "method", "factors"):
        if argument in SIGNATURES[name]:
            assert SIGNATURES[name][argument].default in (None, getattr(settings, argument)), argument


def test_gaussian_noise_is_an_sd_or_a_covariance():
    for name in ("GaussianObservation", "heat", "wave"):
        assert {"sd", "covariance"} <= set(SIGNATURES[name])
        assert SIGNATURES[name]["sd"].default is SIGNATURES[name]["covariance"].default is None


def test_arguments_of_a_numpyro_model_are_a_mapping():
    """Functions of a NumPyro model that they call take its keyword arguments as ``model_kwargs``."""
    runs = {name for name, arguments in SIGNATURES.items()
            if "numpyro_model" in arguments and not inspect.isclass(CALLABLES[name])}
    without = {name for name in runs if "model_kwargs" not in SIGNATURES[name]}
    # Options of `fit`, model_kwargs among them, are passed on; a calibrated model generates its data from times alone.
    assert without == {"backtest", "fit_many", "calibrate"}
    for name in runs:
        variable = [p.name for p in SIGNATURES[name].values() if p.kind is inspect.Parameter.VAR_KEYWORD]
        assert variable in ([], ["options"])


def test_events_have_the_same_arguments_and_attributes():
    times, target = [0.0, 1.0], "gut"
    for event, values in ((lfm.Dose(times, 2.0, target), "amounts"), (lfm.Reset(times, target, 2.0), "values"),
                          (lfm.Infusion(times, 2.0, target, rate=1.0), "amounts")):
        arguments = list(SIGNATURES[type(event).__name__])
        assert {"times", "target", values, "lag"} <= set(arguments) and arguments[0] == "times"
        assert event.target == target and float(getattr(event, values)) == 2.0 and event.times.tolist() == times
