"""Smoothed moments from filtered ones and what later observations say, by whichever of two ways is more accurate."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.predict import Moments
from lfm_ppl.linalg import (
    cholesky,
    conditional_shares,
    congruence,
    matmul,
    outer_square,
    semidefinite_root,
    solve_semidefinite,
)


def given_later(now: Moments, predicted: Moments, phi: jax.Array, noise: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the gain G = P Phi' P_p^-1, and the covariance C now given the state at the later time.

    C = (I - G Phi) P (I - G Phi)' + G Q G', a sum of squares.

    Args:
        now: filtered, m and P.
        predicted: m_p and P_p at the later time.
        phi: Phi, from now to the later time.
        noise: Q, gained on the way.
    """
    gain = solve_semidefinite(predicted.covariance, matmul(phi, now.covariance)).T
    kept = jnp.eye(phi.shape[0]) - matmul(gain, phi)
    return gain, congruence(kept, now.covariance) + congruence(gain, noise)


def combine(now: Moments, predicted: Moments, later: Moments, gain: jax.Array, conditional: jax.Array, r: jax.Array,
            adjoint: jax.Array) -> Moments:
    """Return smoothed moments at a time from the filtered ones there.

    Rauch, Tung and Striebel's way goes through the smoothed moments at a later time, with G and C of `given_later`,

        m + G (m_s - m_p),    C + G P_s G',

    and magnifies errors by the inverse of P_p. Soon after a known start, where all states are moved by the same force,
    P_p is singular but for rounding. Bryson and Frazier's goes through the adjoint,

        m + P r,    P - P Lambda P = L (I - L' Lambda L) L',    P = L L',

    and magnifies them by the reduction of the variance, without bound for a start of which nothing is known. The one
    whose smallest pivot is larger is taken.

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
    root = semidefinite_root(now.covariance)
    left = cholesky(jnp.eye(root.shape[0]) - congruence(root.T, adjoint), keep=False).chol
    trusted = jnp.min(conditional_shares(predicted.covariance)) > jnp.min(jnp.diagonal(left)) ** 2
    mean = jnp.where(trusted, matmul(gain, (later.mean - predicted.mean)[:, None])[:, 0],
                     matmul(now.covariance, r[:, None])[:, 0])
    covariance = jnp.where(trusted, conditional + congruence(gain, later.covariance), outer_square(matmul(root, left)))
    return Moments(now.mean + mean, covariance)
