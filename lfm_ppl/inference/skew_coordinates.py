r"""Coordinates in which a skewed posterior is nearly symmetric.

The logarithm of a positive parameter that the data hardly bound from below has a long left tail. There a step of NUTS
that suits the mode is too short, and a step that suits the tail diverges at the mode.

1. Each unconstrained coordinate is a function of another one,

       z_i = m_i + s_i (x_i + t_i (sqrt(1 + x_i^2) - 1)),    -1 < t_i < 1,

   with the mode m and the standard deviations s of the Laplace approximation. Its slope is s_i at the mode, and
   s_i (1 - t_i) and s_i (1 + t_i) in the left and the right tail.
2. The skewness t_i follows from the drops of the log density at two standard deviations below and above the mode. All
   other coordinates are at their conditional means there.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.laplace_start import Laplace

_DISTANCE = 2.0
"""Distance from the mode, in standard deviations, at which the skewness is measured."""

_LARGEST_SKEWNESS = 0.8
"""Slopes in the two tails differ by a factor of nine at most."""

_SMALLEST_DROP, _LARGEST_DROP = 1e-2, 1e3
"""Range of a drop of the log density; of a normal distribution it is 2."""


class SkewCoordinates(eqx.Module):
    """The coordinates x (d,), about zero and in units of standard deviations.

    Attributes:
        laplace: approximation of the posterior of z.
        skewness: t (d,).
    """

    laplace: Laplace
    skewness: Any

    @property
    def covariance(self) -> jax.Array:
        """The covariance (d, d) of x, a correlation matrix."""
        sd = self._sd
        return self.laplace.covariance / (sd[:, None] * sd)

    def to_z(self, x: jax.Array) -> jax.Array:
        """Return z (d,)."""
        return self.laplace.mode + self._sd * (x + self.skewness * (jnp.sqrt(1.0 + x**2) - 1.0))

    def to_x(self, z: jax.Array) -> jax.Array:
        """Return x (d,), the inverse of `to_z`."""
        t = self.skewness
        shifted = (z - self.laplace.mode) / self._sd + t
        return (shifted - t * jnp.sqrt(shifted**2 + 1.0 - t**2)) / (1.0 - t**2)

    def slope(self, x: jax.Array) -> jax.Array:
        """Return the derivative (d,) of each z by its x."""
        return self._sd * (1.0 + self.skewness * x / jnp.sqrt(1.0 + x**2))

    @property
    def _sd(self) -> jax.Array:
        return jnp.sqrt(jnp.diagonal(self.laplace.covariance))


def skew_coordinates(bound: BoundModel, laplace: Laplace) -> SkewCoordinates:
    """Return the coordinates for a posterior.

    Args:
        bound: the model and its data.
        laplace: the approximation of its posterior.
    """
    sd = np.sqrt(np.diag(laplace.covariance))
    ridges = _DISTANCE * laplace.covariance / sd[:, None]

    def log_density(z: np.ndarray) -> float:
        return float(bound.log_density_gradient(z)[0])  # the program that the starting points need, too

    peak = log_density(laplace.mode)
    drops = np.array([[peak - log_density(laplace.mode + side * ridge) for side in (-1.0, 1.0)] for ridge in ridges])
    drops = np.clip(np.where(np.isnan(drops), np.inf, drops), _SMALLEST_DROP, _LARGEST_DROP)
    ratio = np.sqrt(drops[:, 0] / drops[:, 1])
    skewness = _DISTANCE / (np.sqrt(1.0 + _DISTANCE**2) - 1.0) * (ratio - 1.0) / (ratio + 1.0)
    return SkewCoordinates(laplace, np.clip(skewness, -_LARGEST_SKEWNESS, _LARGEST_SKEWNESS))
