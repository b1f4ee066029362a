"""What can be seen of a user's function without running it: traced once, and read.

An index beyond an array raises in NumPy. In compiled code nothing can raise, so that JAX takes the nearest entry
instead, and the likelihood of ``u[7]`` is finite for a model of one force. The indices that are numbers stand in the
jaxpr, and so do the times at which a table is read, given the model's time; parameters may be tracers.
"""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox
import jax
import numpy as np
import numpyro
from jax.extend.core import Literal

_LARGEST = 4096
"""Most entries of a value that is worked out."""

_DEEPEST = 100
"""Most equations one after another from what is known to what is asked for."""

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


class Traced(NamedTuple):
    """A function of (x, u, t) as JAX sees it.

    Attributes:
        what: how messages call it.
        shape: of its value; a pytree of such where it returns one.
        closed: its jaxpr with constants; those that depend on parameters are tracers.
    """

    what: str
    shape: Any
    closed: Any

    @property
    def depends_on_time(self) -> bool:
        """Whether t, the last argument, is used at all."""
        jaxpr = self.closed.jaxpr
        used = {id(atom) for equation in jaxpr.eqns for atom in equation.invars} | {id(atom) for atom in jaxpr.outvars}
        return id(jaxpr.invars[-1]) in used

    @property
    def takes_roots(self) -> bool:
        """Whether it holds a root or a power that is no whole number."""
        scope = _Scope.of(self.closed, [None] * len(self.closed.jaxpr.invars))
        return any(equation.primitive.name in ("sqrt", "rsqrt", "cbrt", "pow") for _, equation in scope.equations())

    def check_indices(self, names: Sequence[str]) -> None:
        """Check the indices that are numbers.

        Args:
            names: of the first arguments, as in ``("x", "u")``.

        Raises:
            ValueError: one is out of range; the message has the array and the range.
        """
        scope = _Scope.of(self.closed, [None] * len(self.closed.jaxpr.invars))
        written = None
        for inner, equation in scope.equations():
            written = equation if inner is scope else written  # those of a function that it calls follow it
            index = _INDEX_OF.get(equation.primitive.name)
            wrong = None if index is None else index(inner, equation)
            if wrong is None:
                continue
            entry, axis = wrong
            array, size = equation.invars[0], equation.invars[0].aval.shape[axis]
            argument = inner.argument(array)
            name = names[argument] if argument is not None and argument < len(names) else None
            shape = array.aval.shape
            read = f"{name}[{entry}]" if name is not None and len(shape) == 1 else (
                f"index {entry} of axis {axis} of an array of shape {shape}")
            has = f"{name or 'that axis'} has {size} {'entry' if size == 1 else 'entries'}"
            valid = f"; use an index from 0 to {size - 1}, or from -{size} to -1 to count from the end" if size else ""
            raise ValueError(f"{self.what} {_VERBS[equation.primitive.name.startswith('scatter')]} {read}, but {has}"
                             f"{valid}. JAX does not raise here, and would compute something else.{_place(written)}")

    def not_finite(self, *arguments: np.ndarray) -> str:
        """Return a sentence about where a value first is not finite, given the arguments; empty where none is known."""
        scope, found = _Scope.of(self.closed, arguments), ""

        def bad(atom: Any) -> bool:
            try:
                value = scope.known(atom)
                return value is not None and not np.all(np.isfinite(value))
            except Exception:  # NumPy does not know the value; a hint must not stand in the way of the error
                return False

        # Back from the value: what a jnp.where discards is on no way that is not finite.
        reached = [atom for atom in self.closed.jaxpr.outvars if bad(atom)]
        while reached and reached[0] in scope.producer:
            equation, _ = scope.producer[reached[0]]
            found = _place(equation) or found
            reached = [atom for atom in equation.invars if not isinstance(atom, Literal) and bad(atom)]
        return found

    def table_reads(self, mark: str, t: Any) -> Iterator[tuple[str, Any, np.ndarray]]:
        """Yield (name, table times, times at which it is read) for functions jitted under a name with ``mark``.

        Args:
            mark: begins the name of such a function ``(table times, values, t)``.
            t: the last argument. What depends on the others, on tracers or on a branch is left out.
        """
        scope = _Scope.of(self.closed, [*[None] * (len(self.closed.jaxpr.invars) - 1), np.asarray(t, float)])
        for inner, equation in scope.equations(branches=False):
            name = str(equation.params.get("name", ""))
            if mark not in name:
                continue
            table, _, when = equation.invars[-3:]
            known = inner.known(table), inner.known(when)
            if known[0] is not None and known[1] is not None:
                yield name, known[0], known[1]

    def table_calls(self, mark: str, t: float, consts: Sequence[Any]) -> Iterator[tuple[str, Any, Any, Any]]:
        """Yield (name, table times, values, times at which it is read) as `table_reads` does, branches included.

        Args:
            mark: begins the name of such a function ``(table times, values, t)``.
            t: the last argument.
            consts: values of the constants of the jaxpr, tracers too. What is not known is None.
        """
        arguments = [*[None] * (len(self.closed.jaxpr.invars) - 1), np.asarray(t, float)]
        scope = _Scope(self.closed.jaxpr, consts, lambda index: arguments[index], lambda index: index, tracers=True)
        for inner, equation in scope.equations():
            name = str(equation.params.get("name", ""))
            if mark in name:
                times, values, time = (inner.known(operand) for operand in equation.invars[-3:])
                yield name, times, values, time

    def has(self, mark: str) -> bool:
        """Whether a function jitted under a name with ``mark`` is called."""
        scope = _Scope.of(self.closed, [None] * len(self.closed.jaxpr.invars))
        return any(mark in str(equation.params.get("name", "")) for _, equation in scope.equations())


def trace(what: str, form: str, function: Callable, *arguments: Any) -> Traced:
    """Trace a user's function once.

    Args:
        what: how messages call it.
        form: its arguments, as in ``f(x, u, t)``.
        function: plain, or an Equinox module.
        *arguments: arrays, or their shapes and types.

    Raises:
        TypeError: a wrong number of arguments; NumPy functions, Python branches and the like, which cannot be traced:
            JAX's error after a sentence that says what to write instead.
    """
    try:
        inspect.signature(function).bind(*arguments)
    except TypeError as error:
        raise TypeError(f"{what} must take three arguments, {form}: {error}.") from None
    except ValueError:  # no signature to be had
        pass
    try:
        hash(function)
    except TypeError:  # a module that holds arrays
        called = function
        function = lambda *given: called(*given)  # noqa: E731
    try:
        closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    except tuple(kind for kind, _ in _REMEDIES) as error:
        remedy = next(text for kind, text in _REMEDIES if isinstance(error, kind))
        said = str(error).split("\n")[0]
        raise TypeError(f"{what} must be made of JAX operations, since it is compiled. {remedy} JAX says: "
                        f"{type(error).__name__}: {said}") from error
    except (TypeError, IndexError) as error:
        said = str(error).split("\n")[0]
        if "'Input'" in said:
            raise TypeError(f"{what} computes with a known input; call it with the time, inputs[...](t). Python says: "
                            f"{said}") from error
        if "array is 0-dimensional" in said:
            raise TypeError(f"{what} takes an entry of a number. Its arguments are {form}, in this order, and t is a "
                            f"number. JAX says: {said}") from error
        raise
    return Traced(what, shape, closed)


_LIBRARIES = tuple(f"{Path(file or '').parent}{os.sep}" for file in (
    jax.__file__, equinox.__file__, numpyro.__file__, str(Path(__file__).parent)))


def _place(equation: Any) -> str:
    """Return a sentence about the line of a user's file that an equation comes from; empty where there is none."""
    for frame in getattr(getattr(equation.source_info, "traceback", None), "frames", ()):
        if not frame.file_name.startswith(_LIBRARIES):
            # Not so the cells of a notebook, and what is typed.
            return f" It stands in {frame.file_name}, line {frame.line_num}." if Path(frame.file_name).is_file() else ""
    return ""


class _Scope:
    """A jaxpr whose values are worked out on demand, from constants and what is known of its arguments."""

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
    def of(cls, closed: Any, arguments: Sequence[Any]) -> _Scope:
        return cls(closed.jaxpr, closed.consts, lambda index: arguments[index], lambda index: index)

    def equations(self, branches: bool = True) -> Iterator[tuple[_Scope, Any]]:
        """Yield every equation with its scope, those of inner functions, loops and, if wished, branches too."""
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

    def known(self, atom: Any, depth: int = 0) -> Any:
        """Return the value of a variable or a literal, None where it is not known."""
        if isinstance(atom, Literal):
            return np.asarray(atom.val)
        if atom not in self.values:
            self.values[atom] = self._found(atom, depth)
        value = self.values[atom]
        return value if value is None or isinstance(value, jax.core.Tracer) else np.asarray(value)

    def argument(self, atom: Any) -> int | None:
        """Return which argument of the outermost function a variable is, None where it is none."""
        position = None if isinstance(atom, Literal) else self.position.get(atom)
        return None if position is None else self.source(position)

    def _found(self, atom: Any, depth: int) -> Any:
        if depth > _DEEPEST:
            return None
        if atom in self.position:
            return self.outer(self.position[atom])
        if math.prod(atom.aval.shape) > _LARGEST:
            return None
        if atom not in self.producer:
            return None
        equation, index = self.producer[atom]
        if any(key in equation.params for key in (*_BODIES, "branches", "body_jaxpr")):
            inner = None if equation.primitive.name == "scan" else self._call(equation)
            return None if inner is None else inner.known(inner.jaxpr.outvars[index], depth + 1)
        operands = [self.known(operand, depth + 1) for operand in equation.invars]
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
            count = 0 if equation.primitive.name == "scan" else len(equation.invars)  # a loop's values change
            self.called[id(equation)] = self._inner(equation, body, max(skip, 0), count)
        return self.called[id(equation)]

    def _inner(self, equation: Any, body: Any, skip: int, count: int) -> _Scope:
        """Return the scope of a body; the first ``count`` of its operands, after ``skip`` others, keep their values."""
        operands = equation.invars[skip:]
        return _Scope(getattr(body, "jaxpr", body), getattr(body, "consts", ()),
                      lambda index: self.known(operands[index]) if index < count else None,
                      lambda index: self.argument(operands[index]) if index < count else None, self.tracers)


def _sliced(scope: _Scope, equation: Any) -> tuple[int, int] | None:
    """Return (index, axis) where a slice begins out of range, None where none is known to."""
    shape = equation.invars[0].aval.shape
    for axis, (start, width) in enumerate(zip(equation.invars[1:], equation.params["slice_sizes"], strict=True)):
        begin = scope.known(start)
        if begin is not None and not 0 <= int(begin) <= shape[axis] - width:
            return _written(int(begin), shape[axis]), axis
    return None


def _gathered(scope: _Scope, equation: Any) -> tuple[int, int] | None:
    # A mode that is asked for ("clip", "fill", "wrap") says what is to happen out of range.
    if equation.params["mode"] != jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS:
        return None
    numbers = equation.params["dimension_numbers"]
    return _indexed(scope, equation, numbers.start_index_map, equation.params["slice_sizes"])


def _scattered(scope: _Scope, equation: Any) -> tuple[int, int] | None:
    # Several indices may be padded with ones out of range, which are dropped; a single one has no use there.
    if len(equation.invars[1].aval.shape) != 1 or equation.params["mode"] != jax.lax.GatherScatterMode.FILL_OR_DROP:
        return None
    axes = equation.params["dimension_numbers"].scatter_dims_to_operand_dims
    return _indexed(scope, equation, axes, (1,) * len(equation.invars[0].aval.shape))


def _indexed(scope: _Scope, equation: Any, axes: Sequence[int], widths: Sequence[int]) -> tuple[int, int] | None:
    indices = scope.known(equation.invars[1])
    for column, axis in enumerate(axes if indices is not None else ()):
        size, entries = equation.invars[0].aval.shape[axis], np.ravel(np.asarray(indices)[..., column])
        wrong = (entries < 0) | (entries > size - widths[axis])
        if wrong.any():
            return _written(int(entries[np.argmax(wrong)]), size), axis
    return None


def _written(index: int, size: int) -> int:
    """Return an index as it was written: JAX has added the size to a negative one."""
    return index - size if index < 0 else index


_INDEX_OF: dict[str, Callable[[_Scope, Any], tuple[int, int] | None]] = {
    "dynamic_slice": _sliced, "gather": _gathered,
    **dict.fromkeys(["scatter", "scatter-add", "scatter_add", "scatter-mul", "scatter_mul"], _scattered),
}
_VERBS = {False: "reads", True: "sets"}
