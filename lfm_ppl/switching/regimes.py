r"""Filter, smoother and draws of a model that switches between K regimes by a Markov chain.

The state s is Gaussian in each regime r, with p(r_k = j | y_1:k) beside it. For each interval of the time grid:

1. The chain moves: c_ij = p(r_k-1 = i | y_1:k-1) P_ij.
2. GPB2 predicts and updates the state of each regime i under each regime j, K^2 filters. IMM first merges the states
   that enter regime j by their moments, with the weights c_ij / sum_i c_ij, and then takes K filters.
3. The one-step-ahead density is the mixture sum_ij c_ij N(y_k; mu_ij, S_ij), whose terms are the new weights.
4. All states of a regime j are merged by their moments.

From the last interval to the first, for each of S draws of the later state s_k+1 and its regime j,

5. p(r_k = i | s_k+1, j, y) is proportional to p(r_k = i | y_1:k) P_ij N(s_k+1; m_ij, P_ij), with the predictions (i, j)
   of step 2, and the smoother's gain gives the Gaussian of s_k in regime i. Regime and state are drawn from this law.
6. Smoothed probabilities, moments and leave-one-out densities are averages of this law over the draws.

Draws are exact given the merged states of the filter.

Source: Blom and Bar-Shalom (1988), IEEE Transactions on Automatic Control 33(8), for IMM; Tugnait (1982), Automatica
18(5), for GPB2; Carter and Kohn (1994), Biometrika 81(3), for the draws.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp, ndtr, ndtri

from lfm_ppl.filtering.forward import predict, update_at_end
from lfm_ppl.filtering.intervals import TimeGrid, as_arrays, with_observations
from lfm_ppl.filtering.moments import Moments, Prediction, Record, matvec
from lfm_ppl.filtering.problem import FilterProblem
from lfm_ppl.filtering.smoothing_kernel import SmoothingKernel, smoothing_kernel
from lfm_ppl.filtering.update import GaussianUpdate, Update, linearize_observation
from lfm_ppl.switching.chain import transition_matrices
from lfm_ppl.utils.gaussian_residuals import log_density, masked, wrapped
from lfm_ppl.utils.linalg import cholesky, congruence, diagonal, semidefinite_root, solve_lower

IMM, GPB2 = MERGINGS = "imm", "gpb2"
"""Methods of merging."""

_JITTER = 1e-10
"""Relative variance added to a predicted covariance whose density is compared between regimes: it may be singular."""


class RegimeProblem(NamedTuple):
    """A filter problem for each regime on a common time grid, and the Markov chain.

    Attributes:
        problems: of the K regimes.
        initial: (K,), probabilities of the regimes at the initial time.
        transitions: (N, K, K), probabilities p(r_k = j | r_k-1 = i) of the intervals.
        merging: one of `MERGINGS`.
    """

    problems: tuple[FilterProblem, ...]
    initial: jax.Array
    transitions: jax.Array
    merging: str

    @property
    def grid(self) -> TimeGrid:
        """The time grid."""
        return self.problems[0].grid

    @property
    def intervals(self) -> tuple[Any, ...]:
        """The intervals of each regime, which differ in their tabulated transitions."""
        return tuple(as_arrays(problem.grid.intervals) for problem in self.problems)


class RegimeMoments(NamedTuple):
    """Probabilities (..., K) of the regimes and moments (..., K, n), (..., K, n, n) of the state in each."""

    probability: jax.Array
    moments: Moments


class RegimeTrace(NamedTuple):
    """Output of `filter_regimes`, a row for each of the N intervals.

    Attributes:
        log_likelihood: (N,), of the observation at the end, zero without one.
        filtered: after the observation.
        residual: (N, D), normal quantiles of the predictive distribution functions of the outputs, NaN where missing.
    """

    log_likelihood: jax.Array
    filtered: RegimeMoments
    residual: jax.Array


class RegimePaths(NamedTuple):
    """Output of `sample_regimes`, a row for each of the N intervals; S draws.

    Attributes:
        state: (N, S, n), draws of the state.
        regime: (N, S), draws of the regime, an index.
        probability: (N, K), of the regimes, given all observations.
        moments: (N, n), (N, n, n), of the state, merged over the regimes.
        leave_one_out: (N,), log p(y_k | all other observations), zero without an observation.
    """

    state: jax.Array
    regime: jax.Array
    probability: jax.Array
    moments: Moments
    leave_one_out: jax.Array


class _ConditionalLaw(NamedTuple):
    """Law of regime and state given draws of later ones: sum_i weight_i N(mean_i, covariance[group]_i).

    Attributes:
        weight: (S, K).
        mean: (S, K, n).
        covariance: (G, K, n, n).
        group: (S,), index of the covariance of a draw.
    """

    weight: jax.Array
    mean: jax.Array
    covariance: jax.Array
    group: jax.Array


def merge(weights: jax.Array, moments: Moments) -> Moments:
    """Return the moments of a mixture; ``weights`` (S,) need not be normalised, and zeros alone count as equal."""
    total = weights.sum()
    share = jnp.where(total > 0, weights / jnp.where(total > 0, total, 1.0), 1.0 / weights.shape[0])
    mean = share @ moments.mean
    deviation = moments.mean - mean
    covariance = jnp.tensordot(share, moments.covariance, 1) + (share[:, None] * deviation).T @ deviation
    return Moments(mean, covariance)


def transition_probabilities(rates: jax.Array, grid: TimeGrid) -> jax.Array:
    """Return the transition probabilities (N, K, K) of the intervals, exp(rates dt).

    The regime is constant between two observations: the first interval after an observation carries the transition over
    the whole time to the next, other intervals the identity. After the last observation each interval is a transition.

    Args:
        rates: (K, K), rows that sum to zero.
        grid: the time grid.
    """
    is_end = np.asarray(grid.intervals.observation) >= 0
    is_end[max(grid.observed) + 1:] = True
    group = np.append(0, np.cumsum(is_end[:-1]))
    first = np.unique(group, return_index=True)[1]
    dwell = jax.ops.segment_sum(jnp.asarray(grid.intervals.length), group, group[-1] + 1)
    identity = jnp.broadcast_to(jnp.eye(rates.shape[0]), (len(group), *rates.shape))
    return identity.at[first].set(transition_matrices(rates, dwell))


def filter_regimes(regimes: RegimeProblem, y: jax.Array) -> RegimeTrace:
    """Run the filter on observations (T, D)."""
    updater = GaussianUpdate(y)
    starts = [problem.initial() for problem in regimes.problems]
    updates = [updater.bind(problem, start) for problem, start in zip(regimes.problems, starts, strict=True)]
    rows = with_observations(regimes.grid.intervals, updater.rows())[1]

    def step(carry: RegimeMoments, inputs: tuple) -> tuple[RegimeMoments, RegimeTrace]:
        transition, intervals, row = inputs
        joint = carry.probability[:, None] * transition
        log_weights, moments, distributions = [], [], []
        for j, (problem, update, interval) in enumerate(zip(regimes.problems, updates, intervals, strict=True)):
            sources, weights = carry.moments, joint[:, j]
            if regimes.merging == IMM:
                sources, weights = jax.tree.map(lambda a: a[None], merge(weights, sources)), weights.sum()[None]

            def filter_source(source: Moments, problem: Any = problem, update: Any = update,
                              interval: Any = interval) -> tuple:
                predicted = predict(problem, interval, source).moments
                updated = update_at_end(problem, update, interval, row, predicted)
                return updated.log_likelihood, updated.moments, _distribution_function(updated)

            log_likelihood, updated, distribution = jax.vmap(filter_source)(sources)
            log_weights.append(_log(weights) + log_likelihood)
            moments.append(updated)
            distributions.append(weights @ distribution)
        log_weight = jnp.stack(log_weights)
        total = logsumexp(log_weight)
        weight = jnp.exp(log_weight - jnp.where(jnp.isfinite(total), total, 0.0))
        filtered = RegimeMoments(weight.sum(1), _stack([merge(*pair) for pair in zip(weight, moments, strict=True)]))
        residual = ndtri(jnp.clip(jnp.stack(distributions).sum(0), 1e-15, 1 - 1e-15))
        return filtered, RegimeTrace(total, filtered, jnp.where(jnp.isfinite(row), residual, jnp.nan))

    start = RegimeMoments(regimes.initial, _stack(starts))
    inputs = regimes.transitions, regimes.intervals, rows
    return jax.lax.scan(jax.checkpoint(step, prevent_cse=False), start, inputs)[1]


def sample_regimes(key: jax.Array, regimes: RegimeProblem, trace: RegimeTrace, y: jax.Array,
                   draws: int) -> RegimePaths:
    """Draw paths of state and regime given the observations (T, D), and average over their conditional laws."""
    count, regime_count, size = trace.filtered.moments.mean.shape
    normals = jax.random.normal(key, (count, draws, size))
    gumbels = jax.random.gumbel(jax.random.fold_in(key, 1), (count, draws, regime_count))
    rows = with_observations(regimes.grid.intervals, y)[1]

    def summarize(law: _ConditionalLaw, filtered: Moments, inputs: tuple) -> RegimePaths:
        intervals, row, normal, gumbel = inputs
        root = jax.vmap(jax.vmap(semidefinite_root))(law.covariance)
        regime = jnp.argmax(_log(law.weight) + gumbel, axis=1)
        number = jnp.arange(draws)
        state = law.mean[number, regime] + matvec(root[law.group, regime], normal)
        flat = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]),
                            (law.weight, Moments(law.mean, law.covariance[law.group])))
        terms = [_log_inverse_density(problem, interval, row, jax.tree.map(lambda a, i=i: a[i], filtered),
                                      law.mean[:, i], law.covariance[:, i], law.group)
                 for i, (problem, interval) in enumerate(zip(regimes.problems, intervals, strict=True))]
        left_out = jnp.log(draws) - logsumexp(_log(law.weight) + jnp.stack(terms, axis=1))
        return RegimePaths(state, regime, law.weight.mean(0), merge(*flat), left_out)

    def step(later: tuple, inputs: tuple) -> tuple[tuple, RegimePaths]:
        filtered, transition, later_intervals, rest = inputs
        paths = summarize(_law_given_later(regimes, filtered, transition, later_intervals, *later),
                          filtered.moments, rest)
        return (paths.state, paths.regime), paths

    filtered, rest = trace.filtered, (regimes.intervals, rows, normals, gumbels)
    end, rest_of_end = jax.tree.map(lambda a: a[-1], (filtered, rest))
    law = _ConditionalLaw(jnp.broadcast_to(end.probability, (draws, regime_count)),
                          jnp.broadcast_to(end.moments.mean, (draws, regime_count, size)),
                          end.moments.covariance[None], jnp.zeros(draws, int))
    last = summarize(law, end.moments, rest_of_end)
    earlier_rows = jax.tree.map(lambda a: a[:-1], (filtered, rest))
    later_rows = jax.tree.map(lambda a: a[1:], (regimes.transitions, regimes.intervals))
    inputs = earlier_rows[0], *later_rows, earlier_rows[1]
    paths = jax.lax.scan(step, (last.state, last.regime), inputs, reverse=True)[1]
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), paths, last)


def _law_given_later(regimes: RegimeProblem, filtered: RegimeMoments, transition: jax.Array,
                     intervals: tuple[Any, ...], states: jax.Array, later: jax.Array) -> _ConditionalLaw:
    """Return the law at the end of an interval given draws of states and regimes at the end of the next."""
    predicted, kernel = jax.tree.map(lambda *leaves: jnp.stack(leaves),
                                     *_predictions(regimes, filtered.moments, intervals))
    joint = (filtered.probability[:, None] * transition).T

    def given(state: jax.Array, regime: jax.Array) -> tuple[jax.Array, jax.Array]:
        moments = jax.tree.map(lambda a: a[regime], predicted.moments)
        change = matvec(kernel.gain[regime], state - moments.mean)
        return _source_probabilities(joint[regime], moments, state), filtered.moments.mean + change

    weight, mean = jax.vmap(given)(states, later)
    return _ConditionalLaw(weight, mean, kernel.conditional, later)


def _log_inverse_density(problem: FilterProblem, interval: Any, y: jax.Array, centre: Moments, mean: jax.Array,
                         covariance: jax.Array, group: jax.Array) -> jax.Array:
    """Return log E[1 / p(y | s)] under N(mean, covariance) for means (S, n) and covariances (G, n, n).

    With f = h(s) ~ N(m, V) and y ~ N(f, R) it is -log N(y; m, R - V) - log |R - V| + log |R|, for V < R; infinite else.
    """
    observation = linearize_observation(problem.ssm, problem.rule, problem.shared.observation_jacobian, interval.end,
                                        jnp.maximum(interval.observation, 0), centre)
    present = jnp.isfinite(y)

    def factors(covariance: jax.Array) -> tuple[jax.Array, jax.Array]:
        variance = congruence(observation.jacobian, covariance)
        _, remainder = masked(y, observation.obs_cov - variance, present)
        factor = cholesky(remainder)
        return factor.chol, factor.degenerate.any()

    def log_term(mean: jax.Array, chol: jax.Array, is_infinite: jax.Array) -> jax.Array:
        value = observation.value + matvec(observation.jacobian, mean - centre.mean)
        residual = jnp.where(present, jnp.where(present, y, 0.0) - value, 0.0)
        for index in problem.ssm.model.observation.angular:
            residual = residual.at[index].set(wrapped(residual[index]))
        density = log_density(solve_lower(chol, residual), chol, present)
        return jnp.where(is_infinite, jnp.inf, log_det - 2.0 * jnp.log(diagonal(chol)).sum() - density)

    log_det = 2.0 * jnp.log(diagonal(cholesky(masked(y, observation.obs_cov, present)[1]).chol)).sum()
    chol, is_infinite = jax.vmap(factors)(covariance)
    return jax.vmap(log_term)(mean, chol[group], is_infinite[group])


def _predictions(regimes: RegimeProblem, moments: Moments,
                 intervals: tuple[Any, ...]) -> list[tuple[Prediction, SmoothingKernel]]:
    """Return the predictions from the moments (K, ...) of all regimes under each regime, with the smoother's gains."""

    def predict_sources(problem: FilterProblem, interval: Any) -> tuple[Prediction, SmoothingKernel]:
        predicted = jax.vmap(lambda source: predict(problem, interval, source, record=Record.SMOOTHER))(moments)
        return predicted, jax.vmap(smoothing_kernel)(moments, predicted.moments, predicted.phi, predicted.process_cov)

    return [predict_sources(*pair) for pair in zip(regimes.problems, intervals, strict=True)]


def _source_probabilities(weights: jax.Array, predicted: Moments, state: jax.Array) -> jax.Array:
    """Return the probabilities (K,) of the regimes from which the later ``state`` (n,) came."""

    def density(mean: jax.Array, covariance: jax.Array) -> jax.Array:
        # A known coordinate gets a width far below its size and above its rounding errors.
        sd = jnp.sqrt(diagonal(covariance)) + 1e-8 * jnp.abs(state) + 1e-150
        scaled = covariance / (sd[:, None] * sd) + _JITTER * jnp.eye(sd.shape[0])
        chol = cholesky(scaled).chol
        return log_density(solve_lower(chol, (state - mean) / sd), chol) - jnp.log(sd).sum()

    log_weight = _log(weights) + jax.vmap(density)(*predicted)
    log_weight = jnp.where(jnp.isnan(log_weight), -jnp.inf, log_weight)
    is_possible = jnp.isfinite(log_weight).any()
    return jnp.where(is_possible, jax.nn.softmax(jnp.where(is_possible, log_weight, 0.0)),
                     weights / jnp.where(weights.sum() > 0, weights.sum(), 1.0))


def _distribution_function(updated: Update) -> jax.Array:
    """Return the predictive distribution functions (D,) of the outputs at the data."""
    return jnp.asarray(ndtr(updated.innovation / jnp.sqrt((updated.chol**2).sum(-1))))


def _log(weights: jax.Array) -> jax.Array:
    """Return the logarithm, -inf for zero with a derivative of zero."""
    return jnp.where(weights > 0, jnp.log(jnp.where(weights > 0, weights, 1.0)), -jnp.inf)


def _stack(moments: list[Moments]) -> Moments:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *moments)
