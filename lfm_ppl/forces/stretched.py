"""Base of stationary forces whose lengthscale only rescales time: one set of matrices for each order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from lfm_ppl.forces.parameters import Mean, mean_parameter, positive_parameter, static_order
from lfm_ppl.forces.sde import Force


class UnitMatrices(Protocol):
    """The matrices of a process with scale = 1 and lam = 1, driven by one Brownian motion."""

    @property
    def feedback(self) -> np.ndarray:
        """F_1 (n, n)."""

    @property
    def dispersion(self) -> np.ndarray:
        """L_1 (n, 1)."""

    @property
    def covariance(self) -> np.ndarray:
        """P_1 (n, n), stationary."""


class Stretched(Force):
    """A stationary force with P0 = scale^2 P_1, F = lam F_1 and L = scale sqrt(lam) L_1.

    The state is ``(v, v'/lam, v''/lam^2, ...)`` with a rate lam proportional to 1/lengthscale, so that the matrices of
    the unit process depend on the order alone. v equals u, unless a subclass overrides ``measurement``. A subclass
    implements ``unit`` and ``rate``.

    Args:
        scale: standard deviation of u, in the units of the force; > 0.
        lengthscale: in units of time; > 0.
        order: one of ``orders``.
        mean: a number, or a function of time.
    """

    scale: jax.Array
    lengthscale: jax.Array
    order: int = eqx.field(static=True)
    mean: Any

    orders: ClassVar[Sequence[int]]

    def __init__(self, scale: ArrayLike, lengthscale: ArrayLike, order: int, mean: Mean = 0.0):
        self.scale = positive_parameter("scale", scale)
        self.lengthscale = positive_parameter("lengthscale", lengthscale)
        self.order = static_order(order, self.orders)
        self.mean = mean_parameter(mean)

    @property
    def unit(self) -> UnitMatrices:
        """The matrices of the unit process."""
        raise NotImplementedError

    @property
    def rate(self) -> jax.Array:
        """The rate lam, in 1/time."""
        raise NotImplementedError

    @property
    def state_dim(self) -> int:
        """Number n of states."""
        return len(self.unit.feedback)

    @property
    def stationary(self) -> bool:
        """True."""
        return True

    def initial_covariance(self) -> jax.Array:
        """Return the stationary covariance (n, n) of the SDE."""
        return self.scale**2 * self.unit.covariance

    def feedback(self) -> jax.Array:
        """Return F (n, n)."""
        return self.rate * self.unit.feedback

    def dispersion(self) -> jax.Array:
        """Return L (n, 1)."""
        return self.scale * jnp.sqrt(self.rate) * self.unit.dispersion


def covariance_of_derivatives(moments: Sequence[Any] | np.ndarray) -> np.ndarray:
    """Return the stationary covariance (n, n) of a process and its first n - 1 derivatives.

    ``E[v^(i) v^(j)] = (-1)^((i - j)/2) m_((i + j)/2)`` where i + j is even, zero otherwise.

    Args:
        moments: the n spectral moments m_0, ..., m_(n-1).
    """
    n = len(moments)
    covariance = np.zeros((n, n))
    for i in range(n):
        for j in range(i % 2, n, 2):
            covariance[i, j] = (-1) ** ((i - j) // 2) * moments[(i + j) // 2]
    return covariance
