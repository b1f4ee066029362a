"""Evolutions of the weights of a quasi-periodic force, as processes of unit variance.

1. `CQM` changes the weights continuously: a Matern process of order 0.
2. `SQM` and `WQM` change them at change points only, by a jump ``a <- G a + N(0, Q)``; between change points the
   weights are constant.
3. The covariance of two times depends on the number of change points up to each of them (`cycle`).
4. `change_points` gives the ends of the cycles of a known period. Change points are static, since they set the time
   grid of a filter.

Source: Reece, Ghosh, Rogers, Roberts and Jennings (2014), Journal of Machine Learning Research 15, section 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lfm_ppl.forces.matern import Matern
from lfm_ppl.forces.parameters import non_negative_parameter, positive_parameter, scalar_parameter
from lfm_ppl.forces.sde import Force
from lfm_ppl.utils import checks


class CQM(Matern):
    """Weights that change continuously (continuous quasi model): ``exp(-|t - s| / lengthscale)``.

    It is the Matern process of order 0 and scale 1.

    Args:
        lengthscale: in units of time; > 0.

    Raises:
        ValueError: the lengthscale is not positive.

    Example:
        >>> round(float(CQM(lengthscale=10.0).covariance(10.0)), 6)
        0.367879

    Source: Reece et al. (2014), equation 38.
    """

    def __init__(self, lengthscale: ArrayLike):
        super().__init__(1.0, lengthscale, order=0)


class _StepEvolution(Force):
    """A weight a ~ N(0, 1) that is constant except for jumps ``a <- G a + N(0, Q)`` at change points."""

    change_points: tuple[float, ...] = eqx.field(static=True)
    mean: Any

    state_dim: ClassVar[int] = 1

    @property
    def jump_times(self) -> tuple[float, ...]:
        """The change points."""
        return self.change_points

    def initial_covariance(self) -> jax.Array:
        """Return the unit variance (1, 1)."""
        return jnp.ones((1, 1))

    def feedback(self) -> jax.Array:
        """Return F (1, 1), zero."""
        return jnp.zeros((1, 1))

    def dispersion(self) -> jax.Array:
        """Return L (1, 0)."""
        return jnp.zeros((1, 0))

    def discretise(self, dt: ArrayLike) -> tuple[jax.Array, jax.Array]:
        """Return transition (1, 1), one, and process noise (1, 1), zero."""
        return jnp.ones((1, 1)), jnp.zeros((1, 1))

    def sde_covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return `covariance`, which is exact."""
        return self.covariance(t, s)

    def covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return k(t, s), elementwise, for times of the model."""
        return self.between_cycles(self.cycle(t), self.cycle(s))

    def covariance_in_model(self, t: ArrayLike, s: ArrayLike, initial_time: ArrayLike) -> jax.Array:
        """Return k(t, s) in a model that starts at ``initial_time``, which ignores earlier change points."""
        first_cycle = self.cycle(initial_time)
        return self.between_cycles(self.cycle(t) - first_cycle, self.cycle(s) - first_cycle)

    def between_cycles(self, i: jax.Array, j: jax.Array) -> jax.Array:
        """Return the covariance of the weights in cycles i and j, elementwise; the first cycle is number 0."""
        raise NotImplementedError

    def cycle(self, t: ArrayLike) -> jax.Array:
        """Return the number of change points at or before t, elementwise."""
        points = np.asarray(self.change_points, float)
        return (jnp.asarray(t, float)[..., None] >= points).sum(-1)


class SQM(_StepEvolution):
    """Weights that jump at change points and keep their variance (step quasi model).

        k(t, s) = exp(-|C(t) - C(s)| / lengthscale),    C(t) the number of change points up to t.

    At a change point ``a <- exp(-1/lengthscale) a + N(0, 1 - exp(-2/lengthscale))``.

    Args:
        lengthscale: in cycles, without unit; > 0.
        change_points: increasing times, known before compilation. A model ignores change points up to its initial time.

    Raises:
        ValueError: the lengthscale is not positive, or the change points do not increase.

    Example:
        >>> steps = SQM(lengthscale=2.0, change_points=(24.0, 48.0))
        >>> round(float(steps.covariance(50.0, 3.0)), 6)
        0.367879

    Source: Reece et al. (2014), equations 39, 42 and 43.
    """

    lengthscale: jax.Array

    def __init__(self, lengthscale: ArrayLike, change_points: Sequence[float]):
        self.lengthscale = positive_parameter("lengthscale", lengthscale)
        self.change_points = _increasing_times(change_points)
        self.mean = scalar_parameter("mean", 0.0)

    def jump(self, index: int) -> tuple[jax.Array, jax.Array]:
        """Return G (1, 1) and Q (1, 1)."""
        if not 0 <= index < len(self.change_points):
            return super().jump(index)
        return jnp.exp(-jnp.ones((1, 1)) / self.lengthscale), -jnp.expm1(-2.0 * jnp.ones((1, 1)) / self.lengthscale)

    def between_cycles(self, i: jax.Array, j: jax.Array) -> jax.Array:
        """Return ``exp(-|i - j| / lengthscale)``."""
        return jnp.exp(-jnp.abs(i - j) / self.lengthscale)


class WQM(_StepEvolution):
    """Weights that jump at change points and gain variance (Wiener-step quasi model).

        k(t, s) = 1 + growth min(C(t), C(s)),    C(t) the number of change points up to t.

    At a change point ``a <- a + N(0, growth)``.

    Args:
        growth: variance gained at a change point, relative to the variance of the first cycle; >= 0.
        change_points: increasing times, known before compilation. A model ignores change points up to its initial
            time; `covariance` counts them.

    Raises:
        ValueError: the growth is negative, or the change points do not increase.

    Example:
        >>> steps = WQM(growth=0.25, change_points=(24.0, 48.0))
        >>> float(steps.covariance(50.0, 60.0)), float(steps.covariance(50.0, 3.0))
        (1.5, 1.0)

    Source: Reece et al. (2014), equations 40, 44 and 45.
    """

    growth: jax.Array

    def __init__(self, growth: ArrayLike, change_points: Sequence[float]):
        self.growth = non_negative_parameter("growth", growth)
        self.change_points = _increasing_times(change_points)
        self.mean = scalar_parameter("mean", 0.0)

    def jump(self, index: int) -> tuple[jax.Array, jax.Array]:
        """Return G (1, 1), one, and Q (1, 1)."""
        if not 0 <= index < len(self.change_points):
            return super().jump(index)
        return jnp.ones((1, 1)), jnp.reshape(self.growth, (1, 1))

    def between_cycles(self, i: jax.Array, j: jax.Array) -> jax.Array:
        """Return ``1 + growth min(i, j)``."""
        return 1.0 + self.growth * jnp.minimum(i, j)


def change_points(period: float, start: float, stop: float) -> tuple[float, ...]:
    """Return the ends of the cycles from ``start`` to ``stop``: start + D, start + 2 D, ...

    Args:
        period: D, in units of time; known before compilation, since jump times are static.
        start: beginning of the first cycle.
        stop: the last time of interest.

    Raises:
        ValueError: the period is not positive, or longer than the time from start to stop.
        TypeError: the period is traced.

    Example:
        >>> change_points(24.0, start=0.0, stop=72.0)
        (24.0, 48.0, 72.0)
    """
    if checks.traced((period, start, stop)):
        raise TypeError("period, start and stop must be known before compilation, since change points are static; "
                        "pass numbers, and keep the change points fixed where the period is a parameter.")
    # NumPy arithmetic: inside compiled code, jnp functions turn numbers into tracers.
    for name, value in (("period", period), ("start", start), ("stop", stop)):
        checks.finite(name, value)
    checks.positive("period", period)
    period, start, stop = float(period), float(start), float(stop)
    count = int(np.floor((stop - start) / period * (1 + 1e-12)))
    if count < 1:
        raise ValueError(f"period must not be longer than the time from start to stop, {stop - start:g}; got "
                         f"{period:g}. There is no whole cycle, so no change point between cycles.")
    return tuple(start + period * index for index in range(1, count + 1))


def _increasing_times(points: Sequence[float]) -> tuple[float, ...]:
    if checks.traced(points):
        raise TypeError("change_points must be known before compilation; pass numbers, not traced values.")
    times = np.asarray(points)
    if times.dtype.kind not in "biuf" or times.ndim != 1:
        raise TypeError(f"change_points must be a sequence of times, got {points!r}.")
    checks.finite("change_points", times)
    disordered = np.flatnonzero(np.diff(times) <= 0)
    if disordered.size:
        index = int(disordered[0]) + 1
        raise ValueError(f"change_points must increase: entry {index} is {times[index]:g} after {times[index - 1]:g}. "
                         "Sort them and remove repeated entries.")
    return tuple(float(time) for time in times)
