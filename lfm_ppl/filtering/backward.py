"""The backward scan: smoothed moments, leave-one-out terms and adjoints, from the trace of any forward pass.

The adjoint is the smoother's variable (r, Lambda) of Bryson and Frazier, the score and the information of all later
observations; it has nothing to do with automatic differentiation. From the last interval to the first,

1. take in the observation at the interval's end: the adjoint (r, Lambda) there, and the law of that observation given
   all others. With u = S^-1 v - K' r and C = S^-1 + K' Lambda K it is N(y - C^-1 u, C^-1);
2. carry the adjoint to the interval's start by the transition matrix;
3. smooth the moments at the start, by the gain of Rauch, Tung and Striebel or by the adjoint of Bryson and Frazier
   (`lfm_ppl.filtering.smoothing_kernel` says when).

Source: Rauch, Tung and Striebel (1965), AIAA Journal 3; Bryson and Frazier (1963), ASD-TDR-63-119; de Jong (1989),
Biometrika 76, for the leave-one-out terms.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.forward import FilterTrace
from lfm_ppl.filtering.moments import Moments, matvec
from lfm_ppl.filtering.problem import FilterProblem
from lfm_ppl.filtering.smoothing_kernel import smoothed_moments, smoothing_kernel
from lfm_ppl.filtering.update import Update
from lfm_ppl.utils.gaussian_residuals import log_density
from lfm_ppl.utils.linalg import cholesky, congruence, diagonal, matmul, outer_square, solve_lower, symmetric

_ROUNDING, _LARGE_ROUNDING = 8.0, 1e4
"""Variances of a sum of states, in units of eps times the states' own, that are rounding errors: in general, and where
the smoothed variance is not positive."""


class SmoothedPredictor(NamedTuple):
    """A family's predictor given all factors, and its law given the factors of all other entries.

    Attributes:
        mean: (N, D).
        covariance: (N, D, D).
        score: u (N, D).
        precision: C (N, D, D): a factor given all others is N(z - C^-1 u, C^-1).
    """

    mean: jax.Array
    covariance: jax.Array
    score: jax.Array
    precision: jax.Array


class SmootherTrace(NamedTuple):
    """Output of the backward scan; the nodes are the initial time and each interval's end.

    Attributes:
        moments: smoothed, at the N + 1 nodes.
        leave_one_out: (N,), log p(y_k | all other observations), zero in intervals without an observation.
        entry_leave_one_out: (N, D), log p of each entry of y_k given all other entries of all observations; zero where
            the entry is missing, and (N,) of a pass without leave-one-out terms.
        adjoint: r (N, n) and Lambda (N, n, n) at the interval's end, its observation and all later ones included: the
            smoothed mean there is m_p + P_p r, the covariance P_p - P_p Lambda P_p.
        predictor: (N, ...), of a pass with factors, which has no leave-one-out terms; None of any other.
    """

    moments: Moments
    leave_one_out: jax.Array
    entry_leave_one_out: jax.Array
    adjoint: tuple[jax.Array, jax.Array]
    predictor: SmoothedPredictor | None = None


def at_interval_starts(filtered: Moments, initial: Moments) -> Moments:
    """Return the filtered moments (N, ...) at the intervals' starts."""
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b[:-1]]), initial, filtered)


def backward(problem: FilterProblem, trace: FilterTrace, adjoint_only: bool = False) -> SmootherTrace:
    """Run the backward scan.

    Args:
        problem: the problem of the forward pass.
        trace: the forward pass, recorded for the smoother, or for a linearisation if only the adjoint is asked for.
        adjoint_only: leave out the smoothed moments and the leave-one-out terms, which then are the filtered moments
            and zero.
    """
    intervals = problem.grid.intervals
    is_empty = ((jnp.asarray(intervals.length) == 0) & (jnp.asarray(intervals.jump) < 0)
                & (jnp.asarray(intervals.event) < 0))
    start = at_interval_starts(trace.filtered, trace.initial)
    size = trace.initial.mean.shape[0]

    def step(carry: tuple, row: tuple) -> tuple[tuple, tuple]:
        later, r, adjoint = carry
        filtered, interval, skip = row
        update, predicted = interval.update, interval.predicted
        left_out, predictor = (jnp.zeros(()), jnp.zeros(())), None
        if update.factor_terms is not None:
            predictor = _smoothed_predictor(update, predicted, r, adjoint)
        elif not adjoint_only:
            left_out = _leave_one_out(update, r, adjoint)
        r, adjoint = _add_observation(update, r, adjoint)
        previous = matvec(interval.phi.T, r), congruence(interval.phi.T, adjoint)
        output = later, left_out, (r, adjoint), predictor
        if adjoint_only:
            return (filtered, *previous), output
        kernel = smoothing_kernel(filtered, predicted, interval.phi, interval.process_cov)
        smoothed = smoothed_moments(filtered, predicted, later, kernel, *previous)
        # In an interval of length zero nothing happens but the observation at its end.
        smoothed = jax.tree.map(lambda a, b: jnp.where(skip, a, b), later, smoothed)
        return (smoothed, *previous), output

    last = Moments(trace.filtered.mean[-1], trace.filtered.covariance[-1])
    carry = last, jnp.zeros(size), jnp.zeros((size, size))
    rows = start, trace._replace(initial=None, nodes=None, predictor=None), is_empty
    (first, _, _), (smoothed_ends, left_out, adjoint, predictor) = jax.lax.scan(
        jax.checkpoint(step, prevent_cse=False), carry, rows, reverse=True)
    moments = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, smoothed_ends)
    rows_left_out, entries_left_out = left_out
    return SmootherTrace(moments, rows_left_out, entries_left_out, adjoint, predictor)


def _smoothed_predictor(update: Update, predicted: Moments, r: jax.Array, adjoint: jax.Array) -> SmoothedPredictor:
    """Return the predictor at an interval's end given all factors.

    With M = (I + T F)^-1 and r and Lambda of what comes later, the predictor has the mean f + F S^-1 v + M' H P r and
    the covariance F M - M' H P Lambda P H' M: no difference of variances that are larger than the factor leaves them.

    A predicted variance that is a rounding error of the sum H P H', as that of a conserved sum of uncertain states, is
    reported as zero: its sign is random.
    """
    terms, jacobian = update.factor_terms, update.jacobian
    assert terms is not None
    score = terms.score - matvec(update.gain.T, r)
    precision = terms.precision + congruence(update.gain.T, adjoint)
    factor = matmul(terms.shrinkage.T, matmul(jacobian, predicted.covariance))
    mean = terms.value + matvec(terms.variance, terms.score) + matvec(factor, r)
    covariance = symmetric(matmul(terms.variance, terms.shrinkage)) - congruence(factor, adjoint)
    rounding = jnp.finfo(r.dtype).eps * matvec(jacobian**2, diagonal(predicted.covariance))
    variance = jnp.abs(diagonal(terms.variance))
    is_rounding = (variance <= _ROUNDING * rounding) | (
        (diagonal(covariance) <= 0) & (variance <= _LARGE_ROUNDING * rounding))
    covariance = jnp.where(np.eye(len(variance), dtype=bool) & is_rounding[:, None], 0.0, covariance)
    return SmoothedPredictor(mean, covariance, score, precision)


def _whitened(update: Update) -> tuple[jax.Array, jax.Array]:
    """Return S^-1 (D, D) and S^-1 v (D,), or their counterparts of an update by factors."""
    if update.factor_terms is not None:
        return update.factor_terms.precision, update.factor_terms.score
    inverse = outer_square(solve_lower(update.chol, jnp.eye(update.innovation.shape[0])).T)
    return inverse, matvec(inverse, update.innovation)


def _add_observation(update: Update, r: jax.Array, adjoint: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the adjoint at an interval's end, its observation included."""
    inverse, white = _whitened(update)
    i_kh = jnp.eye(r.shape[0]) - matmul(update.gain, update.jacobian)
    return (matvec(update.jacobian.T, white) + matvec(i_kh.T, r),
            congruence(update.jacobian.T, inverse) + congruence(i_kh.T, adjoint))


def _leave_one_out(update: Update, r: jax.Array, adjoint: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the log density of an interval's observation given all others, and that of each entry (D,) given the rest.

    With u and C of de Jong (1989), y - C^-1 u is the mean of y given all other observations and C^-1 its covariance, so
    that y_d given all other entries has the mean y_d - u_d / C_dd and the variance 1 / C_dd.
    """
    inverse, white = _whitened(update)
    u = white - matvec(update.gain.T, r)
    precision = inverse + congruence(update.gain.T, adjoint)
    factor = cholesky(precision)
    # A missing entry has unit precision and u = 0, and so contributes nothing.
    density: Any = log_density(solve_lower(factor.chol, u), factor.chol, update.present)
    row = density + 2.0 * jnp.log(diagonal(factor.chol)).sum()  # C is a precision
    precisions = diagonal(precision)
    is_positive = precisions > 0
    safe = jnp.where(is_positive, precisions, 1.0)
    entries = 0.5 * (jnp.log(safe) - u**2 / safe - np.log(2.0 * np.pi))
    return row, jnp.where(update.present, jnp.where(is_positive, entries, -jnp.inf), 0.0)
