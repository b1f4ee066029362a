"""Bootstrap particle filter: an unbiased estimate of the likelihood of any state-space model.

1. Draw N particles from the initial distribution, with equal weights.
2. For each row of the time grid, move the particles over the row (`lfm_ppl.particles.stochastic_steps`).
3. If the row ends with an observation y_k, multiply the weight of particle i by p(y_k | s_i). The logarithm of the sum
   of the products is the estimate of log p(y_k | y_1:k-1). Normalise the weights.
4. If the effective sample size is below the threshold, resample: draw N ancestors with probabilities proportional to
   the weights, and make the weights equal.
5. A particle with a non-finite state or density has weight zero.
6. Sum the log likelihood over the rows; return the weighted moments at the observations.

Source: Gordon, Salmond and Smith (1993), IEE Proceedings F 140(2).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from lfm_ppl.filtering.arguments import check_observations, warn_single_precision
from lfm_ppl.filtering.intervals import Intervals, TimeGrid, with_observations, with_state_maps
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation_noise import check_noise, log_density
from lfm_ppl.model.state_space import StateSpaceModel, state_space
from lfm_ppl.particles.resampling import RESAMPLING, effective_sample_size, resample, reweight
from lfm_ppl.particles.stochastic_steps import ParticleTransition, StepConstants, choose_scheme, initial_particles
from lfm_ppl.utils import checks
from lfm_ppl.utils.programs import shared_jit
from lfm_ppl.utils.random_keys import split_by_name


class ParticleSettings(NamedTuple):
    """Settings of the particle filter; hashable, so that they can be static arguments of compiled code.

    Attributes:
        particles: number of particles N.
        resampling: one of `lfm_ppl.particles.resampling.RESAMPLING`.
        threshold: resample where the effective sample size is below this share of N; 1: after every observation.
        scheme: integration scheme, see `lfm_ppl.particles.stochastic_steps.choose_scheme`.
        batch: number of particles that are moved and weighted at a time; None: all.
    """

    particles: int = 1000
    resampling: str = "systematic"
    threshold: float = 0.5
    scheme: str = "auto"
    batch: int | None = None


class ParticleFilterResult(eqx.Module):
    """Result of `particle_filter`.

    Attributes:
        times: (T,), observation times.
        log_likelihood: (T,), logarithms of the estimates of p(y_k | y_1:k-1). The exponential of their SUM is an
            unbiased estimate of the likelihood.
        mean, covariance: (T, n), (T, n, n), filtering moments of the joint state.
        ess: (T,), effective sample size of the weights after each observation, before resampling.
        resampled: (T,), whether the particles were resampled after the observation.
        particles: number of particles N.
        scheme: integration scheme.
    """

    times: jax.Array
    log_likelihood: jax.Array
    mean: jax.Array
    covariance: jax.Array
    ess: jax.Array
    resampled: jax.Array
    particles: int = eqx.field(static=True)
    scheme: str = eqx.field(static=True)


class FilterStep(NamedTuple):
    """Particles at the end of one row of the time grid, before resampling.

    Attributes:
        log_likelihood: scalar, of the row's observation. In a row without one it is zero, or the log share of weight
            of the particles that stay finite.
        state: (n, N), the particles.
        log_weights: (N,), normalised, after the observation.
        ess: effective sample size of these weights.
        resampled: whether the particles are resampled after the row.
        ancestors: (N,), indices of the particles with which the filter continues.
    """

    log_likelihood: jax.Array
    state: Any = None
    log_weights: Any = None
    ess: Any = None
    resampled: Any = None
    ancestors: Any = None


def particle_filter(key: jax.Array, model: LatentForceModel, times: ArrayLike, y: ArrayLike, *, particles: int = 10_000,
                    steps: int = 20, max_step: float | None = None, resampling: str = "systematic",
                    threshold: float = 0.5, scheme: str = "auto", batch: int | None = None) -> ParticleFilterResult:
    """Run the bootstrap particle filter.

    Particles follow the model: the forces exactly, the physical state by a stochastic Runge-Kutta scheme. At an
    observation the weight of particle i is multiplied by p(y_k | s_i), and

        p(y_k | y_1:k-1) ~ sum_i W_i p(y_k | s_i),

    where W are the normalised weights before the observation. The product over k is an unbiased estimate of the
    likelihood of the discretised model, for any number of particles.

    Args:
        key: a JAX random key.
        model: the latent force model; its functions are read once for each model, as by `jax.jit`.
        times: (T,), non-decreasing; equal times are replicates.
        y: (T, D), NaN where missing.
        particles: number of particles N.
        steps: integration steps between two consecutive times.
        max_step: longest step; a longer interval gets more steps.
        resampling: "systematic", "stratified" or "multinomial".
        threshold: resample where the effective sample size is below this share of N; 1: after every observation.
        scheme: integration scheme: "exact" (linear time-invariant models), "srk" (additive noise, strong order 1.5),
            "milstein" (strong order 1; several noise sources must commute, and a force in the dispersion must be
            smooth), "euler", or "auto": the first of these that the model allows, Milstein for one noise source only.
        batch: number of particles that are moved and weighted at a time. Use it if memory is short: temporary memory
            is proportional to the batch. None: all particles at once, which is faster.

    Returns:
        Log likelihoods, filtering moments and effective sample sizes at each observation.

    Raises:
        ValueError, TypeError: as `lfm_ppl.filter`; zero particles; an unknown name; a singular covariance of the
            observation noise, for which the weights have no density.

    Example:
        >>> import jax, jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: x - x**3, {}, lfm.GaussianObservation(lambda x, u, t: x, sd=0.3),
        ...     lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.eye(1))
        >>> result = lfm.particle_filter(jax.random.key(0), model, jnp.arange(3.0), jnp.ones((3, 1)), particles=100)
        >>> result.scheme
        'srk'

    Source: Gordon, Salmond and Smith (1993), IEE Proceedings F 140(2); Rössler (2010), SIAM J. Numer. Anal. 48(3).
    """
    checks.random_key(key)
    ssm = state_space(model)
    grid, y = check_inputs(ssm, times, y, steps, max_step)
    settings = check_settings(ssm, ParticleSettings(particles, resampling, threshold, scheme, batch))
    return _filter_moments(ssm, grid, y, jnp.asarray(times, float), key, settings)


@shared_jit
def _filter_moments(ssm: StateSpaceModel, grid: TimeGrid, y: jax.Array, times: jax.Array, key: jax.Array,
                    settings: ParticleSettings) -> ParticleFilterResult:
    """Run the filter and return its moments at the observations."""
    def summarize(step: FilterStep) -> tuple:
        return step.log_likelihood, *_moments(step.state, step.log_weights), step.ess, step.resampled

    row_log_likelihood, *summaries = filter_particles(ssm, grid, y, key, settings, summarize)
    observed = jnp.asarray(grid.observed)
    # A row between two observations contributes to the log likelihood of the second one.
    next_observation = jnp.searchsorted(observed, jnp.arange(row_log_likelihood.shape[0]))
    total = jax.ops.segment_sum(row_log_likelihood, next_observation, observed.shape[0] + 1)[:-1]
    mean, covariance, ess, resampled = (summary[observed] for summary in summaries)
    return ParticleFilterResult(times, total, mean, covariance, ess, resampled, settings.particles, settings.scheme)


def log_likelihood(ssm: StateSpaceModel, grid: TimeGrid, y: jax.Array, key: jax.Array,
                   settings: ParticleSettings) -> jax.Array:
    """Return the logarithm of an unbiased estimate of the likelihood; -inf for a failure. For compiled code.

    Args:
        ssm: the model; it may hold traced parameters.
        grid: the time grid.
        y: (T, D), NaN where missing.
        key: a JAX random key.
        settings: checked by `check_settings`.
    """
    total = filter_particles(ssm, grid, y, key, settings, lambda step: step.log_likelihood).sum()
    return jnp.where(jnp.isnan(total), -jnp.inf, total)


def check_inputs(ssm: StateSpaceModel, times: ArrayLike, y: ArrayLike, steps: int, max_step: float | None,
                 requested_times: Any = None, interval_per_step: bool = False) -> tuple[TimeGrid, jax.Array]:
    """Check times, observations and steps; return the time grid and the observations as an array."""
    grid = build_time_grid(ssm, times, steps, max_step, requested_times, interval_per_step=interval_per_step)
    ssm.model.check_at(grid.initial_time, len(grid.observed))
    check_noise(ssm, grid.initial_time)
    warn_single_precision()
    return grid, check_observations(y, len(grid.observed), ssm.output_dim, model=ssm.model)


def check_settings(ssm: StateSpaceModel, settings: ParticleSettings) -> ParticleSettings:
    """Check the settings, and return them with "auto" replaced by the scheme for the model."""
    checks.positive_integer("particles", settings.particles)
    checks.one_of("resampling", settings.resampling, RESAMPLING)
    if not 0.0 <= settings.threshold <= 1.0:
        raise ValueError(f"threshold must lie in [0, 1], a share of the particles, got {settings.threshold}.")
    if settings.batch is not None:
        checks.positive_integer("batch", settings.batch)
    return settings._replace(scheme=choose_scheme(ssm, settings.scheme))


def filter_particles(ssm: StateSpaceModel, grid: TimeGrid, y: jax.Array, key: jax.Array, settings: ParticleSettings,
                     summarize: Callable[[FilterStep], Any]) -> Any:
    """Run the filter over all rows and return ``summarize(step)`` of each row, stacked."""
    initial_key, rows_key = jax.random.split(key)
    count = settings.particles
    state = initial_particles(initial_key, *ssm.initial(), count)
    grid = with_state_maps(ssm, grid)
    transition = ParticleTransition(ssm, settings.scheme, grid)

    def step(carry: tuple[jax.Array, jax.Array], inputs: tuple[Intervals, jax.Array, jax.Array]) -> tuple[tuple, Any]:
        state, log_weights = carry
        interval, y_row, row_key = inputs
        keys = split_by_name(row_key, ("move", "resampling"))
        constants = transition.step_constants(interval)
        state, log_density = _in_batches(
            lambda k, s: _move_and_score(transition, constants, interval, y_row, k, s), keys["move"], state,
            settings.batch)
        state, log_weights, record = _reweight_and_resample(settings, keys["resampling"], state, log_weights,
                                                            log_density, interval.observation >= 0)
        return (state, log_weights), summarize(record)

    start = (state, jnp.full(count, -np.log(count)))
    rows, y_rows = with_observations(grid.intervals, y)
    keys = jax.random.split(rows_key, y_rows.shape[0])
    return jax.lax.scan(step, start, (rows, y_rows, keys))[1]


def _move_and_score(transition: ParticleTransition, constants: StepConstants, interval: Intervals, y_row: jax.Array,
                    key: jax.Array, state: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Move particles (n, N) over a row; return them and the log densities (N,) of the observation at its end."""
    move_key, jump_key = jax.random.split(key)
    state = transition.move(interval, constants, move_key, jump_key, state)
    end = interval.end
    density = jax.vmap(
        lambda s: log_observation(transition.ssm, s, end, jnp.maximum(interval.observation, 0), y_row),
        in_axes=-1)(state)
    is_possible = jnp.isfinite(state).all(axis=0) & ~jnp.isnan(density)
    return state, jnp.where(is_possible, density, -jnp.inf)


def log_observation(ssm: StateSpaceModel, s: jax.Array, t: jax.Array, row: jax.Array, y: jax.Array) -> jax.Array:
    """Return log p(y | s) of the present entries of ``y`` (D,), zero where all are missing."""
    return log_density(ssm, ssm.inputs(s, t) if ssm.force_dim else s, t, row, y)[0]


def _reweight_and_resample(settings: ParticleSettings, key: jax.Array, state: jax.Array, log_weights: jax.Array,
                           log_density: jax.Array, is_observed: jax.Array) -> tuple[jax.Array, jax.Array, FilterStep]:
    """Return particles and log weights with which the filter continues, and the record of the row."""
    count = settings.particles
    equal = jnp.full(count, -np.log(count))
    log_weights, total = reweight(log_weights, log_density, equal)
    weights = jnp.exp(log_weights)
    ess = effective_sample_size(weights)
    is_resampled = is_observed & (ess < settings.threshold * count) if settings.threshold < 1.0 else is_observed
    identity = jnp.arange(count)
    ancestors = jax.lax.cond(is_resampled, lambda: resample(key, weights, settings.resampling), lambda: identity)
    # Particles that become infinite or NaN lower the likelihood in every row, not only in rows with an observation.
    has_failures = jnp.isneginf(log_density).any()
    step = FilterStep(jnp.where(is_observed | has_failures, total, 0.0), state, log_weights, ess, is_resampled,
                      ancestors)
    return state[:, ancestors], jnp.where(is_resampled, equal, log_weights), step


def _in_batches(move: Callable, key: jax.Array, state: jax.Array, batch: int | None) -> tuple[jax.Array, jax.Array]:
    """Apply ``move(key, state)`` to batches of the particles (n, N), one after another."""
    count = state.shape[1]
    if batch is None or batch >= count:
        return move(key, state)
    batches = -(-count // batch)
    # All batches have the same size: the last one is padded with copies of the last particle, dropped afterwards.
    index = jnp.minimum(jnp.arange(batches * batch), count - 1)
    batched_state = jnp.moveaxis(state[:, index].reshape(-1, batches, batch), 1, 0)
    next_state, density = jax.lax.map(lambda pair: move(*pair), (jax.random.split(key, batches), batched_state))
    return jnp.moveaxis(next_state, 0, 1).reshape(state.shape[0], -1)[:, :count], density.reshape(-1)[:count]


def _moments(state: jax.Array, log_weights: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the weighted mean (n,) and covariance (n, n) of particles (n, N)."""
    weights = jnp.exp(log_weights)
    # A particle with a non-finite state has weight zero, and zero times infinity is NaN.
    state = jnp.where(weights > 0, state, 0.0)
    mean = state @ weights
    centred = state - mean[:, None]
    return mean, (centred * weights) @ centred.T
