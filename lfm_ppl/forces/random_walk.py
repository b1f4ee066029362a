"""Brownian motion as a force."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from lfm_ppl.forces.parameters import Mean, mean_parameter, non_negative_parameter, positive_parameter
from lfm_ppl.forces.sde import Force


class RandomWalk(Force):
    """Brownian motion, ``du = scale dbeta``, from ``u(t0) ~ N(mean, initial_sd^2)``.

    With times t >= s counted from the model's initial time t0,

        cov(u(t), u(s)) = initial_sd^2 + scale^2 s.

    Args:
        scale: square root of the rate at which the variance grows, in force units / time^(1/2); > 0.
        initial_sd: standard deviation of u at the initial time; >= 0.
        mean: a number, or a function of time.

    Raises:
        ValueError: the scale is not positive, or the initial standard deviation is negative.

    Example:
        >>> force = RandomWalk(scale=2.0, initial_sd=1.0)
        >>> float(force.covariance(3.0, 5.0))
        13.0
    """

    scale: jax.Array
    initial_sd: jax.Array
    mean: Any

    state_dim: ClassVar[int] = 1

    def __init__(self, scale: ArrayLike, initial_sd: ArrayLike = 0.0, mean: Mean = 0.0):
        self.scale = positive_parameter("scale", scale)
        self.initial_sd = non_negative_parameter("initial_sd", initial_sd)
        self.mean = mean_parameter(mean)

    def initial_covariance(self) -> jax.Array:
        """Return the covariance (1, 1) at the model's initial time."""
        return jnp.reshape(self.initial_sd**2, (1, 1))

    def feedback(self) -> jax.Array:
        """Return F (1, 1), zero."""
        return jnp.zeros((1, 1))

    def dispersion(self) -> jax.Array:
        """Return L (1, 1)."""
        return jnp.reshape(self.scale, (1, 1))

    def discretise(self, dt: ArrayLike) -> tuple[jax.Array, jax.Array]:
        """Return transition (1, 1), one, and process noise (1, 1) over a step of length dt >= 0."""
        return jnp.ones((1, 1)), jnp.reshape(self.scale**2 * dt, (1, 1))

    def covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return the covariance of u(t) and u(s), with times counted from the initial time."""
        return self.initial_sd**2 + self.scale**2 * jnp.minimum(t, s)

    def spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Raise NotImplementedError: Brownian motion is not stationary."""
        raise NotImplementedError(
            "RandomWalk is not stationary, so it has no spectral density; use `covariance(t, s)`, "
            "or a Matern force of order 0 with a long lengthscale."
        )
