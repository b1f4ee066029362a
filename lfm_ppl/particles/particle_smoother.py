"""Particle smoother: draws of trajectories from their distribution given all observations.

1. Run the particle filter, and keep the particles, weights and ancestors of every row.
2. Draw S particles of the last row by their weights: the ends of the trajectories.
3. Go back row by row. For a trajectory at s_k+1, choose a particle of row k
   - by backward simulation: particle i with probability proportional to W_i p(s_k+1 | s_i), where p is the transition
     density of the exact discretisation or of Euler's step;
   - by ancestor tracing: the ancestor of the particle at k + 1 in the filter.
   Between equal times the transition has no density, and backward simulation takes the ancestor, too.
4. Return the trajectories at the requested times, and the number of different particles in each row.

Source: Godsill, Doucet and West (2004), JASA 99(465); Kitagawa (1996), J. Comput. Graph. Statist. 5(1).
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from lfm_ppl.filtering.integrators.exact import exact_offset
from lfm_ppl.filtering.intervals import Intervals, TimeGrid, as_arrays
from lfm_ppl.filtering.smoother import MeanSd, Trajectories
from lfm_ppl.filtering.transition import exact
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.state_space import StateSpaceModel, state_space
from lfm_ppl.particles.particle_filter import (
    FilterStep,
    ParticleSettings,
    check_inputs,
    check_settings,
    filter_particles,
)
from lfm_ppl.particles.stochastic_steps import choose_scheme
from lfm_ppl.utils import checks
from lfm_ppl.utils.gaussian_residuals import log_density
from lfm_ppl.utils.linalg import cholesky, matmul, solve_lower
from lfm_ppl.utils.programs import shared_jit

BACKWARD, TRACING = "backward simulation", "ancestor tracing"
METHODS = (BACKWARD, TRACING)

_LARGEST_HISTORY = 2**32
"""Largest memory of the particles of all rows, in bytes."""

_BLOCK = 4_000_000
"""Number of transition densities that are computed at a time."""


class ParticleSmootherResult(eqx.Module):
    """Result of `particle_smoother`.

    Attributes:
        times: (K,), requested times.
        draws: (S, K, n), trajectories of the joint state.
        distinct: (K,), number of different particles among the trajectories at each time.
        ssm: the model in state-space form.
        method: "backward simulation" or "ancestor tracing".
        scheme: integration scheme.
    """

    times: jax.Array
    draws: jax.Array
    distinct: jax.Array
    ssm: StateSpaceModel
    method: str = eqx.field(static=True)
    scheme: str = eqx.field(static=True)

    @property
    def mean(self) -> jax.Array:
        """Mean (K, n) of the draws."""
        return self.draws.mean(axis=0)

    @property
    def covariance(self) -> jax.Array:
        """Covariance (K, n, n) of the draws."""
        centred = self.draws - self.mean
        return jnp.einsum("ski,skj->kij", centred, centred) / (self.draws.shape[0] - 1)

    @property
    def trajectories(self) -> Trajectories:
        """The draws as trajectories of physical state (S, K, M) and forces (S, K)."""
        inputs, size = self._inputs(slice(None)), self.ssm.physical_dim
        forces = {name: inputs[:, :, size + index] for index, name in enumerate(self.ssm.model.force_names)}
        return Trajectories(self.times, inputs[:, :, :size], forces)

    def force(self, name: str) -> MeanSd:
        """Return mean (K,) and sd (K,) of the draws of a force.

        Raises:
            ValueError: there is no force of that name.
        """
        checks.one_of("force", name, self.ssm.model.force_names)
        return self._moments(self.ssm.physical_dim + self.ssm.model.force_names.index(name))

    def state(self, name: str) -> MeanSd:
        """Return mean (K,) and sd (K,) of the draws of a physical state.

        Raises:
            ValueError: there is no state of that name.
        """
        checks.one_of("state", name, self.ssm.model.state_names)
        return self._moments(self.ssm.model.state_names.index(name))

    def _inputs(self, columns: slice) -> jax.Array:
        """Return the draws (S, K, C) of some columns of the inputs w = (x, u)."""
        matrix, offset = jax.vmap(self.ssm.input_map)(self.times)
        return jnp.einsum("kcn,skn->skc", matrix[:, columns], self.draws) + offset[:, columns]

    def _moments(self, index: int) -> MeanSd:
        draws = self._inputs(slice(index, index + 1))[:, :, 0]
        return MeanSd(draws.mean(axis=0), draws.std(axis=0, ddof=1))


def particle_smoother(key: jax.Array, model: LatentForceModel, times: ArrayLike, y: ArrayLike, *,
                      particles: int = 2_000, draws: int = 200, at: ArrayLike | None = None,
                      method: str = "auto", steps: int = 20, max_step: float | None = None,
                      resampling: str = "systematic", threshold: float = 0.5,
                      scheme: str = "auto") -> ParticleSmootherResult:
    """Draw trajectories of the joint state given all observations.

    Backward simulation draws the last state from the filter's particles. Then it goes back in time and chooses
    particle i with probability proportional to W_i p(s_k+1 | s_i). It needs the transition density, which is that of
    the exact transition for linear time-invariant models, and that of Euler's step otherwise. In the second case the
    particles, too, move by Euler's method, with one step for each row. In both cases every state must have noise.
    Ancestor tracing needs no density: it follows the ancestors of the last particles. Far back, all its trajectories
    pass through few particles; see ``distinct``.

    Args:
        key: a JAX random key.
        model: the latent force model; its functions are read once for each model, as by `jax.jit`.
        times: (T,), non-decreasing.
        y: (T, D), NaN where missing.
        particles: number of particles N.
        draws: number of trajectories S, at least two for their covariance.
        at: (K,) times of the trajectories, at or after the initial time, also after the data; by default ``times``.
        method: "backward simulation", "ancestor tracing", or "auto": the first of these that the model allows.
        steps: integration steps between two consecutive times; Euler's method needs more than the others.
        max_step: longest step.
        resampling: as in `particle_filter`.
        threshold: as in `particle_filter`.
        scheme: integration scheme as in `particle_filter`; backward simulation allows "exact" and "euler" only.

    Returns:
        The trajectories. Memory is proportional to particles times integration steps. Cost is proportional to the
        same product, for backward simulation also to the number of draws.

    Raises:
        ValueError, TypeError: as `particle_filter`; a method that the model does not allow; more than 4 GiB of
            particles.

    Example:
        >>> import jax, jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: x - x**3, {}, lfm.GaussianObservation(lambda x, u, t: x, sd=0.3),
        ...     lfm.Gaussian(jnp.zeros(1), jnp.eye(1)), process_noise=jnp.eye(1))
        >>> result = lfm.particle_smoother(
        ...     jax.random.key(0), model, jnp.arange(3.0), jnp.ones((3, 1)), particles=50, draws=10)
        >>> result.method, result.draws.shape
        ('backward simulation', (10, 3, 1))

    Source: Godsill, Doucet and West (2004), JASA 99(465); Kitagawa (1996), J. Comput. Graph. Statist. 5(1).
    """
    checks.random_key(key)
    checks.positive_integer("draws", draws)
    checks.one_of("method", method, ("auto", *METHODS))
    ssm = state_space(model)
    method, scheme = _choose_method(ssm, method, scheme)
    interval_per_step = method == BACKWARD and scheme == "euler"
    grid, y = check_inputs(ssm, times, y, steps, max_step, at, interval_per_step=interval_per_step)
    settings = check_settings(ssm, ParticleSettings(particles, resampling, threshold, scheme))
    rows = len(grid.intervals.observation)
    if (size := 8 * rows * particles * (ssm.state_dim + 2)) > _LARGEST_HISTORY:
        raise ValueError(f"the particles of {rows} rows would take {size / 2**30:.1f} GiB; smoothing keeps all of "
                         f"them. Take at most {particles * _LARGEST_HISTORY // size} particles, or fewer steps.")
    states, indices, _ = _compiled_draws(ssm, grid, y, key, settings, draws, method)
    distinct = np.array([len(np.unique(row)) for row in np.asarray(indices)])
    return ParticleSmootherResult(jnp.asarray(grid.requested_times, float), jnp.moveaxis(states, 0, 1),
                                  jnp.asarray(distinct), ssm, method, settings.scheme)


def _choose_method(ssm: StateSpaceModel, method: str, scheme: str) -> tuple[str, str]:
    """Return the method and the integration scheme, with "auto" replaced."""
    reason = _missing_density_reason(ssm)
    if method == BACKWARD and reason:
        raise ValueError(f"backward simulation needs the transition density, but {reason}. Use "
                         f'method="{TRACING}" (or "auto").')
    if method == TRACING or reason:
        return TRACING, choose_scheme(ssm, scheme)
    if scheme not in ("auto", "exact", "euler"):
        raise ValueError(f'backward simulation moves particles by the scheme "exact" or "euler", got {scheme!r}.')
    if scheme == "auto":
        scheme = "exact" if ssm.plan.has_exact_noise else "euler"
    return BACKWARD, choose_scheme(ssm, scheme)


def _missing_density_reason(ssm: StateSpaceModel) -> str:
    """Return why the transition over a short time has no density; the empty string if it has one."""
    if ssm.stack.jump_times:
        return "a force jumps"
    if ssm.model.events:
        return "the model has events"
    if ssm.plan.has_exact_noise:
        noise = exact(ssm, jnp.ones(()), 1).process_cov
        return "" if _is_regular(noise) else "not every state of this linear model has noise"
    time = 0.0 if ssm.model.initial_time is None else ssm.model.initial_time
    w = jnp.concatenate([ssm.model.initial_state.mean, ssm.stack.mean_at(time)])
    dispersion = ssm.dispersion(w, time)
    if ssm.physical_dim and (dispersion is None or not _is_regular(matmul(dispersion, dispersion.T))):
        return "not every physical state has process noise"
    if ssm.force_dim and not _is_regular(ssm.stack.discretise(1.0)[1]):
        return "a force has states without noise"
    return ""


def _is_regular(covariance: jax.Array) -> bool:
    """Return whether a covariance is concrete and its correlation matrix is numerically positive definite."""
    value = checks.concrete(covariance)
    if value is None:
        return False
    sd = np.sqrt(np.maximum(np.diag(value), 0.0))
    return bool((sd > 0).all() and np.linalg.eigvalsh(value / np.outer(sd, sd)).min() > 1e-10)


def draw_trajectories(ssm: StateSpaceModel, grid: TimeGrid, y: jax.Array, key: jax.Array, settings: ParticleSettings,
                      draws: int, method: str) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return trajectories (K, S, n), their particle indices (K, S), and the log likelihood estimate.

    For compiled code.
    """
    filter_key, last_key, backward_key = jax.random.split(key, 3)
    steps: FilterStep = filter_particles(ssm, grid, y, filter_key, settings, lambda step: step)
    last_index = _sample_indices(last_key, jnp.broadcast_to(steps.log_weights[-1], (draws, settings.particles)))
    rows = as_arrays(grid.intervals)
    particles = jax.tree_util.tree_map(lambda a: a[:-1], (steps.state, steps.log_weights, steps.ancestors))
    intervals: Intervals = jax.tree.map(lambda a: a[1:], rows)
    keys = jax.random.split(backward_key, rows.start.shape[0])[1:]

    def step_back(carry: tuple[jax.Array, jax.Array], inputs: tuple) -> tuple[tuple, tuple]:
        (state, log_weights, ancestors), interval, row_key = inputs
        next_state, next_index = carry
        index = ancestors[next_index]
        if method == BACKWARD:
            def draw_index() -> jax.Array:
                mean, chol = _transition_moments(ssm, settings.scheme, interval, grid.steps, state)
                return _draw_origins(row_key, mean, chol, log_weights, next_state)

            ancestor_index = index
            index = jax.lax.cond(interval.length > 0, draw_index, lambda: ancestor_index)
        trajectories = state[:, index].T
        return (trajectories, index), (trajectories, index)

    last = (steps.state[-1][:, last_index].T, last_index)
    _, (states, indices) = jax.lax.scan(step_back, last, (particles, intervals, keys), reverse=True)
    states = jnp.concatenate([states, last[0][None]])
    indices = jnp.concatenate([indices, last_index[None]])
    requested = jnp.asarray(grid.requested)
    return states[requested], indices[requested], steps.log_likelihood.sum()


def _draw_origins(key: jax.Array, mean: jax.Array, chol: jax.Array, log_weights: jax.Array,
                  next_state: jax.Array) -> jax.Array:
    """Draw the particle (S,) from which each of the next states (S, n) originates.

    Args:
        key: a JAX random key.
        mean: (n, N), mean of the next state given each particle.
        chol: (n, n) or (n, n, N), Cholesky factor of its covariance.
        log_weights: (N,), of the particles.
        next_state: (S, n).
    """
    def draw_origin(state_and_uniform: tuple[jax.Array, jax.Array]) -> jax.Array:
        state, uniform = state_and_uniform
        density = jax.vmap(lambda m, c: log_density(solve_lower(c, state - m), c),
                           in_axes=(-1, -1 if chol.ndim == 3 else None))(mean, chol)
        return _quantile_index(uniform, log_weights + jnp.where(jnp.isnan(density), -jnp.inf, density))

    batch_size = max(1, min(next_state.shape[0], _BLOCK // mean.shape[1]))
    uniforms = jax.random.uniform(key, next_state.shape[:1])
    return jax.lax.map(draw_origin, (next_state, uniforms), batch_size=batch_size)


def _transition_moments(ssm: StateSpaceModel, scheme: str, interval: Intervals, steps: int,
                        state: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the means (n, N) of the next state, and the factor of its covariance, (n, n) or (n, n, N)."""
    if scheme == "exact":
        transition = exact(ssm, interval.length, steps)
        offset = exact_offset(ssm, transition, steps, interval.span, interval.length)
        return matmul(transition.phi, state) + offset[:, None], cholesky(transition.process_cov).chol
    size, length = ssm.physical_dim, interval.length
    force_transition, force_noise = ssm.stack.discretise(length)

    def euler_moments(s: jax.Array) -> tuple[jax.Array, jax.Array]:
        t = interval.span.time()
        w = ssm.inputs(s, t)
        physical_mean = s[:size] + length * ssm.drift(w, t)
        dispersion = ssm.dispersion(w, t)
        physical_noise = jnp.zeros((0, 0)) if dispersion is None else length * matmul(dispersion, dispersion.T)
        covariance = jax.scipy.linalg.block_diag(physical_noise, force_noise)
        mean = jnp.concatenate([physical_mean, matmul(force_transition, s[size:, None])[:, 0]])
        return mean, cholesky(covariance).chol

    # One factor serves all particles unless the noise depends on the state.
    factor_axis = -1 if callable(ssm.model.process_noise) else None
    return jax.vmap(euler_moments, in_axes=-1, out_axes=(-1, factor_axis))(state)


def _sample_indices(key: jax.Array, log_weights: jax.Array) -> jax.Array:
    """Draw one index for each row of log weights (S, N); return them, (S,)."""
    return jax.vmap(_quantile_index)(jax.random.uniform(key, log_weights.shape[:1]), log_weights)


def _quantile_index(uniform: jax.Array, log_weights: jax.Array) -> jax.Array:
    """Return the index of the quantile ``uniform`` in [0, 1) of the distribution with weights (N,)."""
    cumulative = jnp.cumsum(jnp.exp(log_weights - log_weights.max()))
    index = jnp.searchsorted(cumulative, uniform * cumulative[-1], side="right")
    return jnp.minimum(index, log_weights.shape[0] - 1).astype(int)


_compiled_draws = shared_jit(draw_trajectories)
