"""Counts whose variance is their mean."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaincc, gammaln

from lfm_ppl.model.observations.family import ObservationFamily, not_counts, parameter
from lfm_ppl.model.observations.links import RATES, checked


class PoissonObservation(ObservationFamily):
    r"""Counts from a Poisson distribution.

        y_kd ~ Poisson(E_kd g(f_kd)),    f_k = h(x, u, t_k).

    Args:
        function: ``h(x, u, t) -> (D,)``, the predictor f.
        link: g: "exp", "softplus" or "identity" (the predictor is then the rate itself, and must be positive).
        exposure: E, what a rate of one is counted over (a length of time, a population): a number, (D,) or (T, D).

    Raises:
        ValueError: an unknown link; an exposure that is not positive.

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
        self.link = checked(link, RATES)
        self.exposure = parameter("exposure", exposure)

    def log_prob(self, predictor: jax.Array, y: jax.Array) -> jax.Array:
        """Return y log(E g) - E g - log y!, (D,)."""
        link = RATES[self.link]
        log_rate = link.log_rate(predictor) + jnp.log(self.exposure)
        value = y * log_rate - self.exposure * link.rate(predictor) - gammaln(y + 1.0)
        return jnp.where(jnp.isneginf(log_rate), -jnp.inf, value) if self.link == "identity" else value

    def sample(self, key: jax.Array, predictor: jax.Array) -> jax.Array:
        """Draw counts (D,)."""
        rate = self.exposure * RATES[self.link].rate(predictor)
        return jax.random.poisson(key, rate, predictor.shape).astype(predictor.dtype)

    def cumulative(self, predictor: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return P(data < y) and P(data <= y), (D,) each."""
        return poisson_cumulative(self.mean(predictor), y)

    def mean(self, predictor: jax.Array) -> jax.Array:
        """Return the expected counts (D,)."""
        return self.exposure * RATES[self.link].rate(predictor)

    def problem(self, y: np.ndarray) -> tuple[np.ndarray, str]:
        """Counts are whole numbers >= 0."""
        return not_counts(y), "counts: whole numbers of at least zero"

    def overflows(self, predictor: np.ndarray) -> np.ndarray:
        """Say where the rate is not finite, or not positive."""
        rate = np.asarray(self.exposure * RATES[self.link].rate(jnp.asarray(predictor, float)))
        return ~np.isfinite(rate) | ((rate <= 0) & (self.link == "identity"))


def poisson_cumulative(rate: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return P(count < y) and P(count <= y) at a rate."""
    below = jnp.where(y > 0, gammaincc(jnp.where(y > 0, y, 1.0), rate), 0.0)
    return below, gammaincc(y + 1.0, rate)
