"""Draws of whole trajectories given all observations, by the simulation smoother.

1. A trajectory s+ and observations y+ of the linearised model are simulated forwards. The draw is s+ - E[s+ | y+],
   which has the law of s - E[s | y]. With the filter's gains only its errors are needed,

       e_p = Phi e + q,    v = H e_p + eps,    e' = e_p - K v,    q ~ N(0, Q),    eps ~ N(0, R).

2. The adjoint runs backwards over the innovations v,

       r = H' S^-1 v + (I - K H)' r',    s+ - E[s+ | y+] = e_p - P_p r.

3. Factors of positive precision are observations of variance 1 / tau. With a negative precision, states are drawn from
   the last to the first instead, each given the next one.

No covariance of a state is inverted, so that a known state, or fewer noises than states, does no harm. All draws share
one pass of each scan.

Source: Durbin and Koopman (2002), Biometrika 89(3); de Jong and Shephard (1995), Biometrika 82(2).
"""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.forward import FilterTrace
from lfm_ppl.filtering.moments import Moments
from lfm_ppl.filtering.smoothing_kernel import smoothing_kernel
from lfm_ppl.utils.gaussian_residuals import masked
from lfm_ppl.utils.linalg import cholesky, congruence, matmul, solve_lower, solve_upper
from lfm_ppl.utils.random_keys import split_by_name
from lfm_ppl.utils.semidefinite import pivoted_root


def sample_errors(key: jax.Array, trace: FilterTrace, draws: int) -> jax.Array:
    """Draw deviations from the smoothed means: (N, n, draws) at the intervals' ends, jointly Gaussian over time.

    Args:
        key: a JAX random key.
        trace: a forward pass with `Record.SMOOTHER`.
        draws: number of draws.
    """
    keys = split_by_name(key, ("initial", "process", "observation", "backwards"))
    factor_terms = trace.update.factor_terms
    if factor_terms is None:
        return _sample_by_simulation(keys, trace, draws)
    is_negative = (factor_terms.factors.tau < 0).any()
    return jax.lax.cond(is_negative, lambda: _sample_backwards(keys["backwards"], trace, draws),
                        lambda: _sample_by_simulation(keys, _factors_as_observations(trace), draws))


def _sample_by_simulation(keys: Mapping[str, jax.Array], trace: FilterTrace, draws: int) -> jax.Array:
    """Draw deviations as `sample_errors` does: simulate state and observations, subtract the smoothed simulation.

    ``keys`` are random keys of "initial", "process" and "observation".
    """
    rows, size = trace.phi.shape[:2]
    outputs = trace.update.innovation.shape[-1]
    first = matmul(pivoted_root(trace.initial.covariance), jax.random.normal(keys["initial"], (size, draws)))
    noises = (jax.random.normal(keys["process"], (rows, size, draws)),
              jax.random.normal(keys["observation"], (rows, outputs, draws)))
    roots = jax.vmap(pivoted_root)(trace.process_cov), jax.vmap(pivoted_root)(trace.update.obs_cov)
    intervals = trace._replace(initial=None)

    def simulate(error: jax.Array, row: tuple) -> tuple[jax.Array, tuple]:
        interval, (process_root, obs_root), process_noise, obs_noise = row
        error = matmul(interval.phi, error) + matmul(process_root, process_noise)
        innovation = matmul(interval.update.jacobian, error) + matmul(obs_root, obs_noise)
        return error - matmul(interval.update.gain, innovation), (error, innovation)

    def smooth(r: jax.Array, row: tuple) -> tuple[jax.Array, jax.Array]:
        interval, error, innovation = row
        update = interval.update
        white = solve_upper(update.chol, solve_lower(update.chol, innovation))
        r = matmul(update.jacobian.T, white - matmul(update.gain.T, r)) + r
        return matmul(interval.phi.T, r), error - matmul(interval.predicted.covariance, r)

    _, (errors, innovations) = jax.lax.scan(simulate, first, (intervals, roots, *noises))
    _, deviations = jax.lax.scan(smooth, jnp.zeros((size, draws)), (intervals, errors, innovations), reverse=True)
    return deviations


def _factors_as_observations(trace: FilterTrace) -> FilterTrace:
    """Return a pass with factors of non-negative precision as a pass with observations of variances 1 / tau."""

    def row(interval: FilterTrace) -> FilterTrace:
        update = interval.update
        terms = update.factor_terms
        present = terms.factors.tau > 0
        variance = jnp.diag(1.0 / jnp.where(present, terms.factors.tau, 1.0))
        _, obs_cov = masked(terms.value, terms.residual_cov + variance, present)
        jacobian = jnp.where(present[:, None], update.jacobian, 0.0)
        chol = cholesky(congruence(jacobian, interval.predicted.covariance) + obs_cov).chol
        return interval._replace(
            update=update._replace(chol=chol, obs_cov=obs_cov, jacobian=jacobian, factor_terms=None))

    return jax.vmap(row)(trace._replace(initial=None, nodes=None))._replace(initial=trace.initial)


def _sample_backwards(key: jax.Array, trace: FilterTrace, draws: int) -> jax.Array:
    """Draw deviations as `sample_errors` does, from the last interval to the first, each state given the next.

    With factors of negative precision a filtered covariance may be indefinite, but that of a state given the next one
    and all factors is not.
    """
    rows, size = trace.phi.shape[:2]
    standard = jax.random.normal(key, (rows, size, draws))
    last = matmul(pivoted_root(trace.filtered.covariance[-1]), standard[-1])

    def step(error: jax.Array, row: tuple[Moments, Moments, jax.Array, jax.Array, jax.Array]) -> tuple:
        filtered, predicted, phi, process_cov, noise = row
        gain, conditional, min_share = smoothing_kernel(filtered, predicted, phi, process_cov)
        cross = matmul(phi, filtered.covariance)
        pseudo_gain = matmul(jnp.linalg.pinv(predicted.covariance, rtol=1e-13, hermitian=True), cross).T
        is_definite = min_share > 0
        gain = jnp.where(is_definite, gain, pseudo_gain)
        conditional = jnp.where(is_definite, conditional,
                                filtered.covariance - congruence(pseudo_gain, predicted.covariance))
        error = matmul(gain, error) + matmul(pivoted_root(conditional), noise)
        return error, error

    inputs = (jax.tree.map(lambda a: a[:-1], trace.filtered), jax.tree.map(lambda a: a[1:], trace.predicted),
              trace.phi[1:], trace.process_cov[1:], standard[:-1])
    deviations: jax.Array = jax.lax.scan(step, last, inputs, reverse=True)[1]
    return jnp.concatenate([deviations, last[None]])
