r"""The interior point for non-linear models: Gauss-Newton with Levenberg-Marquardt damping, and a merit function.

A trajectory is parametrised by its disturbances r: s_0 = m_0 + P_0 r_0 and s_k+1 = F_k(s_k) + Q_k r_k, where F_k is the
integrated mean of an interval, and Q_k its process covariance at the iterate. The objective is

    J = r_0' P_0 r_0 / 2 + sum_k r_k' Q_k r_k / 2 + sum_i (y_i - h(s_i))' R_i^-1 (y_i - h(s_i)) / 2,

which needs no inverse of Q, so that states without process noise are allowed.

1. Start from the disturbances of the extended Kalman smoother, or from none if their objective is smaller.
2. Linearise dynamics, observations and constraints about the whole trajectory. A smoother pass with the
   pseudo-observations of `lfm_ppl.constrained.interior_point` gives the Gauss-Newton step; its adjoint is r.
3. Damping with delta adds delta / 2 |q - q_old|^2 in the metric of Q^-1 for q = Q r. This is the prior
   q ~ N(delta / (1 + delta) q_old, Q / (1 + delta)), which needs no further outputs.
4. Roll the trajectory out through the non-linear dynamics. Accept the step if it lowers the merit function

       J - mu sum log s + sum nu |c - s|,    nu above the multipliers;

   otherwise halve it, at most 8 times.
5. Reduce the damping after an accepted full step, raise it otherwise.
6. Repeat from 2 until gap, residual and Newton decrement are below their tolerances.

Q and R are evaluated at the iterate and not differentiated: the solution is stationary for J with the Q and R of the
solution.

Source: Bell (1994), SIAM Journal on Optimization 4(3) (the iterated smoother is Gauss-Newton); Wächter and Biegler
(2006), Mathematical Programming 106 (interior points for non-linear programs).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.constrained.augmented import AugmentedObservation
from lfm_ppl.constrained.interior_point import (
    CENTRING,
    ConstrainedProblem,
    ConstraintMargins,
    InteriorPointIterate,
    Solution,
    constraint_margins,
    constraint_values,
    initial_iterate,
    iterate_until_finished,
    longest_step,
    newton_direction,
    pseudo_observations,
    smoother_pass,
    start_adjoint,
    weighted_noise,
)
from lfm_ppl.filtering.backward import SmootherTrace, backward
from lfm_ppl.filtering.forward import FilterTrace, IntervalMaps, LinearisationPoints, forward
from lfm_ppl.filtering.intervals import as_arrays
from lfm_ppl.filtering.moments import Moments, Record
from lfm_ppl.filtering.predict import predict
from lfm_ppl.filtering.problem import filter_problem
from lfm_ppl.filtering.update import GaussianUpdate
from lfm_ppl.linearisation.taylor import Taylor
from lfm_ppl.utils.gaussian_residuals import masked, wrapped
from lfm_ppl.utils.linalg import cholesky, matmul, solve_lower

_HALVINGS = 8
"""Largest number of halvings of a step."""

_SMALLEST_DAMPING, _INITIAL_DAMPING = 1e-6, 1e-2
"""Smaller dampings are set to zero; damping after the first rejected step, and the largest at convergence."""

_ROUNDING = 1e-12
"""Relative increase of the merit function that counts as rounding."""


class Trajectory(NamedTuple):
    """A trajectory that follows the dynamics, with its disturbances.

    Attributes:
        nodes: (N + 1, n), states at the scan's nodes.
        r0: (n,), disturbance of the initial state.
        r: (N, n), disturbances of the intervals.
    """

    nodes: jax.Array
    r0: jax.Array
    r: jax.Array


class GaussNewtonState(NamedTuple):
    """Primal part of an iterate.

    Attributes:
        trajectory: the trajectory.
        process_cov: (N, n, n), process covariances Q of the intervals.
        penalty: (G, C), weights nu of the merit function.
        damping: delta.
        centring: ratio of mu to the mean of s lambda in the next step.
        decrement: squared length of the last step in the metric of Q.
    """

    trajectory: Trajectory
    process_cov: jax.Array
    penalty: jax.Array
    damping: jax.Array
    centring: jax.Array
    decrement: jax.Array


class ConstrainedDynamics:
    """The maps of the intervals of a problem."""

    def __init__(self, problem: ConstrainedProblem):
        self.problem, self.ssm = problem, problem.ssm
        self.filter_problem = filter_problem(problem.ssm, Taylor(), problem.grid)
        self.intervals = as_arrays(self.filter_problem.grid.intervals)

    def predict(self, interval: Any, state: jax.Array, with_map: bool) -> Any:
        """Return the prediction over an interval from a state (n,) without uncertainty."""
        zero_cov = jnp.zeros((state.shape[0],) * 2)
        record = Record.SMOOTHER if with_map else Record.LIKELIHOOD
        return predict(self.filter_problem, interval, Moments(state, zero_cov), record=record)

    def linearise(self, nodes: jax.Array) -> IntervalMaps:
        """Return the maps of all intervals, linearised about a trajectory (N + 1, n)."""

        def linearise_interval(interval: Any, state: jax.Array) -> IntervalMaps:
            prediction = self.predict(interval, state, True)
            return IntervalMaps(state, prediction.moments.mean, prediction.phi, prediction.process_cov)

        return jax.vmap(linearise_interval)(self.intervals, nodes[:-1])

    def roll_out(self, r0: jax.Array, r: jax.Array, process_cov: jax.Array) -> Trajectory:
        """Return the trajectory with the disturbances r0 (n,) and r (N, n)."""
        prior = self.problem.start
        initial_state = prior.mean + matmul(prior.covariance, r0[:, None])[:, 0]

        def step(state: jax.Array, inputs: tuple) -> tuple[jax.Array, jax.Array]:
            interval, r, q = inputs
            next_state = self.predict(interval, state, False).moments.mean + matmul(q, r[:, None])[:, 0]
            return next_state, next_state

        _, nodes = jax.lax.scan(step, initial_state, (self.intervals, r, process_cov))
        return Trajectory(jnp.concatenate([initial_state[None], nodes]), r0, r)


def _states_at_data(problem: ConstrainedProblem, nodes: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return states (T, n) and times (T,) of the observations."""
    data_rows = jnp.asarray(problem.rows.data)
    return nodes[1:][jnp.asarray(problem.grid.observed)[data_rows]], jnp.asarray(problem.rows.times)[data_rows]


def _noise_factors(problem: ConstrainedProblem, nodes: jax.Array) -> jax.Array:
    """Return the Cholesky factors (T, D, D) of the observation noise along a trajectory."""
    ssm, outputs = problem.ssm, problem.outputs
    assert isinstance(ssm.model.observation, AugmentedObservation)
    inner = ssm.model.observation.inner

    def noise_factor(state: jax.Array, t: jax.Array, row: jax.Array, y: jax.Array) -> jax.Array:
        covariance = inner.covariance_at(*ssm.split(ssm.inputs(state, t)), t, row)
        return cholesky(masked(jnp.zeros(outputs), covariance, jnp.isfinite(y))[1]).chol

    return jax.vmap(noise_factor)(*_states_at_data(problem, nodes), jnp.arange(problem.y.shape[0]), problem.y)


def _objective(problem: ConstrainedProblem, trajectory: Trajectory, process_cov: jax.Array,
               chol: jax.Array) -> jax.Array:
    """Return J, with the Cholesky factors (T, D, D) of the observation noise."""
    ssm, outputs = problem.ssm, problem.outputs

    def misfit(state: jax.Array, t: jax.Array, y: jax.Array, chol: jax.Array) -> jax.Array:
        residual = jnp.where(jnp.isfinite(y), y, 0.0) - ssm.observe(ssm.inputs(state, t), t)[:outputs]
        for index in ssm.model.observation.angular:
            residual = residual.at[index].set(wrapped(residual[index], ssm.model.observation.period))
        return (solve_lower(chol, jnp.where(jnp.isfinite(y), residual, 0.0)) ** 2).sum()

    data = jax.vmap(misfit)(*_states_at_data(problem, trajectory.nodes), problem.y, chol)
    return 0.5 * (_quadratic_form(trajectory.r0, problem.start.covariance)
                  + _quadratic_form(trajectory.r, process_cov) + data.sum())


def _quadratic_form(r: jax.Array, p: jax.Array) -> jax.Array:
    """Return r' P r, summed over leading dimensions."""
    return (r * matmul(p, r[..., None])[..., 0]).sum()


def solve_nonlinear(problem: ConstrainedProblem, tolerance: float, max_passes: int) -> Solution:
    """Solve the problem of any model; arguments as in `lfm_ppl.constrained.interior_point.solve_linear`."""
    dynamics = ConstrainedDynamics(problem)
    no_targets = problem.no_targets
    forward_pass, smoothed, _ = smoother_pass(problem, no_targets, jnp.ones_like(no_targets))
    margins = constraint_margins(problem, smoothed)
    is_fixed, sd = margins.is_fixed, margins.sd

    def step(iterate: InteriorPointIterate) -> InteriorPointIterate:
        return _step(problem, dynamics, margins, iterate, tolerance)

    trajectory = _initial_trajectory(problem, dynamics, forward_pass, smoothed)
    value = constraint_values(problem, trajectory.nodes)
    primal = GaussNewtonState(trajectory, forward_pass.process_cov, jnp.zeros_like(value), jnp.asarray(0.0),
                              jnp.asarray(CENTRING), jnp.asarray(jnp.inf))
    first = initial_iterate(primal, value, margins, ~jnp.isfinite(trajectory.nodes).all())
    last = iterate_until_finished(step, first, max_passes)
    trajectory, nodes = last.primal.trajectory, last.primal.trajectory.nodes
    value = constraint_values(problem, nodes)
    is_violated = margins.is_violated(problem, value)
    slack = jnp.where(is_fixed, jnp.maximum(value, 0.0), last.slack)
    is_finite = jnp.isfinite(last.gap + last.primal.decrement) & jnp.isfinite(nodes).all()
    objective = _objective(problem, trajectory, last.primal.process_cov, _noise_factors(problem, nodes))
    return Solution(nodes, slack, jnp.where(is_fixed, 0.0, last.multiplier), last.gap, last.residual,
                    jnp.where(is_fixed, 0.0, jnp.abs(value - slack) / sd), sd, is_fixed, is_violated, objective,
                    last.passes, last.is_finished & is_finite & ~is_violated.any())


def _step(problem: ConstrainedProblem, dynamics: ConstrainedDynamics, margins: ConstraintMargins,
          iterate: InteriorPointIterate, tolerance: float) -> InteriorPointIterate:
    """Take one damped Gauss-Newton step with a line search on the merit function."""
    is_fixed, state = margins.is_fixed, iterate.primal
    # The disturbances belong to the new Q, so that the trajectory is rolled out again.
    process_cov = dynamics.linearise(state.trajectory.nodes).process_cov
    trajectory = dynamics.roll_out(state.trajectory.r0, state.trajectory.r, process_cov)
    maps = dynamics.linearise(trajectory.nodes)._replace(process_cov=process_cov)
    chol = _noise_factors(problem, trajectory.nodes)
    mu = state.centring * iterate.gap / margins.free_count
    r0, r, noise = _gauss_newton_pass(problem, trajectory, maps, state.damping,
                                      *pseudo_observations(iterate, mu, is_fixed))
    slack_change, multiplier_change = newton_direction(iterate, mu, noise, is_fixed)
    r0_change, r_change = r0 - trajectory.r0, r - trajectory.r
    penalty = jnp.maximum(state.penalty, jnp.where(is_fixed, 0.0, 2.0 * jnp.abs(noise)))

    def merit(trajectory: Trajectory, slack: jax.Array) -> jax.Array:
        distance = jnp.where(is_fixed, 0.0, jnp.abs(constraint_values(problem, trajectory.nodes) - slack))
        barrier = jnp.where(is_fixed, 0.0, jnp.log(slack)).sum()
        value = _objective(problem, trajectory, process_cov, chol) - mu * barrier + (penalty * distance).sum()
        return jnp.where(jnp.isfinite(value), value, jnp.inf)

    old_merit = merit(trajectory, iterate.slack)

    def candidate(step_size: jax.Array) -> tuple[Trajectory, jax.Array]:
        return (dynamics.roll_out(trajectory.r0 + step_size * r0_change, trajectory.r + step_size * r_change,
                                  process_cov),
                iterate.slack + step_size * slack_change)

    def has_descended(value: jax.Array) -> jax.Array:
        return value <= old_merit + _ROUNDING * jnp.maximum(1.0, jnp.abs(old_merit))

    def is_rejected(search: tuple) -> jax.Array:
        return ~has_descended(search[4]) & (search[1] < _HALVINGS)

    def halve(search: tuple) -> tuple:
        step_size, halvings = 0.5 * search[0], search[1] + 1
        trial = candidate(step_size)
        return step_size, halvings, *trial, merit(*trial)

    longest = longest_step(iterate.slack, slack_change)
    trial = candidate(longest)
    _, halvings, next_trajectory, slack, value = jax.lax.while_loop(
        is_rejected, halve, (longest, 0, *trial, merit(*trial)))
    is_accepted = has_descended(value)
    next_trajectory, slack = jax.tree_util.tree_map(
        lambda a, b: jnp.where(is_accepted, a, b), (next_trajectory, slack), (trajectory, iterate.slack))
    multiplier_step = jnp.where(is_accepted, longest_step(iterate.multiplier, multiplier_change), 0.0)
    multiplier = iterate.multiplier + multiplier_step * multiplier_change
    is_full_step = is_accepted & (halvings == 0)
    damping = jnp.where(is_full_step, 0.1 * state.damping,
                        jnp.maximum(jnp.where(is_accepted, 2.0, 10.0) * state.damping, _INITIAL_DAMPING))
    damping = jnp.where(damping < _SMALLEST_DAMPING, 0.0, damping)
    gap = jnp.where(is_fixed, 0.0, slack * multiplier).sum()
    distance = jnp.where(is_fixed, 0.0, jnp.abs(constraint_values(problem, next_trajectory.nodes) - slack))
    residual = jnp.max(distance / margins.sd, initial=0.0)
    decrement = _quadratic_form(r_change, process_cov) + _quadratic_form(r0_change, problem.start.covariance)
    has_converged = ((gap <= tolerance) & (residual <= jnp.sqrt(tolerance)) & (decrement <= tolerance) & is_accepted
                     & (state.damping <= _INITIAL_DAMPING))
    next_state = GaussNewtonState(next_trajectory, process_cov, penalty, damping,
                                  jnp.where(is_full_step, CENTRING, 0.5), decrement)
    return InteriorPointIterate(next_state, slack, multiplier, gap, residual, iterate.passes + 1,
                                has_converged | ~jnp.isfinite(gap + decrement))


def _gauss_newton_pass(problem: ConstrainedProblem, trajectory: Trajectory, maps: IntervalMaps, damping: jax.Array,
                       targets: jax.Array, variances: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the disturbances r_0 (n,) and r (N, n) of a damped step, and its weighted pseudo-noise (G, C)."""
    weight = damping / (1.0 + damping)  # of the old disturbances
    ssm, y = problem.with_pseudo_observations(targets, variances)
    maps = maps._replace(mean=maps.mean + weight * matmul(maps.process_cov, trajectory.r[..., None])[..., 0],
                         process_cov=(1.0 - weight) * maps.process_cov)
    prior = Moments(problem.start.mean + weight * matmul(problem.start.covariance, trajectory.r0[:, None])[:, 0],
                    (1.0 - weight) * problem.start.covariance)
    nodes = Moments(trajectory.nodes[1:], jnp.zeros_like(maps.process_cov))
    passes = filter_problem(ssm, Taylor(), problem.grid)
    forward_pass = forward(passes, GaussianUpdate(y), initial=prior, about=LinearisationPoints(nodes, nodes),
                           record=Record.SMOOTHER, maps=maps)
    smoothed = backward(passes, forward_pass)
    noise = problem.at_grid(weighted_noise(forward_pass, smoothed))[:, problem.outputs:]
    return (weight * trajectory.r0 + (1.0 - weight) * start_adjoint(forward_pass, smoothed),
            weight * trajectory.r + (1.0 - weight) * smoothed.adjoint[0], noise)


def _initial_trajectory(problem: ConstrainedProblem, dynamics: ConstrainedDynamics, forward_pass: FilterTrace,
                        smoothed: SmootherTrace) -> Trajectory:
    """Return the trajectory with the disturbances of the extended Kalman smoother, or without any if it is better."""
    candidates = []
    for scale in (1.0, 0.0):
        r0, r = (scale * jnp.nan_to_num(a) for a in (start_adjoint(forward_pass, smoothed), smoothed.adjoint[0]))
        trajectory = dynamics.roll_out(r0, r, forward_pass.process_cov)
        cost = _objective(problem, trajectory, forward_pass.process_cov, _noise_factors(problem, trajectory.nodes))
        candidates.append((trajectory, jnp.where(jnp.isfinite(cost), cost, jnp.inf)))
    (with_noise, smoother_cost), (without_noise, prior_cost) = candidates
    return jax.tree_util.tree_map(lambda a, b: jnp.where(smoother_cost <= prior_cost, a, b), with_noise, without_noise)
