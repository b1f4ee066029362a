"""Log likelihoods at draws of the parameters: of the Gaussian filter, and of what it is measured against."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.ep import importance
from lfm_ppl.filtering.ep.settings import as_settings
from lfm_ppl.filtering.problem import filter_problem, is_linear, is_observation_nonlinear
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.fokker_planck_grid import fokker_planck
from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.map_draws import BatchStore, map_draws, map_series
from lfm_ppl.inference.panel import Panel
from lfm_ppl.inference.series_likelihood import SeriesLikelihood
from lfm_ppl.model.observation_noise import check_noise
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.particles import particle_filter
from lfm_ppl.particles.particle_filter import ParticleSettings
from lfm_ppl.utils.progress import Console

_PILOT = 8
"""Draws that the pilot run takes."""

GRID_ERROR = 1e-2
"""Discretisation error of a log likelihood that does not matter: most of it is common to all draws, and cancels."""

_SCOUTS = 10
"""Draws whose models the grid is laid out for: those with the smallest and largest parameters, and others between."""


class PosteriorDraws(NamedTuple):
    """A bound model, and draws of its parameters.

    Attributes:
        bound: the model with its times and data.
        draws: site name -> (S, ...).
        parts: maps the name of what is computed to what keeps its batches; None: they are not kept.
    """

    bound: BoundModel
    draws: Mapping[str, np.ndarray]
    parts: Callable[[str], BatchStore] | None = None

    def kept(self, name: str) -> BatchStore | None:
        """Return what keeps the batches of a computation."""
        return None if self.parts is None else self.parts(name)

    @property
    def example(self) -> SeriesLikelihood:
        """The likelihood of one series at parameters from the prior."""
        return self.bound.site.example

    @property
    def y(self) -> np.ndarray:
        """The data, (T, D), or (B, T, D) for a panel."""
        return np.asarray(self.bound.y)

    @property
    def size(self) -> int:
        """S, the number of draws."""
        return len(next(iter(self.draws.values())))

    @property
    def series(self) -> int:
        """Number of series."""
        return self.y.shape[0] if isinstance(self.bound.site.distribution, Panel) else 1

    def at(self, rows: Any) -> PosteriorDraws:
        """Return the same problem with some of the draws."""
        return self._replace(draws={name: value[rows] for name, value in self.draws.items()})


class Reference(NamedTuple):
    """Log likelihoods of a reference.

    Attributes:
        estimates: (S, R) log likelihoods, R replicates of an unbiased estimate, or R = 1 where they are exact.
        description: of the method, in words.
        particles: in each replicate; zero where there are none.
        limited: whether more particles were wanted than the limit on work allows.
    """

    estimates: np.ndarray
    description: str
    particles: int = 0
    limited: bool = False


def is_exact(ssm: StateSpaceModel) -> bool:
    """Whether the Gaussian filter computes the exact likelihood: linear dynamics and observation, Gaussian noise."""
    is_family = isinstance(ssm.model.observation, ObservationFamily)
    return ssm.time_invariant and not is_family and not is_observation_nonlinear(ssm)


def gaussian(problem: PosteriorDraws, name: str = "log likelihoods") -> np.ndarray:
    """Return (S,): the log likelihoods of the Gaussian filter, summed over the series of a panel."""
    bound = problem.bound

    def per_draw(values: Any, key: jax.Array, y: jax.Array) -> dict[str, jax.Array]:
        return {"total": bound.likelihood(values, y).log_prob(bound.data(y)).sum()}

    return map_draws(bound, "log likelihoods", per_draw, problem.draws, jax.random.key(0), rows=bound.times.size,
                     store=problem.kept(name))["total"]


def recorded(problem: PosteriorDraws, log_likelihoods: np.ndarray) -> np.ndarray:
    """Return (S,): what a result records of its log likelihoods, the sum of one-step-ahead terms.

    Those of the Gaussian filter are the sum itself; of an observation family they are of assumed density filtering.
    """
    bound = problem.bound
    if not isinstance(problem.example.ssm.model.observation, ObservationFamily):
        return log_likelihoods

    def per_draw(values: Any, key: jax.Array, y: jax.Array) -> jax.Array:
        return bound.likelihood(values, y).log_prob_per_observation(bound.data(y)).sum()

    return map_draws(bound, "one step ahead", per_draw, problem.draws, jax.random.key(0), rows=bound.times.size,
                     store=problem.kept("one-step-ahead terms"))


def finer_tolerance(tolerance: float) -> float:
    """Return the tolerance at which steps are half as long: their errors grow with the fourth power of the length."""
    return tolerance / 16


def finer_steps(example: SeriesLikelihood) -> dict[str, Any]:
    """Return the settings of a likelihood with about twice as many integration steps."""
    settings: dict[str, Any] = {"steps": 2 * example.steps}
    if example.max_step is not None:
        settings["max_step"] = example.max_step / 2
    if example.tolerance is not None:
        settings["tolerance"] = finer_tolerance(example.tolerance)
    return settings


def gaussian_with_finer_steps(problem: PosteriorDraws) -> np.ndarray:
    """Return (S,): the log likelihoods of the Gaussian filter with about twice as many integration steps."""
    finer = problem.bound.approximate(**finer_steps(problem.example))
    return gaussian(problem._replace(bound=finer), "log likelihoods with finer steps")


def on_grid(problem: PosteriorDraws, steps: int | None, progress: bool) -> Reference:
    """Return the log likelihoods by the Fokker-Planck equation on one grid for all draws.

    Raises:
        ValueError: what the grid raises, for states of more than one dimension, no noise, and so on.
    """
    layout = fokker_planck.choose_grid(_scouted(problem), problem.example.times, problem.y, tolerance=GRID_ERROR)
    bound = problem.bound

    def one(distribution: SeriesLikelihood, y: jax.Array) -> jax.Array:
        time_grid = build_time_grid(distribution.ssm, distribution.times, steps or distribution.steps,
                                    distribution.max_step)
        return fokker_planck.log_likelihood(distribution.ssm, time_grid, y, layout)

    def per_draw(values: Any, key: jax.Array, y: jax.Array) -> jax.Array:
        return map_series(bound.likelihood(values, y), one, bound.data(y)).sum()

    log_likelihoods = _one_by_one(problem, jax.random.key(0), ("grid", layout, steps), per_draw, "Fokker-Planck grid",
                                  progress)
    return Reference(log_likelihoods[:, None], f"Fokker-Planck equation on a grid of {layout.cells} cells")


def takes_smoother_draws(ssm: StateSpaceModel) -> bool:
    """Whether draws of the smoother, weighted, estimate the likelihood: linear, with an observation family."""
    return isinstance(ssm.model.observation, ObservationFamily) and is_linear(ssm)


def by_particles(problem: PosteriorDraws, particles: int | None, replicates: int, steps: int | None, key: jax.Array,
                 progress: bool, noise: Callable[[np.ndarray], float], target: float, most_work: float) -> Reference:
    """Return replicates of the particle filter's estimates, or of importance sampling where `takes_smoother_draws`.

    Without a number of particles, a pilot run at a few draws, spread over all, finds the number at which the noise of
    a draw's averaged estimate is below ``target``, for the variance falls in proportion to it.

    Args:
        problem: the draws.
        particles: N, or None.
        replicates: R.
        steps: integration steps between two times; None: those of the Gaussian filter.
        key: a JAX random key.
        progress: whether to show how far it is.
        noise: maps estimates (S, R) to the sd of their averages.
        target: of that sd.
        most_work: limit on the number of particle steps, from which that on N follows.
    """
    example = problem.example
    pilot_key, key = jax.random.split(key)
    limited = False
    count = particles or _FIRST_PARTICLES
    run = _particle_run(problem, count, replicates, steps, progress)
    if particles is None:
        rows = np.unique(np.linspace(0, problem.size - 1, _PILOT).round().astype(int))
        keep = problem.parts
        pilot = None if keep is None else lambda name: keep(f"pilot {name}")
        sd = noise(run(problem.at(rows)._replace(parts=pilot), pilot_key))
        needed = count * (sd / target) ** 2 * _SAFETY if np.isfinite(sd) else np.inf
        time_grid = build_time_grid(example.ssm, example.times, steps or example.steps, example.max_step)
        steps_made = np.shape(time_grid.intervals.length)[0] * time_grid.steps
        each_particle = problem.size * replicates * problem.series * steps_made
        most = max(count, most_work / each_particle)
        limited = needed > most
        if needed > count and most > count:
            count = int(np.ceil(min(needed, most) / 500) * 500)
            run = _particle_run(problem, count, replicates, steps, progress)
    method = (f"importance sampling, {replicates} runs of {count:,} draws of the smoother" if takes_smoother_draws(
        example.ssm) else f"particle filter, {replicates} runs of {count:,} particles")
    return Reference(run(problem, key), f"{method} a draw", count, limited)


_FIRST_PARTICLES = 1000
_SAFETY = 1.2
"""Margin of the number of particles over what the pilot run asks for, which is itself an estimate."""


def _particle_run(problem: PosteriorDraws, particles: int, replicates: int, steps: int | None,
                  progress: bool) -> Callable:
    example = problem.example
    check_noise(example.ssm, example.time_grid.initial_time)
    settings = particle_filter.check_settings(example.ssm, ParticleSettings(particles))

    def one(distribution: SeriesLikelihood, y: jax.Array, key: jax.Array) -> jax.Array:
        time_grid = build_time_grid(distribution.ssm, distribution.times, steps or distribution.steps,
                                    distribution.max_step)
        if takes_smoother_draws(distribution.ssm):
            filtering = filter_problem(distribution.ssm, distribution.rule, time_grid)
            return importance.log_likelihood(filtering, y, key, particles, as_settings(distribution.sites))
        return particle_filter.log_likelihood(distribution.ssm, time_grid, y, key, settings)

    bound, series = problem.bound, problem.series

    def per_draw(values: Any, key: jax.Array, y: jax.Array) -> jax.Array:
        distribution = bound.likelihood(values, y)
        y = bound.data(y)

        def replicate(key: jax.Array) -> jax.Array:
            keys = jax.random.split(key, series) if isinstance(distribution, Panel) else key
            return map_series(distribution, one, y, keys).sum()

        return jax.lax.map(replicate, jax.random.split(key, replicates))

    name = ("particles", settings, replicates, steps)
    label = f"particle filter, {particles:,} particles"
    return lambda problem, key: _one_by_one(problem, key, name, per_draw, label, progress)


def _one_by_one(problem: PosteriorDraws, key: jax.Array, name: Hashable, per_draw: Callable, label: str,
                progress: bool) -> np.ndarray:
    """Map over draws, one after another, and say how far that is."""
    return map_draws(problem.bound, name, per_draw, problem.draws, key, label=label,
                     report=Console() if progress else None, store=problem.kept(label))


def _scouted(problem: PosteriorDraws) -> list[Any]:
    """Return latent force models at draws that span the posterior, to lay out one grid for all."""
    flat = np.column_stack([np.reshape(value, (problem.size, -1)) for value in problem.draws.values()])
    extreme = np.concatenate([flat.argmin(axis=0), flat.argmax(axis=0)])
    even = np.linspace(0, problem.size - 1, min(_SCOUTS, problem.size)).round().astype(int)
    rows = list(dict.fromkeys([*extreme, *even]))[: max(_SCOUTS, len(extreme))]
    models = []
    for row in rows:
        parameters = {name: jnp.asarray(value[row]) for name, value in problem.draws.items()}
        distribution = problem.bound.likelihood(parameters)
        if isinstance(distribution, Panel):
            leaves = [jax.tree_util.tree_map(lambda leaf: jnp.asarray(leaf)[b], distribution.parameters)  # noqa: B023
                      for b in range(problem.series)]
            models += [distribution.build(leaf) for leaf in leaves]
        else:
            models.append(distribution.model)
    return models
