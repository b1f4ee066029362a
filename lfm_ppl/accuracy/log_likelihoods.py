"""Log likelihoods at posterior draws: of the Gaussian filter, and of references.

1. The Gaussian filter, with its own steps, with half of them, and as stored in a result.
2. A Fokker-Planck grid for models of one state; one grid serves all draws.
3. A particle filter; a pilot run chooses the number of particles. Where that number takes long, fewer come first, and
   more only until the verdict is settled. Linear models with an observation family use importance sampling by draws of
   the smoother instead.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.ep import importance
from lfm_ppl.filtering.ep.settings import as_settings
from lfm_ppl.filtering.problem import filter_problem
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.fokker_planck_grid import fokker_planck
from lfm_ppl.inference.draw_batches import DrawFunction, map_draws
from lfm_ppl.inference.model_draws import ModelDraws
from lfm_ppl.likelihoods.series_likelihood import SeriesLikelihood
from lfm_ppl.model.observation_noise import check_noise
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.particles import particle_filter
from lfm_ppl.particles.particle_filter import ParticleSettings
from lfm_ppl.utils.progress import Console, duration

_PILOT = 8
"""Draws that the pilot run takes."""

GRID_ERROR = 1e-2
"""Tolerated discretisation error of a log likelihood: most of it is common to all draws, and cancels."""

_SCOUTS = 10
"""Number of draws whose models determine the grid: extremes of each parameter, and draws between."""


@dataclass(frozen=True)
class Reference:
    """Log likelihoods of a reference.

    Attributes:
        estimates: (S, B, R) log likelihoods of each series, R replicates of an unbiased estimate; (S, 1, 1) where they
            are exact, summed over the series.
        description: of the method, in words.
        particles: in each replicate; zero where there are none.
        limited: whether more particles were wanted than the limit on work allows.
    """

    estimates: np.ndarray
    description: str
    particles: int = 0
    limited: bool = False


@dataclass(frozen=True)
class ReferenceSettings:
    """Settings of a reference likelihood.

    Attributes:
        kind: "grid", "particles" or "none".
        particles: number of particles; None: chosen by a pilot run.
        replicates: number of replicates of the particle filter.
        steps: integration steps between two times; None: the steps of the Gaussian filter.
        seed: seed of the particle filter.
        show_progress: whether the progress is shown.
    """

    kind: str
    particles: int | None
    replicates: int
    steps: int | None = None
    seed: int = 0
    show_progress: bool = False


def gaussian(problem: ModelDraws, name: str = "log likelihoods", **settings: Any) -> np.ndarray:
    """Return log likelihoods (S,) of the Gaussian filter, with other settings, summed over the series of a panel."""
    bound = problem.bound.approximate(**settings) if settings else problem.bound

    def per_draw(values: Any, key: jax.Array, y: jax.Array) -> dict[str, jax.Array]:
        return {"total": bound.likelihood(values, y).log_prob(bound.data(y)).sum()}

    return map_draws(bound, DrawFunction("log likelihoods", per_draw), problem.draws, jax.random.key(0),
                     rows=bound.times.size, store=problem.batch_store(name))["total"]


def recorded(problem: ModelDraws, log_likelihoods: np.ndarray) -> np.ndarray:
    """Return (S,): the log likelihoods that a result stores, sums of one-step-ahead terms.

    For Gaussian observations the sum is the log likelihood; for an observation family assumed density filtering.
    """
    bound = problem.bound
    if not isinstance(problem.example.ssm.model.observation, ObservationFamily):
        return log_likelihoods

    def per_draw(values: Any, key: jax.Array, y: jax.Array) -> jax.Array:
        return bound.likelihood(values, y).log_prob_per_observation(bound.data(y)).sum()

    return map_draws(bound, DrawFunction("one step ahead", per_draw), problem.draws, jax.random.key(0),
                     rows=bound.times.size, store=problem.batch_store("one-step-ahead terms"))


def finer_tolerance(tolerance: float) -> float:
    """Return the tolerance at which steps are half as long: their errors grow with the fourth power of the length."""
    return tolerance / 16


def finer_steps(example: SeriesLikelihood) -> dict[str, Any]:
    """Return the settings of a likelihood with about twice as many integration steps."""
    settings: dict[str, Any] = {"steps": 2 * example.settings.integration_steps}
    if example.settings.max_step is not None:
        settings["max_step"] = example.settings.max_step / 2
    if example.settings.tolerance is not None:
        settings["tolerance"] = finer_tolerance(example.settings.tolerance)
    return settings


def on_grid(problem: ModelDraws, settings: ReferenceSettings) -> Reference:
    """Return the log likelihoods by the Fokker-Planck equation on one grid for all draws.

    Raises:
        ValueError: what the grid raises, for states of more than one dimension, no noise, and so on.
    """
    layout = fokker_planck.choose_grid(_scout_models(problem), problem.example.times, problem.y, tolerance=GRID_ERROR)
    bound, steps = problem.bound, settings.steps

    def series_log_likelihood(distribution: SeriesLikelihood, y: jax.Array) -> jax.Array:
        time_grid = build_time_grid(distribution.ssm, distribution.times, steps or distribution.settings.steps,
                                    distribution.settings.max_step)
        return fokker_planck.log_likelihood(distribution.ssm, time_grid, y, layout)

    def per_draw(values: Any, key: jax.Array, y: jax.Array) -> jax.Array:
        return bound.likelihood(values, y).mapped(series_log_likelihood, bound.data(y)).sum()

    log_likelihoods = _map_sequentially(problem, jax.random.key(0), ("Fokker-Planck grid", layout, steps), per_draw,
                                        settings.show_progress)
    return Reference(log_likelihoods[:, None, None], f"Fokker-Planck equation on a grid of {layout.cells} cells")


def takes_smoother_draws(ssm: StateSpaceModel) -> bool:
    """Whether draws of the smoother, weighted, estimate the likelihood: linear, with an observation family."""
    return isinstance(ssm.model.observation, ObservationFamily) and ssm.plan.is_linear


def by_particles(problem: ModelDraws, settings: ReferenceSettings, noise: Callable[[np.ndarray], float],
                 target: float, most_work: float, is_settled: Callable[[np.ndarray], bool] | None = None) -> Reference:
    """Return replicates of the particle filter's estimates, or of importance sampling where `takes_smoother_draws`.

    Without a number of particles, a pilot run at a few draws determines the number at which the noise of the averaged
    estimate of a draw is below ``target``: the variance is inversely proportional to it. If that takes minutes, a run
    with fewer particles comes first, and others with four times as many until ``is_settled``.

    Args:
        problem: the draws.
        settings: settings of the particle filter.
        noise: maps estimates (S, B, R) to the sd of their averages, summed over the series.
        target: largest sd.
        most_work: limit on the number of particle steps times states, which limits the number of particles.
        is_settled: maps estimates to whether more particles would change nothing; None: they always do.
    """
    example = problem.example
    pilot_key, key = jax.random.split(jax.random.key(settings.seed))
    limited = False
    count, replicates = settings.particles or _FIRST_PARTICLES, settings.replicates
    final_count = count
    if settings.particles is None:
        rows = np.unique(np.linspace(0, problem.size - 1, _PILOT).round().astype(int))
        pilot = problem.select(rows).rename_stores(prefix="pilot ")
        sd = noise(_particle_estimates(pilot, count, settings, pilot_key))
        needed_particles = count * (sd / target) ** 2 * _SAFETY if np.isfinite(sd) else np.inf
        time_grid = build_time_grid(example.ssm, example.times, settings.steps or example.settings.steps,
                                    example.settings.max_step)
        steps_made = np.shape(time_grid.intervals.length)[0] * time_grid.steps
        each_particle = problem.size * replicates * problem.series * steps_made * example.ssm.state_dim
        most = max(count, most_work / each_particle)
        limited = needed_particles > most
        if needed_particles > count and most > count:
            final_count = _rounded(min(needed_particles, most))
        count = max(count, min(final_count, _rounded(_FIRST_WORK / each_particle)))
    while True:
        start_time = time.perf_counter()
        estimates = _particle_estimates(problem, count, settings, key)
        if count >= final_count or (is_settled is not None and is_settled(estimates)):
            break
        more = min(4 * count, final_count)
        if settings.show_progress:
            seconds = more / count * (time.perf_counter() - start_time)
            Console()(f"{count:,} particles leave too much noise; {more:,} take about {duration(seconds)}")
        count = more
    method = (f"importance sampling, {replicates} runs of {count:,} draws of the smoother" if takes_smoother_draws(
        example.ssm) else f"particle filter, {replicates} runs of {count:,} particles")
    return Reference(estimates, f"{method} a draw", count, limited and count >= final_count)


def _rounded(particles: float) -> int:
    """Return a number of particles, rounded up to 500."""
    return int(np.ceil(particles / 500) * 500)


_FIRST_PARTICLES = 1000

_FIRST_WORK = 2e9
"""Particle steps times states of a first run: a minute on two cores."""

_SAFETY = 1.2
"""Factor on the number of particles of the pilot run, which is an estimate."""


def _particle_estimates(problem: ModelDraws, particles: int, settings: ReferenceSettings,
                        key: jax.Array) -> np.ndarray:
    """Return estimates (S, B, R) of the likelihoods of each series."""
    example, steps = problem.example, settings.steps
    check_noise(example.ssm, example.time_grid.initial_time)
    filter_settings = particle_filter.check_settings(example.ssm, ParticleSettings(particles))

    def series_log_likelihood(distribution: SeriesLikelihood, y: jax.Array, key: jax.Array) -> jax.Array:
        time_grid = build_time_grid(distribution.ssm, distribution.times, steps or distribution.settings.steps,
                                    distribution.settings.max_step)
        if takes_smoother_draws(distribution.ssm):
            filtering = filter_problem(distribution.ssm, distribution.settings.rule, time_grid)
            return importance.log_likelihood(filtering, y, key, particles, as_settings(distribution.settings.factors))
        return particle_filter.log_likelihood(distribution.ssm, time_grid, y, key, filter_settings)

    bound, series = problem.bound, problem.series

    def per_draw(values: Any, key: jax.Array, y: jax.Array) -> jax.Array:
        distribution = bound.likelihood(values, y)
        y = bound.data(y)

        def replicate(key: jax.Array) -> jax.Array:
            keys = distribution.split_key(key)
            return jnp.reshape(distribution.mapped(series_log_likelihood, y, keys), (series,))

        # Replicates of each series are averaged apart: their product over the series is noisier than the product of
        # their averages.
        return jax.lax.map(replicate, jax.random.split(key, settings.replicates)).T

    name = (f"particle filter, {particles:,} particles", filter_settings, settings.replicates, steps)
    return _map_sequentially(problem, key, name, per_draw, settings.show_progress)


def _map_sequentially(problem: ModelDraws, key: jax.Array, name: tuple[str, *tuple[Hashable, ...]],
                      per_draw: Callable, show_progress: bool) -> np.ndarray:
    """Map over draws, one after another, with a display of the progress."""
    return map_draws(problem.bound, DrawFunction(name, per_draw, (problem.bound.constants,)), problem.draws, key,
                     report=Console() if show_progress else None, store=problem.batch_store(name[0]))


def _scout_models(problem: ModelDraws) -> list[Any]:
    """Return latent force models at draws that span the posterior, to lay out one grid for all."""
    flat = np.column_stack([np.reshape(value, (problem.size, -1)) for value in problem.draws.values()])
    extreme = np.concatenate([flat.argmin(axis=0), flat.argmax(axis=0)])
    even = np.linspace(0, problem.size - 1, min(_SCOUTS, problem.size)).round().astype(int)
    rows = list(dict.fromkeys([*extreme, *even]))[: max(_SCOUTS, len(extreme))]
    models = []
    for row in rows:
        parameters = {name: jnp.asarray(value[row]) for name, value in problem.draws.items()}
        site = problem.bound.site._replace(distribution=problem.bound.likelihood(parameters))
        models += [member.model for member in site.members]
    return models
