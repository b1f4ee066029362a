"""Learn from three days, track the fourth: one method on one window.

Tracking is filtering: at every five minutes of the test day the queue and the rate of arrivals are estimated from the
readings up to then, so that the longest prediction is one of three hours. The parameters are those most likely given
the training, and stay. The model's state is x = log(1 + L) with the queue L, so that L has a shifted log-normal
distribution: its median is the estimate, its quantiles are the bands.
"""

from __future__ import annotations

import functools
import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from lfm_ppl.engine.task import Result, Task
from lfm_ppl.experiments import scores
from lfm_ppl.experiments.call_centre import counts, problem
from lfm_ppl.experiments.call_centre.problem import FIRST, GRID, TESTED, Method, Window
from lfm_ppl.experiments.study import stacked
from lfm_ppl.filtering.filter import filter
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.inference.optimise import quasi_newton
from lfm_ppl.linalg import congruence, matmul
from lfm_ppl.model.state_space import state_space

METHODS = {"SQM": "sqm", "CQM": "cqm", "WQM": "wqm", "periodic": "periodic", "Matern": "matern",
           "resonator": "resonator"}
"""Method -> force of the model file."""

LIMITS = {"mean": (1.0, 30.0), "scale": (0.1, 30.0), "lengthscale": (10.0, 10_000.0), "memory": (0.2, 10_000.0),
          "noise_sd": (0.01, 5.0)}
"""Parameter -> least and largest value."""

STARTS = (
    {"mean": 6.0, "scale": 2.0, "lengthscale": 150.0, "memory": 10.0, "noise_sd": 2.0},
    {"mean": 4.0, "scale": 3.5, "lengthscale": 220.0, "memory": 1.0, "noise_sd": 1.5},
    {"mean": 7.0, "scale": 1.3, "lengthscale": 110.0, "memory": 60.0, "noise_sd": 1.0},
)
"""Where searches start: cycles somewhat alike, hardly alike, and nearly the same. From a small noise a search gets lost
where cycles differ more than a model allows."""

SAME = 0.1
"""Ends of searches that differ by less than this in every logarithm are the same mode."""

FAR = 7.0
"""Modes that are so much lower in log density than the highest are left out: below a thousandth of it. Unless they are
much wider, they hold next to nothing."""

STEPS = 3
"""Integration steps in five minutes, about as long as those of the model file."""

_SEARCH = {"ftol": 1e-7, "gtol": 1e-3, "maxfun": 60}


class Learnt(NamedTuple):
    """Where a search ended.

    Attributes:
        z: (P,) logarithms of the parameters.
        log_likelihood: of the training; with the log prior density of z where that was asked for.
        evaluations: of it and its gradient.
    """

    z: np.ndarray
    log_likelihood: float
    evaluations: int


def learn(method: Method, y: np.ndarray, prior: float = 0.0) -> Learnt:
    """Return the most likely parameters within `LIMITS`, with the evaluations of all searches; otherwise as `modes`."""
    found = _searches(method, y, prior)
    return found[0]._replace(evaluations=sum(one.evaluations for one in found))


def modes(method: Method, y: np.ndarray, prior: float = 0.0) -> list[Learnt]:
    """Return the different modes within `LIMITS` that searches from `STARTS` find, the highest first.

    Args:
        method: the model of the arrivals.
        y: (63, 1) logarithms of the readings of the training.
        prior: 0 for maxima of the likelihood, 1 for those of the posterior density of z.

    Raises:
        ValueError: the density is not finite wherever a search starts.
    """
    found = _searches(method, y, prior)
    kept: list[Learnt] = []
    for one in found:
        high = found[0].log_likelihood - one.log_likelihood < FAR
        if high and all(np.abs(one.z - other.z).max() > SAME for other in kept):
            kept.append(one)
    return kept


def _searches(method: Method, y: np.ndarray, prior: float) -> list[Learnt]:
    """Return the ends of all searches, the highest first."""
    bounds, found = np.log([LIMITS[name] for name in method.names]), []
    for start in STARTS:
        objective = problem.posterior(method).objective(y, prior)
        end = quasi_newton(objective, np.log([start[name] for name in method.names]), bounds=bounds, options=_SEARCH)
        if np.isfinite(end.value):
            found.append(Learnt(end.point, -end.value, objective.evaluations))
    if not found:
        raise ValueError(f"the likelihood is not finite wherever a search for the parameters of {method.force} starts; "
                         "are there readings that no queue can have?")
    return sorted(found, key=lambda one: -one.log_likelihood)


class Tracked(NamedTuple):
    """What a filter says on `GRID`.

    Attributes:
        log_queue: (T,) mean of log(1 + customers).
        log_queue_sd: (T,).
        arrivals: (T,) mean rate of arrivals (customers/min).
        arrivals_sd: (T,).
    """

    log_queue: np.ndarray
    log_queue_sd: np.ndarray
    arrivals: np.ndarray
    arrivals_sd: np.ndarray

    def queue(self, deviations: float = 0.0) -> np.ndarray:
        """Return customers (T,), so many standard deviations above the median."""
        return np.expm1(np.maximum(self.log_queue + deviations * self.log_queue_sd, 0.0))


def track(method: Method, z: np.ndarray, y: np.ndarray, tested: tuple[float, float]) -> Tracked:
    """Filter a window.

    Args:
        method: the model of the arrivals.
        z: logarithms of its parameters.
        y: (673, 1) logarithms of readings on `GRID`, NaN where there is none.
        tested: service rates in the halves of the test day.
    """
    found = _tracker(method)(jnp.asarray(z), jnp.asarray(y), jnp.asarray(tested))
    return Tracked(*map(np.asarray, found))


@functools.cache
def _tracker(method: Method) -> Callable:
    def run(z: jax.Array, y: jax.Array, tested: jax.Array) -> tuple[jax.Array, ...]:
        model = problem.system(method, z, tested)
        passed = filter(model, GRID, y, steps=STEPS)
        return _estimates(method, model, passed.filtered_mean, passed.filtered_covariance)

    return jax.jit(run)


def shapes(method: Method, z: np.ndarray, y: np.ndarray, tested: tuple[float, float]) -> Tracked:
    """Smooth a window, given all of its readings; otherwise as `track`."""
    return Tracked(*map(np.asarray, _smoother(method)(jnp.asarray(z), jnp.asarray(y), jnp.asarray(tested))))


@functools.cache
def _smoother(method: Method) -> Callable:
    def run(z: jax.Array, y: jax.Array, tested: jax.Array) -> tuple[jax.Array, ...]:
        model = problem.system(method, z, tested)
        found = smooth(model, GRID, y, steps=STEPS)
        return _estimates(method, model, found.mean, found.covariance)

    return jax.jit(run)


def _estimates(method: Method, model: Any, mean: jax.Array, covariance: jax.Array) -> tuple[jax.Array, ...]:
    """Return means and standard deviations of queue and arrivals from those of the joint state."""
    ssm = state_space(model)

    def at(t: jax.Array, m: jax.Array, p: jax.Array) -> tuple[jax.Array, ...]:
        matrix, offset = ssm.input_map(t)
        return matmul(matrix, m[:, None])[:, 0] + offset, congruence(matrix, p)

    centre, spread = jax.vmap(at)(jnp.asarray(GRID), mean, covariance)
    sd = jnp.sqrt(jnp.maximum(jnp.diagonal(spread, axis1=1, axis2=2), 0.0))
    rate, rate_sd = centre[:, 1], sd[:, 1]
    if method.link == "softplus":
        nodes, weights = np.polynomial.hermite_e.hermegauss(20)
        values = jax.nn.softplus(rate[:, None] + rate_sd[:, None] * nodes)
        rate = values @ (weights / weights.sum())
        rate_sd = jnp.sqrt((values - rate[:, None]) ** 2 @ (weights / weights.sum()))
    return centre[:, 0], sd[:, 0], rate, rate_sd


def judge(found: Tracked, one: Window, name: str) -> dict[str, float]:
    """Return how good the estimates of the test day are, at the ends of its five-minute counts.

    Returns:
        ``rmse`` and ``coverage`` of the 95% bands, of the queue and (``rate_``) of the arrivals; ``ell``, the log
        density of the true queue, summed over these times; and ``largest``, the longest true queue.
    """
    test, z = slice(FIRST + 1, None), scores.Z
    queue, arrivals = one.queues[name][test], one.arrivals[FIRST:]
    # The density of L is that of x = log(1 + L) times dx/dL = exp(-x).
    x, rate, rate_sd = np.log1p(queue), found.arrivals[test], found.arrivals_sd[test]
    density = stats.norm(found.log_queue[test], found.log_queue_sd[test]).logpdf(x) - x
    return {"rmse": scores.rmse(found.queue()[test], queue),
            "coverage": scores.covered(found.queue(-z)[test], found.queue(z)[test], queue),
            "ell": float(density.sum()), "rate_rmse": scores.rmse(rate, arrivals),
            "rate_coverage": scores.covered(rate - z * rate_sd, rate + z * rate_sd, arrivals),
            "largest": float(queue.max())}


def tasks(settings: Any) -> list[Task]:
    """Return one task for each method: what is compiled for it serves all windows."""
    return [Task(f"track/{name}", settings.seed, {
        "experiment": "call-centre", "what": "track", "method": name, "link": settings.link,
        "functions": settings.functions, "starts": len(STARTS), **settings.windows()}) for name in settings.methods]


def method_of(task: Task) -> Method:
    """Return the method of a task."""
    return Method(METHODS[task.settings["method"]], task.settings["link"], task.settings["functions"])


def windows_of(task: Task) -> list[Window]:
    """Return the windows of a task; what is warned of them is said once, by the experiment."""
    given = task.settings
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", counts.OverloadWarning)
        return [problem.window(given["data"], given["weekday"], given["first"] + index, task.seed)
                for index in range(given["count"])]


def compute(task: Task) -> Result:
    """Return what a method finds of all windows.

    Returns:
        ``z`` (N, P), ``log_likelihood`` (N,), and for both tests, with its name before it, the entries of `judge` (N,)
        and those of `Tracked` of the first window; CPU ``seconds`` of all windows but the first, which compiles.
    """
    method = method_of(task)
    first: Result = {}
    rows: list[dict[str, Any]] = []
    for one in windows_of(task):
        began = time.process_time()
        learnt = learn(method, one.training)
        row: dict[str, Any] = {"z": learnt.z, "log_likelihood": learnt.log_likelihood,
                               "evaluations": learnt.evaluations}
        for name, tested in TESTED.items():
            found = track(method, learnt.z, one.y[name], tested)
            row |= {f"{name}_{key}": value for key, value in judge(found, one, name).items()}
            if not rows:
                first |= {f"{name}_{key}": value for key, value in found._asdict().items()}
        rows.append(row | {"seconds": time.process_time() - began})
    return stacked(rows) | first
