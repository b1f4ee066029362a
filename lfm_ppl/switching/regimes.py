r"""Filter, smoother and draws of a model that switches between K regimes by a Markov chain.

The state s is Gaussian given each source i, which is a regime with one of the M histories of the n - 2 regimes before
it (GPBn; GPB2 and IMM have one history, so that a source is a regime). For each interval of the time grid:

1. Where a new regime may begin, after an observation, states of the same source are merged by their moments, and the
   chain moves: c_ij = p(i | y_1:k-1) P_ij, with P_ij from the regime of i to the regime j.
2. GPBn takes the state of each source i on under each regime j, K^n filters. IMM merges the states that enter regime j
   by their moments, too, with the weights c_ij / sum_i c_ij, and takes K filters.
3. The one-step-ahead density is the mixture sum_ij c_ij N(y_k; mu_ij, S_ij), whose terms are the new weights.

From the last interval to the first, for each of S draws of the later state s_k+1 and its regime j,

4. p(i | s_k+1, j, y) is proportional to c_ij N(s_k+1; m_ij, P_ij), with the predictions (i, j) from the merged states,
   and the smoother's gain gives the Gaussian of s_k given i. Both are drawn from this law, which is exact given the
   merged states. After the last observation the chain is simulated.
5. Given a path of regimes the model is that of one filter: its trace goes to the backward scan of the smoother, and
   draws of the state are exact.

The index of a source is ``regime * M + history``, and that of a history has the oldest regime last.

Source: Blom and Bar-Shalom (1988), IEEE Transactions on Automatic Control 33(8), for IMM; Tugnait (1982), Automatica
18(5), for GPBn; Carter and Kohn (1994), Biometrika 81(3), for the draws.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp, ndtr, ndtri

from lfm_ppl.filtering.backward import SmootherTrace, backward
from lfm_ppl.filtering.forward import FilterTrace, predict, update_at_end
from lfm_ppl.filtering.intervals import TimeGrid, as_arrays, with_observations
from lfm_ppl.filtering.moments import Moments, Record
from lfm_ppl.filtering.problem import FilterProblem
from lfm_ppl.filtering.sample import sample_errors
from lfm_ppl.filtering.smoothing_kernel import smoothing_kernel
from lfm_ppl.filtering.update import GaussianUpdate
from lfm_ppl.switching.chain import transition_matrices
from lfm_ppl.utils import checks
from lfm_ppl.utils.gaussian_residuals import log_density
from lfm_ppl.utils.linalg import cholesky, diagonal, semidefinite_root, solve_lower

MERGINGS = {"imm": 0, "gpb2": 1, "gpb3": 2, "gpb4": 3}
"""Methods of merging -> number of latest regimes for whose histories there are states; 0: merged before the prediction.
"""

_JITTER = 1e-10
"""Relative variance added to a predicted covariance whose density is compared between regimes: it may be singular."""


class RegimeProblem(NamedTuple):
    """A filter problem for each regime on a common time grid, and the Markov chain.

    Attributes:
        problems: of the K regimes.
        initial: (K,), probabilities of the regimes at the first observation.
        transitions: (N, K, K), probabilities p(r_k = j | r_k-1 = i) at the starts of the intervals.
        is_start: (N,), whether an interval is the first after an observation, so that the regime may change.
        memory: one of the values of `MERGINGS`.
    """

    problems: tuple[FilterProblem, ...]
    initial: jax.Array
    transitions: jax.Array
    is_start: jax.Array
    memory: int

    @property
    def grid(self) -> TimeGrid:
        """The time grid."""
        return self.problems[0].grid

    @property
    def intervals(self) -> tuple[Any, ...]:
        """The intervals of each regime, which differ in their tabulated transitions."""
        return tuple(as_arrays(problem.grid.intervals) for problem in self.problems)


class RegimeMoments(NamedTuple):
    """Probabilities (..., K, M) of the K regimes and M histories before each, and moments of the state given them."""

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


def merge(weights: jax.Array, moments: Moments) -> Moments:
    """Return the moments of a mixture; ``weights`` (S,) need not be normalised, and zeros alone count as equal."""
    total = weights.sum()
    share = jnp.where(total > 0, weights / jnp.where(total > 0, total, 1.0), 1.0 / weights.shape[0])
    mean = share @ moments.mean
    deviation = moments.mean - mean
    covariance = jnp.tensordot(share, moments.covariance, 1) + (share[:, None] * deviation).T @ deviation
    return Moments(mean, covariance)


def regime_transitions(rates: jax.Array, grid: TimeGrid) -> tuple[jax.Array, jax.Array]:
    """Return the fields ``transitions`` and ``is_start`` of a `RegimeProblem`.

    The regime is constant between two observations: the first interval after an observation carries the transition over
    the whole time to the next, other intervals the identity. After the last observation each interval is a transition.

    Args:
        rates: (K, K), rows that sum to zero.
        grid: the time grid.
    """
    if checks.traced((grid.intervals.observation, grid.observed)):
        raise ValueError("times, a lag, or the length of an infusion are traced values, but regimes need intervals "
                         "that are known before compilation; give them as numbers.")
    is_end = np.asarray(grid.intervals.observation) >= 0
    is_end[max(grid.observed) + 1:] = True
    is_start = np.append(True, is_end[:-1])
    group = np.cumsum(is_start) - 1
    dwell = jax.ops.segment_sum(jnp.asarray(grid.intervals.length), group, group[-1] + 1)
    transitions = jnp.broadcast_to(jnp.eye(rates.shape[0]), (len(group), *rates.shape))
    # The chain begins with the first observation.
    starts = np.flatnonzero(is_start)[1:]
    return transitions.at[starts].set(transition_matrices(rates, dwell[1:])), jnp.asarray(is_start)


def filter_regimes(regimes: RegimeProblem, y: jax.Array) -> RegimeTrace:
    """Run the filter on observations (T, D)."""
    return _forward(regimes, y, Record.LIKELIHOOD)[0]


def filter_path(regimes: RegimeProblem, y: jax.Array, path: jax.Array) -> FilterTrace:
    """Run the filter given a path (N,) of regimes, as that of a chain that takes this path with certainty."""
    indicators = jax.nn.one_hot(path, len(regimes.problems))
    transitions = jnp.broadcast_to(indicators[:, None], regimes.transitions.shape)
    certain = regimes._replace(initial=indicators[0], transitions=transitions, memory=0)
    trace = _forward(certain, y, Record.SMOOTHER)[1]
    initial = _stack([problem.initial() for problem in regimes.problems])
    return jax.vmap(lambda trace, regime: jax.tree.map(lambda a: a[regime, 0], trace))(trace, path)._replace(
        initial=jax.tree.map(lambda a: a[path[0]], initial))


def smooth_path(regimes: RegimeProblem, y: jax.Array, path: jax.Array) -> SmootherTrace:
    """Smooth given a path (N,) of regimes."""
    return backward(regimes.problems[0], filter_path(regimes, y, path))


def _forward(regimes: RegimeProblem, y: jax.Array, record: Record) -> tuple[RegimeTrace, FilterTrace | None]:
    """Run the forward scan; of a `Record.SMOOTHER` return the traces (N, K, S, ...) of regimes and sources, too."""
    updater = GaussianUpdate(y)
    count = len(regimes.problems)
    histories = count**max(regimes.memory - 1, 0)
    initial = RegimeMoments(
        jnp.broadcast_to(regimes.initial[:, None] / histories, (count, histories)),
        jax.tree.map(lambda a: jnp.repeat(a[:, None], histories, axis=1),
                     _stack([problem.initial() for problem in regimes.problems])))
    updates = [updater.bind(problem, problem.initial()) for problem in regimes.problems]
    rows = with_observations(regimes.grid.intervals, updater.rows())[1]

    def step(carry: tuple[RegimeMoments, RegimeMoments], inputs: tuple) -> tuple[tuple, tuple]:
        sources, merged = carry
        transition, is_start, intervals, row = inputs
        entering = _enter_regimes(merged, transition, regimes.memory)
        sources = jax.tree.map(lambda a, b: jnp.where(is_start, a, b), entering, sources)
        traces, distributions = [], []
        for j, (problem, update, interval) in enumerate(zip(regimes.problems, updates, intervals, strict=True)):
            source = Moments(sources.moments.mean[j], sources.moments.covariance[j])
            prediction = jax.vmap(functools.partial(predict, problem, interval, record=record))(source)
            updated = jax.vmap(functools.partial(update_at_end, problem, update, interval, row))(prediction.moments)
            trace = FilterTrace(None, updated.log_likelihood, filtered=updated.moments)
            if record is Record.SMOOTHER:
                trace = trace._replace(predicted=prediction.moments, phi=prediction.phi,
                                       process_cov=prediction.process_cov,
                                       update=updated._replace(moments=None, log_likelihood=None))
            traces.append(trace)
            distribution = ndtr(updated.innovation / jnp.sqrt((updated.chol**2).sum(-1)))
            distributions.append(sources.probability[j] @ distribution)
        trace = _stack(traces)
        log_weight = _log(sources.probability) + trace.log_likelihood
        total = logsumexp(log_weight)
        weight = jnp.exp(log_weight - jnp.where(jnp.isfinite(total), total, 0.0))
        # The oldest regime is forgotten.
        joint, sources = jax.tree.map(lambda a: a.reshape(count, histories, -1, *a.shape[2:]), (weight, trace.filtered))
        filtered = RegimeMoments(joint.sum(2), jax.vmap(jax.vmap(merge))(joint, sources))
        residual = ndtri(jnp.clip(sum(distributions), 1e-15, 1 - 1e-15))
        output = RegimeTrace(total, filtered, jnp.where(jnp.isfinite(row), residual, jnp.nan))
        recorded = None if record is Record.LIKELIHOOD else trace
        return (RegimeMoments(weight, trace.filtered), filtered), (output, recorded)

    carry = _enter_regimes(initial, regimes.transitions[0], regimes.memory), initial
    inputs = regimes.transitions, regimes.is_start, regimes.intervals, rows
    return jax.lax.scan(jax.checkpoint(step, prevent_cse=False), carry, inputs)[1]


def _enter_regimes(filtered: RegimeMoments, transition: jax.Array, memory: int) -> RegimeMoments:
    """Return joint probabilities (K, S) of regimes and their sources after a transition, and the sources' moments."""
    joint = (transition.T[:, :, None] * filtered.probability).reshape(transition.shape[0], -1)
    sources = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), filtered.moments)
    if memory:
        return RegimeMoments(joint, jax.tree.map(lambda a: jnp.broadcast_to(a, (len(joint), *a.shape)), sources))
    merged = jax.vmap(merge, (0, None))(joint, sources)
    return RegimeMoments(joint.sum(1, keepdims=True), jax.tree.map(lambda a: a[:, None], merged))


def sample_regimes(key: jax.Array, regimes: RegimeProblem, trace: RegimeTrace,
                   draws: int) -> tuple[jax.Array, jax.Array]:
    """Draw paths of regimes given the observations.

    Returns:
        The paths (N, S) and the probabilities (N, K) of the regimes, at the ends of the intervals.
    """
    filtered, last = trace.filtered, max(regimes.grid.observed)
    histories = filtered.probability.shape[2]
    keys = jax.random.split(key, (len(trace.log_likelihood), draws))

    def step(later: tuple[jax.Array, jax.Array], inputs: tuple) -> tuple[tuple, tuple]:
        filtered, keys, transition, intervals = inputs
        joint, sources = _enter_regimes(filtered, transition, 1)
        sources = jax.tree.map(lambda a: a[0], sources)  # they are the same for all regimes
        predictions = []
        for problem, interval in zip(regimes.problems, intervals, strict=True):
            predicted = jax.vmap(functools.partial(predict, problem, interval, record=Record.SMOOTHER))(sources)
            kernel = jax.vmap(smoothing_kernel)(sources, predicted.moments, predicted.phi, predicted.process_cov)
            predictions.append((predicted.moments, kernel.gain, jax.vmap(semidefinite_root)(kernel.conditional)))
        by_regime = joint, _stack(predictions)

        def draw(key: jax.Array, state: jax.Array, regime: jax.Array) -> tuple[tuple, jax.Array]:
            weights, (predicted, gain, root) = jax.tree.map(lambda a: a[regime], by_regime)
            probability = _source_probabilities(weights, predicted, state)
            source_key, state_key = jax.random.split(key)
            source = jax.random.categorical(source_key, _log(probability))
            mean = sources.mean[source] + gain[source] @ (state - predicted.mean[source])
            state = mean + root[source] @ jax.random.normal(state_key, mean.shape)
            return (state, source // histories), probability.reshape(-1, histories).sum(1)

        earlier, probability = jax.vmap(draw)(keys, *later)
        return earlier, (earlier[1], probability.mean(0))

    def draw_last(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        source_key, state_key = jax.random.split(key)
        probability, moments = jax.tree.map(lambda a: a[last].reshape(-1, *a.shape[3:]), filtered)
        source = jax.random.categorical(source_key, _log(probability))
        normal = jax.random.normal(state_key, moments.mean[source].shape)
        return moments.mean[source] + semidefinite_root(moments.covariance[source]) @ normal, source // histories

    def simulate(regime: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        transition, keys = inputs
        regime = jax.vmap(jax.random.categorical)(keys, _log(transition[regime]))
        return regime, regime

    end = jax.vmap(draw_last)(keys[last])
    inputs = (*jax.tree.map(lambda a: a[:last], (filtered, keys)),
              *jax.tree.map(lambda a: a[1:last + 1], (regimes.transitions, regimes.intervals)))
    earlier, probability = jax.lax.scan(step, end, inputs, reverse=True)[1]
    later = jax.lax.scan(simulate, end[1], (regimes.transitions[last + 1:], keys[last + 1:]))[1]
    return (jnp.concatenate([earlier, end[1][None], later]),
            jnp.concatenate([probability, filtered.probability[last:].sum(2)]))


def sample_states(key: jax.Array, regimes: RegimeProblem, y: jax.Array, path: jax.Array) -> jax.Array:
    """Draw the state (N, n) at the ends of the intervals given a path (N,) of regimes."""
    trace = filter_path(regimes, y, path)
    smoothed = backward(regimes.problems[0], trace).moments.mean[1:]
    return smoothed + sample_errors(key, trace, 1)[:, :, 0]


def _source_probabilities(weights: jax.Array, predicted: Moments, state: jax.Array) -> jax.Array:
    """Return the probabilities (K M,) of the sources from which the later ``state`` (n,) came."""

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


def _log(weights: jax.Array) -> jax.Array:
    """Return the logarithm, -inf for zero with a derivative of zero."""
    return jnp.where(weights > 0, jnp.log(jnp.where(weights > 0, weights, 1.0)), -jnp.inf)


def _stack(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
