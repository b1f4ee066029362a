"""The estimators, each compiled once for blocks of records: estimate and ends of the 95% band of the force."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from scipy.optimize import minimize_scalar

from lfm_ppl.constrained.full_information import ConstrainedEstimate, full_information
from lfm_ppl.constrained.posterior import ConstrainedPosterior, constrained_posterior
from lfm_ppl.experiments.constrained import problem
from lfm_ppl.experiments.constrained.problem import FACTOR, TIMES, WINDOW
from lfm_ppl.experiments.scores import Z
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.linearisation.sigma_points import GaussHermite

EARLY, HORIZON, HORIZON_RATE, RATE, RATE_IN_Q, SMOOTHER, FULL, BANDS, LINK = (
    "smoother, 60 samples", "delayed MHE, 60 samples", "delayed MHE, rate a state", "full information, rate a state",
    "full information, rate in Q", "smoother", "full information", "EP", "softplus link")
METHODS = {EARLY: "early", HORIZON: "early", HORIZON_RATE: "window", RATE: "record", RATE_IN_Q: "weight",
           SMOOTHER: "all", FULL: "all", BANDS: "all", LINK: "softplus"}
"""Estimator -> its hyperparameters: a kind of `problem.learning`, or of `states`."""

STATES = ("window", "record", "weight")
"""Kinds of lengthscales that are constant states of the cost."""

ROWS = dict.fromkeys(METHODS, 1) | {BANDS: 10}
"""Estimator -> of how many samples one has an estimate."""

_BELOW = np.array([0.0, 0.01, 0.025, 0.04])
"""Shares below a 95% band, among which the shortest one is chosen."""

_LENGTHSCALES = np.geomspace(0.02, 1000.0, 12)
"""Among which a lengthscale that is a state of the cost is searched for first (s); the last is as good as infinity."""


def shortest(found: ConstrainedPosterior, name: str) -> tuple[jax.Array, jax.Array]:
    """Return the ends (K,), (K,) of the shortest 95% interval of what has the lower bound zero.

    A central interval would leave out a truth at the bound, however probable it is.
    """
    low = [jnp.zeros_like(found.times), *(found.interval(name, 1.0 - 2.0 * share)[0] for share in _BELOW[1:])]
    return _narrowest(jnp.stack(low), jnp.stack([found.interval(name, 0.9 + 2.0 * share)[1] for share in _BELOW]))


def _narrowest(low: jax.Array, high: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the ends (K,) of the narrowest of several bands (S, K)."""
    best = jnp.argmin(high - low, axis=0)[None]
    return jnp.take_along_axis(low, best, 0)[0], jnp.take_along_axis(high, best, 0)[0]


@functools.cache
def transcription(method: str) -> Callable[[Any, Any], tuple[jax.Array, jax.Array, jax.Array]]:
    """Return estimates and ends of bands (N, K) of hyperparameters (N, P) and records (N, T, 1)."""
    one = {EARLY: _smoother, SMOOTHER: _smoother, HORIZON: _horizon, HORIZON_RATE: _horizon, RATE: _cost,
           RATE_IN_Q: _cost, FULL: _full, BANDS: _bands, LINK: _link}[method]
    return jax.jit(jax.vmap(one))


def _model(values: jax.Array, softplus: bool = False) -> Any:
    scale = values[1] if values.shape[0] > 1 else 1.0
    return problem.transcription(scale, values[0], softplus=softplus)


def _smoother(values: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    force = smooth(_model(values), TIMES, y).force(FACTOR)
    return force.mean, force.mean - Z * force.sd, force.mean + Z * force.sd


def _link(values: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    """Mean of softplus(u) by quadrature, and its shortest 95% interval."""
    force = smooth(_model(values, True), TIMES, y, rule=GaussHermite(5), steps=1).force(FACTOR)
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    mean = (weights / weights.sum() * jax.nn.softplus(force.mean[:, None] + force.sd[:, None] * nodes)).sum(axis=1)
    below, above = (norm.ppf(jnp.asarray(shares))[:, None] for shares in (_BELOW, _BELOW + 0.95))
    return mean, *_narrowest(*(jax.nn.softplus(force.mean + force.sd * z) for z in (below, above)))


def _full(values: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    found = full_information(_model(values), TIMES, y, lower={FACTOR: 0.0}, grid=TIMES)
    nothing = jnp.where(found.converged, jnp.nan, jnp.inf) * jnp.ones(len(TIMES))
    return found.force(FACTOR), nothing, nothing


def _bands(values: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    """On every tenth row: a prior that is truncated on ever more rows keeps the force ever further from its bound."""
    found = constrained_posterior(_model(values), TIMES, y, lower={FACTOR: 0.0}, grid=TIMES[:: ROWS[BANDS]])
    low, high = shortest(found, FACTOR)
    # An end at infinity says that there is no estimate.
    return found.force_mean[:, 0], jnp.where(found.converged, low, jnp.inf), high


def _minimum(values: jax.Array, y: jax.Array, count: int = len(TIMES)) -> ConstrainedEstimate:
    """Minimise the source's cost of the first samples, with the lengthscales (P,) of force and weights."""
    return full_information(problem.companion(values[0], jnp.zeros(3), values[-1]), TIMES[:count], y[:count],
                            lower={FACTOR: 0.0}, grid=TIMES[:count], tolerance=1e-8)


def _cost(values: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    found = _minimum(values, y)
    nothing = jnp.where(found.converged, jnp.nan, jnp.inf) * jnp.ones(len(TIMES))
    return found.state(FACTOR), nothing, nothing


def states(kind: str, y: np.ndarray) -> np.ndarray:
    """Return lengthscales (N, 2) of force and weights from records (N, T, 1), learnt as section 3.4 of the source says.

    The rate sqrt(3) / lengthscale is one more state, which does not change, and is found with the others: the cost
    decides, and no likelihood. As Q is a constant in the source ("window", the first one, and "record", all of it),
    only the dynamics depend on the rate, and but for boundary terms

        integral of w^2 = integral of (l'' + 2 rate l' + rate^2 l)^2 = integral of l''^2 + 2 rate^2 l'^2 + rate^4 l^2

    grows with it: a rate of zero is best, whatever the force is. With the Q of the rate that is found ("weight"), it is
    divided by 4 rate^3 and has a minimum. The density of a path would also have its factor |Q|^(-1/2) = rate^(-3/2)
    for each sample; without it a short lengthscale costs nothing, and with it a path without disturbances at a rate of
    zero has an infinite density. The marginal likelihood, in which the path is integrated out, has neither fault.

    The minimum is that over the rate of the cost's minimum over all else. Gauss-Newton steps of all states at once
    (`lfm_ppl.full_information` of `problem.companion` with ``learnt``) have the same minimum for a constant Q, and find
    it on short records; on whole ones, where the cost hardly depends on the rate, they take hundreds of passes.
    """
    return np.stack([_least(kind, one) for one in y])


def _least(kind: str, y: np.ndarray) -> np.ndarray:
    """Return the lengthscales (2,) of one record: the best of a grid, and a search between its neighbours."""
    run, grid = _costs(kind), np.log(_LENGTHSCALES)
    best = int(np.argmin(run(grid, y)))
    ends = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    found = minimize_scalar(lambda z: float(run(np.array([z]), y)[0]), bounds=ends, method="bounded",
                            options={"xatol": 5e-3})
    lengthscale = np.exp(found.x)
    return np.array([lengthscale, lengthscale if kind == "weight" else problem.GUESSED])


@functools.cache
def _costs(kind: str) -> Callable[[Any, Any], jax.Array]:
    """Return the least cost (G,) at logarithms of lengthscales (G,), with the arrival cost of the rate."""
    count = problem.WINDOW + 1 if kind == "window" else len(TIMES)

    def one(z: jax.Array, y: jax.Array) -> jax.Array:
        weighted = jnp.exp(z) if kind == "weight" else problem.GUESSED
        arrival = problem.ARRIVAL * 3.0 * (jnp.exp(-z) - 1.0 / problem.GUESSED) ** 2
        return _minimum(jnp.stack([jnp.exp(z), jnp.asarray(weighted)]), y, count).objective + arrival

    return jax.jit(jax.vmap(one, in_axes=(0, None)))


def _horizon(values: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    nothing = jnp.full(len(TIMES), jnp.nan)
    return horizon(values, y)[:, 1], nothing, nothing


def horizon(values: jax.Array, y: jax.Array) -> jax.Array:
    """Return (x, l, l') (T, 3) by the source's delayed estimator, with the lengthscales (P,) of force and weights.

    The arrival mean of the window from t - M is the earlier estimate at t - M.

    Row k is the middle of its window, from which a later window starts (equations 13 to 16); the first and the last
    half windows are from the end windows. The estimate before the first window is zero.
    """
    inside, half = TIMES[: WINDOW + 1], WINDOW // 2

    def window(begin: Any, mean: jax.Array) -> jax.Array:
        part = jax.lax.dynamic_slice_in_dim(y, begin, WINDOW + 1)
        model = problem.companion(values[0], mean, values[-1])
        return full_information(model, inside, part, lower={FACTOR: 0.0}, grid=inside, tolerance=1e-8).state_mean

    def step(estimate: jax.Array, begin: jax.Array) -> tuple[jax.Array, None]:
        found = window(begin, estimate[begin])
        return estimate.at[begin + half].set(found[half]), None

    last = len(TIMES) - 1 - WINDOW
    estimate = jnp.zeros((len(TIMES), 3)).at[: half + 1].set(window(0, jnp.zeros(3))[: half + 1])
    estimate, _ = jax.lax.scan(step, estimate, jnp.arange(1, last))
    return jax.lax.dynamic_update_slice(estimate, window(last, estimate[last])[half:], (last + half, 0))


@functools.cache
def ballistic() -> Callable[[Any], tuple]:
    """Return paths (N, 3, T) of distances (N, T, 1), and whether the estimate has converged (N,)."""

    def one(y: jax.Array) -> tuple:
        # P = 1e-11 I and the cost 2 |x - guess|^2_P against |y - h|^2_R
        model = problem.ballistic(problem.GUESS, 1.0 / 2e-11)
        found = full_information(model, problem.TARGET_TIMES, y, lower={"altitude": 0.0, "speed": 0.0},
                                 grid=problem.TARGET_TIMES, steps=4)
        return jnp.concatenate([found.state_mean, found.force_mean], axis=1).T, found.converged

    return jax.jit(jax.vmap(one))


@functools.cache
def thyroid() -> tuple[Callable[[Any, Any], dict[str, jax.Array]], Callable[[Any, Any], dict[str, jax.Array]]]:
    """Return full information of patients' logarithms of parameters (N, P) and concentrations (N, T, 3), and bands.

    Bands take several logarithms of parameters of a patient, (N, K, P), and average over them.
    """
    times = problem.patient(0).times

    def full(z: jax.Array, y: jax.Array) -> dict[str, jax.Array]:
        model = problem.thyroid_learning().likelihood(z, y).model
        lower = dict.fromkeys((*model.state_names, problem.HORMONE), 0.0)
        found = full_information(model, times, y, lower=lower, steps=2)
        lowest = jnp.minimum(found.state_mean.min(), found.force_mean.min())
        return {"times": found.times, "mode": found.force(problem.HORMONE), "lowest": lowest,
                "converged": found.converged}

    def given(z: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        model = problem.thyroid_learning().likelihood(z, y).model
        found = constrained_posterior(model, times, y, lower={problem.HORMONE: 0.0}, steps=2)
        return found.force_mean[:, 0], quantiles(found, problem.HORMONE), found.converged

    def bands(draws: jax.Array, y: jax.Array) -> dict[str, jax.Array]:
        means, each, converged = jax.vmap(given, in_axes=(0, None))(draws, y)
        low, high = shortest_of(each.reshape(-1, each.shape[-1]), 0.0)
        return {"mean": means.mean(axis=0), "low": low, "high": high, "bands_converged": converged.all()}

    return jax.jit(jax.vmap(full)), jax.jit(jax.vmap(bands))


def quantiles(found: ConstrainedPosterior, name: str, count: int = 40) -> jax.Array:
    """Return as many quantiles (count, K), at equal distances in probability: a distribution as equal parts."""
    ends = [found.interval(name, 1.0 - (2.0 * i + 1.0) / count) for i in range(count // 2)]
    return jnp.stack([end for pair in ends for end in pair])


def shortest_of(values: jax.Array, bound: float = -math.inf, level: float = 0.95) -> tuple[jax.Array, jax.Array]:
    """Return the ends (K,) of the shortest interval with a share ``level``, or a little more, of a distribution.

    Args:
        values: (S, K), its quantiles (i + 1/2) / S, in any order.
        bound: below which there is nothing, where the interval may begin.
        level: the share.
    """
    ordered = jnp.sort(values, axis=0)
    parts = math.ceil(level * len(values))
    # From the bound, a half part below the first quantile, it is as many and a half less to the upper end.
    low = jnp.concatenate([jnp.full_like(ordered[:1], bound), ordered[: len(values) - parts]])
    return _narrowest(low, jnp.concatenate([0.5 * (ordered[parts - 1] + ordered[parts])[None], ordered[parts:]]))
