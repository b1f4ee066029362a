"""Fix parameters of a NumPyro model: a whole site, or single elements of a vector site.

NumPyro conditions whole sites. An element of a vector site needs more: the remaining elements must
be sampled from their distribution given the fixed one, in a space of fewer dimensions. Here the
site keeps its name and its shape, so that coordinates and predictive draws work as before, and its
distribution becomes p(theta_free | theta_fixed) on the affine set where the fixed elements have
their values. The bijection onto that set has as many unconstrained coordinates as there are free
elements, so a sampler never sees the fixed ones.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import constraints
from numpyro.distributions.transforms import Transform, biject_to
from numpyro.primitives import Messenger

from lfm_ppl import checks

_ELEMENT = re.compile(r"^(?P<site>[^\[\]]+)\[(?P<label>[^\[\]]+)\]$")


class fix(Messenger):  # noqa: N801 (an effect handler, named as NumPyro names its handlers)
    """Effect handler that fixes parameters.

    Args:
        fn: the NumPyro model.
        fixed: name -> value. ``decay`` fixes the whole site (a number is repeated to its shape);
            ``decay[CDKN1A]`` or ``decay[2]`` fixes one element of a vector site, by label or by
            index from zero.
        labels: the names of the elements of every vector site of this length, as a rule the names
            of the outputs.

    Raises:
        ValueError: when the model runs, for a site, a label or an index that does not exist (with
            the nearest names), a value outside the support, and a site whose elements cannot be
            fixed one by one.

    Example:
        >>> import jax, numpyro
        >>> def model():
        ...     return numpyro.sample("decay", dist.LogNormal(0.0, 1.0).expand([3]).to_event(1))
        >>> fixed = fix(model, {"decay[b]": 0.8}, labels=("a", "b", "c"))
        >>> decay = numpyro.handlers.seed(fixed, jax.random.key(0))()
        >>> float(decay[1].round(3))
        0.8
    """

    def __init__(
        self,
        fn: Callable[..., Any] | None = None,
        fixed: Mapping[str, Any] | None = None,
        labels: Sequence[str] = (),
    ) -> None:
        self.whole, self.elements = _split(fixed or {})
        self.labels = tuple(labels)
        self.sites: dict[str, bool] = {}
        super().__init__(fn)

    def __enter__(self) -> fix:
        """Start a run of the model."""
        self.sites = {}
        super().__enter__()
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        """End the run; a name that the model never sampled is an error."""
        super().__exit__(kind, error, trace)
        if kind is None:
            free = [name for name, observed in self.sites.items() if not observed]
            for name in (*self.whole, *self.elements):
                if name not in free:
                    raise ValueError(checks.unknown("parameter to fix", name, free))

    def process_message(self, msg: dict[str, Any]) -> None:
        """Condition a site that is fixed as a whole, pin the elements of the others."""
        if msg["type"] != "sample":
            return
        name = msg["name"]
        self.sites[name] = msg["is_observed"]
        if msg["is_observed"]:
            return
        if name in self.whole:
            shape = msg["fn"].batch_shape + msg["fn"].event_shape
            value = _broadcast(name, self.whole[name], shape)
            _inside(name, msg["fn"].support, value)
            msg["value"] = value
            msg["is_observed"] = True
        elif name in self.elements:
            msg["fn"] = pin(name, msg["fn"], self.elements[name], self.labels)


def pin(
    name: str, base: dist.Distribution, elements: Mapping[str, float], labels: Sequence[str] = ()
) -> Pinned:
    """Return ``base`` given that some of its elements have known values.

    Args:
        name: what to call the site in an error.
        base: a distribution over a vector, as batch or as event, whose support is elementwise.
        elements: label or index (from zero, as text) -> value.
        labels: the names of the elements, used where their number is that of the elements.

    Returns:
        The conditional distribution, up to its constant.

    Raises:
        ValueError: see :class:`fix`.
    """
    shape = base.batch_shape + base.event_shape
    if len(shape) != 1:
        raise ValueError(
            f"{name} has shape {shape}; single elements can be fixed of a vector only. "
            f"Fix it as a whole, as in {name}=VALUE."
        )
    _elementwise(name, base.support)
    known = [str(label) for label in labels] if len(labels) == shape[0] else []
    known = known or [str(index) for index in range(shape[0])]
    indices = {_index(name, label, known): value for label, value in elements.items()}
    order = sorted(indices)
    pinned = Pinned(base, tuple(order), jnp.array([float(indices[i]) for i in order]))
    _inside(name, base.support, pinned.insert(base.support.feasible_like(jnp.zeros(shape))))
    return pinned


class Pinned(dist.Distribution):
    """A distribution over a vector, conditioned on the values of some of its elements.

    The log density is the joint one, log p(theta_free, theta_fixed), which equals the conditional
    log p(theta_free | theta_fixed) up to a constant in theta_free.

    Args:
        base: distribution over a vector, as batch or as event, of elementwise support.
        indices: the fixed elements.
        values: their values, shape (len(indices),).
    """

    pytree_data_fields = ("base", "values")
    pytree_aux_fields = ("indices",)

    def __init__(self, base: dist.Distribution, indices: tuple[int, ...], values: Any) -> None:
        self.base = base
        self.indices = indices
        self.values = values
        super().__init__(base.batch_shape, base.event_shape)

    @property
    def support(self) -> constraints.Constraint:
        """The part of the base support where the fixed elements have their values."""
        each = _elementwise("a pinned site", self.base.support)
        return _Pinned(each, self.indices, self.values, self.shape()[0], self.event_dim)

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
    """The vectors whose elements satisfy ``each`` and whose fixed elements have their values.

    The vector is one event (``event_dim`` 1) or a batch of scalar ones (0), as inside a plate.
    """

    def __init__(
        self, each: Any, indices: tuple[int, ...], values: Any, size: int, event_dim: int
    ) -> None:
        self.each, self.indices, self.values = each, indices, values
        self.size, self.event_dim = size, event_dim

    def insert(self, vector: Any) -> Any:
        """Return ``vector`` (..., n) with the fixed elements in place."""
        return vector.at[..., jnp.array(self.indices)].set(self.values)

    def __call__(self, x: Any) -> Any:
        valid = self.each(x) & (x == self.insert(jnp.asarray(x)))
        return jnp.all(valid, axis=-1) if self.event_dim else valid

    def feasible_like(self, prototype: Any) -> Any:
        """Return a vector of the shape of ``prototype`` that satisfies the constraint."""
        return self.insert(jnp.asarray(self.each.feasible_like(prototype)))

    def tree_flatten(self) -> Any:
        """Split into arrays and static fields."""
        static = {"indices": self.indices, "size": self.size, "event_dim": self.event_dim}
        return (self.each, self.values), (("each", "values"), static)


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
        return self.constraint.insert(biject_to(self.constraint.each)(self._full(x)))

    def _inverse(self, y: jax.Array) -> jax.Array:
        return biject_to(self.constraint.each)._inverse(y)[..., self._free()]

    def log_abs_det_jacobian(
        self, x: jax.Array, y: jax.Array, intermediates: Any = None
    ) -> jax.Array:
        """Return the log derivatives of the free elements: summed for an event, else one by one."""
        full = self._full(x)
        transform = biject_to(self.constraint.each)
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


def _elementwise(name: str, support: Any) -> Any:
    """Return the constraint on one element, for a constraint that treats elements alike."""
    while isinstance(support, type(constraints.independent(constraints.real, 1))):
        support = support.base_constraint
    if support.event_dim != 0:
        raise ValueError(
            f"the elements of {name} depend on each other, its support is {support!r}; they cannot "
            f"be fixed one by one. Fix it as a whole, as in {name}=VALUE."
        )
    return support


def _split(fixed: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, dict[str, float]]]:
    """Sort ``fixed`` into whole sites and single elements."""
    whole: dict[str, Any] = {}
    elements: dict[str, dict[str, float]] = {}
    for name, value in fixed.items():
        match = _ELEMENT.match(name)
        if match:
            elements.setdefault(match["site"], {})[match["label"].strip()] = value
        else:
            whole[name] = value
    both = sorted(set(whole) & set(elements))
    if both:
        raise ValueError(f"{both[0]} is fixed as a whole and by element; give one of the two.")
    return whole, elements


def _index(name: str, label: str, known: list[str]) -> int:
    if label in known:
        return known.index(label)
    if re.fullmatch(r"\d+", label) and int(label) < len(known):
        return int(label)
    raise ValueError(checks.unknown(f"element of {name}", label, known))


def _broadcast(name: str, value: Any, shape: tuple[int, ...]) -> jax.Array:
    value = jnp.asarray(value, dtype=float)
    if value.shape != shape and value.size not in (1, math.prod(shape)):
        raise ValueError(
            f"{name} has shape {shape}, got a value of shape {value.shape} to fix it at."
        )
    return jnp.broadcast_to(value, shape) if value.size == 1 else value.reshape(shape)


def _inside(name: str, support: Any, value: jax.Array) -> None:
    """Raise unless ``value`` lies in ``support``; traced bounds are left to the log density."""
    inside = checks.concrete(support(value))
    if inside is not None and not np.all(inside):
        raise ValueError(
            f"{name} cannot be fixed at {np.asarray(value)}: its support is {support!r}."
        )
