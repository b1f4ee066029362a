"""An unknown constant level."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from lfm_ppl.forces.parameters import Mean, mean_parameter, positive_parameter
from lfm_ppl.forces.sde import Force


class Constant(Force):
    """A force that is constant in time at an unknown level, ``u ~ N(mean, scale^2)``.

    With a mean that is a function of time, the level is an unknown offset from it.

    Args:
        scale: prior standard deviation of the level, in the units of the force; > 0.
        mean: a number, or a function of time.

    Raises:
        ValueError: the scale is not positive.

    Example:
        >>> force = Constant(scale=2.0, mean=1.0)
        >>> float(force.covariance(100.0)), float(force.mean_at(0.0))
        (4.0, 1.0)
    """

    scale: jax.Array
    mean: Any

    state_dim: ClassVar[int] = 1

    def __init__(self, scale: ArrayLike, mean: Mean = 0.0):
        self.scale = positive_parameter("scale", scale)
        self.mean = mean_parameter(mean)

    @property
    def stationary(self) -> bool:
        """True: the variance is the same at all times."""
        return True

    def initial_covariance(self) -> jax.Array:
        """Return the prior variance (1, 1)."""
        return jnp.reshape(self.scale**2, (1, 1))

    def feedback(self) -> jax.Array:
        """Return F (1, 1), zero."""
        return jnp.zeros((1, 1))

    def dispersion(self) -> jax.Array:
        """Return L (1, 0)."""
        return jnp.zeros((1, 0))

    def discretise(self, dt: ArrayLike) -> tuple[jax.Array, jax.Array]:
        """Return transition (1, 1), one, and process noise (1, 1), zero."""
        return jnp.ones((1, 1)), jnp.zeros((1, 1))

    def covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return scale^2 for every pair of times."""
        return self.scale**2 * jnp.ones(jnp.broadcast_shapes(jnp.shape(t), jnp.shape(s)))

    def spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Raise NotImplementedError: the spectrum is a line at frequency zero."""
        raise NotImplementedError(
            "a Constant force has all its power at frequency zero, so its spectral density is "
            "not a function; use `covariance`."
        )

    def sde_spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Raise NotImplementedError like `spectral_density`."""
        return self.spectral_density(omega)
