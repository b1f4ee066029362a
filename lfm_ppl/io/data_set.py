"""Data sets: times, observations, known inputs, units, and the truth of simulated data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from lfm_ppl.io.input_table import OF_SERIES, as_events, as_inputs, input_table
from lfm_ppl.utils import calendar_time, checks, date_warnings

if TYPE_CHECKING:
    from lfm_ppl.model.events import Event
    from lfm_ppl.model.inputs import Input


@dataclass(frozen=True)
class Data:
    """Observations y_k at times t_k of named outputs, and the truth where it is known.

    Attributes:
        times: t_k, shape (T,), non-decreasing; equal times are replicates. (B, T) for the series of a panel.
        y: observations, shape (T, D), or (B, T, D); NaN is a missing value.
        outputs: the names of the D outputs.
        units: name -> unit, for ``time``, outputs, states, forces and known inputs; incomplete is fine.
        truth: for simulated data, a mapping with any of ``times`` (K,), ``forces`` (name -> (K,)),
            ``deterministics`` (name -> (K,)), ``state`` (K, M) and ``parameters`` (name -> array).
        note: what was done to the numbers, to be printed with the results.
        inputs: known inputs: name -> (times, values) or (times, values, "linear"), or an `lfm.Input`; kept as
            `InputTable`. `known_inputs` gives them as functions of time. Missing values are left out, or with "zero"
            read as zero. (times, amounts, "dose:STATE") are doses to a state, which a model gets as `lfm.Dose` in its
            argument ``events``. Those of a file may be infusions and resets, too.
        origin: the calendar time of t = 0 as ISO 8601 text, where the times were dates.
        series: labels of the B series of a panel; empty for one series.

    Times, also of inputs, may be dates (``datetime64``, a DatetimeIndex, ...). They become numbers since the
    origin, by default the midnight before the first of them, in the unit of ``units["time"]``, by default that of the
    time between rows.

    Raises:
        ValueError: if the shapes do not fit together or the times go back.

    Example:
        >>> data = Data(times=[0.0, 1.0], y=[[1.0], [float("nan")]], outputs=("x",))
        >>> data.y.shape
        (2, 1)
    """

    times: np.ndarray
    y: np.ndarray
    outputs: tuple[str, ...]
    units: Mapping[str, str] = field(default_factory=dict)
    truth: Mapping[str, Any] | None = None
    note: str = ""
    inputs: Mapping[str, Any] = field(default_factory=dict)
    origin: str | None = None
    series: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Convert to arrays and check that the shapes fit together."""
        times, origin, units = self.times, self.origin, dict(self.units)
        checks.refuse_durations("times", times)
        if unit := units.get("time"):
            units["time"] = calendar_time.UNITS.get(unit, unit)
        if calendar_time.holds_dates(times):
            if unit:
                checks.one_of('units["time"]', unit, calendar_time.SECONDS)
            numbers, midnight, units["time"] = calendar_time.numbers_of("times", times, unit)
            date_warnings.warn_of_changed_clock("times[{}]".format, numbers, midnight, units["time"])
            times = calendar_time.positions("times", times, origin, units["time"]) if origin else numbers
            origin = origin or midnight
        times, y = (np.asarray(checks.unmask(values), float) for values in (times, self.y))
        inputs = {name: input_table(name, value, origin, units.get("time", "")) for name, value in self.inputs.items()}
        for name, value in {"times": times, "y": y, "outputs": tuple(self.outputs), "units": units, "inputs": inputs,
                            "origin": origin}.items():
            object.__setattr__(self, name, value)
        lead = (len(self.series),) if self.series else ()
        if times.shape[:-1] != lead or times.ndim == 0 or y.shape != (*times.shape, len(self.outputs)):
            expected = (*lead, times.shape[-1] if times.ndim else 1, len(self.outputs))
            raise ValueError(f"y must have shape ({'series, ' if lead else ''}times, outputs) = {expected}, got "
                             f"{y.shape} for times of shape {times.shape} and outputs {self.outputs}.")
        checks.finite("times", times)
        for row in np.atleast_2d(times):
            if (row[1:] < row[:-1]).any():
                index = int(np.argmax(row[1:] < row[:-1])) + 1
                raise ValueError(f"times must not go back, got {row[index]:g} after {row[index - 1]:g} at index "
                                 f"{index}. Sort the observations by time.")

    def known_inputs(self) -> dict[str, Input]:
        """Return the known inputs as functions of time, for the ``inputs`` argument of a model."""
        return as_inputs(self.inputs)

    def doses(self) -> list[Event]:
        """Return the doses, infusions and resets among the known inputs, for the ``events`` argument of a model."""
        return as_events(self.inputs)


def at_origin(data: Data, origin: str | None, unit: str) -> Data:
    """Return data with their times in another unit, and counted from another origin where they were dates."""
    ratio = calendar_time.SECONDS[data.units["time"]] / calendar_time.SECONDS[unit]
    shift = 0.0 if origin is None else float(calendar_time.positions("origin", data.origin, origin, unit))
    truth = data.truth
    if truth is not None and truth.get("times") is not None:
        truth = {**truth, "times": np.asarray(truth["times"], float) * ratio + shift}
    inputs = {name: table.on_clock(ratio, shift) for name, table in data.inputs.items()}
    return replace(data, times=data.times * ratio + shift, truth=truth, origin=origin, inputs=inputs,
                   units={**data.units, "time": unit})


def in_unit(data: Data, unit: str) -> Data:
    """Return data with their times in another unit; unchanged where one of the units is none of `calendar_time`."""
    unit_of_data = data.units.get("time", "")
    if {unit, unit_of_data} <= set(calendar_time.SECONDS) and (
            calendar_time.UNITS[unit] != calendar_time.UNITS[unit_of_data]):
        return at_origin(data, data.origin, unit)
    return data


def on_clock_of_fit(data: Data, origin: str | None, unit: str, label: str) -> Data:
    """Return later data with times on the clock of a fit; ``label`` names them in errors.

    Raises:
        ValueError: dates for numbers or numbers for dates, or a unit of time that cannot be converted.
    """
    if (data.origin is None) != (origin is None):
        kinds = ("plain numbers", "dates") if data.origin is None else ("dates", "plain numbers")
        raise ValueError(f"{label}: its times are {kinds[0]}, the times of the result {kinds[1]}; use the same form.")
    data = in_unit(data, unit) if origin is None else at_origin(data, origin, unit)
    if (unit_of_data := data.units.get("time", unit)) != unit:
        raise ValueError(f"{label}: its times are in {unit_of_data}, which cannot be converted to the unit of the "
                         f"result, {unit or 'none'}.")
    return data


def stack_series(series: Mapping[str, Data]) -> Data:
    """Return the series of a panel as one data set, for a model with `lfm_ppl.panel`.

    Shorter series are padded with rows that are all missing, at their last time. Known inputs are named after their
    series, "dose of series Ann". The model gets them stacked, with a leading axis for the series, so that they can be
    entries of ``parameters`` of the panel.

    Args:
        series: label -> observations, as of `lfm_ppl.read_series`.

    Raises:
        ValueError: a series has other outputs or known inputs than the first one; not all times are dates.

    Example:
        >>> short, long = Data([0.0], [[1.0]], ("x",)), Data([0.0, 2.0], [[1.5], [0.5]], ("x",))
        >>> panel = stack_series({"Ann": short, "Bo": long})
        >>> panel.series, panel.times.tolist(), panel.y[0].ravel().tolist()
        (('Ann', 'Bo'), [[0.0, 0.0], [0.0, 2.0]], [1.0, nan])
    """
    label, first = next(iter(series.items()))
    for name, data in series.items():
        if (data.outputs, list(data.inputs), data.origin is None) != (
                first.outputs, list(first.inputs), first.origin is None):
            raise ValueError(f"series {name!r} must have the outputs and known inputs of series {label!r} "
                             f"({', '.join((*first.outputs, *first.inputs))}), and dates or numbers as times like it.")
    calendar_time.check_offsets({name: data.origin for name, data in series.items()})
    if first.origin is not None:
        origin = min(str(data.origin) for data in series.values())
        series = {name: at_origin(data, origin, first.units["time"]) for name, data in series.items()}
    rows = max(len(data.times) for data in series.values())
    times = [np.pad(data.times, (0, rows - len(data.times)), "edge") for data in series.values()]
    y = [np.pad(data.y, ((0, rows - len(data.y)), (0, 0)), constant_values=np.nan) for data in series.values()]
    inputs = {f"{name}{OF_SERIES}{label}": table for label, data in series.items()
              for name, table in data.inputs.items()}
    return replace(next(iter(series.values())), times=np.array(times), y=np.array(y), inputs=inputs,
                   series=tuple(series))


