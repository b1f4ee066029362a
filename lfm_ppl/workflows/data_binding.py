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
from lfm_ppl.inference.trajectories import has_noise_of_rows
from lfm_ppl.inference.unbound_model import SharedModel
from lfm_ppl.io.data import as_data
from lfm_ppl.io.data_set import Data, at_origin
from lfm_ppl.io.input_table import keywords_by_site, model_keywords
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


class BoundData(NamedTuple):
    """A model that is bound to its data.

    Attributes:
        bound: the bound model.
        series: the data by likelihood site, also of one site.
        clock: the calendar time of t = 0 (None where times are plain numbers) with the unit of time (empty where it is
            unknown, or where sites have units of their own).
        model_kwargs: keyword arguments of the model; of one site with the known inputs of its data.
    """

    bound: BoundModel
    series: dict[str, SiteData]
    clock: tuple[str | None, str]
    model_kwargs: Mapping[str, Any] | None


class _Record(NamedTuple):
    """Observations of a site, with numbers as times.

    Attributes:
        times, y: (T,) or (B, T); the observations.
        data: the object that holds them; None where times and y were passed themselves.
        origin: the calendar time of t = 0; None for plain numbers.
        unit: of the times; empty where it is unknown.
    """

    times: Any
    y: Any
    data: Data | None
    origin: str | None
    unit: str

    @classmethod
    def of(cls, value: Data | tuple[Any, Any], label: str) -> _Record:
        """Return the record of `Data`, or of a pair of times, which may be dates, and observations."""
        if isinstance(value, Data):
            return cls(value.times, value.y, value, value.origin, value.units.get("time", ""))
        times, y = value
        y = y.to_numpy(float) if hasattr(y, "to_numpy") else y  # a data frame
        checks.refuse_durations(label, times)
        if not calendar_time.holds_dates(times):
            _warn_of_compact_dates(label, times)
            return cls(times, y, None, None, "")
        numbers, origin, unit = calendar_time.numbers_of(label, times)
        date_warnings.warn_of_changed_clock(f"{label}[{{}}]".format, numbers, origin, unit)
        return cls(numbers, y, None, origin, unit)

    def on_clock(self, origin: str | None, unit: str) -> _Record:
        """Return the record with times that count from another origin in another unit; without a unit as it is."""
        seconds, new_seconds = (calendar_time.SECONDS.get(name) for name in (self.unit, unit))
        if seconds is None or new_seconds is None or (self.origin, seconds) == (origin, new_seconds):
            return self
        if self.data is not None:
            data = at_origin(self.data, origin, unit)
            return _Record(data.times, self.y, data, origin, unit)
        shift = 0.0 if origin is None else float(calendar_time.positions("origin", self.origin, origin, unit))
        return _Record(np.asarray(self.times) * (seconds / new_seconds) + shift, self.y, None, origin, unit)


def bind_data(numpyro_model: Callable, times: Any, y: Any, model_kwargs: Mapping[str, Any] | None) -> BoundData:
    """Bind a model to data with dates or units, of one likelihood site or by site; arguments as `lfm_ppl.fit`.

    1. Dates of all sites are counted from the first one. Numbers stay.
    2. The model is bound. It names its unit of time only once it has been built, which needs times.
    3. Where that is another unit, times and known inputs of the data are converted, and the model is bound again.
    """
    passed = data_by_site(times, y)
    is_by_site = passed is not None
    if passed is None:
        passed = {"": as_data(times) if y is None else (times, y)}
    records = {name: _Record.of(value, f"times[{name!r}]" if is_by_site else "times")
               for name, value in passed.items()}
    origin, unit = _common_clock(records)
    if origin is not None:
        records = {name: record.on_clock(origin, unit) for name, record in records.items()}

    def bind_records(records: Mapping[str, _Record], unit: str) -> BoundModel:
        with calendar_time.in_messages(origin, unit):
            return _bind(numpyro_model, records, is_by_site, model_kwargs)

    bound = bind_records(records, unit)
    unit, converted = _in_units_of(bound, records, origin, unit)
    if any(converted[name] is not record for name, record in records.items()):
        for name, record in converted.items():
            if record is not records[name]:
                _check_unit_of_inputs(model_kwargs, records[name].data, records[name].unit, record.unit)
        bound = bind_records(converted, unit)
    series = {}
    for name, record in converted.items():
        value = passed[name]
        unit_and_labels = (value.units.get("time"), None) if isinstance(value, Data) else (None, value[1])
        series[name if is_by_site else bound.site.name] = SiteData(record.data, *unit_and_labels)
    if not is_by_site and converted[""].data is not None:
        model_kwargs = model_keywords(converted[""].data.inputs, model_kwargs)
    return BoundData(bound, series, (origin, unit), model_kwargs)


def _common_clock(records: Mapping[str, _Record]) -> tuple[str | None, str]:
    """Return the first origin and the unit of the first site; None where times are numbers.

    Raises:
        ValueError: the times of some sites alone are dates, or the clocks of the sites have no common zero.
    """
    first = next(iter(records.values()))
    origins = {name: record.origin for name, record in records.items()}
    dates = [date for date in origins.values() if date is not None]
    if not dates:
        return None, "" if len(records) > 1 else first.unit
    if len(dates) < len(records):
        raise ValueError("the times of some sites are dates and the others are numbers: give dates for all sites, or "
                         "numbers for all.")
    calendar_time.check_offsets(origins)
    return dates[int(np.argmin([calendar_time.positions("times", date, dates[0], first.unit) for date in dates]))], (
        first.unit)


def _in_units_of(bound: BoundModel, records: Mapping[str, _Record], origin: str | None,
                 unit: str) -> tuple[str, dict[str, _Record]]:
    """Return the unit of the clock, and records in the units of time that the models of their sites name.

    Dates have one unit, the first that a model names. Where the model of a site of numbers names none, its unit is that
    of the first record with one.
    """
    models = bound.site_models
    named = {name: models.get(name, bound).site.example.ssm.model.units.get("time", "") for name in records}
    time_units = [name for name in named.values() if name in calendar_time.SECONDS]
    if origin is not None:
        unit = time_units[0] if time_units else unit
        return unit, {name: record.on_clock(origin, unit) for name, record in records.items()}
    first = next((record.unit for record in records.values() if record.unit in calendar_time.SECONDS), "")
    converted = {name: record.on_clock(None, named[name] or first) for name, record in records.items()}
    return (next(iter(converted.values())).unit if len(records) == 1 else ""), converted


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
            elif setting == "steps" and (named := likelihood.settings.integration_steps) != value:
                checks.warn(f"the model names filter_steps={named} in its likelihood {name!r}, which stays: steps="
                            f"{value} holds for simulations only. lfm.approximate(model, steps=...) replaces both.")


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


def _bind(numpyro_model: Callable, records: Mapping[str, _Record], is_by_site: bool,
          model_kwargs: Mapping[str, Any] | None) -> BoundModel:
    """Bind a model to records, by site or of one, with their known inputs as keyword arguments."""
    inputs = {name: {} if record.data is None else model_keywords(record.data.inputs, None)
              for name, record in records.items()}
    times, y = ({name: getattr(record, field) for name, record in records.items()} for field in ("times", "y"))
    keywords = (keywords_by_site(inputs) if is_by_site else inputs[""]) | dict(model_kwargs or {})
    try:
        return bind(numpyro_model, times if is_by_site else times[""], y if is_by_site else y[""],
                    model_kwargs=keywords)
    except TypeError as error:
        if "'NoneType'" not in str(error) or "inputs" in keywords or (
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
