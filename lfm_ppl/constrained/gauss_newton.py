r"""The interior point for models that bend: Gauss-Newton with Levenberg-Marquardt damping, and a merit function.

A trajectory is described by its disturbances, s_0 = m_0 + P_0 r_0 and s_k+1 = F_k(s_k) + Q_k r_k, where F_k is the
integrated mean of an interval, and Q_k its process covariance at the iterate. The objective is

    J = r_0' P_0 r_0 / 2 + sum_k r_k' Q_k r_k / 2 + sum_i (y_i - h(s_i))' R_i^-1 (y_i - h(s_i)) / 2,

which needs no inverse of Q, so that states without noise of their own do no harm. r is the adjoint of a smoother pass:
linearised about the iterate (the whole trajectory, not the filter's), a pass gives the Gauss-Newton step. Damping with
delta adds delta / 2 |q - q_old|^2 in the metric of Q^-1, that is, disturbances q ~ N(delta / (1 + delta) q_old,
Q / (1 + delta)): a pseudo-observation of the disturbances, which needs no further outputs.

A step is taken where it lowers the merit

    J - mu sum log s + sum nu |c - s|,    nu above the multipliers,

along the trajectory rolled out through the non-linear dynamics; otherwise it is halved, and the damping grows. Q and R
are those at the iterate, not differentiated: the solution is stationary for J with the Q and R of the solution.

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
    START,
    Problem,
    Solution,
    constraint_values,
    longest_step,
    margins,
    scan,
    start_adjoint,
    weighted_noise,
)
from lfm_ppl.filtering.filter import Points, Transitions, forward, predict, preparation
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.rts import backward
from lfm_ppl.filtering.time_grid import as_arrays
from lfm_ppl.gaussian_residuals import masked, wrapped
from lfm_ppl.linalg import cholesky, matmul, solve_lower
from lfm_ppl.linearisation.taylor import Taylor

_HALVINGS = 8
_LEAST_DAMPING, _FIRST_DAMPING = 1e-6, 1e-2
_ROUNDING = 1e-12
"""Relative increase of the merit function that may be rounding."""


class Path(NamedTuple):
    """A trajectory that obeys the dynamics, with its disturbances.

    Attributes:
        nodes: (N + 1, n), the states.
        start: r_0 (n,).
        r: (N, n).
    """

    nodes: jax.Array
    start: jax.Array
    r: jax.Array


class _Iterate(NamedTuple):
    path: Path
    process_cov: jax.Array
    slack: jax.Array
    multiplier: jax.Array
    penalty: jax.Array
    damping: jax.Array
    centring: jax.Array
    gap: jax.Array
    residual: jax.Array
    decrement: jax.Array
    passes: jax.Array
    done: jax.Array


class Dynamics:
    """The maps of the intervals of a problem."""

    def __init__(self, problem: Problem):
        self.problem, self.ssm = problem, problem.ssm
        self.prepared = preparation(problem.ssm, Taylor(), problem.grid)
        self.intervals = as_arrays(problem.grid.intervals)

    def predicted(self, interval: Any, state: jax.Array, with_map: bool) -> Any:
        """Return the prediction from a known state (n,) over an interval."""
        still = jnp.zeros((state.shape[0],) * 2)
        return predict(self.ssm, Taylor(), self.problem.grid, self.prepared, interval, Moments(state, still),
                       with_map=with_map)

    def linearised(self, nodes: jax.Array) -> Transitions:
        """Return the maps of all intervals, linearised about a trajectory (N + 1, n)."""

        def one(interval: Any, state: jax.Array) -> Transitions:
            found = self.predicted(interval, state, True)
            return Transitions(state, found.moments.mean, found.phi, found.process_cov)

        return jax.vmap(one)(self.intervals, nodes[:-1])

    def rolled(self, start: jax.Array, r: jax.Array, process_cov: jax.Array) -> Path:
        """Return the trajectory with these disturbances."""
        prior = self.problem.start
        first = prior.mean + matmul(prior.covariance, start[:, None])[:, 0]

        def step(state: jax.Array, at: tuple) -> tuple[jax.Array, jax.Array]:
            interval, r, q = at
            new = self.predicted(interval, state, False).moments.mean + matmul(q, r[:, None])[:, 0]
            return new, new

        _, nodes = jax.lax.scan(step, first, (self.intervals, r, process_cov))
        return Path(jnp.concatenate([first[None], nodes]), start, r)


def _rows_of_data(problem: Problem, nodes: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return states (T, n) and times (T,) of the observations."""
    at = jnp.asarray(problem.grid.observed)[jnp.asarray(problem.rows.data)]
    return nodes[1:][at], jnp.asarray(problem.rows.times)[jnp.asarray(problem.rows.data)]


def _noise_factors(problem: Problem, nodes: jax.Array) -> jax.Array:
    """Return the Cholesky factors (T, D, D) of the observations' noise along a trajectory."""
    ssm, outputs = problem.ssm, problem.y.shape[1]
    assert isinstance(ssm.model.observation, AugmentedObservation)
    inner = ssm.model.observation.inner

    def one(state: jax.Array, t: jax.Array, row: jax.Array, y: jax.Array) -> jax.Array:
        covariance = inner.covariance_at(*ssm.split(ssm.inputs(state, t)), t, row)
        return cholesky(masked(jnp.zeros(outputs), covariance, jnp.isfinite(y))[1]).chol

    return jax.vmap(one)(*_rows_of_data(problem, nodes), jnp.arange(problem.y.shape[0]), problem.y)


def _objective(problem: Problem, path: Path, process_cov: jax.Array, chol: jax.Array) -> jax.Array:
    """Return J."""
    ssm, outputs = problem.ssm, problem.y.shape[1]

    def misfit(state: jax.Array, t: jax.Array, y: jax.Array, chol: jax.Array) -> jax.Array:
        residual = jnp.where(jnp.isfinite(y), y, 0.0) - ssm.observe(ssm.inputs(state, t), t)[:outputs]
        for index in ssm.model.observation.angular:
            residual = residual.at[index].set(wrapped(residual[index]))
        return (solve_lower(chol, jnp.where(jnp.isfinite(y), residual, 0.0)) ** 2).sum()

    data = jax.vmap(misfit)(*_rows_of_data(problem, path.nodes), problem.y, chol)
    return 0.5 * (_square(path.start, problem.start.covariance) + _square(path.r, process_cov) + data.sum())


def _square(r: jax.Array, p: jax.Array) -> jax.Array:
    """Return r' P r, summed over leading dimensions."""
    return (r * matmul(p, r[..., None])[..., 0]).sum()


def solve_nonlinear(problem: Problem, tolerance: float, most: int) -> Solution:
    """Solve the problem of any model; arguments as in `lfm_ppl.constrained.interior_point.solve_linear`."""
    dynamics, start = Dynamics(problem), problem.start
    nothing = jnp.full((len(problem.rows.grid), problem.width), jnp.nan)
    free = scan(problem, nothing, jnp.ones_like(nothing))
    at = margins(problem, free.smoothed)
    known, sd, count = at.known, at.sd, at.free

    def step(now: _Iterate) -> _Iterate:
        process_cov = dynamics.linearised(now.path.nodes).process_cov
        path = dynamics.rolled(now.path.start, now.path.r, process_cov)
        maps = dynamics.linearised(path.nodes)._replace(process_cov=process_cov)
        chol = _noise_factors(problem, path.nodes)
        s, multiplier = now.slack, now.multiplier
        mu = now.centring * now.gap / count
        safe = jnp.where(known, 1.0, multiplier)
        r0, r, noise = _gauss_newton(problem, path, maps, now.damping, jnp.where(known, jnp.nan, s + mu / safe),
                                     s / safe)
        ds = jnp.where(known, 0.0, (mu - s * noise) / safe)
        dm = jnp.where(known, 0.0, noise - multiplier)
        dr0, dr = r0 - path.start, r - path.r
        penalty = jnp.maximum(now.penalty, jnp.where(known, 0.0, 2.0 * jnp.abs(noise)))

        def merit(path: Path, s: jax.Array) -> jax.Array:
            apart = jnp.where(known, 0.0, jnp.abs(constraint_values(problem, path.nodes) - s))
            barrier = jnp.where(known, 0.0, jnp.log(s)).sum()
            value = _objective(problem, path, process_cov, chol) - mu * barrier + (penalty * apart).sum()
            return jnp.where(jnp.isfinite(value), value, jnp.inf)

        old, longest = merit(path, s), longest_step(s, ds)

        def candidate(share: jax.Array) -> tuple[Path, jax.Array]:
            return dynamics.rolled(path.start + share * dr0, path.r + share * dr, process_cov), s + share * ds

        def good(value: jax.Array) -> jax.Array:
            return value <= old + _ROUNDING * jnp.maximum(1.0, jnp.abs(old))

        def halve(carry: tuple) -> tuple:
            share, tries = 0.5 * carry[0], carry[1] + 1
            new = candidate(share)
            return share, tries, *new, merit(*new)

        whole = candidate(longest)
        _, tries, new, slack, value = jax.lax.while_loop(
            lambda carry: ~good(carry[4]) & (carry[1] < _HALVINGS), halve, (longest, 0, *whole, merit(*whole)))
        accepted = good(value)
        new, slack = jax.tree_util.tree_map(lambda a, b: jnp.where(accepted, a, b), (new, slack), (path, s))
        multiplier = multiplier + jnp.where(accepted, longest_step(safe, dm), 0.0) * dm
        at_once = accepted & (tries == 0)
        damping = jnp.where(at_once, 0.1 * now.damping,
                            jnp.maximum(jnp.where(accepted, 2.0, 10.0) * now.damping, _FIRST_DAMPING))
        damping = jnp.where(damping < _LEAST_DAMPING, 0.0, damping)
        gap = jnp.where(known, 0.0, slack * multiplier).sum()
        apart = jnp.where(known, 0.0, jnp.abs(constraint_values(problem, new.nodes) - slack)) / sd
        residual = jnp.max(apart, initial=0.0)
        decrement = _square(dr, process_cov) + _square(dr0, start.covariance)
        done = ((gap <= tolerance) & (residual <= jnp.sqrt(tolerance)) & (decrement <= tolerance) & accepted
                & (now.damping <= _FIRST_DAMPING))
        return _Iterate(new, process_cov, slack, multiplier, penalty, damping, jnp.where(at_once, CENTRING, 0.5), gap,
                        residual, decrement, now.passes + 1, done | ~jnp.isfinite(gap + decrement))

    path = _first_path(problem, dynamics, free)
    slack = jnp.where(known, 1.0, jnp.maximum(constraint_values(problem, path.nodes), sd))
    multiplier = jnp.where(known, 0.0, START / slack)
    unknown = jnp.asarray(jnp.inf)
    first = _Iterate(path, free.passed.process_cov, slack, multiplier, jnp.zeros_like(slack), jnp.asarray(0.0),
                     jnp.asarray(CENTRING), jnp.sum(slack * multiplier), unknown, unknown, jnp.asarray(1),
                     ~jnp.isfinite(path.nodes).all())
    last = jax.lax.while_loop(lambda now: ~now.done & (now.passes < most), step, first)
    value = constraint_values(problem, last.path.nodes)
    violated = at.violated(problem, value)
    slack = jnp.where(known, jnp.maximum(value, 0.0), last.slack)
    finite = jnp.isfinite(last.gap + last.decrement) & jnp.isfinite(last.path.nodes).all()
    objective = _objective(problem, last.path, last.process_cov, _noise_factors(problem, last.path.nodes))
    return Solution(last.path.nodes, slack, jnp.where(known, 0.0, last.multiplier), last.gap, last.residual,
                    jnp.where(known, 0.0, jnp.abs(value - slack) / sd), sd, known, violated, objective, last.passes,
                    last.done & finite & ~violated.any())


def _gauss_newton(problem: Problem, path: Path, maps: Transitions, damping: jax.Array, targets: jax.Array,
                  variances: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return r_0 (n,) and r (N, n) at the end of a damped step, and the multipliers (G, C) there."""
    held = damping / (1.0 + damping)
    ssm, y = problem.with_targets(targets, variances)
    maps = maps._replace(mean=maps.mean + held * matmul(maps.process_cov, path.r[..., None])[..., 0],
                         process_cov=(1.0 - held) * maps.process_cov)
    prior = Moments(problem.start.mean + held * matmul(problem.start.covariance, path.start[:, None])[:, 0],
                    (1.0 - held) * problem.start.covariance)
    ends = Moments(path.nodes[1:], jnp.zeros_like(maps.process_cov))
    passed = forward(ssm, Taylor(), problem.grid, y, start=prior, keep="all", transitions=maps,
                     linearization_point=Points(ends, ends))
    smoothed = backward(passed, prior, problem.grid)
    noise = problem.at_grid(weighted_noise(passed, smoothed))[:, problem.y.shape[1]:]
    return (held * path.start + (1.0 - held) * start_adjoint(passed, smoothed),
            held * path.r + (1.0 - held) * smoothed.adjoint[0], noise)


def _first_path(problem: Problem, dynamics: Dynamics, free: Any) -> Path:
    """Return the trajectory with the disturbances of the extended Kalman smoother, or with none if that is better."""
    guesses = []
    for share in (1.0, 0.0):
        r0, r = (share * jnp.nan_to_num(a) for a in (start_adjoint(free.passed, free.smoothed),
                                                      free.smoothed.adjoint[0]))
        path = dynamics.rolled(r0, r, free.passed.process_cov)
        cost = _objective(problem, path, free.passed.process_cov, _noise_factors(problem, path.nodes))
        guesses.append((path, jnp.where(jnp.isfinite(cost), cost, jnp.inf)))
    (smoothed, a), (prior, b) = guesses
    return jax.tree_util.tree_map(lambda x, y: jnp.where(a <= b, x, y), smoothed, prior)
