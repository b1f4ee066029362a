"""Draws of whole trajectories given all observations: simulate, then smooth the difference."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.filter import Pass
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.linalg import matmul, semidefinite_root, solve_lower, solve_upper


def smoothing_errors(key: jax.Array, passed: Pass, start: Moments, draws: int) -> jax.Array:
    """Draw what the smoothed mean is off by: (N, n, draws) at the intervals' ends, jointly Gaussian over the intervals.

    A trajectory s+ and observations y+ of the linearised model are simulated, and the draw is s+ - E[s+ | y+], which
    has the law of s - E[s | y]. With the filter's gains only its errors are needed,

        e_p = Phi e + q,    v = H e_p + eps,    e' = e_p - K v,    q ~ N(0, Q),    eps ~ N(0, R),

    and the adjoint, run backwards over the innovations v,

        r = H' S^-1 v + (I - K H)' r',    s+ - E[s+ | y+] = e_p - P_p r.

    No covariance of a state is inverted, so that a state that is known, or moved by less noise than it has
    dimensions, does no harm; all draws share one pass of each scan.

    Args:
        key: a JAX random key.
        passed: the forward scan, with everything kept.
        start: moments at the initial time.
        draws: number of draws.

    Source: Durbin and Koopman (2002), Biometrika 89(3); de Jong and Shephard (1995), Biometrika 82(2).
    """
    rows, size = passed.phi.shape[:2]
    outputs = passed.innovation.shape[-1]
    keys = jax.random.split(key, 3)
    first = matmul(semidefinite_root(start.covariance), jax.random.normal(keys[0], (size, draws)))
    standard = (jax.random.normal(keys[1], (rows, size, draws)), jax.random.normal(keys[2], (rows, outputs, draws)))

    def simulate(error: jax.Array, row: tuple) -> tuple[jax.Array, tuple]:
        one, moving, observing = row
        error = matmul(one.phi, error) + matmul(semidefinite_root(one.process_cov), moving)
        innovation = matmul(one.jacobian, error) + matmul(semidefinite_root(one.obs_cov), observing)
        return error - matmul(one.gain, innovation), (error, innovation)

    def smooth(r: jax.Array, row: tuple) -> tuple[jax.Array, jax.Array]:
        one, error, innovation = row
        white = solve_upper(one.chol, solve_lower(one.chol, innovation))
        r = matmul(one.jacobian.T, white - matmul(one.gain.T, r)) + r
        return matmul(one.phi.T, r), error - matmul(one.predicted.covariance, r)

    _, (errors, innovations) = jax.lax.scan(simulate, first, (passed, *standard))
    _, drawn = jax.lax.scan(smooth, jnp.zeros((size, draws)), (passed, errors, innovations), reverse=True)
    return drawn
