"""The exact posterior by Monte Carlo, with the process as its values at the data: dense algebra, no filter in it."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.filter import as_rule
from lfm_ppl.filtering.sites import FamilyTerms, SiteSettings, evidence
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.inference.kernels.elliptical_slice import SliceState, elliptical_slice_step
from lfm_ppl.latent_grid.latent_grid import JITTER
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.state_space import state_space

CHAINS = 4

WARMUP = 100
"""Steps that are left out; chains start near the posterior already."""


class Weighed(NamedTuple):
    """The log evidence by importance sampling, its standard error, and the effective share of the draws."""

    log_evidence: float
    error: float
    share: float


class _Proposal(NamedTuple):
    """A normal distribution of the whitened process: mean (T,), and the factor R of its precision R R'."""

    mean: jax.Array
    root: jax.Array


class Reference:
    r"""The predictor at the data as f = m + L w with w standard normal, L L' its prior covariance.

    Both samplers propose from N(w; a, P^-1), the posterior with the sites of expectation propagation in the place of
    the data, and both are exact whatever these are: importance sampling for the evidence; elliptical slices of the
    posterior over this normal, taken as the prior (generalised elliptical slice sampling), for everything else.

    Args:
        model: forces that are observed themselves, through a predictor that is linear in them.
        times: (T,).
        sites: how they are refined.

    Source: Nishihara, Murray and Adams (2014), Journal of Machine Learning Research 15.
    """

    def __init__(self, model: LatentForceModel, times: np.ndarray, sites: SiteSettings) -> None:
        assert isinstance(model.observation, ObservationFamily)
        self.ssm, self.times, self.settings, self.family = state_space(model), times, sites, model.observation
        t = jnp.asarray(times)
        nothing = jnp.zeros(len(model.force_names))
        predictor = jax.vmap(lambda u, t: model.observation.function(jnp.zeros(0), u, t)[0], in_axes=(None, 0))
        self.mean = predictor(nothing, t)
        loadings = [predictor(nothing.at[i].set(1.0), t) - self.mean for i in range(len(nothing))]
        covariance = sum(loading[:, None] * loading * force.covariance_in_model(t[:, None], t, times[0])
                         for loading, force in zip(loadings, self.ssm.stack.forces, strict=True))
        jitter = JITTER * jnp.max(jnp.diagonal(covariance)) * jnp.eye(len(times))
        self.root = jnp.linalg.cholesky(covariance + jitter)

    def sample(self, key: jax.Array, y: np.ndarray, draws: int) -> np.ndarray:
        """Return draws of the predictor (chains, draws, T) given data (T, 1), by elliptical slices."""
        found = self._sample(key, jnp.asarray(y), self._proposal(jnp.asarray(y)), draws)
        return np.asarray(found)

    def weigh(self, key: jax.Array, y: np.ndarray, draws: int) -> Weighed:
        """Return the log evidence of data (T, 1) by importance sampling with as many draws as all chains."""
        proposal = self._proposal(jnp.asarray(y))
        log_weight = np.asarray(self._weigh(key, jnp.asarray(y), proposal, CHAINS * draws))
        weight = np.exp(log_weight - log_weight.max())
        value = log_weight.max() + np.log(weight.mean()) - np.log(np.diagonal(proposal.root)).sum()
        return Weighed(float(value), float(weight.std() / weight.mean() / np.sqrt(weight.size)),
                       float(weight.sum() ** 2 / (weight**2).sum() / weight.size))

    def log_likelihood(self, w: jax.Array, y: jax.Array) -> jax.Array:
        """Return log p(y | w)."""
        return FamilyTerms(self.family, y).log_prob((self.mean + self.root @ w)[:, None]).sum()

    @partial(jax.jit, static_argnums=0)
    def _proposal(self, y: jax.Array) -> _Proposal:
        rule, grid = as_rule(None), build_time_grid(self.ssm, self.times, 1)
        terms = FamilyTerms(self.family, y)
        sites = evidence(self.ssm, rule, grid, y, terms, self.settings).refined.found.sites
        nu, tau = (jnp.where(jnp.isfinite(y), a, 0.0)[:, 0] for a in (sites.nu, sites.tau))
        precision = jnp.eye(len(y)) + self.root.T @ (tau[:, None] * self.root)
        root = jnp.linalg.cholesky(precision)
        pull = self.root.T @ (nu + tau * (sites.centre[:, 0] - self.mean))
        return _Proposal(jax.scipy.linalg.cho_solve((root, True), pull), root)

    @partial(jax.jit, static_argnums=(0, 4))
    def _weigh(self, key: jax.Array, y: jax.Array, proposal: _Proposal, draws: int) -> jax.Array:
        def one(key: jax.Array) -> jax.Array:
            z = jax.random.normal(key, proposal.mean.shape)
            w = proposal.mean + jax.scipy.linalg.solve_triangular(proposal.root.T, z)
            return self.log_likelihood(w, y) - 0.5 * w @ w + 0.5 * z @ z

        return jax.lax.map(one, jax.random.split(key, draws), batch_size=200)

    @partial(jax.jit, static_argnums=(0, 4))
    def _sample(self, key: jax.Array, y: jax.Array, proposal: _Proposal, draws: int) -> jax.Array:
        # In coordinates z = R' (w - a) the proposal is standard normal; f = m + L a + L R^-T z.
        forward = jax.scipy.linalg.solve_triangular(proposal.root, self.root.T, lower=True).T
        middle = self.mean + self.root @ proposal.mean
        terms = FamilyTerms(self.family, y)
        back = jax.scipy.linalg.solve_triangular(proposal.root, jnp.eye(len(middle)), lower=True).T

        def log_ratio(z: jax.Array) -> jax.Array:
            w = proposal.mean + back @ z
            return terms.log_prob((middle + forward @ z)[:, None]).sum() - 0.5 * w @ w + 0.5 * z @ z

        def chain(key: jax.Array) -> jax.Array:
            def step(state: SliceState, key: jax.Array) -> tuple[SliceState, jax.Array]:
                draw_key, step_key = jax.random.split(key)
                state = elliptical_slice_step(step_key, state, jax.random.normal(draw_key, middle.shape), log_ratio)
                return state._replace(evaluations=0), middle + forward @ state.position

            start_key, key = jax.random.split(key)
            first: Any = jax.random.normal(start_key, middle.shape)
            return jax.lax.scan(step, SliceState(first, log_ratio(first)),
                                jax.random.split(key, WARMUP + draws))[1][WARMUP:]

        return jax.lax.map(chain, jax.random.split(key, CHAINS))
