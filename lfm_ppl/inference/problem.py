"""Everything that a log density is made of besides its parameters, as one pytree.

1. `Partition` splits a pytree into arrays, which a program takes as arguments, and everything else, which is a part of
   the pytree's structure, so that `jax.jit` compiles another program for it.
2. `Problem` holds the data of a model, and a partition of its other arguments and of the time grids of its likelihoods.
3. `signature` compares pytrees by value.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.grid_layout import GridLayout
from lfm_ppl.filtering.iterated import Anchor
from lfm_ppl.likelihoods.handlers.binding import SiteTimes
from lfm_ppl.utils import checks

_ARRAY, _DATA = object(), object()
"""Mark the place of an array among the static leaves of a partition, and that of the data among the arguments."""


@dataclass(frozen=True)
class _Structure:
    """Everything of a pytree but its arrays, compared by the signatures of its leaves."""

    tree: Any
    leaves: tuple[Any, ...] = field(compare=False)
    signatures: tuple[Hashable, ...]


class Partition(eqx.Module):
    """A pytree some of whose arrays are its leaves; all other values are a part of its structure."""

    arrays: tuple[Any, ...]
    structure: _Structure = eqx.field(static=True)

    @classmethod
    def of(cls, arguments: Any, layouts: Any) -> Partition:
        """Return the pair of arguments of a model and layouts of time grids.

        Arrays of real numbers are leaves, and so are the index arrays of a layout. Integers among the arguments are
        static, since models use them as sizes and indices; an index array 0, 1, 2, ... is static, because a pass then
        reads its results without a gather.
        """
        is_leaf = [*map(_is_real, jax.tree.leaves(arguments)), *map(_is_index, jax.tree.leaves(layouts))]
        return cls._split((arguments, layouts), is_leaf)

    @classmethod
    def of_layout(cls, layout: GridLayout) -> Partition:
        """Return the layout of a time grid, whose arrays are leaves as in `of`."""
        return cls._split(layout, [*map(_is_index, jax.tree.leaves(layout))])

    @classmethod
    def of_constants(cls, value: Any) -> Partition:
        """Return a pytree all of whose leaves are static."""
        return cls._split(value, [False] * len(jax.tree.leaves(value)))

    @classmethod
    def _split(cls, value: Any, is_leaf: list[bool]) -> Partition:
        leaves, tree = jax.tree.flatten(value)
        pairs = list(zip(leaves, is_leaf, strict=True))
        static = tuple(_ARRAY if flag else leaf for leaf, flag in pairs)
        return cls(tuple(jnp.asarray(checks.unmask(leaf)) for leaf, flag in pairs if flag),
                   _Structure(tree, static, tuple(map(_leaf_signature, static))))

    @property
    def value(self) -> Any:
        """The pytree."""
        arrays = iter(self.arrays)
        return jax.tree.unflatten(self.structure.tree, [next(arrays) if leaf is _ARRAY else leaf
                                                        for leaf in self.structure.leaves])


class Problem(eqx.Module):
    """Everything that the log density of a model is made of besides its parameters.

    It is not the `FilterProblem` that a likelihood makes of its model inside the program.
    Its leaves are the arguments of compiled programs. A model may need the values of its times and arrays (a Python
    branch), or of its data, too; these are then a part of the structure.

    Attributes:
        data: the data, a pytree of arrays; None where they are among the arguments, or where there are none.
        inputs: the positional arguments of the model with the place of the data, its keyword arguments, and the times
            of each likelihood by name of its site.
        anchors: smoothed moments from which iterations of posterior linearisation start, by name of a site; other
            sites start from the filter's.
    """

    data: Any
    inputs: Partition
    anchors: dict[str, Anchor] = eqx.field(default_factory=dict)

    @classmethod
    def of_constants(cls, arguments: tuple, keywords: Mapping[str, Any], data: Any = None,
                     grids: Mapping[str, SiteTimes] | None = None) -> Problem:
        """Return a problem whose leaves are the data alone.

        Args:
            arguments: positional arguments of the model; where there are ``data``, they replace the last one.
            keywords: keyword arguments of the model.
            data: the data; None: no argument is data, or the model needs their values.
            grids: times of each likelihood by site, where they do not depend on the parameters.
        """
        arguments = arguments if data is None else (*arguments[:-1], _DATA)
        return cls(data, Partition.of_constants(((arguments, dict(keywords)), dict(grids or {}))))

    def with_grids(self, grids: Mapping[str, SiteTimes]) -> Problem:
        """Return the problem with other times of its likelihoods, as constants."""
        return Problem(self.data, Partition.of_constants((self.inputs.value[0], dict(grids))))

    def with_traced_inputs(self, grids: Mapping[str, SiteTimes]) -> Problem:
        """Return the problem with these times, all of whose arrays are leaves."""
        return Problem(self.data, Partition.of(self.inputs.value[0], dict(grids)))

    def with_data(self, data: Any) -> Problem:
        """Return the problem with other data, which must be an argument of its programs."""
        return Problem(data, self.inputs, self.anchors)

    def with_anchors(self, anchors: Mapping[str, Anchor]) -> Problem:
        """Return the problem with other smoothed moments to start from, which are leaves."""
        return Problem(self.data, self.inputs, dict(anchors))

    @property
    def kind(self) -> Hashable:
        """The structure, with shapes and types of the leaves: problems of one kind have the same programs."""
        leaves, structure = jax.tree.flatten(self)
        return structure, *((np.shape(leaf), str(leaf.dtype)) for leaf in leaves)

    @property
    def has_traced_inputs(self) -> bool:
        """Whether times and arrays are arguments of programs."""
        return bool(self.inputs.arrays)

    @property
    def observations(self) -> Any:
        """The data, wherever they are; None where no argument can be data."""
        if self.data is not None:
            return self.data
        arguments, _ = self.call()
        return arguments[-1] if arguments and is_numeric(arguments[-1]) else None

    @property
    def grids(self) -> dict[str, SiteTimes]:
        """The times of each likelihood by name of its site."""
        return self.inputs.value[1]

    def call(self) -> tuple[tuple, dict[str, Any]]:
        """Return the positional and the keyword arguments of the model."""
        arguments, keywords = self.inputs.value[0]
        return tuple(self.data if argument is _DATA else argument for argument in arguments), keywords


def is_numeric(value: Any) -> bool:
    """Return whether an argument may be data: a pytree whose leaves are all arrays of real numbers."""
    leaves = jax.tree.leaves(value)
    return bool(leaves) and all(isinstance(leaf, (np.ndarray, jax.Array)) and jnp.issubdtype(leaf.dtype, jnp.floating)
                                for leaf in leaves)


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
    if checks.traced(leaf):
        return _Identity(leaf)
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    if isinstance(leaf, (np.ndarray, np.generic, jax.Array)):
        return np.shape(leaf), str(np.asarray(leaf).dtype), np.asarray(leaf).tobytes()
    try:
        hash(leaf)
    except TypeError:
        return _Identity(leaf)
    return type(leaf), leaf


class _Identity:
    """Hash an object by its identity, and keep it alive so that its identity is not reused."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __eq__(self, candidate: object) -> bool:
        """Whether both refer to the same object."""
        return isinstance(candidate, _Identity) and candidate.value is self.value

    def __hash__(self) -> int:
        """Return the hash of the identity."""
        return id(self.value)


def _is_real(leaf: Any) -> bool:
    return isinstance(leaf, (np.ndarray, np.generic, jax.Array)) and bool(jnp.issubdtype(leaf.dtype, jnp.floating))


def _is_index(leaf: Any) -> bool:
    """Return whether a leaf of a layout is an array, but not 0, 1, 2, ..."""
    if not isinstance(leaf, (np.ndarray, jax.Array)):
        return False
    return not (jnp.issubdtype(leaf.dtype, jnp.integer) and np.array_equal(leaf, np.arange(np.size(leaf))))
