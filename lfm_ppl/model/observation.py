"""Gaussian observations: y_k = h(x(t_k), u(t_k), t_k) + r_k with Gaussian noise r_k."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.utils import checks
from lfm_ppl.utils.gaussian_residuals import TURN


class GaussianObservation(eqx.Module):
    """Measurements of states and forces with Gaussian noise.

    ``y_k = h(x, u, t_k) + r_k``,  ``r_k ~ N(0, R_k)``.

    Args:
        function: ``h(x, u, t) -> (D,)``; ``x`` (M,), ``u`` (R,) in the order of the forces.
        covariance: ``R``: variances (D,), a matrix (D, D), one matrix per observation (T, D, D), or a function
            ``(x, u, t)`` that returns (D,) or (D, D).
        angular: indices of components that are angles; their residuals are reduced to [-period / 2, period / 2].
        period: the period of these angles: 2 pi for radians, 360 for degrees such as a direction of the wind, 24 for
            hours of the day. ``function`` and ``covariance`` are in the same unit.

    Raises:
        ValueError: the covariance is not symmetric, not positive semi-definite, or of a wrong shape; the period is not
            positive.

    Example:
        >>> import jax.numpy as jnp
        >>> GaussianObservation(lambda x, u, t: x[:1], jnp.array([0.01])).angular
        ()

    Source: Hartikainen, Seppänen and Särkkä (2012), equation 4.
    """

    function: Callable[..., jax.Array]
    covariance: Any
    angular: tuple[int, ...] = eqx.field(static=True)
    period: float = eqx.field(static=True)

    def __init__(self, function: Callable[..., jax.Array], covariance: Any, angular: Any = (), period: float = TURN):
        if not callable(function):
            raise TypeError(f"observation function must be callable as h(x, u, t), got {type(function).__name__}.")
        self.function = function
        indices = np.atleast_1d(np.asarray(angular))
        if indices.size and indices.dtype.kind not in "iu":
            raise TypeError(f"angular must hold the indices of the components that are angles, for example (0,), got "
                            f"{angular!r}.")
        self.angular = tuple(int(index) for index in indices)
        checks.positive("period", period, "It is the period of the angles, such as 360 for degrees.")
        self.period = float(period)
        if callable(covariance):
            self.covariance = covariance
            return
        values = checks.concrete(covariance)
        for index, matrix in enumerate(values) if values is not None and values.ndim == 3 else ():
            checks.covariance_matrix(f"observation covariance of row {index}", matrix)
        if values is not None and values.ndim != 3:
            checks.covariance_matrix("observation covariance", np.atleast_1d(values))
        self.covariance = jnp.atleast_1d(jnp.asarray(covariance, float))

    def check_data(self, y: Any, first_column: int = 0, names: Sequence[str] = ()) -> None:
        """Warn of angles (T, D) in radians that are larger than a turn, as degrees are.

        Args:
            y: observations, NaN where missing.
            first_column: index of the first column, for messages.
            names: names of the D outputs.
        """
        for index in self.angular if self.period == TURN else ():
            column = np.asarray(y)[:, index]
            largest = column[np.nanargmax(np.abs(column))] if np.isfinite(column).any() else 0.0
            if abs(largest) > TURN:
                name = names[index] if index < len(names) else f"y[:, {first_column + index}]"
                checks.warn(f"the angles {name!r} reach {largest:g}, and are read in radians. For degrees give "
                            "lfm.GaussianObservation(..., period=360), for hours of the day period=24.")

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
