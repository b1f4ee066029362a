"""Known inputs: measured signals as functions of time, and the times at which models read them.

1. `Input` interpolates a table: piecewise constant ("previous") or linear. It is read by a jitted function whose name
   contains a mark and the settings of the input, so that the read is visible in the jaxpr of the user's function.
2. `input_reads` finds the reads of each function and evaluates the time of the read at several model times. An affine
   result gives slope and offset, so that the breakpoints of the table translate to times of the model; a lag may be a
   traced parameter.
3. A read at t, clipped to an interval, keeps its breakpoints. Any other function of time is refused or warned
   of, since its jumps between two observations would be missed.
4. `breakpoints_within` collects the breakpoints, at which a filter divides its intervals.
5. `check_reads` compares the times of reads with the range of the table.

Source: Hairer, Nørsett and Wanner (1993), Solving Ordinary Differential Equations I, section II.6, for integration up
to discontinuities.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.model.user_functions import TracedFunction, Unknown
from lfm_ppl.utils import checks
from lfm_ppl.utils.calendar_time import named


class Input(eqx.Module):
    """A known input, a function of time for use in the dynamics or the observation.

    Args:
        times: (K,), increasing.
        values: (K,) or (K, C), for C signals.
        interpolation: "previous" holds each value until the next time, "linear" interpolates. The first value holds
            before the first time, the last value after the last time.
        outside: action of a model that reads the input beyond the table: "warn", "hold" (no action) or "error". The
            check applies to concrete times and tables, not in compiled code. With "previous", the table includes an
            interval after the last time, as long as the interval before it. A table of one row is a constant without
            limits.
        name: name of the input in messages; for an input from a data file, its column. The name is static: inputs that
            are to be stacked must have the same name.

    Raises:
        ValueError: the times do not increase or are not finite, the values have another length or are not finite, or
            the interpolation is unknown.

    Example:
        >>> heater = Input([0.0, 1.0, 2.0], [0.0, 5.0, 0.0])
        >>> float(heater(1.5)), float(Input([0.0, 1.0], [0.0, 5.0], "linear")(0.5))
        (5.0, 2.5)

    If the dynamics read the input at ``t`` or at ``t - lag``, the integration is divided at the jumps of "previous" and
    the kinks of "linear". The lag may be a parameter: log likelihood and gradient account for the division. The
    interval before a jump uses the value before it, the interval after it the value after it.
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
        # In compiled code jnp.asarray turns numbers into tracers, but the time grid needs concrete breakpoints.
        self.times, self.values = _as_array(times, min_ndim=1), _as_array(values)
        self.interpolation, self.outside, self.name = interpolation, outside, name
        if self.times.ndim != 1 or self.times.size == 0 or self.values.shape[:1] != self.times.shape:
            raise ValueError("input values must have one row for each time, and at least one: "
                             f"{self.times.shape} times, values of shape {self.values.shape}.")
        concrete_times = checks.concrete(times)
        if concrete_times is not None and np.any(np.diff(concrete_times) <= 0):
            row = int(np.argmax(np.diff(concrete_times) <= 0)) + 1
            raise ValueError(f"input times must increase; row {row} ({concrete_times[row]:g}) does not.")

    def __call__(self, t: Any) -> jax.Array:
        """Return the input at time ``t``: a scalar, or (C,)."""
        return _reader(self.interpolation, self.outside, self.name)(self.times, self.values, t)


def _as_array(values: Any, min_ndim: int = 0) -> jax.Array:
    """Return an array that is concrete also in compiled code, if ``values`` are concrete."""
    with contextlib.nullcontext() if checks.traced(values) else jax.ensure_compile_time_eval():
        array = jnp.asarray(values, float)
        return jnp.atleast_1d(array) if array.ndim < min_ndim else array


@dataclass(frozen=True)
class InputRead:
    """A read of a known input at the time ``slope * t + offset``, where t is the time of the model.

    Attributes:
        interpolation: interpolation of the input.
        times, values: table of the input; the values are None if they are computed and not known.
        slope, offset: coefficients of the time of the read, which may be traced; a lag is ``-offset``.
    """

    interpolation: str
    times: Any
    values: Any
    slope: Any
    offset: Any

    @property
    def scale(self) -> Any:
        """The magnitude of the numbers with which the read compares the time of the model."""
        xp = jnp if checks.traced((self.times, self.slope, self.offset)) else np
        return xp.maximum(xp.max(xp.abs(self.times)), xp.max(xp.abs(self.offset))) / xp.abs(self.slope)

    @property
    def breakpoint_rows(self) -> np.ndarray:
        """Rows of the table at which the input jumps or has a kink; without known values all that may have one."""
        count = np.shape(self.times)[0]
        values = None if self.values is None else checks.concrete(self.values)
        if count < 2:
            return np.arange(0)
        if values is None or checks.traced(self.times):
            return np.arange(1 if self.interpolation == "previous" else 0, count)
        if self.interpolation == "previous":
            return 1 + np.flatnonzero((np.diff(values, axis=0) != 0).reshape(count - 1, -1).any(axis=1))
        columns = values.reshape(count, -1)
        slopes = np.pad(np.diff(columns, axis=0) / np.diff(self.times)[:, None], ((1, 1), (0, 0)))
        rounding = _COLLINEAR * (np.abs(slopes[1:]) + np.abs(slopes[:-1]))
        return np.flatnonzero((np.abs(np.diff(slopes, axis=0)) > rounding).any(axis=1))

    def breakpoints(self, rows: Any = None) -> Any:
        """Return the times of the model (K,) at which it reads rows of the table; None: `breakpoint_rows`."""
        return (self.times[self.breakpoint_rows if rows is None else rows] - self.offset) / self.slope


def input_reads(functions: Sequence[TracedFunction], first: float, last: float) -> list[InputRead]:
    """Return the reads of known inputs by functions of time.

    Args:
        functions: functions of (x, u, t) or of t.
        first: a time of the model.
        last: a later time of the model.

    Raises:
        ValueError: an input is read at a time that depends on a parameter, but not as ``t - lag``.

    Warns:
        UserWarning: an input is read at another function of time.
    """
    results = []
    generator = np.random.default_rng(0)
    trials = (0.0, 1.0, first, 0.37 * first + 0.63 * last, last)
    for function in functions:
        consts = function.closed.consts
        # Random numbers instead of tracers show whether the time of the read is affine in t.
        trial_consts = [generator.uniform(0.5, 1.5, np.shape(value)).astype(value.dtype) if checks.traced(value)
                        else value for value in consts]
        calls = zip(*(function.table_reads(_MARK, t, trial_consts) for t in trials), strict=True)
        exact = zip(*(function.table_reads(_MARK, t, consts) for t in (0.0, 1.0)), strict=True)
        for position, (trial, (at_zero, at_one)) in enumerate(zip(calls, exact, strict=True)):
            reads = [call.time for call in trial]
            if any(isinstance(value, Unknown) for value in (at_zero.times, *reads, at_zero.time, at_one.time)):
                continue  # the time depends on the state, or on a variable of a loop
            interpolation, _, input_name = _settings(at_zero.name)
            values = None if isinstance(at_zero.values, Unknown) else at_zero.values
            slope = reads[1] - reads[0]
            error = max(np.max(np.abs(read - reads[0] - slope * t)) for read, t in zip(reads, trials, strict=True))
            size = max(np.max(np.abs(read)) for read in reads) + np.max(np.abs(slope)) * max(np.abs(trials))
            if error > 1e-9 * size or np.any(slope == 0):
                if _is_read_in_place(function, position, first, last):
                    results.append(InputRead(interpolation, at_zero.times, values, 1.0, 0.0))
                else:
                    _refuse_read(function.label, input_name, checks.traced((at_zero.time, at_one.time)),
                                 bool(np.all(slope == 0)))
                continue
            # A slope that depends on a random parameter is not one by chance.
            is_unit = np.all(np.abs(slope - 1.0) < 1e-9)
            flat = [jnp.ravel(time) if checks.traced(time) else np.ravel(time) for time in (at_zero.time, at_one.time)]
            for index in range(np.size(reads[0])):
                time_at_zero, time_at_one = (times[index] for times in flat)
                slope_at_index = 1.0 if is_unit else time_at_one - time_at_zero
                results.append(InputRead(interpolation, at_zero.times, values, slope_at_index, time_at_zero))
    return results


def _is_read_in_place(function: TracedFunction, position: int, first: float, last: float) -> bool:
    """Return whether an input is read at t, clipped to an interval, so that its breakpoints are times of the model.

    ``position`` is the index of the read among all reads of the function.
    """
    if checks.traced(function.closed.consts):
        return False
    times = np.linspace(first, last, _SAMPLE_TIMES)
    reads = [list(function.table_reads(_MARK, t, function.closed.consts))[position].time for t in times]
    if any(isinstance(read, Unknown) or np.size(read) != 1 for read in reads):
        return False
    read_times = np.ravel(reads)
    error = np.max(np.abs(read_times - np.clip(times, read_times.min(), read_times.max())))
    return bool(error <= 1e-9 * max(1.0, np.abs(times).max()))


def _refuse_read(function_label: str, input_name: str, is_traced: bool, is_constant: bool) -> None:
    """Raise (traced) or warn of a read at a time that is not t minus a lag; a constant time needs no breakpoints."""
    if is_constant:
        return
    label = f"the known input {f'{input_name!r} ' if input_name else ''}in {function_label}"
    if is_traced:
        raise ValueError(f"{label} is read at a time that depends on a parameter, such as a lag, but not as t - lag: "
                         "where it jumps, the derivative with respect to the lag would be wrong. Read it at t - lag, "
                         "or fix the lag.")
    checks.warn(f"{label} is read at a time that is not t minus a constant, so that its jumps between two observations "
                "are not found, and a step may cross them. Read it at t, with a table over all times of the model.")


def check_reads(functions: Sequence[TracedFunction], first: float, last: float) -> None:
    """Check that functions of (x, u, t) read no known input beyond its table for t from ``first`` to ``last``.

    Raises:
        ValueError: a function reads an input with ``outside="error"`` beyond its table.

    Warns:
        UserWarning: a function reads an input with ``outside="warn"`` beyond its table.
    """
    violations: dict[str, set[str]] = {"warn": set(), "error": set()}
    for function in functions:
        for read in (read for t in (first, last) for read in function.table_reads(_MARK, t, function.concrete_consts)):
            interpolation, policy, input_name = _settings(read.name)
            if policy not in violations or read.is_conditional or isinstance(read.time, Unknown) or isinstance(
                    read.times, Unknown) or np.ndim(read.times) != 1 or np.size(read.times) < 2:
                continue
            table, read_times = np.asarray(read.times), np.asarray(read.time)
            end = table[-1] + (table[-1] - table[-2] if interpolation == "previous" else 0.0)
            rounding = 4 * np.finfo(float).eps * max(abs(table[0]), abs(end), abs(first), abs(last))
            slack = 1e-9 * max(end - table[0], last - first) + rounding
            span = (f"the known input {f'{input_name!r} ' if input_name else ''}in {function.label}, whose table goes "
                    f"from {named(table[0])} to {named(table[-1])}, is read at")
            if np.min(read_times) < table[0] - slack:
                violations[policy].add(f"{span} time {named(np.min(read_times))}, where its first value holds")
            if np.max(read_times) > end + slack:
                violations[policy].add(f"{span} time {named(np.max(read_times))}, where its last value holds")
    remedy = ('Give it values for these times, as rows of the data file or with --held-out, or accept the held value '
              'with lfm.Input(..., outside="hold").')
    if violations["error"]:
        raise ValueError(f"{'; '.join(sorted(violations['error']))}. {remedy}")
    if violations["warn"]:
        checks.warn(f"{'; '.join(sorted(violations['warn']))}. {remedy}")


def breakpoints_within(reads: Sequence[InputRead], first: float, last: float) -> tuple[np.ndarray, Any]:
    """Return the times at which inputs jump or have a kink.

    Args:
        reads: reads of the inputs.
        first: breakpoints at or before this time are omitted.
        last: breakpoints at or after this time are omitted.

    Returns:
        The concrete breakpoints between both times, in order; and all traced breakpoints (K,).
    """
    times = [read.breakpoints() for read in reads]
    fixed = np.unique(np.concatenate([t for t in times if not checks.traced(t)] or [np.zeros(0)]))
    traced = [t for t in times if checks.traced(t)]
    return fixed[(fixed > first) & (fixed < last)], jnp.concatenate(traced) if traced else np.zeros(0)


def has_inputs(function: TracedFunction, is_limited: bool = False) -> bool:
    """Return whether a function reads a known input, or one that must not be read beyond its table."""
    return any(_MARK in name and not (is_limited and _settings(name)[1] == "hold") for name in function.names())


def interpolation_of(name: str) -> str | None:
    """Return the interpolation of the known input that a function of this name reads; None for any other function."""
    return _settings(name)[0] if _MARK in name else None


def _settings(name: str) -> list[str]:
    """Return interpolation, policy outside and name of the input from the name of its reader."""
    return name[name.index(_MARK) + len(_MARK):].split("_", 2)


@functools.cache
def _reader(interpolation: str, policy: str, name: str) -> Callable[..., jax.Array]:
    """Return the jitted function that reads a table; its name marks the read in the jaxprs of its callers."""

    def read(times: jax.Array, values: jax.Array, t: jax.Array) -> jax.Array:
        next_index = jnp.searchsorted(times, t, side="right")
        index = jnp.clip(next_index - 1, 0, times.shape[0] - 1)
        if interpolation == "previous" or times.shape[0] == 1:
            return values[index]
        lower = jnp.clip(index, 0, times.shape[0] - 2)
        width = times[lower + 1] - times[lower]
        fraction = jnp.clip((t - times[lower]) / width, 0.0, 1.0)
        return values[lower] + fraction * (values[lower + 1] - values[lower])

    read.__name__ = read.__qualname__ = f"{_MARK}{interpolation}_{policy}_{name}"
    return jax.jit(read)


_SAMPLE_TIMES = 50
"""Number of times of the model at which the time of a read is compared with a clipped time."""

_COLLINEAR = 1e-10
"""Relative change of a slope below which a linear input has no kink."""

_MARK = "known_input_"
_INTERPOLATIONS = ("previous", "linear")
_OUTSIDE = ("warn", "hold", "error")
