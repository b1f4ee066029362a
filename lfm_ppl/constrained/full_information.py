"""Full information estimation: the most probable trajectory given all observations, under constraints.

1. Combine bounds and constraint functions, and lay out rows of observations and constraints.
2. Add the constraints to the outputs of the model (`lfm_ppl.constrained.augmented`).
3. Solve the MAP problem by an interior point: `lfm_ppl.constrained.interior_point.solve_linear` for linear models,
   `lfm_ppl.constrained.gauss_newton.solve_nonlinear` otherwise.
4. Compute bounded states and forces from bound and slack, so that rounding violates no bound.
5. Report an infeasible problem, naming the constraints and the rows, or missing convergence.

Source: Wolff, Lopez, Müller and Beckers, Inference in latent force models using optimal state estimation, section 3.2.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from lfm_ppl.constrained.augmented import augmented_model, build_rows
from lfm_ppl.constrained.constraints import Constraints, build_constraints
from lfm_ppl.constrained.gauss_newton import solve_nonlinear
from lfm_ppl.constrained.interior_point import RESPECTED, ConstrainedProblem, Solution, solve_linear
from lfm_ppl.filtering.arguments import check_observations, warn_single_precision
from lfm_ppl.filtering.moments import Moments
from lfm_ppl.filtering.smoother import MeanSd, moments_by_name
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation import GaussianObservation
from lfm_ppl.model.observation_noise import check_noise
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import matmul
from lfm_ppl.utils.programs import shared_jit


class ConstrainedEstimate(eqx.Module):
    """Result of `full_information` and `lfm_ppl.MovingHorizon.estimate`.

    Attributes:
        times: (K,), times at which the constraints hold.
        state_mean: (K, M), the most probable trajectory of the physical state. A bounded state never violates its
            bound.
        force_mean: (K, R), the most probable trajectories of the forces.
        slack: (K, C), values s >= 0 of the constraints.
        multiplier: (K, C), derivatives of the log density with respect to a relaxation of a constraint; zero for an
            inactive constraint.
        gap: the duality gap, sum of s lambda, in units of the log density.
        objective: minus the log density of trajectory and data, up to a constant.
        passes: number of smoother passes.
        converged: whether the gap is below the tolerance, and the constraints equal their slacks.
        violation: (K, C), distance of each constraint from its slack in standard deviations; large for an infeasible
            problem.
        scale: (K, C), standard deviation of each constraint given the data alone; 1 for a constraint without variance.
        labels: labels of the C constraints, such as "factor >= lower".
        state_names, force_names: names of the M states and the R forces.
    """

    times: jax.Array
    state_mean: jax.Array
    force_mean: jax.Array
    slack: jax.Array
    multiplier: jax.Array
    gap: jax.Array
    objective: jax.Array
    passes: jax.Array
    converged: jax.Array
    violation: jax.Array
    scale: jax.Array
    labels: tuple[str, ...] = eqx.field(static=True)
    state_names: tuple[str, ...] = eqx.field(static=True)
    force_names: tuple[str, ...] = eqx.field(static=True)

    @property
    def active(self) -> jax.Array:
        """Whether a constraint is active, (K, C): its multiplier exceeds its slack, both in standard deviations."""
        return self.multiplier * self.scale > self.slack / self.scale

    def state(self, name: str) -> MeanSd:
        """Return the trajectory (K,) of a physical state as ``mean``; its ``sd`` is NaN.

        Raises:
            ValueError: an unknown name; the message lists similar names.
        """
        return most_probable("state", name, self.state_names, self.state_mean)

    def force(self, name: str) -> MeanSd:
        """Return the trajectory (K,) of a force as ``mean``; its ``sd`` is NaN."""
        return most_probable("force", name, self.force_names, self.force_mean)


def most_probable(kind: str, name: str, names: tuple[str, ...], means: jax.Array) -> MeanSd:
    """Return the mean of a state or force by its name, from means (..., N) of all, with an sd of NaN."""
    return moments_by_name(kind, name, names, means, jnp.full_like(means, jnp.nan))


def full_information(model: LatentForceModel, times: ArrayLike, y: ArrayLike,
                     lower: Mapping[str, ArrayLike] | None = None, upper: Mapping[str, ArrayLike] | None = None,
                     constraints: Callable[..., Any] | Sequence[Callable[..., Any]] = (),
                     grid: ArrayLike | int | None = None,
                     steps: int = 10, tolerance: float = 1e-10, max_passes: int = 100) -> ConstrainedEstimate:
    r"""Find the most probable trajectory of state and forces given all observations, under constraints.

    It solves

        minimise    (s_0 - m_0)' P_0^-1 (s_0 - m_0) / 2 + sum_k (s_k+1 - F_k(s_k))' Q_k^-1 (s_k+1 - F_k(s_k)) / 2
                    + sum_i (y_i - h(x, u, t_i))' R_i^-1 (y_i - h(x, u, t_i)) / 2
        subject to  lower <= (x, u, h) <= upper  and  c(x, u, t) >= 0  at the times of the grid,

    with the transition F and the process covariance Q of the state-space model, by a primal-dual interior point. Each
    Newton step is one pass of the smoother, so that time is linear in the number of rows. A non-linear model is
    linearised about the iterate (Gauss-Newton with Levenberg and Marquardt's damping and a merit function). Its
    solution is a local minimum, with Q and R evaluated at the solution.

    Without active constraints the result for a linear model is the smoother's mean.

    Args:
        model: the latent force model; its functions are read once for each model, as by `jax.jit`.
        times: (T,), non-decreasing.
        y: (T, D), NaN where missing.
        lower: name of a state, force or output -> its lower bound, ``{"factor": 0.0}``.
        upper: the same for upper bounds.
        constraints: a function c(x, u, t) or several, each returning a number or a vector, feasible where >= 0.
        grid: (K,) increasing times at which the constraints hold, and the times of the result. By default the initial
            time and the observation times; longer gaps than 1/200 of the record are divided equally. An integer: this
            number of times at equal distances over the record.
        steps: integration steps between two times of the grid or the data; without effect for a linear model.
        tolerance: tolerance of the duality gap, in units of the log density; constraints equal their slacks to its
            square root, in standard deviations.
        max_passes: largest number of smoother passes.

    Returns:
        Trajectories, multipliers, duality gap, active set and convergence. A bounded state or force is computed from
        its bound and the slack s >= 0, and so feasible in floating-point arithmetic.

    Raises:
        ValueError, TypeError: as `lfm_ppl.smooth`; an unknown name, bounds that contradict each other, an initial state
            without variance outside of its bounds, a bound on a quantity without variance. An infeasible problem; the
            message names the constraints and the rows.

    Warns:
        UserWarning: no convergence within ``max_passes``.

    Example:
        >>> import jax.numpy as jnp, numpy as np, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, sd=0.3), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        >>> estimate = lfm.full_information(model, np.arange(3.0), -jnp.ones((3, 1)), lower={"u": 0.0})
        >>> bool(estimate.force("u").mean.min() >= 0), bool(estimate.converged)
        (True, True)

    Source: Wolff, Lopez, Müller and Beckers, Inference in latent force models using optimal state estimation, section
    3.2; Rao, Wright and Rawlings (1998), Journal of Optimization Theory and Applications 99(3), for interior points by
    Riccati recursions.
    """
    check_settings(model, tolerance, max_passes)
    constraint_function = build_constraints(model, lower, upper, constraints)
    rows = build_rows(model, times, grid)
    ssm = augmented_model(model, constraint_function, rows)
    scan_grid = build_time_grid(ssm, rows.times, steps)
    model.check_at(scan_grid.initial_time, np.shape(times)[0])
    y = check_observations(y, np.shape(times)[0], len(model.output_names))
    warn_single_precision()
    linear = ssm.plan.has_fixed_weights
    if not linear:
        check_noise(ssm, scan_grid.initial_time)
    problem = ConstrainedProblem(ssm, scan_grid, rows, y, Moments(*ssm.initial()))
    result, solution = _solve(problem, constraint_function, float(tolerance), max_passes, linear)
    _report_failures(result, solution)
    return result


def check_settings(model: LatentForceModel, tolerance: float, max_passes: int) -> None:
    """Raise if the model's observation is not Gaussian, or a setting is out of range."""
    if not isinstance(model.observation, GaussianObservation):
        raise TypeError("estimation under constraints takes an lfm.GaussianObservation; the observation is "
                        f"{type(model.observation).__name__}. Leave the bounds out, or keep the quantity in them by a "
                        "link, such as softplus, in the dynamics.")
    checks.positive("tolerance", tolerance, "It is in units of the log density.")
    checks.positive_integer("max_passes", max_passes)


def solve_problem(problem: ConstrainedProblem, constraints: Constraints, tolerance: float, max_passes: int,
                  linear: bool) -> tuple[ConstrainedEstimate, Solution]:
    """Solve a problem without checks; for compiled code."""
    ssm, solution = problem.ssm, (solve_linear if linear else solve_nonlinear)(problem, tolerance, max_passes)
    times = problem.grid_times
    matrix, offset = jax.vmap(ssm.input_map)(times)
    inputs = matmul(matrix, problem.at_grid(solution.mean[1:])[..., None])[..., 0] + offset
    inputs = constraints.impose_bounds(inputs, solution.slack)
    size = ssm.physical_dim
    return ConstrainedEstimate(
        times, inputs[:, :size], inputs[:, size:], solution.slack, solution.multiplier, solution.gap,
        solution.objective, solution.passes, solution.converged, solution.violation, solution.sd, constraints.labels,
        ssm.model.state_names, ssm.model.force_names), solution


_solve = shared_jit(solve_problem)


def _report_failures(result: ConstrainedEstimate, solution: Solution) -> None:
    """Raise or warn if a solution is not usable; without effect for traced values.

    Raises:
        ValueError: an infeasible problem, or a bound on a quantity without variance.
    """
    if checks.traced((result, solution)):
        return
    is_fixed = np.asarray(solution.is_fixed)
    for index in np.flatnonzero(is_fixed.all(axis=0)):
        raise ValueError(f"the constraint {result.labels[index]!r} is on a quantity without variance: nothing that is "
                         "unknown moves it at any time of the grid. Leave it out, or give the quantity a variance.")
    if bool(result.converged):
        return
    fixed_violations = _list_violations(result, np.asarray(solution.is_violated))
    if fixed_violations:
        raise ValueError(f"the problem is infeasible: quantities that have no variance violate {fixed_violations}. "
                         "Change the bound, or give the quantity a variance.")
    violations = _list_violations(result, np.asarray(result.violation) > RESPECTED)
    if not np.isfinite(float(result.gap)) or not np.isfinite(np.asarray(result.violation)).all():
        checks.warn("the estimate under constraints breaks down: it is not finite. Try more steps, a tighter prior, or "
                    "constraints that keep the dynamics where it is defined.")
    elif violations:
        raise ValueError(f"the problem is infeasible, or nearly: after {int(result.passes)} passes no trajectory is "
                         f"found that respects {violations}. Loosen one of these constraints, or raise max_passes.")
    else:
        checks.warn(f"the estimate under constraints has not converged in {int(result.passes)} passes: duality gap "
                    f"{float(result.gap):.2g}. Raise max_passes, or the tolerance.")


def _list_violations(result: ConstrainedEstimate, is_violated: np.ndarray) -> str:
    """Return the violated constraints (K, C) with rows and times, as text."""
    times = np.asarray(result.times)
    return "; ".join(f"{label!r} at {_list_rows(column, times)}"
                     for label, column in zip(result.labels, is_violated.T, strict=True) if column.any())


def _list_rows(is_violated: np.ndarray, times: np.ndarray) -> str:
    """Return the first five rows of a violated constraint, as text."""
    rows = np.flatnonzero(is_violated)
    listed = ", ".join(f"{row} (time {times[row]:g})" for row in rows[:5])
    more = f" and {rows.size - 5} more" if rows.size > 5 else ""
    return f"{'row' if rows.size == 1 else 'rows'} {listed}{more}"
