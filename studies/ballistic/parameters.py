"""Parameters from the measurements alone: the maximum of the likelihood, and the posterior.

1. Maximise the Gaussian filter's likelihood, and its product with the prior, over the logarithms z of the parameters.
2. Draw importance samples about the posterior mode. Their Pareto index shows whether the weights are reliable, and NUTS
   and RAM must agree with them on a few targets.
3. Smooth the paths at the maximum of the likelihood, and averaged over posterior draws.

The coverage of the posterior for a fixed truth depends on the prior. With the other parameters known the prior hardly
matters: if the filter's likelihood is right, the posterior of the drag, by quadrature, has the nominal
coverage (`rank_drag`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from numpyro.infer import init_to_uniform

import lfm_ppl as lfm
from lfm_ppl.inference.optimise import Minimum, newton, quasi_newton
from lfm_ppl.parallel.task import Result, Task

from .. import chains
from ..importance_at_modes import Weighted, weighted_posterior
from ..scores import GridPosterior, interval, score_path, total_moments
from ..tasks import dataset_indices, stack_results
from ..timing import time_compiled_call
from . import problem
from .problem import SimulatedTarget, posterior
from .states import smoothed_paths

SAMPLERS = ("NUTS", "RAM")
LEVELS = (0.5, 0.8, 0.95)
"""Probabilities of the central intervals whose coverage is reported."""

REACH = 1.5
"""Half the width of the grid about the true log alpha, about six posterior standard deviations."""

MAX_DISTANCE = 3.0
"""Largest distance of the maximum of the likelihood from the prior medians, in every logarithm. A search that ends
further away has no maximum among plausible values."""


def estimate_targets(task: Task, from_prior: bool = False) -> Result:
    """Return the entries of `estimate` for every target of a task, and ``draws`` of the first.

    The targets have the true parameters or, with ``from_prior``, parameters drawn from the prior.
    """
    simulate = problem.simulate_target_from_prior if from_prior else problem.simulate_target
    count, paths = task.settings["draws"], task.settings["paths"]
    indices = dataset_indices(task)
    seeds = [int(jax.random.bits(jax.random.fold_in(task.key, index))) for index in indices]
    rows = [estimate(simulate(index, task.seed), count, paths, seed)
            for index, seed in zip(indices, seeds, strict=True)]
    return stack_results(rows, first_only=("draws",))


def estimate(target: SimulatedTarget, count: int, paths: int, seed: int) -> Result:
    """Return maximum of the likelihood and posterior for a target.

    Args:
        target: the target.
        count: number of importance samples.
        paths: number of draws over which smoothed paths are averaged.
        seed: seed of the draws.

    Returns:
        ``likely`` (3,), the maximum of the likelihood, and whether it ``exists``; the posterior's entries of
        `Weighted.summary`; ``below`` (3,), the posterior probability of values below the truth; RMSE and coverage (3,)
        of the paths smoothed at the maximum (``likely_``) and with the parameters marginalised (``posterior_``); CPU
        ``seconds`` of searches and weights; ``draws`` (3, count).
    """
    density, start = posterior(), np.log(problem.MEDIANS)

    def search() -> tuple[Minimum, Weighted]:
        objectives = [density.objective(target.y, prior) for prior in (1.0, 0.0)]
        mode, likely = (newton(objective, quasi_newton(objective, start, 200).point) for objective in objectives)
        return likely, weighted_posterior(density, target.y, [mode], count, seed)

    seconds, (likely, weighted) = time_compiled_call(f"ballistic, {count} weighted draws", search)
    row = {**weighted.summary, "likely": likely.point, "seconds": seconds, "draws": weighted.resampled(count, seed).T,
           "below": weighted.weight @ (weighted.draws < target.z),
           "exists": likely.curvature is not None and likely.curvature.definite
           and bool(np.all(np.abs(likely.point - start) < MAX_DISTANCE))}
    for prefix, draws in (("likely", likely.point[None]), ("posterior", weighted.resampled(paths, seed))):
        means, sds = map(np.asarray, _compiled_smoother()(draws, target.y))
        mean, sd = total_moments(means, sds**2)
        row |= score_path(prefix, mean, interval(mean, sd), target.paths)
    return row


@functools.cache
def _compiled_smoother() -> Callable:
    """Return the map from draws of z (S, 3) and data to smoothed paths, compiled once for all targets."""
    return jax.jit(lambda draws, y: jax.lax.map(
        lambda z: smoothed_paths(posterior().likelihood(z).smooth(y)), draws, batch_size=10))


def sample_chains(task: Task) -> Result:
    """Return the entries of `lfm_ppl.studies.chains.sample` for z (3, chains, draws) of a target."""
    target = problem.simulate_target(task.settings["index"], task.seed)
    start = init_to_uniform(radius=1.0)  # R-hat detects nothing unless the chains start at different points
    kernel: Any = (lfm.RAM if task.settings["sampler"] == "RAM" else chains.nuts)(problem.model(), init_strategy=start)
    mcmc = chains.sampler(kernel, *(task.settings[name] for name in chains.LENGTHS))
    return chains.sample(mcmc, problem.NAMES, task.key, target.times, target.y)


def rank_targets(task: Task) -> Result:
    """Return ``below`` (N,), the entries of `rank_drag` for the targets of a task."""
    targets = (problem.simulate_target(index, task.seed) for index in dataset_indices(task))
    return {"below": np.array([rank_drag(target) for target in targets])}


def rank_drag(target: SimulatedTarget, nodes: int = 121) -> float:
    """Return the posterior probability that the drag is below its true value, with the other parameters known.

    The posterior is computed by quadrature. The prior of the logarithm is flat within `REACH` of the truth, the range
    of the nodes: it must be several posterior standard deviations on either side, with a few nodes in each.
    """
    points = np.tile(target.z, (nodes, 1))
    points[:, 0] += REACH * np.linspace(-1.0, 1.0, nodes)
    log_likelihood, _ = posterior().log_densities_of(points, target.y, batch=11)
    return GridPosterior(points[:, 0], log_likelihood).cdf(target.z[0])
