"""Controllers of discrete inputs, such as the thermostat of a heater."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.utils import checks


class Controller(eqx.Module):
    """Controller of a discrete input: the next value follows from the current one and a reading of the state.

        r_k = g(x(t_k), u(t_k), t_k) + N(0, diag(variance)),    d_k = decide(d_k-1, r_k, t_k),

    at the decision times t_k; the input is constant between them. A subclass defines ``values``, ``reading`` (the
    function g), ``variance`` and ``decide``.

    Attributes:
        values: the V values of the input; d_k is an index in them.
    """

    values: eqx.AbstractVar[tuple[float, ...]]

    def reading(self, x: jax.Array, u: jax.Array, t: Any) -> jax.Array:
        """Return the reading (p,) without its error."""
        raise NotImplementedError

    def variance(self) -> jax.Array:
        """Return the variances (p,) of the reading's error."""
        raise NotImplementedError

    def decide(self, index: jax.Array, reading: jax.Array, t: Any) -> jax.Array:
        """Return the index of the next value, given the index of the current one and a reading (p,)."""
        raise NotImplementedError


class Thermostat(Controller):
    """Thermostat of a heater, which is on below the set point and off above it.

        d_k = 1 if r_k < s(t_k) - b/2,    0 if r_k > s(t_k) + b/2,    d_k-1 otherwise,

    with the measured temperature r_k, the set point s and the width b of the hysteresis. Without hysteresis the heater
    is on whenever the temperature is below the set point, as in the source.

    Args:
        set_point: a number, or a function of time such as `lfm.Input`.
        hysteresis: b >= 0, in the unit of the reading.
        sensor: ``sensor(x, u, t)`` -> the measured temperature, a scalar that is linear in x and u; None: the first
            state.
        sensor_sd: standard deviation of the sensor's error, >= 0.

    Raises:
        ValueError: a missing or non-finite set point; a negative hysteresis or sensor_sd.
        TypeError: the set point is neither a number nor a function; hysteresis or sensor_sd is an array.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> night = lfm.Input([0.0, 7.0, 22.0], [16.0, 20.0, 16.0])
        >>> thermostat = Thermostat(night, hysteresis=0.5)
        >>> [int(thermostat.decide(0, jnp.array([18.0]), t)) for t in (3.0, 8.0)]
        [0, 1]

    Source: Reece et al. (2014), Efficient state-space inference of periodic latent force models, section 9.
    """

    set_point: Any
    hysteresis: jax.Array
    sensor: Callable[..., jax.Array] | None
    sensor_sd: jax.Array
    values: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, set_point: Any, hysteresis: Any = 0.0, sensor: Callable[..., jax.Array] | None = None,
                 sensor_sd: Any = 0.0):
        if set_point is None or (not callable(set_point) and np.size(set_point) == 0):
            raise ValueError("a thermostat needs a set point, got none: give a temperature, or a function of time such "
                             "as lfm.Input(times, set_points). For a house without recorded set points, use the "
                             "heating power as a known input, lfm.Input(times, power).")
        if not callable(set_point):
            if np.ndim(set_point):
                raise TypeError("set_point must be one number or a function of time, got an array of shape "
                                f"{np.shape(set_point)}; use lfm.Input(times, set_points).")
            checks.finite("set_point", set_point)
            set_point = jnp.asarray(set_point, float)
        self.set_point = set_point
        for name, value in (("hysteresis", hysteresis), ("sensor_sd", sensor_sd)):
            concrete = checks.concrete(value)
            checks.finite(name, value)
            if np.ndim(value):
                raise TypeError(f"{name} must be one number, got an array of shape {np.shape(value)}.")
            if concrete is not None and np.any(concrete < 0):
                raise ValueError(f"{name} must not be negative, got {float(concrete):g}.")
        self.hysteresis, self.sensor_sd = jnp.asarray(hysteresis, float), jnp.asarray(sensor_sd, float)
        self.sensor = sensor
        self.values = (0.0, 1.0)

    def set_point_at(self, t: Any) -> jax.Array:
        """Return the set point at time t."""
        return self.set_point(t) if callable(self.set_point) else self.set_point

    def reading(self, x: jax.Array, u: jax.Array, t: Any) -> jax.Array:
        """Return the measured temperature (1,) without its error."""
        return x[:1] if self.sensor is None else jnp.reshape(self.sensor(x, u, t), (1,))

    def variance(self) -> jax.Array:
        """Return the variance (1,) of the sensor's error."""
        return jnp.reshape(self.sensor_sd**2, (1,))

    def decide(self, index: jax.Array, reading: jax.Array, t: Any) -> jax.Array:
        """Return 1 for on, 0 for off."""
        excess = reading[0] - self.set_point_at(t)
        # Exactly at the set point a heater without hysteresis is off.
        is_in_band = (self.hysteresis > 0) & (jnp.abs(excess) <= 0.5 * self.hysteresis)
        return jnp.where(is_in_band, index, (excess < 0).astype(jnp.result_type(index)))
