"""Bootstrap particle filter: an unbiased estimate of the likelihood of any state-space model."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.filtering.filter import check_observations, warn_single_precision
from lfm_ppl.filtering.time_grid import Intervals, TimeGrid, build_time_grid, with_observations
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observation_noise import check_noise, log_density
from lfm_ppl.model.state_space import StateSpaceModel, state_space
from lfm_ppl.particles.resampling import RESAMPLING, effective_sample_size, resample, reweighted
from lfm_ppl.particles.stochastic_steps import Moves, Prepared, choose_scheme, first_particles


class ParticleSettings(NamedTuple):
    """How the filter runs; hashable, so that compiled code can take it as static.

    Attributes:
        particles: N.
        resampling: one of `lfm_ppl.particles.resampling.RESAMPLING`.
        threshold: resample where the effective sample size is below this share of N; 1 for always.
        scheme: of the steps, see `lfm_ppl.particles.stochastic_steps.choose_scheme`.
        batch: particles that are moved and weighted at a time; None: all.
    """

    particles: int = 1000
    resampling: str = "systematic"
    threshold: float = 0.5
    scheme: str = "auto"
    batch: int | None = None


class ParticleFilterResult(eqx.Module):
    """The outcome of `particle_filter`.

    Attributes:
        times: (T,).
        log_likelihood: (T,), logarithms of the estimates of p(y_k | y_1:k-1). The exponential of their SUM is an
            unbiased estimate of the likelihood.
        mean, covariance: (T, n), (T, n, n), filtering moments of the joint state.
        ess: (T,), effective sample size of the weights after each observation, before resampling.
        resampled: (T,), whether the particles were resampled after it.
        particles: N.
        scheme: of the steps.
    """

    times: jax.Array
    log_likelihood: jax.Array
    mean: jax.Array
    covariance: jax.Array
    ess: jax.Array
    resampled: jax.Array
    particles: int = eqx.field(static=True)
    scheme: str = eqx.field(static=True)

    @property
    def minimum_ess(self) -> tuple[float, float]:
        """The smallest effective sample size, and the time at which it occurs."""
        worst = int(np.argmin(np.asarray(self.ess)))
        return float(self.ess[worst]), float(self.times[worst])


class Step(NamedTuple):
    """What a row leaves.

    Attributes:
        log_likelihood: of the row's observation; without one, of having stayed among the finite numbers, mostly zero.
        state: (n, N), the particles before resampling.
        log_weights: (N,), normalised, after the observation.
        ess: of these weights.
        resampled: whether they were resampled.
        ancestors: (N,), which particles go on.
    """

    log_likelihood: jax.Array
    state: Any = None
    log_weights: Any = None
    ess: Any = None
    resampled: Any = None
    ancestors: Any = None


def particle_filter(key: jax.Array, model: LatentForceModel, times: Any, y: Any, *, particles: int = 10_000,
                    steps: int = 20, max_step: float | None = None, resampling: str = "systematic",
                    threshold: float = 0.5, scheme: str = "auto", batch: int | None = None) -> ParticleFilterResult:
    """Run the bootstrap particle filter.

    Particles follow the model itself, forces exactly and the physical state by a stochastic Runge-Kutta scheme; at an
    observation particle i gets the weight p(y_k | s_i), and

        p(y_k | y_1:k-1) ~ sum_i W_i p(y_k | s_i),

    with W the normalised weights of before. The product over k is an unbiased estimate of the likelihood (of the model
    as the steps discretise it), whatever the number of particles.

    Args:
        key: a JAX random key.
        model: the latent force model.
        times: (T,), non-decreasing; equal times are replicates.
        y: (T, D), NaN where missing.
        particles: N.
        steps: integration steps between two consecutive times.
        max_step: longest step; longer intervals get more.
        resampling: "systematic", "stratified" or "multinomial".
        threshold: resample where the effective sample size is below this share of N; 1 for after every observation.
        scheme: of the steps: "exact" (linear time-invariant models), "srk" (additive noise, strong order 1.5),
            "milstein" (strong order 1; several noise sources must commute, and a force in the dispersion be smooth),
            "euler", or "auto" for the first of these that the model allows, Milstein with one noise source only.
        batch: particles that are moved and weighted at a time, one batch after another, where memory is short: what is
            held besides the particles is proportional to it. None: all at once, which is faster.

    Returns:
        Log likelihoods, filtering moments and effective sample sizes, by observation.

    Raises:
        ValueError, TypeError: as `lfm_ppl.filter`; zero particles; an unknown name; observation noise whose covariance
            is singular, so that the weights have no density.

    Example:
        >>> import jax, jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: x - x**3, {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
        ...     lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.eye(1))
        >>> result = lfm.particle_filter(jax.random.key(0), model, jnp.arange(3.0), jnp.ones((3, 1)), particles=100)
        >>> result.scheme
        'srk'

    Source: Gordon, Salmond and Smith (1993), IEE Proceedings F 140(2); Rössler (2010), SIAM J. Numer. Anal. 48(3).
    """
    checks.random_key(key)
    ssm = state_space(model)
    grid, y = checked(ssm, times, y, steps, max_step)
    settings = check_settings(ssm, ParticleSettings(particles, resampling, threshold, scheme, batch))
    return _run(ssm, grid, y, jnp.asarray(times, float), key, settings)


@eqx.filter_jit
def _run(ssm: StateSpaceModel, grid: TimeGrid, y: jax.Array, times: jax.Array, key: jax.Array,
         settings: ParticleSettings) -> ParticleFilterResult:
    def summary(step: Step) -> tuple:
        return step.log_likelihood, *_moments(step.state, step.log_weights), step.ess, step.resampled

    kept = forward(ssm, grid, y, key, settings, summary)
    observed = jnp.asarray(grid.observed)
    # What happens in rows between two observations belongs to the second.
    following = jnp.searchsorted(observed, jnp.arange(kept[0].shape[0]))
    total = jax.ops.segment_sum(kept[0], following, observed.shape[0] + 1)[:-1]
    mean, covariance, ess, resampled = (part[observed] for part in kept[1:])
    return ParticleFilterResult(times, total, mean, covariance, ess, resampled, settings.particles, settings.scheme)


def log_likelihood(ssm: StateSpaceModel, grid: TimeGrid, y: jax.Array, key: jax.Array,
                   settings: ParticleSettings) -> jax.Array:
    """Return the log of an unbiased estimate of the likelihood, for compiled code; a failure is -inf.

    Args:
        ssm: the model; it may hold traced parameters.
        grid: the time grid.
        y: (T, D), NaN where missing.
        key: a JAX random key.
        settings: checked ones, see `check_settings`.
    """
    total = forward(ssm, grid, y, key, settings, lambda step: step.log_likelihood).sum()
    return jnp.where(jnp.isnan(total), -jnp.inf, total)


def checked(ssm: StateSpaceModel, times: Any, y: Any, steps: int, max_step: float | None,
            at: Any = None, interval_per_step: bool = False) -> tuple[TimeGrid, jax.Array]:
    """Check what a particle method is given, and return rows and observations."""
    grid = build_time_grid(ssm, times, steps, max_step, at, interval_per_step=interval_per_step)
    ssm.model.check_at(grid.initial_time, len(grid.observed))
    check_noise(ssm, grid.initial_time)
    warn_single_precision()
    return grid, check_observations(y, len(grid.observed), ssm.output_dim, model=ssm.model)


def check_settings(ssm: StateSpaceModel, settings: ParticleSettings) -> ParticleSettings:
    """Check the settings, and return them with the scheme that "auto" stands for."""
    checks.positive_integer("particles", settings.particles)
    checks.one_of("resampling", settings.resampling, RESAMPLING)
    if not 0.0 <= settings.threshold <= 1.0:
        raise ValueError(f"threshold must lie in [0, 1], a share of the particles, got {settings.threshold}.")
    if settings.batch is not None:
        checks.positive_integer("batch", settings.batch)
    return settings._replace(scheme=choose_scheme(ssm, settings.scheme))


def forward(ssm: StateSpaceModel, grid: TimeGrid, y: jax.Array, key: jax.Array, settings: ParticleSettings,
            keep: Callable[[Step], Any]) -> Any:
    """Run over the rows and return ``keep`` of each, stacked."""
    first_key, rows_key = jax.random.split(key)
    size = settings.particles
    state = first_particles(first_key, *ssm.initial(), size)
    moves = Moves.over(ssm, settings.scheme, grid)

    def row(carry: tuple[jax.Array, jax.Array], inputs: tuple[Intervals, jax.Array, jax.Array]) -> tuple[tuple, Any]:
        state, log_weights = carry
        one, observed, row_key = inputs
        keys = jax.random.split(row_key, 3)
        ready = moves.ready(one)
        state, log_density = _in_batches(
            lambda k, s: _move(moves, ready, one, observed, k, s), keys[0], state, settings.batch)
        state, log_weights, step = _weigh(settings, keys[1], state, log_weights, log_density, one.observation >= 0)
        return (state, log_weights), keep(step)

    start = (state, jnp.full(size, -np.log(size)))
    rows, by_row = with_observations(grid.intervals, y)
    keys = jax.random.split(rows_key, by_row.shape[0])
    return jax.lax.scan(row, start, (rows, by_row, keys))[1]


def _move(moves: Moves, ready: Prepared, row: Intervals, observed: jax.Array, key: jax.Array,
          state: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Move particles over a row, and score the observation at its end."""
    move_key, jump_key = jax.random.split(key)
    state = moves.across(row, ready, move_key, jump_key, state)
    end = row.end
    density = jax.vmap(lambda s: log_observation(moves.ssm, s, end, jnp.maximum(row.observation, 0), observed),
                       in_axes=-1)(state)
    possible = jnp.isfinite(state).all(axis=0) & ~jnp.isnan(density)
    return state, jnp.where(possible, density, -jnp.inf)


def log_observation(ssm: StateSpaceModel, s: jax.Array, t: jax.Array, row: jax.Array, y: jax.Array) -> jax.Array:
    """Return log p(y | s) of the present entries of ``y`` (D,), zero where all are missing."""
    return log_density(ssm, ssm.inputs(s, t) if ssm.force_dim else s, t, row, y)[0]


def _weigh(settings: ParticleSettings, key: jax.Array, state: jax.Array, log_weights: jax.Array,
           log_density: jax.Array, observed: jax.Array) -> tuple[jax.Array, jax.Array, Step]:
    size = settings.particles
    equal = jnp.full(size, -np.log(size))
    log_weights, total = reweighted(log_weights, log_density, equal)
    weights = jnp.exp(log_weights)
    ess = effective_sample_size(weights)
    needed = observed & (ess < settings.threshold * size) if settings.threshold < 1.0 else observed
    stay = jnp.arange(size)
    ancestors = jax.lax.cond(needed, lambda: resample(key, weights, settings.resampling), lambda: stay)
    # Particles that have left the finite numbers count as such wherever it happens, not only at an observation.
    lost = jnp.isneginf(log_density).any()
    step = Step(jnp.where(observed | lost, total, 0.0), state, log_weights, ess, needed, ancestors)
    return state[:, ancestors], jnp.where(needed, equal, log_weights), step


def _in_batches(move: Callable, key: jax.Array, state: jax.Array, batch: int | None) -> tuple[jax.Array, jax.Array]:
    size = state.shape[1]
    if batch is None or batch >= size:
        return move(key, state)
    count = -(-size // batch)
    # Full batches only: the last one is filled up with copies, which are dropped again.
    index = jnp.minimum(jnp.arange(count * batch), size - 1)
    parts = jnp.moveaxis(state[:, index].reshape(-1, count, batch), 1, 0)
    moved, density = jax.lax.map(lambda pair: move(*pair), (jax.random.split(key, count), parts))
    return jnp.moveaxis(moved, 0, 1).reshape(state.shape[0], -1)[:, :size], density.reshape(-1)[:size]


def _moments(state: jax.Array, log_weights: jax.Array) -> tuple[jax.Array, jax.Array]:
    weights = jnp.exp(log_weights)
    # A particle that has left the finite numbers has weight zero, and zero times infinity is NaN.
    state = jnp.where(weights > 0, state, 0.0)
    mean = state @ weights
    centred = state - mean[:, None]
    return mean, (centred * weights) @ centred.T
