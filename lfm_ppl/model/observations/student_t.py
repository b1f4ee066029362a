"""Measurements with heavy-tailed errors: Student's t."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax.scipy.special import betainc, gammaln

from lfm_ppl.model.observations.family import ObservationFamily, as_parameter


class StudentTObservation(ObservationFamily):
    r"""Measurements with Student's t errors, robust against outliers.

        y_kd = f_kd + s e,    e ~ t_v,    f_k = h(x, u, t_k).

    Args:
        function: ``h(x, u, t) -> (D,)``.
        df: degrees of freedom v > 0: a number, (D,) or (T, D); it may be sampled.
        scale: s > 0: a number, (D,) or (T, D); it may be sampled.

    Raises:
        ValueError: df or scale is not positive.

    Example:
        >>> import jax.numpy as jnp
        >>> StudentTObservation(lambda x, u, t: x, 1.0, 1.0).log_prob(jnp.zeros(1), jnp.zeros(1)).round(4).tolist()
        [-1.1447]

    Source: Lange, Little and Taylor (1989), Journal of the American Statistical Association 84.
    """

    df: jax.Array
    scale: jax.Array
    per_entry: ClassVar[tuple[str, ...]] = ("df", "scale")

    def __init__(self, function: Callable[..., jax.Array], df: Any, scale: Any):
        self.function = function
        self.df = as_parameter("df", df)
        self.scale = as_parameter("scale", scale)

    def log_prob(self, predictor: jax.Array, y: jax.Array) -> jax.Array:
        """Return the log densities (D,)."""
        v, s = self.df, self.scale
        constant = gammaln(0.5 * (v + 1.0)) - gammaln(0.5 * v) - 0.5 * jnp.log(jnp.pi * v) - jnp.log(s)
        return constant - 0.5 * (v + 1.0) * jnp.log1p(((y - predictor) / s) ** 2 / v)

    def cumulative(self, predictor: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return P(data < y) and P(data <= y), (D,) each, which are equal for a continuous distribution."""
        error = (y - predictor) / self.scale
        tail = 0.5 * betainc(0.5 * self.df, 0.5, self.df / (self.df + error**2))
        probability = jnp.where(error < 0, tail, 1.0 - tail)
        return probability, probability

    def sample(self, key: jax.Array, predictor: jax.Array) -> jax.Array:
        """Draw measurements (D,)."""
        df = jnp.broadcast_to(self.df, predictor.shape)
        return predictor + self.scale * jax.random.t(key, df)
