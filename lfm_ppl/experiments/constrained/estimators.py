"""The estimators, each compiled once for blocks of records: estimates, ends of 95% bands, and how good they are."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from scipy.optimize import minimize_scalar

from lfm_ppl.constrained.full_information import ConstrainedEstimate, full_information
from lfm_ppl.constrained.posterior import ConstrainedPosterior, constrained_posterior
from lfm_ppl.experiments.constrained import problem
from lfm_ppl.experiments.constrained.problem import FACTOR, HORMONE, TIMES, WINDOW
from lfm_ppl.experiments.scores import Z, interval_coverage, rmse
from lfm_ppl.experiments.tasks import dataset_indices
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.inference.log_posterior import LogPosterior
from lfm_ppl.inference.optimise import newton, quasi_newton
from lfm_ppl.linearisation.sigma_points import GaussHermite
from lfm_ppl.parallel.task import Result, Task
from lfm_ppl.results.importance_at_modes import weighted_posterior

NEAR = 1.0
"""Hours within which a peak counts as found."""

_SEARCH = {"ftol": 1e-10, "gtol": 1e-4}
_FURTHEST = float(np.log(TIMES[-1] / 2.0))
"""How far from the middle of its prior, in logarithms, a parameter is searched for where 60 samples are given: their
likelihood often has no maximum."""
_LENGTHSCALES = np.geomspace(0.02, 1000.0, 12)
"""Among which a lengthscale that is a state of the cost is searched for first (s); the last is as good as infinity."""
_BELOW = np.array([0.0, 0.01, 0.025, 0.04])
"""Shares below a 95% band, among which the shortest one is chosen."""


@functools.cache
def _compiled(estimate: Callable) -> Callable[..., Any]:
    """Return what estimates from arguments that all have a leading dimension: of records, targets, patients."""
    return jax.jit(jax.vmap(estimate))


def posterior_mode(posterior: LogPosterior, y: np.ndarray, prior: float = 1.0, furthest: float = np.inf) -> np.ndarray:
    """Return the mode (P,) of the density of logarithms of parameters, no further from the prior's middle than that."""
    start = posterior.central
    bounds = np.stack([start - furthest, start + furthest], axis=1)
    return quasi_newton(posterior.objective(y, prior), start, bounds=bounds, options=_SEARCH).point


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


# --- transcription: from hyperparameters (P,) and a record (T, 1) estimate and ends of the band (K,), (K,), (K,): NaN
# where there is no band, infinite where there is no estimate either


def _smoother(values: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    force = smooth(problem.transcription(*values), TIMES, y).force(FACTOR)
    return force.mean, force.mean - Z * force.sd, force.mean + Z * force.sd


def _link(values: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    """Mean of softplus(u) by quadrature, and its shortest 95% interval."""
    model = problem.transcription(*values, softplus=True)
    force = smooth(model, TIMES, y, rule=GaussHermite(5), steps=1).force(FACTOR)
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    mean = (weights / weights.sum() * jax.nn.softplus(force.mean[:, None] + force.sd[:, None] * nodes)).sum(axis=1)
    below, above = (norm.ppf(jnp.asarray(shares))[:, None] for shares in (_BELOW, _BELOW + 0.95))
    return mean, *_narrowest(*(jax.nn.softplus(force.mean + force.sd * z) for z in (below, above)))


def _bands(values: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    """On every tenth row: a prior that is truncated on ever more rows keeps the force ever further from its bound."""
    rows = TIMES[:: METHODS[BANDS].every]
    found = constrained_posterior(problem.transcription(*values), TIMES, y, lower={FACTOR: 0.0}, grid=rows)
    low, high = shortest(found, FACTOR)
    return found.force_mean[:, 0], jnp.where(found.converged, low, jnp.inf), high


def _without_band(estimate: jax.Array, converged: Any = True) -> tuple[jax.Array, ...]:
    end = jnp.where(converged, jnp.nan, jnp.inf) * jnp.ones(len(TIMES))
    return estimate, end, end


def _full(values: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    found = full_information(problem.transcription(*values), TIMES, y, lower={FACTOR: 0.0}, grid=TIMES)
    return _without_band(found.force(FACTOR), found.converged)


def _cost(values: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    found = _minimum(values, jnp.zeros(3), y)
    return _without_band(found.state(FACTOR), found.converged)


def _minimum(values: jax.Array, mean: Any, y: jax.Array) -> ConstrainedEstimate:
    """Minimise the source's cost of samples from an arrival mean, with the lengthscales (P,) of force and weights."""
    times = TIMES[: len(y)]
    return full_information(problem.companion(values[0], mean, values[-1]), times, y, lower={FACTOR: 0.0}, grid=times,
                            tolerance=1e-8)


def _horizon(values: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    return _without_band(horizon(values, y)[:, 1])


def horizon(values: jax.Array, y: jax.Array) -> jax.Array:
    """Return (x, l, l') (T, 3) by the source's delayed estimator, with the lengthscales (P,) of force and weights.

    The arrival mean of the window from t - M is the earlier estimate at t - M. Row k is the middle of its window, from
    which a later window starts (equations 13 to 16); the first and the last half windows are from the end windows. The
    estimate before the first window is zero.
    """
    half, last = WINDOW // 2, len(TIMES) - 1 - WINDOW

    def window(begin: Any, mean: jax.Array) -> jax.Array:
        return _minimum(values, mean, jax.lax.dynamic_slice_in_dim(y, begin, WINDOW + 1)).state_mean

    def step(estimate: jax.Array, begin: jax.Array) -> tuple[jax.Array, None]:
        return estimate.at[begin + half].set(window(begin, estimate[begin])[half]), None

    estimate = jnp.zeros((len(TIMES), 3)).at[: half + 1].set(window(0, jnp.zeros(3))[: half + 1])
    estimate, _ = jax.lax.scan(step, estimate, jnp.arange(1, last))
    return jax.lax.dynamic_update_slice(estimate, window(last, estimate[last])[half:], (last + half, 0))


class Method(NamedTuple):
    """An estimator, the kind of hyperparameters ``learnt`` for it, and ``every`` how many samples it estimates."""

    estimate: Callable[[jax.Array, jax.Array], tuple[jax.Array, ...]]
    learnt: str
    every: int = 1
    published: float = np.nan


HORIZON, SMOOTHER, FULL, BANDS = "delayed MHE, 60 samples", "smoother", "full information", "EP"
METHODS = {
    "smoother, 60 samples": Method(_smoother, "early", published=problem.PUBLISHED["smoother"]),
    HORIZON: Method(_horizon, "early", published=problem.PUBLISHED["delayed MHE"]),
    "delayed MHE, rate a state": Method(_horizon, "window", published=problem.PUBLISHED["delayed MHE"]),
    "full information, rate a state": Method(_cost, "record"), "full information, rate in Q": Method(_cost, "weight"),
    SMOOTHER: Method(_smoother, "all"), FULL: Method(_full, "all"), BANDS: Method(_bands, "all", every=10),
    "softplus link": Method(_link, "softplus")}


def transcription(task: Task) -> Result:
    """Return by estimator, ``{method}/``: ``mse``, ``minimum``, ``coverage``, ``failed`` (N,), and ``first`` (3, K).

    Errors and coverage are without the samples from which the source learns. Of the first record there are estimate and
    ends of the band, and its ``truth`` (T,). ``hyperparameters/{kind}`` (N, P) begin with the lengthscale.
    """
    y, truth = map(np.stack, zip(*(problem.record(task.settings["shape"], index, task.seed)
                                   for index in dataset_indices(task)), strict=True))
    methods = {label: METHODS[label] for label in task.settings["methods"]}
    learnt = {kind: _learnt(kind, y) for kind in dict.fromkeys(method.learnt for method in methods.values())}
    result: Result = {f"hyperparameters/{kind}": values for kind, values in learnt.items()} | {"truth": truth[0]}
    for label, method in methods.items():
        estimate, low, high = map(np.asarray, _compiled(method.estimate)(learnt[method.learnt], y))
        exact, after = truth[:, :: method.every], slice(WINDOW // method.every, None)
        is_covered = np.where(np.isfinite(low), (low <= exact) & (exact <= high), np.nan)
        result |= {f"{label}/mse": ((estimate - exact)[:, after] ** 2).mean(axis=1),
                   f"{label}/minimum": estimate.min(axis=1), f"{label}/coverage": is_covered[:, after].mean(axis=1),
                   f"{label}/first": np.stack([estimate[0], low[0], high[0]]),
                   f"{label}/failed": ~np.isfinite(estimate).all(axis=1) | np.isinf(low).any(axis=1)}
    return result


def _learnt(kind: str, y: np.ndarray) -> np.ndarray:
    """Return the hyperparameters (N, P) of a kind from records (N, T, 1)."""
    if kind in ("window", "record", "weight"):
        return states(kind, y)
    posterior = problem.learning(kind)
    # The source maximises the likelihood of the first samples.
    how = {"prior": 0.0, "furthest": _FURTHEST} if kind == "early" else {}
    return np.exp([posterior_mode(posterior, record[: len(posterior.bound.times)], **how) for record in y])


def states(kind: str, y: np.ndarray) -> np.ndarray:
    """Return lengthscales (N, 2) of force and weights from records (N, T, 1), learnt as section 3.4 of the source says.

    The rate sqrt(3) / lengthscale is one more state, which does not change, and is found with the others: the cost
    decides, and no likelihood. As Q is a constant in the source ("window", the first one, and "record", all of it),
    only the dynamics depend on the rate, and but for boundary terms

        integral of w^2 = integral of (l'' + 2 rate l' + rate^2 l)^2 = integral of l''^2 + 2 rate^2 l'^2 + rate^4 l^2

    grows with it: a rate of zero is best, whatever the force is. With the Q of the rate that is found ("weight"), it is
    divided by 4 rate^3 and has a minimum. The density of a path would also have its factor |Q|^(-1/2) = rate^(-3/2)
    for each sample; without it a short lengthscale costs nothing, and with it a path without disturbances at a rate of
    zero has an infinite density. The marginal likelihood, in which the path is marginalised, has neither fault.

    The minimum is that over the rate of the cost's minimum over all else, the best of a grid and a search between its
    neighbours. Gauss-Newton steps of all states at once (`lfm_ppl.full_information` of `problem.companion` with
    ``learnt``) have the same minimum for a constant Q, and find it on short records; on whole ones, where the cost
    hardly depends on the rate, they take hundreds of passes.
    """
    costs, grid, lengthscales = _costs(kind), np.log(_LENGTHSCALES), []
    for record in y:
        best = int(np.argmin(costs(grid, record)))
        ends = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
        found = minimize_scalar(lambda z, record: float(costs(np.array([z]), record)[0]), args=(record,), bounds=ends,
                                method="bounded", options={"xatol": 5e-3})
        lengthscales.append(np.exp(found.x))
    of_weights = lengthscales if kind == "weight" else np.full(len(y), problem.GUESSED)
    return np.stack([lengthscales, of_weights], axis=1)


@functools.cache
def _costs(kind: str) -> Callable[[Any, Any], jax.Array]:
    """Return the least cost (G,) at logarithms of lengthscales (G,), with the arrival cost of the rate."""
    count = WINDOW + 1 if kind == "window" else len(TIMES)

    def cost(z: jax.Array, y: jax.Array) -> jax.Array:
        of_weights = jnp.exp(z) if kind == "weight" else jnp.asarray(problem.GUESSED)
        arrival = problem.ARRIVAL * 3.0 * (jnp.exp(-z) - 1.0 / problem.GUESSED) ** 2
        return _minimum(jnp.stack([jnp.exp(z), of_weights]), jnp.zeros(3), y[:count]).objective + arrival

    return jax.jit(jax.vmap(cost, in_axes=(0, None)))


# --- a target on reentry, and patients


def _target(y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return paths (3, T) of distances (T, 1), and whether the estimate has converged."""
    # P = 1e-11 I and the cost 2 |x - guess|^2_P against |y - h|^2_R
    found = full_information(problem.ballistic(problem.GUESS, 1.0 / 2e-11), problem.TARGET_TIMES, y,
                             lower={"altitude": 0.0, "speed": 0.0}, grid=problem.TARGET_TIMES, steps=4)
    return jnp.concatenate([found.state_mean, found.force_mean], axis=1).T, found.converged


def ballistic(task: Task) -> Result:
    """Return ``rmse`` (N, 3) and ``converged`` (N,), and the first target's ``estimate`` and ``truth`` (3, T)."""
    y, truth = map(np.stack, zip(*(problem.target(index, task.seed) for index in dataset_indices(task)), strict=True))
    paths, converged = map(np.asarray, _compiled(_target)(y))
    return {"rmse": rmse(paths, truth), "converged": converged, "estimate": paths[0],
            "truth": truth[0]}


def _patient(z: jax.Array, y: jax.Array) -> dict[str, jax.Array]:
    """Return full information of logarithms of parameters (P,) and concentrations (T, 3)."""
    posterior = problem.thyroid_learning()
    model = posterior.likelihood(z, y).model
    found = full_information(model, posterior.bound.times, y, lower=dict.fromkeys((*model.state_names, HORMONE), 0.0),
                             steps=2)
    return {"times": found.times, "mode": found.force(HORMONE), "converged": found.converged,
            "lowest": jnp.minimum(found.state_mean.min(), found.force_mean.min())}


def _patient_bands(draws: jax.Array, y: jax.Array) -> dict[str, jax.Array]:
    """Return mean and band, averaged over several logarithms of parameters (D, P)."""
    posterior = problem.thyroid_learning()

    def given(z: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        found = constrained_posterior(posterior.likelihood(z, y).model, posterior.bound.times, y, lower={HORMONE: 0.0},
                                      steps=2)
        return found.force_mean[:, 0], quantiles(found, HORMONE), found.converged

    means, each, converged = jax.vmap(given)(draws)
    low, high = shortest_of(each.reshape(-1, each.shape[-1]), 0.0)
    return {"mean": means.mean(axis=0), "low": low, "high": high, "bands_converged": converged.all()}


def thyroid(task: Task) -> Result:
    """Return the TRH of every patient at ``times`` (K,), and what is behind it.

    Of TRH the full information estimate ``mode``, the ``truth``, posterior ``mean``, and ends ``low`` and ``high`` of
    the band (N, K); errors (h) of its ``peak`` (N, 2): when it is greatest, and the wave of 24 h that fits it best.
    ``lowest`` (N,) is the least of all concentrations. Logarithms of parameters at the mode ``z`` (N, P), and ``draws``
    (N, D, P) with their Pareto index ``k`` (N,); ``y`` (T, 3) of the first patient at the times ``measured`` (T,).
    """
    posterior = problem.thyroid_learning()
    patients = [problem.patient(index, task.seed) for index in dataset_indices(task)]
    y = np.stack([patient.y for patient in patients])
    z = np.stack([posterior_mode(posterior, values) for values in y])
    seeds = [problem.MOST * task.seed + index for index in dataset_indices(task)]
    counts = task.settings["draws"], task.settings["weighted"]
    draws, k = map(np.stack, zip(*(drawn(posterior, *own, *counts) for own in zip(y, z, seeds, strict=True)),
                                 strict=True))
    found = {name: np.asarray(value) for name, value in
             (_compiled(_patient)(z, y) | _compiled(_patient_bands)(draws, y)).items()}
    times = found.pop("times")[0]
    truth = np.stack([np.interp(times, own["times"], own["forces"][HORMONE])
                      for own in (patient.truth for patient in patients)])
    errors = [_apart(when(times, found["mode"]), when(times, truth)) for when in (peak, acrophase)]
    return found | {
        "times": times, "truth": truth, "z": z, "draws": draws, "k": k, "peak": np.stack(errors, axis=1),
        "coverage": interval_coverage(found["low"], found["high"], truth), "rmse": rmse(found["mode"], truth),
        "y": y[0],
        "measured": patients[0].times}


def drawn(posterior: LogPosterior, y: np.ndarray, mode: np.ndarray, seed: int, draws: int,
          weighted: int) -> tuple[np.ndarray, float]:
    """Return draws (draws, P) of the logarithms of parameters from their posterior, and the weights' Pareto index.

    They are taken at equal distances from importance samples about the mode. Where there is no curvature, all are at
    the mode, and the index is infinite.
    """
    minimum = newton(posterior.objective(y), mode)
    if minimum.curvature is None:
        return np.tile(mode, (draws, 1)), np.inf
    found = weighted_posterior(posterior, y, [minimum], weighted, seed)
    share = np.cumsum(found.weight)
    chosen = np.searchsorted(share / share[-1], (np.arange(draws) + 0.5) / draws)
    return found.draws[chosen], found.weights.k


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


def peak(times: np.ndarray, paths: np.ndarray) -> np.ndarray:
    """Return when paths (N, K) are greatest."""
    return times[paths.argmax(axis=1)]


def acrophase(times: np.ndarray, paths: np.ndarray) -> np.ndarray:
    """Return when the wave of 24 h that fits paths (N, K) best is greatest, in h."""
    angle = 2.0 * np.pi * times / 24.0
    wave = np.stack([np.ones_like(times), np.cos(angle), np.sin(angle)], axis=1)
    _, cosine, sine = np.linalg.lstsq(wave, paths.T, rcond=None)[0]
    return np.arctan2(sine, cosine) * 12.0 / np.pi % 24.0


def _apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the distance of times of day."""
    return np.abs((a - b + 12.0) % 24.0 - 12.0)
