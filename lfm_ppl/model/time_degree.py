"""Degree in time of a function of (x, u, t) between the breakpoints of its known inputs, from its jaxpr.

1. The argument t has degree one, the others zero. A read of a known input at a time of degree one has degree zero for
   "previous" and one for "linear", between breakpoints.
2. Sums, and primitives that only move entries, take the largest degree of their operands; products add degrees.
3. Any other primitive has degree zero where all of its operands have, and is no polynomial otherwise.

The degree is an upper bound: a polynomial may be classified as none, but never the reverse.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal

from lfm_ppl.model.inputs import interpolation_of
from lfm_ppl.model.user_functions import TracedFunction

_SUMS = {"add", "sub", "add_any", "neg", "copy", "copy_p", "convert_element_type", "reduce_sum", "reshape", "squeeze",
         "broadcast_in_dim", "transpose", "rev", "slice", "concatenate", "pad", "stack", "unstack", "split", "tile",
         "expand_dims", "stop_gradient"}
_PRODUCTS = {"mul", "dot_general"}
_CALLS = ("jaxpr", "call_jaxpr", "fun_jaxpr")


def degree_in_time(function: TracedFunction) -> float:
    """Return the degree in t of a function of (x, u, t) between breakpoints; infinity where it is no polynomial.

    Known inputs that are read at t minus a lag are polynomials of degree zero ("previous") or one ("linear").
    """
    jaxpr = function.closed.jaxpr
    return max(_degrees(jaxpr, [0.0] * (len(jaxpr.invars) - 1) + [1.0]), default=0.0)


def _degrees(jaxpr: Any, arguments: list[float]) -> list[float]:
    """Return the degrees of the outputs of a jaxpr; its constants have degree zero."""
    degrees: dict[Any, float] = dict.fromkeys(jaxpr.constvars, 0.0)
    degrees.update(zip(jaxpr.invars, arguments, strict=True))

    def read(atom: Any) -> float:
        return 0.0 if isinstance(atom, Literal) else degrees[atom]

    for equation in jaxpr.eqns:
        results = _apply(equation, [read(atom) for atom in equation.invars])
        degrees.update(zip(equation.outvars, results, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _apply(equation: Any, operands: list[float]) -> list[float]:
    """Return the degrees of the outputs of one equation."""
    count, name = len(equation.outvars), equation.primitive.name
    highest = max(operands, default=0.0)
    if highest == 0.0:
        return [0.0] * count
    interpolation = interpolation_of(str(equation.params.get("name", "")))
    if interpolation is not None:
        *table, time = operands[-3:]
        is_affine = time == 1.0 and not any(table)
        return [{"previous": 0.0, "linear": 1.0}[interpolation] if is_affine else np.inf] * count
    if name == "convert_element_type" and not jnp.issubdtype(equation.params["new_dtype"], jnp.inexact):
        # Integers truncate and booleans compare with zero: a step function of time.
        return [np.inf] * count
    if name in _SUMS:
        return [highest] * count
    if name in _PRODUCTS:
        return [sum(operands)] * count
    if name == "div" and operands[1] == 0.0:
        return [operands[0]] * count
    if name == "square" or (name == "integer_pow" and equation.params["y"] > 0):
        return [equation.params.get("y", 2) * operands[0]] * count
    if name in ("gather", "dynamic_slice", "select_n"):
        indices = operands[:1] if name == "select_n" else operands[1:]
        return [np.inf if any(indices) else highest] * count
    inner = next((equation.params[key] for key in _CALLS if key in equation.params), None)
    if inner is None or name in ("scan", "while", "cond"):
        return [np.inf] * count
    body = getattr(inner, "jaxpr", inner)
    return _degrees(body, operands[len(operands) - len(body.invars):])
