"""Known inputs: samples of a measured signal as a function of time."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

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

    A jump inside an interval lowers the order of the integration there; put the times of jumps among the observation
    times (with missing observations) where that matters. At such a time the interval before it sees the value before
    the jump, the interval after it the value after.
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
        self.times = jnp.atleast_1d(jnp.asarray(times, float))
        self.values = jnp.asarray(values, float)
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


_MARK = "known_input_"
_INTERPOLATIONS = ("previous", "linear")
_OUTSIDE = ("warn", "hold", "error")
