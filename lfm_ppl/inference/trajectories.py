"""Predictive densities, residuals and trajectories under posterior draws of the parameters.

1. `scores` smooths the data under each draw: leave-one-out and one-step-ahead terms, residuals, and replicated data
   along a path.
2. `trajectories` draws one path of state and forces under each draw: from the smoother up to the last observation, and
   by simulation of the non-linear model after it; or from particle filters.
3. Along the path it draws new observations, and it stores the normal distribution of each output where there is one,
   which gives sharper predictive densities than the path.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.grid_layout import GridLayout, padded_size
from lfm_ppl.filtering.smoother import SmootherResult
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.draw_batches import BatchStore, DrawFunction, map_draws
from lfm_ppl.inference.path_plan import PathPlan, first_simulated_times, has_forecast, plan_paths
from lfm_ppl.inference.problem import Partition, Problem, signature
from lfm_ppl.likelihoods.series_likelihood import SeriesLikelihood
from lfm_ppl.model.observation_noise import expected_observation, noisy_observation, replicate, with_noise
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.simulate import input_breakpoints
from lfm_ppl.model.simulated_path import LONGEST_PRODUCT, simulate_missing_states
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.model.stiff_simulation import warn_of_infinite_states
from lfm_ppl.particles.particle_filter import ParticleSettings
from lfm_ppl.particles.particle_smoother import TRACING, draw_trajectories
from lfm_ppl.utils import checks
from lfm_ppl.utils.progress import Reporter
from lfm_ppl.utils.random_keys import split_by_name
from lfm_ppl.utils.semidefinite import semidefinite_root

_FILTERS = 4
"""Number of particle filters from which the path of one draw is chosen."""

_POINTS = 8
"""Points of the distribution of state and forces, for the bands of non-linear functions of them."""

_PRODUCT = "largest product of step and rate"
"""Name of this number among the results of simulated paths."""

LOG_PRIOR = "log prior of "
"""Start of the names of the log prior densities among the scores."""


def scores(key: jax.Array, bound: BoundModel, draws: Mapping[str, Any], particles: ParticleSettings | None = None,
           particle_steps: int | None = None, *,
           report: Reporter | None = None, store: BatchStore | None = None) -> Any:
    """Score the observations under each draw, and replicate the data along a path given the data.

    Args:
        key: a JAX random key, for the path, the noise, and further parameters such as regimes.
        bound: the model and its data.
        draws: site name -> (S, ...).
        particles: settings of the particle smoother that draws the path; None: the Gaussian smoother.
        particle_steps: integration steps of the particles between two observations; None: the model's.
        report: as in `map_draws`.
        store: as in `map_draws`.

    Returns:
        ``leave_one_out`` (S, ..., T, D), log p of each entry given all others, zero where the entry is
        missing; ``one_step_ahead`` (S, ..., T); ``residual`` and ``replicate`` (S, ..., T, D); the series of a panel
        come after the draws. Under constraints ``one_step_ahead`` and ``residual`` ignore the constraints. The log
        prior density (S,) of each site has the name of the site after `LOG_PRIOR`.
    """

    def per_draw(values: Any, key: jax.Array, y: Any) -> dict[str, jax.Array]:
        trace = bound.trace_at(values, y)
        log_priors = {LOG_PRIOR + name: value for name, value in bound.site_log_priors(trace).items()}
        distribution, y = bound.site_of(trace).distribution, bound.data(y)
        return distribution.mapped(of_series, y, distribution.split_key(key)) | log_priors

    def of_series(series: SeriesLikelihood, y: jax.Array, key: jax.Array) -> dict[str, jax.Array]:
        if particles is None:
            return series.scores(key, y)
        keys = split_by_name(key, ("scores", "path", "noise"))
        w, times = _particle_path(series, y, None, keys["path"], particles, particle_steps or series.settings.steps, 1)
        return series.scores(keys["scores"], y) | {"replicate": replicate(series.ssm, keys["noise"], w, times)}

    rows = bound.times.size * (1 if particles is None else particles.particles)
    problem = bound.problem if particles is None else bound.constants  # a particle filter needs the values of the times
    return map_draws(bound, DrawFunction(("scores", particles, particle_steps), per_draw, (problem,)), draws, key,
                     rows=rows, report=report, store=store)


def trajectories(key: jax.Array, bound: BoundModel, draws: Mapping[str, Any], requested_times: Any,
                 particles: ParticleSettings | None = None, particle_steps: int | None = None, *,
                 report: Reporter | None = None, store: BatchStore | None = None) -> Any:
    """Draw one trajectory for each draw of the parameters, given the data, and new observations along it.

    Up to the last observation the path is a draw of the smoother. After it, non-linear dynamics are simulated: see
    `lfm_ppl.forecast` for the reason. Where a step of that is too long, the paths are simulated once more with
    exponential steps.

    Args:
        key: a JAX random key.
        bound: the model and its data.
        draws: site name -> (S, ...).
        requested_times: (K,) times of the trajectories, or (B, K) for each series of a panel; None: the observation
            times.
        particles: settings of the particle smoother; None: the Gaussian smoother.
        particle_steps: integration steps of the particles between two observations; None: the model's.
        report: as in `map_draws`.
        store: as in `map_draws`.

    Returns:
        ``state`` (S, ..., K, M), ``force`` (S, ..., K, R), ``deterministic`` (S, ..., K, Q), ``output`` (S, ..., K, D)
        without noise (the expectation of a family); ``prediction`` (S, ..., K, D), new observations at the times of
        the trajectories. For Gaussian
        observations ``predictive_mean`` and ``predictive_sd`` (S, ..., K, D), the normal distribution of each given the
        parameters (where the observation is linear, up to the last one) or given the path, so that the mixture over the
        draws is the predictive density, and ``output_sd`` (S, ..., K, D), the sd without the noise. ``prediction`` and
        ``predictive_sd`` are left out where the covariance of the noise belongs to the rows of the data. From the
        Gaussian smoother ``state_mean``, ``state_sd``, ``force_mean`` and ``force_sd``, the normal distribution that
        the path is drawn from, with the path itself and zero where it is simulated; ``deterministic_points``,
        ``output_points`` and ``noise_sd_points`` (S, ..., P, K, size), where these functions are not linear, at points
        of that distribution; and ``log_likelihood`` (S, ...).
    """
    requested_times = None if requested_times is None else np.asarray(requested_times, float)
    if requested_times is not None and np.array_equal(requested_times, bound.times):
        requested_times = None
    is_stiff = bound.site.example.is_stiff
    settings = particles, particle_steps
    paths = _paths(key, bound, draws, requested_times, settings, is_stiff, report=report, store=store)
    if _PRODUCT not in paths:
        return paths
    if not is_stiff and np.max(paths[_PRODUCT], initial=0.0) > LONGEST_PRODUCT:
        # The store holds batches of paths with explicit steps.
        paths = _paths(key, bound, draws, requested_times, settings, True, report=report, store=None)
    del paths[_PRODUCT]
    warn_of_infinite_states(paths["state"], bound.times if requested_times is None else requested_times,
                            bound.site.example.ssm.model.state_names)
    return paths


def _paths(key: jax.Array, bound: BoundModel, draws: Mapping[str, Any], requested_times: np.ndarray | None,
           settings: tuple[ParticleSettings | None, int | None], is_stiff: bool, **options: Any) -> dict[str, Any]:
    """Return the results of `trajectories`, and of simulated paths the largest product of a step and the fastest rate.

    Args:
        key: a JAX random key.
        bound: the model and its data.
        draws: as in `trajectories`.
        requested_times: ``at`` of `trajectories`.
        settings: ``particles`` and ``particle_steps`` of `trajectories`.
        is_stiff: whether simulated steps that are longer than the fastest time constant are exponential.
        **options: ``report`` and ``store`` of `map_draws`.
    """
    particles, particle_steps = settings
    example = bound.site.example
    # In compiled code the noise may be traced, so that rows cannot be compared.
    has_row_noise = has_noise_of_rows(bound)
    is_forecast = None
    if particles is None and example.has_gaussian_state and not example.ssm.plan.has_normal_states:
        is_forecast = has_forecast(bound, requested_times)
    is_shared = particles is None and bound.problem.has_traced_inputs
    count = None if requested_times is None else requested_times.shape[-1]
    if requested_times is not None and is_shared and not is_forecast:
        # Repetitions of the last time, so that similar times share a program; their results are removed below.
        extra = padded_size(requested_times.size) - requested_times.size
        requested_times = np.append(requested_times, np.repeat(requested_times[-1], extra))
    plan = plan_paths(bound, requested_times, particles is not None or is_forecast is not None,
                 first_simulated_times(bound) if is_forecast else np.full(bound.times.shape[:-1], -np.inf))

    def draw_series(distribution: SeriesLikelihood, y: jax.Array, key: jax.Array, path_times: Any = plan.times,
                    layout: GridLayout | None = None) -> dict[str, jax.Array]:
        ssm = distribution.ssm
        keys = split_by_name(key, ("path", "replicate", "forecast", "points", "prediction"))
        noise_key = keys["replicate" if requested_times is None else "prediction"]
        results: dict[str, jax.Array] = {}
        if particles is None and not distribution.has_gaussian_state:
            smoothed = None
            w, when = distribution.sample_path(keys["path"], y, path_times)
        elif particles is None:
            reached = layout or path_times
            if layout is None and is_forecast and path_times is not None:
                minimum = jnp.minimum if plan.is_of_series else np.minimum
                reached = minimum(path_times, distribution.times[-1] if plan.is_of_series else bound.times.max())
            smoothed = distribution.smooth(y, reached, plan.smoother_steps)
            when = smoothed.times if path_times is None else jnp.asarray(path_times, float)
            states = smoothed.sample_joint(keys["path"], 1)[0]
            is_smoothed = jnp.ones((len(when), 1), bool)
            if is_forecast:
                is_smoothed = (when <= _last_observed(y, when, plan))[:, None]
                states, product = _simulate_forecast(distribution, states, when, is_smoothed[:, 0], plan,
                                                     keys["forecast"], is_stiff)
                results[_PRODUCT] = product
            w = jax.vmap(ssm.inputs)(states, when)
            results |= _moments(ssm, smoothed, w, is_smoothed, plan)
            gaussian = not (isinstance(ssm.model.observation, ObservationFamily) or has_row_noise)
            results |= _points(ssm, smoothed, w, when, is_smoothed, plan, keys["points"], gaussian)
            results |= {"log_likelihood": smoothed.log_likelihood.sum()}
        else:
            smoothed = None
            w, when = _particle_path(distribution, y, path_times, keys["path"], particles,
                                     particle_steps or plan.smoother_steps or distribution.settings.steps)
        requested = plan.requested
        results["deterministic"] = jax.vmap(ssm.deterministics)(w[requested], when[requested])
        if isinstance(ssm.model.observation, ObservationFamily):
            results |= _of_family(ssm, noise_key, w, when, plan)
            if requested_times is not None and has_row_noise:
                del results["prediction"]
            return results
        output = jax.vmap(ssm.observe)(w, when)
        size = ssm.physical_dim
        results |= {"state": w[requested, :size], "force": w[requested, size:], "output": output[requested]}
        mean = output[requested]
        variance = jnp.zeros_like(mean)
        if smoothed is not None and ssm.plan.has_normal_outputs:
            # The normal distribution of y given the parameters, much sharper than given a path.
            matrix = jax.vmap(jax.jacfwd(ssm.observe))(smoothed.input_mean[requested], when[requested])
            spread = jnp.einsum("kdi,kij,kdj->kd", matrix, smoothed.input_covariance[requested], matrix)
            normal_mean = jax.vmap(ssm.observe)(smoothed.input_mean[requested], when[requested])
            mean = jnp.where(is_smoothed[requested], normal_mean, mean)
            variance = jnp.where(is_smoothed[requested], jnp.maximum(spread, 0.0), 0.0)
        results |= {"predictive_mean": mean, "output_sd": jnp.sqrt(variance)}
        if requested_times is not None and has_row_noise:
            return results
        rows = jnp.arange(len(requested)) if requested_times is None else jnp.zeros(len(requested), int)
        covariance = jax.vmap(ssm.obs_cov)(w[requested], when[requested], rows)
        prediction = with_noise(noise_key, output[requested], covariance)
        noise = jnp.diagonal(covariance, axis1=1, axis2=2)
        return results | {"prediction": prediction, "predictive_sd": jnp.sqrt(variance + noise)}

    def per_draw(values: Any, key: jax.Array, problem: Problem) -> dict[str, jax.Array]:
        distribution = bound.likelihood(values, problem)
        y = bound.data(problem)
        keys = distribution.split_key(key)
        return distribution.mapped(draw_series, y, keys, *([plan.times] if plan.is_of_series else []))

    def shared_per_draw(values: Any, key: jax.Array, problem: Problem, times: Any,
                        reached: Partition) -> dict[str, jax.Array]:
        distribution = bound.likelihood(values, problem)
        assert isinstance(distribution, SeriesLikelihood)
        return draw_series(distribution, bound.data(problem), key, times, reached.value)

    name: tuple = ("trajectories", particles, particle_steps, is_forecast, is_stiff, has_row_noise)
    if is_shared:
        # Where the path is simulated the smoother stays at the last row of the data, at no cost.
        reached = plan.times if plan.times is None or not is_forecast else np.minimum(plan.times, bound.times.max())
        name = (*name, len(plan.requested), plan.rows, requested_times is None, plan.steps if is_forecast else None)
        arguments = bound.problem, plan.times, bound.requested(reached)
        paths = map_draws(bound, DrawFunction(name, shared_per_draw, arguments), draws, key, rows=plan.rows, **options)
        return {name: value if name in ("log_likelihood", _PRODUCT) else value[..., :count, :]
                for name, value in paths.items()}
    rows = plan.rows * (1 if particles is None else particles.particles)
    name = *name, signature(requested_times), signature(vars(plan))
    return map_draws(bound, DrawFunction(name, per_draw, (bound.constants,)), draws, key, rows=rows, **options)


def _of_family(ssm: StateSpaceModel, key: jax.Array, w: jax.Array, when: jax.Array,
               plan: PathPlan) -> dict[str, jax.Array]:
    """Return outputs and new observations along one path (L, M + R), for an observation family."""
    size, requested = ssm.physical_dim, plan.requested
    output = jax.vmap(lambda w, t: expected_observation(ssm, w, t))(w[requested], when[requested])
    if plan.times is None:
        prediction = replicate(ssm, key, w, when)
    else:
        prediction = jax.vmap(lambda w, t, key: noisy_observation(ssm, w, t, key, None))(
            w[requested], when[requested], jax.random.split(key, len(requested)))
    return {"state": w[requested, :size], "force": w[requested, size:], "output": output, "prediction": prediction}


def _last_observed(y: jax.Array, when: jax.Array, plan: PathPlan) -> jax.Array:
    """Return the time of the last observation, minus infinity without any, where the whole path is simulated."""
    return jnp.max(jnp.where(jnp.isfinite(y).any(axis=-1), when[plan.data], -jnp.inf))


def _simulate_forecast(distribution: SeriesLikelihood, states: jax.Array, when: jax.Array, is_smoothed: jax.Array,
                       plan: PathPlan, key: jax.Array, is_stiff: bool) -> tuple[jax.Array, jax.Array]:
    """Return the joint states (L, n), simulated after the last smoothed one; see `simulate_missing_states`.

    ``is_smoothed`` is (L,).
    """
    order = jnp.arange(plan.rows) if plan.times is None else jnp.argsort(when, stable=True)
    # Breakpoints before the first time or after the last one change nothing.
    layout = distribution.layout
    breakpoints = (input_breakpoints(distribution.model, None, None) if layout is None
                   else layout.breakpoints(distribution.model.input_reads(0.0, 1.0)))
    path, product = simulate_missing_states(distribution.ssm, key, states[order], when[order], is_smoothed[order],
                                            plan.steps, breakpoints, is_stiff)
    return jnp.zeros_like(states).at[order].set(path), product


def _moments(ssm: StateSpaceModel, smoothed: SmootherResult, w: jax.Array, is_smoothed: jax.Array,
             plan: PathPlan) -> dict[str, jax.Array]:
    """Return mean and sd of state and forces at the requested times: of a path (L, M + R) where it is simulated."""
    size, requested = ssm.physical_dim, plan.requested
    mean = jnp.where(is_smoothed, smoothed.input_mean, w)[requested]
    variance = jnp.diagonal(smoothed.input_covariance, axis1=1, axis2=2)
    sd = jnp.where(is_smoothed, jnp.sqrt(jnp.maximum(variance, 0.0)), 0.0)[requested]
    return {"state_mean": mean[:, :size], "state_sd": sd[:, :size],
            "force_mean": mean[:, size:], "force_sd": sd[:, size:]}


def _points(ssm: StateSpaceModel, smoothed: SmootherResult, w: jax.Array, when: jax.Array, is_smoothed: jax.Array,
            plan: PathPlan, key: jax.Array, with_noise: bool) -> dict[str, jax.Array]:
    """Return non-linear functions of state and forces, (P, K, ...), at points of their normal distribution.

    A point has the same coordinates, in units of the distribution, at all times, so that it moves smoothly. Where a
    path is simulated, all points are on the path. ``with_noise`` adds the standard deviations of Gaussian noise.
    """
    nonlinear = isinstance(ssm.model.observation, ObservationFamily) or not ssm.plan.has_normal_outputs
    if not (nonlinear or ssm.model.deterministic_names):
        return {}
    requested = plan.requested
    root = jax.vmap(semidefinite_root)(smoothed.input_covariance[requested])
    z = jax.random.normal(key, (_POINTS, w.shape[1]), w.dtype)
    points = smoothed.input_mean[requested] + jnp.einsum("kij,pj->pki", root, z)
    points, times = jnp.where(is_smoothed[requested], points, w[requested]), when[requested]
    values = {"deterministic_points": jax.vmap(lambda w: jax.vmap(ssm.deterministics)(w, times))(points)}
    if nonlinear:
        expected = jax.vmap(lambda w, t: expected_observation(ssm, w, t))
        values["output_points"] = jax.vmap(lambda w: expected(w, times))(points)
    if nonlinear and with_noise:
        noise = jax.vmap(lambda w, t: jnp.diagonal(ssm.obs_cov(w, t, 0)))
        values["noise_sd_points"] = jnp.sqrt(jax.vmap(lambda w: noise(w, times))(points))
    return values


def evenly_spaced(chains: int, samples: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return indices of about ``count`` evenly spaced draws, in each chain (S,) and in the joined chains (C * S,).

    Example:
        >>> evenly_spaced(2, 100, 4)[1].tolist()
        [0, 99, 100, 199]
    """
    per_chain = min(samples, -(-count // chains))
    index = np.unique(np.linspace(0, samples - 1, per_chain).round().astype(int))
    return index, (np.arange(chains)[:, None] * samples + index).ravel()


def noise_of_rows(distribution: SeriesLikelihood) -> bool:
    """Return whether the noise differs between the rows of the data, so that other rows have none."""
    observation = distribution.ssm.model.observation
    if isinstance(observation, ObservationFamily):
        return observation.has_row_parameters()
    if observation.varies_with_state or np.ndim(observation.covariance) != 3:
        return False
    covariance = checks.concrete(observation.covariance)
    return covariance is None or bool((covariance != covariance[:1]).any())


def has_noise_of_rows(bound: BoundModel) -> bool:
    """Return whether the noise differs between the rows of the data, of any series."""
    example = bound.site.example
    is_of_series = not example.ssm.model.observation.varies_with_state and np.ndim(
        example.ssm.model.observation.covariance) == 3
    if not is_of_series:
        return noise_of_rows(example)
    # Rows that are equal at one point of the parameters may differ at another.
    _, another = bound.probes()
    return any(map(noise_of_rows, [*bound.site.members, *bound.likelihood(another).members]))


def _particle_path(distribution: SeriesLikelihood, y: jax.Array, requested_times: Any, key: jax.Array,
                   particles: ParticleSettings, steps: int, filters: int = _FILTERS) -> tuple[jax.Array, jax.Array]:
    """Return a path (L, M + R) of one of several particle filters, by ancestor tracing, and its times (L,).

    The path of a single filter has the smoothing distribution only for many particles. If the filter is chosen in
    proportion to its estimate of the likelihood, the error also decreases with the number of filters.
    """
    ssm, times = distribution.ssm, distribution.times
    grid = build_time_grid(ssm, times, steps, distribution.settings.max_step, requested_times)
    keys = split_by_name(key, ("filters", "choice"))
    states, _, total = jax.lax.map(lambda k: draw_trajectories(ssm, grid, y, k, particles, 1, TRACING),
                                   jax.random.split(keys["filters"], filters))
    best = jax.random.categorical(keys["choice"], jnp.where(jnp.isneginf(total).all(), 0.0, total))
    when = jnp.asarray(grid.requested_times, float)
    return jax.vmap(ssm.inputs)(states[best][:, 0], when), when
