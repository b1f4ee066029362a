r"""Penalised-complexity priors for scale and lengthscale of a Matern force.

1. The simplest force is none: scale zero, lengthscale infinite. A penalised-complexity prior has a constant rate of
   decay in the distance from it, which is the root of twice the Kullback-Leibler divergence.
2. For a Matern process in time, this distance grows with ``lengthscale^(-1/2)`` at a fixed ``scale / lengthscale^nu``,
   which sets the size of its finest changes, and in proportion to the scale at a fixed lengthscale. Both have
   exponential priors, whatever the smoothness nu.
3. The two rates follow from the probabilities of a short lengthscale and of a large scale.

Source: Fuglstad, Simpson, Lindgren and Rue (2019), Constructing priors that penalize the complexity of Gaussian random
fields, Journal of the American Statistical Association 114: the joint prior of range and standard deviation, in one
dimension. Their range is twice the lengthscale.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpyro.distributions as dist
from jax.typing import ArrayLike
from numpyro.distributions import constraints
from numpyro.distributions.util import promote_shapes, validate_sample

from lfm_ppl.utils import checks

__all__ = ["PenalisedLengthscale", "penalised_complexity"]


class PenalisedLengthscale(dist.Distribution):
    r"""The penalised-complexity prior of a lengthscale, with ``P(lengthscale < shortest_lengthscale) = probability``.

        p(l) = r / 2 l^(-3/2) exp(-r l^(-1/2)),    P(lengthscale < l) = exp(-r l^(-1/2)),
        r = -log(probability) shortest_lengthscale^(1/2).

    Its upper tail is long on purpose, so that it has no mean: a slow force is a simple one.

    Args:
        shortest_lengthscale: a lengthscale that would surprise from below, in units of time; > 0.
        probability: of a lengthscale below it, between 0 and 1.

    Raises:
        ValueError: ``shortest_lengthscale`` is not positive, or the probability is not between 0 and 1.

    Example:
        >>> import lfm_ppl as lfm
        >>> prior = lfm.priors.PenalisedLengthscale(shortest_lengthscale=1.0)
        >>> round(float(prior.cdf(1.0)), 4), round(float(prior.icdf(0.5)), 2)
        (0.05, 18.68)

    Source: Fuglstad, Simpson, Lindgren and Rue (2019).
    """

    arg_constraints = {  # noqa: RUF012
        "shortest_lengthscale": constraints.positive, "probability": constraints.unit_interval}
    support = constraints.positive
    reparametrized_params = ["shortest_lengthscale", "probability"]  # noqa: RUF012

    def __init__(self, shortest_lengthscale: ArrayLike, probability: ArrayLike = 0.05, *,
                 validate_args: bool | None = None):
        checks.positive("shortest_lengthscale", shortest_lengthscale)
        _check_probability(probability)
        self.shortest_lengthscale, self.probability = promote_shapes(
            jnp.asarray(shortest_lengthscale, float), jnp.asarray(probability, float))
        batch_shape = jnp.broadcast_shapes(jnp.shape(shortest_lengthscale), jnp.shape(probability))
        super().__init__(batch_shape=batch_shape, validate_args=validate_args)

    @property
    def rate(self) -> jax.Array:
        """Rate r of the exponential distribution of ``lengthscale^(-1/2)``."""
        return -jnp.log(self.probability) * jnp.sqrt(self.shortest_lengthscale)

    def sample(self, key: jax.Array, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Draw lengthscales of shape ``sample_shape + batch_shape``."""
        exponential = jax.random.exponential(key, sample_shape + self.batch_shape)
        return (self.rate / exponential) ** 2

    @validate_sample
    def log_prob(self, value: ArrayLike) -> jax.Array:
        """Return log p of lengthscales."""
        value = jnp.asarray(value, float)
        return jnp.log(0.5 * self.rate) - 1.5 * jnp.log(value) - self.rate / jnp.sqrt(value)

    def cdf(self, value: ArrayLike) -> jax.Array:
        """Return the probability of a shorter lengthscale."""
        return jnp.exp(-self.rate / jnp.sqrt(value))

    def icdf(self, q: ArrayLike) -> jax.Array:
        """Return the lengthscale with the probability ``q`` of a shorter one."""
        return (self.rate / jnp.log(q)) ** 2

    @property
    def mean(self) -> jax.Array:
        """Infinity: the distribution has no mean."""
        return jnp.full(self.batch_shape, jnp.inf)

    @property
    def variance(self) -> jax.Array:
        """Infinity: the distribution has no variance."""
        return jnp.full(self.batch_shape, jnp.inf)


def penalised_complexity(largest_scale: ArrayLike, shortest_lengthscale: ArrayLike,
                         probability: ArrayLike = 0.05) -> tuple[dist.Distribution, dist.Distribution]:
    """Return priors of scale and lengthscale of a Matern force that prefer a small and slow force.

    ``P(scale > largest_scale) = probability`` and ``P(lengthscale < shortest_lengthscale) = probability``. The scale
    has an exponential distribution; both are independent.

    Args:
        largest_scale: a standard deviation of the force that would surprise, in its units; > 0.
        shortest_lengthscale: a lengthscale that would surprise from below, in units of time; > 0.
        probability: of each of the two surprises, between 0 and 1.

    Returns:
        The prior of the scale, and that of the lengthscale (`PenalisedLengthscale`), in the order of `lfm_ppl.Matern`.

    Raises:
        ValueError: a number is not positive, or the probability is not between 0 and 1.

    Example:
        >>> import lfm_ppl as lfm
        >>> scale, lengthscale = lfm.priors.penalised_complexity(1.5, 1.0)
        >>> round(1.0 - float(scale.cdf(1.5)), 4), round(float(lengthscale.cdf(1.0)), 4)
        (0.05, 0.05)

    Source: Fuglstad, Simpson, Lindgren and Rue (2019).
    """
    checks.positive("largest_scale", largest_scale)
    checks.positive("shortest_lengthscale", shortest_lengthscale)
    lengthscale = PenalisedLengthscale(shortest_lengthscale, probability)
    return dist.Exponential(-jnp.log(probability) / jnp.asarray(largest_scale, float)), lengthscale


def _check_probability(probability: Any) -> None:
    value = checks.concrete(probability)
    if value is not None and not ((value > 0) & (value < 1)).all():
        raise ValueError(f"probability must lie between 0 and 1, got {probability!r}.")
