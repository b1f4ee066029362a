"""Full information estimation: the most probable trajectory given all observations, under constraints."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.constrained.augmented import augmented, rows
from lfm_ppl.constrained.constraints import Constraints, build_constraints
from lfm_ppl.constrained.gauss_newton import solve_nonlinear
from lfm_ppl.constrained.interior_point import RESPECTED, Problem, Solution, solve_linear
from lfm_ppl.filtering.filter import check_observations, warn_single_precision
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.linalg import matmul
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation import GaussianObservation
from lfm_ppl.model.observation_noise import check_noise
from lfm_ppl.model.state_space import StateSpaceModel


class ConstrainedEstimate(eqx.Module):
    """The outcome of `full_information`.

    Attributes:
        times: (K,), at which the constraints hold.
        state_mean: (K, M), the most probable trajectory of the physical state. A bounded state is never beyond its
            bound.
        force_mean: (K, R), the same of the forces.
        slack: (K, C), the constraints' values s >= 0.
        multiplier: (K, C), by how much the log density would grow if a constraint gave way by one unit; zero where it
            does not bind.
        gap: the duality gap, sum of s lambda, in units of the log density.
        objective: minus the log density of trajectory and data, up to a constant.
        passes: number of smoother passes.
        converged: whether the gap is below the tolerance, and the constraints equal their slacks.
        violation: (K, C), distance of each constraint from its slack in standard deviations; large where the problem is
            infeasible.
        scale: (K, C), standard deviation of each constraint given the data alone; 1 where it is known.
        labels: of the C constraints, such as "factor >= lower".
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
        """(K, C), whether a constraint binds: its multiplier outweighs its slack, both in standard deviations."""
        return self.multiplier * self.scale > self.slack / self.scale

    def state(self, name: str) -> jax.Array:
        """Return (K,), the trajectory of a physical state.

        Raises:
            ValueError: unknown name; the message has the nearest ones.
        """
        checks.one_of("state", name, self.state_names)
        return self.state_mean[:, self.state_names.index(name)]

    def force(self, name: str) -> jax.Array:
        """Return (K,), the trajectory of a force."""
        checks.one_of("force", name, self.force_names)
        return self.force_mean[:, self.force_names.index(name)]


def full_information(model: LatentForceModel, times: Any, y: Any, lower: Mapping[str, Any] | None = None,
                     upper: Mapping[str, Any] | None = None,
                     constraints: Callable[..., Any] | Sequence[Callable[..., Any]] = (), grid: Any = None,
                     steps: int = 10, tolerance: float = 1e-10, max_passes: int = 100) -> ConstrainedEstimate:
    r"""Find the most probable trajectory of state and forces given all observations, under constraints.

    It solves

        minimise    (s_0 - m_0)' P_0^-1 (s_0 - m_0) / 2 + sum_k (s_k+1 - F_k(s_k))' Q_k^-1 (s_k+1 - F_k(s_k)) / 2
                    + sum_i (y_i - h(x, u, t_i))' R_i^-1 (y_i - h(x, u, t_i)) / 2
        subject to  lower <= (x, u, h) <= upper  and  c(x, u, t) >= 0  at the times of the grid,

    with the transition F and the process covariance Q of the state-space model. It is a primal-dual interior point,
    each of whose Newton steps is one pass of the smoother, so that it takes time linear in the number of rows. A model
    that bends is linearised about the iterate (Gauss-Newton, damped as Levenberg and Marquardt do, with a merit
    function). Its solution is a local one, and Q and R are those at the solution.

    Without active constraints the result of a linear model is the smoother's mean.

    Args:
        model: the latent force model.
        times: (T,), non-decreasing.
        y: (T, D), NaN where missing.
        lower: name of a state, force or output -> its lower bound, ``{"factor": 0.0}``.
        upper: the same for upper bounds.
        constraints: a function c(x, u, t) or several, each returning a number or a vector, feasible where >= 0.
        grid: (K,) increasing times at which the constraints hold and the result is given. By default the initial time
            and the times of the observations, and between those that are further apart than 1/200 of the record times
            at equal distances. A whole number: as many at equal distances over the record.
        steps: integration steps between two times of the grid or the data; of no account for a linear model.
        tolerance: of the duality gap, in units of the log density; constraints equal their slacks to its square root,
            in standard deviations.
        max_passes: number of smoother passes, at most.

    Returns:
        Trajectories, multipliers, duality gap, active set and convergence. What is returned of a bounded state or force
        is its bound and the slack s >= 0, and so feasible to the last bit.

    Raises:
        ValueError, TypeError: an unknown name, bounds that contradict each other, a known initial state outside of its
            bounds, a bound on a quantity without variance, and what `lfm_ppl.smooth` raises. The problem is infeasible;
            the message names the constraints and the rows.

    Warns:
        UserWarning: it has not converged after ``max_passes``.

    Example:
        >>> import jax.numpy as jnp, numpy as np, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        >>> found = lfm.full_information(model, np.arange(3.0), -jnp.ones((3, 1)), lower={"u": 0.0})
        >>> bool(found.force("u").min() >= 0), bool(found.converged)
        (True, True)

    Source: Wolff, Lopez, Müller and Beckers, Inference in latent force models using optimal state estimation, section
    3.2; Rao, Wright and Rawlings (1998), Journal of Optimization Theory and Applications 99(3), for interior points by
    Riccati recursions.
    """
    check_settings(model, tolerance, max_passes)
    found = build_constraints(model, lower, upper, constraints)
    laid_out = rows(model, times, grid)
    ssm = augmented(model, found, laid_out)
    scan_grid = build_time_grid(ssm, laid_out.times, steps)
    model.check_at(scan_grid.initial_time, np.shape(times)[0])
    y = check_observations(y, np.shape(times)[0], len(model.output_names))
    warn_single_precision()
    linear = is_linear(ssm)
    if not linear:
        check_noise(ssm, scan_grid.initial_time)
    problem = Problem(ssm, scan_grid, laid_out, y, Moments(*ssm.initial()))
    result, solution = _run(ssm, found, problem, float(tolerance), max_passes, linear)
    report(result, solution)
    return result


def check_settings(model: LatentForceModel, tolerance: float, max_passes: int) -> None:
    """Raise where the model's observation is not Gaussian, or a setting is out of range."""
    if not isinstance(model.observation, GaussianObservation):
        raise TypeError("estimation under constraints takes an lfm.GaussianObservation; the observation is "
                        f"{type(model.observation).__name__}. Leave the bounds out, or keep the quantity in them by a "
                        "link, such as softplus, in the dynamics.")
    checks.positive("tolerance", tolerance, "It is in units of the log density.")
    checks.positive_integer("max_passes", max_passes)


def is_linear(ssm: StateSpaceModel) -> bool:
    """Whether transitions, observations and constraints do not depend on the trajectory."""
    return (ssm.drift_structure.linear and ssm.observation_structure.linear and not callable(ssm.model.process_noise)
            and not ssm.model.observation.varies_with_state)


def estimate_on(ssm: StateSpaceModel, constraints: Constraints, problem: Problem, tolerance: float, most: int,
                linear: bool) -> tuple[ConstrainedEstimate, Solution]:
    """Solve a problem without checks; for compiled code."""
    solution = (solve_linear if linear else solve_nonlinear)(problem, tolerance, most)
    times = jnp.asarray(problem.rows.times)[jnp.asarray(problem.rows.grid)]
    matrix, offset = jax.vmap(ssm.input_map)(times)
    inputs = matmul(matrix, problem.at_grid(solution.mean[1:])[..., None])[..., 0] + offset
    inputs = constraints.respected(inputs, solution.slack)
    size = ssm.physical_dim
    return ConstrainedEstimate(
        times, inputs[:, :size], inputs[:, size:], solution.slack, solution.multiplier, solution.gap,
        solution.objective, solution.passes, solution.converged, solution.violation, solution.sd, constraints.labels,
        ssm.model.state_names, ssm.model.force_names), solution


_run = eqx.filter_jit(estimate_on)


def report(result: ConstrainedEstimate, solution: Solution) -> None:
    """Say eagerly what is wrong with a solution.

    Raises:
        ValueError: the problem is infeasible, or a bound is on a quantity without variance.
    """
    if checks.traced((result, solution)):
        return
    known = np.asarray(solution.known)
    for index in np.flatnonzero(known.all(axis=0)):
        raise ValueError(f"the constraint {result.labels[index]!r} is on a quantity without variance: nothing that is "
                         "unknown moves it at any time of the grid. Leave it out, or give the quantity a variance.")
    if bool(result.converged):
        return
    times = np.asarray(result.times)
    apart = np.asarray(result.violation) > RESPECTED
    text = [f"{label!r} at {_where(violated, times)}" for label, violated in
            zip(result.labels, np.asarray(solution.violated).T, strict=True) if violated.any()]
    if text:
        raise ValueError(f"the problem is infeasible: quantities that have no variance violate {'; '.join(text)}. "
                         "Change the bound, or give the quantity a variance.")
    if not np.isfinite(float(result.gap)) or not np.isfinite(np.asarray(result.violation)).all():
        checks.warn("the estimate under constraints breaks down: it is not finite. Try more steps, a tighter prior, or "
                    "constraints that keep the dynamics where it is defined.")
    elif apart.any():
        text = [f"{label!r} at {_where(wrong, times)}" for label, wrong in zip(result.labels, apart.T, strict=True)
                if wrong.any()]
        raise ValueError(f"the problem is infeasible, or nearly: after {int(result.passes)} passes no trajectory is "
                         f"found that respects {'; '.join(text)}. Loosen one of these constraints, or raise "
                         "max_passes.")
    else:
        checks.warn(f"the estimate under constraints has not converged in {int(result.passes)} passes: duality gap "
                    f"{float(result.gap):.2g}. Raise max_passes, or the tolerance.")


def _where(wrong: np.ndarray, times: np.ndarray) -> str:
    found = np.flatnonzero(wrong)
    shown = ", ".join(f"{index} (time {times[index]:g})" for index in found[:5])
    more = f" and {found.size - 5} more" if found.size > 5 else ""
    return f"{'row' if found.size == 1 else 'rows'} {shown}{more}"
