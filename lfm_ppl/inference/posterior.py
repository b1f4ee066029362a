"""What follows from draws of the parameters: predictive densities, residuals and trajectories."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.fingerprint import signature
from lfm_ppl.inference.marginal_likelihood import MarginalLikelihood, Panel
from lfm_ppl.model.observation_noise import expected_observation, noisy_observation
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.particles.particle_filter import ParticleSettings
from lfm_ppl.particles.particle_smoother import TRACING, draw_trajectories

_FILTERS = 4
"""Particle filters from which the path of one draw is chosen."""

_BATCH = 8
"""Draws in a batch of those that go one after another."""

_BATCH_NUMBERS = 2_000_000
"""Numbers that the smoother may hold for one batch of draws; more draws go one batch after another."""


class Parts(Protocol):
    """Keeps batches of what is computed from draws, by their first draw."""

    def get(self, start: int) -> Any:
        """Return a batch; None where it is not known."""

    def put(self, start: int, part: Any) -> None:
        """Keep a batch, a pytree of dicts or an array."""

    def flush(self) -> None:
        """Keep all that was put, now."""


def scores(bound: BoundModel, draws: Mapping[str, Any], *, show: Callable[[int, int], None] = lambda done, count: None,
           parts: Parts | None = None) -> dict[str, np.ndarray]:
    """Score the observations under each draw, site name -> (S, ...); ``show`` and ``parts`` as in `over_draws`.

    Returns:
        ``leave_one_out`` (S, ..., T), ``one_step_ahead`` (S, ..., T), ``residual`` (S, ..., T, D); the series of a
        panel come after the draws.
    """

    def one(distribution: MarginalLikelihood, y: jax.Array) -> dict[str, jax.Array]:
        result = distribution.smooth(y)
        return {"leave_one_out": result.leave_one_out, "one_step_ahead": result.log_likelihood,
                "residual": result.whitened_innovation}

    def per_draw(values: Any, key: jax.Array, y: Any) -> dict[str, jax.Array]:
        return each(bound.likelihood(values, y), one, bound.data(y))

    return over_draws(bound, "scores", per_draw, draws, jax.random.key(0), bound.times.size, show, parts)


def trajectories(key: jax.Array, bound: BoundModel, draws: Mapping[str, Any], at: Any,
                 particles: ParticleSettings | None = None, particle_steps: int | None = None, *,
                 show: Callable[[int, int], None] = lambda done, count: None,
                 parts: Parts | None = None) -> dict[str, np.ndarray]:
    """Draw one trajectory for each draw of the parameters, given the data, and replicate the data along it.

    Args:
        key: a JAX random key.
        bound: the model and its data.
        draws: site name -> (S, ...).
        at: (K,) times of the trajectories, or None for the observation times.
        particles: draw the trajectories with the particle smoother; None: with the Gaussian one.
        particle_steps: integration steps of the particles between two observations; None: the model's.
        show: as in `over_draws`, and so is the next.
        parts: keeps batches.

    Returns:
        ``state`` (S, ..., K, M), ``force`` (S, ..., K, R), ``output`` (S, ..., K, D) free of noise (what is
        expected of a family), and ``y``
        (S, ..., T, D), the posterior predictive at the observation times.
    """
    at = None if at is None else np.asarray(at, float)
    count = 0 if at is None else len(at)

    def one(distribution: MarginalLikelihood, y: jax.Array, key: jax.Array) -> dict[str, jax.Array]:
        ssm = distribution.ssm
        times = jnp.asarray(distribution.times, float)
        both = None if at is None else np.concatenate([at, np.asarray(distribution.times, float)])
        path_key, noise_key = jax.random.split(key)
        if particles is None:
            w, when = _smoothed_path(distribution, y, both, path_key)
        else:
            w, when = _particle_path(distribution, y, both, path_key, particles, particle_steps or distribution.steps)
        output = jax.vmap(lambda w, t: expected_observation(ssm, w, t))(w, when)
        rows = jnp.arange(times.shape[0])
        replicated = jax.vmap(lambda w, t, key, row: noisy_observation(ssm, w, t, key, row))(
            w[count:], times, jax.random.split(noise_key, times.shape[0]), rows)
        stop = count or None
        size = ssm.physical_dim
        return {"state": w[:stop, :size], "force": w[:stop, size:], "output": output[:stop], "y": replicated}

    def per_draw(values: Any, key: jax.Array, y: Any) -> dict[str, jax.Array]:
        distribution = bound.likelihood(values, y)
        y = bound.data(y)
        keys = jax.random.split(key, y.shape[0]) if isinstance(distribution, Panel) else key
        return each(distribution, one, y, keys)

    rows = count + bound.times.size
    width = 1 if particles is None else particles.particles
    name = ("trajectories", signature(at), particles, particle_steps)
    return over_draws(bound, name, per_draw, draws, key, rows * width, show, parts)


def _smoothed_path(distribution: MarginalLikelihood, y: jax.Array, at: Any,
                   key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Draw the inputs (x, u) at times ``at`` (K,) from the Gaussian smoother: (K, M + R), and the times."""
    result = distribution.smooth(y, at)
    path = result.sample(key, 1)
    forces = [path.forces[name][0][:, None] for name in distribution.ssm.model.force_names]
    return jnp.concatenate([path.state[0], *forces], axis=1), result.times


def _particle_path(distribution: MarginalLikelihood, y: jax.Array, at: Any, key: jax.Array,
                   particles: ParticleSettings, steps: int) -> tuple[jax.Array, jax.Array]:
    """The same from particle filters: a path of one of several, by ancestor tracing.

    The path of a single filter is from the right distribution only with many particles. A filter chosen in proportion
    to its estimate of the likelihood gives a path of the right one as the number of filters grows, too.
    """
    ssm, times = distribution.ssm, distribution.times
    grid = build_time_grid(ssm, times, _steps_in_a_row(ssm, times, at, steps), distribution.max_step, at)
    path_keys, choice = jax.random.split(key, _FILTERS + 1)[:-1], jax.random.fold_in(key, _FILTERS)
    states, _, total = jax.lax.map(lambda k: draw_trajectories(ssm, grid, y, k, particles, 1, TRACING), path_keys)
    best = jax.random.categorical(choice, jnp.where(jnp.isneginf(total).all(), 0.0, total))
    when = jnp.asarray(grid.requested_times, float)
    return jax.vmap(ssm.inputs)(states[best][:, 0], when), when


def _steps_in_a_row(ssm: StateSpaceModel, times: Any, at: Any, steps: int) -> int:
    """Return how many steps each row needs so that none is longer than those between two observations."""
    known = checks.concrete(times)
    if at is None or known is None:
        return steps
    rows = build_time_grid(ssm, known, 1, None, at).intervals
    ends = np.asarray(rows.start + rows.length)
    marks = np.unique(np.append(known, rows.start[0]))
    if len(marks) == 1:
        return steps
    gaps = np.diff(marks)
    # A row after the last observation is measured by the usual distance between two.
    index = np.searchsorted(marks, ends - 1e-12 * np.abs(ends), side="left") - 1
    own = np.where(index < len(gaps), gaps[np.clip(index, 0, len(gaps) - 1)], np.median(gaps))
    return max(1, int(np.ceil(steps * min(float((rows.length / own).max()), 1.0) - 1e-9)))


def each(distribution: MarginalLikelihood | Panel, function: Callable, *arguments: Any) -> Any:
    """Return ``function(distribution, *arguments)``; of a panel, for each series, with the series as leading axis."""
    if isinstance(distribution, Panel):
        return distribution.mapped(function, *arguments)
    return function(distribution, *arguments)


def over_draws(bound: BoundModel, name: Hashable, per_draw: Callable, draws: Mapping[str, Any], key: jax.Array,
               rows: int | None = None, show: Callable[[int, int], None] = lambda done, count: None,
               parts: Parts | None = None) -> Any:
    """Return ``per_draw(values, key, y)`` for all draws (S, ...), some at a time, with one compilation for any number.

    Args:
        bound: the model and its data y.
        name: everything that ``per_draw`` depends on besides the model, so that it is compiled once.
        per_draw: maps site values, a random key and the model's ``argument`` to a pytree of arrays.
        draws: site name -> (S, ...).
        key: a JAX random key.
        rows: of the scan over time, from which follows how many draws the memory holds side by side; None: one draw
            after another, as always with steps that follow a tolerance, of which each would make as many as are tried.
        show: is told before each batch how many draws of how many are done.
        parts: keeps the batches, and knows those of an earlier run.
    """
    draws = {site: jnp.asarray(value) for site, value in draws.items()}
    count = next(iter(draws.values())).shape[0]
    example = bound.site.example
    several = rows is not None and (example.tolerance is None or example.ssm.time_invariant)
    numbers = (rows or 1) * example.ssm.state_dim**2 * 6
    batch = int(np.clip(_BATCH_NUMBERS // max(numbers, 1), 1, count)) if several else _BATCH

    def make() -> Callable:
        one_by_one = lambda d, k, y: jax.lax.map(lambda pair: per_draw(*pair, y), (d, k))  # noqa: E731
        return jax.jit(jax.vmap(per_draw, in_axes=(0, 0, None)) if several else one_by_one)

    run, keys = bound.compiled(("over draws", several, name), make), jax.random.split(key, count)
    found = []
    for start in range(0, count, batch):
        show(start, count)
        part = None if parts is None else parts.get(start)
        if part is None:
            index = np.minimum(np.arange(start, start + batch), count - 1)  # full batches: one shape
            part = run({site: value[index] for site, value in draws.items()}, keys[index], bound.argument)
            part = jax.tree_util.tree_map(np.asarray, part)
            if parts is not None:
                parts.put(start, part)
        found.append(part)
    if parts is not None:
        parts.flush()
    return jax.tree_util.tree_map(lambda *parts: np.concatenate(parts)[:count], *found)
