r"""Events: times at which the physical state jumps, or at which an infusion begins and ends.

1. A dose adds an amount, ``x <- x + b d_k``; a reset sets a state, ``x_i <- v_k``; an infusion adds an amount at a
   constant rate.
2. The amounts, values, rates, durations and lags may be parameters of the model.
3. A dose or reset is an affine map ``x <- keep * x + offset``, entry by entry (`StateMap`), and so exact for a
   Gaussian, a particle and a trajectory alike.
4. The time grid ends an interval at the time of each event (`EventTable`).
5. Infusions are a known input that is added to the dynamics (`Infusion.rate_of_change`). Their ends are breakpoints of
   this input, through which a derivative reaches the times. The start is an event that leaves the state as it is: an
   impossible start is found like that of a dose.

Source: Rowland and Tozer (2011), Clinical Pharmacokinetics and Pharmacodynamics, chapter 11, for repeated doses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from lfm_ppl.model.inputs import Input
from lfm_ppl.utils import checks


class Event(eqx.Module):
    """Events at the times ``times + lag``; the base of `Dose`, `Infusion` and `Reset`.

    Attributes:
        times: (K,).
        values: amounts or values, () or (K,).
        state: name of the state that changes; None where a dose has a ``direction`` (M,), or for all states.
        lag: () or (K,).
        observation_first: whether an observation at the time of an event is taken before it.
        is_reset: whether the state is set to the value, and not moved by it.
    """

    label: ClassVar[str] = "an event"
    argument: ClassVar[str] = "amounts"

    times: Any
    values: Any
    state: str | None = eqx.field(static=True)
    direction: Any
    lag: Any
    observation_first: bool = eqx.field(static=True)
    is_reset: bool = eqx.field(static=True)

    def __init__(self, times: ArrayLike, values: ArrayLike, target: Any, lag: ArrayLike, observation_first: bool,
                 is_reset: bool):
        label, argument = self.label, self.argument
        checks.refuse_dates(f"times of {label}", times)
        checks.finite(f"times of {label}", times)
        checks.finite(f"{argument} of {label}", values)
        checks.finite(f"lag of {label}", lag)
        self.times = _concrete(times)
        if np.ndim(self.times) != 1:
            raise ValueError(f"times of {label} must be a vector (K,), got shape {np.shape(times)}.")
        if np.shape(values) not in ((), np.shape(times)):
            raise ValueError(f"{argument} of {label} must be one number or one for each of the {np.size(self.times)} "
                             f"times, got shape {np.shape(values)}.")
        if np.ndim(lag) > 1 or np.ndim(lag) == 1 and np.shape(lag) != np.shape(times):
            raise ValueError(f"lag of {label} must be one number or one for each time, got shape {np.shape(lag)}.")
        self.values, self.lag = _concrete(values), _concrete(lag)
        is_name = isinstance(target, str) or target is None
        if not is_name:
            checks.finite(f"target of {label}", target)
        self.state, self.direction = (target, None) if is_name else (None, _concrete(target))
        self.observation_first, self.is_reset = bool(observation_first), is_reset

    @property
    def target(self) -> Any:
        """Name of the state that changes, or the direction (M,) of a dose; None: all states."""
        return self.state if self.direction is None else self.direction

    @property
    def event_times(self) -> Any:
        """Times (K,), lag included; a NumPy array where neither is traced."""
        return self.times + self.lag

    def delayed(self, lag: ArrayLike) -> Any:
        """Return the same events with a further ``lag``, () or (K,), which may be a parameter."""
        checks.finite(f"lag of {self.label}", lag)
        return eqx.tree_at(lambda event: event.lag, self, _concrete(self.lag + lag))

    def check_target(self, state_names: Sequence[str]) -> None:
        """Raise ValueError unless the target is a state, or a direction in the space of the states."""
        if self.state is not None:
            checks.one_of(f"state that receives {self.label}", self.state, state_names)
        elif self.direction is not None and np.shape(self.direction) != (len(state_names),):
            raise ValueError(f"the target of {self.label} must be the name of a state or a vector with an entry for "
                             f"each of the states {', '.join(state_names)}, got shape {np.shape(self.direction)}.")

    def direction_in(self, state_names: Sequence[str]) -> Any:
        """Return the direction (M,) in which the state changes."""
        if self.direction is not None:
            return self.direction
        return np.array([self.state in (name, None) for name in state_names], float)

    def map(self, state_names: Sequence[str]) -> tuple[jax.Array, jax.Array]:
        """Return keep and offset (K, M) of the map ``x <- keep * x + offset``."""
        count, size = np.shape(self.times)[0], len(state_names)
        direction = self.direction_in(state_names)
        values = jnp.broadcast_to(jnp.asarray(self.values, float), (count,))
        keep = 1.0 - direction if self.is_reset else jnp.ones(size)
        return jnp.broadcast_to(keep, (count, size)), values[:, None] * direction


class Dose(Event):
    r"""Doses: the state jumps by known or estimated amounts, ``x <- x + b d_k`` at ``t_k + lag``.

    Args:
        times: (K,), in any order; not before the initial time of the model. In compiled code they may be traced.
        amounts: d_k (K,), or one number for all; they may be parameters, such as a bioavailability times the doses.
        target: name of the state that receives the dose, or the direction b (M,). An impulse of an input that enters
            the dynamics linearly is a dose in the direction of its coefficients.
        lag: delay of all doses, or of each one (K,); it may be a parameter.
        observation_first: whether an observation at the time of a dose is taken before the dose.

    Raises:
        ValueError, TypeError: numbers that are not finite, or shapes that disagree.

    Example:
        >>> import jax.numpy as jnp, numpy as np, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: jnp.stack([-x[0], x[0] - 0.2 * x[1]]), {},
        ...     lfm.GaussianObservation(lambda x, u, t: x[1:], sd=0.1),
        ...     lfm.Gaussian(jnp.zeros(2), jnp.zeros((2, 2))), state_names=("gut", "blood"), initial_time=0.0,
        ...     events=[lfm.Dose([0.0, 12.0], 4.0, "gut", lag=0.5)])
        >>> result = lfm.filter(model, np.array([0.25, 13.0]), jnp.zeros((2, 1)))
        >>> round(float(result.predicted_mean[1, 1]), 2)
        1.9

    Source: Rowland and Tozer (2011), chapter 11.
    """

    label: ClassVar[str] = "a dose"

    def __init__(self, times: ArrayLike, amounts: ArrayLike, target: Any, lag: ArrayLike = 0.0,
                 observation_first: bool = True):
        _check_target_given(target)
        super().__init__(times, amounts, target, lag, observation_first, False)

    @property
    def amounts(self) -> Any:
        """Amounts (K,), or one for all."""
        return self.values


class Infusion(Event):
    r"""Infusions: amounts d_k that enter the state at a constant rate from ``t_k + lag`` on.

        dx/dt = f(x, u, t) + b d_k / T_k,    t_k + lag < t < t_k + lag + T_k,    T_k = d_k / rate_k.

    Infusions that overlap add up. The ends are ends of intervals of the filter, so that they are exact, and the log
    likelihood has derivatives with respect to all arguments.

    Args:
        times: (K,), starts, in any order; not before the initial time of the model. They may be traced.
        amounts: d_k (K,), or one number for all; they may be parameters. A negative amount is removed, as by a `Dose`;
            it needs ``duration``. Where an amount is zero, nothing is infused.
        target: name of the state that receives the amounts, or the direction b (M,).
        rate: amount in a unit of time, (K,) or one number for all; either it or ``duration`` is given.
        duration: T_k, (K,) or one number for all.
        lag: delay of all infusions, or of each one (K,); it may be a parameter.

    Raises:
        ValueError, TypeError: numbers that are not finite, a rate or duration that is not positive, a negative amount
            with ``rate``, or shapes that disagree. In compiled code a duration that is not positive is a log density
            of -inf.

    Example:
        >>> import jax.numpy as jnp, numpy as np, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: -0.2 * x, {}, lfm.GaussianObservation(lambda x, u, t: x, sd=0.1),
        ...     lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))), state_names=("blood",), initial_time=0.0,
        ...     events=[lfm.Infusion([0.0], 10.0, "blood", duration=2.0)])
        >>> result = lfm.filter(model, np.array([1.0, 2.0, 3.0]), jnp.zeros((3, 1)))
        >>> [round(float(mean), 2) for mean in result.predicted_mean[:, 0]]
        [4.53, 8.24, 6.75]

    Source: Rowland and Tozer (2011), chapter 4.
    """

    label: ClassVar[str] = "an infusion"
    rates: Any
    durations: Any

    def __init__(self, times: ArrayLike, amounts: ArrayLike, target: Any, *, rate: ArrayLike | None = None,
                 duration: ArrayLike | None = None, lag: ArrayLike = 0.0):
        _check_target_given(target)
        super().__init__(times, amounts, target, lag, True, False)
        if (rate is None) == (duration is None):
            raise ValueError("an infusion needs either rate= or duration=, and not both.")
        name = "duration" if rate is None else "rate"
        value: Any = duration if rate is None else rate
        checks.positive(f"{name} of an infusion", value)
        if np.shape(value) not in ((), np.shape(times)):
            raise ValueError(f"{name} of an infusion must be one number or one for each of the {np.size(self.times)} "
                             f"times, got shape {np.shape(value)}.")
        value = _concrete(value)
        # A traced number that is not positive must not make the derivatives of the others infinite.
        is_positive = value > 0
        divisor = jnp.where(is_positive, value, 1.0) if checks.traced(value) else value
        quotient = self.values / divisor
        if rate is not None and not checks.traced(quotient) and np.any(quotient < 0):
            raise ValueError(f"amounts of an infusion with rate= must not be negative, got {np.min(self.values):g}: "
                             "the infusion would end before it starts. Use duration= for amounts that are removed.")
        if rate is None:
            self.rates, self.durations = quotient, value
        else:
            self.rates = divisor
            self.durations = jnp.where(is_positive, quotient, jnp.nan) if checks.traced(value) else quotient

    @property
    def amounts(self) -> Any:
        """Amounts (K,), or one for all."""
        return self.values

    @property
    def event_times(self) -> Any:
        """Starts (K,); NaN unless the duration is positive, and beyond all times where nothing is infused."""
        start = super().event_times
        if not checks.traced((start, self.durations)):
            return start if checks.traced(self.values) else np.where(self.values == 0, np.finfo(float).max, start)
        start = jnp.where(self.durations > 0, start, jnp.nan)
        return jnp.where(self.values == 0, np.finfo(float).max, start)

    def map(self, state_names: Sequence[str]) -> tuple[jax.Array, jax.Array]:
        """Return keep and offset (K, M) of the identity: an infusion begins without a jump."""
        shape = np.shape(self.times)[0], len(state_names)
        return jnp.ones(shape), jnp.zeros(shape)

    def rate_of_change(self) -> Input:
        """Return the rate at which the amounts enter, summed over all infusions, as a known input."""
        starts, durations = self.times + self.lag, self.durations
        if checks.traced(durations):
            # An impossible duration is found by its start; here it must not disturb the order.
            durations = jnp.where(durations > 0, durations, 0.0)
        switch_times = _concatenate(starts, starts + durations)
        rates = self.rates + np.zeros(np.shape(self.times))
        changes = _concatenate(rates, -rates)
        order: Any
        if checks.traced(switch_times):
            order = jnp.argsort(jax.lax.stop_gradient(switch_times))
            times, values = switch_times[order], jnp.asarray(changes)[order].cumsum()
        else:
            # The times of the table of an input increase.
            order = np.argsort(switch_times, kind="stable")
            times = np.unique(switch_times)
            last = np.searchsorted(switch_times[order], times, side="right") - 1
            values = changes[order].cumsum()[last]
        # Before the first start the rate is zero; the time of this row is no breakpoint.
        first = times[:1] - 1.0 - abs(times[:1])
        return Input(_concatenate(first, times), _concatenate(np.zeros(1), values), outside="hold")


def _concatenate(*arrays: Any) -> Any:
    return (jnp if checks.traced(arrays) else np).concatenate(arrays)


class Reset(Event):
    """Resets: a state is set to a value, ``x_i <- v_k`` at ``t_k + lag``, as that of a meter that starts again.

    A state that integrates a flow and is reset after each observation makes the observations integrals between reports.

    Args:
        times: (K,), in any order; not before the initial time of the model.
        target: name of the state; None: all states.
        values: v_k (K,), or one number for all; they may be parameters.
        lag: delay, as in `Dose`.
        observation_first: whether an observation at the time of a reset is taken before the reset.

    Raises:
        ValueError, TypeError: numbers that are not finite, or shapes that disagree.

    Example:
        >>> import jax.numpy as jnp, numpy as np, lfm_ppl as lfm
        >>> weeks = np.arange(1.0, 4.0)
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: u, {"rate": lfm.Matern(1.0, 2.0, mean=3.0)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, sd=0.3),
        ...     lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))), state_names=("cases",), initial_time=0.0,
        ...     events=[lfm.Reset(weeks, "cases")])
        >>> lfm.filter(model, weeks[:1], jnp.array([[3.0]])).filtered_mean[:, 0].tolist()
        [3.0]
    """

    label: ClassVar[str] = "a reset"
    argument: ClassVar[str] = "values"

    def __init__(self, times: ArrayLike, target: str | None = None, values: ArrayLike = 0.0, lag: ArrayLike = 0.0,
                 observation_first: bool = True):
        if target is not None and not isinstance(target, str):
            raise TypeError(f"target of a reset must be the name of a state, got {type(target).__name__}.")
        super().__init__(times, values, target, lag, observation_first, True)


class StateMap(NamedTuple):
    """The maps ``s <- keep * s + offset`` of joint states at the ends of intervals, or of one; None: the identity.

    Attributes:
        keep: (..., n), zeros and ones; None without resets.
        offset: (..., n).
    """

    keep: Any
    offset: Any

    def apply(self, state: jax.Array) -> jax.Array:
        """Return the states (..., n) after the event."""
        return (state if self.keep is None else self.keep * state) + self.offset


NO_EVENT, IMPOSSIBLE_EVENT = -1, -2
"""Entries of the table of state maps: the identity, and NaN for an event before the initial time or at no time."""


class EventTable(NamedTuple):
    """All events of a model, one entry each; an infusion counts with its start.

    Attributes:
        times: (E,), infinite where the time is traced.
        traced_times: (E,), with the traced times; None if all are concrete.
        observation_first: (E,), whether an observation at the same time comes first.
        start: time of a given state, which includes the events before it; None: the state is that of the model at its
            initial time, before which there are no events.
    """

    times: np.ndarray
    traced_times: Any
    observation_first: np.ndarray
    start: Any = None

    @property
    def all_times(self) -> Any:
        """Times of all events (E,)."""
        return self.times if self.traced_times is None else self.traced_times

    @property
    def is_traced(self) -> np.ndarray:
        """Whether the time of an event is traced (E,)."""
        return np.isinf(self.times)

    def is_past(self, times: Any) -> Any:
        """Return whether the state at ``start`` includes an event, if it is at one of ``times`` (E,)."""
        if self.start is None:
            return np.zeros(len(self.times), bool)
        return (times < self.start) | ((times == self.start) & ~self.observation_first)

    def entries_within(self, first: Any, last: Any) -> tuple[jax.Array, jax.Array]:
        """Return times (E,) of the events within ``first`` to ``last``, and their entries in the table of state maps.

        The entry is `NO_EVENT` for an event after ``last`` or one that is past, and `IMPOSSIBLE_EVENT` where a traced
        time is NaN or before ``first``: the moments, and with them the density, are then not finite.
        """
        times = jnp.asarray(self.all_times, float)
        is_possible, is_later = times >= first, times > last
        entry = jnp.where(is_possible, np.arange(len(self.times)), IMPOSSIBLE_EVENT)
        entry = jnp.where(self.is_past(times) | is_later, NO_EVENT, entry)
        # At the bounds themselves the derivative is that of the time, one-sided.
        return jnp.where(is_possible, jnp.where(is_later, last, times), first), entry


def _check_target_given(target: Any) -> None:
    if target is None:
        raise TypeError("target must be the name of a state or a vector with an entry for each state, got None.")


def check_start(times: np.ndarray, origin: float) -> None:
    """Raise ValueError if an event lies before the initial time."""
    if np.any(times < origin):
        raise ValueError(f"an event at time {np.nanmin(times):g} lies before the initial time {origin:g} of the model; "
                         "set initial_time to the time of the first event or earlier.")


def event_table(events: Sequence[Event]) -> EventTable:
    """Return the times of all events."""
    times = [event.event_times for event in events]
    concrete = [np.full(np.shape(t)[0], np.inf) if checks.traced(t) else np.asarray(t, float) for t in times]
    first = [np.full(len(t), event.observation_first) for t, event in zip(concrete, events, strict=True)]
    traced_times = jnp.concatenate([jnp.asarray(t, float) for t in times]) if checks.traced(times) else None
    return EventTable(np.concatenate([np.zeros(0), *concrete]), traced_times,
                      np.concatenate([np.zeros(0, bool), *first]))


def state_maps(events: Sequence[Event], state_names: Sequence[str], size: int) -> StateMap | None:
    """Return the maps of all E events on the joint state, of `IMPOSSIBLE_EVENT` and `NO_EVENT`; None without events.

    Args:
        events: the events of a model.
        state_names: names of its physical states.
        size: n, the size of its joint state.
    """
    if not events:
        return None
    keep, offset = (jnp.concatenate(rows) for rows in zip(*(event.map(state_names) for event in events), strict=True))
    columns = size - len(state_names)
    offset = jnp.pad(offset, ((0, 2), (0, columns))).at[IMPOSSIBLE_EVENT].set(jnp.nan)
    has_resets = any(event.is_reset for event in events)
    return StateMap(jnp.pad(keep, ((0, 2), (0, columns)), constant_values=1.0) if has_resets else None, offset)


def _concrete(value: Any) -> Any:
    """Return a NumPy array unless the value is traced: time grids need numbers, also inside of a trace."""
    array = checks.concrete(value)
    return jnp.asarray(value, float) if array is None else array.astype(float)
