r"""A primal-dual interior point whose Newton step is one smoother pass.

The MAP trajectory under constraints minimises J, minus the log density of states and data, subject to c(x, u, t) >= 0
on some rows. With slacks s and multipliers lambda the optimality conditions, the last one relaxed by mu, are

    grad J = C' lambda,    c = s,    s lambda = mu,    s, lambda > 0.

Newton's step for them minimises J + sum (lambda / 2 s) (c - z)^2: a smoother pass with the pseudo-observations

    z = s + mu / lambda    of variance    V = s / lambda,

after which lambda+ = mu / s - (lambda / s) (c - s) and s+ = c. Both are taken from the adjoint of the smoother and not
from its mean: lambda+ = S^-1 v - K' r is the smoothed pseudo-noise (z - c) / V, and s+ = z - V lambda+, so that a slack
of 1e-15 has all its digits.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from lfm_ppl.constrained.augmented import Rows, with_rows
from lfm_ppl.filtering.filter import Pass, Transitions, forward
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.rts import Smoothed, backward
from lfm_ppl.filtering.time_grid import TimeGrid
from lfm_ppl.linalg import congruence, diagonal, matmul, safe_sqrt, solve_lower, solve_upper
from lfm_ppl.linearisation.taylor import Taylor
from lfm_ppl.model.state_space import StateSpaceModel

CENTRING = 0.1
"""mu as a share of the mean of s lambda."""
BOUNDARY = 0.99
"""Share of the way to the boundary that a step goes at most."""
START = 0.1
"""Product s lambda of the first iterate."""
KNOWN = 1e-12
"""Variance, as a share of the constraint's largest over the rows, below which it is known and no pass can move it."""
RESPECTED = 1e-6
"""Distance of a constraint from its slack, in standard deviations, up to which it is respected. Slacks follow the
adjoint; where no trajectory is feasible they vanish, and only the trajectory tells."""
VIOLATED = 1e-9
"""Share of the constraint's largest standard deviation by which a known value must be negative to violate it."""


class Problem(NamedTuple):
    """What a pass needs besides the pseudo-observations.

    Attributes:
        ssm: the model with the constraints as further outputs.
        grid: the time grid over the rows.
        rows: which rows hold observations, and which constraints.
        y: (T, D), NaN where missing.
        start: moments at the initial time.
        held: (G,), at which times of the grid the constraints hold; all by default.
        transitions: of a linear model's intervals, where they are known ahead of all passes.
    """

    ssm: StateSpaceModel
    grid: TimeGrid
    rows: Rows
    y: jax.Array
    start: Moments
    held: Any = None
    transitions: Transitions | None = None

    @property
    def width(self) -> int:
        """C, the number of constraints at a time."""
        return self.ssm.output_dim - self.y.shape[1]

    def with_targets(self, targets: jax.Array, variances: jax.Array) -> tuple[StateSpaceModel, jax.Array]:
        """Return model and observations with pseudo-observations (G, C), NaN for none, of these variances (G, C)."""
        whole = jnp.ones((len(self.rows.times), self.width)).at[self.rows.grid].set(variances)
        ssm = eqx.tree_at(lambda m: m.model.observation.variances, self.ssm, whole)
        return ssm, with_rows(self.y, targets, self.rows)

    def at_grid(self, a: jax.Array) -> jax.Array:
        """Return the entries at the grid's rows of what has one for each interval of the scan."""
        return a[jnp.asarray(self.grid.observed)[jnp.asarray(self.rows.grid)]]


class Scan(NamedTuple):
    """Both scans with given pseudo-observations.

    Attributes:
        passed: the forward scan.
        smoothed: the backward scan.
        noise: (G, C), smoothed pseudo-noise over its variance, (z - c) / V; zero without a pseudo-observation.
    """

    passed: Pass
    smoothed: Smoothed
    noise: jax.Array


def scan(problem: Problem, targets: jax.Array, variances: jax.Array) -> Scan:
    """Run a smoother pass with pseudo-observations (G, C) of the constraints, NaN for none."""
    ssm, y = problem.with_targets(targets, variances)
    passed = forward(ssm, Taylor(), problem.grid, y, start=problem.start, keep="all",
                     transitions=problem.transitions)
    smoothed = backward(passed, problem.start, problem.grid)
    return Scan(passed, smoothed, problem.at_grid(weighted_noise(passed, smoothed))[:, problem.y.shape[1]:])


def weighted_noise(passed: Pass, smoothed: Smoothed) -> jax.Array:
    """Return (N, D): R^-1 E[noise | all observations] = S^-1 v - K' r, with r of the later observations alone."""
    r = smoothed.adjoint[0]
    later = jnp.concatenate([matmul(jnp.swapaxes(passed.phi[1:], 1, 2), r[1:, :, None])[..., 0], jnp.zeros_like(r[:1])])
    white = jax.vmap(lambda chol, v: solve_upper(chol, solve_lower(chol, v)))(passed.chol, passed.innovation)
    return white - matmul(jnp.swapaxes(passed.gain, 1, 2), later[..., None])[..., 0]


def start_adjoint(passed: Pass, smoothed: Smoothed) -> jax.Array:
    """Return r_0 (n,), with which the smoothed state at the initial time is m_0 + P_0 r_0."""
    return matmul(passed.phi[0].T, smoothed.adjoint[0][0][:, None])[:, 0]


def constraint_values(problem: Problem, nodes: jax.Array) -> jax.Array:
    """Return the constraints (G, C) along a trajectory (N + 1, n)."""
    ssm, first = problem.ssm, problem.y.shape[1]
    times = jnp.asarray(problem.rows.times)[jnp.asarray(problem.rows.grid)]
    return jax.vmap(lambda s, t: ssm.observe(ssm.inputs(s, t), t)[first:])(problem.at_grid(nodes[1:]), times)


class Margins(NamedTuple):
    """The constraints along the smoothed trajectory of a pass without them.

    Attributes:
        value: (G, C).
        sd: (G, C), standard deviations to first order; 1 where a value is known.
        largest: (C,), the largest of each constraint.
        known: (G, C), whether no pass can move the constraint, or it is not held.
        free: the number of those that are not known, at least 1.
    """

    value: jax.Array
    sd: jax.Array
    largest: jax.Array
    known: jax.Array
    free: jax.Array

    def violated(self, problem: Problem, value: jax.Array) -> jax.Array:
        """Return (G, C), whether a value is known, and negative."""
        held = True if problem.held is None else problem.held[:, None]
        return self.known & (value < -VIOLATED * self.largest) & held


def margins(problem: Problem, smoothed: Smoothed) -> Margins:
    """Return the constraints at the smoothed means, and by how much they are uncertain to first order."""
    ssm, first = problem.ssm, problem.y.shape[1]

    def one(mean: jax.Array, covariance: jax.Array, t: jax.Array) -> tuple[jax.Array, jax.Array]:
        function = lambda s: ssm.observe(ssm.inputs(s, t), t)[first:]  # noqa: E731
        return function(mean), safe_sqrt(diagonal(congruence(jax.jacfwd(function)(mean), covariance)))

    mean, covariance = (problem.at_grid(a[1:]) for a in smoothed.moments)
    value, sd = jax.vmap(one)(mean, covariance, jnp.asarray(problem.rows.times)[jnp.asarray(problem.rows.grid)])
    largest = jnp.max(sd, axis=0, initial=0.0)
    known = ~(sd > jnp.sqrt(KNOWN) * largest)
    if problem.held is not None:
        known = known | ~problem.held[:, None]
    return Margins(value, jnp.where(known, 1.0, sd), largest, known, jnp.maximum(jnp.sum(~known), 1))


class Solution(NamedTuple):
    """Where the iterations ended.

    Attributes:
        mean: (N + 1, n), the trajectory at the scan's nodes.
        slack, multiplier: (G, C); infinity and zero where a constraint is not met by any pass (``known``).
        gap: sum of s lambda, in units of the log density.
        residual: largest |c - s| over the constraints, in standard deviations.
        violation: (G, C), how far a constraint is from where its slack is, in standard deviations.
        sd: (G, C), standard deviations of the constraints without them; 1 where a value is known.
        known: (G, C), whether the constraint's value has no variance.
        violated: (G, C), whether such a value is negative.
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
    known: jax.Array
    violated: jax.Array
    objective: jax.Array
    passes: jax.Array
    converged: jax.Array


class _Iterate(NamedTuple):
    mean: jax.Array
    objective: jax.Array
    slack: jax.Array
    multiplier: jax.Array
    gap: jax.Array
    residual: jax.Array
    passes: jax.Array
    done: jax.Array


def objective(problem: Problem, one: Scan) -> jax.Array:
    """Return J at the smoothed trajectory of a linear model: half the squares of what the noises are smoothed to.

    With the adjoint r these are Q r, P_0 r_0 and R (R^-1 E[noise]), so that nothing is inverted.
    """
    passed, r = one.passed, one.smoothed.adjoint[0]
    r0 = start_adjoint(passed, one.smoothed)
    noise = weighted_noise(passed, one.smoothed)[:, : problem.y.shape[1]]
    obs_cov = passed.obs_cov[:, : problem.y.shape[1], : problem.y.shape[1]]
    terms = ((r, passed.process_cov), (r0, problem.start.covariance), (noise, obs_cov))
    return jnp.asarray(0.5 * sum((v * matmul(p, v[..., None])[..., 0]).sum() for v, p in terms))


def longest_step(value: jax.Array, change: jax.Array) -> jax.Array:
    """Return the share of ``change`` after which the first entry of ``value`` > 0 has gone 0.99 of the way to zero."""
    ratio = jnp.where(change < 0, -value / jnp.where(change < 0, change, 1.0), jnp.inf)
    return jnp.minimum(1.0, BOUNDARY * jnp.min(ratio, initial=jnp.inf))


def solve_linear(problem: Problem, tolerance: float, most: int) -> Solution:
    """Solve the problem of a model that is linear in states and forces, with linear constraints.

    Args:
        problem: what is to be solved.
        tolerance: of the duality gap, in units of the log density.
        most: number of passes, at most.
    """
    nothing = jnp.full((len(problem.rows.grid), problem.width), jnp.nan)
    free = scan(problem, nothing, jnp.ones_like(nothing))
    at = margins(problem, free.smoothed)
    known, sd, count = at.known, at.sd, at.free
    violated = at.violated(problem, at.value)
    slack = jnp.where(known, 1.0, jnp.maximum(at.value, sd))
    multiplier = jnp.where(known, 0.0, START / slack)
    feasible = (known | (at.value >= 0)).all()

    def step(now: _Iterate) -> _Iterate:
        s, multiplier = now.slack, now.multiplier
        mu = CENTRING * now.gap / count
        safe = jnp.where(known, 1.0, multiplier)
        target = jnp.where(known, jnp.nan, s + mu / safe)
        one = scan(problem, target, s / safe)
        ds = jnp.where(known, 0.0, (mu - s * one.noise) / safe)
        dm = jnp.where(known, 0.0, one.noise - multiplier)
        # A pass starts from s and lambda alone, so that they may go different ways.
        share, dual = longest_step(s, ds), longest_step(safe, dm)
        slack, multiplier = s + share * ds, multiplier + dual * dm
        gap = jnp.sum(jnp.where(known, 0.0, slack * multiplier))
        residual = jnp.max(jnp.abs((1.0 - share) * ds) / sd, initial=0.0)
        done = (gap <= tolerance) & (residual <= jnp.sqrt(tolerance))
        new = _Iterate(one.smoothed.moments.mean, objective(problem, one), slack, multiplier, gap, residual,
                       now.passes + 1, done)
        # Multipliers of an infeasible problem grow without bound; the last finite iterate tells the rows.
        good = jnp.isfinite(gap) & jnp.isfinite(one.noise).all()
        stopped = now._replace(done=jnp.asarray(True))
        return jax.tree_util.tree_map(lambda a, b: jnp.where(good, a, b), new, stopped)

    first = _Iterate(free.smoothed.moments.mean, objective(problem, free), slack, multiplier,
                     jnp.sum(slack * multiplier), jnp.asarray(jnp.inf), jnp.asarray(1), feasible)
    last = jax.lax.while_loop(lambda now: ~now.done & (now.passes < most), step, first)
    solved = feasible | (last.gap <= tolerance) & (last.residual <= jnp.sqrt(tolerance))
    # Where nothing is active the smoother's own trajectory is the solution.
    slack = jnp.where(feasible, at.value, last.slack)
    slack = jnp.where(known, jnp.maximum(at.value, 0.0), slack)
    violation = jnp.where(known, 0.0, jnp.abs(constraint_values(problem, last.mean) - slack) / sd)
    return Solution(
        last.mean, slack, jnp.where(feasible | known, 0.0, last.multiplier),
        jnp.where(feasible, 0.0, last.gap), jnp.where(feasible, 0.0, last.residual), violation, sd, known, violated,
        last.objective, last.passes, solved & ~violated.any() & (violation <= RESPECTED).all())
