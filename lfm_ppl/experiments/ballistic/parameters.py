"""Drag, scale and lengthscale from the distances alone: the maximum of the likelihood, and the posterior.

The posterior is that of the model with its priors and the Gaussian filter's likelihood, in the logarithms z of the
parameters, by importance samples about its mode, whose Pareto index says whether they are good enough; NUTS and RAM
must agree with them on a few targets. How often it covers one and the same truth depends on how far the prior pulls.
Where scale and lengthscale are known it hardly pulls beside 120 distances: the posterior of the drag alone, by
quadrature, covers the truth about as often as it says if the filter's likelihood is right.
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
from lfm_ppl.experiments.ballistic import problem
from lfm_ppl.experiments.scores import GridPosterior, interval, judged, total_moments
from lfm_ppl.experiments.tasks import indices, stacked
from lfm_ppl.experiments.timing import timed_again
from lfm_ppl.inference.kernels.ram import RAM
from lfm_ppl.inference.optimise import Minimum, newton, quasi_newton
from lfm_ppl.results.importance_at_modes import Weighted, weighted_posterior

SAMPLERS = ("NUTS", "RAM")
LEVELS = (0.5, 0.8, 0.95)
"""Probabilities of the central intervals whose coverage is reported."""

START, FURTHEST = np.log([5e-4, 30.0, 5.0]), 3.0
"""Where every search starts: the prior medians. A maximum of the likelihood further than this from them, in logarithms,
lies at the edge: there is none among plausible values."""

NODES = 1.5 * np.linspace(-1.0, 1.0, 121)
"""A grid about the true log alpha: a dozen posterior standard deviations wide, of a tenth of one a cell."""


def compute(task: Task) -> Result:
    """Return what `estimate` finds of every target of a task, and ``draws`` (3, D) of the first."""
    target = problem.drawn_target if task.settings["what"] == "drawn" else problem.target
    return stacked([estimate(target(index, task.seed), task.settings["draws"], task.settings["paths"],
                             int(jax.random.bits(jax.random.fold_in(task.key, index)))) for index in indices(task)],
                   shown=("draws",))


def estimate(target: problem.Target, count: int, paths: int, seed: int) -> Result:
    """Return maximum and posterior of a target.

    Args:
        target: the target.
        count: importance samples.
        paths: draws over which the smoothed paths are averaged.
        seed: of the draws.

    Returns:
        ``likely`` (3,), the maximum of the likelihood, and whether it ``exists``; of the posterior the entries of
        `Weighted.summary`, and ``below`` (3,), the probability of less than the true value; RMSE and coverage (3,) of
        the paths smoothed at the maximum (``likely_``), and with the parameters marginalised (``posterior_``); CPU
        ``seconds`` of searches and weights; ``draws`` (3, count).
    """
    posterior = problem.posterior()

    def search() -> tuple[Minimum, Weighted]:
        objectives = [posterior.objective(target.y, prior) for prior in (1.0, 0.0)]
        mode, likely = (newton(each, quasi_newton(each, START, 200).point) for each in objectives)
        return likely, weighted_posterior(posterior, target.y, [mode], count, seed)

    seconds, (likely, found) = timed_again(f"ballistic, {count} weighted draws", search)
    row = {**found.summary, "likely": likely.point, "seconds": seconds, "draws": found.resampled(count, seed).T,
           "below": found.weight @ (found.draws < target.z),
           "exists": likely.curvature is not None and likely.curvature.definite
           and bool(np.all(np.abs(likely.point - START) < FURTHEST))}
    for what, several in (("likely", likely.point[None]), ("posterior", found.resampled(paths, seed))):
        means, sds = map(np.asarray, _smoothing()(several, target.y))
        mean, sd = total_moments(means, sds**2)
        row |= judged(what, mean, interval(mean, sd), target.paths)
    return row


@functools.cache
def _smoothing() -> Callable:
    """Return what smooths paths for several z (S, 3), compiled once for all targets."""
    return jax.jit(lambda several, y: jax.lax.map(
        lambda z: problem.paths_of(problem.posterior().likelihood(z).smooth(y)), several, batch_size=10))


def by_chains(task: Task) -> Result:
    """Return what `lfm_ppl.experiments.chains.sample` does, of z (3, chains, draws) of a target."""
    target = problem.target(task.settings["index"], task.seed)
    start = init_to_uniform(radius=1.0)  # chains start apart, or R-hat would say nothing
    kernel: Any = (RAM if task.settings["sampler"] == "RAM" else chains.nuts)(problem.model(), init_strategy=start)
    mcmc = chains.sampler(kernel, *(task.settings[name] for name in chains.LENGTHS))
    return chains.sample(mcmc, problem.NAMES, task.key, target.times, target.y)


def known(task: Task) -> Result:
    """Return ``below`` (N,), see `below`: where nothing but the drag is unknown."""
    return {"below": np.array([below(problem.target(index, task.seed)) for index in indices(task)])}


def below(target: problem.Target) -> float:
    """Return the posterior probability that log alpha is less than it is, for a flat prior, by quadrature."""
    points = target.z + NODES[:, None] * (np.array(problem.NAMES) == "alpha")
    log_likelihood, _ = problem.posterior().log_densities_of(points, target.y, batch=11)
    return GridPosterior(points[:, 0], log_likelihood).below(target.z[0])
