"""Checks and conversions that the constructors of forces share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lfm_ppl.utils import checks

Mean: TypeAlias = ArrayLike | Callable[[jax.Array], jax.Array]
"""A constant mean, or a function of time."""


def positive_parameter(name: str, value: Any) -> jax.Array:
    """Return ``value`` as a scalar array after checking that it is one number above zero."""
    checks.positive(name, value)
    return scalar_parameter(name, value)


def scalar_parameter(name: str, value: Any) -> jax.Array:
    """Return ``value`` as a scalar floating-point array after checking that it is one number."""
    checks.finite(name, value)
    array = jnp.asarray(value, dtype=float)
    if array.shape != ():
        raise ValueError(
            f"{name} must be one number, got an array of shape {array.shape}. "
            "Make one force per value, or use jax.vmap over the construction; for many series, as in a "
            "numpyro.plate, take lfm.panel."
        )
    return array


def non_negative_parameter(name: str, value: Any) -> jax.Array:
    """Return ``value`` as a scalar array after checking that it is one number, zero or above."""
    parameter = scalar_parameter(name, value)
    concrete = checks.concrete(parameter)
    if concrete is not None and concrete < 0:
        raise ValueError(f"{name} must be >= 0, got {concrete:g}.")
    return parameter


def static_order(order: Any, allowed: Sequence[int]) -> int:
    """Return ``order`` after checking that it is a Python int in ``allowed``."""
    choices = ", ".join(str(value) for value in allowed)
    if isinstance(order, bool) or not isinstance(order, (int, np.integer)):
        raise TypeError(
            f"order must be a Python int, one of {choices}, got {order!r} of type "
            f"{type(order).__name__}. It sets the number of states, so it cannot be sampled."
        )
    if order not in allowed:
        raise ValueError(f"order must be one of {choices}, got {order}.")
    return int(order)


def mean_parameter(mean: Any) -> Any:
    """Return the mean of a force as a pytree: a scalar array, or a callable.

    A plain function becomes static structure, so that the force can cross ``jax.jit``; an Equinox
    module keeps its parameters as leaves.
    """
    if isinstance(mean, eqx.Module) and callable(mean):
        return mean
    return jax.tree_util.Partial(mean) if callable(mean) else scalar_parameter("mean", mean)
