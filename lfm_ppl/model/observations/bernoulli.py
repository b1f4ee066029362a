"""Yes or no."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.observations.links import PROBABILITIES, checked


class BernoulliObservation(ObservationFamily):
    r"""Yes (1) or no (0).

        P(y_kd = 1) = g(f_kd),    f_k = h(x, u, t_k).

    Args:
        function: ``h(x, u, t) -> (D,)``, the predictor f.
        link: g: "logit", "probit" or "identity" (the predictor is then the probability itself).

    Raises:
        ValueError: an unknown link.

    Example:
        >>> import jax.numpy as jnp
        >>> BernoulliObservation(lambda x, u, t: u).log_prob(jnp.zeros(1), jnp.ones(1)).round(4).tolist()
        [-0.6931]
    """

    link: str = eqx.field(static=True)
    per_entry: ClassVar[tuple[str, ...]] = ()

    def __init__(self, function: Callable[..., jax.Array], link: str = "logit"):
        self.function = function
        self.link = checked(link, PROBABILITIES)

    def log_prob(self, predictor: jax.Array, y: jax.Array) -> jax.Array:
        """Return log p where y = 1, log(1 - p) where y = 0, (D,)."""
        link = PROBABILITIES[self.link]
        return jnp.where(y > 0.5, link.log_probability(predictor), link.log_complement(predictor))

    def sample(self, key: jax.Array, predictor: jax.Array) -> jax.Array:
        """Draw zeros and ones (D,)."""
        probability = jnp.exp(PROBABILITIES[self.link].log_probability(predictor))
        return jax.random.bernoulli(key, probability, predictor.shape).astype(predictor.dtype)

    def cumulative(self, predictor: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return P(data < y) and P(data <= y), (D,) each."""
        no = jnp.exp(PROBABILITIES[self.link].log_complement(predictor))
        return jnp.where(y > 0.5, no, 0.0), jnp.where(y > 0.5, 1.0, no)

    def mean(self, predictor: jax.Array) -> jax.Array:
        """Return the expected values, the probabilities of yes, (D,)."""
        return jnp.exp(PROBABILITIES[self.link].log_probability(predictor))

    def problem(self, y: np.ndarray) -> tuple[np.ndarray, str]:
        """Data are zeros and ones."""
        return (y != 0) & (y != 1), "0 (no) or 1 (yes)"

    def overflows(self, predictor: np.ndarray) -> np.ndarray:
        """Say where the predictor is no number, or no probability."""
        return ~np.isfinite(predictor) | ((self.link == "identity") & ((predictor <= 0) | (predictor >= 1)))
