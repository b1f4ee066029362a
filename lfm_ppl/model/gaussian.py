"""A Gaussian distribution of the physical state."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike

from lfm_ppl.utils import checks


class Gaussian(eqx.Module):
    """A Gaussian distribution N(mean, covariance) of the physical state at the initial time.

    Args:
        mean: (M,).
        covariance: (M, M), or a vector of M variances; zero (a known state) is legal.

    Raises:
        ValueError: the shapes disagree, or the covariance is not symmetric and positive semi-definite.

    Example:
        >>> import jax.numpy as jnp
        >>> Gaussian(jnp.zeros(2), jnp.zeros((2, 2))).covariance.shape
        (2, 2)
    """

    mean: jax.Array
    covariance: jax.Array

    def __init__(self, mean: ArrayLike, covariance: ArrayLike):
        checks.finite("initial_state.mean", mean)
        checks.covariance_matrix("initial_state.covariance", covariance)
        self.mean = jnp.atleast_1d(jnp.asarray(mean, float))
        if self.mean.ndim != 1:
            raise ValueError(f"initial_state.mean must be a vector (M,), got shape {self.mean.shape}.")
        covariance = jnp.asarray(covariance, float)
        self.covariance = jnp.diag(covariance) if covariance.ndim == 1 else covariance
        size = self.mean.shape[0]
        if self.covariance.shape != (size, size):
            raise ValueError(f"initial_state.covariance must have shape ({size}, {size}) or ({size},) to go with a "
                             f"mean of that length, got {covariance.shape}.")
