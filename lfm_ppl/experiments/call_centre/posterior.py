"""The parameters integrated out: the posterior given the training, and what it adds to the most likely parameters.

Draws of the posterior of the logarithms z under the model's priors are weighted draws about all modes that are found,
see `lfm_ppl.experiments.weighting`; of the first windows there are those of NUTS, too, which they must agree with where
there is one mode (chains are far too short to tell how much of the posterior is about each of several). Each draw
tracks the test day; the estimates of all, mixed, stand for the prediction.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from numpyro.infer import MCMC
from scipy import special, stats

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import chains, scores
from lfm_ppl.experiments.call_centre import problem, tracking
from lfm_ppl.experiments.call_centre.problem import FIRST, TESTED, Method, Window
from lfm_ppl.experiments.call_centre.tracking import Tracked
from lfm_ppl.experiments.study import stacked
from lfm_ppl.experiments.weighting import Weighted, weighted
from lfm_ppl.inference.optimise import Minimum
from lfm_ppl.results import importance

ACCEPTED = 0.95
"""Acceptance that NUTS aims at: steps fine enough for the walls of the posterior, where arrivals exceed what is served
and the log density falls by hundreds within a few standard deviations."""


def tasks(settings: Any) -> list[Task]:
    """Return one task for each method whose parameters are integrated out, by weighted draws in all windows."""
    return [Task(f"posterior/{name}", settings.seed, {**_shared(settings, name), **settings.windows()})
            for name in settings.integrated]


def nuts_tasks(settings: Any) -> list[Task]:
    """Return one task for each method and window whose parameters are integrated out by NUTS."""
    first = range(min(settings.nuts_days, settings.days))
    return [Task(f"nuts/{name}/{index:02d}", settings.seed, {
        **_shared(settings, name), "what": "nuts", "chains": list(settings.nuts), "accepted": ACCEPTED,
        **settings.windows(), "first": index, "count": 1}) for name in settings.integrated for index in first]


def _shared(settings: Any, name: str) -> dict[str, Any]:
    return {"experiment": "call-centre", "what": "posterior", "method": name, "link": settings.link,
            "functions": settings.functions, "starts": len(tracking.STARTS), "draws": settings.draws,
            "mixed": settings.mixed}


def compute(task: Task) -> Result:
    """Return what the posterior says of all windows.

    Returns:
        ``k``, the Pareto index, and ``ess`` of the weights, the number of ``modes`` and the share of the posterior
        ``beyond`` the highest of them (N,), ``posterior_mean`` and ``posterior_sd`` of z (N, P);
        for both tests, with its name before it, the entries of `judge` (N,); for the first window the smoothed
        arrivals ``shapes`` and ``shapes_sd`` (673,), given all readings, at the most likely parameters.
    """
    method = tracking.method_of(task)
    rows: list[dict[str, Any]] = []
    first: Result = {}
    for index, one in enumerate(tracking.windows_of(task)):
        draws, weights, mass = posterior(method, one.training, task.settings["draws"], task.seed + index)
        weight = np.exp(weights.log_weight[0])
        mean = weight @ draws
        row: dict[str, Any] = {"k": float(np.ravel(weights.k)[0]), "ess": float(np.ravel(weights.ess)[0]),
                               "modes": len(mass), "beyond": float(mass[1:].sum()),
                               "posterior_mean": mean, "posterior_sd": np.sqrt(weight @ (draws - mean) ** 2)}
        chosen = draws[importance.resample(weights.log_weight, task.settings["mixed"], task.seed + index)]
        rows.append(row | _judged(method, chosen, one))
        if index == 0:
            best = tracking.learn(method, one.training)
            shape = tracking.shapes(method, best.z, one.y["constant"], TESTED["constant"])
            first = {"shapes": shape.arrivals, "shapes_sd": shape.arrivals_sd}
    return stacked(rows) | first


def compute_nuts(task: Task) -> Result:
    """Return the entries of `judge` of one window for both tests, and those of `chains.sample`."""
    method, (one,) = tracking.method_of(task), tracking.windows_of(task)
    count, warmup, draws = task.settings["chains"]

    def model(y: np.ndarray) -> None:
        problem.model_file().model(problem.TRAINING, y, **method._asdict())

    mcmc = MCMC(chains.nuts(model, target_accept_prob=task.settings["accepted"]), num_warmup=warmup, num_samples=draws,
                num_chains=count, chain_method="sequential", progress_bar=False)
    start_key, run_key = jax.random.split(task.key)
    near = tracking.learn(method, one.training, prior=1.0).z
    found = chains.sample(mcmc, method.names, run_key, one.training,
                          init_params=chains.starts(method.names, near, count, start_key))
    return found | _judged(method, scores.spread(found["draws"], task.settings["mixed"]), one)


def _judged(method: Method, several: np.ndarray, one: Window) -> dict[str, float]:
    """Return the entries of `judge` for both tests, with its name before them."""
    row: dict[str, float] = {}
    for name, tested in TESTED.items():
        found = [tracking.track(method, z, one.y[name], tested) for z in several]
        row |= {f"{name}_{key}": value for key, value in judge(found, one, name).items()}
    return row


def posterior(method: Method, y: np.ndarray, count: int, seed: int) -> Weighted:
    """Return weighted draws (count, P) of z, about all modes that are found.

    Args:
        method: the model of the arrivals.
        y: (63, 1) logarithms of the readings of the training.
        count: draws that are weighted.
        seed: of them.
    """
    density = problem.posterior(method).log_densities_of
    return weighted(lambda draws: np.sum(density(draws, y), axis=0), modes(method, y), count, seed)


def modes(method: Method, y: np.ndarray) -> list[Minimum]:
    """Return the modes of the posterior with their curvature, the highest first; arguments as `posterior`.

    A lower one without a positive definite curvature is none, but the edge of what is allowed or of a search.
    """
    objective = problem.posterior(method).objective(y)

    def with_curvature(point: np.ndarray) -> Minimum:
        value, gradient = objective.value_and_gradient(point)
        return Minimum(point, value, objective.curvature(point), 0.0, np.zeros_like(point), gradient)

    highest, *lower = [with_curvature(one.z) for one in tracking.modes(method, y, prior=1.0)]
    return [highest, *(mode for mode in lower if mode.curvature is not None and mode.curvature.definite)]


def judge(found: list[Tracked], one: Window, name: str) -> dict[str, float]:
    """Return how good a mixture of estimates is, the same as `tracking.judge` of one."""
    test = slice(FIRST + 1, None)
    queue, arrivals = one.queues[name][test], one.arrivals[FIRST:]
    mean, sd = (np.array([getattr(part, key)[test] for part in found]) for key in ("log_queue", "log_queue_sd"))
    rate, rate_sd = (np.array([getattr(part, key)[test] for part in found]) for key in ("arrivals", "arrivals_sd"))
    low, middle, high = np.expm1(np.maximum(quantiles(mean, sd, np.array([0.025, 0.5, 0.975])), 0.0))
    rate_low, rate_high = quantiles(rate, rate_sd, np.array([0.025, 0.975]))
    x = np.log1p(queue)
    density = special.logsumexp(stats.norm(mean, sd).logpdf(x), axis=0) - np.log(len(found)) - x
    return {"rmse": scores.rmse(middle, queue), "coverage": scores.covered(low, high, queue),
            "ell": float(density.sum()), "rate_rmse": scores.rmse(rate.mean(axis=0), arrivals),
            "rate_coverage": scores.covered(rate_low, rate_high, arrivals)}


def quantiles(mean: np.ndarray, sd: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return quantiles (Q, K) of equal mixtures of normal distributions with mean and sd (S, K), by bisection.

    Example:
        >>> quantiles(np.array([[1.0], [3.0]]), np.ones((2, 1)), np.array([0.5])).round(6).tolist()
        [[2.0]]
    """
    shape = (len(p), mean.shape[1])
    low = np.broadcast_to((mean - 10 * sd).min(axis=0), shape)
    high = np.broadcast_to((mean + 10 * sd).max(axis=0), shape)
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = special.ndtr((middle[:, None] - mean) / sd).mean(axis=1) < p[:, None]
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return 0.5 * (low + high)
