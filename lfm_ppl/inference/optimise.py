"""Minimisation of a smooth function that may be infinite at some points.

1. L-BFGS from a starting point; the lowest point of its path is kept (`quasi_newton`).
2. Newton's method with backtracking, on the scaled Hessian without its flat and negative directions, down to rounding
   (`newton`).

Source: Nocedal and Wright (2006), Numerical Optimization, chapters 3 and 7.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

from lfm_ppl.inference.curvature import Curvature, decompose, finite_difference_hessian

_NEWTON_STEPS = 20
_NEGLIGIBLE = 1e-16
"""Predicted decrease of minus a log density that ends the search: a step of 1e-8 standard deviations."""
_STRICT = {"maxcor": 20, "ftol": 1e-14, "gtol": 1e-7}
_EXACT_NOISE, _DIFFERENCE_NOISE = 1e-12, 1e-7
"""Error of a Hessian scaled to a unit diagonal: by automatic differentiation, and by finite differences."""


def value_and_gradient(function: Callable[..., jax.Array], forward_mode: bool) -> Callable[..., tuple]:
    """Return the function from z and further arguments to the value and the gradient with respect to z.

    A function without a reverse mode is differentiated in forward mode.
    """

    def value_with_copy(*arguments: Any) -> tuple[jax.Array, jax.Array]:
        value = function(*arguments)
        return value, value

    def forward(*arguments: Any) -> tuple[jax.Array, jax.Array]:
        return jax.jacfwd(value_with_copy, has_aux=True)(*arguments)[::-1]

    def reverse(*arguments: Any) -> tuple[jax.Array, jax.Array]:
        try:
            return jax.value_and_grad(function)(*arguments)
        except ValueError as error:
            # A `jax.lax.while_loop` of the user; JAX raises this when it traces the program.
            if "Reverse-mode differentiation does not work" not in str(error):
                raise
            return forward(*arguments)

    return forward if forward_mode else reverse


@dataclass
class Objective:
    """A function of a vector with its compiled derivatives, from and to NumPy arrays.

    Attributes:
        program: from a vector (d,) to the value and the gradient (d,).
        hessian: from a vector (d,) to the Hessian (d, d); None: differences of the gradient.
        evaluations: number of computed values with gradients.
    """

    program: Callable[[Any], tuple[Any, Any]]
    hessian: Callable[[Any], Any] | None = None
    evaluations: int = field(default=0, init=False)

    @classmethod
    def of(cls, function: Callable[[jax.Array], jax.Array]) -> Objective:
        """Return the objective of a traceable function of a vector (d,), with derivatives in reverse mode."""
        return cls(jax.jit(jax.value_and_grad(function)), jax.jit(jax.jacfwd(jax.jacrev(function))))

    def value(self, point: np.ndarray) -> float:
        """Return the value, infinite where it is not finite."""
        value, _ = self.value_and_gradient(point)  # one program to compile instead of two
        return value if np.isfinite(value) else np.inf

    def value_and_gradient(self, point: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the value and the gradient (d,)."""
        self.evaluations += 1
        value, gradient = self.program(jnp.asarray(point))
        return float(value), np.asarray(gradient, float)

    def curvature(self, point: np.ndarray) -> Curvature | None:
        """Return the curvature; None where the Hessian is not finite."""
        hessian, noise = None, _EXACT_NOISE
        if self.hessian is not None:
            hessian = np.asarray(self.hessian(jnp.asarray(point)), float)
        if hessian is None or not np.all(np.isfinite(hessian)):
            hessian = finite_difference_hessian(lambda point: self.value_and_gradient(point)[1], point)
            noise = _DIFFERENCE_NOISE
        return decompose(hessian, noise) if np.all(np.isfinite(hessian)) else None


@dataclass(frozen=True, eq=False)
class Minimum:
    """The end of a search by Newton's method.

    Attributes:
        point: (d,).
        value: value of the objective.
        curvature: curvature at the point; None where the Hessian is not finite.
        decrement: predicted decrease of a further Newton step.
        step: the further Newton step (d,).
        gradient: (d,).
    """

    point: np.ndarray
    value: float
    curvature: Curvature | None
    decrement: float
    step: np.ndarray
    gradient: np.ndarray


@dataclass(frozen=True, eq=False)
class End:
    """The lowest point on the path of a search.

    Attributes:
        point: (d,).
        value: value of the objective; infinite if it is finite nowhere on the path.
    """

    point: np.ndarray
    value: float


def quasi_newton(objective: Objective, start: np.ndarray, max_iterations: int = 1000, *,
                 bounds: np.ndarray | None = None,
                 options: Mapping[str, float] | None = None) -> End:
    """Return the lowest point on the path of L-BFGS from ``start``.

    Where the objective or its gradient is not finite, the line search gets a moderate penalty, because interpolation
    through a huge value would shorten the step to zero.

    Args:
        objective: the function; it is evaluated at the points of the search only.
        start: (d,).
        max_iterations: largest number of iterations.
        bounds: (d, 2), least and largest value of each coordinate; None: there are none.
        options: options of SciPy's L-BFGS-B; None: strict tolerances.
    """
    best = End(np.asarray(start, float), np.inf)
    highest = -np.inf

    def guarded(point: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal best, highest
        value, gradient = objective.value_and_gradient(point)
        usable = np.isfinite(value) and np.all(np.isfinite(gradient))
        if usable or best.value == np.inf and np.isfinite(value):
            best = min(best, End(point.copy(), value), key=lambda end: end.value)
        if not usable:
            # Without any finite value the search cannot return to one; it ends, since the gradient is zero.
            penalty = highest + 10.0 * (1.0 + abs(highest - best.value)) if np.isfinite(highest) else 0.0
            return penalty, np.zeros_like(point)
        highest = max(highest, value)
        return value, gradient

    settings = {"maxiter": max_iterations, **(_STRICT if options is None else options)}
    scipy.optimize.minimize(guarded, start, jac=True, method="L-BFGS-B", bounds=bounds, options=settings)
    return best


def newton(objective: Objective, point: np.ndarray) -> Minimum:
    """Return the minimum near ``point`` (d,), to rounding, by Newton's method with backtracking."""
    for remaining in reversed(range(_NEWTON_STEPS)):
        value, gradient = objective.value_and_gradient(point)
        curvature = objective.curvature(point) if np.all(np.isfinite(gradient)) else None
        if curvature is None:
            return Minimum(point, value, None, np.inf, np.zeros_like(point), gradient)
        step = curvature.newton_step(gradient)
        decrement = -0.5 * float(gradient @ step)
        next_point = _backtrack(objective, point, step, value) if remaining else None
        if next_point is None or decrement < _NEGLIGIBLE:
            break
        point = next_point
    return Minimum(point, value, curvature, decrement, step, gradient)


def _backtrack(
    objective: Objective, point: np.ndarray, step: np.ndarray, value: float
) -> np.ndarray | None:
    rounding = 10 * np.finfo(float).eps * max(1.0, abs(value))
    for length in 0.5 ** np.arange(30):
        if objective.value(point + length * step) <= value + rounding:
            return point + length * step
    return None
