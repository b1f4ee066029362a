"""Periodic covariance functions, from which periodic and quasi-periodic forces are built.

1. `PeriodicCovariance` is the protocol: k(t, s) with a period D, elementwise in both times.
2. `PeriodicMatern` and `PeriodicSquaredExponential` apply an ordinary kernel to the chord |sin(pi (t - s) / D)|; they
   are stationary.
3. `ModeratedPeriodicMatern` multiplies the periodic Matern kernel by a decay from the start of each cycle.
4. `PeriodicKernel` repeats any user-defined covariance function of one cycle; it is checked at a few times when it is
   constructed (shape, finiteness, symmetry, stationarity if claimed).

Source: Reece, Ghosh, Rogers, Roberts and Jennings (2014), Journal of Machine Learning Research 15.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lfm_ppl.forces.matern import Matern
from lfm_ppl.forces.parameters import non_negative_parameter, positive_parameter, scalar_parameter, static_order
from lfm_ppl.utils import checks


class PeriodicCovariance(eqx.Module):
    """A covariance function k(t, s) with ``k(t + D, s) = k(t, s)``, D the period.

    It is a pytree whose parameters are its leaves. A subclass implements ``__call__``, elementwise in both times.

    Attributes:
        period: D, in units of time.
        stationary: whether k depends on t - s alone.
        has_fixed_period: whether the period is a Python or NumPy number. A sampled period is a JAX array, which no
            check may reject.
    """

    period: eqx.AbstractVar[jax.Array]
    has_fixed_period: eqx.AbstractVar[bool]

    @property
    def stationary(self) -> bool:
        """Whether k depends on t - s alone."""
        return True

    @property
    def start(self) -> jax.Array:
        """The beginning of the cycle on which eigenfunctions are computed."""
        return jnp.zeros(())

    @property
    def name(self) -> str:
        """The name of the kernel in messages."""
        return type(self).__name__

    def __call__(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return k(t, s), elementwise."""
        raise NotImplementedError

    def chord(self, t: ArrayLike, s: ArrayLike) -> jax.Array:
        """Return ``|sin(pi (t - s) / D)|``, elementwise, which goes from 0 to 1 and back to 0 within a period."""
        return jnp.abs(jnp.sin(np.pi * (jnp.asarray(t) - s) / self.period))


def _is_number(value: Any) -> bool:
    return not isinstance(value, jax.Array)


class PeriodicMatern(PeriodicCovariance):
    """The Matern kernel of the chord: ``k(t, s) = Matern(|sin(pi (t - s) / D)|)``, nu = order + 1/2.

    Args:
        scale: standard deviation, in the units of the force; > 0.
        lengthscale: relative to the chord, without unit; > 0. At about 1, the two halves of a cycle are similar; a
            small lengthscale gives many oscillations per cycle.
        period: D, in units of time; > 0.
        order: a Python int from 0 to 5. Lower orders need more eigenfunctions.

    Raises:
        ValueError: a parameter is not positive, or the order is out of range.

    Example:
        >>> kernel = PeriodicMatern(scale=2.0, lengthscale=0.5, period=24.0)
        >>> round(float(kernel(30.0, 6.0)), 6)
        4.0

    Source: Reece et al. (2014), equation 31.
    """

    scale: jax.Array
    lengthscale: jax.Array
    period: jax.Array
    order: int = eqx.field(static=True)
    has_fixed_period: bool = eqx.field(static=True)

    def __init__(self, scale: ArrayLike, lengthscale: ArrayLike, period: ArrayLike, order: int = 1):
        self.scale = positive_parameter("scale", scale)
        self.lengthscale = positive_parameter("lengthscale", lengthscale)
        self.period, self.has_fixed_period = positive_parameter("period", period), _is_number(period)
        self.order = static_order(order, Matern.orders)

    def __call__(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return k(t, s), elementwise."""
        return Matern(self.scale, self.lengthscale, self.order).covariance(self.chord(t, s))


class PeriodicSquaredExponential(PeriodicCovariance):
    """The squared exponential of the chord: ``k(t, s) = scale^2 exp(-sin^2(pi (t - s) / D) / lengthscale^2)``.

    Args:
        scale: standard deviation, in the units of the force; > 0.
        lengthscale: relative to the chord, without unit; > 0.
        period: D, in units of time; > 0.

    Raises:
        ValueError: a parameter is not positive.

    Example:
        >>> kernel = PeriodicSquaredExponential(scale=1.0, lengthscale=1.0, period=10.0)
        >>> round(float(kernel(5.0)), 6)
        0.367879

    Source: Reece et al. (2014), equation 16.
    """

    scale: jax.Array
    lengthscale: jax.Array
    period: jax.Array
    has_fixed_period: bool = eqx.field(static=True)

    def __init__(self, scale: ArrayLike, lengthscale: ArrayLike, period: ArrayLike):
        self.scale = positive_parameter("scale", scale)
        self.lengthscale = positive_parameter("lengthscale", lengthscale)
        self.period, self.has_fixed_period = positive_parameter("period", period), _is_number(period)

    def __call__(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return k(t, s), elementwise."""
        return self.scale**2 * jnp.exp(-((self.chord(t, s) / self.lengthscale) ** 2))


class ModeratedPeriodicMatern(PeriodicCovariance):
    """A periodic Matern kernel that decays with the distance from the beginning of a cycle; it is not stationary.

        k(t, s) = Matern(|sin(pi (t - s) / D)|) exp(-decay (|t| + |s|)),

    where |t| is the distance from t to the nearest multiple of D.

    Args:
        scale: standard deviation at t = 0, in the units of the force; > 0.
        lengthscale: relative to the chord, without unit; > 0.
        period: D, in units of time; > 0.
        decay: rate of decay, per unit of time; >= 0.
        order: as in `PeriodicMatern`.

    Raises:
        ValueError: a parameter is not positive, or the decay is negative.

    Example:
        >>> kernel = ModeratedPeriodicMatern(scale=1.0, lengthscale=1.0, period=10.0, decay=0.5)
        >>> round(float(kernel(12.0, 12.0)), 6), kernel.stationary
        (0.135335, False)

    Source: Reece et al. (2014), equation 32, with a decay of one.
    """

    scale: jax.Array
    lengthscale: jax.Array
    period: jax.Array
    decay: jax.Array
    order: int = eqx.field(static=True)
    has_fixed_period: bool = eqx.field(static=True)

    def __init__(self, scale: ArrayLike, lengthscale: ArrayLike, period: ArrayLike, decay: ArrayLike = 1.0,
                 order: int = 1):
        self.scale = positive_parameter("scale", scale)
        self.lengthscale = positive_parameter("lengthscale", lengthscale)
        self.period, self.has_fixed_period = positive_parameter("period", period), _is_number(period)
        self.decay = non_negative_parameter("decay", decay)
        self.order = static_order(order, Matern.orders)

    @property
    def stationary(self) -> bool:
        """False."""
        return False

    def __call__(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return k(t, s), elementwise."""
        matern = Matern(self.scale, self.lengthscale, self.order).covariance(self.chord(t, s))
        return matern * jnp.exp(-self.decay * (self._distance(t) + self._distance(s)))

    def _distance(self, t: ArrayLike) -> jax.Array:
        t = jnp.asarray(t)
        return jnp.abs(t - self.period * jax.lax.stop_gradient(jnp.round(t / self.period)))


class PeriodicKernel(PeriodicCovariance):
    """The periodic repetition of any covariance function of one cycle.

        k(t, s) = function(t', s'),    t' = start + (t - start) mod D,  s' = start + (s - start) mod D.

    Args:
        function: k(t, s), elementwise, in JAX operations. An Equinox module keeps its parameters as leaves.
        period: D, in units of time; > 0.
        stationary: whether the function depends on t - s alone and is periodic itself. Its eigenfunctions are then
            sines and cosines in closed form.
        start: the beginning of a cycle.

    Raises:
        ValueError: the period is not positive; the function is not elementwise, not finite, not symmetric, or is
            declared stationary and is not. Positive definiteness is checked by the force, where the function's
            parameters are concrete. In compiled code a stationary kernel that is not positive definite gives NaN, and
            thus a log likelihood of -inf; any other kernel loses its negative eigenvalues.

    Example:
        >>> import jax.numpy as jnp
        >>> kernel = PeriodicKernel(lambda t, s: jnp.exp(-jnp.abs(t - s) / 3.0), period=10.0)
        >>> round(float(kernel(21.0, 4.0)), 6)
        0.367879
    """

    function: Callable[..., Any]
    period: jax.Array
    cycle_start: jax.Array
    is_stationary: bool = eqx.field(static=True)
    label: str = eqx.field(static=True)
    has_fixed_period: bool = eqx.field(static=True)

    def __init__(self, function: Callable[..., Any], period: ArrayLike, stationary: bool = False,
                 start: ArrayLike = 0.0):
        if not callable(function):
            raise TypeError(f"function must be callable as k(t, s), got {type(function).__name__}.")
        self.function = function if isinstance(function, eqx.Module) else jax.tree_util.Partial(function)
        self.period, self.has_fixed_period = positive_parameter("period", period), _is_number(period)
        self.cycle_start = scalar_parameter("start", start)
        self.is_stationary = bool(stationary)
        self.label = getattr(function, "__name__", type(function).__name__)
        _check_function(self)

    @property
    def stationary(self) -> bool:
        """Whether the function was declared stationary."""
        return self.is_stationary

    @property
    def start(self) -> jax.Array:
        """The beginning of a cycle."""
        return self.cycle_start

    @property
    def name(self) -> str:
        """The function's name."""
        return self.label

    def __call__(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return k(t, s), elementwise."""
        return jnp.asarray(self.function(self._in_cycle(t), self._in_cycle(s)), float)

    def _in_cycle(self, t: ArrayLike) -> jax.Array:
        t = jnp.asarray(t, float)
        cycle = jax.lax.stop_gradient(jnp.floor((t - self.cycle_start) / self.period))
        return t - cycle * self.period


def _check_function(kernel: PeriodicKernel) -> None:
    """Evaluate the function at a few times of a cycle and check the values."""
    # Irregular fractions of a cycle.
    fractions = np.array([0.0, 0.113, 0.331, 0.502, 0.743, 0.958])
    times = kernel.cycle_start + kernel.period * fractions
    value = kernel(times[:, None], times[None, :])
    if value.shape != (6, 6):
        raise ValueError(f"the kernel {kernel.name!r} must work elementwise: for times of shape (6, 1) and (1, 6) it "
                         f"must return (6, 6), it returned {value.shape}.")
    gram = checks.concrete(value)
    if gram is None:
        return
    if not np.isfinite(gram).all():
        raise ValueError(f"the kernel {kernel.name!r} is not finite on the cycle from {float(kernel.cycle_start):g}.")
    tolerance = 1e-8 * np.abs(gram).max()
    if np.abs(gram - gram.T).max() > tolerance:
        raise ValueError(f"the kernel {kernel.name!r} is not symmetric: k(t, s) differs from k(s, t) by "
                         f"{np.abs(gram - gram.T).max():g}.")
    if kernel.is_stationary:
        shifted_times = times + 0.271 * kernel.period
        shifted = np.asarray(kernel(shifted_times[:, None], shifted_times[None, :]))
        if np.abs(shifted - gram).max() > tolerance:
            raise ValueError(f"the kernel {kernel.name!r} is declared stationary with period {float(kernel.period):g}, "
                             "but is not: shifting both times by a fraction of a period changes it by "
                             f"{np.abs(shifted - gram).max():g}. Set stationary=False, or write it as a function of "
                             "jnp.sin(pi * (t - s) / period).")
