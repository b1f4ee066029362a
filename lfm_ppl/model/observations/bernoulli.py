"""Binary observations."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.observations.links import PROBABILITIES, link_name


class BernoulliObservation(ObservationFamily):
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

    link: str = eqx.field(static=True)
    per_entry: ClassVar[tuple[str, ...]] = ()

    def __init__(self, function: Callable[..., jax.Array], link: str = "logit"):
        self.function = function
        self.link = link_name(link, PROBABILITIES)

    def log_prob(self, predictor: jax.Array, y: jax.Array) -> jax.Array:
        """Return log p where y = 1, log(1 - p) where y = 0, (D,)."""
        log_probability, log_complement = PROBABILITIES[self.link]
        return jnp.where(y > 0.5, log_probability(predictor), log_complement(predictor))

    def sample(self, key: jax.Array, predictor: jax.Array) -> jax.Array:
        """Draw zeros and ones (D,)."""
        probability = jnp.exp(PROBABILITIES[self.link][0](predictor))
        return jax.random.bernoulli(key, probability, predictor.shape).astype(predictor.dtype)

    def cumulative(self, predictor: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return P(data < y) and P(data <= y), (D,) each."""
        _, log_complement = PROBABILITIES[self.link]
        complement = jnp.exp(log_complement(predictor))
        return jnp.where(y > 0.5, complement, 0.0), jnp.where(y > 0.5, 1.0, complement)

    def mean(self, predictor: jax.Array) -> jax.Array:
        """Return the expected values, the probabilities of yes, (D,)."""
        return jnp.exp(PROBABILITIES[self.link][0](predictor))

    def problem(self, y: np.ndarray) -> tuple[np.ndarray, str]:
        """Return which data are neither 0 nor 1, and the requirement."""
        return (y != 0) & (y != 1), "0 (no) or 1 (yes)"

    def overflows(self, predictor: np.ndarray) -> np.ndarray:
        """Return whether the predictor is not finite, or is not a probability under the identity link, (D,)."""
        return ~np.isfinite(predictor) | ((self.link == "identity") & ((predictor <= 0) | (predictor >= 1)))
