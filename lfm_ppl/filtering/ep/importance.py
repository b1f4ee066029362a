"""Importance weights of trajectories of the smoother with factors: an unbiased estimate of a family's likelihood."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.backward import backward
from lfm_ppl.filtering.ep.evidence import evidence
from lfm_ppl.filtering.ep.moment_matching import observation_family
from lfm_ppl.filtering.ep.settings import FactorSettings
from lfm_ppl.filtering.ep.terms import FamilyTerms
from lfm_ppl.filtering.moments import Record
from lfm_ppl.filtering.problem import FilterProblem, at_intervals
from lfm_ppl.filtering.sample import sample_errors


def importance_weights(problem: FilterProblem, y: jax.Array, key: jax.Array, draws: int,
                       settings: FactorSettings) -> jax.Array:
    r"""Return log weights (draws,) whose exponentials have the likelihood as their mean.

    The smoother with the factors is prior times factors, over the integral I of the factors. With draws f of it,

        p(y) = I E[prod_i p(y_i | f_i) / t_i(f_i)].

    Args:
        problem: a model that is linear in the state, with an observation family.
        y: (T, D), NaN where missing.
        key: a JAX random key.
        draws: number of trajectories.
        settings: of the factors.

    Source: Durbin and Koopman (1997), Biometrika 84; Shephard and Pitt (1997), Biometrika 84.
    """
    ssm, grid = problem.ssm, problem.grid
    terms = FamilyTerms(observation_family(problem), y)
    result = evidence(problem, terms, settings, record=Record.SMOOTHER)
    trace, fixed_point = result.trace, result.refined.fixed_point
    factors = fixed_point.factors
    mean = at_intervals(backward(problem, trace).moments.mean[1:], grid.observed)
    errors = at_intervals(sample_errors(key, trace, draws), grid.observed)
    end_times = at_intervals(jnp.asarray(grid.intervals.end), grid.observed)

    def log_weight(errors: jax.Array) -> jax.Array:
        f = jax.vmap(lambda s, t: ssm.observe(ssm.inputs(s, t), t))(mean + errors, end_times)
        offset = f - factors.centre
        log_factor = (factors.nu - 0.5 * factors.tau * offset) * offset
        return jnp.where(terms.present, terms.log_prob(f) - log_factor, 0.0).sum()

    weights = jax.lax.map(log_weight, jnp.moveaxis(errors, -1, 0), batch_size=256)
    return jnp.where(fixed_point.converged, trace.log_likelihood.sum() + weights, -jnp.inf)


def log_likelihood(problem: FilterProblem, y: jax.Array, key: jax.Array, draws: int,
                   settings: FactorSettings) -> jax.Array:
    """Return the log of the unbiased estimate; arguments as in `importance_weights`."""
    weights = importance_weights(problem, y, key, draws, settings)
    return jax.scipy.special.logsumexp(weights) - jnp.log(draws)
