"""Checks of user functions by analysis of their jaxprs.

An index out of range raises in NumPy. Compiled code cannot raise: JAX uses the nearest entry instead, and the
likelihood of ``u[7]`` is finite for a model of one force. A jaxpr contains concrete indices, and the times at which
known inputs are read.

1. `trace` traces a function once; its errors explain how to rewrite functions that cannot be traced.
2. `_Scope` evaluates variables of the jaxpr on demand, from constants and known arguments, through calls of inner
   functions. Branches and loops have scopes as well, but their variables may be unknown.
3. `TracedFunction.check_indices` evaluates the indices of slices, gathers and scatters, and raises if one is out of
   range. The traceback of the equation gives the line in the user's file.
4. `TracedFunction.not_finite` goes back from a non-finite value to the first operation that produced it.
5. `TracedFunction.table_reads` and `table_calls` list the reads of known inputs (`lfm_ppl.model.inputs`).

Source: https://docs.jax.dev/en/latest/jaxpr.html for the structure of jaxprs.
"""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox
import jax
import numpy as np
import numpyro
from jax.extend.core import Literal

_MOST_ENTRIES = 4096
"""Largest number of entries of a value that is evaluated."""

_MOST_EQUATIONS = 100
"""Largest number of consecutive equations between known values and an evaluated variable."""

_BODIES = ("jaxpr", "call_jaxpr", "fun_jaxpr")

_REMEDIES: tuple[tuple[type[Exception], str], ...] = (
    (jax.errors.TracerBoolConversionError, "It has a Python branch (if, while, and, or, min, max) on a value that "
     "depends on x, u or t or on a parameter; use jnp.where, jnp.minimum or jax.lax.cond."),
    (jax.errors.TracerArrayConversionError, "It calls NumPy or SciPy (np.exp, say) on a value that depends on x, u or "
     "t or on a parameter; use the function of the same name in jax.numpy, jnp.exp."),
    (jax.errors.TracerIntegerConversionError, "It takes a value that depends on x, u or t or on a parameter for a "
     "Python index or count; convert it with .astype(int), and index a JAX array, jnp.asarray(table)[i]."),
    (jax.errors.ConcretizationTypeError, "It makes a Python number (float(), int(), the math module) of a value that "
     "depends on x, u or t or on a parameter; use jax.numpy, as in jnp.exp."),
    (jax.errors.NonConcreteBooleanIndexError, "It picks entries by a condition on values that depend on x, u or t or "
     "on a parameter; use jnp.where, which keeps the shape."),
)


@dataclass(frozen=True)
class TracedFunction:
    """A traced function of (x, u, t).

    Attributes:
        label: name of the function in messages.
        shape: shape and type of its value, or a pytree of shapes and types.
        closed: its jaxpr with constants; constants that depend on parameters may be tracers.
    """

    label: str
    shape: Any
    closed: Any

    @property
    def depends_on_time(self) -> bool:
        """Whether the function uses its last argument, t."""
        jaxpr = self.closed.jaxpr
        used = {id(atom) for equation in jaxpr.eqns for atom in equation.invars} | {id(atom) for atom in jaxpr.outvars}
        return id(jaxpr.invars[-1]) in used

    @property
    def has_roots(self) -> bool:
        """Whether the function contains a root or a power with a non-integer exponent."""
        scope = _Scope.from_arguments(self.closed, [None] * len(self.closed.jaxpr.invars))
        return any(equation.primitive.name in ("sqrt", "rsqrt", "cbrt", "pow") for _, equation in scope.equations())

    def check_indices(self, names: Sequence[str]) -> None:
        """Check concrete indices.

        Args:
            names: names of the first arguments, such as ``("x", "u")``.

        Raises:
            ValueError: an index is out of range; the message names the array and the range.
        """
        scope = _Scope.from_arguments(self.closed, [None] * len(self.closed.jaxpr.invars))
        outer_equation = None
        for inner, equation in scope.equations():
            # Equations of an inner function follow its call, whose line is that of the user's code.
            outer_equation = equation if inner is scope else outer_equation
            find_invalid = _INVALID_INDEX.get(equation.primitive.name)
            invalid = None if find_invalid is None else find_invalid(inner, equation)
            if invalid is None:
                continue
            entry, axis = invalid
            array, size = equation.invars[0], equation.invars[0].aval.shape[axis]
            argument = inner.argument(array)
            name = names[argument] if argument is not None and argument < len(names) else None
            shape = array.aval.shape
            access = f"{name}[{entry}]" if name is not None and len(shape) == 1 else (
                f"index {entry} of axis {axis} of an array of shape {shape}")
            size_text = f"{name or 'that axis'} has {size} {'entry' if size == 1 else 'entries'}"
            remedy = f"; use an index from 0 to {size - 1}, or from -{size} to -1 to count from the end" if size else ""
            raise ValueError(f"{self.label} {_VERBS[equation.primitive.name.startswith('scatter')]} {access}, but "
                             f"{size_text}{remedy}. JAX does not raise here, and would use another entry."
                             f"{_source_line(outer_equation)}")

    def not_finite(self, *arguments: np.ndarray) -> str:
        """Return a sentence with the line of the first non-finite value at ``arguments``, or an empty string."""
        scope, sentence = _Scope.from_arguments(self.closed, arguments), ""

        def is_non_finite(atom: Any) -> bool:
            try:
                value = scope.evaluate(atom)
                return value is not None and not np.all(np.isfinite(value))
            except Exception:  # a failed evaluation must not hide the error to which the sentence is added
                return False

        # Go back from the result through non-finite operands only: a branch that jnp.where discards is not reached.
        non_finite = [atom for atom in self.closed.jaxpr.outvars if is_non_finite(atom)]
        while non_finite and non_finite[0] in scope.producer:
            equation, _ = scope.producer[non_finite[0]]
            sentence = _source_line(equation) or sentence
            non_finite = [atom for atom in equation.invars if not isinstance(atom, Literal) and is_non_finite(atom)]
        return sentence

    def table_reads(self, mark: str, t: Any) -> Iterator[tuple[str, Any, np.ndarray]]:
        """Yield (name, table times, times of the read) for calls of jitted functions whose name contains ``mark``.

        Args:
            mark: part of the name of a function ``(table times, values, t)``.
            t: the last argument. Reads that depend on the other arguments, on tracers or on a branch are omitted.
        """
        arguments = [*[None] * (len(self.closed.jaxpr.invars) - 1), np.asarray(t, float)]
        scope = _Scope.from_arguments(self.closed, arguments)
        for inner, equation in scope.equations(branches=False):
            name = str(equation.params.get("name", ""))
            if mark not in name:
                continue
            table, _, time = equation.invars[-3:]
            table_times, read_times = inner.evaluate(table), inner.evaluate(time)
            if table_times is not None and read_times is not None:
                yield name, table_times, read_times

    def table_calls(self, mark: str, t: float, consts: Sequence[Any]) -> Iterator[tuple[str, Any, Any, Any]]:
        """Yield (name, table times, values, times of the read) like `table_reads`, including branches.

        Args:
            mark: part of the name of a function ``(table times, values, t)``.
            t: the last argument.
            consts: values of the constants of the jaxpr, which may be tracers. Unknown results are None.
        """
        arguments = [*[None] * (len(self.closed.jaxpr.invars) - 1), np.asarray(t, float)]
        scope = _Scope(self.closed.jaxpr, consts, lambda index: arguments[index], lambda index: index, tracers=True)
        for inner, equation in scope.equations():
            name = str(equation.params.get("name", ""))
            if mark in name:
                times, values, time = (inner.evaluate(operand) for operand in equation.invars[-3:])
                yield name, times, values, time

    def has(self, mark: str) -> bool:
        """Return whether the function calls a jitted function whose name contains ``mark``."""
        scope = _Scope.from_arguments(self.closed, [None] * len(self.closed.jaxpr.invars))
        return any(mark in str(equation.params.get("name", "")) for _, equation in scope.equations())


def trace(label: str, form: str, function: Callable, *arguments: Any) -> TracedFunction:
    """Trace a user's function once.

    Args:
        label: name of the function in messages.
        form: its call with arguments, such as ``f(x, u, t)``.
        function: a function or an Equinox module.
        *arguments: arrays, or their shapes and types.

    Raises:
        TypeError: the function takes another number of arguments, or cannot be traced because of NumPy functions,
            Python branches and the like; the message contains the remedy and JAX's error.
    """
    try:
        inspect.signature(function).bind(*arguments)
    except TypeError as error:
        raise TypeError(f"{label} must take three arguments, {form}: {error}.") from None
    except ValueError:  # the function has no signature
        pass
    try:
        hash(function)
    except TypeError:  # make_jaxpr needs a hashable function; an Equinox module with arrays is not
        function = _hashable(function)
    try:
        closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    except tuple(kind for kind, _ in _REMEDIES) as error:
        remedy = next(text for kind, text in _REMEDIES if isinstance(error, kind))
        first_line = str(error).split("\n")[0]
        raise TypeError(f"{label} must be made of JAX operations, since it is compiled. {remedy} JAX says: "
                        f"{type(error).__name__}: {first_line}") from error
    except (TypeError, IndexError) as error:
        first_line = str(error).split("\n")[0]
        if "'Input'" in first_line:
            raise TypeError(f"{label} computes with a known input; call it with the time, inputs[...](t). Python says: "
                            f"{first_line}") from error
        if "array is 0-dimensional" in first_line:
            raise TypeError(f"{label} takes an entry of a number. Its arguments are {form}, in this order, and t is a "
                            f"number. JAX says: {first_line}") from error
        raise
    return TracedFunction(label, shape, closed)


def _hashable(function: Callable) -> Callable:
    """Return a plain function that calls ``function``."""

    def call(*arguments: Any) -> Any:
        return function(*arguments)

    return call


_LIBRARIES = tuple(f"{Path(file or '').parent}{os.sep}" for file in (
    jax.__file__, equinox.__file__, numpyro.__file__, str(Path(__file__).parent)))


def _source_line(equation: Any) -> str:
    """Return a sentence with the line of the user's file from which an equation comes, or an empty string."""
    for frame in getattr(getattr(equation.source_info, "traceback", None), "frames", ()):
        if not frame.file_name.startswith(_LIBRARIES):
            # Notebook cells and interactive input have no file.
            return f" It stands in {frame.file_name}, line {frame.line_num}." if Path(frame.file_name).is_file() else ""
    return ""


class _Scope:
    """A jaxpr whose variables are evaluated on demand, from its constants and the known arguments.

    Args:
        jaxpr: the jaxpr.
        consts: values of its constants.
        outer: function from the index of an argument to its value, None if unknown.
        source: function from the index of an argument to the index of the argument of the outermost function that it
            is, None if it is not one.
        tracers: whether tracers among the constants count as known values.
    """

    def __init__(self, jaxpr: Any, consts: Sequence[Any], outer: Callable[[int], Any],
                 source: Callable[[int], int | None], tracers: bool = False):
        self.jaxpr, self.outer, self.source, self.tracers = jaxpr, outer, source, tracers
        self.values: dict[Any, Any] = {}
        for variable, value in zip(jaxpr.constvars, consts, strict=True):
            self.values[variable] = None if isinstance(value, jax.core.Tracer) and not tracers else value
        self.position = {variable: index for index, variable in enumerate(jaxpr.invars)}
        self.producer = {variable: (equation, index) for equation in jaxpr.eqns
                         for index, variable in enumerate(equation.outvars)}
        self.called: dict[int, _Scope] = {}

    @classmethod
    def from_arguments(cls, closed: Any, arguments: Sequence[Any]) -> _Scope:
        """Return the scope of a closed jaxpr with these arguments, None for an unknown one."""
        return cls(closed.jaxpr, closed.consts, lambda index: arguments[index], lambda index: index)

    def equations(self, branches: bool = True) -> Iterator[tuple[_Scope, Any]]:
        """Yield every equation with its scope, including inner functions, loops and, optionally, branches."""
        for equation in self.jaxpr.eqns:
            yield self, equation
            if equation.primitive.name in ("cond", "while"):
                bodies = equation.params.get("branches") or (equation.params["body_jaxpr"],)
                for body in bodies if branches else ():
                    skip = len(equation.invars) - len(body.jaxpr.invars)
                    count = len(body.jaxpr.invars) if equation.primitive.name == "cond" else 0
                    yield from self._inner(equation, body, skip, count).equations()
            else:
                inner = self._call(equation)
                if inner is not None:
                    yield from inner.equations(branches)

    def evaluate(self, atom: Any, depth: int = 0) -> Any:
        """Return the value of a variable or a literal, None if it is unknown."""
        if isinstance(atom, Literal):
            return np.asarray(atom.val)
        if atom not in self.values:
            self.values[atom] = self._evaluate_variable(atom, depth)
        value = self.values[atom]
        return value if value is None or isinstance(value, jax.core.Tracer) else np.asarray(value)

    def argument(self, atom: Any) -> int | None:
        """Return the index of the argument of the outermost function that a variable is, or None."""
        position = None if isinstance(atom, Literal) else self.position.get(atom)
        return None if position is None else self.source(position)

    def _evaluate_variable(self, atom: Any, depth: int) -> Any:
        if depth > _MOST_EQUATIONS:
            return None
        if atom in self.position:
            return self.outer(self.position[atom])
        if math.prod(atom.aval.shape) > _MOST_ENTRIES:
            return None
        if atom not in self.producer:
            return None
        equation, index = self.producer[atom]
        if any(key in equation.params for key in (*_BODIES, "branches", "body_jaxpr")):
            inner = None if equation.primitive.name == "scan" else self._call(equation)
            return None if inner is None else inner.evaluate(inner.jaxpr.outvars[index], depth + 1)
        operands = [self.evaluate(operand, depth + 1) for operand in equation.invars]
        if any(operand is None for operand in operands):
            return None
        if any(isinstance(operand, jax.core.Tracer) for operand in operands):
            value = equation.primitive.bind(*operands, **equation.params)
            return value[index] if equation.primitive.multiple_results else value
        with jax.ensure_compile_time_eval():
            value = equation.primitive.bind(*operands, **equation.params)
        return np.asarray(value[index] if equation.primitive.multiple_results else value)

    def _call(self, equation: Any) -> _Scope | None:
        """Return the scope of a function that an equation calls, or of the body of a scan."""
        body = next((equation.params[key] for key in _BODIES if key in equation.params), None)
        if body is None or not hasattr(getattr(body, "jaxpr", body), "eqns"):
            return None
        if id(equation) not in self.called:
            skip = len(equation.invars) - len(getattr(body, "jaxpr", body).invars)
            count = 0 if equation.primitive.name == "scan" else len(equation.invars)  # values change in a loop
            self.called[id(equation)] = self._inner(equation, body, max(skip, 0), count)
        return self.called[id(equation)]

    def _inner(self, equation: Any, body: Any, skip: int, count: int) -> _Scope:
        """Return the scope of a body, whose arguments are the operands after the first ``skip``.

        The first ``count`` of its arguments have the values of the operands; the others are unknown.
        """
        operands = equation.invars[skip:]
        return _Scope(getattr(body, "jaxpr", body), getattr(body, "consts", ()),
                      lambda index: self.evaluate(operands[index]) if index < count else None,
                      lambda index: self.argument(operands[index]) if index < count else None, self.tracers)


def _invalid_slice(scope: _Scope, equation: Any) -> tuple[int, int] | None:
    """Return (index, axis) of a slice that starts out of range, None if there is no such slice."""
    shape = equation.invars[0].aval.shape
    for axis, (start, width) in enumerate(zip(equation.invars[1:], equation.params["slice_sizes"], strict=True)):
        index = scope.evaluate(start)
        if index is not None and not 0 <= int(index) <= shape[axis] - width:
            return _user_index(int(index), shape[axis]), axis
    return None


def _invalid_gather(scope: _Scope, equation: Any) -> tuple[int, int] | None:
    """Return (index, axis) of a gather out of range, None if there is no such index."""
    # An explicit mode ("clip", "fill", "wrap") defines the result out of range.
    if equation.params["mode"] != jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS:
        return None
    numbers = equation.params["dimension_numbers"]
    return _invalid_index(scope, equation, numbers.start_index_map, equation.params["slice_sizes"])


def _invalid_scatter(scope: _Scope, equation: Any) -> tuple[int, int] | None:
    """Return (index, axis) of a scatter out of range, None if there is no such index."""
    # Several indices may include padding out of range, which JAX drops; a single index out of range is an error.
    if len(equation.invars[1].aval.shape) != 1 or equation.params["mode"] != jax.lax.GatherScatterMode.FILL_OR_DROP:
        return None
    axes = equation.params["dimension_numbers"].scatter_dims_to_operand_dims
    return _invalid_index(scope, equation, axes, (1,) * len(equation.invars[0].aval.shape))


def _invalid_index(scope: _Scope, equation: Any, axes: Sequence[int], widths: Sequence[int]) -> tuple[int, int] | None:
    """Return (index, axis) of the first index out of range along ``axes``, None if there is no such index."""
    indices = scope.evaluate(equation.invars[1])
    for column, axis in enumerate(axes if indices is not None else ()):
        size, entries = equation.invars[0].aval.shape[axis], np.ravel(np.asarray(indices)[..., column])
        is_invalid = (entries < 0) | (entries > size - widths[axis])
        if is_invalid.any():
            return _user_index(int(entries[np.argmax(is_invalid)]), size), axis
    return None


def _user_index(index: int, size: int) -> int:
    """Return the index in the user's code: JAX has added the size to a negative index."""
    return index - size if index < 0 else index


_INVALID_INDEX: dict[str, Callable[[_Scope, Any], tuple[int, int] | None]] = {
    "dynamic_slice": _invalid_slice, "gather": _invalid_gather,
    **dict.fromkeys(["scatter", "scatter-add", "scatter_add", "scatter-mul", "scatter_mul"], _invalid_scatter),
}
_VERBS = {False: "reads", True: "sets"}
