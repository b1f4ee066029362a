"""Smoothed moments from filtered ones and what later observations say, by whichever of two ways is more accurate."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.predict import Moments
from lfm_ppl.linalg import congruence, factorise_semidefinite, matmul


class SmoothingKernel(NamedTuple):
    """The state at a time given a later one: N(m + G (s - m_p), C).

    Attributes:
        gain: G.
        conditional: C.
        share: the least conditional share of P_p, by which G is to be trusted.
    """

    gain: jax.Array
    conditional: jax.Array
    share: jax.Array


def smoothing_kernel(now: Moments, predicted: Moments, phi: jax.Array, process_cov: jax.Array) -> SmoothingKernel:
    """Return the gain G = P Phi' P_p^-1, and C = (I - G Phi) P (I - G Phi)' + G Q G', a sum of squares.

    Args:
        now: filtered, m and P.
        predicted: m_p and P_p at the later time.
        phi: Phi, from now to the later time.
        process_cov: Q, gained on the way.
    """
    factor = factorise_semidefinite(predicted.covariance)
    gain = factor.solve(matmul(phi, now.covariance)).T
    kept = jnp.eye(phi.shape[0]) - matmul(gain, phi)
    conditional = congruence(kept, now.covariance) + congruence(gain, process_cov)
    return SmoothingKernel(gain, conditional, jnp.min(factor.conditional_shares()))


def smoothed_moments(now: Moments, predicted: Moments, later: Moments, kernel: SmoothingKernel, r: jax.Array,
                     adjoint: jax.Array) -> Moments:
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
        kernel: G and C, and how far they are to be trusted.
        r: adjoint of the mean, at this time.
        adjoint: Lambda, at this time.

    Source: Rauch, Tung and Striebel (1965), AIAA Journal 3; Bryson and Frazier (1963), ASD-TDR-63-119.
    """
    # Not by a root of P: where P is singular but for rounding, a Cholesky factor is right to half the digits only.
    reduced = now.covariance - congruence(now.covariance, adjoint)
    before = jnp.diagonal(now.covariance)
    shares = jnp.where(before > 0, jnp.diagonal(reduced) / jnp.where(before > 0, before, 1.0), 1.0)
    gain, conditional, share = kernel
    trusted = share > jnp.min(shares)
    mean = jnp.where(trusted, matmul(gain, (later.mean - predicted.mean)[:, None])[:, 0],
                     matmul(now.covariance, r[:, None])[:, 0])
    covariance = jnp.where(trusted, conditional + congruence(gain, later.covariance), reduced)
    return Moments(now.mean + mean, covariance)
