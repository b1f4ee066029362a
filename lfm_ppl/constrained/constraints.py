"""Constraints c(x, u, t) >= 0: bounds by name and functions, as one function with its labels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.user_functions import trace


class Constraints(eqx.Module):
    """All constraints of a problem as one function c(x, u, t) -> (C,), feasible where >= 0.

    The values of the bounds are arguments of a compiled program; which quantities they bound is not.

    Attributes:
        observe: the observation function, whose outputs may be bounded.
        lower, upper: values of the bounds, in the order of ``lower_indices`` and ``upper_indices``.
        functions: further constraints.
        lower_indices, upper_indices: of the bounded quantities in (x, u, y).
        inputs: M + R, the number of entries of (x, u).
        labels: C labels such as "factor >= lower".
    """

    observe: Callable[..., jax.Array]
    lower: jax.Array
    upper: jax.Array
    functions: tuple[Callable[..., jax.Array], ...]
    lower_indices: tuple[int, ...] = eqx.field(static=True)
    upper_indices: tuple[int, ...] = eqx.field(static=True)
    inputs: int = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, x: jax.Array, u: jax.Array, t: jax.Array) -> jax.Array:
        """Return (C,), how far each constraint is from its bound."""
        quantities = [*(x[i] for i in range(x.shape[0])), *(u[i] for i in range(u.shape[0]))]
        if any(index >= self.inputs for index in (*self.lower_indices, *self.upper_indices)):
            y = jnp.asarray(self.observe(x, u, t), float)
            quantities += [y[i] for i in range(y.shape[0])]
        margins = [quantities[index] - self.lower[i] for i, index in enumerate(self.lower_indices)]
        margins += [self.upper[i] - quantities[index] for i, index in enumerate(self.upper_indices)]
        stacked = jnp.stack(margins) if margins else jnp.zeros(0)
        return jnp.concatenate([stacked, *(jnp.atleast_1d(jnp.asarray(f(x, u, t), float)) for f in self.functions)])

    @property
    def count(self) -> int:
        """C, the number of constraints at a time."""
        return len(self.labels)

    def respected(self, quantities: jax.Array, slack: jax.Array) -> jax.Array:
        """Return quantities (..., M + R) = (x, u) with the bounded ones where their slacks (..., C) put them.

        ``lower + s`` with ``s >= 0`` is never below ``lower``, whatever the rounding.
        """
        below = len(self.lower_indices)
        for i, index in enumerate(self.lower_indices):
            if index < self.inputs:
                quantities = quantities.at[..., index].set(self.lower[i] + slack[..., i])
        for i, index in enumerate(self.upper_indices):
            if index >= self.inputs:
                continue
            value = self.upper[i] - slack[..., below + i]
            if index in self.lower_indices:
                # Of two bounds the nearer one knows the distance better.
                j = self.lower_indices.index(index)
                nearer = slack[..., below + i] < slack[..., j]
                value = jnp.clip(jnp.where(nearer, value, quantities[..., index]), self.lower[j], self.upper[i])
            quantities = quantities.at[..., index].set(value)
        return quantities


def build_constraints(model: LatentForceModel, lower: Mapping[str, Any] | None, upper: Mapping[str, Any] | None,
                      functions: Any) -> Constraints:
    """Check what a user gives as constraints and put it into one function.

    Args:
        model: the latent force model.
        lower: name of a state, force or output -> its lower bound.
        upper: the same for upper bounds.
        functions: one function or several, c(x, u, t) -> a scalar or a vector, feasible where >= 0.

    Raises:
        ValueError, TypeError: an unknown name, a bound that is not one finite number, bounds that contradict each
            other, a known initial state outside of its bounds.
    """
    names = (*model.state_names, *model.force_names, *model.output_names)
    bounds = [_checked(kind, given, names) for kind, given in (("lower", lower), ("upper", upper))]
    for name in bounds[0].keys() & bounds[1].keys():
        low, high = (checks.concrete(bound[name]) for bound in bounds)
        if low is not None and high is not None and low >= high:
            raise ValueError(f"the bounds of {name!r} leave nothing between them: lower={low:g}, upper={high:g}. The "
                             "lower bound must be below the upper one; for a known quantity give a precise "
                             "observation.")
    _check_initial_state(model, *bounds)
    if callable(functions):
        functions = (functions,)
    functions = tuple(functions or ())
    # Without the bounds' values, which are arguments of a compiled program.
    labels = [*(f"{name} >= lower" for name in bounds[0]), *(f"{name} <= upper" for name in bounds[1])]
    for number, function in enumerate(functions):
        size = _size(model, number, function)
        name = getattr(function, "__name__", "<lambda>")
        if name == "<lambda>" or any(label.startswith((f"{name} ", f"{name}[")) for label in labels):
            name = f"constraints[{number}]"
        labels += [f"{name} >= 0"] if size == 1 else [f"{name}[{i}] >= 0" for i in range(size)]
    values = [jnp.asarray([jnp.asarray(bound, float) for bound in given.values()], float) for given in bounds]
    below, above = (tuple(names.index(name) for name in given) for given in bounds)
    return Constraints(model.observation.function, values[0], values[1], functions, below, above,
                       len(model.state_names) + len(model.force_names), tuple(labels))


def _checked(kind: str, given: Mapping[str, Any] | None, names: Sequence[str]) -> dict[str, Any]:
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise TypeError(f'{kind} must map names to bounds, for example {{"{names[0]}": 0.0}}; got '
                        f"{type(given).__name__}.")
    for name, bound in given.items():
        checks.one_of(f"name in {kind}", name, tuple(dict.fromkeys(names)))
        if np.ndim(bound):
            raise ValueError(f"{kind}[{name!r}] must be one number, got shape {np.shape(bound)}. For a bound that "
                             "changes with time give a function: constraints=lambda x, u, t: x[0] - bound(t).")
        checks.finite(f"{kind}[{name!r}]", bound, "Leave a quantity without a bound out.")
    return dict(given)


def _check_initial_state(model: LatentForceModel, lower: dict[str, Any], upper: dict[str, Any]) -> None:
    """Raise where the initial state is known and lies outside of its bounds."""
    prior = model.initial_state
    mean, covariance = checks.concrete(prior.mean), checks.concrete(prior.covariance)
    if mean is None or covariance is None:
        return
    for index, name in enumerate(model.state_names):
        if covariance[index, index] > 0:
            continue
        for kind, given, sign in (("below its lower", lower, -1.0), ("above its upper", upper, 1.0)):
            bound = checks.concrete(given.get(name, np.nan))
            if bound is not None and sign * (mean[index] - bound) > 0:
                raise ValueError(f"the initial state {name!r} is known to be {mean[index]:g}, {kind} bound {bound:g}. "
                                 "Change the bound or initial_state.mean, or give the state a variance there.")


def _size(model: LatentForceModel, number: int, function: Any) -> int:
    if not callable(function):
        raise TypeError("constraints must be a function c(x, u, t), or several, each feasible where >= 0; entry "
                        f"{number} is {type(function).__name__}. A number belongs to lower or upper.")
    u = jax.ShapeDtypeStruct((len(model.force_names),), jnp.result_type(float))
    traced = trace(f"constraints[{number}]", "c(x, u, t)", function, model.initial_state.mean, u, jnp.zeros(()))
    traced.check_indices(("x", "u"))
    shape = getattr(traced.shape, "shape", None)
    if shape is None or len(shape) > 1:
        raise ValueError(f"constraints[{number}] must return a number or a vector, got "
                         f"{shape if shape is not None else type(traced.shape).__name__}.")
    return int(np.prod(shape))
