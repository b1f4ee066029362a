"""Data sets: times, observations, known inputs, units, and the truth of simulated data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lfm_ppl.utils import calendar_time, checks, date_warnings

if TYPE_CHECKING:
    from lfm_ppl.model.events import Event
    from lfm_ppl.model.inputs import Input


INTERPOLATIONS = ("previous", "linear", "zero")
"""How known inputs are read; "zero" is "previous" with blank cells read as zero."""

DOSE = "dose:"
"""Beginning of ``dose:STATE,STATE``, which reads a known input as doses to states."""

ONCE = ":once"
"""End of ``dose:STATE:once``: the column repeats one dose, which is given at the first time."""

OF_SERIES = " of series "
"""Between the name of a known input and the label of its series in a panel."""


def dosed_states(interpolation: str) -> tuple[str, ...]:
    """Return the states in ``dose:STATE,STATE``; none of another interpolation."""
    if not interpolation.startswith(DOSE):
        return ()
    return tuple(interpolation.removeprefix(DOSE).removesuffix(ONCE).split(","))


class InputTable(NamedTuple):
    """A known input as it was measured.

    Attributes:
        times: (K,), increasing; for doses not decreasing.
        values: (K,).
        interpolation: "previous", "linear", or "dose:STATE,STATE" for doses to these states.
        durations: (K,), of doses that are infusions, zero for others; None: none is.
        compartments: (K,), indices of the states that receive the doses; None: the first one receives all.
        resets: (R,), times at which all states are set to zero, before a dose; None: none.
    """

    times: np.ndarray
    values: np.ndarray
    interpolation: str = "previous"
    durations: np.ndarray | None = None
    compartments: np.ndarray | None = None
    resets: np.ndarray | None = None

    @property
    def is_dose(self) -> bool:
        """Whether the values are doses, and not a function of time."""
        return self.interpolation.startswith(DOSE)

    @property
    def dosed_states(self) -> tuple[str, ...]:
        """Names of the states that receive the values as doses; empty for a function of time."""
        return dosed_states(self.interpolation)

    def on_clock(self, ratio: float, shift: float) -> InputTable:
        """Return the table with times ``ratio * t + shift``."""
        return self._replace(times=self.times * ratio + shift,
                             durations=None if self.durations is None else self.durations * ratio,
                             resets=None if self.resets is None else self.resets * ratio + shift)

    def continued(self, later: InputTable, later_resets: np.ndarray) -> InputTable:
        """Return the table up to the first time of a later one, followed by it.

        The later resets (R,), also of other tables, end the infusions that run. States that only the later table names
        are added.

        Raises:
            ValueError: one of the tables holds doses, the other one a function of time.
        """
        if self.is_dose != later.is_dose:
            kinds = [f"doses to {', '.join(table.dosed_states)}" if table.is_dose else "a function of time"
                     for table in (self, later)]
            raise ValueError(f"the known input is {kinds[0]} in the fit and {kinds[1]} in the later data; read it in "
                             "one manner.")
        earlier_resets, resets = (np.zeros(0) if table.resets is None else table.resets for table in (self, later))
        end = min(later.times.min(initial=np.inf), resets.min(initial=np.inf))
        is_earlier = self.times < end
        times, values = self.times[is_earlier], self.values[is_earlier]
        if not self.is_dose:
            return InputTable(np.append(times, later.times), np.append(values, later.values), self.interpolation)
        durations, later_durations = self.durations_of_all[is_earlier], later.durations_of_all
        values, durations = end_at_resets(times, values, durations, later_resets)
        states = list(dict.fromkeys((*self.dosed_states, *later.dosed_states)))
        index = np.array([states.index(state) for state in later.dosed_states])
        compartments = np.append(self.compartments_of_all[is_earlier], index[later.compartments_of_all])
        durations = np.append(durations, later_durations)
        resets = np.append(earlier_resets[earlier_resets < end], resets)
        return InputTable(np.append(times, later.times), np.append(values, later.values), DOSE + ",".join(states),
                          durations if durations.any() else None, compartments if len(states) > 1 else None,
                          resets if resets.size else None)

    @property
    def durations_of_all(self) -> np.ndarray:
        """Lengths (K,) of the infusions, zero for doses at once."""
        return np.zeros(len(self.times)) if self.durations is None else self.durations

    @property
    def compartments_of_all(self) -> np.ndarray:
        """Indices (K,) of the states that receive the doses."""
        return np.zeros(len(self.times), int) if self.compartments is None else self.compartments

    def event_arrays(self) -> dict[tuple[str, str], tuple[np.ndarray, ...]]:
        """Return the arrays of the doses as events: kind and state -> times, values and durations."""
        arrays: dict[tuple[str, str], tuple[np.ndarray, ...]] = {}
        if self.resets is not None and len(self.resets):
            arrays["reset", ""] = self.resets, np.zeros(len(self.resets)), np.zeros(len(self.resets))
        durations, compartments = self.durations_of_all, self.compartments_of_all
        for index, state in enumerate(self.dosed_states):
            for kind, is_kind in (("dose", durations == 0), ("infusion", durations > 0)):
                rows = is_kind & (compartments == index)
                if rows.any():
                    arrays[kind, state] = self.times[rows], self.values[rows], durations[rows]
        return arrays or {("dose", self.dosed_states[0]): (self.times, self.values, durations)}


def end_at_resets(times: np.ndarray, values: np.ndarray, durations: np.ndarray,
                  resets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return amounts (K,) and durations (K,) of doses whose infusions end at the next reset after their start.

    The rate of an infusion stays, and a dose at once (duration zero) is unchanged. ``resets`` (R,) are sorted.
    """
    next_reset = np.append(resets, np.inf)[np.searchsorted(resets, times, side="right")]
    shortened = np.minimum(durations, next_reset - times)
    is_ended = shortened < durations
    fraction = np.where(is_ended, shortened, 1.0) / np.where(is_ended, durations, 1.0)
    return values * fraction, shortened


def continued_inputs(tables: Mapping[str, InputTable], later: Mapping[str, InputTable]) -> dict[str, InputTable]:
    """Return the tables that later ones continue, by name, and the doses that later resets end.

    The later resets of a series, in any table, end the infusions in all tables of this series.
    """
    resets: dict[str, np.ndarray] = {}
    for name, table in later.items():
        series = name.partition(OF_SERIES)[2]
        resets[series] = np.union1d(resets.get(series, np.zeros(0)), np.zeros(0) if table.resets is None else
                                    table.resets)
    continued = {}
    for name, table in tables.items():
        later_resets = resets.get(name.partition(OF_SERIES)[2], np.zeros(0))
        if name in later:
            continued[name] = table.continued(later[name], later_resets)
        elif table.is_dose and later_resets.size:
            values, durations = end_at_resets(table.times, table.values, table.durations_of_all, later_resets)
            continued[name] = table._replace(values=values, durations=durations if durations.any() else None)
    return continued


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


def input_table(name: str, value: Any, origin: str | None, unit: str) -> InputTable:
    """Return a known input, (times, values), (times, values, interpolation) or an `lfm.Input`, as a table.

    Dates are counted from the ``origin`` in this unit; where the origin is None, times must be numbers.
    """
    if isinstance(value, InputTable) and value.is_dose:
        return value
    if all(hasattr(value, part) for part in InputTable._fields[:3]):  # an Input
        value = tuple(getattr(value, part) for part in InputTable._fields[:3])
    if not (isinstance(value, tuple) and 2 <= len(value) <= 3):
        raise TypeError(f"the known input {name!r} must be (times, values), (times, values, interpolation) or an "
                        f"lfm.Input, got {type(value).__name__}.")
    times, values, interpolation = (*value, "previous")[:3]
    if interpolation.startswith(DOSE) and interpolation.endswith(ONCE):
        raise ValueError(f"the known input {name!r}: {interpolation!r} is for a column of a file that repeats a dose; "
                         f"give the dose once, ([time], [amount], {interpolation.removesuffix(ONCE)!r}).")
    label = f"times of the known input {name!r}"
    checks.refuse_durations(label, times)
    times = calendar_time.positions(label, times, origin, unit)
    times, values = (np.asarray(checks.unmask(part), float) for part in (times, values))
    if times.shape == values.shape and times.ndim == 1 and np.isnan(values).any():
        if interpolation != "zero" and not interpolation.startswith(DOSE) and np.isnan(values).all():
            raise ValueError(f"every value of the known input {name!r} is missing; expected at least one number.")
        remedy = f"{name!r}: (times, values, 'zero')"
        values = fill_blanks(f"the known input {name!r}", remedy, times, values, interpolation)
        times, values = times[~np.isnan(values)], values[~np.isnan(values)]
    if interpolation.startswith(DOSE) and (values < 0).any():
        index = int(np.argmax(values < 0))
        raise ValueError(f"the known input {name!r}: the dose {values[index]:g} at index {index} is negative; give "
                         "amounts of zero or more.")
    return InputTable(times, values, "previous" if interpolation == "zero" else interpolation)


def as_inputs(tables: Mapping[str, InputTable]) -> dict[str, Input]:
    """Return known inputs as functions of time."""
    # Here and not before: arrays made before float64 is enabled stay in float32.
    from lfm_ppl.model.inputs import Input

    functions = {name: table for name, table in tables.items() if not table.is_dose}
    stacked = {}
    for name, members in _groups(functions).items():
        size = max(len(table.times) for table in members)
        entries = [Input(*_padded(table, size)[:3], name=name) for table in members]
        stacked[name] = entries[0] if name in tables else _stack(entries)
    return stacked


def as_events(tables: Mapping[str, InputTable]) -> list[Event]:
    """Return the doses among known inputs as events; resets come before doses at the same time."""
    events = []
    for name, members in _groups({name: table for name, table in tables.items() if table.is_dose}).items():
        arrays = [table.event_arrays() for table in members]
        kinds = sorted({kind for part in arrays for kind in part}, key=lambda kind: (kind[0] != "reset", *kind))
        for kind, state in kinds:
            parts = [part.get((kind, state), (np.zeros(0),) * 3) for part in arrays]
            entries = [_event(kind, state, *part) for part in _padded_events(kind, parts)]
            events.append(entries[0] if name in tables else _stack(entries))
    return events


def _event(kind: str, state: str, times: np.ndarray, values: np.ndarray, durations: np.ndarray) -> Event:
    from lfm_ppl.model.events import Dose, Infusion, Reset

    if kind == "reset":
        return Reset(times)
    return Dose(times, values, state) if kind == "dose" else Infusion(times, values, state, duration=durations)


def _padded_events(kind: str, parts: list[tuple[np.ndarray, ...]]) -> list[tuple[np.ndarray, ...]]:
    """Return times, values and durations of the series of a panel with equally many events.

    What is added never happens, or infuses nothing.
    """
    size = max(len(times) for times, _, _ in parts)
    # The times of an infusion set the scale to which times are compared.
    time = max(times.max(initial=0.0) for times, _, _ in parts) if kind == "infusion" else np.finfo(float).max
    fills = time, 0.0, 1.0
    return [tuple(np.append(array, np.full(size - len(array), fill)) for array, fill in zip(part, fills, strict=True))
            for part in parts]


def _groups(tables: Mapping[str, InputTable]) -> dict[str, list[InputTable]]:
    """Return the tables by the name of the input; the series of a panel have one each."""
    groups: dict[str, list[InputTable]] = {}
    for name, table in tables.items():
        groups.setdefault(name.partition(OF_SERIES)[0], []).append(table)
    return groups


def _stack(entries: Sequence[Any]) -> Any:
    import jax

    return jax.tree.map(lambda *leaves: np.stack(leaves), *entries)


def _padded(table: InputTable, size: int) -> InputTable:
    """Return a function of time with ``size`` rows; the last value follows the last time."""
    count = size - len(table.times)
    times = table.times[-1] + np.arange(1, count + 1)
    return table._replace(times=np.append(table.times, times),
                          values=np.append(table.values, np.full(count, table.values[-1])))


def model_keywords(tables: Mapping[str, InputTable], model_kwargs: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the keyword arguments of a model: those given, and ``inputs`` and ``events`` where the data have any."""
    from_data = {"inputs": as_inputs(tables), "events": as_events(tables)}
    return {**{name: value for name, value in from_data.items() if value}, **(model_kwargs or {})}


def keywords_by_site(sites: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return keyword arguments that are dicts by likelihood site, from the keyword arguments for each site."""
    names = {name: None for keywords in sites.values() for name in keywords}
    return {name: {site: keywords.get(name, {}) for site, keywords in sites.items()} for name in names}


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


def fill_blanks(label: str, remedy: str, times: np.ndarray, values: np.ndarray, interpolation: str) -> np.ndarray:
    """Return the values (K,) of a known input, with zeros for NaN where the interpolation is "zero".

    Otherwise warn of NaN, over which the input is interpolated; ``remedy`` says how to read them as zero. NaN beside a
    number of the same time counts as filled, and no dose is given where a dose is NaN.
    """
    if interpolation.startswith(DOSE):
        return values
    is_blank = np.isnan(values) & ~np.isin(times, times[np.isfinite(values)])
    if interpolation == "zero":
        return np.where(is_blank, 0.0, values)
    if is_blank.any():
        reading = "a line joins the values beside them" if interpolation == "linear" else "the last value holds there"
        checks.warn(f"{label}: {int(is_blank.sum())} of {len(values)} values of the known input are blank, and "
                    f"{reading}. If blank means zero, as for a dose, say so: {remedy}.")
    return values
