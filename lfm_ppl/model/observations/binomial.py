"""How many of a known number."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import betainc, gammaln

from lfm_ppl.model.observations.family import ObservationFamily, not_counts, parameter
from lfm_ppl.model.observations.links import PROBABILITIES, checked


class BinomialObservation(ObservationFamily):
    r"""Successes among a known number of trials.

        y_kd ~ Binomial(n_kd, g(f_kd)),    f_k = h(x, u, t_k).

    Args:
        function: ``h(x, u, t) -> (D,)``, the predictor f.
        total_count: n: a number, (D,) or (T, D).
        link: g: "logit", "probit" or "identity" (the predictor is then the probability itself).

    Raises:
        ValueError: an unknown link; a number of trials that is not positive.

    Example:
        >>> import jax.numpy as jnp
        >>> BinomialObservation(lambda x, u, t: u, 2).log_prob(jnp.zeros(1), jnp.ones(1)).round(4).tolist()
        [-0.6931]
    """

    total_count: jax.Array
    link: str = eqx.field(static=True)
    per_entry: ClassVar[tuple[str, ...]] = ("total_count",)

    def __init__(self, function: Callable[..., jax.Array], total_count: Any, link: str = "logit"):
        self.function = function
        self.total_count = parameter("total_count", total_count)
        self.link = checked(link, PROBABILITIES)

    def log_prob(self, predictor: jax.Array, y: jax.Array) -> jax.Array:
        """Return log C(n, y) + y log p + (n - y) log(1 - p), (D,)."""
        link, n = PROBABILITIES[self.link], self.total_count
        ways = gammaln(n + 1.0) - gammaln(y + 1.0) - gammaln(n - y + 1.0)
        return ways + _times(y, link.log_probability(predictor)) + _times(n - y, link.log_complement(predictor))

    def sample(self, key: jax.Array, predictor: jax.Array) -> jax.Array:
        """Draw counts (D,)."""
        probability = jnp.exp(PROBABILITIES[self.link].log_probability(predictor))
        return jax.random.binomial(key, self.total_count, probability, predictor.shape).astype(predictor.dtype)

    def cumulative(self, predictor: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return P(data < y) and P(data <= y), (D,) each."""
        n, share = self.total_count, jnp.exp(PROBABILITIES[self.link].log_complement(predictor))
        below = jnp.where(y > 0, betainc(n - y + 1.0, jnp.where(y > 0, y, 1.0), share), 0.0)
        return below, jnp.where(y < n, betainc(jnp.where(y < n, n - y, 1.0), y + 1.0, share), 1.0)

    def mean(self, predictor: jax.Array) -> jax.Array:
        """Return the expected counts (D,)."""
        return self.total_count * jnp.exp(PROBABILITIES[self.link].log_probability(predictor))

    def problem(self, y: np.ndarray) -> tuple[np.ndarray, str]:
        """Counts are whole numbers from zero to the number of trials."""
        return not_counts(y) | (y > np.asarray(self.total_count)), "counts: whole numbers from zero to total_count"

    def overflows(self, predictor: np.ndarray) -> np.ndarray:
        """Say where the predictor is no number, or no probability."""
        return ~np.isfinite(predictor) | ((self.link == "identity") & ((predictor <= 0) | (predictor >= 1)))


def _times(count: jax.Array, log_probability: jax.Array) -> jax.Array:
    """Return count * log p, zero for a count of zero whatever p is."""
    return jnp.where(count == 0, 0.0, count * log_probability)
