"""THE smoother: one backward scan over what the filter left, for any rule and any model."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.filtering.between import Places, marginals_between, places
from lfm_ppl.filtering.filter import (
    Pass,
    as_rule,
    check_observations,
    forward,
    standardised,
    warn_single_precision,
)
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.retrospect import combine, given_later
from lfm_ppl.filtering.schedule import Schedule, schedule
from lfm_ppl.filtering.simulation_smoother import smoothing_errors
from lfm_ppl.linalg import (
    cholesky,
    congruence,
    matmul,
    safe_sqrt,
    solve_lower,
    solve_upper,
)
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.augment import StateSpaceModel, state_space
from lfm_ppl.model.latent_force_model import LatentForceModel

_LONGEST_FORECAST = 10_000
"""Most rows of a forecast; a longer one gets a long last row (or `max_step`)."""

_LOG_2PI = float(np.log(2.0 * np.pi))


class Smoothed(NamedTuple):
    """What the backward scan leaves: nodes are the initial time and each row's end.

    Attributes:
        moments: smoothed, at the N + 1 nodes.
        gain: (N, n, n), G of the row: s_start | s_end has mean m_f + G (s_end - m_p).
        conditional: (N, n, n), covariance of s_start given s_end and the past.
        leave_one_out: (N,), log p(y_k | all other observations), zero in rows without one.
        adjoint: r (N, n) and Lambda (N, n, n) at the row's end, its observation and all later ones included: the
            smoothed mean there is m_p + P_p r, the covariance P_p - P_p Lambda P_p.
    """

    moments: Moments
    gain: jax.Array
    conditional: jax.Array
    leave_one_out: jax.Array
    adjoint: tuple[jax.Array, jax.Array]


class Marginal(NamedTuple):
    """Mean (K,) and standard deviation (K,) of one force or state at the requested times."""

    mean: jax.Array
    sd: jax.Array


class Trajectories(NamedTuple):
    """Draws of whole trajectories at the requested times.

    Attributes:
        times: (K,).
        state: (draws, K, M), the physical state.
        forces: name -> (draws, K).
    """

    times: jax.Array
    state: jax.Array
    forces: dict[str, jax.Array]


class SmootherResult(eqx.Module):
    """The outcome of `smooth`.

    Attributes:
        times: (K,) requested times.
        mean, covariance: (K, n), (K, n, n) of the joint state, given all observations.
        input_mean, input_covariance: (K, M + R), (K, M + R, M + R) of w = (x, u).
        log_likelihood: (T,), log p(y_k | y_1:k-1).
        leave_one_out: (T,), log p(y_k | y_-k).
        residual: (T, D), standardised one-step-ahead residuals, NaN where missing.
        change: largest change of a smoothed mean in the last iteration, in smoothed standard deviations; NaN
            without iterations.
    """

    times: jax.Array
    mean: jax.Array
    covariance: jax.Array
    input_mean: jax.Array
    input_covariance: jax.Array
    log_likelihood: jax.Array
    leave_one_out: jax.Array
    residual: jax.Array
    change: jax.Array
    _elements: Any
    _input_map: Any
    state_names: tuple[str, ...] = eqx.field(static=True)
    force_names: tuple[str, ...] = eqx.field(static=True)

    def force(self, name: str) -> Marginal:
        """Return mean (K,) and sd (K,) of a force.

        Raises:
            ValueError: unknown name; the message has the nearest ones.
        """
        return self._marginal("force", name, self.force_names, len(self.state_names))

    def state(self, name: str) -> Marginal:
        """Return mean (K,) and sd (K,) of a physical state."""
        return self._marginal("state", name, self.state_names, 0)

    def _marginal(self, kind: str, name: str, names: tuple[str, ...], first: int) -> Marginal:
        checks.one_of(kind, name, names)
        index = first + names.index(name)
        return Marginal(self.input_mean[:, index], safe_sqrt(self.input_covariance[:, index, index]))

    def sample(self, key: jax.Array, draws: int = 1) -> Trajectories:
        """Draw whole trajectories from the joint smoothing distribution, by `smoothing_errors`.

        Args:
            key: a JAX random key.
            draws: number of trajectories.

        Returns:
            Physical state and forces at the requested times, jointly Gaussian in time.

        Example:
            >>> result.sample(jax.random.key(0), 3).state.shape  # doctest: +SKIP
            (3, 25, 1)
        """
        checks.positive_integer("draws", draws)
        return _sample(self, key, draws)


@eqx.filter_jit
def _sample(result: SmootherResult, key: jax.Array, draws: int) -> Trajectories:
    requested, start, passed, mean = result._elements
    states = (mean[..., None] + smoothing_errors(key, passed, start, draws))[requested]
    matrix, offset = result._input_map
    inputs = jnp.moveaxis(matmul(matrix, states) + offset[..., None], -1, 0)
    size = len(result.state_names)
    forces = {name: inputs[:, :, size + index] for index, name in enumerate(result.force_names)}
    return Trajectories(result.times, inputs[:, :, :size], forces)


def backward(passed: Pass, start: Moments, plan: Schedule) -> Smoothed:
    """Run the one backward scan.

    Moments follow Rauch, Tung and Striebel, with the gain from a semi-definite solve and the covariance as a sum of
    squares, or the adjoint of Bryson and Frazier, r and Lambda, which needs no inverse of a covariance (`combine` says
    when). With u = S^-1 v - K' r and C = S^-1 + K' Lambda K, an observation given all the others is
    N(y - C^-1 u, C^-1).
    """
    length = jnp.asarray(plan.rows.length)
    still = (length == 0) & (jnp.asarray(plan.rows.jump) < 0)
    before = Moments(jnp.concatenate([start.mean[None], passed.filtered.mean[:-1]]),
                     jnp.concatenate([start.covariance[None], passed.filtered.covariance[:-1]]))
    size = start.mean.shape[0]
    identity = jnp.eye(size)

    def step(carry: tuple, row: tuple) -> tuple[tuple, tuple]:
        later, r, adjoint = carry
        at, one, at_rest = row
        gain, conditional = given_later(at, one.predicted, one.phi, one.noise)
        # Nothing happens in a row without length but for the observation at its end.
        gain, conditional = jnp.where(at_rest, identity, gain), jnp.where(at_rest, 0.0, conditional)
        left_out, r, adjoint = _leave_one_out(one, r, adjoint)
        back = matmul(one.phi.T, r[:, None])[:, 0], congruence(one.phi.T, adjoint)
        smoothed = combine(at, one.predicted, later, gain, conditional, *back)
        smoothed = jax.tree_util.tree_map(lambda a, b: jnp.where(at_rest, a, b), later, smoothed)
        return (smoothed, *back), (later, gain, conditional, left_out, (r, adjoint))

    last = Moments(passed.filtered.mean[-1], passed.filtered.covariance[-1])
    carry = (last, jnp.zeros(size), jnp.zeros((size, size)))
    (first, _, _), (ends, gain, conditional, left_out, adjoint) = jax.lax.scan(
        step, carry, (before, passed, still), reverse=True)
    moments = jax.tree_util.tree_map(lambda a, b: jnp.concatenate([a[None], b]), first, ends)
    return Smoothed(moments, gain, conditional, left_out, adjoint)


def _leave_one_out(one: Pass, r: jax.Array, adjoint: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Log density of a row's observation given all others, and the adjoint at the row's end with it."""
    outputs = one.innovation.shape[0]
    inverse = solve_upper(one.chol, solve_lower(one.chol, jnp.eye(outputs)))
    white = matmul(inverse, one.innovation[:, None])[:, 0]
    u = white - matmul(one.gain.T, r[:, None])[:, 0]
    precision = inverse + congruence(one.gain.T, adjoint)
    factor = cholesky(precision)
    # A missing entry has unit precision and u = 0, and so contributes nothing.
    left_out = (jnp.log(jnp.diagonal(factor.chol)).sum() - 0.5 * (solve_lower(factor.chol, u) ** 2).sum()
                - 0.5 * _LOG_2PI * one.present.sum())
    kept = jnp.eye(r.shape[0]) - matmul(one.gain, one.slope)
    r = matmul(one.slope.T, white[:, None])[:, 0] + matmul(kept.T, r[:, None])[:, 0]
    adjoint = congruence(one.slope.T, inverse) + congruence(kept.T, adjoint)
    return left_out, r, adjoint


def posterior_linearisation(ssm: StateSpaceModel, rule: Rule, plan: Schedule, y: jax.Array, start: Moments,
                            iterations: int, damping: float) -> tuple[Moments, jax.Array]:
    """Iterate: smooth, linearise about the smoothed marginals, smooth again.

    Args:
        ssm: the model.
        rule: the linearisation rule.
        plan: with a row for each integration step.
        y: (T, D), NaN where missing.
        start: moments at the initial time.
        iterations: fixed number, so that the result is a smooth function of the parameters.
        damping: share of the new marginals that is taken, in (0, 1].

    Returns:
        The marginals (N + 1 nodes) about which the last linearisation is made, and the largest change in the last
        iteration in standard deviations.
    """
    passed = forward(ssm, rule, plan, y, start=start, keep="all")
    about = backward(passed, start, plan).moments

    def iterate(carry: tuple, _: None) -> tuple[tuple, None]:
        about, _ = carry
        passed = forward(ssm, rule, plan, y, start=start, about=about, keep="all")
        new = backward(passed, start, plan).moments
        sd = safe_sqrt(jnp.diagonal(new.covariance, axis1=1, axis2=2))
        change = jnp.max(jnp.where(sd > 0, jnp.abs(new.mean - about.mean) / jnp.where(sd > 0, sd, 1.0), 0.0))
        return (jax.tree_util.tree_map(lambda a, b: a + damping * (b - a), about, new), change), None

    (about, change), _ = jax.lax.scan(jax.checkpoint(iterate), (about, jnp.asarray(jnp.nan)), None,
                                      length=iterations - 1)
    return about, change


def check_iterations(iterations: int, damping: float) -> None:
    """Raise where the iterations are not a whole number >= 0 or the damping is outside (0, 1]."""
    if iterations != 0:
        checks.positive_integer("iterations", iterations)
    if not 0 < damping <= 1:
        raise ValueError(f"damping must lie in (0, 1] (the share of each new iterate that is taken), got {damping}.")


def smooth(model: LatentForceModel, times: Any, y: Any, rule: Rule | None = None, steps: int = 10,
           max_step: float | None = None, at: Any = None, iterations: int = 0, damping: float = 0.7) -> SmootherResult:
    """Smooth: the state and the forces given all observations.

        m_s = m + G (m_s+ - m_p),  P_s = (I - G Phi) P (I - G Phi)' + G (Q + P_s+) G',  G = P Phi' P_p^-1.

    Args:
        model: the latent force model.
        times: (T,), non-decreasing.
        y: (T, D), NaN where missing.
        rule: linearisation rule; `Cubature()` by default.
        steps: integration steps between two consecutive times.
        max_step: longest step; longer intervals get more.
        at: (K,) times at which results are wanted, in any order, also after the last observation (a forecast).
            The observation times by default. They change nothing elsewhere.
        iterations: of posterior linearisation, 0 for none.
        damping: share of each new iterate that is taken, in (0, 1].

    Returns:
        Moments at the requested times, forces by name, draws of trajectories, diagnostics.

    Raises:
        ValueError, TypeError: as `lfm_ppl.filter`; also for a requested time before the initial time.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        >>> lfm.smooth(model, jnp.arange(3.0), jnp.ones((3, 1)), at=jnp.linspace(0, 4, 5)).force("u").mean.shape
        (5,)

    Source: Särkkä and Sarmavuori (2013); García-Fernández, Svensson and Särkkä (2017) for the iterations;
    de Jong (1989), Biometrika 76, for the leave-one-out conditionals.
    """
    rule = as_rule(rule)
    check_iterations(iterations, damping)
    ssm = state_space(model)
    plans = smoothing_plans(ssm, times, steps, max_step, at, iterations)
    model.check_at(plans.rows.initial_time, np.shape(times)[0])
    y = check_observations(y, len(plans.rows.observed), ssm.output_dim)
    warn_single_precision()
    return _run_smoother(ssm, rule, plans, y, iterations, damping)


class Plans(NamedTuple):
    """The scans of a smoother.

    Attributes:
        rows: of the likelihood and the marginals.
        joint: for draws of trajectories, with rows that end at the requested times too; None where ``rows`` serves:
            without requested times, and for a model whose rows are exact whatever their length.
        where: the requested times among ``rows``; None where ``joint`` is.
        times: (K,) requested times.
    """

    rows: Schedule
    joint: Schedule | None
    where: Places | None
    times: Any


def smoothing_plans(ssm: StateSpaceModel, times: Any, steps: int, max_step: float | None, at: Any,
                    iterations: int) -> Plans:
    """Plan a smoother's scans; a forecast goes on in rows as long as the data's median interval."""
    fine = iterations > 0
    joint = schedule(ssm, times, steps, max_step, at, row_per_step=fine)
    if at is None or ssm.time_invariant:
        return Plans(joint, None, None, joint.requested_times)
    known = np.asarray(times, float)
    beyond = np.array([])
    if joint.requested_times.max() > known[-1]:
        gaps = np.diff(known)
        gap = np.median(gaps[gaps > 0]) if np.any(gaps > 0) else joint.requested_times.max() - known[-1]
        count = int(np.ceil((joint.requested_times.max() - known[-1]) / gap * (1 - 1e-12)))
        beyond = known[-1] + gap * np.arange(1, min(count, _LONGEST_FORECAST) + 1)
        beyond[-1] = max(beyond[-1], joint.requested_times.max())
    base = schedule(ssm, times, steps, max_step, np.append(known[-1:], beyond), row_per_step=fine)
    return Plans(base, joint, places(base, joint.requested_times), joint.requested_times)


def smooth_on(ssm: StateSpaceModel, rule: Rule, plans: Plans, y: jax.Array, iterations: int,
              damping: float) -> SmootherResult:
    """The same on plans, without checks; for compiled code."""
    plan = plans.rows
    start = Moments(*ssm.initial())
    passed, smoothed, about, change = _smooth_rows(ssm, rule, plan, y, start, iterations, damping)
    drawn, pieces, requested = passed, smoothed, plan.requested
    times = jnp.asarray(plans.times, float)
    if plans.joint is None or plans.where is None:
        mean, covariance = (a[jnp.asarray(plan.requested) + 1] for a in smoothed.moments)
    else:
        drawn, pieces, _, _ = _smooth_rows(ssm, rule, plans.joint, y, start, iterations, damping)
        requested = plans.joint.requested
        mean, covariance = marginals_between(ssm, rule, plan, start, passed.filtered, smoothed.moments,
                                             smoothed.adjoint, about, plans.where)
    matrix, offset = jax.vmap(ssm.input_map)(times)
    observed = jnp.asarray(plan.observed)
    at_data = jax.tree_util.tree_map(lambda a: a[observed], passed)
    return SmootherResult(
        times, mean, covariance, matmul(matrix, mean[..., None])[..., 0] + offset, congruence(matrix, covariance),
        at_data.log_likelihood, smoothed.leave_one_out[observed], standardised(at_data, y), change,
        (jnp.asarray(requested), start, drawn, pieces.moments.mean[1:]), (matrix, offset),
        ssm.model.state_names, ssm.model.force_names)


def _smooth_rows(ssm: StateSpaceModel, rule: Rule, plan: Schedule, y: jax.Array, start: Moments, iterations: int,
                 damping: float) -> tuple[Pass, Smoothed, Moments | None, jax.Array]:
    about, change = None, jnp.asarray(jnp.nan)
    if iterations:
        about, change = posterior_linearisation(ssm, rule, plan, y, start, iterations, damping)
    passed = forward(ssm, rule, plan, y, start=start, about=about, keep="all")
    return passed, backward(passed, start, plan), about, change


_run_smoother = eqx.filter_jit(smooth_on)
