"""Any NumPyro distribution as an observation family."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist

from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.utils import checks


class DistributionObservation(ObservationFamily):
    r"""Observations from any NumPyro distribution, entry by entry.

        y_kd ~ distribution(f_k)_d,    f_k = h(x, u, t_k).

    Args:
        function: ``h(x, u, t) -> (D,)``, the predictor f.
        distribution: function from a predictor (D,) to a NumPyro distribution of batch shape (D,), whose entry d
            depends on entry d of the predictor alone. It may close over sampled parameters.

    Raises:
        TypeError: ``distribution`` is not callable, or does not return a NumPyro distribution.
        ValueError: the distribution is not one of D independent numbers.

    Example:
        >>> import jax.numpy as jnp, numpyro.distributions as dist
        >>> family = DistributionObservation(lambda x, u, t: u, lambda f: dist.ZeroInflatedPoisson(0.5, jnp.exp(f)))
        >>> family.log_prob(jnp.zeros(1), jnp.zeros(1)).round(4).tolist()
        [-0.3799]
    """

    distribution: Callable[[jax.Array], dist.Distribution]

    def __init__(self, function: Callable[..., jax.Array],
                 distribution: Callable[[jax.Array], dist.Distribution]):
        if not callable(distribution):
            raise TypeError("distribution must map a predictor to a NumPyro distribution, such as "
                            f"lambda f: dist.Poisson(jnp.exp(f)); got {type(distribution).__name__}.")
        self.function, self.distribution = function, distribution

    def check_shapes(self, outputs: int) -> None:
        """Raise unless ``distribution`` returns a distribution of independent numbers, one for each output."""
        results: list[Any] = []
        # The trace leaks the distribution.
        jax.eval_shape(lambda f: results.append(self.distribution(f)), jnp.zeros(outputs))
        (distribution,) = results
        if not isinstance(distribution, dist.Distribution):
            raise TypeError("distribution must return a NumPyro distribution, such as dist.Poisson(jnp.exp(f)); it "
                            f"returned {type(distribution).__name__}.")
        if distribution.event_shape or distribution.batch_shape != (outputs,):
            raise ValueError(f"distribution must return a distribution of {outputs} independent numbers, batch shape "
                             f"({outputs},) and event shape (); it has {distribution.batch_shape} and "
                             f"{distribution.event_shape}. Compute its parameters from the predictor entry by entry.")

    def log_prob(self, predictor: jax.Array, y: jax.Array) -> jax.Array:
        """Return the log densities (D,)."""
        return self.distribution(predictor).log_prob(y)

    def sample(self, key: jax.Array, predictor: jax.Array) -> jax.Array:
        """Draw entries (D,)."""
        return self.distribution(predictor).sample(key).astype(predictor.dtype)

    def cumulative(self, predictor: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return P(data < y) and P(data <= y), (D,) each; NaN where NumPyro does not implement them."""
        distribution = self.distribution(predictor)
        try:
            up_to = distribution.cdf(y)
            return (distribution.cdf(y - 1.0) if distribution.is_discrete else up_to), up_to
        except NotImplementedError:
            return super().cumulative(predictor, y)

    def possible(self, predictor: jax.Array) -> jax.Array:
        """Return entries (D,) inside the distribution's support."""
        value = self.distribution(jax.lax.stop_gradient(predictor)).support.feasible_like(predictor)
        return jax.lax.stop_gradient(jnp.asarray(value, predictor.dtype))

    def mean(self, predictor: jax.Array) -> jax.Array:
        """Return the distribution's mean (D,)."""
        return jnp.asarray(self.distribution(predictor).mean, float)

    def check_data(self, y: Any, first_column: int = 0, names: Sequence[str] = ()) -> None:
        """Raise ValueError if an entry lies outside of the distribution's support."""
        data = checks.concrete(y)
        if data is None:
            return
        support = self.distribution(jnp.zeros(data.shape[1])).support
        is_possible = checks.concrete(support(jnp.asarray(data)))
        if is_possible is None:  # compiled code: every result is traced
            return
        self._refuse(~np.broadcast_to(is_possible, data.shape), data, f"the distribution needs {support}", first_column,
                     names)
