"""The arguments of a model as arguments of compiled programs, and signatures that compare what decides a program.

1. `ModelInputs` splits times, keyword arguments and time grids into arrays, which a program takes as arguments, and
   everything else, which is a part of the pytree's structure, so that `jax.jit` compiles another program for it.
2. `ModelArguments` adds the data.
3. `signature` compares pytrees by value.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.utils import checks

_ARRAY = object()
"""Marks the place of an array among the static leaves."""


@dataclass(frozen=True)
class _Structure:
    """Everything of a pytree but its arrays, compared by the signatures of its leaves."""

    tree: Any
    leaves: tuple[Any, ...] = field(compare=False)
    signatures: tuple[Hashable, ...]


class ModelInputs(eqx.Module):
    """Times, keyword arguments and time grids of a model; its leaves are their arrays.

    Arrays of real numbers are leaves, and so are the index arrays of a time grid. Integers among the arguments of a
    model are static, since models use them as sizes and indices; an index array 0, 1, 2, ... is static, because a pass
    then reads its results without a gather.
    """

    arrays: tuple[Any, ...]
    structure: _Structure = eqx.field(static=True)

    @classmethod
    def of(cls, arguments: Any, layouts: Any) -> ModelInputs:
        """Return the inputs of concrete ``arguments`` and ``layouts``, any pytrees."""
        is_array = [_is_real(leaf) for leaf in jax.tree.leaves(arguments)]
        is_array += [isinstance(leaf, (np.ndarray, jax.Array)) and not _is_range(leaf)
                     for leaf in jax.tree.leaves(layouts)]
        leaves, tree = jax.tree.flatten((arguments, layouts))
        pairs = list(zip(leaves, is_array, strict=True))
        static = tuple(_ARRAY if flag else leaf for leaf, flag in pairs)
        return cls(tuple(jnp.asarray(checks.unmask(leaf)) for leaf, flag in pairs if flag),
                   _Structure(tree, static, tuple(map(_leaf_signature, static))))

    @property
    def value(self) -> tuple[Any, Any]:
        """The arguments and the layouts."""
        arrays = iter(self.arrays)
        return jax.tree.unflatten(self.structure.tree, [next(arrays) if leaf is _ARRAY else leaf
                                                        for leaf in self.structure.leaves])


class ModelArguments(NamedTuple):
    """Arguments of a compiled program of a model, besides its parameters.

    Attributes:
        data: the data.
        inputs: times, keyword arguments and time grids.
    """

    data: Any
    inputs: ModelInputs


def shapes(tree: Any) -> Any:
    """Return the shapes and dtypes of a pytree of arrays."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), tree)


def signature(value: Any) -> Hashable:
    """Return a hashable object that is equal for equal pytrees; None for a pytree with tracers.

    Arrays are compared by shape, dtype and bytes, objects without a hash by identity.
    """
    leaves, structure = jax.tree.flatten(value)
    if checks.traced(leaves):
        return None
    return structure, tuple(_leaf_signature(leaf) for leaf in leaves)


def _leaf_signature(leaf: Any) -> Hashable:
    if isinstance(leaf, (np.ndarray, np.generic, jax.Array)):
        return np.shape(leaf), str(np.asarray(leaf).dtype), np.asarray(leaf).tobytes()
    try:
        hash(leaf)
    except TypeError:
        return Identity(leaf)
    return type(leaf), leaf


class Identity:
    """Hash an object by its identity, and keep it alive so that its identity is not reused."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __eq__(self, candidate: object) -> bool:
        """Whether both refer to the same object."""
        return isinstance(candidate, Identity) and candidate.value is self.value

    def __hash__(self) -> int:
        """Return the hash of the identity."""
        return id(self.value)


def _is_real(leaf: Any) -> bool:
    return isinstance(leaf, (np.ndarray, np.generic, jax.Array)) and bool(jnp.issubdtype(leaf.dtype, jnp.floating))


def _is_range(leaf: Any) -> bool:
    return bool(jnp.issubdtype(leaf.dtype, jnp.integer)) and np.array_equal(leaf, np.arange(np.size(leaf)))
