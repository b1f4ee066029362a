"""Compiled functions that share machine code where their lowered programs have the same text.

1. A `Program` traces its function anew, so that it computes what the function computes now: helpers, globals and
   attributes of objects that the function reads are a part of what is traced, and no key has to guess them.
2. The text of the lowered program, constants included, with the structures and kinds of arguments and results decides
   which machine code can be shared. Compilation, the larger part of the time, happens once for each text in a process.
3. `shared_jit` does the same for functions of built models, whose arguments hold functions beside arrays.
"""

from __future__ import annotations

import functools
import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any

import equinox as eqx
import jax
import numpy as np

from lfm_ppl.utils import checks

_MOST_EXECUTABLES = 64
"""Executables that are kept for later programs of the same text; a `Program` keeps its own."""

_MOST_PROGRAMS = 16
"""Programs that a function decorated by `shared_jit` keeps, one for each model and each value of its settings."""

_executables: OrderedDict[Hashable, Any] = OrderedDict()
_tables: list[OrderedDict[Hashable, Any]] = []
_lock = threading.Lock()


class Program:
    """A function of pytrees of arrays, traced once and compiled once for each kind of arguments, as by `jax.jit`.

    Args:
        function: what `jax.jit` takes; its arguments are pytrees of arrays and numbers.

    Example:
        >>> import jax.numpy as jnp
        >>> float(Program(lambda x: 2.0 * x)(jnp.ones(())))
        2.0
    """

    def __init__(self, function: Callable) -> None:
        self._function = jax.jit(function, keep_unused=True)
        self._own: dict[Hashable, Any] = {}

    def __call__(self, *arguments: Any) -> Any:
        """Return the function's result; in compiled code the function becomes a part of the outer program."""
        leaves, structure = jax.tree.flatten(arguments)
        if checks.traced(leaves):
            return self._function(*arguments)
        return self._executable(arguments, leaves, structure)(*arguments)

    def compile(self, *arguments: Any) -> Callable:
        """Return the executable for arguments of this kind, which threads can call side by side."""
        return self._executable(arguments, *jax.tree.flatten(arguments))

    def _executable(self, arguments: tuple, leaves: list[Any], structure: Any) -> Callable:
        kinds = structure, _context(), *map(_kind, leaves)
        if kinds not in self._own:
            lowered = self._function.lower(*arguments)
            # A function that reads tracers has more inputs, and is a part of the outer program.
            self._own[kinds] = _compile(lowered, kinds) if _inputs(lowered) == len(leaves) else self._function
        return self._own[kinds]


def shared_jit(function: Callable) -> Callable:
    """Return a compiled function of pytrees, as `equinox.filter_jit`; programs of equal text share their machine code.

    Arrays are arguments of the program, everything else is a constant of it and must have a hash: a function is read
    once for each of these, and compiled once for each text.
    """
    inlined = eqx.filter_jit(function)
    programs: OrderedDict[Hashable, Program] = OrderedDict()
    _tables.append(programs)

    @functools.wraps(function)
    def call(*arguments: Any, **keywords: Any) -> Any:
        arrays, constants = eqx.partition((arguments, keywords), _is_array)
        if checks.traced(arrays):
            return inlined(*arguments, **keywords)

        def run(arrays: Any) -> Any:
            arguments, keywords = eqx.combine(arrays, constants)
            return function(*arguments, **keywords)

        leaves, structure = jax.tree.flatten(constants)
        key = structure, *((type(leaf), leaf) for leaf in leaves)
        return remembered(programs, key, lambda: Program(run), _MOST_PROGRAMS)(arrays)

    return call


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, (jax.Array, np.ndarray, np.generic))


def forget_executables() -> None:
    """Forget the executables that no `Program` of a caller holds, as `jax.clear_caches` does for JAX's own."""
    with _lock:
        for table in (_executables, *_tables):
            table.clear()


def _compile(lowered: Any, kinds: Hashable) -> Any:
    key = hashlib.sha256(lowered.as_text().encode()).digest(), lowered.out_tree, kinds
    return remembered(_executables, key, lowered.compile, _MOST_EXECUTABLES)


def remembered(table: OrderedDict[Hashable, Any], key: Hashable, make: Callable[[], Any], most: int) -> Any:
    """Return the entry of a table of the latest entries, made at the first call; threads may share the table."""
    with _lock:
        if key in table:
            table.move_to_end(key)
            return table[key]
    entry = make()  # compilation is not serial
    with _lock:
        table[key] = entry
        while len(table) > most:
            table.popitem(last=False)
    return entry


def _context() -> Hashable:
    """Return the settings of JAX that decide a program besides its arguments."""
    config: Any = jax.config
    return config.jax_enable_x64, config.jax_default_device, config.jax_default_matmul_precision


def _inputs(lowered: Any) -> int:
    """Return the number of inputs of a lowered program."""
    operations = lowered.compiler_ir().body.operations
    (main,) = (operation for operation in operations if operation.attributes["sym_name"].value == "main")
    return len(main.arguments)


def _kind(leaf: Any) -> Hashable:
    """Return shape, type and devices of an argument; the attribute of a JAX array is faster than `jax.typeof`."""
    return (leaf.aval, leaf.sharding) if isinstance(leaf, jax.Array) else jax.typeof(leaf)
