"""Censored measurements, of which only a limit or an interval is reported."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm

from lfm_ppl.model.observations.family import ObservationFamily, as_parameter
from lfm_ppl.utils import checks


class CensoredObservation(ObservationFamily):
    r"""Gaussian measurements with censoring.

    The measurement ``f + s e``, ``e ~ N(0, 1)``, may be reported incompletely:

    - left: a value at or below ``left`` is reported as ``left`` (a detection limit);
    - right: a value at or above ``right`` is reported as ``right`` (a saturated instrument);
    - interval: a value is reported as the middle of its bin, the multiple of ``width`` nearest to it.

    Args:
        function: ``h(x, u, t) -> (D,)``, f.
        sd: s > 0: a number, (D,) or (T, D); it may be sampled.
        left: lower limit, -inf for none: a number, (D,) or (T, D).
        right: upper limit, inf for none; shapes as for ``left``.
        width: width of the bins, 0 where values are reported exactly; shapes as for ``left``.

    Raises:
        ValueError: the sd is not positive, the width is negative, or the lower limit is not below the upper limit.

    Example:
        >>> import jax.numpy as jnp
        >>> family = CensoredObservation(lambda x, u, t: x, sd=1.0, left=0.0)
        >>> family.log_prob(jnp.zeros(2), jnp.array([0.0, 1.0])).round(4).tolist()
        [-0.6931, -1.4189]

    Source: Tobin (1958), Econometrica 26.
    """

    sd: jax.Array
    left: jax.Array
    right: jax.Array
    width: jax.Array
    per_entry: ClassVar[tuple[str, ...]] = ("sd", "left", "right", "width")

    def __init__(self, function: Callable[..., jax.Array], sd: Any, left: Any = -np.inf, right: Any = np.inf,
                 width: Any = 0.0):
        self.function = function
        self.sd = as_parameter("sd", sd)
        self.left, self.right, self.width = (jnp.asarray(checks.unmask(value), float) for value in (left, right, width))
        lower, upper, bin_width = (checks.concrete(value) for value in (self.left, self.right, self.width))
        if lower is not None and upper is not None and not np.all(lower < upper):
            raise ValueError(f"left must lie below right, got left={lower} and right={upper}.")
        if bin_width is not None and not np.all(bin_width >= 0):
            raise ValueError(f"width must be at least zero, got {bin_width}.")

    def log_prob(self, predictor: jax.Array, y: jax.Array) -> jax.Array:
        """Return the log density of exact values, the log probability of limits and bins, (D,)."""
        s = self.sd
        half = 0.5 * jnp.where(self.width > 0, self.width, s)
        error = (y - predictor) / s
        uncensored = jnp.where(self.width > 0, _log_probability_between(error - half / s, error + half / s),
                               norm.logpdf(error) - jnp.log(s))
        low, high = self._limits(y)
        below, above = norm.logcdf((low - predictor) / s), norm.logcdf((predictor - high) / s)
        return jnp.where(y <= self.left, below, jnp.where(y >= self.right, above, uncensored))

    def _limits(self, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the values below and above which a measurement is reported as a limit; y where there is no limit."""
        finite_left = jnp.where(jnp.isfinite(self.left), self.left, y)
        finite_right = jnp.where(jnp.isfinite(self.right), self.right, y)
        # A binned value is reported as a limit if the middle of its bin lies at the limit or beyond.
        width = jnp.where(self.width > 0, self.width, 1.0)
        low = jnp.where(self.width > 0, (jnp.floor(finite_left / width) + 0.5) * width, finite_left)
        return low, jnp.where(self.width > 0, (jnp.ceil(finite_right / width) - 0.5) * width, finite_right)

    def cumulative(self, predictor: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return P(data < y) and P(data <= y), (D,) each, for a limit, a bin or an exact value."""
        low, high = self._limits(y)
        half = 0.5 * self.width
        lower, upper = jnp.where(y >= self.right, high, y - half), jnp.where(y <= self.left, low, y + half)
        below, up_to = norm.cdf((lower - predictor) / self.sd), norm.cdf((upper - predictor) / self.sd)
        return jnp.where(y <= self.left, 0.0, below), jnp.where(y >= self.right, 1.0, up_to)

    def sample(self, key: jax.Array, predictor: jax.Array) -> jax.Array:
        """Draw measurements (D,), binned and limited as the data are."""
        value = predictor + self.sd * jax.random.normal(key, predictor.shape)
        width = jnp.where(self.width > 0, self.width, 1.0)
        value = jnp.where(self.width > 0, jnp.round(value / width) * width, value)
        return jnp.clip(value, self.left, self.right)


def _log_probability_between(low: jax.Array, high: jax.Array) -> jax.Array:
    """Return log(Phi(high) - Phi(low)) for low < high, without cancellation.

    The interval is reflected to the lower tail, where the difference of probabilities keeps its relative accuracy.
    """
    is_reflected = low > 0
    low, high = jnp.where(is_reflected, -high, low), jnp.where(is_reflected, -low, high)
    log_upper, log_lower = norm.logcdf(high), norm.logcdf(low)
    return log_upper + jnp.log1p(-jnp.exp(jnp.minimum(log_lower - log_upper, -1e-300)))
