"""From a stored result and its NumPyro model back to what the model says of the data at each draw."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import xarray as xr

from lfm_ppl.inference.bind import bind
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.likelihood_site import LikelihoodSite
from lfm_ppl.io.data_set import InputTable, as_events, keywords_by_site, model_keywords
from lfm_ppl.results import arviz_data, inputs
from lfm_ppl.results.likelihoods import LikelihoodProblem
from lfm_ppl.results.series import TIMES, times_of
from lfm_ppl.results.sites import select_site

_TOLERANCE = 1e-6
"""Relative difference of log likelihoods between machines and versions that is rounding."""


def observations(result: Any) -> tuple[Any, Any]:
    """Return the times and the observations that ``result`` was made from.

    Returns:
        times (T,) or (B, T), and y (T, D) or (B, T, D); or dicts of them by site.

    Raises:
        ValueError: the result holds no data.
    """
    if sites := {name: observations(select_site(result, name)) for name in arviz_data.sites_of(result)}:
        return {name: times for name, (times, _) in sites.items()}, {name: y for name, (_, y) in sites.items()}
    data = arviz_data.group(result, "data")
    names = [name for name in data.data_vars if name != TIMES]
    if len(names) != 1 or not {TIMES, "time"} & set(data.variables):
        raise ValueError(f"the group data holds {', '.join(map(str, data.variables)) or 'nothing'}; expected "
                         "one variable of observations and their times. Pass times and y.")
    return np.asarray(times_of(data).values, float), np.asarray(data[names[0]].values, float)


def keywords(result: Any, later: Mapping[str, Any] | None, overrides: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the keyword arguments of a result's model, by site where it has several.

    Args:
        result: with the known inputs of the fit.
        later: known inputs that reach further, see `lfm_ppl.forecast`; None: those of the fit.
        overrides: keyword arguments that replace these.
    """
    if sites := arviz_data.sites_of(result):
        return keywords_by_site({name: keywords(select_site(result, name), (later or {}).get(name), None)
                                 for name in sites}) | dict(overrides or {})
    stored = inputs.inputs_of(result)
    doses = {name: InputTable(*value) for name, value in (later or {}).items()
             if name in stored and stored[name].is_dose}
    arguments = model_keywords(stored, overrides)
    if doses:
        arguments["events"] = as_events(stored | doses)
    for name, value in (later or {}).items():
        if name in doses:
            continue
        arguments |= {"inputs": {**arguments["inputs"], name: value}} if name in stored else {name: value}
    return arguments


def problem(result: Any, numpyro_model: Callable, times: Any = None, y: Any = None,
            model_kwargs: Mapping[str, Any] | None = None) -> LikelihoodProblem:
    """Return model, data and all draws (C * N, ...) of the sample sites, with the result's fixed parameters.

    Raises:
        ValueError: the result holds no posterior or no data; or the model is not the one that it was made with: other
            settings, other parameters.
        TypeError: the model needs a keyword argument; the message names it.
    """
    posterior = arviz_data.group(result, "posterior")
    attrs = arviz_data.attributes(result)
    if times is None or y is None:
        stored = observations(result)
        times, y = stored[0] if times is None else times, stored[1] if y is None else y
    arguments = keywords(result, None, model_kwargs)
    try:
        bound = bind(numpyro_model, times, y, **arguments)
    except (TypeError, AttributeError) as error:
        missing = _missing_keywords(numpyro_model, arguments)
        if not missing or not re.search("NoneType|required", str(error)):
            raise
        example = ", ".join(f"{name!r}: ..." for name in missing)
        raise TypeError(f"the model needs {', '.join(missing)}: pass model_kwargs={{{example}}}.") from error
    settings = arviz_data.sites_of(result)
    for name, site_model in bound.site_models.items():
        _check_settings(site_model.site, settings.get(name, {}) if settings else attrs)
    bound = bound.fix(json.loads(attrs.get("fixed") or "{}"))
    if not bound.sites:
        raise ValueError("the model has no parameters that are sampled, so there is nothing to check.")
    return LikelihoodProblem(bound, parameter_draws(bound, posterior))


def _missing_keywords(numpyro_model: Callable, arguments: Mapping[str, Any]) -> list[str]:
    """Return the names of keyword arguments that the model has no value of."""
    parameters = list(inspect.signature(numpyro_model).parameters.values())[2:]
    return [parameter.name for parameter in parameters if parameter.name not in arguments
            and parameter.kind is not parameter.VAR_KEYWORD
            and (parameter.default is None or parameter.default is parameter.empty)]


def check_likelihood(result: Any, log_likelihood: np.ndarray, draw_index: np.ndarray) -> None:
    """Compare log likelihoods (C, S) at draws ``chosen`` (S,) of each chain with those that the result records.

    Raises:
        ValueError: they differ: model, options or data are not the ones of the result.
    """
    if not arviz_data.has_group(result, "one_step_ahead"):
        return
    terms = arviz_data.group(result, "one_step_ahead")["log_density"].transpose("chain", "draw", ...)
    recorded = terms.isel(draw=draw_index).values.reshape(*log_likelihood.shape, -1).sum(axis=-1)
    difference = np.abs(recorded - log_likelihood)
    if np.any(difference > _TOLERANCE * (1.0 + np.abs(recorded))):
        raise ValueError(f"the model gives other log likelihoods than the result records, by up to {difference.max():g}"
                         " at its draws: model, options or data differ from the ones of the result. "
                         "Fit again, or use the original ones.")


def _check_settings(site: LikelihoodSite, attrs: Mapping[str, Any]) -> None:
    example = site.example
    settings = {**example.recorded_settings, "constraints": example.constraints_in_words or None}
    if not set(settings) & set(attrs):
        return  # not made by `fit`
    for name in settings:
        # What is None is not stored.
        if attrs.get(name) != settings[name]:
            raise ValueError(f"the result was made with {name} = {attrs.get(name)}, but the model has {name} = "
                             f"{settings[name]}; give the model as it was fitted.")


def parameter_draws(bound: BoundModel, posterior: xr.Dataset) -> dict[str, np.ndarray]:
    """Return the draws (C * N, ...) of the sample sites; deterministic ones the model computes itself."""
    shapes = {name: np.shape(value) for name, value in bound.constrain(np.zeros(bound.size)).items()}
    draws = {}
    for name in bound.sites:
        stored = name.replace("/", ".")
        if stored not in posterior:
            names = ", ".join(map(str, posterior.data_vars))
            raise ValueError(f"the model samples {name!r}, of which the result has no draws (it has {names}); it is "
                             "not the model that the result was made with. Give the one that was.")
        values = posterior[stored].transpose("chain", "draw", ...).values
        if values.shape[2:] != shapes[name]:
            raise ValueError(f"{name!r} has shape {shapes[name]} in the model and {values.shape[2:]} in the "
                             "result; it is not the model that the result was made with.")
        draws[name] = values.reshape(-1, *values.shape[2:])
    return draws
