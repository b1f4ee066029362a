"""Smoothed moments from filtered ones and what later observations say, by whichever of two ways is more accurate."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.predict import Moments
from lfm_ppl.linalg import (
    conditional_shares,
    congruence,
    matmul,
    solve_semidefinite,
)


def smoothing_kernel(now: Moments, predicted: Moments, phi: jax.Array,
                     process_cov: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the gain G = P Phi' P_p^-1, and the covariance C now given the state at the later time.

    C = (I - G Phi) P (I - G Phi)' + G Q G', a sum of squares.

    Args:
        now: filtered, m and P.
        predicted: m_p and P_p at the later time.
        phi: Phi, from now to the later time.
        process_cov: Q, gained on the way.
    """
    gain = solve_semidefinite(predicted.covariance, matmul(phi, now.covariance)).T
    kept = jnp.eye(phi.shape[0]) - matmul(gain, phi)
    return gain, congruence(kept, now.covariance) + congruence(gain, process_cov)


def smoothed_moments(now: Moments, predicted: Moments, later: Moments, gain: jax.Array, conditional: jax.Array,
                     r: jax.Array, adjoint: jax.Array) -> Moments:
    """Return smoothed moments at a time from the filtered ones there.

    Rauch, Tung and Striebel's way goes through the smoothed moments at a later time, with G and C of
    `smoothing_kernel`,

        m + G (m_s - m_p),    C + G P_s G',

    and magnifies errors by the inverse of P_p. Soon after a known start, where all states are moved by the same force,
    P_p is singular but for rounding. Bryson and Frazier's goes through the adjoint,

        m + P r,    P - P Lambda P,

    and magnifies them by the reduction of the variances, without bound for a start of which nothing is known. The
    first is taken where the conditional shares of P_p are larger than those of the variances that the second leaves.

    Args:
        now: filtered, m and P.
        predicted: m_p and P_p at the later time.
        later: smoothed, m_s and P_s there.
        gain: G.
        conditional: C.
        r: adjoint of the mean, at this time.
        adjoint: Lambda, at this time.

    Source: Rauch, Tung and Striebel (1965), AIAA Journal 3; Bryson and Frazier (1963), ASD-TDR-63-119.
    """
    # Not by a root of P: where P is singular but for rounding, a Cholesky factor is right to half the digits only.
    reduced = now.covariance - congruence(now.covariance, adjoint)
    before = jnp.diagonal(now.covariance)
    shares = jnp.where(before > 0, jnp.diagonal(reduced) / jnp.where(before > 0, before, 1.0), 1.0)
    trusted = jnp.min(conditional_shares(predicted.covariance)) > jnp.min(shares)
    mean = jnp.where(trusted, matmul(gain, (later.mean - predicted.mean)[:, None])[:, 0],
                     matmul(now.covariance, r[:, None])[:, 0])
    covariance = jnp.where(trusted, conditional + congruence(gain, later.covariance), reduced)
    return Moments(now.mean + mean, covariance)
