"""Options of `lfm-ppl fit` as arguments of `lfm_ppl.fit`: likelihood, sampler, attributes of the result."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from lfm_ppl.cli import choices, pages
from lfm_ppl.cli.options import Approximation, FitArguments
from lfm_ppl.io import loading
from lfm_ppl.io.data_set import Data
from lfm_ppl.likelihoods.handlers.approximate import approximate

TIME_UNIT = "file_time_unit"
"""Attribute of a result: the unit that --time-unit gave to the times of the data file."""

_SETTINGS = ("rule", "steps", "max_step", "iterations", "tolerance", "method")


def approximated_model(options: FitArguments, model: loading.ModelFile) -> Any:
    """Return the NumPyro model with the user's settings of the approximation.

    Raises:
        ValueError: bounds with a sampler that does not support them.
    """
    bounds = _bounds(options.approximation)
    if bounds and options.inference.sampler == "pmmh":
        raise ValueError("--lower and --upper are for the samplers nuts, ram and map: the particle filter of pmmh "
                         "does not support constraints.")
    settings = _settings(options.approximation)
    return approximate(model.model, **settings | {"rule": choices.rule(settings["rule"])}, **bounds)


def _settings(approximation: Approximation) -> dict[str, Any]:
    return {name: getattr(approximation, name) for name in _SETTINGS}


def _bounds(approximation: Approximation) -> dict[str, Any]:
    """Return the bounds and the times at which they hold; empty without bounds."""
    bounds = {"lower": choices.bounds("--lower", approximation.lower),
              "upper": choices.bounds("--upper", approximation.upper)}
    if not any(bounds.values()):
        if approximation.grid is not None:
            raise ValueError("--grid is the number of times at which --lower and --upper hold; give one of them with "
                             "it.")
        return {}
    return {name: value for name, value in (bounds | {"grid": approximation.grid}).items() if value is not None}


def sampling_arguments(options: FitArguments, model: loading.ModelFile) -> dict[str, Any]:
    """Return the arguments that `lfm_ppl.fit` and `lfm_ppl.fit_many` share."""
    inference = options.inference
    names = ("sampler", "chains", "warmup", "samples", "thin", "trajectory_draws", "init", "seed")
    target_accept = inference.target_accept
    if target_accept is None and inference.sampler == "nuts":
        target_accept = model.target_accept
    sampler_options = {"target_accept_prob": target_accept, "particles": inference.particles}
    return {**{name: getattr(inference, name) for name in names}, "overwrite": options.output.overwrite,
            "sampler_options": {name: value for name, value in sampler_options.items() if value is not None}}


def without_data(keywords: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keyword arguments of a model without known inputs and doses.

    `lfm_ppl.fit` takes them from the data, whose times it converts to the unit of the model.
    """
    return {name: value for name, value in keywords.items() if not (name in ("inputs", "events") and value)}


def result_attributes(options: FitArguments, line: Sequence[str], model: loading.ModelFile, observed: Data,
                      model_options: dict[str, Any]) -> dict[str, Any]:
    """Return the attributes of a result that `lfm-ppl check` and `forecast` read."""
    is_shipped = loading.available().get(model.name) == model.path
    return {
        "model_file": model.name if is_shipped else str(model.path),
        "settings": json.dumps(_settings(options.approximation) | _bounds(options.approximation)),
        "options": json.dumps(model_options),
        "data": options.data.data or "simulated",
        "description": model.description,
        "meanings": json.dumps(dict(model.parameters)),
        "command_line": pages.command_line(line),
        **({"note": observed.note} if observed.note else {}),
        **({TIME_UNIT: options.data.time_unit} if options.data.time_unit else {}),
        **({"series_column": options.data.series} if observed.series and options.data.series else {}),
    }
