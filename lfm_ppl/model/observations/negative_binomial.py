"""Counts whose variance is more than their mean."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import betainc, gammaln

from lfm_ppl.model.observations.family import ObservationFamily, not_counts, parameter
from lfm_ppl.model.observations.links import RATES, checked
from lfm_ppl.model.observations.poisson import poisson_cumulative


class NegativeBinomialObservation(ObservationFamily):
    r"""Counts from a negative binomial distribution: a Poisson whose rate is gamma distributed.

        E y = mu = E g(f),    Var y = mu + mu^2 / c,    f_k = h(x, u, t_k).

    Args:
        function: ``h(x, u, t) -> (D,)``, the predictor f.
        concentration: c > 0, infinite for a Poisson: a number, (D,) or (T, D); it may be sampled.
        link: g: "exp", "softplus" or "identity".
        exposure: E: a number, (D,) or (T, D).

    Raises:
        ValueError: an unknown link; a concentration or an exposure that is not positive.

    Example:
        >>> import jax.numpy as jnp
        >>> NegativeBinomialObservation(lambda x, u, t: u, 1.0).log_prob(jnp.zeros(1), jnp.zeros(1)).round(4).tolist()
        [-0.6931]
    """

    concentration: jax.Array
    exposure: jax.Array
    link: str = eqx.field(static=True)
    per_entry: ClassVar[tuple[str, ...]] = ("concentration", "exposure")

    def __init__(self, function: Callable[..., jax.Array], concentration: Any, link: str = "exp",
                 exposure: Any = 1.0):
        self.function = function
        self.concentration = parameter("concentration", concentration)
        self.link = checked(link, RATES)
        self.exposure = parameter("exposure", exposure)

    def log_prob(self, predictor: jax.Array, y: jax.Array) -> jax.Array:
        """Return the log probabilities (D,) of counts."""
        c, log_mean = self.concentration, RATES[self.link].log_rate(predictor) + jnp.log(self.exposure)
        log_odds = log_mean - jnp.log(c)
        total = jax.nn.softplus(log_odds)  # log(1 + mu / c)
        # Gamma(y + c) / (Gamma(c) c^y): differences of large numbers where c is large; Stirling's series there.
        large = c > 1e3
        small_c, large_c = jnp.where(large, 1.0, c), jnp.where(large, c, 1e3)
        rising = jnp.where(
            large, (y + large_c - 0.5) * jnp.log1p(y / large_c) - y - y / (12.0 * large_c * (y + large_c)),
            gammaln(y + small_c) - gammaln(small_c) - y * jnp.log(small_c))
        value = rising - gammaln(y + 1.0) - c * total + y * (log_mean - total)
        return jnp.where(jnp.isneginf(log_mean), -jnp.inf, value) if self.link == "identity" else value

    def sample(self, key: jax.Array, predictor: jax.Array) -> jax.Array:
        """Draw counts (D,)."""
        rate_key, count_key = jax.random.split(key)
        c = jnp.broadcast_to(self.concentration, predictor.shape)
        rate = self.exposure * RATES[self.link].rate(predictor) * jax.random.gamma(rate_key, c) / c
        return jax.random.poisson(count_key, rate, predictor.shape).astype(predictor.dtype)

    def cumulative(self, predictor: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return P(data < y) and P(data <= y), (D,) each."""
        mean, small = self.mean(predictor), self.concentration < _POISSON
        c = jnp.where(small, self.concentration, 1.0)
        share = c / (c + mean)
        below = jnp.where(y > 0, betainc(c, jnp.where(y > 0, y, 1.0), share), 0.0)
        limit = poisson_cumulative(mean, y)
        return jnp.where(small, below, limit[0]), jnp.where(small, betainc(c, y + 1.0, share), limit[1])

    def mean(self, predictor: jax.Array) -> jax.Array:
        """Return the expected counts (D,)."""
        return self.exposure * RATES[self.link].rate(predictor)

    def problem(self, y: np.ndarray) -> tuple[np.ndarray, str]:
        """Counts are whole numbers >= 0."""
        return not_counts(y), "counts: whole numbers of at least zero"

    def overflows(self, predictor: np.ndarray) -> np.ndarray:
        """Say where the mean is not finite, or not positive."""
        mean = np.asarray(self.exposure * RATES[self.link].rate(jnp.asarray(predictor, float)))
        return ~np.isfinite(mean) | ((mean <= 0) & (self.link == "identity"))


_POISSON = 1e8
"""Concentration from which on counts are those of a Poisson to eight digits."""
