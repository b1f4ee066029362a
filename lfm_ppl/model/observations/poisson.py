"""Poisson counts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaincc, gammaln

from lfm_ppl.model.observations.family import ObservationFamily, as_parameter, is_not_count
from lfm_ppl.model.observations.links import RATES, link_name


class PoissonObservation(ObservationFamily):
    r"""Counts from a Poisson distribution.

        y_kd ~ Poisson(E_kd g(f_kd)),    f_k = h(x, u, t_k).

    Args:
        function: ``h(x, u, t) -> (D,)``, the predictor f.
        link: g: "exp", "softplus" or "identity" (the predictor is then the rate itself, and must be positive).
        exposure: E, the length of time, population or similar to which the rate refers: a number, (D,) or (T, D).

    Raises:
        ValueError: the link is unknown, or the exposure is not positive.

    Example:
        >>> import jax.numpy as jnp
        >>> PoissonObservation(lambda x, u, t: u).log_prob(jnp.zeros(1), jnp.zeros(1)).tolist()
        [-1.0]

    Source: Møller, Syversen and Waagepetersen (1998), Scandinavian Journal of Statistics 25.
    """

    exposure: jax.Array
    link: str = eqx.field(static=True)
    per_entry: ClassVar[tuple[str, ...]] = ("exposure",)

    def __init__(self, function: Callable[..., jax.Array], link: str = "exp", exposure: Any = 1.0):
        self.function = function
        self.link = link_name(link, RATES)
        self.exposure = as_parameter("exposure", exposure)

    def log_prob(self, predictor: jax.Array, y: jax.Array) -> jax.Array:
        """Return y log(E g) - E g - log y!, (D,)."""
        rate, log_rate = RATES[self.link]
        log_mean = log_rate(predictor) + jnp.log(self.exposure)
        value = y * log_mean - self.exposure * rate(predictor) - gammaln(y + 1.0)
        return jnp.where(jnp.isneginf(log_mean), -jnp.inf, value) if self.link == "identity" else value

    def sample(self, key: jax.Array, predictor: jax.Array) -> jax.Array:
        """Draw counts (D,)."""
        return jax.random.poisson(key, self.mean(predictor), predictor.shape).astype(predictor.dtype)

    def cumulative(self, predictor: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return P(data < y) and P(data <= y), (D,) each."""
        return poisson_cumulative(self.mean(predictor), y)

    def mean(self, predictor: jax.Array) -> jax.Array:
        """Return the expected counts (D,)."""
        rate, _ = RATES[self.link]
        return self.exposure * rate(predictor)

    def problem(self, y: np.ndarray) -> tuple[np.ndarray, str]:
        """Return which data are not counts, and the requirement."""
        return is_not_count(y), "counts: whole numbers of at least zero"

    def overflows(self, predictor: np.ndarray) -> np.ndarray:
        """Return whether the mean is not finite, or not positive under the identity link, (D,)."""
        mean = np.asarray(self.mean(jnp.asarray(predictor, float)))
        return ~np.isfinite(mean) | ((mean <= 0) & (self.link == "identity"))


def poisson_cumulative(rate: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return P(count < y) and P(count <= y) of Poisson counts with this rate."""
    below = jnp.where(y > 0, gammaincc(jnp.where(y > 0, y, 1.0), rate), 0.0)
    return below, gammaincc(y + 1.0, rate)
