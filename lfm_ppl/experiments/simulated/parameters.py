"""Parameters from the measurements alone: the maximum of the likelihood, and the posterior.

The posterior is that of the model with its priors and the Gaussian filter's likelihood, in the logarithms z of the
parameters, by importance samples about its mode, whose Pareto index says whether they are good enough; NUTS and RAM
must agree with them on a few data sets. How often it covers one and the same truth depends on how far the prior pulls.
Where all parameters but one are known it hardly pulls: the posterior of that one, by quadrature, covers the truth about
as often as it says if the filter's likelihood is right.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from numpyro.infer import init_to_uniform

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import chains
from lfm_ppl.experiments.scores import GridPosterior, interval, score_path, total_moments
from lfm_ppl.experiments.simulated.problem import Problem, Record, drawn_record, model, posterior, record
from lfm_ppl.experiments.simulated.states import paths_of
from lfm_ppl.experiments.tasks import dataset_indices, stack_results
from lfm_ppl.experiments.timing import time_compiled_call
from lfm_ppl.inference.kernels.ram import RAM
from lfm_ppl.inference.optimise import Minimum, newton, quasi_newton
from lfm_ppl.results.importance_at_modes import Weighted, weighted_posterior

SAMPLERS = ("NUTS", "RAM")
LEVELS = (0.5, 0.8, 0.95)
"""Probabilities of the central intervals whose coverage is reported."""

FURTHEST = 3.0
"""A maximum of the likelihood further than this from where searches start, in logarithms, lies at the edge: there is
none among plausible values."""


def weighted(problem: Problem, task: Task, drawn: bool = False) -> Result:
    """Return what `estimate` finds of every data set, with the truth or one ``drawn``, and ``draws`` of the first."""
    simulate_record = drawn_record if drawn else record
    count, paths = task.settings["draws"], task.settings["paths"]
    rows = [estimate(problem, simulate_record(problem, index, task.seed), count, paths,
                     int(jax.random.bits(jax.random.fold_in(task.key, index)))) for index in dataset_indices(task)]
    return stack_results(rows, first_only=("draws",))


def estimate(problem: Problem, one: Record, count: int, paths: int, seed: int) -> Result:
    """Return maximum and posterior of a data set.

    Args:
        problem: what is simulated.
        one: the data set.
        count: importance samples.
        paths: draws over which the smoothed paths are averaged.
        seed: of the draws.

    Returns:
        ``likely`` (P,), the maximum of the likelihood, and whether it ``exists``; of the posterior the entries of
        `Weighted.summary`, and ``below`` (P,), the probability of less than the true value; RMSE and coverage (K,) of
        the paths smoothed at the maximum (``likely_``), and with the parameters marginalised (``posterior_``); CPU
        ``seconds`` of searches and weights; ``draws`` (P, count).
    """
    density, start = posterior(problem), np.log(problem.medians)

    def search() -> tuple[Minimum, Weighted]:
        objectives = [density.objective(one.y, prior) for prior in (1.0, 0.0)]
        mode, likely = (newton(each, quasi_newton(each, start, 200).point) for each in objectives)
        return likely, weighted_posterior(density, one.y, [mode], count, seed)

    seconds, (likely, found) = time_compiled_call(f"{problem}, {count} weighted draws", search)
    row = {**found.summary, "likely": likely.point, "seconds": seconds, "draws": found.resampled(count, seed).T,
           "below": found.weight @ (found.draws < one.z),
           "exists": likely.curvature is not None and likely.curvature.definite
           and bool(np.all(np.abs(likely.point - start) < FURTHEST))}
    for what, several in (("likely", likely.point[None]), ("posterior", found.resampled(paths, seed))):
        means, sds = map(np.asarray, _smoothing(problem)(several, one.y))
        mean, sd = total_moments(means, sds**2)
        row |= score_path(what, mean, interval(mean, sd), one.paths)
    return row


@functools.cache
def _smoothing(problem: Problem) -> Callable:
    """Return what smooths paths for several z (S, P), compiled once for all data sets."""
    return jax.jit(lambda several, y: jax.lax.map(
        lambda z: paths_of(problem, posterior(problem).likelihood(z).smooth(y)), several, batch_size=10))


def by_chains(problem: Problem, task: Task) -> Result:
    """Return what `lfm_ppl.experiments.chains.sample` does, of z (P, chains, draws) of a data set."""
    one = record(problem, task.settings["index"], task.seed)
    start = init_to_uniform(radius=1.0)  # chains start apart, or R-hat would say nothing
    kernel: Any = (RAM if task.settings["sampler"] == "RAM" else chains.nuts)(model(problem), init_strategy=start)
    mcmc = chains.sampler(kernel, *(task.settings[name] for name in chains.LENGTHS))
    return chains.sample(mcmc, problem.names, task.key, one.times, one.y)


def alone(problem: Problem, reach: float, task: Task) -> Result:
    """Return ``below`` (N,), see `below`, of the data sets of a task."""
    return {"below": np.array([below(problem, reach, record(problem, index, task.seed))
                               for index in dataset_indices(task)])}


def below(problem: Problem, reach: float, one: Record, nodes: int = 121) -> float:
    """Return the posterior probability that the first parameter is less than it is, the others known, by quadrature.

    The prior of its logarithm is flat within ``reach`` of the truth, where the nodes are: several posterior standard
    deviations on either side, a few nodes in each.
    """
    points = np.tile(one.z, (nodes, 1))
    points[:, 0] += reach * np.linspace(-1.0, 1.0, nodes)
    log_likelihood, _ = posterior(problem).log_densities_of(points, one.y, batch=11)
    return GridPosterior(points[:, 0], log_likelihood).below(one.z[0])
