"""Parameters from the measurements alone: the maximum of the likelihood, and the posterior.

1. Maximise the Gaussian filter's likelihood, and its product with the prior, over the logarithms z of the parameters.
2. Draw importance samples about the posterior mode. Their Pareto index shows whether the weights are reliable, and NUTS
   and RAM must agree with them on a few data sets.
3. Smooth the paths at the maximum of the likelihood, and averaged over posterior draws.

The coverage of the posterior for a fixed truth depends on the prior. With all parameters but one known the prior hardly
matters: if the filter's likelihood is right, the posterior of the remaining parameter, by quadrature, has the nominal
coverage (`rank_first_parameter`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from numpyro.infer import init_to_uniform

from lfm_ppl.experiments import chains
from lfm_ppl.experiments.scores import GridPosterior, interval, score_path, total_moments
from lfm_ppl.experiments.simulated.problem import (
    SimulatedRecord,
    SimulationProblem,
    model,
    posterior,
    simulate_record,
    simulate_record_from_prior,
)
from lfm_ppl.experiments.simulated.states import smoothed_paths
from lfm_ppl.experiments.tasks import dataset_indices, stack_results
from lfm_ppl.experiments.timing import time_compiled_call
from lfm_ppl.inference.kernels.ram import RAM
from lfm_ppl.inference.optimise import Minimum, newton, quasi_newton
from lfm_ppl.parallel.task import Result, Task
from lfm_ppl.results.importance_at_modes import Weighted, weighted_posterior

SAMPLERS = ("NUTS", "RAM")
LEVELS = (0.5, 0.8, 0.95)
"""Probabilities of the central intervals whose coverage is reported."""

MAX_DISTANCE = 3.0
"""Largest distance of the maximum of the likelihood from the prior medians, in every logarithm. A search that ends
further away has no maximum among plausible values."""


def estimate_all(problem: SimulationProblem, task: Task, from_prior: bool = False) -> Result:
    """Return the entries of `estimate` for every data set of a task, and ``draws`` of the first.

    The data sets have the true parameters or, with ``from_prior``, parameters drawn from the prior.
    """
    simulate = simulate_record_from_prior if from_prior else simulate_record
    count, paths = task.settings["draws"], task.settings["paths"]
    rows = [estimate(problem, simulate(problem, index, task.seed), count, paths,
                     int(jax.random.bits(jax.random.fold_in(task.key, index)))) for index in dataset_indices(task)]
    return stack_results(rows, first_only=("draws",))


def estimate(problem: SimulationProblem, record: SimulatedRecord, count: int, paths: int, seed: int) -> Result:
    """Return maximum of the likelihood and posterior for a data set.

    Args:
        problem: the problem.
        record: the data set.
        count: number of importance samples.
        paths: number of draws over which smoothed paths are averaged.
        seed: seed of the draws.

    Returns:
        ``likely`` (P,), the maximum of the likelihood, and whether it ``exists``; the posterior's entries of
        `Weighted.summary`; ``below`` (P,), the posterior probability of values below the truth; RMSE and coverage (K,)
        of the paths smoothed at the maximum (``likely_``) and with the parameters marginalised (``posterior_``); CPU
        ``seconds`` of searches and weights; ``draws`` (P, count).
    """
    density, start = posterior(problem), np.log(problem.medians)

    def search() -> tuple[Minimum, Weighted]:
        objectives = [density.objective(record.y, prior) for prior in (1.0, 0.0)]
        mode, likely = (newton(objective, quasi_newton(objective, start, 200).point) for objective in objectives)
        return likely, weighted_posterior(density, record.y, [mode], count, seed)

    seconds, (likely, weighted) = time_compiled_call(f"{problem}, {count} weighted draws", search)
    row = {**weighted.summary, "likely": likely.point, "seconds": seconds, "draws": weighted.resampled(count, seed).T,
           "below": weighted.weight @ (weighted.draws < record.z),
           "exists": likely.curvature is not None and likely.curvature.definite
           and bool(np.all(np.abs(likely.point - start) < MAX_DISTANCE))}
    for prefix, draws in (("likely", likely.point[None]), ("posterior", weighted.resampled(paths, seed))):
        means, sds = map(np.asarray, _compiled_smoother(problem)(draws, record.y))
        mean, sd = total_moments(means, sds**2)
        row |= score_path(prefix, mean, interval(mean, sd), record.paths)
    return row


@functools.cache
def _compiled_smoother(problem: SimulationProblem) -> Callable:
    """Return the map from draws of z (S, P) and data to smoothed paths, compiled once for all data sets."""
    return jax.jit(lambda draws, y: jax.lax.map(
        lambda z: smoothed_paths(problem, posterior(problem).likelihood(z).smooth(y)), draws, batch_size=10))


def sample_chains(problem: SimulationProblem, task: Task) -> Result:
    """Return the entries of `lfm_ppl.experiments.chains.sample` for z (P, chains, draws) of a data set."""
    record = simulate_record(problem, task.settings["index"], task.seed)
    start = init_to_uniform(radius=1.0)  # R-hat detects nothing unless the chains start at different points
    kernel: Any = (RAM if task.settings["sampler"] == "RAM" else chains.nuts)(model(problem), init_strategy=start)
    mcmc = chains.sampler(kernel, *(task.settings[name] for name in chains.LENGTHS))
    return chains.sample(mcmc, problem.names, task.key, record.times, record.y)


def rank_all(problem: SimulationProblem, reach: float, task: Task) -> Result:
    """Return ``below`` (N,), the entries of `rank_first_parameter` for the data sets of a task."""
    return {"below": np.array([rank_first_parameter(problem, reach, simulate_record(problem, index, task.seed))
                               for index in dataset_indices(task)])}


def rank_first_parameter(problem: SimulationProblem, reach: float, record: SimulatedRecord, nodes: int = 121) -> float:
    """Return the posterior probability that the first parameter is below its true value, with the others known.

    The posterior is computed by quadrature. The prior of the logarithm is flat within ``reach`` of the truth, the range
    of the nodes: it must be several posterior standard deviations on either side, with a few nodes in each.
    """
    points = np.tile(record.z, (nodes, 1))
    points[:, 0] += reach * np.linspace(-1.0, 1.0, nodes)
    log_likelihood, _ = posterior(problem).log_densities_of(points, record.y, batch=11)
    return GridPosterior(points[:, 0], log_likelihood).below(record.z[0])
