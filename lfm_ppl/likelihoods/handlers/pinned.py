"""A distribution over a vector, given the values of some of its elements.

1. NumPyro conditions whole sites. Here the distribution is restricted to the affine set of vectors with the given
   elements; its density is the base density.
2. The bijection onto this set has one unconstrained coordinate per free element, so that samplers never see fixed ones.
3. Only supports that treat elements separately are possible.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import constraints
from numpyro.distributions.transforms import Transform, biject_to


class Pinned(dist.Distribution):
    """A distribution over a vector, conditioned on the values of some of its elements.

    The log density is the joint one, log p(theta_free, theta_fixed), which equals the conditional
    log p(theta_free | theta_fixed) up to a constant in theta_free.

    Args:
        base: distribution over a vector, as batch or as event, of elementwise support.
        indices: the fixed elements.
        values: their values, shape (len(indices),).
        labels: what the fixed elements are called; by default their indices.
    """

    pytree_data_fields = ("base", "values")
    pytree_aux_fields = ("indices", "labels")

    def __init__(self, base: dist.Distribution, indices: tuple[int, ...], values: Any,
                 labels: tuple[str, ...] = ()) -> None:
        self.base = base
        self.indices = indices
        self.values = values
        self.labels = labels or tuple(str(index) for index in indices)
        super().__init__(base.batch_shape, base.event_shape)

    @property
    def support(self) -> constraints.Constraint:
        """The part of the base support where the fixed elements have their values."""
        entry_constraint = elementwise("a pinned site", self.base.support)
        return _Pinned(entry_constraint, self.indices, self.values, self.shape()[0], self.event_dim)

    def insert(self, vector: jax.Array) -> jax.Array:
        """Return ``vector`` (..., n) with the fixed elements in place."""
        return vector.at[..., jnp.array(self.indices)].set(self.values)

    def sample(self, key: jax.Array, sample_shape: tuple[int, ...] = ()) -> jax.Array:
        """Draw from the base and put the fixed elements in place.

        Exact where the elements are independent under the base.
        """
        return self.insert(self.base.sample(key, sample_shape))

    def log_prob(self, value: jax.Array, intermediates: Any = None) -> jax.Array:
        """Return the joint log density, fixed elements included."""
        return self.base.log_prob(value)


class _Pinned(constraints.Constraint):
    """The vectors whose elements satisfy ``entry_constraint`` and whose fixed elements have their values.

    The vector is one event (``event_dim`` 1) or a batch of scalar ones (0), as inside a plate.
    """

    def __init__(
        self, entry_constraint: Any, indices: tuple[int, ...], values: Any, size: int, event_dim: int
    ) -> None:
        self.entry_constraint, self.indices, self.values = entry_constraint, indices, values
        self.size, self.event_dim = size, event_dim

    def insert(self, vector: Any) -> Any:
        """Return ``vector`` (..., n) with the fixed elements in place."""
        return vector.at[..., jnp.array(self.indices)].set(self.values)

    def __call__(self, x: Any) -> Any:
        valid = self.entry_constraint(x) & (x == self.insert(jnp.asarray(x)))
        return jnp.all(valid, axis=-1) if self.event_dim else valid

    def feasible_like(self, prototype: Any) -> Any:
        """Return a vector of the shape of ``prototype`` that satisfies the constraint."""
        return self.insert(jnp.asarray(self.entry_constraint.feasible_like(prototype)))

    def tree_flatten(self) -> Any:
        """Split into arrays and static fields."""
        static = {"indices": self.indices, "size": self.size, "event_dim": self.event_dim}
        return (self.entry_constraint, self.values), (("entry_constraint", "values"), static)


class _PinnedTransform(Transform):
    """R^(n - k) to the vectors of n elements of which k are fixed, element by element."""

    domain = constraints.real_vector

    def __init__(self, constraint: _Pinned) -> None:
        self.constraint = constraint

    @property
    def codomain(self) -> constraints.Constraint:
        """The vectors with the fixed elements in place."""
        return self.constraint

    def _free(self) -> np.ndarray:
        return np.setdiff1d(np.arange(self.constraint.size), self.constraint.indices)

    def _full(self, x: jax.Array) -> jax.Array:
        shape = (*jnp.shape(x)[:-1], self.constraint.size)
        return jnp.zeros(shape, jnp.result_type(x)).at[..., self._free()].set(x)

    def __call__(self, x: jax.Array) -> jax.Array:
        return self.constraint.insert(biject_to(self.constraint.entry_constraint)(self._full(x)))

    def _inverse(self, y: jax.Array) -> jax.Array:
        return biject_to(self.constraint.entry_constraint)._inverse(y)[..., self._free()]

    def log_abs_det_jacobian(
        self, x: jax.Array, y: jax.Array, intermediates: Any = None
    ) -> jax.Array:
        """Return the log derivatives of the free elements: summed for an event, else one by one."""
        full = self._full(x)
        transform = biject_to(self.constraint.entry_constraint)
        log_derivatives = transform.log_abs_det_jacobian(full, transform(full))
        free = jnp.zeros(self.constraint.size).at[self._free()].set(1.0)
        log_derivatives = jnp.where(free > 0, log_derivatives, 0.0)
        return jnp.sum(log_derivatives, axis=-1) if self.constraint.event_dim else log_derivatives

    def forward_shape(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Return the shape of the vectors for unconstrained coordinates of ``shape``."""
        return (*shape[:-1], shape[-1] + len(self.constraint.indices))

    def inverse_shape(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Return the shape of the unconstrained coordinates for vectors of ``shape``."""
        return (*shape[:-1], shape[-1] - len(self.constraint.indices))

    def tree_flatten(self) -> Any:
        """Split into arrays and static fields."""
        return (self.constraint,), (("constraint",), {})


@biject_to.register(_Pinned)
def _biject_to_pinned(constraint: _Pinned) -> Transform:
    return _PinnedTransform(constraint)


def elementwise(name: str, support: Any) -> Any:
    """Return the constraint on one element, for a support that treats its elements alike.

    Args:
        name: what to call the site in an error.
        support: the support of a distribution over a vector.

    Raises:
        ValueError: if the elements depend on each other, as on a simplex.
    """
    while isinstance(support, type(constraints.independent(constraints.real, 1))):
        support = support.base_constraint
    if support.event_dim != 0:
        raise ValueError(
            f"the elements of {name} depend on each other, its support is {support!r}; they cannot "
            f"be fixed one by one. Fix it as a whole, as in {name}=VALUE."
        )
    return support
