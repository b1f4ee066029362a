"""Measurements of which only a limit or an interval is known."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm

from lfm_ppl import checks
from lfm_ppl.model.observations.family import ObservationFamily, parameter


class CensoredObservation(ObservationFamily):
    r"""Gaussian measurements with censoring.

    The measurement ``f + s e``, ``e ~ N(0, 1)``, is not always seen:

    - left: a value at or below ``left`` is reported as ``left`` (a detection limit);
    - right: a value at or above ``right`` is reported as ``right`` (a saturated instrument);
    - interval: a value is reported as the middle of its bin, the multiple of ``width`` nearest to it.

    Args:
        function: ``h(x, u, t) -> (D,)``, f.
        scale: s > 0: a number, (D,) or (T, D); it may be sampled.
        left: lower limit; -inf for none. A number, (D,) or (T, D), and so are the next two.
        right: upper limit; inf for none.
        width: of the bins; 0 where values are reported as they are.

    Raises:
        ValueError: a scale that is not positive, a negative width, a lower limit that is not below the upper one.

    Example:
        >>> import jax.numpy as jnp
        >>> family = CensoredObservation(lambda x, u, t: x, 1.0, left=0.0)
        >>> family.log_prob(jnp.zeros(2), jnp.array([0.0, 1.0])).round(4).tolist()
        [-0.6931, -1.4189]

    Source: Tobin (1958), Econometrica 26.
    """

    scale: jax.Array
    left: jax.Array
    right: jax.Array
    width: jax.Array
    per_entry: ClassVar[tuple[str, ...]] = ("scale", "left", "right", "width")

    def __init__(self, function: Callable[..., jax.Array], scale: Any, left: Any = -np.inf, right: Any = np.inf,
                 width: Any = 0.0):
        self.function = function
        self.scale = parameter("scale", scale)
        self.left, self.right, self.width = (jnp.asarray(checks.unmask(value), float) for value in (left, right, width))
        known = [checks.concrete(value) for value in (self.left, self.right, self.width)]
        if known[0] is not None and known[1] is not None and not np.all(known[0] < known[1]):
            raise ValueError(f"left must lie below right, got left={known[0]} and right={known[1]}.")
        if known[2] is not None and not np.all(known[2] >= 0):
            raise ValueError(f"width must be at least zero, got {known[2]}.")

    def log_prob(self, predictor: jax.Array, y: jax.Array) -> jax.Array:
        """Return the log density of what is seen, the log probability of what is censored, (D,)."""
        s = self.scale
        half = 0.5 * jnp.where(self.width > 0, self.width, s)
        error = (y - predictor) / s
        seen = jnp.where(self.width > 0, _log_probability_between(error - half / s, error + half / s),
                         norm.logpdf(error) - jnp.log(s))
        low, high = self._limits(y)
        below, above = norm.logcdf((low - predictor) / s), norm.logcdf((predictor - high) / s)
        return jnp.where(y <= self.left, below, jnp.where(y >= self.right, above, seen))

    def _limits(self, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return below and above which values are reported as a limit; y where there is no limit."""
        finite_left = jnp.where(jnp.isfinite(self.left), self.left, y)
        finite_right = jnp.where(jnp.isfinite(self.right), self.right, y)
        # Of values in bins those are reported as a limit whose bin's middle lies at it or beyond.
        width = jnp.where(self.width > 0, self.width, 1.0)
        low = jnp.where(self.width > 0, (jnp.floor(finite_left / width) + 0.5) * width, finite_left)
        return low, jnp.where(self.width > 0, (jnp.ceil(finite_right / width) - 0.5) * width, finite_right)

    def cumulative(self, predictor: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return P(data < y) and P(data <= y), (D,) each: those of a limit, of a bin, or of a value."""
        low, high = self._limits(y)
        half = 0.5 * self.width
        from_, to = jnp.where(y >= self.right, high, y - half), jnp.where(y <= self.left, low, y + half)
        below, up_to = norm.cdf((from_ - predictor) / self.scale), norm.cdf((to - predictor) / self.scale)
        return jnp.where(y <= self.left, 0.0, below), jnp.where(y >= self.right, 1.0, up_to)

    def sample(self, key: jax.Array, predictor: jax.Array) -> jax.Array:
        """Draw measurements (D,) and report them as the instrument does."""
        value = predictor + self.scale * jax.random.normal(key, predictor.shape)
        width = jnp.where(self.width > 0, self.width, 1.0)
        value = jnp.where(self.width > 0, jnp.round(value / width) * width, value)
        return jnp.clip(value, self.left, self.right)


def _log_probability_between(low: jax.Array, high: jax.Array) -> jax.Array:
    """Return log(Phi(high) - Phi(low)) for low < high, in the tail in which both probabilities are small."""
    mirrored = low > 0
    low, high = jnp.where(mirrored, -high, low), jnp.where(mirrored, -low, high)
    outer, inner = norm.logcdf(high), norm.logcdf(low)
    return outer + jnp.log1p(-jnp.exp(jnp.minimum(inner - outer, -1e-300)))
