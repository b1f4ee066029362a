"""Update: condition the state on one observation."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from lfm_ppl.filtering.predict import Moments, covariance_of, linearise_state
from lfm_ppl.gaussian_residuals import log_density, masked, wrapped
from lfm_ppl.linalg import (
    cholesky,
    congruence,
    diagonal,
    inverse_and_log_det,
    matmul,
    safe_sqrt,
    symmetric,
)
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.linearisation.sigma_points import SigmaPointRule
from lfm_ppl.model.state_space import StateSpaceModel

FAILED, FACTOR = "lfm_ppl: failed", "lfm_ppl: factor of the innovation covariance"
"""Under these names they are kept for the derivative of a row, and not computed again."""

_LOST_MEAN, _LOST_VARIANCE = 1e-3, 1e3
"""Errors of a filtered output, in standard deviations and variances of its noise, from which precision is lost."""

_HARMLESS = 1e-6
"""The same errors as shares of an output's scale (and of its square) that do no harm, however small the noise."""


class Linearised(NamedTuple):
    """An observation as an affine map of the state: y ~ value + jacobian (s - point) + N(0, obs_cov)."""

    value: jax.Array
    jacobian: jax.Array
    obs_cov: jax.Array

    def shifted(self, change: jax.Array) -> Linearised:
        """Return the same map with its point moved by ``change`` (n,)."""
        return self._replace(value=self.value + matmul(self.jacobian, change[:, None])[:, 0])


class Sites(NamedTuple):
    """Gaussian pseudo-observations of the predictor f, unnormalised: exp(nu (f - c) - tau (f - c)^2 / 2) an entry.

    The parameters are natural ones, and tau may be negative. The point c only keeps numbers small.

    Attributes:
        centre: c (..., D).
        nu: (..., D).
        tau: (..., D).
    """

    centre: jax.Array
    nu: jax.Array
    tau: jax.Array


class SiteTerms(NamedTuple):
    """What the backward scan needs of an update by sites; f = value + H (s - m_p) + e, e ~ N(0, residual_cov).

    Attributes:
        value: (D,), the predicted mean of f.
        variance: F = H P H' + residual_cov (D, D).
        residual_cov: (D, D), of what the linearisation leaves out.
        shrinkage: (I + T F)^-1 (D, D), with T = diag(tau).
        precision: (I + T F)^-1 T (D, D), the S^-1 of an observation.
        score: (I + T F)^-1 (nu - T (value - c)) (D,), the S^-1 v of an observation.
        sites: as they were used.
    """

    value: jax.Array
    variance: jax.Array
    residual_cov: jax.Array
    shrinkage: jax.Array
    precision: jax.Array
    score: jax.Array
    sites: Sites


class Update(NamedTuple):
    """The filtered moments and what the smoother and the diagnostics need.

    Attributes:
        moments: given the observation.
        log_likelihood: log density of the observation's present entries, given the past.
        innovation: (D,), zero where missing.
        chol: (D, D), Cholesky factor of the innovation covariance, the identity where missing.
        gain: (n, D).
        jacobian: (D, n), zero rows where missing.
        obs_cov: (D, D), covariance of the observation given the state, the identity where missing.
        site_terms: of an update by sites, which has neither chol nor obs_cov.
    """

    moments: Moments
    log_likelihood: jax.Array
    innovation: jax.Array
    chol: Any
    gain: jax.Array
    jacobian: jax.Array
    obs_cov: Any
    site_terms: SiteTerms | None = None


def linearise_observation(ssm: StateSpaceModel, rule: Rule, jacobian: jax.Array, t: jax.Array, row: jax.Array,
                          centre: Moments) -> Linearised:
    """Linearise the observation about given moments."""
    angular = ssm.model.observation.angular
    if angular:
        middle = jax.lax.stop_gradient(ssm.observe(ssm.inputs(centre.mean, t), t))

    def function(w: jax.Array) -> tuple[jax.Array, Any]:
        value = ssm.observe(w, t)
        for index in angular:
            # Averages are taken on the branch of the angle that is centred on the mean.
            value = value.at[index].set(middle[index] + wrapped(value[index] - middle[index]))
        return value, ssm.obs_cov(w, t, row)

    affine = linearise_state(ssm, rule, function, ssm.observation_structure, jacobian, t, centre.mean,
                             covariance_of(centre), _min_sd(ssm, rule, t, centre))
    return Linearised(affine.value, affine.jacobian, affine.residual_cov + affine.extra)


def _min_sd(ssm: StateSpaceModel, rule: Rule, t: jax.Array, moments: Moments) -> jax.Array:
    """As in the prediction: the standard deviation below which a coordinate counts as known."""
    if isinstance(rule, SigmaPointRule) and rule.full_state:
        scale = moments.mean
    else:
        scale = ssm.inputs(moments.mean, t)[jnp.asarray(ssm.observation_structure.points, int)]
    # Next to a state that is exactly zero and known, one unit is as good a scale as any.
    return jax.lax.stop_gradient(1e-6 * jnp.where(scale == 0, 1e-3, jnp.abs(scale)))


def update(ssm: StateSpaceModel, observation: Linearised, y: jax.Array, present: jax.Array,
           moments: Moments, scale: jax.Array | None = None) -> Update:
    """Condition on the present entries of ``y`` (D,), with the covariance in Joseph's form.

    The log likelihood is -inf where the innovation covariance is not positive definite to working precision, or where
    the filtered moments are lost to rounding: where an unstable model has sent the prediction to infinity, or nearly.

    Args:
        ssm: the model.
        observation: its linearisation about the predicted moments.
        y: (D,).
        present: (D,), whether an entry is.
        moments: predicted.
        scale: (D,), how large the outputs are; None: rounding errors of the filtered moments are not asked for.
    """
    mean, covariance = moments
    jacobian = jnp.where(present[:, None], observation.jacobian, 0.0)
    residual = jnp.where(present, y, 0.0) - observation.value
    for index in ssm.model.observation.angular:
        residual = residual.at[index].set(wrapped(residual[index]))
    innovation, obs_cov = masked(residual, observation.obs_cov, present)
    cross = matmul(covariance, jacobian.T)
    innovation_covariance = matmul(jacobian, cross) + obs_cov
    # A smaller pivot has no correct digit, and its sign is chance.
    rounding = 4 * jnp.finfo(y.dtype).eps * jnp.abs(diagonal(innovation_covariance))
    factor = cholesky(innovation_covariance, jax.lax.stop_gradient(rounding), name=FACTOR)
    chol = factor.chol
    # The gain does not see the innovation: it is one for all means that share a covariance.
    gain = factor.solve_upper(factor.solve_lower(cross.T)).T
    white = factor.solve_lower(innovation[:, None])
    kept = jnp.eye(mean.shape[0]) - matmul(gain, jacobian)
    filtered = Moments(mean + matmul(gain, innovation[:, None])[:, 0],
                       congruence(kept, covariance) + congruence(gain, obs_cov))
    failed = factor.degenerate.any()
    if scale is not None:
        failed = failed | _precision_lost(ssm, observation, y, present, moments, filtered, obs_cov,
                                          factor.solve_upper(white)[:, 0], scale)
    failed = checkpoint_name(failed, FAILED)
    log_likelihood = jnp.where(failed, -jnp.inf, log_density(white[:, 0], chol, present))
    return Update(filtered, log_likelihood, innovation, chol, gain, jacobian, obs_cov)


def predictor_variance(observation: Linearised, moments: Moments) -> jax.Array:
    """Return the covariance F (D, D) of a family's predictor."""
    return congruence(observation.jacobian, moments.covariance) + observation.obs_cov


def update_by_sites(observation: Linearised, sites: Sites, moments: Moments) -> Update:
    r"""Multiply the predicted moments with Gaussian sites in natural parameters.

    With f ~ N(m, F) as predicted and d = f - c,

        log \int N(f; m, F) prod_i t_i(f_i) df
            = -log|I + T F| / 2 + nu'(m - c) - (m - c)'T(m - c) / 2 + b'F (I + T F)^-1 b / 2,    b = nu - T (m - c),

    and the covariance in Joseph's form, (I - K H) P (I - K H)' + P H' M T M' H P + K Omega K' with M = (I + T F)^-1
    and K = P H' M T. Nothing is divided by tau, which may be zero (nothing is observed) or negative.

    Args:
        observation: the predictor, linearised about the predicted moments; its ``obs_cov`` is what that leaves out.
        sites: (D,) each.
        moments: predicted.

    Returns:
        An update whose log likelihood is the integral above.

    Source: Minka (2001), Expectation propagation; Rasmussen and Williams (2006), section 3.6.
    """
    mean, covariance = moments
    jacobian, residual_cov = observation.jacobian, observation.obs_cov
    cross = matmul(covariance, jacobian.T)
    variance = symmetric(matmul(jacobian, cross)) + residual_cov
    away = observation.value - sites.centre
    shrinkage, log_det = inverse_and_log_det(jnp.eye(away.shape[0]) + sites.tau[:, None] * variance)
    precision = symmetric(shrinkage * sites.tau[None, :])
    pull = sites.nu - sites.tau * away
    score = matmul(shrinkage, pull[:, None])[:, 0]
    gain = matmul(cross, precision)
    kept = jnp.eye(mean.shape[0]) - matmul(gain, jacobian)
    through = matmul(cross, shrinkage)
    filtered = Moments(mean + matmul(cross, score[:, None])[:, 0],
                       congruence(kept, covariance) + symmetric(matmul(through * sites.tau, through.T))
                       + congruence(gain, residual_cov))
    log_integral = ((sites.nu - 0.5 * sites.tau * away) * away).sum() - 0.5 * log_det + 0.5 * (
        pull * matmul(variance, score[:, None])[:, 0]).sum()
    terms = SiteTerms(observation.value, variance, residual_cov, shrinkage, precision, score, sites)
    return Update(filtered, log_integral, pull, None, gain, jacobian, None, terms)


def _precision_lost(ssm: StateSpaceModel, observation: Linearised, y: jax.Array, present: jax.Array,
                    predicted: Moments, filtered: Moments, obs_cov: jax.Array, weighted: jax.Array,
                    scale: jax.Array) -> jax.Array:
    """Whether the filtered moments of an observed output are nothing but rounding errors.

    Given the observation, the output has the residual R S^-1 v and the variance R - R S^-1 R <= R. Errors are some
    1e-16 of the prediction, too large where an unstable model has sent that to infinity, or nearly.

    Args:
        ssm: the model.
        observation: its linearisation about the predicted moments.
        y: (D,).
        present: (D,), whether an entry is.
        predicted: moments before the observation.
        filtered: moments after it.
        obs_cov: R (D, D).
        weighted: (D,), S^-1 v.
        scale: (D,), of the outputs.
    """
    y = jnp.where(present, y, 0.0)
    moved = matmul(observation.jacobian, (filtered.mean - predicted.mean)[:, None])[:, 0]
    error = y - (observation.value + moved) - matmul(obs_cov, weighted[:, None])[:, 0]
    for index in ssm.model.observation.angular:
        error = error.at[index].set(wrapped(error[index]))
    variance = jnp.abs((matmul(observation.jacobian, filtered.covariance) * observation.jacobian).sum(1))
    own = jnp.abs(diagonal(obs_cov))
    lost = ((jnp.abs(error) > _LOST_MEAN * safe_sqrt(own) + _HARMLESS * scale)
            | (variance > _LOST_VARIANCE * own + _HARMLESS * scale**2))
    return (present & lost).any()
