"""Data sets: times, observations, known inputs, units, and the truth of simulated data.

1. `Data` checks shapes, and converts dates to numbers in the model's unit of time.
2. Known inputs are tables with an interpolation; blank cells are interpolated, or zero.
3. Data sets of one record are put on one origin of time (`on_clock_of`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lfm_ppl.utils import calendar_time, checks

if TYPE_CHECKING:
    from lfm_ppl.model.inputs import Input


INTERPOLATIONS = ("previous", "linear", "zero")
"""How known inputs are read; "zero" is "previous" with blank cells read as zero."""


class InputTable(NamedTuple):
    """A known input as it was measured.

    Attributes:
        times: (K,), increasing.
        values: (K,).
        interpolation: "previous" or "linear".
    """

    times: np.ndarray
    values: np.ndarray
    interpolation: str = "previous"


@dataclass(frozen=True)
class Data:
    """Observations y_k at times t_k of named outputs, and the truth where it is known.

    Attributes:
        times: t_k, shape (T,), non-decreasing; equal times are replicates.
        y: observations, shape (T, D); NaN is a missing value.
        outputs: the names of the D outputs.
        units: name -> unit, for ``time``, outputs, states, forces and known inputs; incomplete is fine.
        truth: for simulated data, a mapping with any of ``times`` (K,), ``forces`` (name -> (K,)),
            ``deterministics`` (name -> (K,)), ``state`` (K, M) and ``parameters`` (name -> array).
        note: what was done to the numbers, to be printed with the results.
        inputs: known inputs: name -> (times, values) or (times, values, "linear"), or an `lfm.Input`; kept as
            `InputTable`. `known_inputs` gives them as functions of time. Missing values are left out, or with "zero"
            read as zero.
        origin: the calendar time of t = 0 as ISO 8601 text, where the times were dates.

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

    def __post_init__(self) -> None:
        """Convert to arrays and check that the shapes fit together."""
        if calendar_time.holds_dates(self.times):
            self._read_dates()
        checks.refuse_durations("times", self.times)
        object.__setattr__(self, "times", np.asarray(checks.unmask(self.times), dtype=float))
        object.__setattr__(self, "y", np.asarray(checks.unmask(self.y), dtype=float))
        object.__setattr__(self, "outputs", tuple(self.outputs))
        object.__setattr__(self, "inputs", {name: self._table_of(name, table) for name, table in self.inputs.items()})
        expected = (len(self.times), len(self.outputs))
        if self.times.ndim != 1 or self.y.shape != expected:
            raise ValueError(
                f"y must have shape (times, outputs) = {expected}, got {self.y.shape} for times "
                f"of shape {self.times.shape} and outputs {self.outputs}."
            )
        checks.finite("times", self.times)
        if np.any(np.diff(self.times) < 0):
            index = int(np.argmax(np.diff(self.times) < 0)) + 1
            raise ValueError(
                f"times must not go back, got {self.times[index]:g} after "
                f"{self.times[index - 1]:g} at index {index}. Sort the observations by time."
            )

    def _read_dates(self) -> None:
        """Convert times that are dates, and note their origin and unit."""
        unit = self.units.get("time")
        if unit is not None:
            checks.one_of('units["time"]', unit, calendar_time.SECONDS)
        times, origin, unit = calendar_time.numbers_of("times", self.times, unit)
        if self.origin is not None:
            times, origin = calendar_time.positions("times", self.times, self.origin, unit), self.origin
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "origin", origin)
        object.__setattr__(self, "units", {**self.units, "time": unit})

    def _table_of(self, name: str, value: Any) -> InputTable:
        """Return a known input as it is kept.

        Raises:
            TypeError: neither a tuple of times and values nor an `lfm.Input`.
        """
        if all(hasattr(value, part) for part in InputTable._fields):  # an Input
            value = tuple(getattr(value, part) for part in InputTable._fields)
        if not (isinstance(value, tuple) and 2 <= len(value) <= 3):
            raise TypeError(f"the known input {name!r} must be (times, values), (times, values, interpolation) or an "
                            f"lfm.Input, got {type(value).__name__}.")
        times, values, *way = value
        label = f"times of the known input {name!r}"
        checks.refuse_durations(label, times)
        times = calendar_time.positions(label, times, self.origin, self.units.get("time", ""))
        times, values = (np.asarray(checks.unmask(part), float) for part in (times, values))
        interpolation = way[0] if way else "previous"
        if times.shape == values.shape and times.ndim == 1 and np.isnan(values).any():
            if interpolation != "zero" and np.isnan(values).all():
                raise ValueError(f"every value of the known input {name!r} is missing; expected at least one number.")
            values = fill_blanks(f"the known input {name!r}", f"{name!r}: (times, values, 'zero')", times, values,
                                  interpolation)
            times, values = times[~np.isnan(values)], values[~np.isnan(values)]
        return InputTable(times, values, stored_interpolation(interpolation))

    def known_inputs(self) -> dict[str, Input]:
        """Return the known inputs as functions of time, for the ``inputs`` argument of a model."""
        return as_inputs(self.inputs)


def as_inputs(tables: Mapping[str, InputTable]) -> dict[str, Input]:
    """Return known inputs as functions of time."""
    # Here and not before: arrays made before float64 is enabled stay in float32.
    from lfm_ppl.model.inputs import Input

    return {name: Input(*table, name=name) for name, table in tables.items()}


def model_keywords(tables: Mapping[str, InputTable], model_kwargs: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the keyword arguments of a model: those given, and ``inputs`` where there are known inputs."""
    return {**({"inputs": as_inputs(tables)} if tables else {}), **(model_kwargs or {})}


def on_clock_of(data: Data, reference: Data) -> Data:
    """Return data with their times counted from the origin of other data, in their unit.

    Raises:
        ValueError: the times of one are dates and of the other plain numbers, or only one has an offset from UTC.
    """
    if data.origin is None and reference.origin is None:
        return data
    if data.origin is None or reference.origin is None:
        dated, plain = ("first", "others") if data.origin else ("others", "first")
        raise ValueError(f"the times of two tables cannot be compared: the times of the {dated} are dates, "
                         f"the times of the {plain} plain numbers.")
    return at_origin(data, reference.origin, reference.units["time"])


def at_origin(data: Data, origin: str, unit: str) -> Data:
    """Return data, whose times were dates, with their times counted from another origin, in another unit.

    Raises:
        ValueError: only one of the origins has an offset from UTC.
    """
    assert data.origin is not None
    ratio = calendar_time.SECONDS[data.units["time"]] / calendar_time.SECONDS[unit]
    shift = calendar_time.position(data.origin, origin, unit)
    truth = data.truth
    if truth is not None and truth.get("times") is not None:
        truth = {**truth, "times": np.asarray(truth["times"], float) * ratio + shift}
    return replace(data, times=data.times * ratio + shift, truth=truth, origin=origin,
                   units={**data.units, "time": unit},
                   inputs={name: table._replace(times=table.times * ratio + shift)
                           for name, table in data.inputs.items()})


def number_array(name: str, value: Any) -> np.ndarray:
    """Return an array of numbers; ValueError names the argument."""
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be numbers, in rows of one length.") from None


def zero_option(name: str) -> str:
    """Return how to say that empty cells of a column are zero."""
    return f"--inputs {name}:zero (inputs={{{name!r}: 'zero'}})"


def stored_interpolation(interpolation: str) -> str:
    """Return how a known input is interpolated once its empty cells have been read."""
    return "previous" if interpolation == "zero" else interpolation


def fill_blanks(label: str, option: str, times: np.ndarray, values: np.ndarray, interpolation: str) -> np.ndarray:
    """Return the values (K,) of a known input, with zeros for blank ones where that is how they are read.

    Args:
        label: of the input, for messages.
        option: how to say that blank values are zero.
        times: (K,).
        values: (K,), NaN where blank. A blank value at the time of another row that has one says nothing.
        interpolation: one of `INTERPOLATIONS`.

    Warns:
        UserWarning: of blank values over which the input is interpolated.
    """
    is_blank = np.isnan(values) & ~np.isin(times, times[np.isfinite(values)])
    if interpolation == "zero":
        return np.where(is_blank, 0.0, values)
    if is_blank.any():
        reading = "a line joins the values beside them" if interpolation == "linear" else "the last value holds there"
        checks.warn(f"{label}: {int(is_blank.sum())} of {len(values)} values of the known input are blank, and "
                    f"{reading}. If blank means zero, as for a dose, say so: {option}.")
    return values
