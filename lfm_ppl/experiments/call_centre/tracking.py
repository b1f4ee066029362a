"""Track the fourth day, with the parameters that are most likely given the first three, or marginalised.

Tracking is filtering: at every five minutes of the test day the queue and the rate of arrivals are estimated from the
readings up to then, so that the longest prediction is one of three hours. The model's state is x = log(1 + L) with the
queue L, so that L has a shifted log-normal distribution: its median is the estimate, its quantiles are the bands.

Where parameters are marginalised, draws of them track the test day, and the estimates of all, mixed, stand for the
prediction. The draws are importance samples, and in the first windows those of NUTS, too, which they must agree with
where there is one mode (chains are far too short to tell how much of the posterior is about each of several).
"""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import chains, scores
from lfm_ppl.experiments.call_centre import problem
from lfm_ppl.experiments.call_centre.learning import posterior, searches
from lfm_ppl.experiments.call_centre.problem import FIRST, GRID, TESTED, Method, Window
from lfm_ppl.experiments.tasks import dataset_indices, stack_results
from lfm_ppl.filtering.filter import filter
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.linalg import congruence, matmul
from lfm_ppl.model.state_space import state_space
from lfm_ppl.switching.mixture import Mixture

STEPS = 3
"""Integration steps in five minutes, about as long as those of the model file."""

ACCEPTED = 0.95
"""Acceptance that NUTS aims at: steps fine enough for the walls of the posterior, where arrivals exceed what is served
and the log density falls by hundreds within a few standard deviations."""


class Tracked(NamedTuple):
    """Means and standard deviations (T,) on `GRID`: of log(1 + customers), and of the rate of arrivals (1/min)."""

    log_queue: Any
    log_queue_sd: Any
    arrivals: Any
    arrivals_sd: Any


def customers(log_queue: Any) -> Any:
    """Return the queue from x = log(1 + customers), which a band may take below zero."""
    return np.expm1(np.maximum(log_queue, 0.0))


@functools.partial(jax.jit, static_argnames=("method", "smoothed"))
def track(method: Method, z: Any, y: Any, tested: Any, smoothed: bool = False) -> Tracked:
    """Filter a window, or smooth it, with parameters exp(z) and service rates ``tested`` in the halves of the test day.

    The readings y (673, 1) are logarithms on `GRID`, NaN where there is none.
    """
    model = problem.system(method, z, jnp.array(tested))
    path: Any = (smooth if smoothed else filter)(model, GRID, y, steps=STEPS)
    states = (path.mean, path.covariance) if smoothed else (path.filtered_mean, path.filtered_covariance)
    ssm = state_space(model)

    def queue_and_arrivals(t: jax.Array, m: jax.Array, p: jax.Array) -> tuple[jax.Array, jax.Array]:
        matrix, offset = ssm.input_map(t)
        return matmul(matrix, m[:, None])[:, 0] + offset, congruence(matrix, p)

    mean, covariance = jax.vmap(queue_and_arrivals)(jnp.asarray(GRID), *states)
    sd = jnp.sqrt(jnp.maximum(jnp.diagonal(covariance, axis1=1, axis2=2), 0.0))
    rate, rate_sd = mean[:, 1], sd[:, 1]
    if method.link == "softplus":
        nodes, weights = np.polynomial.hermite_e.hermegauss(20)
        values = jax.nn.softplus(rate[:, None] + rate_sd[:, None] * nodes)
        rate = values @ (weights / weights.sum())
        rate_sd = jnp.sqrt((values - rate[:, None]) ** 2 @ (weights / weights.sum()))
    return Tracked(mean[:, 0], sd[:, 0], rate, rate_sd)


def judge(parts: Sequence[Tracked], window: Window, test: str) -> dict[str, float]:
    """Return how good an equal mixture of estimates of the test day is, at the ends of its five-minute counts.

    These are ``rmse`` of the median and ``coverage`` of the 95% bands of the queue, ``ell``, the log density of the
    true queue, summed over these times, and ``rate_rmse`` of the mean and ``rate_coverage`` of the arrivals.
    """
    ends = slice(FIRST + 1, None)
    queue, arrivals = window.queues[test][ends], window.arrivals[FIRST:]
    mean, sd, rate, rate_sd = (jnp.stack(entry, axis=1)[ends, :, None] for entry in zip(*parts, strict=True))
    even = jnp.full(mean.shape[:2], -np.log(len(parts)))
    logarithms, rates = Mixture(mean, sd**2, even), Mixture(rate, rate_sd**2, even)
    low, middle, high = customers(np.asarray(logarithms.quantiles([0.025, 0.5, 0.975]))[:, :, 0])
    rate_low, rate_high = np.asarray(rates.quantiles([0.025, 0.975]))[:, :, 0]
    # The density of L is that of x = log(1 + L) times dx/dL = exp(-x).
    x = np.log1p(queue)
    density = np.asarray(logarithms.log_density(x[:, None]))[:, 0] - x
    return {"rmse": scores.rmse(middle, queue), "coverage": scores.interval_coverage(low, high, queue),
            "ell": density.sum(),
            "rate_rmse": scores.rmse(rate.mean(axis=1)[:, 0], arrivals),
            "rate_coverage": scores.interval_coverage(rate_low, rate_high, arrivals)}


def method_of(task: Task) -> Method:
    """Return the method of a task."""
    return Method(task.settings["method"].lower(), task.settings["link"], task.settings["functions"])


def windows_of(task: Task) -> list[Window]:
    """Return the windows of a task."""
    data, weekday = task.settings["data"], task.settings["weekday"]
    return [problem.window(data, weekday, index, task.seed) for index in dataset_indices(task)]


def most_likely(task: Task) -> Result:
    """Return what a method finds of all windows with its most likely parameters.

    These are z, the log likelihood, and the evaluations of it, the entries of `mixed`, and ``largest``, the longest
    true queue, by test; CPU ``seconds``, the first with compilation; the entries of `Tracked` of the first window, by
    test.
    """
    method, windows, rows = method_of(task), windows_of(task), []
    for window in windows:
        began = time.process_time()
        (best, *_), evaluations = searches(method, window.training)
        scored = mixed(method, best.point[None], window)
        largest = {f"{test}_largest": queue[FIRST + 1:].max() for test, queue in window.queues.items()}
        rows.append({"z": best.point, "log_likelihood": -best.value, "evaluations": evaluations, **scored, **largest,
                     "seconds": time.process_time() - began})
    tracked = {test: track(method, rows[0]["z"], windows[0].y[test], rates) for test, rates in TESTED.items()}
    return stack_results(rows) | {f"{test}_{name}": np.asarray(value) for test, path in tracked.items()
                                  for name, value in path._asdict().items()}


def marginalised(task: Task) -> Result:
    """Return what the posterior says of all windows, and the entries of `mixed`.

    Of the importance samples these are the Pareto index ``k`` and ``ess``, the number of ``modes`` and the share of the
    posterior ``beyond`` the highest of them (N,), ``posterior_mean`` and ``posterior_sd`` of z (N, P); of the first
    window the arrivals ``shapes`` and ``shapes_sd`` (673,), smoothed at the most likely parameters.
    """
    method, windows, rows = method_of(task), windows_of(task), []
    for seed, window in enumerate(windows, task.seed):
        found = posterior(method, window.training, task.settings["draws"], seed)
        rows.append({**found.summary, "modes": len(found.mixture_weights), "beyond": found.mixture_weights[1:].sum(),
                     **mixed(method, found.resampled(task.settings["mixed"], seed), window)})
    (best, *_), _ = searches(method, windows[0].training)
    path = track(method, best.point, windows[0].y["constant"], TESTED["constant"], smoothed=True)
    return stack_results(rows) | {"shapes": np.asarray(path.arrivals), "shapes_sd": np.asarray(path.arrivals_sd)}


def by_nuts(task: Task) -> Result:
    """Return the entries of `mixed` of one window, and those of `chains.sample`."""
    method, (window,) = method_of(task), windows_of(task)
    count, warmup, draws = task.settings["chains"]

    def model(y: np.ndarray) -> None:
        problem.model_file().model(problem.TRAINING, y, **method._asdict())

    mcmc = chains.sampler(chains.nuts(model, target_accept_prob=task.settings["accepted"]), count, warmup, draws)
    start_key, run_key = jax.random.split(task.key)
    (near, *_), _ = searches(method, window.training, prior=1.0)
    starts = chains.draw_starts(method.names, near.point, count, start_key)
    found = chains.sample(mcmc, method.names, run_key, window.training, init_params=starts)
    return found | mixed(method, scores.thin_draws(found["draws"], task.settings["mixed"]), window)


def mixed(method: Method, several: np.ndarray, window: Window) -> dict[str, float]:
    """Return the entries of `judge` of several z (S, P), mixed, by test: with its name before theirs."""
    row: dict[str, float] = {}
    for test, rates in TESTED.items():
        parts = [track(method, z, window.y[test], rates) for z in several]
        row |= {f"{test}_{name}": value for name, value in judge(parts, window, test).items()}
    return row
