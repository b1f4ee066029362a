"""Integrated Brownian motion: a force whose velocity is a Wiener process."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lfm_ppl.forces.parameters import Mean, mean_parameter, non_negative_parameter, positive_parameter
from lfm_ppl.forces.sde import Force


class WienerVelocity(Force):
    """Integrated Brownian motion, ``d(du/dt) = scale dbeta``: a smooth force without a lengthscale.

    The state is ``(u, u')``. With independent ``u(t0) ~ N(0, initial_sd^2)`` and
    ``u'(t0) ~ N(0, initial_velocity_sd^2)``, and with times t >= s counted from the model's
    initial time t0,

        cov(u(t), u(s)) = initial_sd^2 + initial_velocity_sd^2 t s
                          + scale^2 (s^3 / 3 + s^2 (t - s) / 2).

    It is not stationary: its variance grows with time, and it has no spectral density. Without
    initial variance its posterior mean is a cubic spline.

    Args:
        scale: square root of the rate at which the variance of the velocity grows, in force units / time^(3/2); > 0.
        initial_sd: standard deviation of u at the initial time; >= 0.
        initial_velocity_sd: standard deviation of u' at the initial time, in force units / time; >= 0.
        mean: a number, or a function of time.

    Raises:
        ValueError: the scale is not positive, or an initial standard deviation is negative.

    Example:
        >>> force = WienerVelocity(scale=1.0, initial_sd=2.0)
        >>> round(float(force.covariance(3.0, 3.0)), 6)
        13.0
    """

    scale: jax.Array
    initial_sd: jax.Array
    initial_velocity_sd: jax.Array
    mean: Any

    state_dim: ClassVar[int] = 2

    def __init__(
        self,
        scale: ArrayLike,
        initial_sd: ArrayLike = 0.0,
        initial_velocity_sd: ArrayLike = 0.0,
        mean: Mean = 0.0,
    ):
        self.scale = positive_parameter("scale", scale)
        self.initial_sd = non_negative_parameter("initial_sd", initial_sd)
        self.initial_velocity_sd = non_negative_parameter("initial_velocity_sd", initial_velocity_sd)
        self.mean = mean_parameter(mean)

    def initial_covariance(self) -> jax.Array:
        """Return the covariance (2, 2) at the model's initial time."""
        return jnp.diag(jnp.stack([self.initial_sd, self.initial_velocity_sd]) ** 2)

    def feedback(self) -> jax.Array:
        """Return F (2, 2), nilpotent."""
        return jnp.array([[0.0, 1.0], [0.0, 0.0]])

    def dispersion(self) -> jax.Array:
        """Return L (2, 1)."""
        return self.scale * np.array([[0.0], [1.0]])

    def discretise(self, dt: ArrayLike) -> tuple[jax.Array, jax.Array]:
        """Return transition (2, 2) and process noise (2, 2) over a step of length dt >= 0."""
        dt = jnp.asarray(dt, self.scale.dtype)
        transition = jnp.eye(2) + dt * jnp.eye(2, k=1)
        noise = jnp.stack([dt**3 / 3.0, dt**2 / 2.0, dt**2 / 2.0, dt]).reshape(2, 2)
        return transition, self.scale**2 * noise

    def covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return the covariance of u(t) and u(s), with times counted from the initial time."""
        late, early = jnp.maximum(t, s), jnp.minimum(t, s)
        integrated_noise = early**3 / 3.0 + early**2 * (late - early) / 2.0
        initial = self.initial_sd**2 + self.initial_velocity_sd**2 * late * early
        return initial + self.scale**2 * integrated_noise

    def spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Raise NotImplementedError: integrated Brownian motion is not stationary."""
        raise NotImplementedError(
            "WienerVelocity is not stationary, so it has no spectral density; use `covariance(t, "
            "s)`, or a Matern force with a long lengthscale."
        )
