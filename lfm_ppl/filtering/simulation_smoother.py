"""Draws of whole trajectories given all observations: simulate, then smooth the difference."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.filter import Pass
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.smoothing_kernel import smoothing_kernel
from lfm_ppl.gaussian_residuals import masked
from lfm_ppl.linalg import (
    cholesky,
    congruence,
    matmul,
    pivoted_root,
    solve_lower,
    solve_upper,
)


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
    if passed.site_terms is not None:
        negative = (passed.site_terms.sites.tau < 0).any()
        return jax.lax.cond(negative, lambda: _backward_sampled(key, passed, start, draws),
                            lambda: smoothing_errors(key, _as_observations(passed), start, draws))
    rows, size = passed.phi.shape[:2]
    outputs = passed.innovation.shape[-1]
    keys = jax.random.split(key, 3)
    first = matmul(pivoted_root(start.covariance), jax.random.normal(keys[0], (size, draws)))
    standard = (jax.random.normal(keys[1], (rows, size, draws)), jax.random.normal(keys[2], (rows, outputs, draws)))
    roots = jax.vmap(pivoted_root)(passed.process_cov), jax.vmap(pivoted_root)(passed.obs_cov)

    def simulate(error: jax.Array, row: tuple) -> tuple[jax.Array, tuple]:
        one, (process_root, obs_root), moving, observing = row
        error = matmul(one.phi, error) + matmul(process_root, moving)
        innovation = matmul(one.jacobian, error) + matmul(obs_root, observing)
        return error - matmul(one.gain, innovation), (error, innovation)

    def smooth(r: jax.Array, row: tuple) -> tuple[jax.Array, jax.Array]:
        one, error, innovation = row
        white = solve_upper(one.chol, solve_lower(one.chol, innovation))
        r = matmul(one.jacobian.T, white - matmul(one.gain.T, r)) + r
        return matmul(one.phi.T, r), error - matmul(one.predicted.covariance, r)

    _, (errors, innovations) = jax.lax.scan(simulate, first, (passed, roots, *standard))
    _, drawn = jax.lax.scan(smooth, jnp.zeros((size, draws)), (passed, errors, innovations), reverse=True)
    return drawn


def _as_observations(passed: Pass) -> Pass:
    """Return a pass with sites, of which no precision is negative, as one with observations of variances 1 / tau."""

    def row(one: Pass) -> Pass:
        terms = one.site_terms
        present = terms.sites.tau > 0
        variance = jnp.diag(1.0 / jnp.where(present, terms.sites.tau, 1.0))
        _, obs_cov = masked(terms.value, terms.residual_cov + variance, present)
        jacobian = jnp.where(present[:, None], one.jacobian, 0.0)
        chol = cholesky(congruence(jacobian, one.predicted.covariance) + obs_cov).chol
        return one._replace(chol=chol, obs_cov=obs_cov, jacobian=jacobian, site_terms=None)

    return jax.vmap(row)(passed._replace(steps=None))


def _backward_sampled(key: jax.Array, passed: Pass, start: Moments, draws: int) -> jax.Array:
    """Draw errors as `smoothing_errors` does, from the last interval to the first, each state given the next.

    Where sites have negative precisions, filtered covariances may be no covariances, but that of a state given the next
    and all sites is one.
    """
    rows, size = passed.phi.shape[:2]
    standard = jax.random.normal(key, (rows, size, draws))
    last = matmul(pivoted_root(passed.filtered.covariance[-1]), standard[-1])

    def step(error: jax.Array, row: tuple) -> tuple[jax.Array, jax.Array]:
        now, predicted, phi, process_cov, noise = row
        gain, conditional, share = smoothing_kernel(now, predicted, phi, process_cov)
        through = matmul(phi, now.covariance)
        general = matmul(jnp.linalg.pinv(predicted.covariance, rtol=1e-13, hermitian=True), through).T
        proper = share > 0
        gain = jnp.where(proper, gain, general)
        conditional = jnp.where(proper, conditional, now.covariance - congruence(general, predicted.covariance))
        error = matmul(gain, error) + matmul(pivoted_root(conditional), noise)
        return error, error

    tree = jax.tree_util.tree_map
    inputs = (tree(lambda a: a[:-1], passed.filtered), tree(lambda a: a[1:], passed.predicted), passed.phi[1:],
              passed.process_cov[1:], standard[:-1])
    _, drawn = jax.lax.scan(step, last, inputs, reverse=True)
    return jnp.concatenate([drawn, last[None]])
