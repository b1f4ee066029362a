"""Counts: Poisson and, overdispersed, negative binomial."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import betainc, gammaincc

from lfm_ppl.model.observations.family import ObservationFamily, as_parameter, is_not_count
from lfm_ppl.model.observations.links import RATES, link_name
from lfm_ppl.model.observations.saddle_point import LOG_2PI, stirling_error

_POISSON_LIMIT = 1e8
"""Concentration above which the negative binomial distribution is Poisson to eight digits."""


class _CountObservation(ObservationFamily):
    """Counts with the mean E g(f): exposure E, link g, predictor f."""

    exposure: jax.Array
    link: str = eqx.field(static=True)
    per_entry: ClassVar[tuple[str, ...]] = ("exposure",)

    def __init__(self, function: Callable[..., jax.Array], link: str, exposure: Any):
        self.function = function
        self.link = link_name(link, RATES)
        self.exposure = as_parameter("exposure", exposure)

    def mean(self, predictor: jax.Array) -> jax.Array:
        """Return the expected counts (D,)."""
        rate, _ = RATES[self.link]
        return self.exposure * rate(predictor)

    def _log_mean(self, predictor: jax.Array) -> jax.Array:
        _, log_rate = RATES[self.link]
        return log_rate(predictor) + jnp.log(self.exposure)

    def _where_possible(self, predictor: jax.Array, y: jax.Array, value: jax.Array, of_zero: jax.Array) -> jax.Array:
        """Return the log probability of a count at every predictor of the identity link; ``value`` for other links.

        It is -inf below zero. At zero, where the log mean of ``value`` is -inf, a count of zero has the log probability
        ``of_zero``, whose derivative is the right one, and any other count is impossible.
        """
        if self.link != "identity":
            return value
        at_zero = jnp.where(y == 0, of_zero, -jnp.inf)
        return jnp.where(predictor > 0, value, jnp.where(predictor == 0, at_zero, -jnp.inf))

    def problem(self, y: np.ndarray) -> tuple[np.ndarray, str]:
        """Return which data are not counts, and the requirement."""
        return is_not_count(y), "counts: whole numbers of at least zero"

    def overflows(self, predictor: np.ndarray) -> np.ndarray:
        """Return whether the mean is not finite, or negative under the identity link, (D,)."""
        mean = np.asarray(self.mean(jnp.asarray(predictor, float)))
        return ~np.isfinite(mean) | (mean < 0)


class PoissonObservation(_CountObservation):
    r"""Counts from a Poisson distribution.

        y_kd ~ Poisson(E_kd g(f_kd)),    f_k = h(x, u, t_k).

    Args:
        function: ``h(x, u, t) -> (D,)``, the predictor f.
        link: g: "exp", "softplus" or "identity" (the predictor is then the rate itself, and must not be negative; where
            it is zero, the count is zero).
        exposure: E, the length of time, population or similar to which the rate refers: a number, (D,) or (T, D).

    Raises:
        ValueError: the link is unknown, or the exposure is not positive.

    Example:
        >>> import jax.numpy as jnp
        >>> PoissonObservation(lambda x, u, t: u).log_prob(jnp.zeros(1), jnp.zeros(1)).tolist()
        [-1.0]

    Source: Møller, Syversen and Waagepetersen (1998), Scandinavian Journal of Statistics 25.
    """

    def __init__(self, function: Callable[..., jax.Array], link: str = "exp", exposure: Any = 1.0):
        super().__init__(function, link, exposure)

    def log_prob(self, predictor: jax.Array, y: jax.Array) -> jax.Array:
        """Return y log(E g) - E g - log y!, (D,)."""
        log_mean, reference = self._log_mean(predictor), jnp.where(y > 0, y, 1.0)
        log_ratio = log_mean - jnp.log(reference)
        at_reference = jnp.where(y > 0, -stirling_error(reference) - 0.5 * (LOG_2PI + jnp.log(reference)), -1.0)
        value = at_reference + y * log_ratio - reference * jnp.expm1(log_ratio)
        return self._where_possible(predictor, y, value, -self.mean(predictor))

    def sample(self, key: jax.Array, predictor: jax.Array) -> jax.Array:
        """Draw counts (D,)."""
        return jax.random.poisson(key, self.mean(predictor), predictor.shape).astype(predictor.dtype)

    def cumulative(self, predictor: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return P(data < y) and P(data <= y), (D,) each."""
        return _poisson_cumulative(self.mean(predictor), y)


class NegativeBinomialObservation(_CountObservation):
    r"""Counts from a negative binomial distribution: Poisson counts with a gamma-distributed rate.

        E y = mu = E g(f),    Var y = mu + mu^2 / c,    f_k = h(x, u, t_k).

    Args:
        function: ``h(x, u, t) -> (D,)``, the predictor f.
        concentration: c > 0, with the Poisson distribution as the limit: a number, (D,) or (T, D); it may be sampled.
        link: g: "exp", "softplus" or "identity".
        exposure: E, as in `PoissonObservation`: a number, (D,) or (T, D).

    Raises:
        ValueError: the link is unknown, or the concentration or the exposure is not positive.

    Example:
        >>> import jax.numpy as jnp
        >>> NegativeBinomialObservation(lambda x, u, t: u, 1.0).log_prob(jnp.zeros(1), jnp.zeros(1)).round(4).tolist()
        [-0.6931]
    """

    concentration: jax.Array
    per_entry: ClassVar[tuple[str, ...]] = ("concentration", "exposure")

    def __init__(self, function: Callable[..., jax.Array], concentration: Any, link: str = "exp",
                 exposure: Any = 1.0):
        super().__init__(function, link, exposure)
        self.concentration = as_parameter("concentration", concentration)

    def log_prob(self, predictor: jax.Array, y: jax.Array) -> jax.Array:
        """Return the log probabilities (D,) of counts."""
        c, log_mean, reference = self.concentration, self._log_mean(predictor), jnp.where(y > 0, y, 1.0)
        log_ratio = log_mean - jnp.log(reference)
        at_count = (stirling_error(reference + c) - stirling_error(c) - stirling_error(reference)
                    - 0.5 * (LOG_2PI + jnp.log(reference) + jnp.log1p(reference / c)))
        at_reference = jnp.where(y > 0, at_count, -c * jnp.log1p(1.0 / c))
        # y log(mu / r) - (y + c) log((c + mu) / (c + r)), in the form whose terms are smaller.
        is_large_c = c > reference
        sign, factor = jnp.where(is_large_c, 1.0, -1.0), jnp.where(is_large_c, y, c)
        share = jnp.minimum(reference, c) / (reference + c)
        value = at_reference + sign * factor * log_ratio - (y + c) * _log_mixture(share, sign * log_ratio)
        return self._where_possible(predictor, y, value, -c * jnp.log1p(self.mean(predictor) / c))

    def sample(self, key: jax.Array, predictor: jax.Array) -> jax.Array:
        """Draw counts (D,)."""
        rate_key, count_key = jax.random.split(key)
        c = jnp.broadcast_to(self.concentration, predictor.shape)
        rate = self.mean(predictor) * jax.random.gamma(rate_key, c) / c
        return jax.random.poisson(count_key, rate, predictor.shape).astype(predictor.dtype)

    def cumulative(self, predictor: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return P(data < y) and P(data <= y), (D,) each."""
        mean, is_overdispersed = self.mean(predictor), self.concentration < _POISSON_LIMIT
        c = jnp.where(is_overdispersed, self.concentration, 1.0)
        probability = c / (c + mean)
        below = jnp.where(y > 0, betainc(c, jnp.where(y > 0, y, 1.0), probability), 0.0)
        poisson_below, poisson_up_to = _poisson_cumulative(mean, y)
        return (jnp.where(is_overdispersed, below, poisson_below),
                jnp.where(is_overdispersed, betainc(c, y + 1.0, probability), poisson_up_to))


def _log_mixture(share: jax.Array, log_ratio: jax.Array) -> jax.Array:
    """Return log(1 - share + share exp(log_ratio)) without cancellation or overflow."""
    # Beyond the square root of the largest number, the exponential is all of the mixture.
    clipped = jnp.minimum(log_ratio, 0.5 * np.log(jnp.finfo(log_ratio.dtype).max))
    return jnp.log1p(share * jnp.expm1(clipped)) + (log_ratio - clipped)


def _poisson_cumulative(rate: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return P(count < y) and P(count <= y) of Poisson counts with this rate."""
    below = jnp.where(y > 0, gammaincc(jnp.where(y > 0, y, 1.0), rate), 0.0)
    return below, gammaincc(y + 1.0, rate)
