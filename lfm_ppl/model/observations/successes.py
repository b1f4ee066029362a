"""Binary data, and numbers of successes among known numbers of trials."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import betainc

from lfm_ppl.model.observations.family import ObservationFamily, as_parameter, is_not_count
from lfm_ppl.model.observations.links import PROBABILITIES, link_name
from lfm_ppl.model.observations.saddle_point import LOG_2PI, stirling_error


class _TrialObservation(ObservationFamily):
    """Trials that succeed with the probability g(f): link g, predictor f."""

    link: str = eqx.field(static=True)

    def __init__(self, function: Callable[..., jax.Array], link: str = "logit"):
        self.function = function
        self.link = link_name(link, PROBABILITIES)

    def mean(self, predictor: jax.Array) -> jax.Array:
        """Return the probability of a success, (D,)."""
        return jnp.exp(PROBABILITIES[self.link][0](predictor))

    def overflows(self, predictor: np.ndarray) -> np.ndarray:
        """Return whether the predictor is not finite, or is not a probability under the identity link, (D,)."""
        return ~np.isfinite(predictor) | ((self.link == "identity") & ((predictor <= 0) | (predictor >= 1)))


class BernoulliObservation(_TrialObservation):
    r"""Binary data: yes (1) or no (0).

        P(y_kd = 1) = g(f_kd),    f_k = h(x, u, t_k).

    Args:
        function: ``h(x, u, t) -> (D,)``, the predictor f.
        link: g: "logit", "probit" or "identity" (the predictor is then the probability itself).

    Raises:
        ValueError: the link is unknown.

    Example:
        >>> import jax.numpy as jnp
        >>> BernoulliObservation(lambda x, u, t: u).log_prob(jnp.zeros(1), jnp.ones(1)).round(4).tolist()
        [-0.6931]
    """

    def log_prob(self, predictor: jax.Array, y: jax.Array) -> jax.Array:
        """Return log p where y = 1, log(1 - p) where y = 0, (D,)."""
        log_probability, log_complement = PROBABILITIES[self.link]
        return jnp.where(y > 0.5, log_probability(predictor), log_complement(predictor))

    def sample(self, key: jax.Array, predictor: jax.Array) -> jax.Array:
        """Draw zeros and ones (D,)."""
        return jax.random.bernoulli(key, self.mean(predictor), predictor.shape).astype(predictor.dtype)

    def cumulative(self, predictor: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return P(data < y) and P(data <= y), (D,) each."""
        _, log_complement = PROBABILITIES[self.link]
        complement = jnp.exp(log_complement(predictor))
        return jnp.where(y > 0.5, complement, 0.0), jnp.where(y > 0.5, 1.0, complement)

    def problem(self, y: np.ndarray) -> tuple[np.ndarray, str]:
        """Return which data are neither 0 nor 1, and the requirement."""
        return (y != 0) & (y != 1), "0 (no) or 1 (yes)"


class BinomialObservation(_TrialObservation):
    r"""Successes among a known number of trials.

        y_kd ~ Binomial(n_kd, g(f_kd)),    f_k = h(x, u, t_k).

    Args:
        function: ``h(x, u, t) -> (D,)``, the predictor f.
        total_count: number of trials n: a number, (D,) or (T, D).
        link: g: "logit", "probit" or "identity" (the predictor is then the probability itself).

    Raises:
        ValueError: the link is unknown, or the number of trials is not positive.

    Example:
        >>> import jax.numpy as jnp
        >>> BinomialObservation(lambda x, u, t: u, 2).log_prob(jnp.zeros(1), jnp.ones(1)).round(4).tolist()
        [-0.6931]
    """

    total_count: jax.Array
    per_entry: ClassVar[tuple[str, ...]] = ("total_count",)

    def __init__(self, function: Callable[..., jax.Array], total_count: Any, link: str = "logit"):
        super().__init__(function, link)
        self.total_count = as_parameter("total_count", total_count)

    def log_prob(self, predictor: jax.Array, y: jax.Array) -> jax.Array:
        """Return log C(n, y) + y log p + (n - y) log(1 - p), (D,)."""
        (log_probability, log_complement), n = PROBABILITIES[self.link], self.total_count
        failure_count, is_mixed = n - y, (y > 0) & (y < n)
        trials, successes, failures = (jnp.where(is_mixed, number, default) for number, default in (
            (n, 2.0), (y, 1.0), (failure_count, 1.0)))
        coefficient = (stirling_error(trials) - stirling_error(successes) - stirling_error(failures)
                       - 0.5 * (LOG_2PI + jnp.log(successes) + jnp.log(failures / trials)))
        # Shares of y / n and 1 - y / n are the reference, where the two deviances are zero.
        terms = [_log_power(log_p - jnp.log(jnp.where(is_mixed, share, 1.0)), number, is_mixed)
                 for log_p, share, number in ((log_probability(predictor), successes / trials, y),
                                              (log_complement(predictor), failures / trials, failure_count))]
        return jnp.where(is_mixed, coefficient, 0.0) + terms[0] + terms[1]

    def sample(self, key: jax.Array, predictor: jax.Array) -> jax.Array:
        """Draw counts (D,)."""
        draws = jax.random.binomial(key, self.total_count, super().mean(predictor), predictor.shape)
        return draws.astype(predictor.dtype)

    def cumulative(self, predictor: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return P(data < y) and P(data <= y), (D,) each."""
        _, log_complement = PROBABILITIES[self.link]
        n, complement = self.total_count, jnp.exp(log_complement(predictor))
        below = jnp.where(y > 0, betainc(n - y + 1.0, jnp.where(y > 0, y, 1.0), complement), 0.0)
        return below, jnp.where(y < n, betainc(jnp.where(y < n, n - y, 1.0), y + 1.0, complement), 1.0)

    def mean(self, predictor: jax.Array) -> jax.Array:
        """Return the expected counts (D,)."""
        return self.total_count * super().mean(predictor)

    def problem(self, y: np.ndarray) -> tuple[np.ndarray, str]:
        """Return which data are not counts up to the number of trials, and the requirement."""
        return is_not_count(y) | (y > np.asarray(self.total_count)), "counts: whole numbers from zero to total_count"


def _log_power(log_ratio: jax.Array, count: jax.Array, is_mixed: jax.Array) -> jax.Array:
    """Return count * log_ratio, zero for a count of zero also where the ratio is infinite.

    Among successes and failures the sum of count * (ratio - 1) over both is zero; it cancels their rounding errors.
    """
    correction = jnp.where(is_mixed, jnp.expm1(log_ratio), 0.0)
    return jnp.where(count == 0, 0.0, count * (log_ratio - correction))
