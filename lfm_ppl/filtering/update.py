"""Updates: condition the predicted moments on one observation, or multiply them with Gaussian factors.

1. `linearise_observation` gives the observation as an affine map of the state.
2. An `Updater` turns that map, the row's data and the predicted moments into an `Update`: `GaussianUpdate` conditions
   on a Gaussian observation, `FactorUpdate` multiplies with given factors, and `MomentMatchingUpdate` of
   `lfm_ppl.filtering.ep.moment_matching` computes the factors of a row from its prediction.
3. Covariances are in Joseph's form. The log likelihood is -inf where the innovation covariance is not positive definite
   to working precision, or where the filtered moments of an output are rounding errors.

Source: Särkkä (2013), Bayesian Filtering and Smoothing, chapters 4 to 6; Minka (2001) for the factors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from lfm_ppl.filtering.dynamics import covariance_of, linearise
from lfm_ppl.filtering.moments import Moments, matvec
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.linearisation.sigma_points import SigmaPointRule
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.utils.gaussian_residuals import TURN, log_density, masked, wrapped
from lfm_ppl.utils.linalg import (
    cholesky,
    congruence,
    diagonal,
    inverse_and_log_det,
    matmul,
    safe_sqrt,
    symmetric,
)

if TYPE_CHECKING:
    from lfm_ppl.filtering.problem import FilterProblem

UPDATE_FAILED = "lfm_ppl: update failed"
INNOVATION_FACTOR = "lfm_ppl: factor of the innovation covariance"
"""Names under which quantities of a row are stored for its derivative instead of being computed again."""

_LOST_MEAN, _LOST_VARIANCE = 1e-3, 1e3
"""Errors of a filtered output, in standard deviations and variances of its noise, from which precision is lost."""

_HARMLESS = 1e-6
"""The same errors as fractions of an output's scale (and of its square) that do no harm, however small the noise."""


class LinearisedObservation(NamedTuple):
    """An observation as an affine map of the state: y ~ value + jacobian (s - point) + N(0, obs_cov).

    ``obs_cov`` is the covariance of the linearisation's residual and, for a Gaussian observation, of its noise. For an
    observation family the map is that of the predictor, without noise.
    """

    value: jax.Array
    jacobian: jax.Array
    obs_cov: jax.Array

    def shifted(self, change: jax.Array) -> LinearisedObservation:
        """Return the same map with its point moved by ``change`` (n,)."""
        return self._replace(value=self.value + matvec(self.jacobian, change))


class Factors(NamedTuple):
    """Gaussian factors of the predictor f, unnormalised: exp(nu (f - c) - tau (f - c)^2 / 2) for each entry.

    The parameters are natural ones, and tau may be negative. The point c only keeps numbers small.

    Attributes:
        centre: c (..., D).
        nu: (..., D).
        tau: (..., D).
    """

    centre: jax.Array
    nu: jax.Array
    tau: jax.Array


class FactorTerms(NamedTuple):
    """What the backward scan needs of an update by factors; f = value + H (s - m_p) + e, e ~ N(0, residual_cov).

    Attributes:
        value: (D,), the predicted mean of f.
        variance: F = H P H' + residual_cov (D, D).
        residual_cov: (D, D), covariance of the linearisation's residual.
        shrinkage: (I + T F)^-1 (D, D), with T = diag(tau).
        precision: (I + T F)^-1 T (D, D), the S^-1 of an observation.
        score: (I + T F)^-1 (nu - T (value - c)) (D,), the S^-1 v of an observation.
        factors: the factors.
    """

    value: jax.Array
    variance: jax.Array
    residual_cov: jax.Array
    shrinkage: jax.Array
    precision: jax.Array
    score: jax.Array
    factors: Factors


class Update(NamedTuple):
    """Filtered moments and what the smoother and the diagnostics need.

    An update returns either ``chol``, ``obs_cov`` and ``present`` (as `condition` does for Gaussian noise) or
    ``factor_terms`` (as `multiply_by_factors` does; an updater with factors calls it and replaces the log likelihood).

    Attributes:
        moments: given the observation.
        log_likelihood: log density of the observation's present entries, given the past.
        innovation: (D,), zero where missing.
        gain: (n, D).
        jacobian: (D, n), zero rows where missing.
        chol: (D, D), Cholesky factor of the innovation covariance, the identity where missing; None with factors.
        obs_cov: (D, D), covariance of the observation given the state, the identity where missing; None with factors.
        present: (D,), whether an entry is present; None with factors.
        factor_terms: of an update by factors; None otherwise.
    """

    moments: Any
    log_likelihood: Any
    innovation: jax.Array
    gain: Any
    jacobian: Any
    chol: Any = None
    obs_cov: Any = None
    present: Any = None
    factor_terms: FactorTerms | None = None


RowUpdate = Callable[[LinearisedObservation, jax.Array, Any, Moments], Update]
"""Maps a linearised observation, the row's index, its data and the predicted moments to an `Update`.

The index is for parameters of a row, such as its covariance; it is 0 in an interval without an observation.
"""


class Updater(Protocol):
    """How observations update the predicted moments."""

    def rows(self) -> Any:
        """Return the data of all rows, a pytree of arrays (T, ...).

        They become floats, and NaN in intervals without an observation: a scale of the noise is masked before its use.
        """

    def bind(self, problem: FilterProblem, initial: Moments) -> RowUpdate:
        """Return the update of one row, with what all rows share.

        Args:
            problem: the filter problem.
            initial: moments at the initial time, which give the scales of the outputs.
        """


class GaussianUpdate(NamedTuple):
    """Condition on Gaussian observations.

    Attributes:
        y: (T, D), NaN where missing.
    """

    y: jax.Array

    def rows(self) -> jax.Array:
        """Return the observations."""
        return jnp.asarray(self.y, float)

    def bind(self, problem: FilterProblem, initial: Moments) -> RowUpdate:
        """Return the update of one row; the scale of the outputs is that of all data and of the prior."""
        scale = _output_scale(problem, self.rows(), initial)

        def update(observation: LinearisedObservation, index: jax.Array, y: jax.Array, predicted: Moments) -> Update:
            return condition(problem.ssm, observation, y, predicted, scale)

        return update


class FactorUpdate(NamedTuple):
    """Multiply with given factors.

    Attributes:
        factors: (T, D) each.
    """

    factors: Factors

    def rows(self) -> jax.Array:
        """Return the factors as one array (T, 3, D)."""
        return jnp.stack(self.factors, axis=1)

    def bind(self, problem: FilterProblem, initial: Moments) -> RowUpdate:
        """Return the update of one row."""

        def update(observation: LinearisedObservation, index: jax.Array, row: jax.Array, predicted: Moments) -> Update:
            return multiply_by_factors(observation, Factors(*jnp.where(jnp.isnan(row), 0.0, row)), predicted)

        return update


def linearise_observation(ssm: StateSpaceModel, rule: Rule, jacobian: jax.Array, t: jax.Array, row: jax.Array,
                          centre: Moments) -> LinearisedObservation:
    """Linearise the observation of a row at time t about given moments."""
    angular, period = ssm.model.observation.angular, ssm.model.observation.period
    if angular:
        middle = jax.lax.stop_gradient(ssm.observe(ssm.inputs(centre.mean, t), t))

    def function(w: jax.Array) -> tuple[jax.Array, Any]:
        value = ssm.observe(w, t)
        for index in angular:
            # Averages are taken on the branch of the angle that is centred on the mean.
            value = value.at[index].set(middle[index] + wrapped(value[index] - middle[index], period))
        return value, ssm.obs_cov(w, t, row)

    affine = linearise(ssm, rule, function, ssm.observation_structure, jacobian, t,
                       (centre.mean, covariance_of(centre)), _minimum_sd(ssm, rule, t, centre))
    return LinearisedObservation(affine.value, affine.jacobian, affine.residual_cov + affine.extra)


def _minimum_sd(ssm: StateSpaceModel, rule: Rule, t: jax.Array, moments: Moments) -> jax.Array:
    """Return the standard deviation below which a coordinate counts as known, as in the prediction."""
    if isinstance(rule, SigmaPointRule) and rule.full_state:
        scale = moments.mean
    else:
        scale = ssm.inputs(moments.mean, t)[jnp.asarray(ssm.observation_structure.nonlinear, int)]
    # For a state that is exactly zero and known, any unit is as good as another.
    return jax.lax.stop_gradient(1e-6 * jnp.where(scale == 0, 1e-3, jnp.abs(scale)))


def condition(ssm: StateSpaceModel, observation: LinearisedObservation, y: jax.Array, predicted: Moments,
              scale: jax.Array | None = None) -> Update:
    """Condition on the present entries of ``y``, with the covariance in Joseph's form.

    Args:
        ssm: the model.
        observation: its affine map, whose point is the predicted mean.
        y: (D,), NaN where missing.
        predicted: predicted moments.
        scale: (D,), size of the outputs; None: skip the test for lost precision.
    """
    mean, covariance = predicted
    present = jnp.isfinite(y)
    jacobian = jnp.where(present[:, None], observation.jacobian, 0.0)
    residual = jnp.where(present, y, 0.0) - observation.value
    for index in ssm.model.observation.angular:
        residual = residual.at[index].set(wrapped(residual[index], ssm.model.observation.period))
    innovation, obs_cov = masked(residual, observation.obs_cov, present)
    cross = matmul(covariance, jacobian.T)
    innovation_covariance = matmul(jacobian, cross) + obs_cov
    # A smaller pivot has no correct digit, and its sign is random.
    rounding = 4 * jnp.finfo(y.dtype).eps * jnp.abs(diagonal(innovation_covariance))
    factor = cholesky(innovation_covariance, jax.lax.stop_gradient(rounding), name=INNOVATION_FACTOR)
    # The gain does not depend on the innovation, so that means with a common covariance share it.
    gain = factor.solve_upper(factor.solve_lower(cross.T)).T
    white = factor.solve_lower(innovation[:, None])
    i_kh = jnp.eye(mean.shape[0]) - matmul(gain, jacobian)
    filtered = Moments(mean + matvec(gain, innovation), congruence(i_kh, covariance) + congruence(gain, obs_cov))
    failed = factor.degenerate.any()
    if scale is not None:
        weighted = factor.solve_upper(white)[:, 0]
        error, variance = _output_errors(ssm, observation, y, predicted, filtered, matvec(obs_cov, weighted))
        failed = failed | (present & _is_precision_lost(error, variance, jnp.abs(diagonal(obs_cov)), scale)).any()
    failed = checkpoint_name(failed, UPDATE_FAILED)
    log_likelihood = jnp.where(failed, -jnp.inf, log_density(white[:, 0], factor.chol, present))
    return Update(filtered, log_likelihood, innovation, gain, jacobian, factor.chol, obs_cov, present)


def _output_errors(ssm: StateSpaceModel, observation: LinearisedObservation, y: jax.Array, predicted: Moments,
                   filtered: Moments, expected: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the error (D,) of the filtered outputs, whose residual should be ``expected``, and their variance (D,).

    Given the observation, the output has the residual R S^-1 v and the variance R - R S^-1 R <= R. Errors are some
    1e-16 of the prediction, too large where an unstable model has sent that to infinity, or nearly.
    """
    y = jnp.where(jnp.isfinite(y), y, 0.0)
    change = matvec(observation.jacobian, filtered.mean - predicted.mean)
    error = y - (observation.value + change) - expected
    for index in ssm.model.observation.angular:
        error = error.at[index].set(wrapped(error[index], ssm.model.observation.period))
    return error, jnp.abs((matmul(observation.jacobian, filtered.covariance) * observation.jacobian).sum(1))


def _is_precision_lost(error: jax.Array, variance: jax.Array, noise: jax.Array, scale: jax.Array) -> jax.Array:
    """Return whether the filtered moments of outputs with noise variances ``noise`` are rounding errors, (D,)."""
    return ((jnp.abs(error) > _LOST_MEAN * safe_sqrt(noise) + _HARMLESS * scale)
            | (variance > _LOST_VARIANCE * noise + _HARMLESS * scale**2))


def _output_scale(problem: FilterProblem, y: jax.Array, initial: Moments) -> jax.Array:
    """Return the size (D,) of the outputs: their largest observation, or the prior's standard deviation if larger.

    The prior's is that through the constant part of the observation's Jacobian. An angle is at least one radian large.
    """
    matrix, _ = problem.ssm.input_map(jnp.asarray(problem.grid.initial_time, float))
    jacobian = matmul(problem.shared.observation_jacobian, matrix)
    prior = safe_sqrt(diagonal(congruence(jacobian, initial.covariance)))
    scale = jnp.maximum(jnp.max(jnp.where(jnp.isfinite(y), jnp.abs(y), 0.0), axis=0), prior)
    for index in problem.ssm.model.observation.angular:
        scale = scale.at[index].max(problem.ssm.model.observation.period / TURN)
    return jax.lax.stop_gradient(scale)


def predictor_variance(observation: LinearisedObservation, moments: Moments) -> jax.Array:
    """Return the covariance F (D, D) of a family's predictor."""
    return congruence(observation.jacobian, moments.covariance) + observation.obs_cov


def multiply_by_factors(observation: LinearisedObservation, factors: Factors, predicted: Moments) -> Update:
    r"""Multiply the predicted moments with Gaussian factors in natural parameters.

    With f ~ N(m, F) as predicted and d = f - c,

        log \int N(f; m, F) prod_i t_i(f_i) df
            = -log|I + T F| / 2 + nu'(m + F s - c) / 2 + s'(m - c) / 2,    s = (I + T F)^-1 (nu - T (m - c)),

    and the covariance in Joseph's form, (I - K H) P (I - K H)' + P H' M T M' H P + K Omega K' with M = (I + T F)^-1
    and K = P H' M T. Nothing is divided by tau, which may be zero (nothing is observed) or negative.

    Args:
        observation: the predictor, linearised about the predicted moments; ``obs_cov`` is its residual covariance.
        factors: (D,) each.
        predicted: predicted moments.

    Returns:
        An update whose log likelihood is the integral above.

    Source: Minka (2001), Expectation propagation; Rasmussen and Williams (2006), section 3.6.
    """
    mean, covariance = predicted
    jacobian, residual_cov = observation.jacobian, observation.obs_cov
    cross = matmul(covariance, jacobian.T)
    variance = symmetric(matmul(jacobian, cross)) + residual_cov
    offset = observation.value - factors.centre
    shrinkage, log_det = inverse_and_log_det(jnp.eye(offset.shape[0]) + factors.tau[:, None] * variance)
    precision = symmetric(shrinkage * factors.tau[None, :])
    slope = factors.nu - factors.tau * offset
    score = matvec(shrinkage, slope)
    gain = matmul(cross, precision)
    i_kh = jnp.eye(mean.shape[0]) - matmul(gain, jacobian)
    gain_factor = matmul(cross, shrinkage)
    filtered = Moments(mean + matvec(cross, score),
                       congruence(i_kh, covariance) + symmetric(matmul(gain_factor * factors.tau, gain_factor.T))
                       + congruence(gain, residual_cov))
    log_integral = 0.5 * ((factors.nu * (offset + matvec(variance, score)) + score * offset).sum() - log_det)
    terms = FactorTerms(observation.value, variance, residual_cov, shrinkage, precision, score, factors)
    return Update(filtered, log_integral, slope, gain, jacobian, factor_terms=terms)
