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
import jax.numpy as jnp
import numpy as np
from numpyro.infer import init_to_uniform

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import chains, scores
from lfm_ppl.experiments.ballistic import problem
from lfm_ppl.experiments.ballistic.smoothing import judged
from lfm_ppl.experiments.study import stacked
from lfm_ppl.experiments.timing import timed
from lfm_ppl.inference.kernels.ram import RAM
from lfm_ppl.inference.optimise import Minimum, newton, quasi_newton
from lfm_ppl.results import importance
from lfm_ppl.results.importance_at_modes import Weighted, moments, weighted

SAMPLERS = ("NUTS", "RAM")
LEVELS = (0.5, 0.8, 0.95)
"""Probabilities of the central intervals whose coverage is reported."""

START = np.log([5e-4, 30.0, 5.0])
"""Where every search starts: the prior medians."""

FURTHEST = 3.0
"""A maximum of the likelihood further than this from `START`, in logarithms, lies at the edge: there is none among
plausible values."""

REACH, POINTS = 1.5, 121
"""Of the grid about the true log alpha: a dozen posterior standard deviations wide, of a tenth of one a cell."""

_PATHS_TOGETHER, _POINTS_TOGETHER = 10, 11


def compute(task: Task) -> Result:
    """Return what `estimate` finds of every target of a task, and ``draws`` (3, D) of the first."""
    count, paths = task.settings["draws"], task.settings["paths"]
    _warm(count, paths)
    target = problem.drawn_target if task.settings["what"] == "drawn" else problem.target
    rows = [estimate(target(index, task.seed), count, paths, int(jax.random.bits(jax.random.fold_in(task.key, index))))
            for index in range(task.settings["first"], task.settings["last"] + 1)]
    return stacked(rows, shown=("draws",))


def estimate(target: problem.Target, count: int, paths: int, seed: int) -> Result:
    """Return maximum and posterior of a target.

    Args:
        target: the target.
        count: importance samples.
        paths: draws over which the smoothed paths are averaged.
        seed: of the draws.

    Returns:
        ``likely`` (3,), the maximum of the likelihood, and whether it ``exists``; of the posterior ``posterior_mean``,
        ``posterior_sd`` and ``below`` (3,), the probability of less than the true value; ``k`` and ``ess`` of the
        weights; RMSE and coverage (3,) of the paths smoothed at the maximum (``likely_``), and with the parameters
        marginalised (``posterior_``); CPU ``seconds`` of searches and weights; ``draws`` (3, count).
    """
    (one_path, smoothing), posterior = _paths(), problem.posterior()
    y = jnp.asarray(target.y)

    def search() -> tuple[Minimum, Weighted]:
        objectives = [posterior.objective(y, prior) for prior in (1.0, 0.0)]
        mode, likely = (newton(each, quasi_newton(each, START, 200).point) for each in objectives)
        return likely, weighted(lambda draws: np.sum(posterior.log_densities_of(draws, y), axis=0), [mode], count, seed)

    seconds, (likely, (draws, weights, _)) = timed(search)
    weight = np.exp(weights.log_weight[0])
    mean, covariance = moments(draws, weight)
    plain = one_path(jnp.asarray(likely.point), y)
    chosen = draws[importance.resample(weights.log_weight, paths, seed)]
    means, sds = map(np.asarray, smoothing(jnp.asarray(chosen), y))
    total = [scores.total_moments(means[:, row], sds[:, row] ** 2) for row in range(len(problem.PATHS))]
    exists = (likely.curvature is not None and likely.curvature.definite
              and bool(np.all(np.abs(likely.point - START) < FURTHEST)))
    return {
        "likely": likely.point, "exists": exists, "posterior_mean": mean, "posterior_sd": np.sqrt(np.diag(covariance)),
        "below": weight @ (draws < target.z), "k": weights.k, "ess": weights.ess, "seconds": seconds,
        "draws": draws[importance.resample(weights.log_weight, count, seed)].T,
        **judged("likely", plain[0], plain[1], target),
        **judged("posterior", np.stack([mean for mean, _ in total]), np.stack([sd for _, sd in total]), target)}


@functools.cache
def _paths() -> tuple[Callable, Callable]:
    """Return smoothed paths for one and for several z, compiled once for all targets."""
    def one(z: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        return problem.paths_of(problem.posterior().likelihood(z).smooth(y))

    return jax.jit(one), jax.jit(lambda all_, y: jax.lax.map(lambda z: one(z, y), all_, batch_size=_PATHS_TOGETHER))


@functools.cache
def _warm(count: int, paths: int) -> None:
    """Compile everything before it is timed."""
    estimate(problem.target(0), count, paths, 0)


def by_chains(task: Task) -> Result:
    """Return what `lfm_ppl.experiments.chains.sample` does, of z (3, chains, draws) of a target."""
    settings, target = task.settings, problem.target(task.settings["index"], task.seed)
    start = init_to_uniform(radius=1.0)  # chains start apart, or R-hat would say nothing
    kernel: Any = (RAM if settings["sampler"] == "RAM" else chains.nuts)(problem.model(), init_strategy=start)
    mcmc = chains.sampler(kernel, *(settings[name] for name in ("chains", "warmup", "draws", "thin")))
    return chains.sample(mcmc, problem.NAMES, task.key, target.times, target.y)


def known(task: Task) -> Result:
    """Return ``below`` (N,), see `below`: where nothing but the drag is unknown."""
    targets = range(task.settings["first"], task.settings["last"] + 1)
    return {"below": np.array([below(problem.target(index, task.seed)) for index in targets])}


def below(target: problem.Target) -> float:
    """Return the posterior probability that log alpha is less than it is, for a flat prior; by the trapezoidal rule.

    Raises:
        ValueError: no drag on the grid has a finite likelihood.
    """
    alphas = target.z[0] + REACH * np.linspace(-1.0, 1.0, POINTS)
    points = np.stack([alphas, np.full(POINTS, target.z[1]), np.full(POINTS, target.z[2])], axis=1)
    log_likelihood, _ = problem.posterior().log_densities_of(points, target.y, _POINTS_TOGETHER)
    density = np.where(np.isfinite(log_likelihood), np.exp(log_likelihood - np.nanmax(log_likelihood)), 0.0)
    if not np.isfinite(log_likelihood).any():
        raise ValueError("the filter breaks down at every drag on the grid.")
    total = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    return float(np.interp(target.z[0], alphas, total / total[-1]))
