r"""A primal-dual interior point whose Newton step is one smoother pass.

The MAP trajectory under constraints minimises J, minus the log density of states and data, subject to c(x, u, t) >= 0
on some rows. With slacks s and multipliers lambda the optimality conditions, the last one relaxed by mu, are

    grad J = C' lambda,    c = s,    s lambda = mu,    s, lambda > 0.

1. A smoother pass without the constraints gives their values and standard deviations (`constraint_margins`). Values
   without variance are fixed: no pass can change them. If all values are >= 0 this trajectory is the solution.
2. Start with slacks of at least one standard deviation, and multipliers such that s lambda = 0.1.
3. Set mu to a tenth of the mean of s lambda. Newton's step minimises J + sum (lambda / 2 s) (c - z)^2, which is a
   smoother pass with the pseudo-observations z = s + mu / lambda of variance V = s / lambda.
4. Then lambda+ = mu / s - (lambda / s) (c - s) and s+ = c. Both follow from the adjoint of the smoother, not from its
   mean: lambda+ = S^-1 v - K' r is the smoothed pseudo-noise (z - c) / V, and s+ = z - V lambda+, so that a slack of
   1e-15 has all its digits.
5. Go up to 99% of the way to the boundary, separately for s and lambda.
6. Repeat from 3 until the duality gap sum s lambda and the residual c - s are below their tolerances.

Source: Rao, Wright and Rawlings (1998), Journal of Optimization Theory and Applications 99(3).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from lfm_ppl.constrained.augmented import Rows, augmented_observations
from lfm_ppl.filtering.backward import SmootherTrace, backward
from lfm_ppl.filtering.forward import FilterTrace, IntervalMaps, forward
from lfm_ppl.filtering.intervals import TimeGrid
from lfm_ppl.filtering.moments import Moments, Record
from lfm_ppl.filtering.problem import filter_problem
from lfm_ppl.filtering.update import GaussianUpdate
from lfm_ppl.linearisation.taylor import Taylor
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.utils.linalg import congruence, diagonal, matmul, safe_sqrt, solve_lower, solve_upper

CENTRING = 0.1
"""Ratio of mu to the mean of s lambda."""

BOUNDARY_FRACTION = 0.99
"""Largest fraction of the way to the boundary that a step goes."""

INITIAL_PRODUCT = 0.1
"""Product s lambda of the first iterate."""

FIXED_VARIANCE = 1e-12
"""Ratio of a constraint's variance to its largest variance over the rows, below which the constraint is fixed."""

RESPECTED = 1e-6
"""Distance of a constraint from its slack, in standard deviations, up to which it is respected. Slacks follow from the
adjoint and stay positive even if no trajectory is feasible; only the trajectory shows a violation."""

VIOLATED = 1e-9
"""A fixed constraint is violated if it is below minus this multiple of its largest standard deviation."""


class ConstrainedProblem(eqx.Module):
    """Model, data and constraints of a MAP problem.

    Attributes:
        ssm: the model with the constraints as further outputs.
        grid: the time grid over the rows.
        rows: rows of the observations and of the constraints.
        y: (T, D), NaN where missing.
        start: moments at the initial time.
        is_constrained: (G,), whether the constraints hold at a time of the grid; None: at all of them.
        transitions: maps of the intervals of a linear model, if computed before all passes.
    """

    ssm: StateSpaceModel
    grid: TimeGrid
    rows: Rows
    y: jax.Array
    start: Moments
    is_constrained: Any = None
    transitions: IntervalMaps | None = None

    @property
    def outputs(self) -> int:
        """Number of outputs D of the model."""
        return self.y.shape[1]

    @property
    def grid_times(self) -> jax.Array:
        """Times (G,) of the grid."""
        return jnp.asarray(self.rows.times)[jnp.asarray(self.rows.grid)]

    @property
    def no_targets(self) -> jax.Array:
        """NaN (G, C), for a pass without pseudo-observations."""
        return jnp.full((len(self.rows.grid), self.ssm.output_dim - self.outputs), jnp.nan)

    def with_pseudo_observations(self, targets: jax.Array, variances: jax.Array) -> tuple[StateSpaceModel, jax.Array]:
        """Return model and observations with pseudo-observations (G, C) of given variances; NaN for none."""
        row_variances = jnp.ones((len(self.rows.times), targets.shape[1])).at[self.rows.grid].set(variances)
        ssm = eqx.tree_at(lambda m: m.model.observation.variances, self.ssm, row_variances)
        return ssm, augmented_observations(self.y, targets, self.rows)

    def at_grid(self, a: jax.Array) -> jax.Array:
        """Return the entries at the grid's rows of an array with one entry for each interval of the scan."""
        return a[jnp.asarray(self.grid.observed)[jnp.asarray(self.rows.grid)]]


def smoother_pass(problem: ConstrainedProblem, targets: jax.Array,
                  variances: jax.Array) -> tuple[FilterTrace, SmootherTrace, jax.Array]:
    """Run the smoother with pseudo-observations (G, C) of the constraints, NaN for none.

    Returns:
        The forward pass, the backward pass, and the smoothed pseudo-noise over its variance, (z - c) / V (G, C), zero
        without a pseudo-observation.
    """
    ssm, y = problem.with_pseudo_observations(targets, variances)
    passes = filter_problem(ssm, Taylor(), problem.grid)
    forward_pass = forward(passes, GaussianUpdate(y), initial=problem.start, record=Record.SMOOTHER,
                           maps=problem.transitions)
    smoothed = backward(passes, forward_pass)
    noise = problem.at_grid(weighted_noise(forward_pass, smoothed))[:, problem.outputs:]
    return forward_pass, smoothed, noise


def weighted_noise(forward_pass: FilterTrace, smoothed: SmootherTrace) -> jax.Array:
    """Return R^-1 E[noise | all observations] = S^-1 v - K' r (N, D), with the adjoint r of the later observations."""
    r = smoothed.adjoint[0]
    later_adjoint = jnp.concatenate(
        [matmul(jnp.swapaxes(forward_pass.phi[1:], 1, 2), r[1:, :, None])[..., 0], jnp.zeros_like(r[:1])])
    weighted_innovation = jax.vmap(lambda chol, v: solve_upper(chol, solve_lower(chol, v)))(
        forward_pass.update.chol, forward_pass.update.innovation)
    return weighted_innovation - matmul(jnp.swapaxes(forward_pass.update.gain, 1, 2), later_adjoint[..., None])[..., 0]


def start_adjoint(forward_pass: FilterTrace, smoothed: SmootherTrace) -> jax.Array:
    """Return r_0 (n,), with which the smoothed state at the initial time is m_0 + P_0 r_0."""
    return matmul(forward_pass.phi[0].T, smoothed.adjoint[0][0][:, None])[:, 0]


def constraint_values(problem: ConstrainedProblem, nodes: jax.Array) -> jax.Array:
    """Return the constraints (G, C) along a trajectory (N + 1, n)."""
    ssm, outputs = problem.ssm, problem.outputs
    return jax.vmap(lambda s, t: ssm.observe(ssm.inputs(s, t), t)[outputs:])(
        problem.at_grid(nodes[1:]), problem.grid_times)


class ConstraintMargins(eqx.Module):
    """Constraints along the smoothed trajectory of a pass without them.

    Attributes:
        value: (G, C), values of the constraints.
        sd: (G, C), their standard deviations to first order; 1 for a fixed constraint.
        largest_sd: (C,), largest standard deviation of each constraint.
        is_fixed: (G, C), whether the constraint has no variance, or does not hold at the row.
        free_count: number of constraints that are not fixed, at least 1.
    """

    value: jax.Array
    sd: jax.Array
    largest_sd: jax.Array
    is_fixed: jax.Array
    free_count: jax.Array

    def is_violated(self, problem: ConstrainedProblem, value: jax.Array) -> jax.Array:
        """Return whether a constraint is fixed, and its value negative (G, C)."""
        is_constrained = True if problem.is_constrained is None else problem.is_constrained[:, None]
        return self.is_fixed & (value < -VIOLATED * self.largest_sd) & is_constrained


def constraint_margins(problem: ConstrainedProblem, smoothed: SmootherTrace) -> ConstraintMargins:
    """Return the constraints at the smoothed means, with their standard deviations."""
    ssm, outputs = problem.ssm, problem.outputs

    def value_and_sd(mean: jax.Array, covariance: jax.Array, t: jax.Array) -> tuple[jax.Array, jax.Array]:
        def constraints(s: jax.Array) -> jax.Array:
            return ssm.observe(ssm.inputs(s, t), t)[outputs:]

        return constraints(mean), safe_sqrt(diagonal(congruence(jax.jacfwd(constraints)(mean), covariance)))

    mean, covariance = (problem.at_grid(a[1:]) for a in smoothed.moments)
    value, sd = jax.vmap(value_and_sd)(mean, covariance, problem.grid_times)
    largest_sd = jnp.max(sd, axis=0, initial=0.0)
    is_fixed = ~(sd > jnp.sqrt(FIXED_VARIANCE) * largest_sd)
    if problem.is_constrained is not None:
        is_fixed = is_fixed | ~problem.is_constrained[:, None]
    return ConstraintMargins(value, jnp.where(is_fixed, 1.0, sd), largest_sd, is_fixed,
                             jnp.maximum(jnp.sum(~is_fixed), 1))


class Solution(eqx.Module):
    """Result of an interior point.

    Attributes:
        mean: (N + 1, n), the trajectory at the scan's nodes.
        slack, multiplier: (G, C); the value, at least 0, and zero for a fixed constraint.
        gap: sum of s lambda, in units of the log density.
        residual: largest |c - s| over the constraints, in standard deviations.
        violation: (G, C), distance of a constraint from its slack, in standard deviations.
        sd: (G, C), standard deviations of the constraints given the data alone; 1 for a fixed constraint.
        is_fixed: (G, C), whether the constraint has no variance, or does not hold at the row.
        is_violated: (G, C), whether the constraint has no variance and is negative.
        objective: minus the log density of the trajectory and the data up to a constant, J.
        passes: number of smoother passes.
        converged: whether gap and residual are below their tolerances.
    """

    mean: jax.Array
    slack: jax.Array
    multiplier: jax.Array
    gap: jax.Array
    residual: jax.Array
    violation: jax.Array
    sd: jax.Array
    is_fixed: jax.Array
    is_violated: jax.Array
    objective: jax.Array
    passes: jax.Array
    converged: jax.Array


class InteriorPointIterate(NamedTuple):
    """Iterate of a primal-dual interior point, for linear and non-linear problems.

    Attributes:
        primal: trajectory and objective of `solve_linear`; `lfm_ppl.constrained.gauss_newton.GaussNewtonState` of
            `solve_nonlinear`.
        slack, multiplier: (G, C).
        gap: duality gap, sum of s lambda.
        residual: largest |c - s|, in standard deviations.
        passes: number of smoother passes so far.
        is_finished: whether the iteration ends here, converged or not.
    """

    primal: Any
    slack: jax.Array
    multiplier: jax.Array
    gap: jax.Array
    residual: jax.Array
    passes: jax.Array
    is_finished: jax.Array


def initial_iterate(primal: Any, value: jax.Array, margins: ConstraintMargins,
                    is_finished: jax.Array) -> InteriorPointIterate:
    """Return the first iterate, with slacks of at least one standard deviation; ``value`` (G, C) of the constraints."""
    slack = jnp.where(margins.is_fixed, 1.0, jnp.maximum(value, margins.sd))
    multiplier = jnp.where(margins.is_fixed, 0.0, INITIAL_PRODUCT / slack)
    return InteriorPointIterate(primal, slack, multiplier, jnp.sum(slack * multiplier), jnp.asarray(jnp.inf),
                                jnp.asarray(1), is_finished)


def pseudo_observations(iterate: InteriorPointIterate, mu: jax.Array,
                        is_fixed: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return targets z and variances V (G, C) of Newton's step; NaN targets for fixed constraints."""
    multiplier = jnp.where(is_fixed, 1.0, iterate.multiplier)
    return jnp.where(is_fixed, jnp.nan, iterate.slack + mu / multiplier), iterate.slack / multiplier


def newton_direction(iterate: InteriorPointIterate, mu: jax.Array, noise: jax.Array,
                     is_fixed: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the changes (G, C) of slacks and multipliers, from the weighted pseudo-noise of a pass."""
    multiplier = jnp.where(is_fixed, 1.0, iterate.multiplier)
    slack_change = jnp.where(is_fixed, 0.0, (mu - iterate.slack * noise) / multiplier)
    return slack_change, jnp.where(is_fixed, 0.0, noise - iterate.multiplier)


def longest_step(value: jax.Array, change: jax.Array) -> jax.Array:
    """Return the largest step size, at most 1, with which each entry of ``value`` > 0 keeps 1% of its value."""
    is_falling = change < 0
    ratio = jnp.where(is_falling, -value / jnp.where(is_falling, change, 1.0), jnp.inf)
    return jnp.minimum(1.0, BOUNDARY_FRACTION * jnp.min(ratio, initial=jnp.inf))


def iterate_until_finished(step: Callable[[InteriorPointIterate], InteriorPointIterate],
                           iterate: InteriorPointIterate, max_passes: int) -> InteriorPointIterate:
    """Apply ``step`` until the iterate is finished, or the number of passes is ``max_passes``."""
    return jax.lax.while_loop(lambda i: ~i.is_finished & (i.passes < max_passes), step, iterate)


def linear_objective(problem: ConstrainedProblem, forward_pass: FilterTrace, smoothed: SmootherTrace) -> jax.Array:
    """Return J at the smoothed trajectory of a linear model, half the sum of the squared smoothed noises.

    In terms of the adjoint r the noises are Q r, P_0 r_0 and R (R^-1 E[noise]), so that no matrix is inverted.
    """
    r0, r = start_adjoint(forward_pass, smoothed), smoothed.adjoint[0]
    noise = weighted_noise(forward_pass, smoothed)[:, : problem.outputs]
    obs_cov = forward_pass.update.obs_cov[:, : problem.outputs, : problem.outputs]
    terms = ((r, forward_pass.process_cov), (r0, problem.start.covariance), (noise, obs_cov))
    return jnp.asarray(0.5 * sum((v * matmul(p, v[..., None])[..., 0]).sum() for v, p in terms))


def solve_linear(problem: ConstrainedProblem, tolerance: float, max_passes: int) -> Solution:
    """Solve the problem of a model that is linear in states and forces, with linear constraints.

    Args:
        problem: the problem.
        tolerance: tolerance of the duality gap, in units of the log density.
        max_passes: largest number of passes.
    """
    no_targets = problem.no_targets
    forward_pass, smoothed, _ = smoother_pass(problem, no_targets, jnp.ones_like(no_targets))
    margins = constraint_margins(problem, smoothed)
    is_fixed, sd = margins.is_fixed, margins.sd
    is_violated = margins.is_violated(problem, margins.value)
    is_feasible = (is_fixed | (margins.value >= 0)).all()

    def step(iterate: InteriorPointIterate) -> InteriorPointIterate:
        mu = CENTRING * iterate.gap / margins.free_count
        forward_pass, smoothed, noise = smoother_pass(problem, *pseudo_observations(iterate, mu, is_fixed))
        slack_change, multiplier_change = newton_direction(iterate, mu, noise, is_fixed)
        # A pass depends on s and lambda alone, not on the trajectory, so that their steps may differ.
        slack_step = longest_step(iterate.slack, slack_change)
        multiplier_step = longest_step(iterate.multiplier, multiplier_change)
        slack = iterate.slack + slack_step * slack_change
        multiplier = iterate.multiplier + multiplier_step * multiplier_change
        gap = jnp.sum(jnp.where(is_fixed, 0.0, slack * multiplier))
        residual = jnp.max(jnp.abs((1.0 - slack_step) * slack_change) / sd, initial=0.0)
        primal = smoothed.moments.mean, linear_objective(problem, forward_pass, smoothed)
        next_iterate = InteriorPointIterate(primal, slack, multiplier, gap, residual, iterate.passes + 1,
                                            (gap <= tolerance) & (residual <= jnp.sqrt(tolerance)))
        # The multipliers of an infeasible problem grow without bound; the last finite iterate shows the rows.
        is_finite = jnp.isfinite(gap) & jnp.isfinite(noise).all()
        stopped = iterate._replace(is_finished=jnp.asarray(True))
        return jax.tree_util.tree_map(lambda a, b: jnp.where(is_finite, a, b), next_iterate, stopped)

    primal = smoothed.moments.mean, linear_objective(problem, forward_pass, smoothed)
    first = initial_iterate(primal, margins.value, margins, is_feasible)
    last = iterate_until_finished(step, first, max_passes)
    mean, objective = last.primal
    is_solved = is_feasible | (last.gap <= tolerance) & (last.residual <= jnp.sqrt(tolerance))
    # Without active constraints the smoother's trajectory is the solution.
    slack = jnp.where(is_feasible, margins.value, last.slack)
    slack = jnp.where(is_fixed, jnp.maximum(margins.value, 0.0), slack)
    violation = jnp.where(is_fixed, 0.0, jnp.abs(constraint_values(problem, mean) - slack) / sd)
    return Solution(
        mean, slack, jnp.where(is_feasible | is_fixed, 0.0, last.multiplier),
        jnp.where(is_feasible, 0.0, last.gap), jnp.where(is_feasible, 0.0, last.residual), violation, sd, is_fixed,
        is_violated, objective, last.passes, is_solved & ~is_violated.any() & (violation <= RESPECTED).all())
