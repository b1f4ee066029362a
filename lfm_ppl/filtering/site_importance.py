"""An unbiased estimate of the likelihood of a linear model with an observation family, by draws from its smoother."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.filter import at_intervals
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.rts import backward
from lfm_ppl.filtering.simulation_smoother import smoothing_errors
from lfm_ppl.filtering.sites import FamilyTerms, SiteSettings, evidence
from lfm_ppl.filtering.time_grid import TimeGrid
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.state_space import StateSpaceModel


def importance_weights(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, key: jax.Array, draws: int,
                       settings: SiteSettings) -> jax.Array:
    r"""Return log weights (draws,) whose exponentials have the likelihood as their mean.

    The smoother with the sites is prior times sites, over the integral I of the sites. With draws f of it,

        p(y) = I E[prod_i p(y_i | f_i) / t_i(f_i)].

    Args:
        ssm: the model; linear in the state, with an observation family.
        rule: the linearisation rule.
        grid: the time grid.
        y: (T, D), NaN where missing.
        key: a JAX random key.
        draws: number of trajectories.
        settings: of the sites.

    Source: Durbin and Koopman (1997), Biometrika 84; Shephard and Pitt (1997), Biometrika 84.
    """
    family = ssm.model.observation
    assert isinstance(family, ObservationFamily)
    start = Moments(*ssm.initial())
    terms = FamilyTerms(family, y)
    found = evidence(ssm, rule, grid, y, terms, settings, start, keep="all")
    passed, sites = found.passed, found.refined.found.sites
    mean = at_intervals(backward(passed, start, grid).moments.mean[1:], grid.observed)
    errors = at_intervals(smoothing_errors(key, passed, start, draws), grid.observed)
    ends = at_intervals(jnp.asarray(grid.intervals.end), grid.observed)

    def log_weight(errors: jax.Array) -> jax.Array:
        f = jax.vmap(lambda s, t: ssm.observe(ssm.inputs(s, t), t))(mean + errors, ends)
        away = f - sites.centre
        return jnp.where(terms.present, terms.log_prob(f) - (sites.nu - 0.5 * sites.tau * away) * away, 0.0).sum()

    weights = jax.lax.map(log_weight, jnp.moveaxis(errors, -1, 0), batch_size=256)
    return jnp.where(found.refined.found.converged, passed.log_likelihood.sum() + weights, -jnp.inf)


def log_likelihood(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, key: jax.Array, draws: int,
                   settings: SiteSettings) -> jax.Array:
    """Return the log of the unbiased estimate; arguments as in `importance_weights`."""
    weights = importance_weights(ssm, rule, grid, y, key, draws, settings)
    return jax.scipy.special.logsumexp(weights) - jnp.log(draws)
