"""From a stored result and its NumPyro model back to what the model says of the data at each draw."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import xarray as xr

from lfm_ppl.inference.bind import bind
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.model_draws import ModelDraws
from lfm_ppl.inference.tuning import anchored
from lfm_ppl.io.input_table import (
    OF_SERIES,
    InputTable,
    as_events,
    as_inputs,
    continued_inputs,
    input_table,
    keywords_by_site,
    model_keywords,
)
from lfm_ppl.likelihoods.handlers.approximate import complete
from lfm_ppl.likelihoods.likelihood_site import LikelihoodSite
from lfm_ppl.linearisation.named_rules import named_rule
from lfm_ppl.model.inputs import Input
from lfm_ppl.results.result_view import ResultView
from lfm_ppl.results.series import TIMES, times_of
from lfm_ppl.results.sites import site_view
from lfm_ppl.utils import calendar_time

_TOLERANCE = 1e-6
"""Relative difference of log likelihoods between machines and versions that is rounding."""


def observations(result: Any) -> tuple[Any, Any]:
    """Return the times and the observations that ``result`` was made from.

    Returns:
        times (T,) or (B, T), and y (T, D) or (B, T, D); or dicts of them by site.

    Raises:
        ValueError: the result holds no data.
    """
    view = ResultView.of(result)
    if sites := {name: observations(site_view(view, name)) for name in view.likelihood_sites}:
        return {name: times for name, (times, _) in sites.items()}, {name: y for name, (_, y) in sites.items()}
    data = view.group("data")
    names = [name for name in data.data_vars if name != TIMES]
    if len(names) != 1 or not {TIMES, "time"} & set(data.variables):
        raise ValueError(f"the group data holds {', '.join(map(str, data.variables)) or 'nothing'}; expected "
                         "one variable of observations and their times. Pass times and y.")
    return np.asarray(times_of(data).values, float), np.asarray(data[names[0]].values, float)


def keywords(result: Any, later: Mapping[str, Any] | None, overrides: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the keyword arguments of a result's model, by site where it has several.

    Args:
        result: with the known inputs of the fit.
        later: known inputs that continue the fit's, and further arguments, see `lfm_ppl.forecast`; or None.
        overrides: keyword arguments that replace these.
    """
    view = ResultView.of(result)
    if sites := view.likelihood_sites:
        return keywords_by_site({name: keywords(site_view(view, name), (later or {}).get(name), None)
                                 for name in sites}) | dict(overrides or {})
    stored = view.inputs
    continued = stored | continued_tables(view, later or {})
    arguments = model_keywords(stored, overrides)
    further = {name: value for name, value in (later or {}).items() if name not in stored}
    if len(further) < len(later or {}):
        functions = as_inputs(continued)
        for name, value in (later or {}).items():
            if name in functions and isinstance(value, Input):
                functions[name] = Input(*continued[name][:3], outside=value.outside, name=name)
        from_tables = {"inputs": {**arguments.get("inputs", {}), **functions}, "events": as_events(continued)}
        arguments |= {name: value for name, value in from_tables.items() if value}
    return arguments | further


def continued_tables(result: Any, later: Mapping[str, Any]) -> dict[str, InputTable]:
    """Return the known inputs of a result of one site that later ones continue, by name, and the doses that they end.

    Args:
        result: with the known inputs of the fit.
        later: name -> table, (times, values), (times, values, interpolation) or `lfm.Input`; other names are ignored.

    Raises:
        ValueError: a known input is read in another manner than in the fit, or differs from it before the last
            observation.
    """
    view = ResultView.of(result)
    stored, clock = view.inputs, view.clock
    tables = {name: _later_table(name, value, stored[name], clock) for name, value in later.items() if name in stored}
    continued = continued_inputs(stored, tables)
    for name, table in continued.items():
        span = observed_span(view, name.partition(OF_SERIES)[2])
        check_difference = _check_doses if table.is_dose else _check_function
        with calendar_time.in_messages(*clock):
            check_difference(name, stored[name], table, *span)
    return continued


def _later_table(name: str, value: Any, stored: InputTable, clock: tuple[str | None, str]) -> InputTable:
    if isinstance(value, tuple) and not isinstance(value, InputTable) and len(value) == 2:
        value = (*value, stored.interpolation)
    table = input_table(name, value, *clock)
    if table.times.ndim != 1 or table.times.shape != table.values.shape:
        raise ValueError(f"the known input {name!r} must have one value for each time, (K,), got times of shape "
                         f"{table.times.shape} and values of shape {table.values.shape}.")
    if table.is_dose != stored.is_dose or not table.is_dose and table.interpolation != stored.interpolation:
        raise ValueError(f"the known input {name!r} is read as {stored.interpolation!r} in the fit and as "
                         f"{table.interpolation!r} in the forecast; read it in one manner.")
    return table


def observed_span(result: Any, series: str = "") -> tuple[float, float]:
    """Return the times of the first row and of the last observation, of a series or of all; infinite without any."""
    view = ResultView.of(result)
    times, y = observations(view)
    is_observed = np.isfinite(y).any(axis=-1)
    times = np.broadcast_to(times, is_observed.shape)
    if series:
        index = list(map(str, view.series_labels)).index(series)
        times, is_observed = times[index], is_observed[index]
    return float(times.min()), float(np.max(times[is_observed], initial=-np.inf))


def _check_function(name: str, stored: InputTable, table: InputTable, first: float, last: float) -> None:
    """Raise ValueError where two known inputs differ between the first row and the last observation."""
    is_linear = table.interpolation == "linear"
    knots = np.unique(np.concatenate([stored.times, table.times, [first, last]]))
    knots = knots[(knots >= first) & ((knots <= last) if is_linear else (knots < last))]

    def values_at(table: InputTable) -> np.ndarray:
        if is_linear:
            return np.interp(knots, table.times, table.values)
        return table.values[np.maximum(np.searchsorted(table.times, knots, side="right") - 1, 0)]

    earlier, later = values_at(stored), values_at(table)
    rounding = _TOLERANCE * np.max(np.abs(earlier), initial=0.0)
    differing = np.flatnonzero(np.abs(earlier - later) > rounding)
    if differing.size:
        row = differing[0]
        time, end = calendar_time.named(float(knots[row])), calendar_time.named(last)
        raise ValueError(f"the known input {name!r} of the forecast is {later[row]:g} at time {time}, where that of "
                         f"the fit is {earlier[row]:g}. Until the last observation, at time {end}, they must be the "
                         "same: give later rows only, which continue the fit's, or fit again.")


def _check_doses(name: str, stored: InputTable, table: InputTable, first: float, last: float) -> None:
    """Raise ValueError where two tables of doses and resets differ before the last observation."""
    def events(table: InputTable) -> dict[tuple[float, str], float]:
        """Return the amounts that enter before the last observation, by time and state; resets by their time."""
        amounts = {(float(time), "a reset"): 0.0 for time in (() if table.resets is None else table.resets)
                   if time < last}
        rows = zip(table.times, table.values, table.durations_of_all, table.compartments_of_all, strict=True)
        for time, value, duration, compartment in rows:
            if time < last:
                fraction = min(duration, last - time) / duration if duration > 0 else 1.0
                state = table.dosed_states[compartment]
                amounts[float(time), state] = amounts.get((float(time), state), 0.0) + float(value * fraction)
        return amounts

    earlier, later = events(stored), events(table)
    for time, state in sorted({*earlier, *later}):
        amounts = [entries.get((time, state), np.nan) for entries in (later, earlier)]
        if np.isclose(amounts[0], amounts[1], rtol=_TOLERANCE, atol=0.0):
            continue
        forecast_dose, fitted_dose = (
            "none" if np.isnan(amount) else state if state == "a reset" else f"{amount:g} to {state}"
            for amount in amounts)
        raise ValueError(f"the doses {name!r} of the forecast at time {calendar_time.named(time)} are {forecast_dose}, "
                         f"where the fit has {fitted_dose}. Before the last observation, at time "
                         f"{calendar_time.named(last)}, they must be the same: give later doses only, which continue "
                         "the fit's, or fit again.")


def problem(result: Any, numpyro_model: Callable, times: Any = None, y: Any = None,
            model_kwargs: Mapping[str, Any] | None = None) -> ModelDraws:
    """Return model, data and all draws (C * N, ...) of the sample sites, with the result's fixed parameters.

    Raises:
        ValueError: the result holds no posterior or no data; or the model is not the one that it was made with: other
            settings, other parameters.
        TypeError: the model needs a keyword argument; the message names it.
    """
    view = ResultView.of(result)
    if view.is_part:
        raise ValueError("the result is one series of a panel or one of several likelihood sites, and its model is "
                         "that of all; take the result that it was selected from.")
    posterior = view.posterior
    if times is None or y is None:
        stored = observations(view)
        times, y = stored[0] if times is None else times, stored[1] if y is None else y
    arguments = keywords(view, None, model_kwargs)
    settings = dict(view.likelihood_sites)
    try:
        bound = bind(_as_fitted(numpyro_model, settings or {"": dict(view.attrs)}), times, y, model_kwargs=arguments)
    except (TypeError, AttributeError) as error:
        missing = _missing_keywords(numpyro_model, arguments)
        if not missing or not re.search("NoneType|required", str(error)):
            raise
        example = ", ".join(f"{name!r}: ..." for name in missing)
        raise TypeError(f"the model needs {', '.join(missing)}: pass model_kwargs={{{example}}}.") from error
    for name, site_model in bound.site_models.items():
        _check_settings(site_model.site, settings.get(name, {}) if settings else view.attrs)
    bound = anchored(bound.fix(view.decoded("fixed")), view.attrs)
    if not bound.sites:
        raise ValueError("the model has no parameters that are sampled, so there is nothing to check.")
    return ModelDraws(bound, parameter_draws(bound, posterior))


def further_parameters(numpyro_model: Callable) -> dict[str, inspect.Parameter]:
    """Return the parameters of a model after times and y, by name."""
    return dict(list(inspect.signature(numpyro_model).parameters.items())[2:])


def _as_fitted(numpyro_model: Callable, recorded: Mapping[str, Mapping[str, Any]]) -> Callable:
    """Return the model with the settings that a result records, by likelihood site, where the model leaves them open.

    Args:
        numpyro_model: the model.
        recorded: name of a site, or "" for the only one -> attributes of the result.
    """
    for site, attrs in recorded.items():
        settings = {name: attrs[name] for name in ("steps", "iterations", "method") if name in attrs}
        if rule := named_rule(str(attrs.get("rule", "None"))):
            settings["rule"] = rule
        numpyro_model = complete(numpyro_model, **settings)
        numpyro_model.only_site = site or None
    return numpyro_model


def _missing_keywords(numpyro_model: Callable, arguments: Mapping[str, Any]) -> list[str]:
    """Return the names of keyword arguments that the model has no value of."""
    return [name for name, parameter in further_parameters(numpyro_model).items()
            if name not in arguments and parameter.kind is not parameter.VAR_KEYWORD
            and (parameter.default is None or parameter.default is parameter.empty)]


def check_likelihood(result: Any, log_likelihood: np.ndarray, draw_index: np.ndarray) -> None:
    """Compare log likelihoods (C, S) at draws ``chosen`` (S,) of each chain with those that the result records.

    Raises:
        ValueError: they differ: model, options or data are not the ones of the result.
    """
    groups = ResultView.of(result).groups
    if "one_step_ahead" not in groups:
        return
    terms = groups["one_step_ahead"]["log_density"].transpose("chain", "draw", ...)
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
