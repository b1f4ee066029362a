"""Smoothing with particles: trajectories drawn from their distribution given all observations."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.filtering.predict import exact_offset
from lfm_ppl.filtering.time_grid import Intervals, TimeGrid, as_arrays
from lfm_ppl.filtering.transition import exact
from lfm_ppl.gaussian_residuals import log_density
from lfm_ppl.linalg import cholesky, matmul, solve_lower
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.state_space import StateSpaceModel, state_space
from lfm_ppl.particles.particle_filter import ParticleSettings, Step, check_settings, checked, forward
from lfm_ppl.particles.stochastic_steps import choose_scheme

BACKWARD, TRACING = "backward simulation", "ancestor tracing"
METHODS = (BACKWARD, TRACING)

_LARGEST_HISTORY = 2**32
"""Bytes that the particles of all rows may take."""

_BLOCK = 4_000_000
"""Transition densities that are computed at a time."""


class Paths(NamedTuple):
    """Trajectories of one force or state: draws (S, K), and their mean and standard deviation (K,)."""

    draws: jax.Array
    mean: jax.Array
    sd: jax.Array


class ParticleSmootherResult(eqx.Module):
    """Trajectories given all observations.

    Attributes:
        times: (K,).
        draws: (S, K, n), of the joint state.
        distinct: (K,), how many different particles the trajectories pass through.
        method: "backward simulation" or "ancestor tracing".
        scheme: of the steps.
    """

    times: jax.Array
    draws: jax.Array
    distinct: jax.Array
    ssm: StateSpaceModel
    method: str = eqx.field(static=True)
    scheme: str = eqx.field(static=True)

    @property
    def mean(self) -> jax.Array:
        """(K, n)."""
        return self.draws.mean(axis=0)

    @property
    def covariance(self) -> jax.Array:
        """(K, n, n)."""
        centred = self.draws - self.mean
        return jnp.einsum("ski,skj->kij", centred, centred) / (self.draws.shape[0] - 1)

    def force(self, name: str) -> Paths:
        """Return the trajectories of a force.

        Raises:
            ValueError: there is no force of that name.
        """
        checks.one_of("force", name, self.ssm.model.force_names)
        return self._paths(self.ssm.physical_dim + self.ssm.model.force_names.index(name))

    def state(self, name: str) -> Paths:
        """Return the trajectories of a physical state.

        Raises:
            ValueError: there is no state of that name.
        """
        checks.one_of("state", name, self.ssm.model.state_names)
        return self._paths(self.ssm.model.state_names.index(name))

    def _paths(self, index: int) -> Paths:
        matrix, offset = jax.vmap(self.ssm.input_map)(self.times)
        draws = jnp.einsum("kn,skn->sk", matrix[:, index], self.draws) + offset[:, index]
        return Paths(draws, draws.mean(axis=0), draws.std(axis=0, ddof=1))


def particle_smoother(key: jax.Array, model: LatentForceModel, times: Any, y: Any, *, particles: int = 2_000,
                      draws: int = 200, at: Any = None, method: str = "auto", steps: int = 20,
                      max_step: float | None = None, resampling: str = "systematic", threshold: float = 0.5,
                      scheme: str = "auto") -> ParticleSmootherResult:
    """Draw trajectories of the joint state given all observations.

    Backward simulation draws the last state from the filter's particles, and then, going back, particle i with
    probability proportional to W_i p(s_k+1 | s_i). It needs the transition density: that of the exact transition for
    linear time-invariant models, else of Euler's step, with which the particles move then, too, one step to a row; in
    both cases every state must have noise of its own. Ancestor tracing needs no density: it follows the ancestors of
    the last particles. All its trajectories meet in few particles when going back far, see ``distinct``.

    Args:
        key: a JAX random key.
        model: the latent force model.
        times: (T,), non-decreasing.
        y: (T, D), NaN where missing.
        particles: N.
        draws: S, number of trajectories. (At least two, for their covariance.)
        at: (K,) times of the trajectories, between the initial time and any time after the data; by default ``times``.
        method: "backward simulation", "ancestor tracing", or "auto" for the first where the model allows it.
        steps: integration steps between two consecutive times; Euler's method needs more than the others.
        max_step: longest step.
        resampling: as in `particle_filter`, and so is the next one.
        threshold: of the effective sample size.
        scheme: of the steps, as in `particle_filter`; backward simulation takes "exact" or "euler" alone.

    Returns:
        The trajectories. Cost and memory are proportional to particles times integration steps, and for backward
        simulation the cost to the draws, too.

    Raises:
        ValueError, TypeError: as `particle_filter`; a method that the model does not allow; more than 4 GiB of
            particles.

    Example:
        >>> import jax, jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: x - x**3, {}, lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])),
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
    chosen, scheme = _method(ssm, method, scheme)
    per_step = chosen == BACKWARD and scheme == "euler"
    grid, y = checked(ssm, times, y, steps, max_step, at, interval_per_step=per_step)
    settings = check_settings(ssm, ParticleSettings(particles, resampling, threshold, scheme))
    rows = len(grid.intervals.observation)
    if (needed := 8 * rows * particles * (ssm.state_dim + 2)) > _LARGEST_HISTORY:
        raise ValueError(f"the particles of {rows} rows would take {needed / 2**30:.1f} GiB; smoothing keeps all of "
                         f"them. Take at most {particles * _LARGEST_HISTORY // needed} particles, or fewer steps.")
    states, index, _ = eqx.filter_jit(draw_trajectories)(ssm, grid, y, key, settings, draws, chosen)
    distinct = np.array([len(np.unique(row)) for row in np.asarray(index)])
    return ParticleSmootherResult(jnp.asarray(grid.requested_times, float), jnp.moveaxis(states, 0, 1),
                                  jnp.asarray(distinct), ssm, chosen, settings.scheme)


def _method(ssm: StateSpaceModel, method: str, scheme: str) -> tuple[str, str]:
    """Return the method and the scheme that are wanted, or that the model allows."""
    reason = _obstacle(ssm)
    if method == BACKWARD and reason:
        raise ValueError(f"backward simulation needs the transition density, but {reason}. Use "
                         f'method="{TRACING}" (or "auto").')
    if method == TRACING or reason:
        return TRACING, choose_scheme(ssm, scheme)
    if scheme not in ("auto", "exact", "euler"):
        raise ValueError(f'backward simulation moves particles by the scheme "exact" or "euler", got {scheme!r}.')
    return BACKWARD, choose_scheme(ssm, scheme if scheme != "auto" else "exact" if ssm.time_invariant else "euler")


def _obstacle(ssm: StateSpaceModel) -> str:
    """Return why a transition over a short time has no density; empty where it has."""
    if ssm.stack.jump_times:
        return "a force jumps"
    if ssm.time_invariant:
        noise = exact(ssm, jnp.ones(()), 1).process_cov
        return "" if _regular(noise) else "not every state of this linear model has noise"
    time = 0.0 if ssm.model.initial_time is None else ssm.model.initial_time
    w = jnp.concatenate([ssm.model.initial_state.mean, ssm.stack.mean_at(time)])
    dispersion = ssm.dispersion(w, time)
    if ssm.physical_dim and (dispersion is None or not _regular(matmul(dispersion, dispersion.T))):
        return "not every physical state has process noise"
    if ssm.force_dim and not _regular(ssm.stack.discretise(1.0)[1]):
        return "a force has states without noise"
    return ""


def _regular(covariance: jax.Array) -> bool:
    known = checks.concrete(covariance)
    if known is None:
        return False
    scale = np.sqrt(np.maximum(np.diag(known), 0.0))
    return bool((scale > 0).all() and np.linalg.eigvalsh(known / np.outer(scale, scale)).min() > 1e-10)


def draw_trajectories(ssm: StateSpaceModel, grid: TimeGrid, y: jax.Array, key: jax.Array, settings: ParticleSettings,
                      draws: int, method: str) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return trajectories (K, S, n), the particles (K, S) that they pass through, and the log likelihood estimate.

    For compiled code.
    """
    filter_key, last_key, back_key = jax.random.split(key, 3)
    steps: Step = forward(ssm, grid, y, filter_key, settings, lambda step: step)
    last = _choose(last_key, jnp.broadcast_to(steps.log_weights[-1], (draws, settings.particles)))
    rows = as_arrays(grid.intervals)
    before = jax.tree_util.tree_map(lambda a: a[:-1], (steps.state, steps.log_weights, steps.ancestors))
    after = Intervals(*(a[1:] for a in rows))
    keys = jax.random.split(back_key, rows.start.shape[0])[1:]

    def back(carry: tuple[jax.Array, jax.Array], inputs: tuple) -> tuple[tuple, tuple]:
        (state, log_weights, ancestors), row, row_key = inputs
        later, index = carry
        traced = ancestors[index]
        if method == BACKWARD:
            drawn = lambda: _drawn_back(ssm, settings, grid, row, state, log_weights, later, row_key)  # noqa: E731
            index = jax.lax.cond(row.length > 0, drawn, lambda: traced)
        else:
            index = traced
        found = state[:, index].T
        return (found, index), (found, index)

    first = (steps.state[-1][:, last].T, last)
    _, (states, indices) = jax.lax.scan(back, first, (before, after, keys), reverse=True)
    states = jnp.concatenate([states, first[0][None]])
    indices = jnp.concatenate([indices, last[None]])
    requested = jnp.asarray(grid.requested)
    return states[requested], indices[requested], steps.log_likelihood.sum()


def _drawn_back(ssm: StateSpaceModel, settings: ParticleSettings, grid: TimeGrid, row: Intervals, state: jax.Array,
                log_weights: jax.Array, later: jax.Array, key: jax.Array) -> jax.Array:
    """Draw, for each later state (S, n), the particle that it comes from."""
    mean, chol = _transition(ssm, settings.scheme, row, grid.steps, state)

    def one(pair: tuple[jax.Array, jax.Array]) -> jax.Array:
        following, uniform = pair
        density = jax.vmap(lambda m, c: log_density(solve_lower(c, following - m), c),
                           in_axes=(-1, -1 if chol.ndim == 3 else None))(mean, chol)
        return _choose_at(uniform, log_weights + jnp.where(jnp.isnan(density), -jnp.inf, density))

    size = max(1, min(later.shape[0], _BLOCK // state.shape[1]))
    return jax.lax.map(one, (later, jax.random.uniform(key, later.shape[:1])), batch_size=size)


def _transition(ssm: StateSpaceModel, scheme: str, row: Intervals, steps: int,
                state: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the means (n, N) of the next state, and the factor of its covariance, (n, n) or (n, n, N)."""
    if scheme == "exact":
        whole = exact(ssm, row.length, steps)
        offset = exact_offset(ssm, whole, steps, row.span, row.length)
        return matmul(whole.phi, state) + offset[:, None], cholesky(whole.process_cov).chol
    size = ssm.physical_dim
    forces, noise = ssm.stack.discretise(row.length)

    def one(s: jax.Array) -> tuple[jax.Array, jax.Array]:
        t = row.span.time()
        w = ssm.inputs(s, t)
        moved = s[:size] + row.length * ssm.drift(w, t)
        dispersion = ssm.dispersion(w, t)
        own = jnp.zeros((0, 0)) if dispersion is None else row.length * matmul(dispersion, dispersion.T)
        covariance = jax.scipy.linalg.block_diag(own, noise)
        return jnp.concatenate([moved, matmul(forces, s[size:, None])[:, 0]]), cholesky(covariance).chol

    if callable(ssm.model.process_noise):
        return jax.vmap(one, in_axes=-1, out_axes=(-1, -1))(state)
    return jax.vmap(one, in_axes=-1, out_axes=(-1, None))(state)


def _choose(key: jax.Array, log_weights: jax.Array) -> jax.Array:
    """Draw an index (S,) for each row of weights (S, N)."""
    return jax.vmap(_choose_at)(jax.random.uniform(key, log_weights.shape[:1]), log_weights)


def _choose_at(uniform: jax.Array, log_weights: jax.Array) -> jax.Array:
    """Return the ``uniform`` quantile of the weights (N,)."""
    cumulative = jnp.cumsum(jnp.exp(log_weights - log_weights.max()))
    found = jnp.searchsorted(cumulative, uniform * cumulative[-1], side="right")
    return jnp.minimum(found, log_weights.shape[0] - 1).astype(int)
