"""Track the test day, with the parameters that are most likely given three days of training, or marginalised.

1. Tracking is filtering: at every five minutes of the test day the queue and the rate of arrivals are estimated from
   the readings so far. The longest prediction is three hours ahead.
2. The state of the model is x = log(1 + L) for the queue L, which is Gaussian. L then has a shifted log-normal
   distribution: its median is the estimate, and its quantiles are the bands.
3. Marginalised parameters: filter the test day for every posterior draw, and mix the estimates with equal weights.
4. The draws are importance samples. In the first windows NUTS draws are used as well; the two must agree where the
   posterior has one mode. Chains of this length cannot determine the shares of several modes.

Source: Reece and others (2014), JMLR 15, section 8.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import lfm_ppl as lfm
from lfm_ppl.model.state_space import state_space
from lfm_ppl.parallel.task import Result, Task
from lfm_ppl.switching.mixture import Mixture
from lfm_ppl.utils.linalg import congruence, matmul

from .. import chains, scores
from ..tasks import dataset_indices, stack_results
from . import problem
from .learning import run_searches, sample_posterior
from .problem import GRID, TEST_RATES, TEST_START, ArrivalModel, CallWindow

STEPS = 3
"""Integration steps in five minutes; their length is close to that of the model file."""

TARGET_ACCEPTANCE = 0.95
"""Acceptance probability that NUTS aims at. Its steps must be short near the boundary of the posterior, where arrivals
exceed service and the log density falls by hundreds within a few standard deviations."""


class QueueEstimate(NamedTuple):
    """Estimates on `GRID`.

    Attributes:
        log_queue: means (T,) of log(1 + customers).
        log_queue_sd: their standard deviations.
        arrivals: means (T,) of the rate of arrivals (1/min).
        arrivals_sd: their standard deviations.
    """

    log_queue: Any
    log_queue_sd: Any
    arrivals: Any
    arrivals_sd: Any


def customers(log_queue: Any) -> Any:
    """Return the queue for x = log(1 + customers); bands may extend to negative x, where the queue is zero."""
    return np.expm1(np.maximum(log_queue, 0.0))


@functools.partial(jax.jit, static_argnames=("arrival_model", "is_smoothed"))
def track(arrival_model: ArrivalModel, z: Any, y: Any, test_rates: Any, is_smoothed: bool = False) -> QueueEstimate:
    """Filter or smooth a window.

    Args:
        arrival_model: model of the arrivals.
        z: logarithms of its parameters.
        y: readings (673, 1) on `GRID` as logarithms, NaN where there is none.
        test_rates: service rates in the two halves of the test day.
        is_smoothed: whether to smooth instead of filter.
    """
    model = problem.build_model(arrival_model, z, jnp.array(test_rates))
    path: Any = (lfm.smooth if is_smoothed else lfm.filter)(model, GRID, y, steps=STEPS)
    states = (path.mean, path.covariance) if is_smoothed else (path.filtered_mean, path.filtered_covariance)
    ssm = state_space(model)

    def queue_and_arrivals(t: jax.Array, m: jax.Array, p: jax.Array) -> tuple[jax.Array, jax.Array]:
        matrix, offset = ssm.input_map(t)
        return matmul(matrix, m[:, None])[:, 0] + offset, congruence(matrix, p)

    mean, covariance = jax.vmap(queue_and_arrivals)(jnp.asarray(GRID), *states)
    sd = jnp.sqrt(jnp.maximum(jnp.diagonal(covariance, axis1=1, axis2=2), 0.0))
    rate, rate_sd = mean[:, 1], sd[:, 1]
    if arrival_model.link == "softplus":
        nodes, weights = np.polynomial.hermite_e.hermegauss(20)
        values = jax.nn.softplus(rate[:, None] + rate_sd[:, None] * nodes)
        rate = values @ (weights / weights.sum())
        rate_sd = jnp.sqrt((values - rate[:, None]) ** 2 @ (weights / weights.sum()))
    return QueueEstimate(mean[:, 0], sd[:, 0], rate, rate_sd)


def score_mixture(estimates: Sequence[QueueEstimate], window: CallWindow, test: str) -> dict[str, float]:
    """Return the scores of an equal mixture of estimates on the test day, at the ends of its five-minute counts.

    Returns:
        For the queue ``rmse`` of the median, ``coverage`` of the 95% bands, and ``ell``, the sum of the log
        densities of the true queue; for the arrivals ``rate_rmse`` of the mean and ``rate_coverage`` of the 95% bands.
    """
    test_day = slice(TEST_START + 1, None)
    queue, arrivals = window.queues[test][test_day], window.arrivals[TEST_START:]
    mean, sd, rate, rate_sd = (jnp.stack(entry, axis=1)[test_day, :, None] for entry in zip(*estimates, strict=True))
    log_weights = jnp.full(mean.shape[:2], -np.log(len(estimates)))
    log_queues, rates = Mixture(mean, sd**2, log_weights), Mixture(rate, rate_sd**2, log_weights)
    low, median, high = customers(np.asarray(log_queues.quantiles([0.025, 0.5, 0.975]))[:, :, 0])
    rate_low, rate_high = np.asarray(rates.quantiles([0.025, 0.975]))[:, :, 0]
    # The density of L is that of x = log(1 + L) times dx/dL = exp(-x).
    x = np.log1p(queue)
    density = np.asarray(log_queues.log_density(x[:, None]))[:, 0] - x
    return {"rmse": scores.rmse(median, queue), "coverage": scores.interval_coverage(low, high, queue),
            "ell": density.sum(),
            "rate_rmse": scores.rmse(rate.mean(axis=1)[:, 0], arrivals),
            "rate_coverage": scores.interval_coverage(rate_low, rate_high, arrivals)}


def build_arrival_model(task: Task) -> ArrivalModel:
    """Return the model of the arrivals for a task."""
    return ArrivalModel(task.settings["method"].lower(), task.settings["link"], task.settings["functions"])


def build_windows(task: Task) -> list[CallWindow]:
    """Return the windows of a task."""
    data, weekday = task.settings["data"], task.settings["weekday"]
    return [problem.build_window(data, weekday, index, task.seed) for index in dataset_indices(task)]


def track_most_likely(task: Task) -> Result:
    """Return the results of a method with its most likely parameters, for all windows.

    Returns:
        ``z``, the log likelihood, and its number of ``evaluations``; the entries of `score_draws`; ``{test}_largest``,
        the longest true queue; CPU ``seconds``, for the first window with compilation; and the entries of
        `QueueEstimate` for the first window, with the prefix ``{test}_``.
    """
    arrival_model, windows, rows = build_arrival_model(task), build_windows(task), []
    for window in windows:
        start = time.process_time()
        (best, *_), evaluations = run_searches(arrival_model, window.training)
        window_scores = score_draws(arrival_model, best.point[None], window)
        largest = {f"{test}_largest": queue[TEST_START + 1:].max() for test, queue in window.queues.items()}
        rows.append({"z": best.point, "log_likelihood": -best.value, "evaluations": evaluations, **window_scores,
                     **largest, "seconds": time.process_time() - start})
    estimates = {test: track(arrival_model, rows[0]["z"], windows[0].y[test], rates)
                 for test, rates in TEST_RATES.items()}
    return stack_results(rows) | {f"{test}_{name}": np.asarray(value) for test, estimate in estimates.items()
                                  for name, value in estimate._asdict().items()}


def track_marginalised(task: Task) -> Result:
    """Return the results of a method with marginalised parameters, for all windows.

    Returns:
        The Pareto index ``k`` and the effective sample size ``ess`` of the importance samples (N,), the number of
        ``modes`` and the posterior share ``beyond`` the highest mode (N,), ``posterior_mean`` and ``posterior_sd`` of z
        (N, P), and the entries of `score_draws`; for the first window the smoothed arrivals ``shapes`` and
        ``shapes_sd`` (673,) at the most likely parameters.
    """
    arrival_model, windows, rows = build_arrival_model(task), build_windows(task), []
    for seed, window in enumerate(windows, task.seed):
        weighted = sample_posterior(arrival_model, window.training, task.settings["draws"], seed)
        draws = weighted.resampled(task.settings["mixed"], seed)
        rows.append({**weighted.summary, "modes": len(weighted.mixture_weights),
                     "beyond": weighted.mixture_weights[1:].sum(), **score_draws(arrival_model, draws, window)})
    (best, *_), _ = run_searches(arrival_model, windows[0].training)
    path = track(arrival_model, best.point, windows[0].y["constant"], TEST_RATES["constant"], is_smoothed=True)
    return stack_results(rows) | {"shapes": np.asarray(path.arrivals), "shapes_sd": np.asarray(path.arrivals_sd)}


def track_by_nuts(task: Task) -> Result:
    """Return the entries of `score_draws` and of `chains.sample` for one window."""
    arrival_model, (window,) = build_arrival_model(task), build_windows(task)
    count, warmup, draws = task.settings["chains"]

    def model(y: np.ndarray) -> None:
        problem.model_file().model(problem.TRAINING_TIMES, y, **arrival_model._asdict())

    mcmc = chains.sampler(chains.nuts(model, target_accept_prob=task.settings["accepted"]), count, warmup, draws)
    start_key, run_key = jax.random.split(task.key)
    (mode, *_), _ = run_searches(arrival_model, window.training, prior=1.0)
    starts = chains.draw_starts(arrival_model.names, mode.point, count, start_key)
    sample = chains.sample(mcmc, arrival_model.names, run_key, window.training, init_params=starts)
    return sample | score_draws(arrival_model, scores.thin_draws(sample["draws"], task.settings["mixed"]), window)


def score_draws(arrival_model: ArrivalModel, draws: np.ndarray, window: CallWindow) -> dict[str, float]:
    """Return the entries of `score_mixture` for the mixture over draws of z (S, P), with the prefix ``{test}_``."""
    row: dict[str, float] = {}
    for test, rates in TEST_RATES.items():
        estimates = [track(arrival_model, z, window.y[test], rates) for z in draws]
        row |= {f"{test}_{name}": value for name, value in score_mixture(estimates, window, test).items()}
    return row
