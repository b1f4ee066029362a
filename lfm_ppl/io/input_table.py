"""Known inputs and doses as they were measured, and as the inputs and events of a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lfm_ppl.utils import calendar_time, checks

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
