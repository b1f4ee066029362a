"""A resonator: an oscillation of one frequency with drifting amplitude and phase."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lfm_ppl.forces.discretise import gauss_legendre
from lfm_ppl.forces.parameters import Mean, mean_parameter, non_negative_parameter, positive_parameter
from lfm_ppl.forces.sde import Force

_NODES, _WEIGHTS = gauss_legendre(16)
_SWITCH = 2.0
"""Value of (w + d) dt below which the process noise is a quadrature; at it, both forms are exact to rounding."""


class Resonator(Force):
    r"""A damped oscillation driven by white noise.

        du/dt = w s - d u,    ds = (-w u - d s) dt + noise dbeta,    w = 2 pi / period.

    Without damping (d = 0) this is ``u'' = -w^2 u + white noise`` with a white noise of spectral density
    ``(w noise)^2``; with damping, ``u'' = -2 d u' - (w^2 + d^2) u + ...``, which still oscillates at w. The state is
    ``(u, s)``, at the initial time N(0, scale^2 I). With times t >= s counted from the initial time,

        cov(u(t), u(s)) = scale^2 exp(-d (t + s)) cos w (t - s)
                          + noise^2 exp(-d (t - s)) int_0^s exp(-2 d x) sin(w x) sin(w (x + t - s)) dx.

    A periodic force with harmonics is a sum of resonators of periods D, D/2, D/3, ...

    Args:
        period: period of the oscillation, in units of time; > 0.
        scale: standard deviation of the force at the initial time; >= 0.
        noise: dispersion of the white noise on s, in force units / time^(1/2); >= 0. Zero: exactly periodic.
        damping: d, per unit of time; >= 0.
        mean: a number, or a function of time.

    Raises:
        ValueError: the period is not positive, or another parameter is negative.

    Example:
        >>> force = Resonator(period=24.0, scale=2.0)
        >>> round(float(force.covariance(24.0, 0.0)), 12), round(float(force.covariance(12.0, 0.0)), 12)
        (4.0, -4.0)

    Source: Hartikainen, Seppanen and Sarkka (2012), section 6; S. Sarkka and others, Dynamic retrospective filtering
    of physiological noise in BOLD fMRI: DRIFTER, NeuroImage 60 (2012).
    """

    period: jax.Array
    scale: jax.Array
    noise: jax.Array
    damping: jax.Array
    mean: Any

    state_dim: ClassVar[int] = 2

    def __init__(self, period: ArrayLike, scale: ArrayLike, noise: ArrayLike = 0.0, damping: ArrayLike = 0.0,
                 mean: Mean = 0.0):
        self.period = positive_parameter("period", period)
        self.scale = non_negative_parameter("scale", scale)
        self.noise = non_negative_parameter("noise", noise)
        self.damping = non_negative_parameter("damping", damping)
        self.mean = mean_parameter(mean)

    @property
    def frequency(self) -> jax.Array:
        """The frequency w, in radians per unit of time."""
        return 2 * np.pi / self.period

    def initial_covariance(self) -> jax.Array:
        """Return the covariance (2, 2) at the model's initial time."""
        return self.scale**2 * jnp.eye(2)

    def feedback(self) -> jax.Array:
        """Return F (2, 2)."""
        return self.frequency * np.array([[0.0, 1.0], [-1.0, 0.0]]) - self.damping * jnp.eye(2)

    def dispersion(self) -> jax.Array:
        """Return L (2, 1)."""
        return self.noise * np.array([[0.0], [1.0]])

    def discretise(self, dt: ArrayLike) -> tuple[jax.Array, jax.Array]:
        """Return transition (2, 2) and process noise (2, 2) over a step of length dt >= 0."""
        dt = jnp.asarray(dt, self.scale.dtype)
        angle, decay = self.frequency * dt, jnp.exp(-self.damping * dt)
        c, s = jnp.cos(angle), jnp.sin(angle)
        transition = decay * jnp.stack([jnp.stack([c, s]), jnp.stack([-s, c])])
        return transition, self.noise**2 * self._unit_noise(dt)

    def _unit_noise(self, dt: jax.Array) -> jax.Array:
        """Return the process noise for noise = 1: int_0^dt exp(-2 d x) v v' dx (2, 2) with v = (sin w x, cos w x)."""
        w, d = self.frequency, self.damping
        # The closed form cancels on short steps; the quadrature is exact to rounding on short steps only.
        longest = _SWITCH / (w + d)
        x = jnp.minimum(dt, longest) * _NODES
        columns = jnp.exp(-d * x) * jnp.stack([jnp.sin(w * x), jnp.cos(w * x)])
        short = jnp.minimum(dt, longest) * (columns[:, None] * columns[None] * _WEIGHTS).sum(-1)
        # int_0^dt exp(-2 (d - i w) x) dx = real + i imaginary: the integrals of exp(-2 d x) cos 2 w x and sin 2 w x.
        decay = jnp.exp(-2 * d * dt)
        a, b = 1.0 - decay * jnp.cos(2 * w * dt), decay * jnp.sin(2 * w * dt)
        real, imaginary = (jnp.stack([d * a + w * b, w * a - d * b]) / (2 * (w**2 + d**2)))
        total = dt * _mean_decay(2 * d * dt)
        long = 0.5 * jnp.stack([jnp.stack([total - real, imaginary]), jnp.stack([imaginary, total + real])])
        return jnp.where(dt < longest, short, long)

    def covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return the covariance of u(t) and u(s), with times counted from the initial time."""
        late, early = jnp.maximum(t, s), jnp.minimum(t, s)
        lag = late - early
        noise = jnp.vectorize(self._unit_noise, signature="()->(i,j)")(jnp.asarray(early, float))
        angle = self.frequency * lag
        propagated_noise = jnp.cos(angle) * noise[..., 0, 0] + jnp.sin(angle) * noise[..., 0, 1]
        initial = self.scale**2 * jnp.exp(-self.damping * (late + early)) * jnp.cos(angle)
        return initial + self.noise**2 * jnp.exp(-self.damping * lag) * propagated_noise

    def spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Raise NotImplementedError: the process is not stationary."""
        raise NotImplementedError("a Resonator is not stationary, so it has no spectral density; use `covariance`.")


def _mean_decay(x: jax.Array) -> jax.Array:
    """Return (1 - exp(-x)) / x, with its limit at zero."""
    small = x < 1e-8
    return jnp.where(small, 1.0 - 0.5 * x, -jnp.expm1(-x) / jnp.where(small, 1.0, x))
