"""Known inputs: samples of a measured signal as a function of time."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.calendar_time import named
from lfm_ppl.model.user_functions import Traced


class Input(eqx.Module):
    """A known input, called with the time inside the dynamics or the observation.

    Args:
        times: (K,), increasing.
        values: (K,) or (K, C), for C signals.
        interpolation: "previous" holds each value until the next time, "linear" joins them. Before the first and after
            the last time the first and the last value hold.
        outside: what a model does whose times go beyond the table: "warn", "hold" (nothing) or "error". It is looked at
            where times and table are numbers, not in compiled code. The last value of "previous" may stand for an
            interval as long as the one before; a table of one row is a constant, and ends nowhere.
        name: how messages call it; that of its column, where it comes from a table. Inputs of different names are
            different trees: give those the same one that are to be stacked.

    Raises:
        ValueError: times not increasing or not finite, values of another length or not finite, unknown interpolation.

    Example:
        >>> heater = Input([0.0, 1.0, 2.0], [0.0, 5.0, 0.0])
        >>> float(heater(1.5)), float(Input([0.0, 1.0], [0.0, 5.0], "linear")(0.5))
        (5.0, 2.5)

    Jumps of "previous" and kinks of "linear" between two observations divide the integration there, where the dynamics
    reads the input at ``t``, or at ``t - lag``. The lag may be a parameter: the log likelihood and its derivative with
    respect to the lag are those of the divided interval. The interval before a jump sees the value before it, the
    interval after it the value after.
    """

    times: jax.Array
    values: jax.Array
    interpolation: str = eqx.field(static=True)
    outside: str = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def __init__(self, times: Any, values: Any, interpolation: str = "previous", outside: str = "warn",
                 name: str = ""):
        checks.one_of("interpolation", interpolation, _INTERPOLATIONS)
        checks.one_of("outside", outside, _OUTSIDE)
        checks.finite("input times", times)
        checks.finite("input values", values)
        # In compiled code jnp.asarray makes tracers of numbers; the time grid needs to know where the table jumps.
        self.times, self.values = _as_array(times, least_dim=1), _as_array(values)
        self.interpolation, self.outside, self.name = interpolation, outside, name
        if self.times.ndim != 1 or self.times.size == 0 or self.values.shape[:1] != self.times.shape:
            raise ValueError(f"input values must have one row a time, and at least one: {self.times.shape} times, "
                             f"values of shape {self.values.shape}.")
        known = checks.concrete(times)
        if known is not None and np.any(np.diff(known) <= 0):
            row = int(np.argmax(np.diff(known) <= 0)) + 1
            raise ValueError(f"input times must increase; row {row} ({known[row]:g}) does not.")

    def __call__(self, t: Any) -> jax.Array:
        """Return the input at time ``t``: a scalar, or (C,)."""
        return _reader(self.interpolation, self.outside, self.name)(self.times, self.values, t)


def _as_array(values: Any, least_dim: int = 0) -> jax.Array:
    """Return an array that stays a number in compiled code, where ``values`` are numbers."""
    with contextlib.nullcontext() if checks.traced(values) else jax.ensure_compile_time_eval():
        array = jnp.asarray(values, float)
        return jnp.atleast_1d(array) if array.ndim < least_dim else array


class InputRead(NamedTuple):
    """A known input that a function reads at the time ``slope * t + offset``.

    Attributes:
        interpolation: of the input.
        times, values: its table.
        slope, offset: a lag is ``-offset``; they may be traced.
    """

    interpolation: str
    times: Any
    values: Any
    slope: Any
    offset: Any

    @property
    def scale(self) -> Any:
        """The size of the numbers that the model's time is compared with."""
        xp = jnp if checks.traced((self.times, self.slope, self.offset)) else np
        return xp.maximum(xp.max(xp.abs(self.times)), xp.max(xp.abs(self.offset))) / xp.abs(self.slope)

    def breakpoints(self) -> Any:
        """Return the model's times (K,) at which the input jumps or has a kink."""
        times = self.times
        values = checks.concrete(self.values)
        if np.shape(times)[0] < 2:
            return np.zeros(0)
        if values is None or checks.traced(times):
            times = times[1:] if self.interpolation == "previous" else times
        elif self.interpolation == "previous":
            times = times[1:][(np.diff(values, axis=0) != 0).reshape(len(times) - 1, -1).any(axis=1)]
        else:
            columns = values.reshape(len(times), -1)
            slopes = np.pad(np.diff(columns, axis=0) / np.diff(times)[:, None], ((1, 1), (0, 0)))
            rounding = _COLLINEAR * (np.abs(slopes[1:]) + np.abs(slopes[:-1]))
            times = times[(np.abs(np.diff(slopes, axis=0)) > rounding).any(axis=1)]
        return (times - self.offset) / self.slope


def input_reads(functions: Sequence[Traced], first: float, last: float) -> list[InputRead]:
    """Return which known inputs functions read, and when.

    Args:
        functions: of (x, u, t) or of t.
        first: a time of the model.
        last: a later one.

    Raises:
        ValueError: an input is read at a time that depends on a parameter, but not as ``t - lag``.

    Warns:
        UserWarning: an input is read at another function of time.
    """
    found = []
    generator = np.random.default_rng(0)
    trials = (0.0, 1.0, first, 0.37 * first + 0.63 * last, last)
    for function in functions:
        consts = function.closed.consts
        # Numbers in the place of tracers tell whether the time is affine in t.
        tried = [generator.uniform(0.5, 1.5, np.shape(value)).astype(value.dtype)
                 if isinstance(value, jax.core.Tracer) else value for value in consts]
        calls = zip(*(function.table_calls(_MARK, t, tried) for t in trials), strict=True)
        exact = zip(*(function.table_calls(_MARK, t, consts) for t in (0.0, 1.0)), strict=True)
        pairs = zip(calls, exact, strict=True)
        for position, (trial, ((name, times, values, at_zero), (*_, at_one))) in enumerate(pairs):
            reads = [call[-1] for call in trial]
            if times is None or any(read is None for read in (*reads, at_zero, at_one)):
                continue  # it depends on the state, or on what a loop changes
            interpolation, _, called = name[name.index(_MARK) + len(_MARK):].split("_", 2)
            slope = reads[1] - reads[0]
            error = max(np.max(np.abs(read - reads[0] - slope * t)) for read, t in zip(reads, trials, strict=True))
            size = max(np.max(np.abs(read)) for read in reads) + np.max(np.abs(slope)) * max(np.abs(trials))
            if error > 1e-9 * size or np.any(slope == 0):
                if _is_read_in_place(function, position, first, last):
                    found.append(InputRead(interpolation, times, values, 1.0, 0.0))
                else:
                    _refuse_read(function.what, called, checks.traced((at_zero, at_one)), bool(np.all(slope == 0)))
                continue
            # That of a random parameter is one by no chance.
            unit = np.all(np.abs(slope - 1.0) < 1e-9)
            flat = [jnp.ravel(a) if checks.traced(a) else np.ravel(a) for a in (at_zero, at_one)]
            for index in range(np.size(reads[0])):
                begin, end = (a[index] for a in flat)
                found.append(InputRead(interpolation, times, values, 1.0 if unit else end - begin, begin))
    return found


def _is_read_in_place(function: Traced, position: int, first: float, last: float) -> bool:
    """Return whether an input is read at t, clipped to an interval, so that its breakpoints are in their place.

    Args:
        function: of (x, u, t) or of t.
        position: of the input among those that it reads.
        first: a time of the model.
        last: a later one.
    """
    if checks.traced(function.closed.consts):
        return False
    times = np.linspace(first, last, _SAMPLED)
    reads = [list(function.table_calls(_MARK, t, function.closed.consts))[position][-1] for t in times]
    if any(np.size(read) != 1 for read in reads if read is not None) or any(read is None for read in reads):
        return False
    when = np.ravel(reads)
    error = np.max(np.abs(when - np.clip(times, when.min(), when.max())))
    return bool(error <= 1e-9 * max(1.0, np.abs(times).max()))


def _refuse_read(what: str, called: str, traced: bool, constant: bool) -> None:
    """Raise or warn where an input is read at a time that is not t minus a lag."""
    if constant:
        return
    label = f"the known input {f'{called!r} ' if called else ''}in {what}"
    if traced:
        raise ValueError(f"{label} is read at a time that depends on a parameter, such as a lag, but not as t - lag: "
                         "where it jumps, the derivative with respect to the lag would be wrong. Read it at t - lag, "
                         "or fix the lag.")
    checks.warn(f"{label} is read at a time that is not t minus a constant, so that its jumps between two observations "
                "are not found and may be stepped over. Read it at t, with a table over all times of the model.")


def check_reads(functions: Sequence[Traced], first: float, last: float) -> None:
    """Check that functions of (x, u, t) read no known input beyond its table where t goes from ``first`` to ``last``.

    Raises:
        ValueError: one does whose input has ``outside="error"``; with "warn" it is a warning.
    """
    beyond: dict[str, set[str]] = {"warn": set(), "error": set()}
    for function in functions:
        for name, table, when in (read for t in (first, last) for read in function.table_reads(_MARK, t)):
            interpolation, outside, called = name[name.index(_MARK) + len(_MARK):].split("_", 2)
            if outside not in beyond or table.ndim != 1 or table.size < 2:
                continue
            end = table[-1] + (table[-1] - table[-2] if interpolation == "previous" else 0.0)
            rounding = 4 * np.finfo(float).eps * max(abs(table[0]), abs(end), abs(first), abs(last))
            slack = 1e-9 * max(end - table[0], last - first) + rounding
            span = (f"the known input {f'{called!r} ' if called else ''}in {function.what}, whose table goes from "
                    f"{named(table[0])} to {named(table[-1])}, is read at")
            if np.min(when) < table[0] - slack:
                beyond[outside].add(f"{span} time {named(np.min(when))}, where its first value holds")
            if np.max(when) > end + slack:
                beyond[outside].add(f"{span} time {named(np.max(when))}, where its last value holds")
    remedy = ('Give it values for these times, as rows of the data file or with --held-out, or say with '
              'lfm.Input(..., outside="hold") that they hold.')
    if beyond["error"]:
        raise ValueError(f"{'; '.join(sorted(beyond['error']))}. {remedy}")
    if beyond["warn"]:
        checks.warn(f"{'; '.join(sorted(beyond['warn']))}. {remedy}")


def breakpoints_within(reads: Sequence[InputRead], first: float, last: float) -> tuple[np.ndarray, Any]:
    """Return the times at which inputs jump or have a kink.

    Args:
        reads: of the inputs.
        first: no breakpoint at or before it is of account.
        last: none at or after it.

    Returns:
        Those between both that are known before compilation, in order; and all those (K,) that are traced.
    """
    times = [read.breakpoints() for read in reads]
    known = np.unique(np.concatenate([t for t in times if not checks.traced(t)] or [np.zeros(0)]))
    moving = [t for t in times if checks.traced(t)]
    return known[(known > first) & (known < last)], jnp.concatenate(moving) if moving else np.zeros(0)


def has_inputs(function: Traced) -> bool:
    """Whether a function reads a known input."""
    return function.has(_MARK)


def reads_inputs(function: Traced) -> bool:
    """Whether a function reads a known input that does not simply hold beyond its table."""
    return any(function.has(f"{_MARK}{way}_{outside}_") for way in _INTERPOLATIONS for outside in _OUTSIDE
               if outside != "hold")


@functools.cache
def _reader(interpolation: str, outside: str, name: str) -> Callable[..., jax.Array]:
    """Return the function that reads a table; its name stands in the jaxprs of what calls it."""

    def read(times: jax.Array, values: jax.Array, t: jax.Array) -> jax.Array:
        after = jnp.searchsorted(times, t, side="right")
        before = jnp.clip(after - 1, 0, times.shape[0] - 1)
        if interpolation == "previous" or times.shape[0] == 1:
            return values[before]
        left = jnp.clip(before, 0, times.shape[0] - 2)
        width = times[left + 1] - times[left]
        fraction = jnp.clip((t - times[left]) / width, 0.0, 1.0)
        return values[left] + fraction * (values[left + 1] - values[left])

    read.__name__ = read.__qualname__ = f"{_MARK}{interpolation}_{outside}_{name}"
    return jax.jit(read)


_SAMPLED = 50
"""Times of the model at which the time of a read is compared with a clipped one."""

_COLLINEAR = 1e-10
"""Change of a slope, as a share of its size, below which a linear input has no kink."""

_MARK = "known_input_"
_INTERPOLATIONS = ("previous", "linear")
_OUTSIDE = ("warn", "hold", "error")
