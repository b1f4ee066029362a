"""Smoothed moments from filtered ones and later observations, by the more accurate of two formulas."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.moments import Moments, matvec
from lfm_ppl.utils.linalg import congruence, matmul
from lfm_ppl.utils.semidefinite import factorise_semidefinite


class SmoothingKernel(NamedTuple):
    """The law of the state at a time given a later one: N(m + G (s - m_p), C).

    Attributes:
        gain: G.
        conditional: C.
        min_share: least conditional share of a variance of P_p, a measure of the accuracy of G.
    """

    gain: jax.Array
    conditional: jax.Array
    min_share: jax.Array


def smoothing_kernel(filtered: Moments, predicted: Moments, phi: jax.Array, process_cov: jax.Array) -> SmoothingKernel:
    """Return the gain G = P Phi' P_p^-1, and C = (I - G Phi) P (I - G Phi)' + G Q G', a sum of squares.

    Args:
        filtered: m and P.
        predicted: m_p and P_p at the later time.
        phi: Phi, the transition to the later time.
        process_cov: Q, the noise of that transition.
    """
    factor = factorise_semidefinite(predicted.covariance)
    gain = factor.solve(matmul(phi, filtered.covariance)).T
    i_gphi = jnp.eye(phi.shape[0]) - matmul(gain, phi)
    conditional = congruence(i_gphi, filtered.covariance) + congruence(gain, process_cov)
    return SmoothingKernel(gain, conditional, jnp.min(factor.conditional_shares()))


def smoothed_moments(filtered: Moments, predicted: Moments, later: Moments, kernel: SmoothingKernel, r: jax.Array,
                     adjoint: jax.Array) -> Moments:
    """Return smoothed moments at a time from the filtered ones there.

    The formula of Rauch, Tung and Striebel uses the smoothed moments at a later time, with G and C of
    `smoothing_kernel`,

        m + G (m_s - m_p),    C + G P_s G',

    and magnifies errors by the inverse of P_p. Soon after a known start, where all states are moved by the same force,
    P_p is singular but for rounding. That of Bryson and Frazier uses the adjoint,

        m + P r,    P - P Lambda P,

    and magnifies them by the reduction of the variances, without bound for a diffuse start. The first is taken where
    the conditional shares of P_p are larger than the shares of the variances that the second leaves.

    Args:
        filtered: m and P.
        predicted: m_p and P_p at the later time.
        later: m_s and P_s, smoothed moments at the later time.
        kernel: G and C, and their accuracy.
        r: adjoint of the mean, at this time.
        adjoint: Lambda, at this time.

    Source: Rauch, Tung and Striebel (1965), AIAA Journal 3; Bryson and Frazier (1963), ASD-TDR-63-119.
    """
    # Not by a root of P: where P is singular but for rounding, a Cholesky factor is right to half the digits only.
    reduced = filtered.covariance - congruence(filtered.covariance, adjoint)
    variances = jnp.diagonal(filtered.covariance)
    shares = jnp.where(variances > 0, jnp.diagonal(reduced) / jnp.where(variances > 0, variances, 1.0), 1.0)
    gain, conditional, min_share = kernel
    use_gain = min_share > jnp.min(shares)
    change = jnp.where(use_gain, matvec(gain, later.mean - predicted.mean), matvec(filtered.covariance, r))
    covariance = jnp.where(use_gain, conditional + congruence(gain, later.covariance), reduced)
    return Moments(filtered.mean + change, covariance)
