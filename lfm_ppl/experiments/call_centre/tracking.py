"""Learn from three days, track the fourth: one method on one window.

Tracking is filtering: at every five minutes of the test day the queue and the rate of arrivals are estimated from the
readings up to then, so that the longest prediction is one of three hours. The parameters are those most likely given
the training, and stay. The model's state is x = log(1 + L) with the queue L, so that L has a shifted log-normal
distribution: its median is the estimate, its quantiles are the bands.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize, stats

from lfm_ppl.experiments import scores
from lfm_ppl.experiments.call_centre import problem
from lfm_ppl.experiments.call_centre.problem import FIRST, GRID, TESTED, Method, Window
from lfm_ppl.experiments.tasks import Result
from lfm_ppl.filtering.filter import filter
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.linalg import congruence, matmul
from lfm_ppl.model.augment import state_space

METHODS = {"SQM": "sqm", "CQM": "cqm", "WQM": "wqm", "periodic": "periodic", "Matern": "matern",
           "resonator": "resonator"}
"""Method -> force of the model file."""

QUASI = ("SQM", "CQM", "WQM")

LIMITS = {"mean": (1.0, 6.0, 30.0), "scale": (0.1, 2.0, 30.0), "lengthscale": (10.0, 150.0, 10_000.0),
          "memory": (0.2, 10.0, 10_000.0), "noise_sd": (0.01, 0.5, 5.0)}
"""Parameter -> least value, where the search starts, and largest value."""

STEPS = 3
"""Integration steps in five minutes, about as long as those of the model file."""


class Learnt(NamedTuple):
    """The most likely parameters.

    Attributes:
        z: (P,) their logarithms.
        log_likelihood: of the training.
        evaluations: of likelihood and gradient.
        at_limit: whether one of them lies at the edge of `LIMITS`.
    """

    z: np.ndarray
    log_likelihood: float
    evaluations: int
    at_limit: bool


def learn(method: Method, y: np.ndarray) -> Learnt:
    """Return the most likely parameters within `LIMITS`.

    Args:
        method: the model of the arrivals.
        y: (63, 1) logarithms of the readings of the training.
    """
    low, start, high = np.log([LIMITS[name] for name in method.names]).T
    energy = _energy(method)

    def value_and_gradient(z: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = energy(jnp.asarray(z), jnp.asarray(y))
        # A wall of moderate height, from which the line search turns back.
        return (float(value), np.asarray(gradient)) if np.isfinite(value) else (1e6, np.zeros_like(z))

    found = optimize.minimize(value_and_gradient, start, jac=True, method="L-BFGS-B",
                              bounds=list(zip(low, high, strict=True)), options={"ftol": 1e-9, "gtol": 1e-4})
    edge = np.minimum(found.x - low, high - found.x).min() < 1e-6
    return Learnt(found.x, -float(found.fun), int(found.nfev), bool(edge))


@functools.cache
def _energy(method: Method) -> Callable:
    """Return minus the log likelihood with its gradient, compiled once for all windows."""
    return jax.jit(jax.value_and_grad(lambda z, y: -problem.log_densities(method, z, y)[0]))


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


def compute(method: Method, one: Window) -> Result:
    """Return what a method finds of a window: see `Learnt`, `Tracked` and `judge`, under the names of both tests."""
    learnt = learn(method, one.training)
    result: Result = {"z": learnt.z, "log_likelihood": learnt.log_likelihood, "evaluations": learnt.evaluations,
                      "at_limit": learnt.at_limit}
    for name, tested in TESTED.items():
        found = track(method, learnt.z, one.y[name], tested)
        result |= {f"{name}_{key}": value for key, value in judge(found, one, name).items()}
        result |= {f"{name}_{key}": value for key, value in found._asdict().items()}
    return result
