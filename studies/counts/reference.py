"""Exact posterior by Monte Carlo, with the process as its values at the data: dense algebra without a filter."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve, solve_triangular

import lfm_ppl as lfm
from lfm_ppl.filtering.arguments import as_rule
from lfm_ppl.filtering.ep.evidence import evidence
from lfm_ppl.filtering.ep.terms import FamilyTerms
from lfm_ppl.filtering.problem import filter_problem
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.inference.kernels.elliptical_slice import SliceState, elliptical_slice_step
from lfm_ppl.latent_grid.latent_grid import JITTER
from lfm_ppl.model.state_space import state_space

CHAINS = 4

WARMUP = 100
"""Discarded steps of each chain; few suffice, since chains start close to the posterior."""


class MonteCarloReference:
    r"""Exact posterior of the predictor f = m + L w at the data, with w standard normal and L L' the prior covariance.

    Two samplers use N(w; a, P^-1), the posterior in which factors of expectation propagation replace the likelihood.
    Importance sampling from it gives the evidence. Elliptical slice sampling with it as the prior (generalised
    elliptical slice sampling) gives the posterior. Both are exact for any factors.

    Args:
        model: model without dynamics, whose predictor is a level plus the sum of the forces.
        times: times (T,).
        factors: factor settings.

    Source: Nishihara, Murray and Adams (2014), Journal of Machine Learning Research 15.
    """

    def __init__(self, model: lfm.LatentForceModel, times: np.ndarray, factors: lfm.FactorSettings) -> None:
        assert isinstance(model.observation, lfm.ObservationFamily)
        self.ssm, self.times, self.settings, self.family = state_space(model), times, factors, model.observation
        t, zero_forces = jnp.asarray(times), jnp.zeros(len(model.force_names))
        self.mean = model.observation.function(jnp.zeros(0), zero_forces, t[0])[0]
        covariance: Any = sum(force.covariance_in_model(t[:, None], t, t[0]) for force in self.ssm.stack.forces)
        jitter = JITTER * jnp.max(jnp.diagonal(covariance)) * jnp.eye(len(times))
        self.root = jnp.linalg.cholesky(covariance + jitter)

    @partial(jax.jit, static_argnums=0)
    def proposal(self, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the mean a (T,) and the factor R of the precision P = R R' for data (T, 1)."""
        problem = filter_problem(self.ssm, as_rule(None), build_time_grid(self.ssm, self.times, 1))
        factors = evidence(problem, FamilyTerms(self.family, y), self.settings).refined.fixed_point.factors
        nu, tau = (jnp.where(jnp.isfinite(y), a, 0.0)[:, 0] for a in (factors.nu, factors.tau))
        root = jnp.linalg.cholesky(jnp.eye(len(y)) + self.root.T @ (tau[:, None] * self.root))
        return cho_solve((root, True), self.root.T @ (nu + tau * (factors.centre[:, 0] - self.mean))), root

    @partial(jax.jit, static_argnums=(0, 4))
    def log_weights(self, key: jax.Array, y: jax.Array, proposal: tuple, draws: int) -> jax.Array:
        """Return log importance weights (draws,); the mean of their exponentials estimates p(y) of data (T, 1)."""
        _, log_weight = self._whiten(y, *proposal)
        return jax.lax.map(lambda key: log_weight(jax.random.normal(key, (len(y),))), jax.random.split(key, draws),
                           batch_size=200)

    @partial(jax.jit, static_argnums=(0, 4))
    def sample(self, key: jax.Array, y: jax.Array, proposal: tuple, draws: int) -> jax.Array:
        """Return draws of the predictor (chains, draws, T) for data (T, 1), by elliptical slice sampling."""
        predictor, log_weight = self._whiten(y, *proposal)

        def step(state: SliceState, key: jax.Array) -> tuple[SliceState, jax.Array]:
            draw_key, step_key = jax.random.split(key)
            state = elliptical_slice_step(step_key, state, jax.random.normal(draw_key, (len(y),)), log_weight)
            return state._replace(evaluations=0), predictor(state.position)

        def chain(key: jax.Array) -> jax.Array:
            start_key, key = jax.random.split(key)
            start: Any = jax.random.normal(start_key, (len(y),))
            keys = jax.random.split(key, WARMUP + draws)
            return jax.lax.scan(step, SliceState(start, log_weight(start)), keys)[1][WARMUP:]

        return jax.lax.map(chain, jax.random.split(key, CHAINS))

    def _whiten(self, y: jax.Array, mean: jax.Array, root: jax.Array) -> tuple[Callable, Callable]:
        """Return predictor and log weight as functions of z = R' (w - a), standard normal under the proposal."""
        inverse_root = solve_triangular(root, jnp.eye(len(y)), lower=True).T
        proposal_mean = self.mean + self.root @ mean
        predictor_root = solve_triangular(root, self.root.T, lower=True).T
        log_determinant = jnp.log(jnp.diagonal(root)).sum()

        def predictor(z: jax.Array) -> jax.Array:
            return proposal_mean + predictor_root @ z

        def log_weight(z: jax.Array) -> jax.Array:
            w = mean + inverse_root @ z
            log_likelihood = FamilyTerms(self.family, y).log_prob(predictor(z)[:, None]).sum()
            return log_likelihood - 0.5 * w @ w + 0.5 * z @ z - log_determinant

        return predictor, log_weight
