r"""Events: known times at which the physical state jumps.

1. A dose adds an amount, ``x <- x + b d_k``; a reset sets one state, ``x_i <- v_k``.
2. The amounts, values and lags may be parameters of the model.
3. Each event is an affine map ``x <- keep * x + offset``, entry by entry (`StateMap`), and so exact for a Gaussian, a
   particle and a trajectory alike.
4. The time grid ends an interval at the time of each event (`EventTable`).

Source: Rowland and Tozer (2011), Clinical Pharmacokinetics and Pharmacodynamics, chapter 11, for repeated doses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from lfm_ppl.utils import checks


class Event(eqx.Module):
    """Jumps of the physical state at the times ``times + lag``; the base of `Dose` and `Reset`.

    Attributes:
        times: (K,).
        values: amounts or values, () or (K,).
        state: name of the state that jumps; None where a dose has a ``direction`` (M,).
        lag: () or (K,).
        observation_first: whether an observation at the time of an event is taken before it.
        is_reset: whether the state is set to the value, and not moved by it.
    """

    times: Any
    values: Any
    state: str | None = eqx.field(static=True)
    direction: Any
    lag: Any
    observation_first: bool = eqx.field(static=True)
    is_reset: bool = eqx.field(static=True)

    def __init__(self, times: ArrayLike, values: ArrayLike, target: Any, lag: ArrayLike, observation_first: bool,
                 is_reset: bool):
        label, argument = ("reset", "values") if is_reset else ("dose", "amounts")
        checks.refuse_dates(f"times of a {label}", times)
        checks.finite(f"times of a {label}", times)
        checks.finite(f"{argument} of a {label}", values)
        checks.finite(f"lag of a {label}", lag)
        self.times = _concrete(times)
        if np.ndim(self.times) != 1:
            raise ValueError(f"times of a {label} must be a vector (K,), got shape {np.shape(times)}.")
        if np.shape(values) not in ((), np.shape(times)):
            raise ValueError(f"{argument} of a {label} must be one number or one for each of the {np.size(self.times)} "
                             f"times, got shape {np.shape(values)}.")
        if np.ndim(lag) > 1 or np.ndim(lag) == 1 and np.shape(lag) != np.shape(times):
            raise ValueError(f"lag of a {label} must be one number or one for each time, got shape {np.shape(lag)}.")
        self.values, self.lag = _concrete(values), _concrete(lag)
        if not isinstance(target, str):
            checks.finite(f"target of a {label}", target)
        self.state, self.direction = (target, None) if isinstance(target, str) else (None, _concrete(target))
        self.observation_first, self.is_reset = bool(observation_first), is_reset

    @property
    def event_times(self) -> Any:
        """Times of the jumps (K,), lag included; a NumPy array where neither is traced."""
        return self.times + self.lag

    def check_target(self, state_names: Sequence[str]) -> None:
        """Raise ValueError unless the target is a state, or a direction in the space of the states."""
        if self.state is not None:
            checks.one_of("the target of an event", self.state, state_names)
        elif np.shape(self.direction) != (len(state_names),):
            raise ValueError("the target of a dose must be the name of a state or a vector with an entry for each of "
                             f"the states {', '.join(state_names)}, got shape {np.shape(self.direction)}.")

    def map(self, state_names: Sequence[str]) -> tuple[jax.Array, jax.Array]:
        """Return keep and offset (K, M) of the map ``x <- keep * x + offset``."""
        count, size = np.shape(self.times)[0], len(state_names)
        direction = (jnp.asarray(self.direction, float) if self.state is None
                     else jnp.zeros(size).at[list(state_names).index(self.state)].set(1.0))
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
        ...     lfm.GaussianObservation(lambda x, u, t: x[1:], jnp.array([0.01])),
        ...     lfm.Gaussian(jnp.zeros(2), jnp.zeros((2, 2))), state_names=("gut", "blood"), initial_time=0.0,
        ...     events=[lfm.Dose([0.0, 12.0], 4.0, "gut", lag=0.5)])
        >>> result = lfm.filter(model, np.array([0.25, 13.0]), jnp.zeros((2, 1)))
        >>> round(float(result.predicted_mean[1, 1]), 2)
        1.9

    Source: Rowland and Tozer (2011), chapter 11.
    """

    def __init__(self, times: ArrayLike, amounts: ArrayLike, target: Any, lag: ArrayLike = 0.0,
                 observation_first: bool = True):
        super().__init__(times, amounts, target, lag, observation_first, False)


class Reset(Event):
    """Resets: one state is set to a value, ``x_i <- v_k`` at ``t_k + lag``, as that of a meter that starts again.

    A state that integrates a flow and is reset after each observation makes the observations integrals between reports.

    Args:
        times: (K,), in any order; not before the initial time of the model.
        state: name of the state.
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
        ...     lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
        ...     lfm.Gaussian(jnp.zeros(1), jnp.zeros((1, 1))), state_names=("cases",), initial_time=0.0,
        ...     events=[lfm.Reset(weeks, "cases")])
        >>> lfm.filter(model, weeks[:1], jnp.array([[3.0]])).filtered_mean[:, 0].tolist()
        [3.0]
    """

    def __init__(self, times: ArrayLike, state: str, values: ArrayLike = 0.0, lag: ArrayLike = 0.0,
                 observation_first: bool = True):
        if not isinstance(state, str):
            raise TypeError(f"state of a reset must be the name of a state, got {type(state).__name__}.")
        super().__init__(times, values, state, lag, observation_first, True)


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
    """All events of a model that move the state at once, one entry each.

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

    def place(self, first: Any, last: Any) -> tuple[jax.Array, jax.Array]:
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
