"""Constraints c(x, u, t) >= 0, given as bounds by name and as functions, in one function with labels.

1. `build_constraints` checks the bounds of states, forces and outputs, and the functions.
2. The constraints are, in this order: lower bounds ``quantity - lower``, upper bounds ``upper - quantity``, and the
   values of the functions. `Constraints` evaluates them at (x, u, t).
3. The values of the bounds may be traced. Which quantities are bounded is static.
4. `Constraints.impose_bounds` computes bounded quantities from bound and slack, so that no rounding violates a bound.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.user_functions import own_function, trace_function
from lfm_ppl.utils import checks


class Constraints(eqx.Module):
    """All constraints of a problem as one function c(x, u, t) -> (C,), feasible where >= 0.

    The values of the bounds are arguments of a compiled program; the indices of the bounded quantities are static.

    Attributes:
        observe: the observation function, whose outputs may be bounded.
        lower, upper: values of the bounds, in the order of ``lower_indices`` and ``upper_indices``.
        functions: constraint functions of (x, u, t).
        lower_indices, upper_indices: indices of the bounded quantities in (x, u, y).
        inputs: number of entries of (x, u), M + R.
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
        """Return the values (C,) of the constraints."""
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
        """Number of constraints C at a time."""
        return len(self.labels)

    def impose_bounds(self, quantities: jax.Array, slack: jax.Array) -> jax.Array:
        """Return quantities (..., M + R) = (x, u) with the bounded ones computed from their slacks (..., C).

        ``lower + s`` with ``s >= 0`` is never below ``lower`` in floating-point arithmetic.
        """
        lower_count = len(self.lower_indices)
        for i, index in enumerate(self.lower_indices):
            if index < self.inputs:
                quantities = quantities.at[..., index].set(self.lower[i] + slack[..., i])
        for i, index in enumerate(self.upper_indices):
            if index >= self.inputs:
                continue
            value = self.upper[i] - slack[..., lower_count + i]
            if index in self.lower_indices:
                # The smaller of two slacks has the smaller rounding error.
                j = self.lower_indices.index(index)
                is_upper_nearer = slack[..., lower_count + i] < slack[..., j]
                value = jnp.clip(jnp.where(is_upper_nearer, value, quantities[..., index]), self.lower[j],
                                 self.upper[i])
            quantities = quantities.at[..., index].set(value)
        return quantities


def build_constraints(model: LatentForceModel, lower: Mapping[str, Any] | None, upper: Mapping[str, Any] | None,
                      functions: Any) -> Constraints:
    """Check bounds and constraint functions, and combine them into one function.

    Args:
        model: the latent force model.
        lower: name of a state, force or output -> its lower bound.
        upper: the same for upper bounds.
        functions: one function or several, c(x, u, t) -> a scalar or a vector, feasible where >= 0.

    Raises:
        ValueError, TypeError: an unknown name, a bound that is not one finite number, bounds that contradict each
            other, an initial state without variance outside of its bounds.
    """
    names = (*model.state_names, *model.force_names, *model.output_names)
    lower, upper = (_checked_bounds(kind, bounds, names) for kind, bounds in (("lower", lower), ("upper", upper)))
    for name in lower.keys() & upper.keys():
        low, high = (checks.concrete(bounds[name]) for bounds in (lower, upper))
        if low is not None and high is not None and low >= high:
            raise ValueError(f"the bounds of {name!r} leave nothing between them: lower={low:g}, upper={high:g}. The "
                             "lower bound must be below the upper one; for a known quantity give a precise "
                             "observation.")
    _check_initial_state(model, lower, upper)
    if callable(functions):
        functions = (functions,)
    functions = tuple(own_function(function) if callable(function) and function.__hash__ is None else function
                      for function in functions or ())
    # Labels lack the values of the bounds, which may be traced.
    labels = [*(f"{name} >= lower" for name in lower), *(f"{name} <= upper" for name in upper)]
    for number, function in enumerate(functions):
        size = _output_size(model, number, function)
        name = getattr(function, "__name__", "<lambda>")
        if name == "<lambda>" or any(label.startswith((f"{name} ", f"{name}[")) for label in labels):
            name = f"constraints[{number}]"
        labels += [f"{name} >= 0"] if size == 1 else [f"{name}[{i}] >= 0" for i in range(size)]
    lower_values, upper_values = (jnp.asarray([jnp.asarray(bound, float) for bound in bounds.values()], float)
                                  for bounds in (lower, upper))
    lower_indices, upper_indices = (tuple(names.index(name) for name in bounds) for bounds in (lower, upper))
    return Constraints(model.observation.function, lower_values, upper_values, functions, lower_indices,
                       upper_indices, len(model.state_names) + len(model.force_names), tuple(labels))


def _checked_bounds(kind: str, bounds: Mapping[str, Any] | None, names: Sequence[str]) -> dict[str, Any]:
    """Check the names and values of ``kind`` ("lower" or "upper") bounds."""
    if bounds is None:
        return {}
    if not isinstance(bounds, Mapping):
        raise TypeError(f'{kind} must map names to bounds, for example {{"{names[0]}": 0.0}}; got '
                        f"{type(bounds).__name__}.")
    for name, bound in bounds.items():
        checks.one_of(f"name in {kind}", name, tuple(dict.fromkeys(names)))
        if np.ndim(bound):
            raise ValueError(f"{kind}[{name!r}] must be one number, got shape {np.shape(bound)}. For a bound that "
                             "changes with time give a function: constraints=lambda x, u, t: x[0] - bound(t).")
        checks.finite(f"{kind}[{name!r}]", bound, "Leave a quantity without a bound out.")
    return dict(bounds)


def _check_initial_state(model: LatentForceModel, lower: dict[str, Any], upper: dict[str, Any]) -> None:
    """Raise ValueError if an initial state without variance lies outside of its bounds."""
    prior = model.initial_state
    mean, covariance = checks.concrete(prior.mean), checks.concrete(prior.covariance)
    if mean is None or covariance is None:
        return
    for index, name in enumerate(model.state_names):
        if covariance[index, index] > 0:
            continue
        for kind, bounds, sign in (("below its lower", lower, -1.0), ("above its upper", upper, 1.0)):
            bound = checks.concrete(bounds.get(name, np.nan))
            if bound is not None and sign * (mean[index] - bound) > 0:
                raise ValueError(f"the initial state {name!r} is known to be {mean[index]:g}, {kind} bound {bound:g}. "
                                 "Change the bound or initial_state.mean, or give the initial state a variance.")


def _output_size(model: LatentForceModel, number: int, function: Any) -> int:
    """Return the number of constraints that a function returns."""
    if not callable(function):
        raise TypeError("constraints must be a function c(x, u, t), or several, each feasible where >= 0; entry "
                        f"{number} is {type(function).__name__}. A number belongs to lower or upper.")
    u = jax.ShapeDtypeStruct((len(model.force_names),), jnp.result_type(float))
    traced = trace_function(f"constraints[{number}]", "c(x, u, t)", function, model.initial_state.mean, u,
                            jnp.zeros(()))
    traced.check_indices(("x", "u"))
    shape = getattr(traced.shape, "shape", None)
    if shape is None or len(shape) > 1:
        raise ValueError(f"constraints[{number}] must return a number or a vector, got "
                         f"{shape if shape is not None else type(traced.shape).__name__}.")
    return int(np.prod(shape))
