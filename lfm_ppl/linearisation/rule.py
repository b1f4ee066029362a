"""The one abstraction of every Gaussian filter: a function and a Gaussian give an affine map."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.linearisation.structure import InputStructure

Function = Callable[[jax.Array], tuple[jax.Array, Any]]
"""Maps inputs (N,) to a value (D,) and a pytree of arrays of which only the expectation is asked."""


class AffineMap(NamedTuple):
    """An affine approximation ``f(v) ~ value + jacobian (v - mean)`` with residual covariance.

    Attributes:
        value: (D,), E[f].
        jacobian: (D, N), ``A`` with ``A P = Cov(f, v)``; the Jacobian in directions without variance.
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
        covariance: (a + r, a + r), of the points' and the averaged coordinates, in this order.
        min_sd: (a,), the smallest standard deviation that counts as one, for the points' coordinates. A rule
            differentiates over at least this distance where the variance is zero.
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
            structure: which inputs take points, which are linear given the points, which are linear.
            jacobian: (D, N), the Jacobian in the constant inputs, zero elsewhere.

        Returns:
            The affine approximation.
        """
        raise NotImplementedError

    @property
    def name(self) -> str:
        """The name of the rule, with its settings, as results record it."""
        settings = ", ".join(f"{key}={value}" for key, value in vars(self).items() if value is not False)
        return f"{type(self).__name__}({settings})"


def selection(indices: tuple[int, ...], size: int) -> np.ndarray:
    """Return the (size, len(indices)) matrix that puts entries at ``indices``."""
    matrix = np.zeros((size, len(indices)))
    matrix[list(indices), np.arange(len(indices))] = 1.0
    return matrix


def partial_jacobian(function: Function, point: jax.Array, indices: tuple[int, ...]) -> jax.Array:
    """Return the Jacobian (D, len(indices)) in some of the inputs."""
    directions = jnp.asarray(selection(indices, point.shape[0]).T)
    push = lambda direction: jax.jvp(lambda v: function(v)[0], (point,), (direction,))[1]  # noqa: E731
    return jax.vmap(push, out_axes=1)(directions)
