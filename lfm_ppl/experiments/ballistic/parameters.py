"""Drag, scale and lengthscale from the distances alone: the most likely values, and the posterior of each target.

The posterior is that of the model with its priors and the Gaussian filter's likelihood, in the logarithms z of the
parameters. Its mode and curvature give a multivariate t distribution, whose draws are weighted by the posterior; the
Pareto index of the weights says whether that is good enough. `chains` compares it with NUTS and RAM.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from lfm_ppl.analysis import importance
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.ballistic import problem
from lfm_ppl.experiments.ballistic.tracking import blocks, judged
from lfm_ppl.experiments.tasks import Result, Task
from lfm_ppl.experiments.timing import timed
from lfm_ppl.inference.optimise import Minimum, Objective, newton, quasi_newton

START = np.log([5e-4, 30.0, 5.0])
"""Where every search starts: the prior medians."""

FREEDOM, WIDER = 7, 1.2
"""Degrees of freedom of the t distribution, and how much wider it is than the curvature says."""

LEVELS = (0.5, 0.8, 0.95)
FURTHEST = 3.0
"""A most likely value further than this from `START`, in logarithms, lies at the edge: the likelihood has no maximum
among plausible values."""

_TOGETHER = 10
"""Parameter values that are computed at a time: a thousand no longer fit the CPU's cache, and take seven times as long
each."""

BLOCK = 10
"""Targets that are computed in one go, and stored in one file."""


def tasks(settings: Any) -> list[Task]:
    """Return one task for each block of targets."""
    return [Task(f"parameters/{first:04d}-{last:04d}", settings.seed,
                 {"experiment": "ballistic", "what": "parameters", "first": first, "last": last,
                  "draws": settings.draws, "paths": settings.paths})
            for first, last in blocks(settings.runs, BLOCK)]


def compute(task: Task) -> Result:
    """Return what is found of every target of the task, (N, ...).

    Returns:
        ``likely`` (3,), the most likely z, and whether it ``exists``; of the posterior of z ``posterior_mean``,
        ``posterior_sd`` and ``below`` (3,), the probability of less than the true value; ``k``, the Pareto index, and
        ``ess`` of the weights; RMSE and coverage (3,) of the smoothed paths with the most likely parameters
        (``likely_``) and with the parameters integrated out (``posterior_``); CPU ``seconds`` of searches and weights.
        ``draws`` (3, D) of the first target, for a figure.
    """
    _programs(task.settings["draws"], task.settings["paths"])
    rows: dict[str, list] = {}
    first: Result = {}
    for index in range(task.settings["first"], task.settings["last"] + 1):
        target = problem.target(index, task.seed)
        seed = int(jax.random.bits(jax.random.fold_in(task.key, index)))
        found = estimate(target, task.settings["draws"], task.settings["paths"], seed)
        drawn = found.pop("draws")
        first = first or {"draws": drawn}
        for name, value in found.items():
            rows.setdefault(name, []).append(value)
    return {**{name: np.stack(values) for name, values in rows.items()}, **first}


def estimate(target: problem.Target, count: int, paths: int, seed: int) -> Result:
    """Return what is found of a target, see `compute`.

    Args:
        target: the target.
        count: draws that are weighted.
        paths: draws over which the smoothed paths are averaged.
        seed: of the draws.
    """
    densities, one_path, smoothing = _programs(count, paths)
    y = jnp.asarray(target.y)

    def search() -> tuple[Minimum, Minimum, np.ndarray, np.ndarray]:
        mode, likely = (_minimum(target.y, weight) for weight in (1.0, 0.0))
        draws, log_proposed = proposals(mode, count, seed)
        return mode, likely, draws, np.asarray(densities(jnp.asarray(draws), y)) - log_proposed

    seconds, (mode, likely, draws, log_ratio) = timed(search)
    weights = importance.smooth(np.where(np.isfinite(log_ratio), log_ratio, -np.inf)[None])
    weight = np.exp(weights.log_weight[0])
    mean = weight @ draws
    sd = np.sqrt(weight @ (draws - mean) ** 2)
    chosen = draws[importance.resample(weights.log_weight, paths, seed)]
    means, sds = map(np.asarray, smoothing(jnp.asarray(chosen), y))
    total = [scores.total_moments(means[:, row], sds[:, row] ** 2) for row in range(len(problem.PATHS))]
    exists = likely.curvature is not None and bool(
        (likely.curvature.values > likely.curvature.floor).all() and np.all(np.abs(likely.point - START) < FURTHEST))
    return {
        "likely": likely.point, "exists": exists, "posterior_mean": mean, "posterior_sd": sd,
        "below": weight @ (draws < problem.true_z()), "k": weights.k, "ess": weights.ess, "seconds": seconds,
        "draws": draws[importance.resample(weights.log_weight, count, seed)].T,
        **judged("likely", *one_path(jnp.asarray(likely.point), y), target),
        **judged("posterior", np.stack([one[0] for one in total]), np.stack([one[1] for one in total]), target)}


def proposals(mode: Minimum, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return draws (count, 3) of the multivariate t distribution at a mode, and their log densities up to a constant.

    Raises:
        ValueError: there is no curvature at the mode.
    """
    if mode.curvature is None:
        raise ValueError("the posterior has no curvature at its mode; its derivatives there are not finite.")
    generator = np.random.default_rng(seed)
    root = WIDER * mode.curvature.factor
    dimension = len(root)
    white = generator.normal(size=(count, dimension))
    white *= np.sqrt(FREEDOM / generator.chisquare(FREEDOM, size=(count, 1)))
    log_density = stats.multivariate_t(np.zeros(dimension), np.eye(dimension), df=FREEDOM).logpdf(white)
    return mode.point + white @ root.T, log_density


@dataclass
class _Energy(Objective):
    """Minus the log posterior density of a target, or minus its log likelihood, from the one compiled program."""

    y: Any = None
    prior: float = 1.0

    def value_and_gradient(self, point: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the value and the gradient (3,)."""
        self.evaluations += 1
        value, gradient = _energy_program()(jnp.asarray(point), self.y, self.prior)
        return float(value), np.asarray(gradient)


def _minimum(y: np.ndarray, prior: float) -> Minimum:
    """Return the mode of the posterior (``prior`` 1) or of the likelihood (0)."""
    energy = _Energy(_energy, exact_hessian=False, y=jnp.asarray(y), prior=prior)
    return newton(energy, quasi_newton(energy, START, 200))


def _energy(z: jax.Array, y: jax.Array, prior: Any) -> jax.Array:
    log_likelihood, log_prior = problem.log_densities(z, y)
    return -log_likelihood - prior * log_prior


@functools.cache
def _energy_program() -> Callable:
    """Return value and gradient, by forward mode, compiled once for all targets."""
    def twice(*arguments: Any) -> tuple[jax.Array, jax.Array]:
        value = _energy(*arguments)
        return value, value

    return jax.jit(lambda *arguments: jax.jacfwd(twice, has_aux=True)(*arguments)[::-1])


@functools.cache
def _programs(count: int, paths: int) -> tuple[Callable, Callable, Callable]:
    """Compile the densities of draws, and the smoothed paths of one and of several, once for all targets."""
    def one(z: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        return problem.paths_of(problem.likelihood(z).smooth(y))

    y = jax.ShapeDtypeStruct((len(problem.target(0).times), 1), float)
    z = [jax.ShapeDtypeStruct((*shape, len(problem.NAMES)), float) for shape in ((count,), (), (paths,))]

    def each(function: Callable) -> Callable:
        return lambda all_, y: jax.lax.map(lambda z: function(z, y), all_, batch_size=_TOGETHER)

    functions = each(lambda z, y: -_energy(z, y, 1.0)), one, each(one)
    energy = _energy_program()
    energy(jnp.asarray(START), jnp.asarray(problem.target(0).y), 1.0)
    return tuple(jax.jit(function).lower(shape, y).compile()  # type: ignore[return-value]
                 for function, shape in zip(functions, z, strict=True))
