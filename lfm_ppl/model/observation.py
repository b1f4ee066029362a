"""Gaussian observations: y_k = h(x(t_k), u(t_k), t_k) + r_k with Gaussian noise r_k."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.utils import checks


class GaussianObservation(eqx.Module):
    """Measurements of states and forces with Gaussian noise.

    ``y_k = h(x, u, t_k) + r_k``,  ``r_k ~ N(0, R_k)``.

    Args:
        function: ``h(x, u, t) -> (D,)``; ``x`` (M,), ``u`` (R,) in the order of the forces.
        covariance: ``R``: variances (D,), a matrix (D, D), one matrix per observation (T, D, D), or a function
            ``(x, u, t)`` that returns (D,) or (D, D).
        angular: indices of components that are angles in radians; their residuals are reduced to [-pi, pi].

    Raises:
        ValueError: the covariance is not symmetric, not positive semi-definite, or of a wrong shape.

    Example:
        >>> import jax.numpy as jnp
        >>> GaussianObservation(lambda x, u, t: x[:1], jnp.array([0.01])).angular
        ()

    Source: Hartikainen, Seppänen and Särkkä (2012), equation 4.
    """

    function: Callable[..., jax.Array]
    covariance: Any
    angular: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, function: Callable[..., jax.Array], covariance: Any, angular: Any = ()):
        if not callable(function):
            raise TypeError(f"observation function must be callable as h(x, u, t), got {type(function).__name__}.")
        self.function = function
        indices = np.atleast_1d(np.asarray(angular))
        if indices.size and indices.dtype.kind not in "iu":
            raise TypeError(f"angular must hold the indices of the components that are angles, for example (0,), got "
                            f"{angular!r}.")
        self.angular = tuple(int(index) for index in indices)
        if callable(covariance):
            self.covariance = covariance
            return
        values = checks.concrete(covariance)
        for index, matrix in enumerate(values) if values is not None and values.ndim == 3 else ():
            checks.covariance_matrix(f"observation covariance of row {index}", matrix)
        if values is not None and values.ndim != 3:
            checks.covariance_matrix("observation covariance", np.atleast_1d(values))
        self.covariance = jnp.atleast_1d(jnp.asarray(covariance, float))

    @property
    def varies_with_state(self) -> bool:
        """Whether the covariance is a function of (x, u, t)."""
        return callable(self.covariance)

    def covariance_at(self, x: jax.Array, u: jax.Array, t: jax.Array, row: Any) -> jax.Array:
        """Return R (D, D) at a state, a time and a row of the observations."""
        value = self.covariance(x, u, t) if callable(self.covariance) else self.covariance
        value = jnp.atleast_1d(jnp.asarray(value, float))
        if value.ndim == 3:
            return value[row]
        return jnp.diag(value) if value.ndim == 1 else value
