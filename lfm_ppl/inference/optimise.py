"""Minimisation of a smooth function that may be infinite somewhere: L-BFGS, then Newton."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

from lfm_ppl.inference.curvature import Curvature, decompose, finite_difference_hessian

_NEWTON_STEPS = 20
_NEGLIGIBLE = 1e-16
"""Decrease of minus a log density that ends the search: the step is 1e-8 standard deviations."""
_EXACT_NOISE, _DIFFERENCE_NOISE = 1e-12, 1e-7
"""Error of a Hessian scaled to a unit diagonal: differentiated twice, and by differences."""


@dataclass
class Objective:
    """A function of a vector with its derivatives, compiled once each, in NumPy's terms.

    Attributes:
        function: traceable function of a vector (d,), returning a scalar.
        forward_mode: take the gradient by forward mode, where reverse mode is slower or missing.
        exact_hessian: differentiate twice, instead of taking differences of the gradient.
        evaluations: number of values and gradients computed so far.
    """

    function: Callable[[jax.Array], jax.Array]
    forward_mode: bool = False
    exact_hessian: bool = True
    evaluations: int = field(default=0, init=False)

    def value(self, point: np.ndarray) -> float:
        """Return the value, infinite where it is not finite."""
        value, _ = self.value_and_gradient(point)  # one program to compile instead of two
        return value if np.isfinite(value) else np.inf

    def value_and_gradient(self, point: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the value and the gradient (d,)."""
        self.evaluations += 1
        value, gradient = self._value_and_gradient(jnp.asarray(point))
        return float(value), np.asarray(gradient, float)

    def curvature(self, point: np.ndarray) -> Curvature | None:
        """Return the curvature, None where no finite Hessian is to be had."""
        hessian, noise = None, _EXACT_NOISE
        if self.exact_hessian:
            hessian = np.asarray(self._hessian(jnp.asarray(point)), float)
        if hessian is None or not np.all(np.isfinite(hessian)):
            gradient = lambda x: self.value_and_gradient(x)[1]  # noqa: E731
            hessian, noise = finite_difference_hessian(gradient, point), _DIFFERENCE_NOISE
        return decompose(hessian, noise) if np.all(np.isfinite(hessian)) else None

    @cached_property
    def _value_and_gradient(self) -> Callable:
        if not self.forward_mode:
            return jax.jit(jax.value_and_grad(self.function))

        def twice(point: jax.Array) -> tuple[jax.Array, jax.Array]:
            value = self.function(point)
            return value, value

        return jax.jit(lambda point: jax.jacfwd(twice, has_aux=True)(point)[::-1])

    @cached_property
    def _hessian(self) -> Callable:
        inner = jax.jacfwd if self.forward_mode else jax.jacrev
        return jax.jit(jax.jacfwd(inner(self.function)))


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where the search ended.

    Attributes:
        point: shape (d,).
        value: of the objective.
        curvature: there; None where the Hessian is not finite.
        decrement: decrease that the quadratic model still promises.
        step: the Newton step still to be taken, shape (d,).
        gradient: shape (d,).
    """

    point: np.ndarray
    value: float
    curvature: Curvature | None
    decrement: float
    step: np.ndarray
    gradient: np.ndarray


def quasi_newton(objective: Objective, start: np.ndarray, max_iterations: int) -> np.ndarray:
    """Return the end point of L-BFGS from ``start`` (d,), where the objective is finite.

    Where the objective is not finite the line search sees a wall of moderate height, because
    interpolation through an enormous one would shorten the step to nothing.
    """
    best = (objective.value(start), start)
    highest = best[0]

    def guarded(point: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal best, highest
        value, gradient = objective.value_and_gradient(point)
        if not (np.isfinite(value) and np.all(np.isfinite(gradient))):
            return highest + 10.0 * (1.0 + abs(highest - best[0])), np.zeros_like(point)
        highest = max(highest, value)
        best = min(best, (value, point.copy()), key=lambda pair: pair[0])
        return value, gradient

    options = {"maxiter": max_iterations, "maxcor": 20, "ftol": 1e-14, "gtol": 1e-7}
    scipy.optimize.minimize(guarded, start, jac=True, method="L-BFGS-B", options=options)
    return best[1]


def newton(objective: Objective, point: np.ndarray) -> Minimum:
    """Return the minimum near ``point`` (d,), to rounding, by Newton's method with backtracking."""
    for remaining in reversed(range(_NEWTON_STEPS)):
        value, gradient = objective.value_and_gradient(point)
        curvature = objective.curvature(point) if np.all(np.isfinite(gradient)) else None
        if curvature is None:
            return Minimum(point, value, None, np.inf, np.zeros_like(point), gradient)
        step = curvature.newton_step(gradient)
        decrement = -0.5 * float(gradient @ step)
        taken = _backtrack(objective, point, step, value) if remaining else None
        if taken is None or decrement < _NEGLIGIBLE:
            break
        point = taken
    return Minimum(point, value, curvature, decrement, step, gradient)


def _backtrack(
    objective: Objective, point: np.ndarray, step: np.ndarray, value: float
) -> np.ndarray | None:
    rounding = 10 * np.finfo(float).eps * max(1.0, abs(value))
    for length in 0.5 ** np.arange(30):
        if objective.value(point + length * step) <= value + rounding:
            return point + length * step
    return None
