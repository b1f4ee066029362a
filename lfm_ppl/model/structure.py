"""Which inputs of a function are non-linear: read off its jaxpr.

Every intermediate value carries two Boolean patterns: on which inputs its entries depend, and for which pairs of
inputs a second derivative may be non-zero. Linear primitives unite the patterns, products and non-linear primitives
add pairs, and whatever is unknown counts as non-linear in everything that it depends on. The pattern is therefore
never too small: a linear input may be taken for a non-linear one (which costs time), never the reverse.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal


class Pattern(NamedTuple):
    """Sparsity of a function of ``K`` scalar inputs with ``D`` scalar outputs.

    Attributes:
        jacobian: (D, K), whether an output depends on an input at all.
        hessian: (K, K), whether any output has a second derivative in a pair of inputs.
    """

    jacobian: np.ndarray
    hessian: np.ndarray


class _Value(NamedTuple):
    """Patterns of one array: first (size, K), second (size, K, K); ``known`` its value where it is a constant."""

    first: np.ndarray
    second: np.ndarray
    known: Any = None

    @property
    def constant(self) -> bool:
        return not self.first.any()


def pattern(function: Callable[[jax.Array], jax.Array], inputs: int) -> Pattern:
    """Find the sparsity of ``function``, which maps an array (inputs,) to an array (D,).

    The function may close over tracers; these count as constants. Nothing is evaluated at a point, so the pattern
    holds everywhere.

    Example:
        >>> import jax.numpy as jnp
        >>> pattern(lambda v: jnp.stack([v[0] * v[1] + v[2], v[2]]), 3).hessian.any(axis=1).tolist()
        [True, True, False]
    """
    jaxpr = jax.make_jaxpr(function)(jax.ShapeDtypeStruct((inputs,), jnp.result_type(float)))
    argument = _Value(np.eye(inputs, dtype=bool), np.zeros((inputs, inputs, inputs), bool))
    (output,) = _propagate(jaxpr.jaxpr, jaxpr.consts, [argument], inputs)
    return Pattern(output.first, np.asarray(output.second.any(axis=0)))


def _constant(shape: tuple[int, ...], inputs: int, known: Any = None) -> _Value:
    size = int(np.prod(shape))
    return _Value(np.zeros((size, inputs), bool), np.zeros((size, inputs, inputs), bool), known)


def _propagate(jaxpr: Any, consts: list, arguments: list[_Value], inputs: int) -> list[_Value]:
    environment: dict[Any, _Value] = {}

    def read(atom: Any) -> _Value:
        if isinstance(atom, Literal):
            return _constant(np.shape(atom.val), inputs, np.asarray(atom.val))
        return environment[atom]

    for variable, value in zip(jaxpr.constvars, consts, strict=True):
        known = None if isinstance(value, jax.core.Tracer) else value
        environment[variable] = _constant(np.shape(value), inputs, known)
    environment.update(zip(jaxpr.invars, arguments, strict=True))
    for equation in jaxpr.eqns:
        operands = [read(atom) for atom in equation.invars]
        environment.update(zip(equation.outvars, _apply(equation, operands, inputs), strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _apply(equation: Any, operands: list[_Value], inputs: int) -> list[_Value]:
    name = equation.primitive.name
    if all(operand.constant for operand in operands):
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


def _evaluate(equation: Any, operands: list[_Value], inputs: int) -> list[_Value]:
    shapes = [variable.aval.shape for variable in equation.outvars]
    values: list[Any] = [None] * len(shapes)
    small = all(np.prod(shape) <= 4096 for shape in shapes)
    if small and equation.primitive.name not in _CALLS and all(o.known is not None for o in operands):
        with jax.ensure_compile_time_eval():
            found = equation.primitive.bind(*[o.known for o in operands], **equation.params)
        values = list(found) if equation.primitive.multiple_results else [found]
    return [_constant(shape, inputs, value) for shape, value in zip(shapes, values, strict=True)]


def _outer(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    product = a[..., :, None] & b[..., None, :]
    return product | np.swapaxes(product, -1, -2)


def _fallback(equation: Any, operands: list[_Value]) -> list[_Value]:
    first = np.any([operand.first.any(axis=0) for operand in operands], axis=0)
    second = _outer(first, first)
    return [_Value(np.broadcast_to(first, (int(np.prod(v.aval.shape)), *first.shape)),
                   np.broadcast_to(second, (int(np.prod(v.aval.shape)), *second.shape)))
            for v in equation.outvars]


def _aligned(equation: Any, operands: list[_Value]) -> list[_Value]:
    """Operands of an elementwise primitive, broadcast to its output: scalars and axes of length one are repeated."""
    shape = equation.outvars[0].aval.shape
    aligned = []
    for variable, operand in zip(equation.invars, operands, strict=True):
        own = variable.aval.shape
        if own == shape:
            aligned.append(operand)
            continue
        index = np.broadcast_to(np.arange(int(np.prod(own))).reshape(own), shape).ravel()
        aligned.append(_Value(operand.first[index], operand.second[index]))
    return aligned


def _union(equation: Any, operands: list[_Value]) -> _Value:
    return _joint(_aligned(equation, operands))


def _joint(operands: list[_Value]) -> _Value:
    first, second = operands[0].first, operands[0].second
    for operand in operands[1:]:
        first, second = first | operand.first, second | operand.second
    return _Value(first, second)


def _nonlinear(equation: Any, operands: list[_Value]) -> _Value:
    joint = _union(equation, operands)
    return _Value(joint.first, joint.second | _outer(joint.first, joint.first))


def _product(equation: Any, operands: list[_Value]) -> _Value:
    left, right = _aligned(equation, operands)
    joint = _joint([left, right])
    return _Value(joint.first, joint.second | _outer(left.first, right.first))


def _quotient(equation: Any, operands: list[_Value]) -> _Value:
    numerator, denominator = _aligned(equation, operands)
    joint = _joint([numerator, denominator])
    pairs = _outer(numerator.first, denominator.first) | _outer(denominator.first, denominator.first)
    return _Value(joint.first, joint.second | pairs)


def _power(equation: Any, operands: list[_Value]) -> _Value:
    return _union(equation, operands) if equation.params["y"] == 1 else _nonlinear(equation, operands)


def _select(equation: Any, operands: list[_Value]) -> _Value:
    """A choice between cases: each keeps its own pattern, and bends where the predicate changes."""
    predicate, *cases = _aligned(equation, operands)
    joint = _joint(cases)
    pairs = _outer(predicate.first, predicate.first | joint.first)
    return _Value(joint.first | predicate.first, joint.second | pairs)


def _scatter_add(equation: Any, operands: list[_Value]) -> _Value | None:
    """The operand plus the updates, each where its index says."""
    operand, indices, updates = operands
    if indices.known is None:
        return None
    shapes = [variable.aval.shape for variable in equation.invars]
    with jax.ensure_compile_time_eval():
        place = lambda u: equation.primitive.bind(jnp.zeros(shapes[0]), indices.known, u, **equation.params)  # noqa: E731
        landed = np.asarray(jax.jacfwd(place)(jnp.zeros(shapes[2]))) != 0
    landed = landed.reshape(operand.first.shape[0], updates.first.shape[0])
    return _Value(operand.first | np.einsum("ou,uk->ok", landed, updates.first),
                  operand.second | np.einsum("ou,ukl->okl", landed, updates.second))


def _moved(equation: Any, operands: list[_Value]) -> list[_Value] | None:
    """Primitives that only move entries: run them on the entries' numbers. Zero marks padding."""
    shapes = [variable.aval.shape for variable in equation.invars]
    offsets = np.cumsum([1] + [int(np.prod(shape)) for shape in shapes])
    movable = equation.primitive.name
    arguments: list[Any] = []
    for position, (shape, operand) in enumerate(zip(shapes, operands, strict=True)):
        is_index = (movable in ("gather", "dynamic_slice") and position > 0) or (movable == "scatter" and position == 1)
        if is_index or (movable == "dynamic_update_slice" and position > 1):
            if operand.known is None:
                return None
            arguments.append(operand.known)
        else:
            start = int(offsets[position])
            arguments.append(np.arange(start, start + int(np.prod(shape)), dtype=float).reshape(shape))
    if movable == "pad":
        arguments[1] = np.zeros(shapes[1])
    with jax.ensure_compile_time_eval():
        moved = equation.primitive.bind(*arguments, **equation.params)
    blank = _constant((1,), operands[0].first.shape[-1])
    first = np.concatenate([blank.first, *(operand.first for operand in operands)])
    second = np.concatenate([blank.second, *(operand.second for operand in operands)])
    outputs = list(moved) if equation.primitive.multiple_results else [moved]
    indices = [np.nan_to_num(np.asarray(output)).astype(int).ravel() for output in outputs]
    return [_Value(first[index], second[index]) for index in indices]


def _summed(equation: Any, operands: list[_Value]) -> _Value:
    shape, axes = equation.invars[0].aval.shape, tuple(equation.params["axes"])
    (operand,) = operands
    first = operand.first.reshape(*shape, -1).any(axis=axes)
    second = operand.second.reshape(*shape, *operand.second.shape[1:]).any(axis=axes)
    return _Value(first.reshape(-1, first.shape[-1]), second.reshape(-1, *second.shape[-2:]))


def _dot(equation: Any, operands: list[_Value]) -> _Value:
    (contract_a, contract_b), (batch_a, batch_b) = equation.params["dimension_numbers"]
    inputs = operands[0].first.shape[-1]

    def arrange(operand: _Value, shape: tuple, batch: tuple, contract: tuple) -> tuple[np.ndarray, np.ndarray]:
        free = [axis for axis in range(len(shape)) if axis not in (*batch, *contract)]
        order = [*batch, *free, *contract]
        sizes = [int(np.prod([shape[axis] for axis in axes])) for axes in (batch, free, contract)]
        first = operand.first.reshape(*shape, inputs).transpose(*order, -1).reshape(*sizes, inputs)
        second = operand.second.reshape(*shape, inputs, inputs).transpose(*order, len(shape), len(shape) + 1)
        return first, second.reshape(*sizes, inputs, inputs)

    first_a, second_a = arrange(operands[0], equation.invars[0].aval.shape, batch_a, contract_a)
    first_b, second_b = arrange(operands[1], equation.invars[1].aval.shape, batch_b, contract_b)
    batches, free_a, free_b = first_a.shape[0], first_a.shape[1], first_b.shape[1]
    first = np.zeros((batches, free_a, free_b, inputs), bool)
    second = np.zeros((batches, free_a, free_b, inputs, inputs), bool)
    for batch, i, j in itertools.product(range(batches), range(free_a), range(free_b)):
        a, b = first_a[batch, i], first_b[batch, j]
        first[batch, i, j] = (a | b).any(axis=0)
        second[batch, i, j] = (second_a[batch, i] | second_b[batch, j] | _outer(a, b)).any(axis=0)
    return _Value(first.reshape(-1, inputs), second.reshape(-1, inputs, inputs))


def _converted(equation: Any, operands: list[_Value]) -> _Value | list[_Value] | None:
    """Between floating types nothing happens; to whole numbers or truth values is a step function."""
    floating = jnp.issubdtype(equation.params["new_dtype"], jnp.floating)
    return (_union if floating else _nonlinear)(equation, operands)


_RULES: dict[str, Callable[[Any, list[_Value]], _Value | list[_Value] | None]] = {
    **dict.fromkeys(["add", "sub", "add_any", "neg", "copy", "copy_p", "real",
                     "reduce_precision"], _union),
    **dict.fromkeys(["reshape", "squeeze", "broadcast_in_dim", "transpose", "rev", "slice", "concatenate", "pad",
                     "stack", "unstack", "split", "tile", "expand_dims", "gather", "dynamic_slice",
                     "dynamic_update_slice", "scatter"], _moved),
    **dict.fromkeys(["exp", "exp2", "log", "log1p", "expm1", "sin", "cos", "tan", "tanh", "sinh", "cosh", "asin",
                     "acos", "atan", "atan2", "logistic", "sqrt", "rsqrt", "cbrt", "abs", "sign", "erf", "erfc",
                     "pow", "max", "min", "square", "clamp", "lgamma", "digamma", "rem", "floor", "ceil", "round",
                     "is_finite", "gt", "lt", "ge", "le", "eq", "ne", "and", "or", "not"], _nonlinear),
    "convert_element_type": _converted,
    "mul": _product, "div": _quotient, "integer_pow": _power, "select_n": _select, "reduce_sum": _summed,
    "dot_general": _dot, "scatter-add": _scatter_add, "scatter_add": _scatter_add,
}
