r"""Filter, smoother and draws of a model that switches between K regimes by a Markov chain.

The state s is Gaussian given each source i, which is a regime with one of the M histories of the n - 2 regimes before
it (GPBn; GPB2 and IMM have one history, so that a source is a regime). For each interval of the time grid:

1. Where a new regime may begin, after an observation, states of the same source are merged by their moments, and the
   chain moves: c_ij = p(i | y_1:k-1) P_ij, with P_ij from the regime of i to the regime j.
2. GPBn takes the state of each source i on under each regime j, K^n filters. IMM merges the states that enter regime j
   by their moments, too, with the weights c_ij / sum_i c_ij, and takes K filters.
3. The one-step-ahead density is the mixture sum_ij c_ij N(y_k; mu_ij, S_ij), whose terms are the new weights.

From the last interval to the first, for each of S draws of the later regimes r_k+1, r_k+2, ...,

4. the density of the later observations given the later regimes is Gaussian in s_k, with the state integrated out
   (`FutureLikelihood`). p(i | r_k+1, ..., y) is proportional to c_ij N(y_k+1; mu_ij, S_ij) times the integral of that
   density over the filtered state of (i, j), with the predictions (i, j) from the merged states. The regime is drawn
   from this law, which is exact given the merged states: only the past is merged. No state is drawn before the path,
   since a later state pins an earlier one where there is no process noise, and the merged Gaussian does not hold there.
   After the last observation the chain is simulated.
5. Given a path of regimes the model is that of one filter: its trace goes to the backward scan of the smoother, and
   draws of the state are exact.

The index of a source is ``regime * M + history``, and that of a history has the oldest regime last.

Source: Blom and Bar-Shalom (1988), IEEE Transactions on Automatic Control 33(8), for IMM; Tugnait (1982), Automatica
18(5), for GPBn; Lindsten, Bunch, Sarkka, Schon and Godsill (2016), IEEE Journal of Selected Topics in Signal Processing
10(2), for the draws.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr, ndtri

from lfm_ppl.filtering.backward import SmootherTrace, backward
from lfm_ppl.filtering.forward import FilterTrace, update_at_end
from lfm_ppl.filtering.intervals import TimeGrid, as_arrays, with_observations
from lfm_ppl.filtering.moments import Moments, Prediction, Record, matvec
from lfm_ppl.filtering.predict import predict
from lfm_ppl.filtering.problem import FilterProblem
from lfm_ppl.filtering.sample import sample_errors
from lfm_ppl.filtering.update import GaussianUpdate, Update
from lfm_ppl.switching.chain import transition_matrices
from lfm_ppl.utils import checks
from lfm_ppl.utils.gaussian_residuals import log_density
from lfm_ppl.utils.linalg import cholesky, congruence, matmul, solve_lower

MERGINGS = {"imm": 0, "gpb2": 1, "gpb3": 2, "gpb4": 3}
"""Methods of merging -> number of latest regimes for whose histories there are states; 0: merged before the prediction.
"""

_VANISHING_RATE, _VANISHING_PROBABILITY = 1e-60, 1e-120
"""A rate and an initial probability in place of zero. With them a regime of probability zero has a state, the limit for
rates that tend to zero together, on which the derivative with respect to a rate of zero depends. That derivative is
exact but for merging, which depends on the ratio of these rates where such a regime can be entered from several."""

_LARGEST_EXPONENT, _LARGEST_LIMIT = 700.0, 1e200
"""Bounds of the density and the limit of a regime of probability zero, which overflow in data that contradict the
others."""


class RegimeProblem(NamedTuple):
    """A filter problem for each regime on a common time grid, and the Markov chain.

    Attributes:
        problems: of the K regimes.
        initial: (K,), probabilities of the regimes at the first observation.
        transitions: (N, K, K), probabilities p(r_k = j | r_k-1 = i) at the starts of the intervals.
        limit_transitions: (N, K, K), the same with `_VANISHING_RATE` in place of rates of zero.
        is_start: (N,), whether an interval is the first after an observation, so that the regime may change.
        memory: one of the values of `MERGINGS`.
    """

    problems: tuple[FilterProblem, ...]
    initial: jax.Array
    transitions: jax.Array
    limit_transitions: jax.Array
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
    """Probabilities of the K regimes and M histories before each, and moments of the state given them.

    Attributes:
        probability: (..., K, M).
        moments: (..., K, M).
        limit: (..., K, M), ``probability`` with `_VANISHING_RATE` in place of rates of zero, without derivative.
    """

    probability: jax.Array
    moments: Moments
    limit: jax.Array


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


class FutureLikelihood(NamedTuple):
    """The density of all later observations given the state s and the later regimes, up to a factor.

    It is that of n observations with unit noise, exp(-|value - jacobian (s - point)|^2 / 2), in the square-root form of
    the information filter: neither the process noise nor the state's covariance is inverted, so that both may be zero.

    Attributes:
        value: (n,).
        jacobian: (n, n).
        point: (n,).
    """

    value: jax.Array
    jacobian: jax.Array
    point: jax.Array

    def log_density(self, mean: jax.Array, covariance: jax.Array) -> jax.Array:
        """Return the log density of the later observations given that s ~ N(mean, covariance)."""
        residual = self.value - matvec(self.jacobian, mean - self.point)
        chol = cholesky(jnp.eye(len(mean)) + congruence(self.jacobian, covariance)).chol
        return log_density(solve_lower(chol, residual), chol)

    def with_observation(self, predicted_mean: jax.Array, update: Update) -> FutureLikelihood:
        """Return the density with the observation of ``update`` among the later ones."""
        # An observation without noise gets one that is lost in the rounding of its innovation covariance.
        rounding = jnp.finfo(update.chol.dtype).eps * (update.chol**2).sum(-1)
        chol = cholesky(update.obs_cov + jnp.diag(rounding)).chol
        residual = self.value - matvec(self.jacobian, predicted_mean - self.point)
        rows = jnp.block([[self.jacobian, residual[:, None]],
                          [solve_lower(chol, update.jacobian), solve_lower(chol, update.innovation)[:, None]]])
        # A rotation leaves the sum of squares; the last row has no coefficients of s.
        reduced = jnp.linalg.qr(rows, mode="r")[:len(residual)]
        return FutureLikelihood(reduced[:, -1], reduced[:, :-1], predicted_mean)

    def at_start(self, mean: jax.Array, prediction: Prediction) -> FutureLikelihood:
        """Return the density as a function of the state at the start of an interval.

        Args:
            mean: of the state at the start, whose prediction has the mean ``point``.
            prediction: over the interval.
        """
        chol = cholesky(jnp.eye(len(mean)) + congruence(self.jacobian, prediction.process_cov)).chol
        jacobian = solve_lower(chol, matmul(self.jacobian, prediction.phi))
        return FutureLikelihood(solve_lower(chol, self.value), jacobian, mean)


def merge(weights: jax.Array, moments: Moments) -> Moments:
    """Return the moments of a mixture; ``weights`` (S,) need not be normalised, and zeros alone count as equal."""
    largest = jax.lax.stop_gradient(weights.max())
    weights = weights / jnp.where(largest > 0, largest, 1.0)  # the derivative of a share has the square of their sum
    total = weights.sum()
    share = jnp.where(total > 0, weights / jnp.where(total > 0, total, 1.0), 1.0 / weights.shape[0])
    mean = share @ moments.mean
    deviation = moments.mean - mean
    covariance = jnp.tensordot(share, moments.covariance, 1) + (share[:, None] * deviation).T @ deviation
    return Moments(mean, covariance)


def regime_transitions(rates: jax.Array, grid: TimeGrid) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the fields ``transitions``, ``limit_transitions`` and ``is_start`` of a `RegimeProblem`.

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
    identity = jnp.broadcast_to(jnp.eye(rates.shape[0]), (len(group), *rates.shape))
    # The chain begins with the first observation.
    starts = np.flatnonzero(is_start)[1:]
    limit = identity.at[starts].set(transition_matrices(rates + jnp.where(rates == 0, _VANISHING_RATE, 0.0), dwell[1:]))
    # A regime that cannot be reached has the probability zero, with the derivative of the matrix exponential.
    is_reachable = jnp.linalg.matrix_power((rates != 0) + jnp.eye(rates.shape[0]), rates.shape[0]) > 0
    transitions = jnp.where(is_reachable, limit, limit - jax.lax.stop_gradient(limit))
    return transitions, jax.lax.stop_gradient(limit), jnp.asarray(is_start)


def filter_regimes(regimes: RegimeProblem, y: jax.Array) -> RegimeTrace:
    """Run the filter on observations (T, D)."""
    return _forward(regimes, y, Record.LIKELIHOOD)[0]


def filter_path(regimes: RegimeProblem, y: jax.Array, path: jax.Array) -> FilterTrace:
    """Run the filter given a path (N,) of regimes, as that of a chain that takes this path with certainty."""
    indicators = jax.nn.one_hot(path, len(regimes.problems))
    transitions = jnp.broadcast_to(indicators[:, None], regimes.transitions.shape)
    certain = regimes._replace(initial=indicators[0], transitions=transitions, limit_transitions=transitions, memory=0)
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
    probability = jnp.broadcast_to(regimes.initial[:, None] / histories, (count, histories))
    moments = jax.tree.map(lambda a: jnp.repeat(a[:, None], histories, axis=1),
                           _stack([problem.initial() for problem in regimes.problems]))
    initial = RegimeMoments(probability, moments, _positive(probability, _VANISHING_PROBABILITY))
    updates = [updater.bind(problem, problem.initial()) for problem in regimes.problems]
    rows = with_observations(regimes.grid.intervals, updater.rows())[1]

    def step(carry: tuple[RegimeMoments, RegimeMoments], inputs: tuple) -> tuple[tuple, tuple]:
        sources, merged = carry
        (transition, limit_transition), is_start, intervals, row = inputs
        entering = _enter_regimes(merged, transition, limit_transition, regimes.memory)
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
        total, weight, limit = _update_probabilities(sources, trace.log_likelihood)
        posterior = RegimeMoments(weight, trace.filtered, limit)
        # The oldest regime is forgotten.
        joint = jax.tree.map(lambda a: a.reshape(count, histories, -1, *a.shape[2:]), posterior)
        shares = _shares(joint.probability, joint.limit)
        filtered = RegimeMoments(joint.probability.sum(2), jax.vmap(jax.vmap(merge))(shares, joint.moments),
                                 joint.limit.sum(2))
        residual = ndtri(jnp.clip(sum(distributions), 1e-15, 1 - 1e-15))
        output = RegimeTrace(total, filtered, jnp.where(jnp.isfinite(row), residual, jnp.nan))
        recorded = None if record is Record.LIKELIHOOD else trace
        return (posterior, filtered), (output, recorded)

    transitions = regimes.transitions, regimes.limit_transitions
    carry = _enter_regimes(initial, regimes.transitions[0], regimes.limit_transitions[0], regimes.memory), initial
    inputs = transitions, regimes.is_start, regimes.intervals, rows
    return jax.lax.scan(jax.checkpoint(step, prevent_cse=False), carry, inputs)[1]


def _enter_regimes(filtered: RegimeMoments, transition: jax.Array, limit_transition: jax.Array,
                   memory: int) -> RegimeMoments:
    """Return joint probabilities (K, S) of regimes and their sources after a transition, and the sources' moments."""
    sources = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), filtered.moments)
    joint = (transition.T[:, :, None] * filtered.probability).reshape(len(transition), -1)
    limit = (limit_transition.T[:, :, None] * filtered.limit).reshape(len(transition), -1)
    if memory:
        entering = jax.tree.map(lambda a: jnp.broadcast_to(a, (len(joint), *a.shape)), sources)
        return RegimeMoments(joint, entering, limit)
    merged = jax.vmap(merge, (0, None))(_shares(joint, limit), sources)
    return RegimeMoments(joint.sum(1, keepdims=True), jax.tree.map(lambda a: a[:, None], merged),
                         limit.sum(1, keepdims=True))


def _shares(probability: jax.Array, limit: jax.Array) -> jax.Array:
    """Return weights (..., S) of the sources of each regime: the probabilities, or the limit where all are zero."""
    return jnp.where(probability.sum(-1, keepdims=True) > 0, probability, limit)


def _update_probabilities(sources: RegimeMoments, log_likelihood: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the log density of an observation, and the probabilities (K, S) and their limits given it.

    The derivative with respect to a probability of zero is that of the sum of densities.
    """
    probability = sources.probability
    log_weight = jax.lax.stop_gradient(_log(probability) + log_likelihood)
    largest = jnp.max(log_weight)
    largest = jnp.where(jnp.isfinite(largest), largest, 0.0)
    # The density may break down in a regime of probability zero, or exceed the others by any factor.
    is_used = (probability > 0) | jnp.isfinite(log_likelihood)
    exponent = jnp.where(is_used, log_likelihood, 0.0) - largest
    density = jnp.where(is_used, jnp.exp(jnp.minimum(exponent, _LARGEST_EXPONENT)), 0.0)
    total = (probability * density).sum()
    share = density / jnp.where(total > 0, total, 1.0)
    weight = probability * share
    limit = jnp.minimum(sources.limit * jax.lax.stop_gradient(share), _LARGEST_LIMIT)
    return largest + _log(total), weight, jnp.where(weight > 0, jax.lax.stop_gradient(weight), limit)


def sample_regimes(key: jax.Array, regimes: RegimeProblem, trace: RegimeTrace, y: jax.Array,
                   draws: int) -> tuple[jax.Array, jax.Array]:
    """Draw paths of regimes given the observations (T, D), with the state integrated out.

    Returns:
        The paths (N, S) and the probabilities (N, K) of the regimes, at the ends of the intervals.
    """
    filtered, last = trace.filtered, max(regimes.grid.observed)
    histories, size = filtered.probability.shape[2], filtered.moments.mean.shape[-1]
    updater = GaussianUpdate(y)
    updates = [updater.bind(problem, problem.initial()) for problem in regimes.problems]
    rows = with_observations(regimes.grid.intervals, updater.rows())[1]
    keys = jax.random.split(key, (len(trace.log_likelihood), draws))

    def step(later: tuple[FutureLikelihood, jax.Array], inputs: tuple) -> tuple[tuple, tuple]:
        filtered, keys, transition, intervals, row = inputs
        joint, sources, _ = _enter_regimes(filtered, transition, transition, 1)
        by_regime = []
        for j, (problem, update, interval) in enumerate(zip(regimes.problems, updates, intervals, strict=True)):
            source = Moments(sources.mean[j], sources.covariance[j])
            prediction = jax.vmap(functools.partial(predict, problem, interval, record=Record.SMOOTHER))(source)
            updated = jax.vmap(functools.partial(update_at_end, problem, update, interval, row))(prediction.moments)
            by_regime.append((joint[j], source, prediction, updated))
        stacked = _stack(by_regime)

        def draw(key: jax.Array, future: FutureLikelihood, regime: jax.Array) -> tuple[tuple, jax.Array]:
            weights, source, prediction, updated = jax.tree.map(lambda a: a[regime], stacked)
            log_weight = _log(weights) + updated.log_likelihood + jax.vmap(future.log_density)(*updated.moments)
            probability = _normalised(log_weight, weights)
            index = jax.random.categorical(key, _log(probability))
            source, prediction, updated = jax.tree.map(lambda a: a[index], (source, prediction, updated))
            future = future.with_observation(prediction.moments.mean, updated).at_start(source.mean, prediction)
            return (future, index // histories), probability.reshape(-1, histories).sum(1)

        earlier, probability = jax.vmap(draw)(keys, *later)
        return earlier, (earlier[1], probability.mean(0))

    def simulate(regime: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        transition, keys = inputs
        regime = jax.vmap(jax.random.categorical)(keys, _log(transition[regime]))
        return regime, regime

    end = jax.vmap(jax.random.categorical, (0, None))(keys[last], _log(filtered.probability[last].sum(1)))
    nothing = FutureLikelihood(jnp.zeros((draws, size)), jnp.zeros((draws, size, size)), jnp.zeros((draws, size)))
    inputs = (*jax.tree.map(lambda a: a[:last], (filtered, keys)),
              *jax.tree.map(lambda a: a[1:last + 1], (regimes.transitions, regimes.intervals, rows)))
    earlier, probability = jax.lax.scan(step, (nothing, end), inputs, reverse=True)[1]
    later = jax.lax.scan(simulate, end, (regimes.transitions[last + 1:], keys[last + 1:]))[1]
    return (jnp.concatenate([earlier, end[None], later]),
            jnp.concatenate([probability, filtered.probability[last:].sum(2)]))


def sample_states(key: jax.Array, regimes: RegimeProblem, y: jax.Array, path: jax.Array) -> jax.Array:
    """Draw the state (N, n) at the ends of the intervals given a path (N,) of regimes."""
    trace = filter_path(regimes, y, path)
    smoothed = backward(regimes.problems[0], trace).moments.mean[1:]
    return smoothed + sample_errors(key, trace, 1)[:, :, 0]


def _normalised(log_weight: jax.Array, weights: jax.Array) -> jax.Array:
    """Return the probabilities (K M,) of the sources; those before the data, where the data are impossible."""
    log_weight = jnp.where(jnp.isnan(log_weight), -jnp.inf, log_weight)
    is_possible = jnp.isfinite(log_weight).any()
    return jnp.where(is_possible, jax.nn.softmax(jnp.where(is_possible, log_weight, 0.0)),
                     weights / jnp.where(weights.sum() > 0, weights.sum(), 1.0))


def _log(weights: jax.Array) -> jax.Array:
    """Return the logarithm, -inf for zero with a derivative of zero."""
    return jnp.where(weights > 0, jnp.log(jnp.where(weights > 0, weights, 1.0)), -jnp.inf)


def _positive(probability: jax.Array, smallest: float) -> jax.Array:
    """Return ``probability`` without derivative, with ``smallest`` in place of zero."""
    return jax.lax.stop_gradient(jnp.where(probability > 0, probability, smallest))


def _stack(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
