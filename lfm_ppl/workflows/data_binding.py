"""Binding of a model to data whose times are dates or have a unit, counted in the unit of time that the model names."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.inference.bind import bind
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.problem import signature
from lfm_ppl.inference.trace import SharedModel
from lfm_ppl.inference.trajectories import has_noise_of_rows
from lfm_ppl.io.data import as_data
from lfm_ppl.io.data_set import Data, at_origin, in_unit, keywords_by_site, model_keywords
from lfm_ppl.io.table import is_table
from lfm_ppl.likelihoods.handlers.approximate import complete
from lfm_ppl.model.events import Event
from lfm_ppl.model.inputs import Input
from lfm_ppl.utils import calendar_time, checks, date_warnings


class SiteData(NamedTuple):
    """The data of a likelihood site.

    Attributes:
        on_clock: the data with times in the unit of the model; None where times and y were passed themselves.
        unit: the unit of time of the data that were passed; None where it is unknown.
        labelled_y: the observations where they were passed themselves, whose labels may name dimensions.
    """

    on_clock: Data | None
    unit: str | None
    labelled_y: Any

    @classmethod
    def of(cls, data: Any, on_clock: Any) -> SiteData:
        """Return the data of a site from what was passed, `Data` or (times, y), and the same on the model's clock."""
        on_clock = on_clock if isinstance(on_clock, Data) else None
        if isinstance(data, Data):
            return cls(on_clock, data.units.get("time"), None)
        return cls(on_clock, None, data[1])


class BoundData(NamedTuple):
    """A model that is bound to its data.

    Attributes:
        bound: the bound model.
        series: the data by likelihood site, also of one site.
        clock: the calendar time of t = 0 (None where times are plain numbers) with the unit of time.
        model_kwargs: keyword arguments of the model; of one site with the known inputs of its data.
    """

    bound: BoundModel
    series: dict[str, SiteData]
    clock: tuple[str | None, str]
    model_kwargs: Mapping[str, Any] | None


def bind_data(numpyro_model: Callable, times: Any, y: Any, model_kwargs: Mapping[str, Any] | None) -> BoundData:
    """Bind a model to data with dates or units, of one likelihood site or by site; arguments as `lfm_ppl.fit`."""
    site_data = data_by_site(times, y)
    if site_data is not None:
        bound, on_clock, clock = bind_sites(numpyro_model, site_data, model_kwargs)
        return BoundData(bound, {name: SiteData.of(value, on_clock[name]) for name, value in site_data.items()}, clock,
                         model_kwargs)
    table = as_data(times) if y is None else None
    pair = (times, y) if table is None else (table.times, table.y)
    bound, data, clock = bind_dates(numpyro_model, pair[0], pair[1], table, model_kwargs)
    keywords = model_kwargs if data is None else model_keywords(data.inputs, model_kwargs)
    return BoundData(bound, {bound.site.name: SiteData.of(times if isinstance(times, Data) else pair, data)}, clock,
                     keywords)


def bind_dates(numpyro_model: Callable, times: Any, y: Any, data: Data | None,
               model_kwargs: Mapping[str, Any] | None) -> tuple[BoundModel, Data | None, tuple[str | None, str]]:
    """Bind a model to its data.

    Args:
        numpyro_model: the model.
        times: (T,) or (B, T), numbers or dates.
        y: the observations, or a data frame of them.
        data: the object that holds times and y; None where they were passed themselves.
        model_kwargs: keyword arguments of the model, without the known inputs of ``data``.

    Returns:
        The bound model; the data, with times in the unit of the model where both have one; the calendar time of t = 0
        (None where times are plain numbers) with the unit of time (empty where it is unknown).
    """
    checks.refuse_durations("times", times)
    origin, unit = (None, "") if data is None else (data.origin, data.units.get("time", ""))
    if calendar_time.holds_dates(times):
        times, origin, unit = calendar_time.numbers_of("times", times)
        date_warnings.warn_of_changed_clock("times[{}]".format, times, origin, unit)
    elif data is None:
        _warn_of_compact_dates("times", times)
    values = y.to_numpy(float) if hasattr(y, "to_numpy") else y  # a data frame

    def bind_in(origin: str | None, unit: str) -> BoundModel:
        keywords = dict(model_kwargs or {}) if data is None else model_keywords(data.inputs, model_kwargs)
        with calendar_time.in_messages(origin, unit):
            return _bind(numpyro_model, times, values, keywords)

    bound = bind_in(origin, unit)
    # The model names its unit only once it has been built, which needs times.
    model_unit = bound.site.example.ssm.model.units.get("time", "")
    data_seconds, model_seconds = (calendar_time.SECONDS.get(name) for name in (unit, model_unit))
    if data_seconds is None or model_seconds is None or data_seconds == model_seconds:
        return bound, data, (origin, unit)
    _check_unit_of_inputs(model_kwargs, data, unit, model_unit)
    times = np.asarray(times) * (data_seconds / model_seconds)
    data = None if data is None else at_origin(data, origin, model_unit)
    return bind_in(origin, model_unit), data, (origin, model_unit)


def _warn_of_compact_dates(name: str, times: Any) -> None:
    """Warn of an array of whole numbers that are all dates YYYYMMDD."""
    if np.ndim(times) == 1 and not checks.traced(times) and np.asarray(times).dtype.kind in "iuf":
        if (dates := calendar_time.compact_dates(times)) is not None:
            date_warnings.warn_of_compact_dates(name, np.asarray(times)[0], dates[0])


def _check_unit_of_inputs(model_kwargs: Mapping[str, Any] | None, data: Data | None, unit: str,
                          model_unit: str) -> None:
    """Raise ValueError where a known input or dose of the data, in their unit, is an argument of a model in another.

    Warn of other ones where times are numbers: the data are converted, and the unit of these inputs is not known.
    """
    def is_event_or_input(value: Any) -> bool:
        return isinstance(value, Input | Event)

    leaves = jax.tree.leaves(dict(model_kwargs or {}), is_leaf=is_event_or_input)
    members = [value for value in leaves if is_event_or_input(value)]
    if data is None or not members:
        return
    for member in members:
        if any(np.array_equal(member.times, table.times) for table in data.inputs.values()):
            raise ValueError(f"model_kwargs hold a known input or doses of the data with times in {unit}, and the "
                             f"model counts {model_unit}. Leave them out: the model gets them, converted.")
    if data.origin is None:
        checks.warn(f"the times of the data are converted from {unit} to {model_unit}, the unit of the model. The "
                    f"times of known inputs and doses in model_kwargs are not, and are taken to be in {model_unit}.")


def completed_model(numpyro_model: Callable, settings: Mapping[str, Any]) -> Callable:
    """Return the model with settings of its likelihoods by name, where it leaves them open."""
    def modify(model: Callable) -> Callable:
        return complete(model, **settings)

    if not settings or not callable(numpyro_model):
        return numpyro_model
    if isinstance(numpyro_model, SharedModel):
        return numpyro_model.modified(("complete", signature(dict(settings))), modify)
    return modify(numpyro_model)


def warn_of_named_settings(bound: BoundModel, settings: Mapping[str, Any]) -> None:
    """Warn of settings of `lfm_ppl.fit` of which the model names other values, which stay."""
    for site_model in bound.site_models.values():
        likelihood, name = site_model.site.example, site_model.site.name
        for setting, value in settings.items():
            if (named := getattr(likelihood.settings, setting)) != value:
                checks.warn(f"the model names {setting}={named} in its likelihood {name!r}, which stays: {setting}="
                            f"{value} has no effect. lfm.approximate(model, {setting}=...) replaces it.")


def data_by_site(times: Any, y: Any) -> dict[str, Any] | None:
    """Return the data of each likelihood site, from a dict of data or from two dicts; None for data of one site.

    Raises:
        TypeError: some entries of the dict are data of a site and others are not.
    """
    if not isinstance(times, Mapping) or not times:
        return None
    if isinstance(y, Mapping):
        return {name: (values, y.get(name)) for name, values in times.items()}
    # A dict of columns is a table, of one site.
    if y is not None or not any(map(_is_of_site, times.values())):
        return None
    for name, value in times.items():
        if not _is_of_site(value):
            raise TypeError(f"the data of the likelihood site {name!r} must be lfm.Data, a DataFrame or a pair "
                            f"(times, y), got {type(value).__name__}.")
    return {name: tuple(value) if isinstance(value, list) else value if isinstance(value, tuple) else as_data(value)
            for name, value in times.items()}


def _is_of_site(value: Any) -> bool:
    """Return whether a value is the data of a site, `Data`, a table or a pair of times and y; not a column."""
    if isinstance(value, (tuple, list)):
        return len(value) == 2 and np.ndim(value[0]) > 0
    return isinstance(value, (Data, Mapping)) or is_table(value) and hasattr(value, "columns")


def of_site(argument: str, value: Any, name: str, sites: Collection[str]) -> Any:
    """Return an argument for one site of several, which may be a dict by site; None where the site has no entry."""
    if not sites or not isinstance(value, Mapping):
        return value
    for site in value:
        if site not in sites:
            raise ValueError(f"{argument}: {checks.unknown('likelihood site', site, sites)}")
    return value.get(name)


def coords_of_site(coords: Mapping[str, Any] | None, name: str, sites: Collection[str]) -> dict[str, Any]:
    """Return the labels of the dimensions of a site of several, ``y_output`` as ``output``, without other sites'."""
    if not sites:
        return dict(coords or {})
    prefix, other_prefixes = f"{name}_", tuple(f"{site}_" for site in sites if site != name)
    return {dim.removeprefix(prefix): labels for dim, labels in (coords or {}).items()
            if dim.startswith(prefix) or not dim.startswith(other_prefixes)}


def bind_sites(numpyro_model: Callable, sites: Mapping[str, Any], model_kwargs: Mapping[str, Any] | None
               ) -> tuple[BoundModel, dict[str, Any], tuple[str | None, str]]:
    """Bind a model with several likelihood sites to its data, with dates of all sites on one clock.

    Args:
        numpyro_model: the model.
        sites: name of the site -> `Data` or a pair of times and observations.
        model_kwargs: keyword arguments of the model, without the known inputs of the data.

    Returns:
        The bound model; the data of each site, `Data` or a pair; the clock, as `bind_dates`.
    """
    pairs = [name for name, value in sites.items() if not isinstance(value, Data)]
    sites = {name: _dated(*value) if name in pairs else value for name, value in sites.items()}
    origins = [value.origin for value in sites.values() if isinstance(value, Data) and value.origin is not None]
    if len(origins) < len(sites):
        if origins:
            raise ValueError("the times of some sites are dates and the others are numbers: give dates for all sites, "
                             "or numbers for all.")
        return *_bind_numbers(numpyro_model, sites, model_kwargs), (None, "")
    calendar_time.check_offsets({name: value.origin for name, value in sites.items()})
    unit = next(iter(sites.values())).units["time"]
    origin = origins[int(np.argmin([calendar_time.positions("times", date, origins[0], unit) for date in origins]))]

    def bind_in(unit: str) -> tuple[BoundModel, dict[str, Any], tuple[str | None, str]]:
        on_clock: dict[str, Any] = {name: at_origin(value, origin, unit) for name, value in sites.items()}
        on_clock |= {name: (on_clock[name].times, on_clock[name].y) for name in pairs}
        with calendar_time.in_messages(origin, unit):
            return _bind_sites(numpyro_model, on_clock, model_kwargs), on_clock, (origin, unit)

    bound, data, clock = bind_in(unit)
    # A model names its unit only once it has been built, which needs times.
    units = [model.site.example.ssm.model.units.get("time") for model in bound.site_models.values()]
    model_unit = next((name for name in units if name in calendar_time.SECONDS), unit)
    return (bound, data, clock) if model_unit == unit else bind_in(model_unit)


def _bind_numbers(numpyro_model: Callable, sites: Mapping[str, Any],
                  model_kwargs: Mapping[str, Any] | None) -> tuple[BoundModel, dict[str, Any]]:
    """Bind a model to sites whose times are numbers; those with a unit are converted to that of the model.

    Where the model of a site names no unit, they are converted to that of the first site with one.
    """
    bound = _bind_sites(numpyro_model, sites, model_kwargs)
    first = next((value.units["time"] for value in sites.values()
                  if isinstance(value, Data) and value.units.get("time") in calendar_time.SECONDS), "")
    units = {name: site_model.site.example.ssm.model.units.get("time", first)
             for name, site_model in bound.site_models.items()}
    converted = {name: in_unit(value, units[name]) if isinstance(value, Data) else value
                 for name, value in sites.items()}
    if all(converted[name] is value for name, value in sites.items()):
        return bound, converted
    return _bind_sites(numpyro_model, converted, model_kwargs), converted


def _dated(times: Any, y: Any) -> Data | tuple[Any, Any]:
    """Return times and observations, as `Data` where times are dates."""
    checks.refuse_durations("times", times)
    y = y.to_numpy(float) if hasattr(y, "to_numpy") else y
    if not calendar_time.holds_dates(times):
        return times, y
    columns = np.asarray(checks.unmask(y), float).reshape(len(times), -1)
    return Data(times, columns, tuple(map(str, range(columns.shape[1]))))


def _bind_sites(numpyro_model: Callable, sites: Mapping[str, Any],
                model_kwargs: Mapping[str, Any] | None) -> BoundModel:
    pairs = {name: (value.times, value.y) if isinstance(value, Data) else value for name, value in sites.items()}
    keywords = keywords_by_site({name: model_keywords(value.inputs, None) if isinstance(value, Data) else {}
                                 for name, value in sites.items()})
    times, y = ({name: pair[index] for name, pair in pairs.items()} for index in (0, 1))
    return _bind(numpyro_model, times, y, keywords | dict(model_kwargs or {}))


def _bind(numpyro_model: Callable, times: Any, y: Any, model_kwargs: dict[str, Any]) -> BoundModel:
    try:
        return bind(numpyro_model, times, y, **model_kwargs)
    except TypeError as error:
        if "'NoneType'" not in str(error) or "inputs" in model_kwargs or (
                "inputs" not in inspect.signature(numpyro_model).parameters):
            raise
        raise TypeError("the model has an argument `inputs`, and there are none. Name their columns, "
                        "lfm.read_table(frame, inputs=[...]), or give lfm.Data(..., inputs={...}).") from error


def check_requested_times(bound: BoundModel, times: Any, name: str = "at") -> None:
    """Check the times of trajectories, (K,), or (B, K) for each series; None: a grid over the data.

    Raises:
        ValueError: a wrong shape; a time before the initial time.
    """
    if times is None:
        return
    example = bound.site.example
    has_series_times = bound.times.ndim == 2
    if np.ndim(times) > 1 and not (has_series_times and np.shape(times)[:-1] == (len(bound.times),)):
        expected = f"(K,), or ({len(bound.times)}, K) for each series" if has_series_times else "(K,)"
        raise ValueError(f"{name} must have shape {expected}, got {np.shape(times)}.")
    data_times = bound.times if has_series_times else [bound.times]
    rows = times if np.ndim(times) == 2 else [times] * len(data_times)
    members = bound.site.members if has_series_times else [example]
    for series, (member, observed, requested) in enumerate(zip(members, data_times, rows, strict=True)):
        try:
            settings = member.settings
            build_time_grid(member.ssm, observed, settings.steps, settings.max_step, requested,
                            tolerance=settings.tolerance)
        except ValueError as error:
            raise ValueError(f"series {series}: {error}" if has_series_times else str(error)) from None


def warn_of_missing_predictions(bound: BoundModel, times: Any) -> None:
    """Warn where new observations at the times of the trajectories have no distribution."""
    if times is None or np.array_equal(np.asarray(times, float), bound.times) or not has_noise_of_rows(bound):
        return
    checks.warn("at: the noise differs between the rows of the data, so that new observations at these times cannot be "
                "predicted; the result has trajectories there, and no group `predictions`. For predictions give a "
                "function (x, u, t) or one number for all rows as covariance.")
