r"""A transform of the parameters after which a skewed posterior is nearly symmetric.

The logarithm of a positive parameter that the data hardly bound from below has a long left tail. There a step of NUTS
that suits the mode is too short, and a step that suits the tail diverges at the mode.

1. Each unconstrained coordinate z_i is a function of another one,

       z_i = m_i + s_i (x_i + t_i g(x_i)),    g(x) = sqrt(1 + x^2) - 1,    -1 < t_i < 1,

   with the mode m and the standard deviations s of the Laplace approximation. Its derivative is s_i at the mode, and
   s_i (1 - t_i) and s_i (1 + t_i) in the left and the right tail.
2. The asymmetry t_i follows from the drops d_- and d_+ of the log density at two standard deviations below and above
   the mode, where all other coordinates have their conditional means. A standard normal x has these drops at
   x = -a_- and a_+ with a = sqrt(2 d), if -a_- + t_i g(a_-) = -(a_+ + t_i g(a_+)), that is

       t_i = (a_- - a_+) / (g(a_-) + g(a_+)).

3. A transform of each coordinate alone bends a narrow ridge of several. It is taken where, over draws of the Laplace
   approximation of x, the log density at z(x) is nearer to the normal's with the transform than without it. The
   Jacobian, which is left out, mostly shifts x.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.laplace_start import Laplace

_DISTANCE = 2.0
"""Distance from the mode, in standard deviations, at which the asymmetry is measured."""

_LARGEST_ASYMMETRY = 0.8
"""Derivatives in the two tails differ by a factor of nine at most."""

_DRAWS, _LARGEST_DIFFERENCE = 20, 50.0
"""Draws of the comparison, and the largest difference of log densities that counts in it."""


class SymmetrisingTransform(eqx.Module):
    """The map from x (d,), about zero and in units of standard deviations, to unconstrained parameters z (d,).

    Attributes:
        laplace: approximation of the posterior of z.
        asymmetry: t (d,).
    """

    laplace: Laplace
    asymmetry: Any

    @property
    def correlation(self) -> jax.Array:
        """The covariance (d, d) of x, to first order in the asymmetry."""
        sd = self._sd
        return jnp.asarray(self.laplace.covariance) / (sd[:, None] * sd)

    def to_z(self, x: jax.Array) -> jax.Array:
        """Return z (d,)."""
        return self.laplace.mode + self._sd * (x + self.asymmetry * (jnp.hypot(1.0, x) - 1.0))

    def to_x(self, z: jax.Array) -> jax.Array:
        """Return x (d,), the inverse of `to_z`."""
        t = self.asymmetry
        shifted = (z - self.laplace.mode) / self._sd + t
        return (shifted - t * jnp.hypot(shifted, jnp.sqrt(1.0 - t**2))) / (1.0 - t**2)

    def derivative(self, x: jax.Array) -> jax.Array:
        """Return the derivative (d,) of each z by its x."""
        return self._sd * (1.0 + self.asymmetry * x / jnp.hypot(1.0, x))

    def log_jacobian(self, x: jax.Array) -> jax.Array:
        """Return the log determinant of the derivative of z by x."""
        return jnp.log(self.derivative(x)).sum()

    @property
    def _sd(self) -> jax.Array:
        return jnp.sqrt(jnp.diagonal(self.laplace.covariance))


def symmetrising_transform(key: jax.Array, bound: BoundModel, laplace: Laplace) -> SymmetrisingTransform:
    """Return the transform for a posterior.

    Args:
        key: a JAX random key, for the draws of the comparison.
        bound: the model and its data.
        laplace: the approximation of its posterior.
    """
    def log_density(z: Any) -> float:
        return float(bound.log_density_gradient(z)[0])  # the program that the starting points need, too

    plain = SymmetrisingTransform(laplace, np.zeros(bound.size))
    transform = SymmetrisingTransform(laplace, _asymmetry(log_density, plain))
    standard = np.asarray(jax.random.normal(key, (_DRAWS, bound.size)))
    draws, normal = standard @ np.linalg.cholesky(plain.correlation).T, -0.5 * (standard**2).sum(axis=1)

    def spread(transform: SymmetrisingTransform) -> float:
        values = np.array([log_density(transform.to_z(x)) for x in draws])
        differences = np.nan_to_num(values - normal, nan=-np.inf)
        return float(np.maximum(differences, differences.max() - _LARGEST_DIFFERENCE).std())

    return transform if spread(transform) < spread(plain) else plain


def _asymmetry(log_density: Callable[[Any], float], plain: SymmetrisingTransform) -> np.ndarray:
    """Return t (d,); zero where a density beside the mode is zero, which says nothing about a tail.

    Args:
        log_density: of z.
        plain: the transform without asymmetry.
    """
    peak = log_density(plain.laplace.mode)
    # With one coordinate at a distance, all others have their correlations with it as conditional means.
    drops = np.array([[peak - log_density(plain.to_z(distance * row)) for distance in (-_DISTANCE, _DISTANCE)]
                      for row in plain.correlation])
    is_known = np.isfinite(drops).all(axis=1) & (drops > 0.0).all(axis=1)
    lower, upper = np.sqrt(2.0 * np.where(is_known[:, None], drops, 1.0)).T
    asymmetry = (lower - upper) / (np.hypot(1.0, lower) + np.hypot(1.0, upper) - 2.0)
    return np.clip(np.where(is_known, asymmetry, 0.0), -_LARGEST_ASYMMETRY, _LARGEST_ASYMMETRY)
