"""Known inputs: samples of a measured signal as a function of time."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks


class Input(eqx.Module):
    """A known input, called with the time inside the dynamics or the observation.

    Args:
        times: (K,), increasing.
        values: (K,) or (K, C), for C signals.
        interpolation: "previous" holds each value until the next time, "linear" joins them. Before the first and after
            the last time the first and the last value hold.

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

    def __init__(self, times: Any, values: Any, interpolation: str = "previous"):
        checks.one_of("interpolation", interpolation, ("previous", "linear"))
        checks.finite("input times", times)
        checks.finite("input values", values)
        self.times = jnp.atleast_1d(jnp.asarray(times, float))
        self.values = jnp.asarray(values, float)
        self.interpolation = interpolation
        if self.times.ndim != 1 or self.times.size == 0 or self.values.shape[:1] != self.times.shape:
            raise ValueError(f"input values must have one row a time, and at least one: {self.times.shape} times, "
                             f"values of shape {self.values.shape}.")
        known = checks.concrete(times)
        if known is not None and np.any(np.diff(known) <= 0):
            row = int(np.argmax(np.diff(known) <= 0)) + 1
            raise ValueError(f"input times must increase; row {row} ({known[row]:g}) does not.")

    def __call__(self, t: Any) -> jax.Array:
        """Return the input at time ``t``: a scalar, or (C,)."""
        after = jnp.searchsorted(self.times, t, side="right")
        before = jnp.clip(after - 1, 0, self.times.shape[0] - 1)
        if self.interpolation == "previous" or self.times.shape[0] == 1:
            return self.values[before]
        left = jnp.clip(before, 0, self.times.shape[0] - 2)
        width = self.times[left + 1] - self.times[left]
        fraction = jnp.clip((t - self.times[left]) / width, 0.0, 1.0)
        return self.values[left] + fraction * (self.values[left + 1] - self.values[left])
