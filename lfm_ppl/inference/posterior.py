"""What follows from draws of the parameters: predictive densities, residuals and trajectories."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Hashable, Mapping
from typing import Any, NamedTuple, Protocol, cast

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.batching import BATCH_SIZE, mapped, on_cpu, side_by_side, threads
from lfm_ppl.filtering.smoother import SmootherResult
from lfm_ppl.filtering.time_grid import LONGEST_FORECAST, build_time_grid
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.marginal_likelihood import SIMULATION_STEPS, MarginalLikelihood, Panel
from lfm_ppl.inference.random_keys import split_keys
from lfm_ppl.inference.traced_model import signature
from lfm_ppl.linalg import semidefinite_root
from lfm_ppl.model.observation_noise import expected_observation, noisy_observation, with_noise
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.simulate import input_breakpoints, simulate_missing_states
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.particles.particle_filter import ParticleSettings
from lfm_ppl.particles.particle_smoother import TRACING, draw_trajectories

_FILTERS = 4
"""Particle filters from which the path of one draw is chosen."""

_BATCH = 8
"""Draws in a batch of those that go one after another."""

_CALLS, _WORTH = 4, 16
"""Batches for each thread, so that all end together, and draws that a batch has at least for that."""

_POINTS = 8
"""Points of the distribution of state and forces, for the bands of functions of them that are not linear."""

_TRIED = 5
"""How many times as many steps a model may take whose steps follow a tolerance."""

_BATCH_NUMBERS, _ACCELERATED = 2_000_000, 25
"""Numbers that the smoother may hold for batches side by side, and how many times as many on an accelerator.

More draws go one batch after another. Trajectories of 512 draws took 76 ms in one batch on a GPU, 300 ms in nine.
"""


class Parts(Protocol):
    """Keeps batches of what is computed from draws, by their first draw."""

    def get(self, start: int) -> Any:
        """Return a batch; None where it is not known."""

    def put(self, start: int, part: Any) -> None:
        """Keep a batch, a pytree of dicts or an array."""

    def flush(self) -> None:
        """Keep all that was put, now."""


def scores(bound: BoundModel, draws: Mapping[str, Any], *,
           show: Callable[[int, int], None] = lambda done, count: None, parts: Parts | None = None) -> Any:
    """Score the observations under each draw, site name -> (S, ...); the rest is as in `over_draws`.

    Returns:
        ``leave_one_out`` (S, ..., T), ``one_step_ahead`` (S, ..., T), ``residual`` (S, ..., T, D); the series of a
        panel come after the draws. Under constraints the last two are those of the filter, which knows none.
    """

    def one(distribution: MarginalLikelihood, y: jax.Array) -> dict[str, jax.Array]:
        result = distribution.smooth(y)
        left_out = distribution.constrained_leave_one_out(y) if distribution.constrained else result.leave_one_out
        return {"leave_one_out": left_out, "one_step_ahead": result.log_likelihood,
                "residual": result.whitened_innovation}

    def per_draw(values: Any, key: jax.Array, y: Any) -> dict[str, jax.Array]:
        return each(bound.likelihood(values, y), one, bound.data(y))

    return over_draws(bound, "scores", per_draw, draws, jax.random.key(0), bound.times.size, show, parts)


def trajectories(key: jax.Array, bound: BoundModel, draws: Mapping[str, Any], at: Any,
                 particles: ParticleSettings | None = None, particle_steps: int | None = None, *,
                 log_likelihood: bool = False,
                 show: Callable[[int, int], None] = lambda done, count: None, parts: Parts | None = None) -> Any:
    """Draw one trajectory for each draw of the parameters, given the data, and new data along it.

    Up to the last observation the path is a draw of the smoother. After it, dynamics that are not linear are simulated
    from there on: see `lfm_ppl.forecast` for why.

    Args:
        key: a JAX random key.
        bound: the model and its data.
        draws: site name -> (S, ...).
        at: (K,) times of the trajectories, or None for the observation times.
        particles: draw the trajectories with the particle smoother; None: with the Gaussian one.
        particle_steps: integration steps of the particles between two observations; None: the model's.
        log_likelihood: whether to return that of the Gaussian filter, (S, ...), unless there are particles.
        show: as in `over_draws`.
        parts: as in `over_draws`.

    Returns:
        ``state`` (S, ..., K, M), ``force`` (S, ..., K, R), ``deterministic`` (S, ..., K, Q), ``output`` (S, ..., K, D)
        free of noise (what is expected of a family); ``y`` (S, ..., T, D), the posterior predictive at the observation
        times; ``prediction`` (S, ..., K, D), new observations at the times of the trajectories. For Gaussian
        observations ``predictive_mean`` and ``predictive_sd`` (S, ..., K, D), the normal distribution of each given the
        parameters (where the observation is linear, up to the last one) or given the path, so that the mixture over the
        draws is the predictive density, and ``output_sd`` (S, ..., K, D), the sd without the noise. ``prediction`` and
        ``predictive_sd`` are left out where the covariance of the noise belongs to the rows of the data. From the
        Gaussian smoother ``state_mean``, ``state_sd``, ``force_mean`` and ``force_sd``, the normal distribution that
        the path is drawn from, with the path itself and zero where it is simulated; ``deterministic_points``,
        ``output_points`` and ``noise_sd_points`` (S, ..., P, K, size), where these functions are not linear, at points
        of that distribution.
    """
    at = None if at is None else np.asarray(at, float)
    if at is not None and bound.times.ndim == 1 and np.array_equal(at, bound.times):
        at = None
    example = bound.site.example
    after = None
    if particles is None and not example.constrained and example.ssm.drift_structure.points:
        after = _after(bound, at)
    plan = _plan(bound, at, particles is not None or after is not None, _first_simulated(bound) if after else -np.inf)

    def one(distribution: MarginalLikelihood, y: jax.Array, key: jax.Array) -> dict[str, jax.Array]:
        ssm = distribution.ssm
        path_key, noise_key = jax.random.split(key)
        found: dict[str, jax.Array] = {}
        if distribution.constrained:
            smoothed = None
            w, when = distribution.feasible_path(path_key, y, plan.times)
        elif particles is None:
            # Where the path is simulated the smoother stays at the last row of the data, which costs nothing.
            reached = plan.times if plan.times is None or not after else np.minimum(plan.times, bound.times.max())
            smoothed = distribution.smooth(y, reached)
            when = smoothed.times if plan.times is None else jnp.asarray(plan.times, float)
            states = smoothed.sample_joint(path_key, 1)[0]
            drawn = jnp.ones((len(when), 1), bool)
            if after:
                drawn = (when <= _last(y, when, plan))[:, None]
                states = _onwards(distribution, states, when, drawn[:, 0], plan, jax.random.fold_in(path_key, 1))
            w = jax.vmap(ssm.inputs)(states, when)
            found = _moments(ssm, smoothed, w, drawn, plan)
            gaussian = not (isinstance(ssm.model.observation, ObservationFamily) or noise_of_rows(distribution))
            found |= _points(ssm, smoothed, w, when, drawn, plan, jax.random.fold_in(path_key, 2), gaussian)
            found |= {"log_likelihood": smoothed.log_likelihood.sum()} if log_likelihood else {}
        else:
            smoothed = None
            w, when = _particle_path(distribution, y, plan.times, path_key, particles,
                                     particle_steps or distribution.steps)
        there, data = plan.there, plan.data
        found["deterministic"] = jax.vmap(ssm.deterministics)(w[there], when[there])
        if isinstance(ssm.model.observation, ObservationFamily):
            found |= _of_family(ssm, noise_key, w, when, plan)
            if at is not None and noise_of_rows(distribution):
                del found["prediction"]
            return found
        output = jax.vmap(ssm.observe)(w, when)
        covariance = jax.vmap(ssm.obs_cov)(w[data], when[data], jnp.arange(len(data)))
        replicated = with_noise(noise_key, output[data], covariance)
        size = ssm.physical_dim
        found |= {"state": w[there, :size], "force": w[there, size:], "output": output[there], "y": replicated}
        mean = output[there]
        variance = jnp.zeros_like(mean)
        if smoothed is not None and _normal_outputs(ssm):
            # The normal distribution of y given the parameters, instead of given a path: sharper by a lot.
            matrix = jax.vmap(jax.jacfwd(ssm.observe))(smoothed.input_mean[there], when[there])
            spread = jnp.einsum("kdi,kij,kdj->kd", matrix, smoothed.input_covariance[there], matrix)
            mean = jnp.where(drawn[there], jax.vmap(ssm.observe)(smoothed.input_mean[there], when[there]), mean)
            variance = jnp.where(drawn[there], jnp.maximum(spread, 0.0), 0.0)
        found |= {"predictive_mean": mean, "output_sd": jnp.sqrt(variance)}
        if at is not None and noise_of_rows(distribution):
            return found
        prediction = replicated
        if at is not None:
            covariance = jax.vmap(ssm.obs_cov)(w[there], when[there], jnp.zeros(len(there), int))
            prediction = with_noise(jax.random.fold_in(noise_key, 1), output[there], covariance)
        noise = jnp.diagonal(covariance, axis1=1, axis2=2)
        return found | {"prediction": prediction, "predictive_sd": jnp.sqrt(variance + noise)}

    def per_draw(values: Any, key: jax.Array, y: Any) -> dict[str, jax.Array]:
        distribution = bound.likelihood(values, y)
        y = bound.data(y)
        keys = jax.random.split(key, y.shape[0]) if isinstance(distribution, Panel) else key
        return each(distribution, one, y, keys)

    rows = plan.rows
    width = 1 if particles is None else particles.particles
    name = ("trajectories", signature(at), particles, particle_steps, after, log_likelihood)
    return over_draws(bound, name, per_draw, draws, key, rows * width, show, parts)


def _of_family(ssm: StateSpaceModel, key: jax.Array, w: jax.Array, when: jax.Array,
               plan: _Plan) -> dict[str, jax.Array]:
    """Return what `trajectories` draws along one path (L, M + R) where the observation is of a family."""
    size, there, data = ssm.physical_dim, plan.there, plan.data
    output = jax.vmap(lambda w, t: expected_observation(ssm, w, t))(w[there], when[there])
    replicated = jax.vmap(lambda w, t, key, row: noisy_observation(ssm, w, t, key, row))(
        w[data], when[data], jax.random.split(key, len(data)), jnp.arange(len(data)))
    prediction = replicated
    if plan.times is not None:
        prediction = jax.vmap(lambda w, t, key: noisy_observation(ssm, w, t, key, None))(
            w[there], when[there], jax.random.split(jax.random.fold_in(key, 1), len(there)))
    return {"state": w[there, :size], "force": w[there, size:], "output": output, "y": replicated,
            "prediction": prediction}


class _Plan(NamedTuple):
    """At which times paths are drawn.

    Attributes:
        times: (L,) the requested ones, those between, and those of the data; None: those of the data.
        there: (K,) rows of the requested times.
        data: (T,) rows of the data.
        steps: of the simulation, in each row.
    """

    times: np.ndarray | None
    there: np.ndarray
    data: np.ndarray
    steps: int

    @property
    def rows(self) -> int:
        """How many there are."""
        return len(self.data) if self.times is None else len(self.times)


def _plan(bound: BoundModel, at: np.ndarray | None, simulated: bool, since: float) -> _Plan:
    """Lay out the rows, of which those after ``since`` are simulated, if any are.

    Those after the data are no longer than the usual distance of the data where something is integrated on the way: a
    simulation, or the known inputs of a linear model.
    """
    example = bound.site.example
    known = bound.times
    gaps = np.diff(known, axis=-1)
    base = example.steps
    if example.max_step is not None:
        base = max(base, int(np.ceil(gaps.max(initial=0.0) / example.max_step * (1 - 1e-12))))
    fine = SIMULATION_STEPS * base * (1 if example.tolerance is None else _TRIED)
    rows = np.arange(known.shape[-1])
    if at is None:
        return _Plan(None, rows, rows, fine)
    beyond = np.array([])
    integrated = simulated or not example.ssm.mean_invariant
    if integrated and at.max() > known[-1] and (gaps > 0).any():
        gap = np.median(gaps[gaps > 0])
        count = min(int(np.ceil((at.max() - known[-1]) / gap * (1 - 1e-12))), LONGEST_FORECAST)
        beyond = np.linspace(known[-1], at.max(), count + 1)[1:-1]
    everywhere = np.concatenate([at, beyond])
    steps = _steps_per_interval(example.ssm, known, everywhere, fine, since) if simulated else fine
    first = len(everywhere)
    return _Plan(np.concatenate([everywhere, known]), np.arange(len(at)), first + rows, steps)


def _after(bound: BoundModel, at: np.ndarray | None) -> bool:
    """Whether a time of the trajectories lies after the last observation of a series."""
    seen = np.isfinite(np.asarray(bound.y)).any(axis=-1)
    return not bool(np.all(seen[..., -1])) or (at is not None and bool(at.max() > bound.times.max()))


def _first_simulated(bound: BoundModel) -> float:
    """Return the time of the last observation of the series that ends first."""
    seen = np.isfinite(np.asarray(bound.y)).any(axis=-1)
    return float(np.where(seen, bound.times, -np.inf).max(axis=-1).min())


def _last(y: jax.Array, when: jax.Array, plan: _Plan) -> jax.Array:
    """Return the time of the last observation; where nothing was observed, everything is simulated."""
    return jnp.max(jnp.where(jnp.isfinite(y).any(axis=-1), when[plan.data], -jnp.inf))


def _onwards(distribution: MarginalLikelihood, states: jax.Array, when: jax.Array, known: jax.Array, plan: _Plan,
             key: jax.Array) -> jax.Array:
    """Return the joint states (L, n) with those that are not ``known`` (L,) simulated from the last one that is."""
    order = np.arange(plan.rows) if plan.times is None else np.argsort(plan.times, kind="stable")
    # Nothing is simulated before the first time, and what lies after the last one changes nothing.
    breakpoints = input_breakpoints(distribution.model, None, None)
    path = simulate_missing_states(distribution.ssm, key, states[order], when[order], known[order], plan.steps,
                                   breakpoints)
    return jnp.zeros_like(states).at[order].set(path)


def _moments(ssm: StateSpaceModel, smoothed: SmootherResult, w: jax.Array, drawn: jax.Array,
             plan: _Plan) -> dict[str, jax.Array]:
    """Return mean and sd of state and forces at the requested times: of a path (L, M + R) where it is simulated."""
    size, there = ssm.physical_dim, plan.there
    mean = jnp.where(drawn, smoothed.input_mean, w)[there]
    variance = jnp.diagonal(smoothed.input_covariance, axis1=1, axis2=2)
    sd = jnp.where(drawn, jnp.sqrt(jnp.maximum(variance, 0.0)), 0.0)[there]
    return {"state_mean": mean[:, :size], "state_sd": sd[:, :size],
            "force_mean": mean[:, size:], "force_sd": sd[:, size:]}


def _points(ssm: StateSpaceModel, smoothed: SmootherResult, w: jax.Array, when: jax.Array, drawn: jax.Array,
            plan: _Plan, key: jax.Array, with_noise: bool) -> dict[str, jax.Array]:
    """Return functions of state and forces that are not linear, (P, K, ...), at points of their normal distribution.

    A point is the same one, in units of the distribution, at all times, so that it moves as smoothly as they do. Where
    a path is simulated, all are the path. ``with_noise`` asks for the sds of a Gaussian observation's noise, too.
    """
    nonlinear = isinstance(ssm.model.observation, ObservationFamily) or not _normal_outputs(ssm)
    if not (nonlinear or ssm.model.deterministic_names):
        return {}
    there = plan.there
    root = jax.vmap(semidefinite_root)(smoothed.input_covariance[there])
    z = jax.random.normal(key, (_POINTS, w.shape[1]), w.dtype)
    points = smoothed.input_mean[there] + jnp.einsum("kij,pj->pki", root, z)
    points, times = jnp.where(drawn[there], points, w[there]), when[there]
    found = {"deterministic_points": jax.vmap(lambda w: jax.vmap(ssm.deterministics)(w, times))(points)}
    if nonlinear:
        expected = jax.vmap(lambda one, t: expected_observation(ssm, one, t))
        found["output_points"] = jax.vmap(lambda w: expected(w, times))(points)
    if nonlinear and with_noise:
        noise = jax.vmap(lambda one, t: jnp.diagonal(ssm.obs_cov(one, t, 0)))
        found["noise_sd_points"] = jnp.sqrt(jax.vmap(lambda w: noise(w, times))(points))
    return found


def evenly_spaced(chains: int, samples: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return which draws of each chain (S,), and of all chains one after another (C * S,), are about ``count`` in all.

    Example:
        >>> evenly_spaced(2, 100, 4)[1].tolist()
        [0, 99, 100, 199]
    """
    per_chain = min(samples, -(-count // chains))
    chosen = np.unique(np.linspace(0, samples - 1, per_chain).round().astype(int))
    return chosen, (np.arange(chains)[:, None] * samples + chosen).ravel()


def noise_of_rows(distribution: MarginalLikelihood) -> bool:
    """Whether the law of the noise is given for each row of the data, so that no other row has one."""
    observation = distribution.ssm.model.observation
    if isinstance(observation, ObservationFamily):
        return observation.has_row_parameters()
    return not observation.varies_with_state and np.ndim(observation.covariance) == 3


def _normal_outputs(ssm: StateSpaceModel) -> bool:
    """Whether y is normal where the state is: a linear observation, with noise that does not depend on the state."""
    observation = ssm.model.observation
    return not (ssm.observation_structure.points or observation.varies_with_state or observation.angular)


def _particle_path(distribution: MarginalLikelihood, y: jax.Array, at: Any, key: jax.Array,
                   particles: ParticleSettings, steps: int) -> tuple[jax.Array, jax.Array]:
    """The same from particle filters: a path of one of several, by ancestor tracing.

    The path of a single filter is from the right distribution only with many particles. A filter chosen in proportion
    to its estimate of the likelihood gives a path of the right one as the number of filters grows, too.
    """
    ssm, times = distribution.ssm, distribution.times
    grid = build_time_grid(ssm, times, steps, distribution.max_step, at)
    path_keys, choice = jax.random.split(key, _FILTERS + 1)[:-1], jax.random.fold_in(key, _FILTERS)
    states, _, total = jax.lax.map(lambda k: draw_trajectories(ssm, grid, y, k, particles, 1, TRACING), path_keys)
    best = jax.random.categorical(choice, jnp.where(jnp.isneginf(total).all(), 0.0, total))
    when = jnp.asarray(grid.requested_times, float)
    return jax.vmap(ssm.inputs)(states[best][:, 0], when), when


def _steps_per_interval(ssm: StateSpaceModel, times: Any, at: Any, steps: int, since: float = -np.inf) -> int:
    """Return how many steps a row after ``since`` needs, so that none is longer than those between two observations."""
    known = checks.concrete(times)
    if at is None or known is None:
        return steps
    grid = build_time_grid(ssm, known, 1, sys.float_info.max, at)
    if checks.traced(grid.since):  # breakpoints of a known input that are read at a lag
        return steps
    rows, origin = grid.intervals, np.asarray(grid.initial_time)
    # Counted from the initial time, so that the origin of time does not matter.
    ends, first = grid.since + rows.length, since - origin
    marks = np.unique(np.append(known - origin, 0.0))
    if len(marks) == 1:
        return steps
    gaps = np.diff(marks)
    # A row after the last observation is measured by the usual distance between two.
    index = np.searchsorted(marks, ends - 1e-12 * np.abs(ends), side="left") - 1
    own = np.where(index < len(gaps), gaps[np.clip(index, 0, len(gaps) - 1)], np.median(gaps))
    share = (rows.length / own)[ends > first].max(initial=0.0)
    return max(1, int(np.ceil(steps * min(float(share), 1.0) - 1e-9)))


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
        rows: of the scan over time, from which follows how many draws go into one call of the program; None: one draw
            after another, as always with steps that follow a tolerance, of which each would make as many as are tried.
        show: is told before each batch how many draws of how many are done.
        parts: keeps the batches, and knows those of an earlier run.
    """
    draws = {site: np.asarray(value) for site, value in draws.items()}
    count = next(iter(draws.values())).shape[0]
    example = bound.site.example
    several = rows is not None and (example.tolerance is None or example.ssm.time_invariant)
    numbers = (rows or 1) * example.ssm.state_dim**2 * 6
    most = _BATCH_NUMBERS * (1 if on_cpu() else _ACCELERATED) // max(numbers, 1)
    # What is unknown in size, or a batch by itself, has no other beside it.
    beside = 1 if rows is None else int(np.clip(most, 1, threads()))
    batch = _BATCH
    if several:
        largest = int(np.clip(most // beside, 1, count))
        shared = min(_CALLS * beside, count // _WORTH) if beside > 1 else 1
        batch = -(-count // max(-(-count // largest), shared))  # all of one size
        if batch > BATCH_SIZE:
            batch = -(-batch // BATCH_SIZE) * BATCH_SIZE  # whole fours

    def make() -> Callable:
        one_by_one = lambda d, k, y: jax.lax.map(lambda pair: per_draw(*pair, y), (d, k))  # noqa: E731
        by_fours = lambda d, k, y: mapped(lambda d, k: per_draw(d, k, y), d, k, batch_size=BATCH_SIZE)  # noqa: E731
        return jax.jit(by_fours if several else one_by_one)

    run, keys = bound.compiled(("over draws", several, name), make), split_keys(key, count)

    def some(start: int) -> tuple[dict[str, np.ndarray], jax.Array, Any]:
        index = np.minimum(np.arange(start, start + batch), count - 1)  # full batches: one shape
        return {site: value[index] for site, value in draws.items()}, keys(index), bound.argument

    starts = range(0, count, batch)
    kept = {start: None if parts is None else parts.get(start) for start in starts}
    # Those that were kept by batches of another length are of no use.
    known = {start: part for start, part in kept.items()
             if part is not None and len(jax.tree_util.tree_leaves(part)[0]) == batch}
    arguments = [some(start) for start in starts if start not in known]
    if len(arguments) > 1 and beside > 1:
        run = cast(Any, run).lower(*arguments[0]).compile()
    computed = side_by_side(lambda *own: jax.tree_util.tree_map(np.asarray, run(*own)), arguments, beside)
    with contextlib.closing(computed) as new:
        for start in starts:
            show(start, count)
            if start not in known:
                known[start] = next(new)
                if parts is not None:
                    parts.put(start, known[start])
    if parts is not None:
        parts.flush()
    return jax.tree_util.tree_map(lambda *parts: np.concatenate(parts)[:count],
                                  *(known[start] for start in starts))
