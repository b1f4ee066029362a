"""THE smoother's scan: backward, once, over what the filter left, for any rule and any model."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.filter import Pass
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.smoothing_kernel import smoothed_moments, smoothing_kernel
from lfm_ppl.filtering.time_grid import TimeGrid
from lfm_ppl.gaussian_residuals import log_density
from lfm_ppl.linalg import cholesky, congruence, diagonal, matmul, outer_square, solve_lower, symmetric

_ROUNDING, _LARGE_ROUNDING = 8.0, 1e4
"""Variances of a sum of states, in units of eps times the states' own, that are rounding errors: in general, and where
the smoothed variance is not positive."""


class Predictor(NamedTuple):
    """A family's predictor given all sites, and what tells the site of an entry from the others.

    Attributes:
        mean: (N, D).
        covariance: (N, D, D).
        score: u (N, D).
        precision: C (N, D, D): a pseudo-observation given all others is N(z - C^-1 u, C^-1).
    """

    mean: jax.Array
    covariance: jax.Array
    score: jax.Array
    precision: jax.Array


class Smoothed(NamedTuple):
    """What the backward scan leaves: nodes are the initial time and each interval's end.

    Attributes:
        moments: smoothed, at the N + 1 nodes.
        leave_one_out: (N,), log p(y_k | all other observations), zero in intervals without one.
        adjoint: r (N, n) and Lambda (N, n, n) at the interval's end, its observation and all later ones included: the
            smoothed mean there is m_p + P_p r, the covariance P_p - P_p Lambda P_p.
        predictor: (N, ...), of a pass with sites; None of any other. Its leave-one-out terms are zero.
    """

    moments: Moments
    leave_one_out: jax.Array
    adjoint: tuple[jax.Array, jax.Array]
    predictor: Predictor | None = None


def at_start(filtered: Moments, start: Moments) -> Moments:
    """Return the filtered moments (N, ...) at the intervals' starts."""
    return jax.tree_util.tree_map(lambda a, b: jnp.concatenate([a[None], b[:-1]]), start, filtered)


def backward(passed: Pass, start: Moments, grid: TimeGrid, moments: bool = True) -> Smoothed:
    """Run the one backward scan.

    Moments follow Rauch, Tung and Striebel, with the gain from a semi-definite solve and the covariance as a sum of
    squares, or the adjoint of Bryson and Frazier, r and Lambda, which needs no inverse of a covariance
    (`smoothed_moments` says when). With u = S^-1 v - K' r and C = S^-1 + K' Lambda K, an observation given all the
    others is N(y - C^-1 u, C^-1).

    Args:
        passed: the forward scan, with what the smoother needs.
        start: moments at the initial time.
        grid: the time grid.
        moments: whether those of the state are wanted, and the leave-one-out terms; without them only the adjoint is
            run, moments stay as filtered and the terms are zero.
    """
    length = jnp.asarray(grid.intervals.length)
    still = (length == 0) & (jnp.asarray(grid.intervals.jump) < 0)
    before = at_start(passed.filtered, start)
    size = start.mean.shape[0]

    def step(carry: tuple, row: tuple) -> tuple[tuple, tuple]:
        later, r, adjoint = carry
        at, one, at_rest = row
        left_out, predictor = jnp.zeros(()), None
        if one.site_terms is not None:
            predictor, r, adjoint = _predictor(one, r, adjoint)
        elif moments:
            left_out, r, adjoint = _leave_one_out(one, r, adjoint)
        else:
            r, adjoint = _with_observation(one, *_whitened(one), r, adjoint)
        back = matmul(one.phi.T, r[:, None])[:, 0], congruence(one.phi.T, adjoint)
        if not moments:
            return (at, *back), (later, left_out, (r, adjoint), predictor)
        kernel = smoothing_kernel(at, one.predicted, one.phi, one.process_cov)
        smoothed = smoothed_moments(at, one.predicted, later, kernel, *back)
        # Nothing happens in an interval without length but for the observation at its end.
        smoothed = jax.tree_util.tree_map(lambda a, b: jnp.where(at_rest, a, b), later, smoothed)
        return (smoothed, *back), (later, left_out, (r, adjoint), predictor)

    last = Moments(passed.filtered.mean[-1], passed.filtered.covariance[-1])
    carry = (last, jnp.zeros(size), jnp.zeros((size, size)))
    (first, _, _), (ends, left_out, adjoint, predictor) = jax.lax.scan(
        jax.checkpoint(step, prevent_cse=False), carry, (before, passed._replace(steps=None), still), reverse=True)
    every = jax.tree_util.tree_map(lambda a, b: jnp.concatenate([a[None], b]), first, ends)
    return Smoothed(every, left_out, adjoint, predictor)


def _predictor(one: Pass, r: jax.Array, adjoint: jax.Array) -> tuple[Predictor, jax.Array, jax.Array]:
    """The predictor at an interval's end given all sites, and the adjoint there with the sites at it.

    With M = (I + T F)^-1 and r and Lambda of what comes later, the predictor has the mean f + F S^-1 v + M' H P r and
    the covariance F M - M' H P Lambda P H' M: no difference of variances that are larger than the site leaves them.

    A predicted variance that is a rounding error of the sum H P H', as that of a conserved sum of uncertain states, is
    reported as zero: its sign is chance.
    """
    terms, jacobian = one.site_terms, one.jacobian
    u = terms.score - matmul(one.gain.T, r[:, None])[:, 0]
    precision = terms.precision + congruence(one.gain.T, adjoint)
    through = matmul(terms.shrinkage.T, matmul(jacobian, one.predicted.covariance))
    mean = (terms.value + matmul(terms.variance, terms.score[:, None])[:, 0] + matmul(through, r[:, None])[:, 0])
    covariance = symmetric(matmul(terms.variance, terms.shrinkage)) - congruence(through, adjoint)
    rounding = jnp.finfo(r.dtype).eps * matmul(jacobian**2, diagonal(one.predicted.covariance)[:, None])[:, 0]
    predicted = jnp.abs(diagonal(terms.variance))
    is_rounding = (predicted <= _ROUNDING * rounding) | (
        (diagonal(covariance) <= 0) & (predicted <= _LARGE_ROUNDING * rounding))
    covariance = jnp.where(np.eye(len(predicted), dtype=bool) & is_rounding[:, None], 0.0, covariance)
    kept = jnp.eye(r.shape[0]) - matmul(one.gain, jacobian)
    r = matmul(jacobian.T, terms.score[:, None])[:, 0] + matmul(kept.T, r[:, None])[:, 0]
    adjoint = congruence(jacobian.T, terms.precision) + congruence(kept.T, adjoint)
    return Predictor(mean, covariance, u, precision), r, adjoint


def _whitened(one: Pass) -> tuple[jax.Array, jax.Array]:
    """Return S^-1 (D, D) and S^-1 v (D,) of an update."""
    inverse = outer_square(solve_lower(one.chol, jnp.eye(one.innovation.shape[0])).T)
    return inverse, matmul(inverse, one.innovation[:, None])[:, 0]


def _with_observation(one: Pass, inverse: jax.Array, white: jax.Array, r: jax.Array,
                      adjoint: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the adjoint at an interval's end, its observation included."""
    kept = jnp.eye(r.shape[0]) - matmul(one.gain, one.jacobian)
    return (matmul(one.jacobian.T, white[:, None])[:, 0] + matmul(kept.T, r[:, None])[:, 0],
            congruence(one.jacobian.T, inverse) + congruence(kept.T, adjoint))


def _leave_one_out(one: Pass, r: jax.Array, adjoint: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Log density of an interval's observation given all others, and the adjoint at the interval's end with it."""
    inverse, white = _whitened(one)
    u = white - matmul(one.gain.T, r[:, None])[:, 0]
    precision = inverse + congruence(one.gain.T, adjoint)
    factor = cholesky(precision)
    # A missing entry has unit precision and u = 0, and so contributes nothing.
    left_out = (log_density(solve_lower(factor.chol, u), factor.chol, one.present)
                + 2.0 * jnp.log(diagonal(factor.chol)).sum())  # C is a precision
    return left_out, *_with_observation(one, inverse, white, r, adjoint)
