"""Checks of user functions, and their reads of known inputs, by analysis of their jaxprs.

An index out of range raises in NumPy. Compiled code cannot raise: JAX uses the nearest entry instead, and the
likelihood of ``u[7]`` is finite for a model of one force.

1. `trace_function` traces a function once; its errors explain how to rewrite functions that cannot be traced.
2. `_walk` yields the equations of a jaxpr and of the functions it calls, with the values of operands that are
   constants, known arguments, or computed from these.
3. `TracedFunction.check_indices` compares known indices of slices, gathers and scatters with the shapes of the arrays.
   (`jax.experimental.checkify` needs the values of x, u, t and the parameters, which are not known here: at zeros it
   would refuse an index such as ``floor(t) - 100``.)
4. `TracedFunction.table_reads` lists the reads of known inputs (`lfm_ppl.model.inputs`).

Source: https://docs.jax.dev/en/latest/jaxpr.html for the structure of jaxprs.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import math
import os
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import equinox
import jax
import numpy as np
import numpyro
from jax.extend.core import Literal
from jax.lax import GatherScatterMode

from lfm_ppl.utils import checks

_MOST_ENTRIES = 4096
"""Largest number of entries of a value that is evaluated."""

_LIBRARIES = tuple(f"{Path(file or '').parent}{os.sep}" for file in (
    jax.__file__, equinox.__file__, numpyro.__file__, str(Path(__file__).parent)))

_DEPENDENT = "that depends on x, u, t or a parameter"
_REMEDIES: tuple[tuple[type[Exception], str], ...] = (
    (jax.errors.TracerBoolConversionError, f"A Python branch takes a value {_DEPENDENT}; use jnp.where or lax.cond."),
    (jax.errors.TracerArrayConversionError, f"NumPy or SciPy takes a value {_DEPENDENT}; use jax.numpy, jnp.exp."),
    (jax.errors.TracerIntegerConversionError, f"A Python index {_DEPENDENT} needs a JAX array, jnp.asarray(table)[i]."),
    (jax.errors.ConcretizationTypeError, f"float(), int() or the math module takes a value {_DEPENDENT}; use jnp.exp."),
    (jax.errors.NonConcreteBooleanIndexError, f"A condition {_DEPENDENT} selects entries; use jnp.where."),
)


@dataclass(frozen=True)
class Unknown:
    """A value that is not known; ``name`` is that of the argument of the user's function, if it is an argument."""

    name: str = ""


class TableRead(NamedTuple):
    """A read of a known input: the name of the reading function, its operands, and whether it is in a branch."""

    name: str
    times: Any
    values: Any
    time: Any
    is_conditional: bool


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
        users = (jaxpr.outvars, *(equation.invars for equation in jaxpr.eqns))
        return any(atom is jaxpr.invars[-1] for atoms in users for atom in atoms)

    @property
    def concrete_consts(self) -> list[Any]:
        """The constants of the jaxpr; tracers are unknown."""
        return [Unknown() if checks.traced(value) else value for value in self.closed.consts]

    def names(self) -> set[str]:
        """Return the names of all primitives and of all called functions."""
        equations = list(_equations(self.closed.jaxpr))
        return {equation.primitive.name for equation in equations} | {
            str(equation.params["name"]) for equation in equations if "name" in equation.params}

    def check_indices(self, names: Sequence[str]) -> None:
        """Check the known indices.

        Args:
            names: names of the first arguments, such as ``("x", "u")``.

        Raises:
            ValueError: an index is out of range; the message names the array and the range.
        """
        jaxpr = self.closed.jaxpr
        arguments = [Unknown(name) for name in names] + [Unknown()] * (len(jaxpr.invars) - len(names))
        for step in _walk(jaxpr, self.concrete_consts, arguments):
            invalid = _invalid_index(step.equation, step.operands)
            if invalid is None:
                continue
            index, axis = invalid
            shape, array = step.equation.invars[0].aval.shape, step.operands[0]
            name = array.name if isinstance(array, Unknown) and len(shape) == 1 else ""
            verb = "sets" if step.equation.primitive.name.startswith("scatter") else "reads"
            access = f"{name}[{index}]" if name else f"index {index} of axis {axis} of an array of shape {shape}"
            size = shape[axis]
            remedy = f"; use an index from 0 to {size - 1}, or from -{size} to -1 to count from the end" if size else ""
            raise ValueError(f"{self.label} {verb} {access}, but {name or 'that axis'} has {size} "
                             f"{'entry' if size == 1 else 'entries'}{remedy}. JAX does not raise here, and would use "
                             f"another entry.{_source_line(step.source)}")

    def table_reads(self, mark: str, t: float, consts: Sequence[Any]) -> Iterator[TableRead]:
        """Yield the calls of jitted functions ``(table times, values, t)`` whose name contains ``mark``.

        Args:
            mark: part of the name of the functions.
            t: the last argument; the other arguments are unknown.
            consts: values of the constants of the jaxpr, which may be tracers.
        """
        arguments = [*[Unknown()] * (len(self.closed.jaxpr.invars) - 1), np.asarray(t, float)]
        for step in _walk(self.closed.jaxpr, consts, arguments):
            name = str(step.equation.params.get("name", ""))
            if mark in name:
                # Inside compiled code arithmetic on JAX arrays would give tracers.
                operands = [value if isinstance(value, Unknown) or checks.traced(value) else np.asarray(value)
                            for value in step.operands[-3:]]
                times, values, time = operands
                yield TableRead(name, times, values, time, step.is_conditional)


def own_function(function: Callable) -> Callable:
    """Return a plain function that calls ``function``, unequal to all others and hashable.

    `jax.jit` compiles once for equal functions. A model whose functions are its own is compiled for what they compute
    when it is built, although a variable that they read may have changed since another model had the same functions.
    """

    @functools.wraps(function, updated=())
    def call(*arguments: Any) -> Any:
        return function(*arguments)

    return call


def own_functions(tree: Any) -> Any:
    """Return a pytree with each function that is a leaf as an `own_function`."""
    return jax.tree.map(lambda leaf: own_function(leaf) if callable(leaf) else leaf, tree)


def trace_function(label: str, form: str, function: Callable, *arguments: Any) -> TracedFunction:
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

    def call(*values: Any) -> Any:  # make_jaxpr needs a hashable function; an Equinox module with arrays is not
        return function(*values)

    try:
        closed, shape = jax.make_jaxpr(call, return_shape=True)(*arguments)
    except (TypeError, IndexError) as error:
        remedy = next((text for kind, text in _REMEDIES if isinstance(error, kind)), "")
        first_line = str(error).split("\n")[0]
        if remedy:
            message = (f"must be made of JAX operations, since it is compiled. {remedy} JAX says: "
                       f"{type(error).__name__}: {first_line}")
        elif "'Input'" in first_line:
            message = f"computes with a known input; call it with the time, inputs[...](t). Python says: {first_line}"
        elif "array is 0-dimensional" in first_line:
            message = (f"takes an entry of a number. Its arguments are {form}, in this order, and t is a number. JAX "
                       f"says: {first_line}")
        else:
            raise
        raise TypeError(f"{label} {message}") from error
    return TracedFunction(label, shape, closed)


def _source_line(equation: Any) -> str:
    """Return a sentence with the line of the user's file from which an equation comes, or an empty string."""
    for frame in getattr(getattr(equation.source_info, "traceback", None), "frames", ()):
        if not frame.file_name.startswith(_LIBRARIES):
            # Notebook cells and interactive input have no file.
            return f" It stands in {frame.file_name}, line {frame.line_num}." if Path(frame.file_name).is_file() else ""
    return ""


class _Step(NamedTuple):
    """An equation with its operands, the equation of the outermost function that contains it, and its condition."""

    equation: Any
    operands: list[Any]
    source: Any
    is_conditional: bool


def _walk(jaxpr: Any, consts: Sequence[Any], arguments: Sequence[Any], source: Any = None,
          is_conditional: bool = False) -> Generator[_Step, None, list[Any]]:
    """Yield the equations of a jaxpr and of its inner functions, branches and loops; return the outputs.

    Args:
        jaxpr: the jaxpr.
        consts: values of its constants.
        arguments: values of its arguments.
        source: the equation of the outermost function that calls the jaxpr. Its line is that of the user's code, while
            equations of inner functions may come from JAX's cache, with the lines of another call.
        is_conditional: whether the jaxpr is part of a branch or of a loop that may not run.
    """
    values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *arguments), strict=True))

    def read(atom: Any) -> Any:
        return np.asarray(atom.val) if isinstance(atom, Literal) else values[atom]

    for equation in jaxpr.eqns:
        operands = [read(atom) for atom in equation.invars]
        name, bodies, caller = equation.primitive.name, _bodies(equation), source or equation
        yield _Step(equation, operands, caller, is_conditional)
        results = [Unknown()] * len(equation.outvars)
        for body, body_consts in bodies:
            if name in ("scan", "while"):  # values change from one iteration to the next
                body_arguments = [Unknown()] * len(body.invars)
            else:
                body_arguments = operands[len(operands) - len(body.invars):]
            outputs = yield from _walk(body, body_consts, body_arguments, caller,
                                       is_conditional or name in ("cond", "while"))
            if name not in ("scan", "while", "cond"):
                results = outputs
        values.update(zip(equation.outvars, results if bodies else _evaluate(equation, operands), strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _equations(jaxpr: Any) -> Iterator[Any]:
    """Yield the equations of a jaxpr and of the functions in it."""
    for equation in jaxpr.eqns:
        yield equation
        for body, _ in _bodies(equation):
            yield from _equations(body)


def _bodies(equation: Any) -> list[tuple[Any, Sequence[Any]]]:
    """Return the jaxprs that an equation calls, with their constants."""
    params = equation.params
    bodies = params.get("branches") or [params[key] for key in ("body_jaxpr", "jaxpr", "call_jaxpr", "fun_jaxpr")
                                        if key in params][:1]
    return [(getattr(body, "jaxpr", body), getattr(body, "consts", ())) for body in bodies
            if hasattr(getattr(body, "jaxpr", body), "eqns")]


def _evaluate(equation: Any, operands: list[Any]) -> Sequence[Any]:
    """Return the results of an equation, unknown unless all operands are known and the results are small."""
    sizes = [math.prod(variable.aval.shape) for variable in equation.outvars]
    if equation.effects or max(sizes, default=0) > _MOST_ENTRIES or any(isinstance(o, Unknown) for o in operands):
        return [Unknown()] * len(sizes)
    with contextlib.nullcontext() if checks.traced(operands) else jax.ensure_compile_time_eval():
        results = equation.primitive.bind(*operands, **equation.params)
    return results if equation.primitive.multiple_results else [results]


def _invalid_index(equation: Any, operands: list[Any]) -> tuple[int, int] | None:
    """Return (index, axis) of the first known index out of range, None if there is no such index."""
    name, params = equation.primitive.name, equation.params
    if name == "dynamic_slice":
        starts, axes, widths = operands[1:], range(len(operands) - 1), params["slice_sizes"]
    elif name == "gather" and params["mode"] == GatherScatterMode.PROMISE_IN_BOUNDS:
        # Another mode ("clip", "fill", "wrap") defines the result out of range.
        starts, axes, widths = operands[1], params["dimension_numbers"].start_index_map, params["slice_sizes"]
    elif name.startswith("scatter") and params["mode"] == GatherScatterMode.FILL_OR_DROP and np.ndim(operands[1]) == 1:
        # Several indices may include padding out of range, which JAX drops; a single index out of range is an error.
        starts, axes, widths = operands[1], params["dimension_numbers"].scatter_dims_to_operand_dims, None
    else:
        return None
    shape = equation.invars[0].aval.shape
    for column, axis in enumerate(() if isinstance(starts, Unknown) else axes):
        start = starts[column] if isinstance(starts, list) else np.asarray(starts)[..., column]
        if isinstance(start, Unknown):
            continue
        entries, size = np.ravel(start), shape[axis]
        is_invalid = (entries < 0) | (entries > size - (1 if widths is None else widths[axis]))
        if is_invalid.any():
            index = int(entries[np.argmax(is_invalid)])
            return (index - size if index < 0 else index), axis  # JAX has added the size to a negative index
    return None
