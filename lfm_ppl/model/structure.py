"""Detection of the non-linear inputs of a function from its jaxpr.

1. Trace the function once, without numbers.
2. Give every intermediate array two Boolean patterns for each of its entries: the inputs on which it depends
   (``jacobian``), and the pairs of inputs for which a hessian derivative may be non-zero (``hessian``).
3. The argument starts with the identity and no pairs; constants start with empty patterns.
4. Interpret the equations in order with one rule per primitive: linear primitives unite the patterns of their
   operands, products add the pairs of their factors, non-linear primitives add all pairs of inputs of their operand,
   and primitives that only move entries move the patterns.
5. Calls of inner functions are interpreted recursively. Equations of constants are evaluated, so that computed indices
   are known.
6. An unknown primitive counts as non-linear in all inputs on which its operands depend.

The pattern is therefore an upper bound: a linear input may be classified as non-linear, which costs time, but never
the reverse.

Source: Walther (2008), Computing sparse Hessians with automatic differentiation, ACM Transactions on Mathematical
Software 34(1).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal


class Pattern(NamedTuple):
    """Sparsity of a function of ``K`` scalar inputs with ``D`` scalar outputs.

    Attributes:
        jacobian: (D, K), whether an output depends on an input.
        hessian: (K, K), whether any output may have a non-zero hessian derivative in a pair of inputs.
    """

    jacobian: np.ndarray
    hessian: np.ndarray


@dataclass(frozen=True)
class _ArrayPattern:
    """The patterns of the entries of one intermediate array.

    Attributes:
        jacobian: (size, K), whether an entry depends on an input.
        hessian: (size, K, K), whether an entry may have a non-zero hessian derivative in a pair of inputs.
        value: the array, where it is a concrete constant.
    """

    jacobian: np.ndarray
    hessian: np.ndarray
    value: Any = None

    @property
    def is_constant(self) -> bool:
        return not self.jacobian.any()


def pattern(function: Callable[[jax.Array], jax.Array], inputs: int) -> Pattern:
    """Return the sparsity of ``function``, which maps an array (inputs,) to an array (D,).

    Tracers over which the function closes count as constants. The function is not evaluated at a point, so that the
    pattern holds everywhere.

    Example:
        >>> import jax.numpy as jnp
        >>> pattern(lambda v: jnp.stack([v[0] * v[1] + v[2], v[2]]), 3).hessian.any(axis=1).tolist()
        [True, True, False]
    """
    jaxpr = jax.make_jaxpr(function)(jax.ShapeDtypeStruct((inputs,), jnp.result_type(float)))
    argument = _ArrayPattern(np.eye(inputs, dtype=bool), np.zeros((inputs, inputs, inputs), bool))
    (output,) = _propagate(jaxpr.jaxpr, jaxpr.consts, [argument], inputs)
    return Pattern(output.jacobian, np.asarray(output.hessian.any(axis=0)))


def _constant(shape: tuple[int, ...], inputs: int, value: Any = None) -> _ArrayPattern:
    size = int(np.prod(shape))
    return _ArrayPattern(np.zeros((size, inputs), bool), np.zeros((size, inputs, inputs), bool), value)


def _propagate(jaxpr: Any, consts: list, arguments: list[_ArrayPattern], inputs: int) -> list[_ArrayPattern]:
    environment: dict[Any, _ArrayPattern] = {}

    def read(atom: Any) -> _ArrayPattern:
        if isinstance(atom, Literal):
            return _constant(np.shape(atom.val), inputs, np.asarray(atom.val))
        return environment[atom]

    for variable, value in zip(jaxpr.constvars, consts, strict=True):
        concrete = None if isinstance(value, jax.core.Tracer) else value
        environment[variable] = _constant(np.shape(value), inputs, concrete)
    environment.update(zip(jaxpr.invars, arguments, strict=True))
    for equation in jaxpr.eqns:
        operands = [read(atom) for atom in equation.invars]
        environment.update(zip(equation.outvars, _apply(equation, operands, inputs), strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _apply(equation: Any, operands: list[_ArrayPattern], inputs: int) -> list[_ArrayPattern]:
    """Return the patterns of the outputs of one equation."""
    name = equation.primitive.name
    if all(operand.is_constant for operand in operands):
        return _evaluate(equation, operands, inputs)
    inner = next((equation.params[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr")
                  if key in equation.params), None)
    if inner is not None and name in _CALLS:
        closed = getattr(inner, "jaxpr", None)
        body, consts = (closed, inner.consts) if closed is not None else (inner, [])
        return _propagate(body, consts, operands[len(operands) - len(body.invars):], inputs)
    rule = _RULES.get(name)
    result = rule(equation, operands) if rule is not None else None
    if result is None:
        return _fallback(equation, operands)
    return result if isinstance(result, list) else [result]


_CALLS = {"pjit", "jit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr",
          "remat", "checkpoint", "remat2"}


def _evaluate(equation: Any, operands: list[_ArrayPattern], inputs: int) -> list[_ArrayPattern]:
    shapes = [variable.aval.shape for variable in equation.outvars]
    values: list[Any] = [None] * len(shapes)
    is_small = all(np.prod(shape) <= 4096 for shape in shapes)
    if is_small and equation.primitive.name not in _CALLS and all(o.value is not None for o in operands):
        with jax.ensure_compile_time_eval():
            result = equation.primitive.bind(*[o.value for o in operands], **equation.params)
        values = list(result) if equation.primitive.multiple_results else [result]
    return [_constant(shape, inputs, value) for shape, value in zip(shapes, values, strict=True)]


def _outer(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    product = a[..., :, None] & b[..., None, :]
    return product | np.swapaxes(product, -1, -2)


def _fallback(equation: Any, operands: list[_ArrayPattern]) -> list[_ArrayPattern]:
    jacobian = np.any([operand.jacobian.any(axis=0) for operand in operands], axis=0)
    hessian = _outer(jacobian, jacobian)
    return [_ArrayPattern(np.broadcast_to(jacobian, (int(np.prod(v.aval.shape)), *jacobian.shape)),
                          np.broadcast_to(hessian, (int(np.prod(v.aval.shape)), *hessian.shape)))
            for v in equation.outvars]


def _broadcast_operands(equation: Any, operands: list[_ArrayPattern]) -> list[_ArrayPattern]:
    """Return the operands of an elementwise primitive, broadcast to the shape of its output."""
    shape = equation.outvars[0].aval.shape
    broadcast = []
    for variable, operand in zip(equation.invars, operands, strict=True):
        operand_shape = variable.aval.shape
        if operand_shape == shape:
            broadcast.append(operand)
            continue
        index = np.broadcast_to(np.arange(int(np.prod(operand_shape))).reshape(operand_shape), shape).ravel()
        broadcast.append(_ArrayPattern(operand.jacobian[index], operand.hessian[index]))
    return broadcast


def _union(equation: Any, operands: list[_ArrayPattern]) -> _ArrayPattern:
    return _joint(_broadcast_operands(equation, operands))


def _joint(operands: list[_ArrayPattern]) -> _ArrayPattern:
    jacobian, hessian = operands[0].jacobian, operands[0].hessian
    for operand in operands[1:]:
        jacobian, hessian = jacobian | operand.jacobian, hessian | operand.hessian
    return _ArrayPattern(jacobian, hessian)


def _nonlinear(equation: Any, operands: list[_ArrayPattern]) -> _ArrayPattern:
    joint = _union(equation, operands)
    return _ArrayPattern(joint.jacobian, joint.hessian | _outer(joint.jacobian, joint.jacobian))


def _product(equation: Any, operands: list[_ArrayPattern]) -> _ArrayPattern:
    a, b = _broadcast_operands(equation, operands)
    joint = _joint([a, b])
    return _ArrayPattern(joint.jacobian, joint.hessian | _outer(a.jacobian, b.jacobian))


def _quotient(equation: Any, operands: list[_ArrayPattern]) -> _ArrayPattern:
    numerator, denominator = _broadcast_operands(equation, operands)
    joint = _joint([numerator, denominator])
    pairs = _outer(numerator.jacobian, denominator.jacobian) | _outer(denominator.jacobian, denominator.jacobian)
    return _ArrayPattern(joint.jacobian, joint.hessian | pairs)


def _power(equation: Any, operands: list[_ArrayPattern]) -> _ArrayPattern:
    return _union(equation, operands) if equation.params["y"] == 1 else _nonlinear(equation, operands)


def _select(equation: Any, operands: list[_ArrayPattern]) -> _ArrayPattern:
    """Return the pattern of a choice between cases, which is non-linear in the inputs of the predicate."""
    predicate, *cases = _broadcast_operands(equation, operands)
    joint = _joint(cases)
    pairs = _outer(predicate.jacobian, predicate.jacobian | joint.jacobian)
    return _ArrayPattern(joint.jacobian | predicate.jacobian, joint.hessian | pairs)


def _scatter_add(equation: Any, operands: list[_ArrayPattern]) -> _ArrayPattern | None:
    """Return the pattern of the operand plus the updates at their indices; None where the indices are not known."""
    operand, indices, updates = operands
    if indices.value is None:
        return None
    shapes = [variable.aval.shape for variable in equation.invars]
    with jax.ensure_compile_time_eval():
        def scatter(values: jax.Array) -> jax.Array:
            return equation.primitive.bind(jnp.zeros(shapes[0]), indices.value, values, **equation.params)

        targets = np.asarray(jax.jacfwd(scatter)(jnp.zeros(shapes[2]))) != 0
    targets = targets.reshape(operand.jacobian.shape[0], updates.jacobian.shape[0])
    return _ArrayPattern(operand.jacobian | np.einsum("ou,uk->ok", targets, updates.jacobian),
                         operand.hessian | np.einsum("ou,ukl->okl", targets, updates.hessian))


def _relocate(equation: Any, operands: list[_ArrayPattern]) -> list[_ArrayPattern] | None:
    """Return the patterns of a primitive that only moves entries, or None where its indices are not known.

    The primitive is applied to the numbers of the entries, counted from one over all operands. Zero marks padding.
    """
    shapes = [variable.aval.shape for variable in equation.invars]
    offsets = np.cumsum([1] + [int(np.prod(shape)) for shape in shapes])
    name = equation.primitive.name
    arguments: list[Any] = []
    for position, (shape, operand) in enumerate(zip(shapes, operands, strict=True)):
        is_index = ((name in ("gather", "dynamic_slice") and position > 0) or (name == "scatter" and position == 1)
                    or (name == "dynamic_update_slice" and position > 1))
        if is_index:
            if operand.value is None:
                return None
            arguments.append(operand.value)
        else:
            start = int(offsets[position])
            arguments.append(np.arange(start, start + int(np.prod(shape)), dtype=float).reshape(shape))
    if name == "pad":
        arguments[1] = np.zeros(shapes[1])
    with jax.ensure_compile_time_eval():
        relocated = equation.primitive.bind(*arguments, **equation.params)
    padding = _constant((1,), operands[0].jacobian.shape[-1])
    jacobian = np.concatenate([padding.jacobian, *(operand.jacobian for operand in operands)])
    hessian = np.concatenate([padding.hessian, *(operand.hessian for operand in operands)])
    outputs = list(relocated) if equation.primitive.multiple_results else [relocated]
    indices = [np.nan_to_num(np.asarray(output)).astype(int).ravel() for output in outputs]
    return [_ArrayPattern(jacobian[index], hessian[index]) for index in indices]


def _reduce_sum(equation: Any, operands: list[_ArrayPattern]) -> _ArrayPattern:
    shape, axes = equation.invars[0].aval.shape, tuple(equation.params["axes"])
    (operand,) = operands
    jacobian = operand.jacobian.reshape(*shape, -1).any(axis=axes)
    hessian = operand.hessian.reshape(*shape, *operand.hessian.shape[1:]).any(axis=axes)
    return _ArrayPattern(jacobian.reshape(-1, jacobian.shape[-1]), hessian.reshape(-1, *hessian.shape[-2:]))


def _dot(equation: Any, operands: list[_ArrayPattern]) -> _ArrayPattern:
    (contract_a, contract_b), (batch_a, batch_b) = equation.params["dimension_numbers"]
    inputs = operands[0].jacobian.shape[-1]

    def arrange(operand: _ArrayPattern, shape: tuple, batch: tuple, contract: tuple) -> tuple[np.ndarray, np.ndarray]:
        free = [axis for axis in range(len(shape)) if axis not in (*batch, *contract)]
        order = [*batch, *free, *contract]
        sizes = [int(np.prod([shape[axis] for axis in axes])) for axes in (batch, free, contract)]
        jacobian = operand.jacobian.reshape(*shape, inputs).transpose(*order, -1).reshape(*sizes, inputs)
        hessian = operand.hessian.reshape(*shape, inputs, inputs).transpose(*order, len(shape), len(shape) + 1)
        return jacobian, hessian.reshape(*sizes, inputs, inputs)

    jacobian_a, hessian_a = arrange(operands[0], equation.invars[0].aval.shape, batch_a, contract_a)
    jacobian_b, hessian_b = arrange(operands[1], equation.invars[1].aval.shape, batch_b, contract_b)
    batches, free_a, free_b = jacobian_a.shape[0], jacobian_a.shape[1], jacobian_b.shape[1]
    jacobian = np.zeros((batches, free_a, free_b, inputs), bool)
    hessian = np.zeros((batches, free_a, free_b, inputs, inputs), bool)
    for batch, i, j in itertools.product(range(batches), range(free_a), range(free_b)):
        a, b = jacobian_a[batch, i], jacobian_b[batch, j]
        jacobian[batch, i, j] = (a | b).any(axis=0)
        hessian[batch, i, j] = (hessian_a[batch, i] | hessian_b[batch, j] | _outer(a, b)).any(axis=0)
    return _ArrayPattern(jacobian.reshape(-1, inputs), hessian.reshape(-1, inputs, inputs))


def _convert(equation: Any, operands: list[_ArrayPattern]) -> _ArrayPattern | list[_ArrayPattern] | None:
    """Return the pattern of a type conversion: linear to a floating type, a step function to any other type."""
    is_floating = jnp.issubdtype(equation.params["new_dtype"], jnp.floating)
    return (_union if is_floating else _nonlinear)(equation, operands)


_RULES: dict[str, Callable[[Any, list[_ArrayPattern]], _ArrayPattern | list[_ArrayPattern] | None]] = {
    **dict.fromkeys(["add", "sub", "add_any", "neg", "copy", "copy_p", "real",
                     "reduce_precision"], _union),
    **dict.fromkeys(["reshape", "squeeze", "broadcast_in_dim", "transpose", "rev", "slice", "concatenate", "pad",
                     "stack", "unstack", "split", "tile", "expand_dims", "gather", "dynamic_slice",
                     "dynamic_update_slice", "scatter"], _relocate),
    **dict.fromkeys(["exp", "exp2", "log", "log1p", "expm1", "sin", "cos", "tan", "tanh", "sinh", "cosh", "asin",
                     "acos", "atan", "atan2", "logistic", "sqrt", "rsqrt", "cbrt", "abs", "sign", "erf", "erfc",
                     "pow", "max", "min", "square", "clamp", "lgamma", "digamma", "rem", "floor", "ceil", "round",
                     "is_finite", "gt", "lt", "ge", "le", "eq", "ne", "and", "or", "not"], _nonlinear),
    "convert_element_type": _convert,
    "mul": _product, "div": _quotient, "integer_pow": _power, "select_n": _select, "reduce_sum": _reduce_sum,
    "dot_general": _dot, "scatter-add": _scatter_add, "scatter_add": _scatter_add,
}
