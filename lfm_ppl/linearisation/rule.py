"""The protocol of linearisation rules: a function and a Gaussian give an affine map."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.linearisation.input_selection import InputStructure

Function = Callable[[jax.Array], tuple[jax.Array, Any]]
"""Maps inputs (N,) to a value (D,) and a pytree of arrays, for which a rule returns the expectation only."""


class AffineMap(NamedTuple):
    """An affine approximation ``f(v) ~ value + jacobian (v - mean)`` with residual covariance.

    Attributes:
        value: (D,), ``E[f]``.
        jacobian: (D, N), ``A`` with ``A P = Cov(f, v)``; in directions without variance, the Jacobian of f.
        residual_cov: (D, D), ``Omega = Cov(f) - A P A'``.
        extra: expectation of the second output of the function.
    """

    value: jax.Array
    jacobian: jax.Array
    residual_cov: jax.Array
    extra: Any


class Inputs(NamedTuple):
    """A Gaussian over the inputs of a function, reduced to what a rule needs.

    Attributes:
        mean: (N,).
        covariance: (a + r, a + r), covariance of the non-linear (``points``) and then the ``averaged`` coordinates of
            `InputStructure`.
        min_sd: (a,), lower bound on the standard deviation of the non-linear coordinates. Where the variance is zero, a
            rule takes differences over this distance.
    """

    mean: jax.Array
    covariance: jax.Array
    min_sd: jax.Array


class Rule(eqx.Module):
    """A linearisation rule."""

    def linearise(self, function: Function, inputs: Inputs, structure: InputStructure,
                  jacobian: jax.Array) -> AffineMap:
        """Linearise ``function`` about a Gaussian.

        Args:
            function: maps (N,) to (D,) and extra arrays.
            inputs: the Gaussian.
            structure: the division of the inputs into non-linear, averaged and constant ones.
            jacobian: (D, N), the Jacobian in the constant inputs, zero in the others.

        Returns:
            The affine approximation.
        """
        raise NotImplementedError

    @property
    def name(self) -> str:
        """The name of the rule with its settings, for results and messages."""
        settings = ", ".join(f"{key}={value}" for key, value in vars(self).items() if value is not False)
        return f"{type(self).__name__}({settings})"


def selection(indices: tuple[int, ...], size: int) -> np.ndarray:
    """Return the (size, len(indices)) selection matrix: its product with v places the entries of v at ``indices``."""
    matrix = np.zeros((size, len(indices)))
    matrix[list(indices), np.arange(len(indices))] = 1.0
    return matrix


def partial_jacobian(function: Function, point: jax.Array, indices: tuple[int, ...]) -> jax.Array:
    """Return the Jacobian (D, len(indices)) in the inputs ``indices``."""
    directions = jnp.asarray(selection(indices, point.shape[0]).T)

    def directional_derivative(direction: jax.Array) -> jax.Array:
        return jax.jvp(lambda v: function(v)[0], (point,), (direction,))[1]

    return jax.vmap(directional_derivative, out_axes=1)(directions)
