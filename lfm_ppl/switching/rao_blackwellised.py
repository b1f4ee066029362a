"""Rao-Blackwellised particle filter for a linear model with a discrete input under a known controller.

Given the path of the discrete input and the readings of its controller, the state of a linear model is Gaussian. A
particle carries the input d and the mean m and covariance P of the joint state. For each row of the time grid:

1. Predict m and P over the row with the model of the particle's input.
2. If there is an observation, update m and P, and multiply the particle's weight by the exact density of the
   observation given the particle.
3. If the row ends with a decision, draw the reading r_k, condition m and P on it, and decide:

       r_k ~ N(G m + g, G P G' + V),    (m, P) <- (m, P) given r_k,    d_k = decide(d_k-1, r_k, t_k).

4. If the effective sample size is below the threshold, resample.

The pairs (r_1:k, d_1:k) are exact draws, and the state given them has its exact distribution. Averages over the
particles are therefore unbiased for any number of particles, and their variance is at most that of averages over
particles that draw the whole state. If the input only adds to the dynamics, all particles share one covariance.

Source: Doucet, de Freitas, Murphy and Russell (2000), Rao-Blackwellised particle filtering for dynamic Bayesian
networks; Reece et al. (2014), Efficient state-space inference of periodic latent force models, section 9.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from lfm_ppl.filtering.arguments import check_observations, warn_single_precision
from lfm_ppl.filtering.filter import FilterState
from lfm_ppl.filtering.intervals import Intervals, with_observations
from lfm_ppl.filtering.moments import Moments
from lfm_ppl.filtering.update import LinearisedObservation, Update, condition
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.particles.normals import normals
from lfm_ppl.particles.resampling import RESAMPLING, effective_sample_size, resample, reweight
from lfm_ppl.switching.controller import Controller
from lfm_ppl.switching.mixture import Mixture
from lfm_ppl.switching.switched_model import (
    Build,
    SwitchedMap,
    SwitchedProblem,
    build_models,
    check_linear,
    decision_grid,
    initial_indices,
    initial_moments,
    is_input_additive,
    make_interval_map,
)
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import congruence, matmul
from lfm_ppl.utils.programs import shared_jit
from lfm_ppl.utils.semidefinite import semidefinite_root, solve_semidefinite


class RaoBlackwellisedResult(eqx.Module):
    """Result of `rao_blackwellised`.

    Attributes:
        times: (T,), observation or prediction times.
        log_likelihood: (T,), logarithms of the estimates of p(y_k | y_1:k-1); zero without an observation.
        mean, covariance: (T, n), (T, n, n), moments of the joint state given the observations up to each time.
        outputs: distributions of the outputs without noise, mixtures of one Gaussian for each particle.
        observed: distributions of the outputs with their observation noise.
        inputs: (T, N), values of the discrete input after each time.
        ess: (T,), effective sample size of the weights.
    """

    times: jax.Array
    log_likelihood: jax.Array
    mean: jax.Array
    covariance: jax.Array
    outputs: Mixture
    observed: Mixture
    inputs: jax.Array
    ess: jax.Array

    @property
    def input_mean(self) -> jax.Array:
        """Mean (T,) of the discrete input; for a heater, the probability that it is on."""
        return (jnp.exp(self.outputs.log_weights) * self.inputs).sum(1)


class _Particles(NamedTuple):
    """Rao-Blackwellised particles.

    Attributes:
        mean: (N, n).
        covariance: (N, n, n), or (n, n) if all particles share it.
        input_index: (N,), index of the discrete input.
        log_weights: (N,), normalised.
    """

    mean: jax.Array
    covariance: jax.Array
    input_index: jax.Array
    log_weights: jax.Array


def rao_blackwellised(key: jax.Array, build: Build, controller: Controller, times: ArrayLike, *,
                      y: ArrayLike | None = None, start: FilterState | None = None, initial: Any = 0,
                      decisions: Any = None, particles: int = 1000, steps: int = 10, max_step: float | None = None,
                      resampling: str = "systematic", threshold: float = 0.5) -> RaoBlackwellisedResult:
    """Predict, or filter, a linear latent force model with a discrete input under a known controller.

    A particle draws only the readings of the controller; see the module `lfm_ppl.switching.rao_blackwellised`. Within
    ``jax.jit`` the times must be known, and one compilation serves all values of the other arguments. Outside of it
    each call compiles, because ``build`` returns new functions: put repeated calls under ``jax.jit``.

    Args:
        key: a JAX random key.
        build: function from a value of the input to the `LatentForceModel` that holds while the input has this value.
        controller: controller of the input, such as `lfm.Thermostat`.
        times: (T,), non-decreasing, times of observations or predictions.
        y: (T, D), NaN where missing; None: no observations, a prediction.
        start: the ``state`` of a filter's result, from which to continue; None: the model's initial state.
        initial: index in ``controller.values`` of the input at the start, or (N,), one for each particle.
        decisions: times of its decisions, after an observation at the same time; None: ``times``.
        particles: number of particles N.
        steps: integration steps between two consecutive times; a time-invariant model is exact with any number.
        max_step: longest step; a longer interval gets more steps.
        resampling: "systematic", "stratified" or "multinomial".
        threshold: resample where the effective sample size is below this share of N.

    Returns:
        Moments, mixtures of the outputs, and the input of every particle, at ``times``.

    Raises:
        ValueError: a model or a reading that is not linear, an invalid index ``initial``, and as `lfm_ppl.filter`.
        TypeError: ``controller`` is not a controller, or ``key`` is not a random key.

    Example:
        >>> import jax, jax.numpy as jnp, lfm_ppl as lfm
        >>> def house(heater):
        ...     return lfm.LatentForceModel(
        ...         lambda x, u, t: 0.1 * (5.0 - x) + 2.0 * heater + u, {"rest": lfm.Matern(0.3, 2.0)},
        ...         lfm.GaussianObservation(lambda x, u, t: x, sd=0.1),
        ...         lfm.Gaussian(jnp.array([18.0]), jnp.eye(1)))
        >>> result = rao_blackwellised(jax.random.key(0), house, lfm.Thermostat(20.0), jnp.arange(0.0, 24.0))
        >>> mean, sd = result.outputs.moments()
        >>> mean.shape, bool(abs(mean[-1, 0] - 20.0) < 2.0)
        ((24, 1), True)

    Source: Doucet, de Freitas, Murphy and Russell (2000), Rao-Blackwellised particle filtering for dynamic Bayesian
    networks; Reece et al. (2014), Efficient state-space inference of periodic latent force models, section 9.
    """
    checks.random_key(key)
    checks.positive_integer("particles", particles)
    checks.one_of("resampling", resampling, RESAMPLING)
    if not 0.0 <= threshold <= 1.0:
        raise ValueError(f"threshold must lie in [0, 1], a share of the particles, got {threshold}.")
    ssms = build_models(build, controller)
    for ssm in ssms:
        check_linear(ssm, controller)
    grid, is_decision = decision_grid(ssms[0], times, decisions, start, steps, max_step)
    warn_single_precision()
    shape = (len(grid.observed), ssms[0].output_dim)
    y = jnp.full(shape, jnp.nan) if y is None else check_observations(y, *shape, empty=True)
    problem = SwitchedProblem(ssms, controller, grid, jnp.asarray(is_decision), initial_moments(ssms[0], start),
                              initial_indices(initial, controller, particles))
    return _filter(problem, jnp.asarray(times, float), y, key, resampling, threshold, is_input_additive(build))


@shared_jit
def _filter(problem: SwitchedProblem, times: jax.Array, y: jax.Array, key: jax.Array, resampling: str,
            threshold: float, shared: bool) -> RaoBlackwellisedResult:
    """Run the filter; ``shared``: all particles have the same covariance."""
    ssm, controller, grid = problem.ssms[0], problem.controller, problem.grid
    count = problem.initial_index.shape[0]
    interval_maps = [make_interval_map(ssm, controller, grid) for ssm in problem.ssms]
    equal = jnp.full(count, -np.log(count))

    def step(particles: _Particles,
             inputs: tuple[Intervals, jax.Array, jax.Array, jax.Array]) -> tuple[_Particles, tuple]:
        interval, y_row, is_decision, row_key = inputs
        reading_key, resampling_key = jax.random.split(row_key)
        maps = jax.tree_util.tree_map(lambda *leaves: jnp.stack(leaves),
                                      *(interval_map(interval) for interval_map in interval_maps))
        maps = _select_maps(maps, particles.input_index, shared)
        particles = _predict(particles, maps, shared)
        particles, log_likelihood = _update(ssm, particles, maps, y_row, shared)
        summary = _summarize(particles, maps, shared)
        particles = jax.lax.cond(
            is_decision, lambda p: _decide(controller, p, maps, interval.end, reading_key, shared),
            lambda p: p, particles)
        weights = jnp.exp(particles.log_weights)
        ess = effective_sample_size(weights)
        summary = (*summary, jnp.asarray(controller.values)[particles.input_index], ess, log_likelihood)
        is_resampled = jnp.isfinite(y_row).any() & (ess < threshold * count)
        ancestors = jax.lax.cond(is_resampled, lambda: resample(resampling_key, weights, resampling),
                                 lambda: jnp.arange(count))
        covariance = particles.covariance if shared else particles.covariance[ancestors]
        return _Particles(particles.mean[ancestors], covariance, particles.input_index[ancestors],
                          jnp.where(is_resampled, equal, particles.log_weights)), summary

    mean, covariance = problem.start.mean, problem.start.covariance
    first = _Particles(jnp.broadcast_to(mean, (count, *mean.shape)),
                       covariance if shared else jnp.broadcast_to(covariance, (count, *covariance.shape)),
                       problem.initial_index, equal)
    keys = jax.random.split(key, problem.is_decision.shape[0])
    _, summaries = jax.lax.scan(step, first, (*with_observations(grid.intervals, y), problem.is_decision, keys))
    mean, covariance, output, variance, noise, log_weights, inputs, ess, log_likelihood = (
        summary[jnp.asarray(grid.observed)] for summary in summaries)
    return RaoBlackwellisedResult(times, log_likelihood, mean, covariance, Mixture(output, variance, log_weights),
                                  Mixture(output, variance + noise, log_weights), inputs, ess)


def _select_maps(maps: SwitchedMap, input_index: jax.Array, shared: bool) -> SwitchedMap:
    """Return the map of each particle from the maps of all inputs; shared matrices stay one matrix."""
    selected = jax.tree_util.tree_map(lambda leaf: leaf[0] if shared else leaf[input_index], maps)
    return selected._replace(offset=maps.offset[input_index],
                             observation_offset=maps.observation_offset[input_index],
                             reading_offset=maps.reading_offset[input_index])


def _predict(particles: _Particles, maps: SwitchedMap, shared: bool) -> _Particles:
    """Predict the moments of each particle over the row."""
    def predict_covariance(phi: jax.Array, covariance: jax.Array, process_cov: jax.Array) -> jax.Array:
        return congruence(phi, covariance) + process_cov

    covariance = (predict_covariance if shared else jax.vmap(predict_covariance))(
        maps.phi, particles.covariance, maps.process_cov)
    return particles._replace(mean=_matvec(maps.phi, particles.mean, shared) + maps.offset, covariance=covariance)


def _update(ssm: StateSpaceModel, particles: _Particles, maps: SwitchedMap, y_row: jax.Array,
            shared: bool) -> tuple[_Particles, jax.Array]:
    """Condition each particle on an observation, and multiply its weight by the density of the observation.

    Returns:
        The particles, and the logarithm of the weighted mean density; zero without an observation.
    """
    axis = None if shared else 0
    predicted = _matvec(maps.jacobian, particles.mean, shared) + maps.observation_offset

    def update_particle(value: jax.Array, jacobian: jax.Array, obs_cov: jax.Array, mean: jax.Array,
                        covariance: jax.Array) -> Update:
        return condition(ssm, LinearisedObservation(value, jacobian, obs_cov), y_row, Moments(mean, covariance))

    out_axes = Update(Moments(0, axis), 0, 0, axis, axis, axis, axis, None)  # type: ignore[arg-type]
    updated = jax.vmap(update_particle, (0, axis, axis, 0, axis), out_axes)(
        predicted, maps.jacobian, maps.obs_cov, particles.mean, particles.covariance)
    log_weights, total = reweight(particles.log_weights, updated.log_likelihood, particles.log_weights)
    is_observed = jnp.isfinite(y_row).any()
    particles = particles._replace(mean=updated.moments.mean, covariance=updated.moments.covariance,
                                   log_weights=log_weights)
    return particles, jnp.where(is_observed, jnp.where(jnp.isnan(total), -jnp.inf, total), 0.0)


def _decide(controller: Controller, particles: _Particles, maps: SwitchedMap, t: jax.Array, key: jax.Array,
            shared: bool) -> _Particles:
    """Draw the reading of each particle, condition the particle on it, and decide."""
    predicted = _matvec(maps.reading_jacobian, particles.mean, shared) + maps.reading_offset
    reading_cov = jnp.diag(controller.variance())

    def condition_on_reading(jacobian: jax.Array, covariance: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        cross_cov = matmul(covariance, jacobian.T)
        innovation_cov = matmul(jacobian, cross_cov) + reading_cov
        gain = solve_semidefinite(innovation_cov, cross_cov.T).T
        # Joseph form: positive semi-definite in spite of rounding.
        eye_minus_kh = jnp.eye(covariance.shape[0]) - matmul(gain, jacobian)
        covariance = congruence(eye_minus_kh, covariance) + congruence(gain, reading_cov)
        return semidefinite_root(innovation_cov), gain, covariance

    root, gain, covariance = (condition_on_reading if shared else jax.vmap(condition_on_reading))(
        maps.reading_jacobian, particles.covariance)
    innovation = _matvec(root, normals(key, predicted.shape[1], predicted.shape[0]).T, shared)
    input_index = jax.vmap(lambda d, r: controller.decide(d, r, t))(particles.input_index, predicted + innovation)
    return particles._replace(mean=particles.mean + _matvec(gain, innovation, shared), covariance=covariance,
                              input_index=input_index.astype(particles.input_index.dtype))


def _summarize(particles: _Particles, maps: SwitchedMap, shared: bool) -> tuple[jax.Array, ...]:
    """Return the moments of the joint state, and the mixture of the outputs.

    Returns:
        Mean (n,) and covariance (n, n) of the joint state; means, variances and noise variances (N, D) of the outputs,
        variances (1, D) if shared; log weights (N,).
    """
    component_mean, component_cov, _, log_weights = particles
    weights = jnp.exp(log_weights)
    mean = weights @ component_mean
    centred = component_mean - mean
    within = component_cov if shared else jnp.tensordot(weights, component_cov, 1)
    output_cov = (congruence if shared else jax.vmap(congruence))(maps.jacobian, component_cov)
    variance, noise = (jnp.diagonal(matrix, axis1=-2, axis2=-1) for matrix in (output_cov, maps.obs_cov))
    if shared:
        variance, noise = variance[None], noise[None]
    output = _matvec(maps.jacobian, component_mean, shared) + maps.observation_offset
    return mean, within + (centred * weights[:, None]).T @ centred, output, variance, noise, log_weights


def _matvec(matrix: jax.Array, vectors: jax.Array, shared: bool) -> jax.Array:
    """Return the products of the particles' vectors (N, k) with one shared matrix, or with one for each particle."""
    return vectors @ matrix.T if shared else jnp.einsum("nij,nj->ni", matrix, vectors)
