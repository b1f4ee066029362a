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
        covariance: ``R``: a variance of all outputs, variances (D,), a matrix (D, D), one matrix per observation
            (T, D, D), or a function ``(x, u, t)`` that returns (D,) or (D, D). Either this or ``sd`` is given.
        angular: indices of components that are angles; their residuals are reduced to [-period / 2, period / 2].
        period: the period of these angles: 2 pi for radians, 360 for degrees such as a direction of the wind, 24 for
            hours of the day. ``function`` and the noise are in the same unit.
        sd: standard deviations of independent errors: a number for all outputs, (D,), one row per observation (T, D),
            or a function ``(x, u, t)`` that returns () or (D,).

    Raises:
        TypeError: both of ``sd`` and ``covariance`` are given, or neither.
        ValueError: an sd is negative; the covariance is not symmetric, not positive semi-definite, or of a wrong
            shape; the period is not positive.

    Example:
        >>> import jax.numpy as jnp
        >>> GaussianObservation(lambda x, u, t: x[:1], sd=jnp.array([0.5])).covariance.tolist()
        [0.25]
        >>> GaussianObservation(lambda x, u, t: x[:1], covariance=jnp.array([0.25])).covariance.tolist()
        [0.25]

    Source: Hartikainen, Seppänen and Särkkä (2012), equation 4.
    """

    function: Callable[..., jax.Array]
    covariance: Any
    angular: tuple[int, ...] = eqx.field(static=True)
    period: float = eqx.field(static=True)

    def __init__(self, function: Callable[..., jax.Array], covariance: Any = None, angular: Any = (),
                 period: float = TURN, *, sd: Any = None):
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
        if (sd is None) == (covariance is None):
            raise TypeError("the noise of a GaussianObservation is given by one of sd= and covariance=, got "
                            f"{'neither' if sd is None else 'both'}.")
        self.covariance = _checked_covariance(covariance) if sd is None else _covariance_of_sd(sd, function)

    def with_output_sizes(self, output_size: Callable[[Callable], int]) -> GaussianObservation:
        """Return the observation with a variance for each output where one number stands for all."""
        if callable(self.covariance) or self.covariance.ndim:
            return self
        variances = jnp.full(output_size(self.function), self.covariance)
        return eqx.tree_at(lambda observation: observation.covariance, self, variances)

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


def _checked_covariance(covariance: Any) -> Any:
    """Return a covariance as a function or an array; raise ValueError unless each matrix is a covariance."""
    if callable(covariance):
        return covariance
    values = checks.concrete(covariance)
    for index, matrix in enumerate(values) if values is not None and values.ndim == 3 else ():
        checks.covariance_matrix(f"observation covariance of row {index}", matrix)
    if values is not None and values.ndim != 3:
        checks.covariance_matrix("observation covariance", np.atleast_1d(values))
    return jnp.asarray(covariance, float)


def _covariance_of_sd(sd: Any, function: Callable[..., jax.Array]) -> Any:
    """Return the covariance of independent errors: () or (D,) of one sd or (D,), (T, D, D) of (T, D), or a function."""
    if callable(sd):
        def variance(x: jax.Array, u: jax.Array, t: jax.Array) -> jax.Array:
            value = jnp.asarray(sd(x, u, t), float)
            if value.ndim > 1:
                raise ValueError(f"sd must return a number or a vector (D,), got shape {value.shape}; a matrix is a "
                                 "covariance=.")
            return value**2 if value.ndim else jnp.full(jax.eval_shape(function, x, u, t).shape, value**2)

        return variance
    checks.finite("sd", sd)
    if np.ndim(sd) > 2:
        raise ValueError(f"sd must be a number, (D,) or one row per observation (T, D), got shape {np.shape(sd)}.")
    values = checks.concrete(sd)
    if values is not None and np.any(values < 0):
        raise ValueError(f"sd must not be negative, got {np.min(values):g}.")
    variances = jnp.asarray(sd, float) ** 2
    return jax.vmap(jnp.diag)(variances) if variances.ndim == 2 else variances
