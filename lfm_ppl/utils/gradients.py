"""Log densities that return minus infinity, with zero gradients, where their computation fails.

At some parameter values an explicit integration diverges. The log likelihood is then minus infinity, and a sampler
rejects the value. Reverse-mode differentiation, however, multiplies the zero cotangent of this branch by infinite
Jacobians, and 0 * inf = NaN. This module replaces NaN cotangents by zero where they leave the computation, so that no
operation inside needs a guard.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

# The identity as a linear function, whose transpose replaces non-finite entries by zero. It must be a primitive:
# custom_vjp does not support forward mode, which is faster for a few parameters, and linear_call does not support vmap.
_finite_cotangent_p = Primitive("finite_cotangent")
_finite_cotangent_p.def_impl(lambda x: x)
_finite_cotangent_p.def_abstract_eval(lambda x: x)
mlir.register_lowering(_finite_cotangent_p, lambda ctx, x: [x])
batching.defvectorized(_finite_cotangent_p)


def _transpose(cotangent: Any, x: Any) -> list[Any]:
    if isinstance(cotangent, ad.Zero):
        return [cotangent]
    return [jnp.where(jnp.isfinite(cotangent), cotangent, 0.0)]


ad.deflinear2(_finite_cotangent_p, _transpose)


@jax.custom_jvp
def _finite_or_minus_infinity(value: jax.Array) -> jax.Array:
    return jnp.where(jnp.isfinite(value), value, -jnp.inf)


@_finite_or_minus_infinity.defjvp
def _finite_or_minus_infinity_jvp(primals: tuple, tangents: tuple) -> tuple:
    (value,), (tangent,) = primals, tangents
    return _finite_or_minus_infinity(value), jnp.where(jnp.isfinite(value), tangent, 0.0)


def finite_or_minus_infinity(log_density: Callable[..., jax.Array], *arguments: Any) -> jax.Array:
    """Return ``log_density(*arguments)``, or -inf with zero gradients where it is not finite.

    Args:
        log_density: a function that returns an array; it may close over traced values.
        *arguments: pytrees of arrays.

    Returns:
        The array, -inf where it is not finite. Its derivatives with respect to the arguments and to everything
        that ``log_density`` closes over are finite, in forward and in reverse mode, also under ``vmap`` and ``jit``.

    Example:
        >>> import jax
        >>> jax.grad(lambda a: finite_or_minus_infinity(lambda x: -jnp.exp(jnp.exp(x)), a))(9.0).item()
        0.0
    """
    converted, closed_over = jax.closure_convert(log_density, *arguments)
    value = converted(*jax.tree.map(_guard, arguments), *map(_guard, closed_over))
    return _finite_or_minus_infinity(value)


def _guard(x: Any) -> Any:
    """Return ``x``, with a cotangent of zero where it is not finite; integers have no cotangent."""
    return _finite_cotangent_p.bind(x) if jnp.issubdtype(jnp.result_type(x), jnp.floating) else x
