"""Estimators of the three problems, compiled once for blocks of data sets, with 95% bands and scores.

Transcription records:

1. Learn the hyperparameters of each record: by likelihood, or as a state of the source's cost (`learn_rate_as_state`).
2. Estimate the force with the method's estimator: smoother, delayed moving horizon (`horizon`), full information,
   expectation propagation under the constraint, or a softplus link.
3. Score the estimate after the samples from which the source learns (`transcription`).

Targets have full information estimates under constraints of altitude and speed (`ballistic`). Patients have full
information estimates at the mode of their parameters, and bands averaged over posterior draws (`thyroid`).

Source: Wolff, Lopez, Müller and Beckers; section and equation numbers refer to it.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from scipy.optimize import minimize_scalar

import lfm_ppl as lfm
from lfm_ppl.constrained.full_information import ConstrainedEstimate
from lfm_ppl.constrained.posterior import ConstrainedPosterior
from lfm_ppl.inference.optimise import newton, quasi_newton
from lfm_ppl.parallel.task import Result, Task

from ..importance_at_modes import weighted_posterior
from ..log_posterior import LogPosterior
from ..scores import Z, interval_coverage, rmse
from ..tasks import dataset_indices
from . import problem
from .problem import FACTOR, HORMONE, TIMES, WINDOW

MAX_PEAK_ERROR = 1.0
"""Largest error (h) of a correct peak time."""

_SEARCH = {"ftol": 1e-10, "gtol": 1e-4}
_SEARCH_RADIUS = float(np.log(TIMES[-1] / 2.0))
"""Largest distance of a logarithm from the centre of its prior in searches with 60 samples, whose likelihood often has
no maximum."""
_LENGTHSCALES = np.geomspace(0.02, 1000.0, 12)
"""Grid of lengthscales (s) at which a search for the least cost starts; the last one is effectively infinite."""
_BELOW = np.array([0.0, 0.01, 0.025, 0.04])
"""Probabilities below the candidates of a shortest 95% band."""


@functools.cache
def _compile(estimate: Callable) -> Callable[..., Any]:
    """Return an estimator vectorised over data sets and compiled."""
    return jax.jit(jax.vmap(estimate))


def posterior_mode(posterior: LogPosterior, y: np.ndarray, prior: float = 1.0, max_distance: float = np.inf
                   ) -> np.ndarray:
    """Return the mode (P,) of the logarithms of parameters, at most ``max_distance`` from the centre of the prior."""
    start = posterior.central
    bounds = np.stack([start - max_distance, start + max_distance], axis=1)
    return quasi_newton(posterior.objective(y, prior), start, bounds=bounds, options=_SEARCH).point


def shortest_band(posterior: ConstrainedPosterior, name: str) -> tuple[jax.Array, jax.Array]:
    """Return the bounds (K,), (K,) of the shortest 95% intervals of a force with the lower bound zero.

    A central interval never contains a truth at the bound.
    """
    low = [jnp.zeros_like(posterior.times), *(posterior.interval(name, 1.0 - 2.0 * share)[0] for share in _BELOW[1:])]
    high = [posterior.interval(name, 0.9 + 2.0 * share)[1] for share in _BELOW]
    return _narrowest_band(jnp.stack(low), jnp.stack(high))


def _narrowest_band(low: jax.Array, high: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the bounds (K,) of the narrowest of several bands (S, K)."""
    best = jnp.argmin(high - low, axis=0)[None]
    return jnp.take_along_axis(low, best, 0)[0], jnp.take_along_axis(high, best, 0)[0]


# --- transcription: functions from hyperparameters (P,) and a record (T, 1) to estimate and bounds of the band (K,)
# each. The bounds are NaN for estimators without a band, and infinite if the estimate has not converged.


def _estimate_by_smoother(values: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    force = lfm.smooth(problem.transcription(*values), TIMES, y).force(FACTOR)
    return force.mean, force.mean - Z * force.sd, force.mean + Z * force.sd


def _estimate_with_link(values: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    """Return the mean of softplus(u) by quadrature, and its shortest 95% interval."""
    model = problem.transcription(*values, softplus=True)
    force = lfm.smooth(model, TIMES, y, rule=lfm.GaussHermite(5), steps=1, iterations=0).force(FACTOR)
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    mean = (weights / weights.sum() * jax.nn.softplus(force.mean[:, None] + force.sd[:, None] * nodes)).sum(axis=1)
    below, above = (norm.ppf(jnp.asarray(shares))[:, None] for shares in (_BELOW, _BELOW + 0.95))
    return mean, *_narrowest_band(*(jax.nn.softplus(force.mean + force.sd * z) for z in (below, above)))


def _estimate_by_ep(values: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    """Return EP estimates on every tenth row; a prior truncated on more rows moves the force away from its bound."""
    rows = TIMES[:: METHODS[BANDS].spacing]
    posterior = lfm.constrained_posterior(problem.transcription(*values), TIMES, y, lower={FACTOR: 0.0}, grid=rows)
    low, high = shortest_band(posterior, FACTOR)
    return posterior.force_mean[:, 0], jnp.where(posterior.converged, low, jnp.inf), high


def _without_band(estimate: jax.Array, converged: Any = True) -> tuple[jax.Array, ...]:
    bound = jnp.where(converged, jnp.nan, jnp.inf) * jnp.ones(len(TIMES))
    return estimate, bound, bound


def _estimate_by_full_information(values: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    estimate = lfm.full_information(problem.transcription(*values), TIMES, y, lower={FACTOR: 0.0}, grid=TIMES)
    return _without_band(estimate.force(FACTOR).mean, estimate.converged)


def _estimate_by_cost(values: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    estimate = _minimise_cost(values, jnp.zeros(3), y)
    return _without_band(estimate.state(FACTOR).mean, estimate.converged)


def _minimise_cost(values: jax.Array, mean: Any, y: jax.Array) -> ConstrainedEstimate:
    """Minimise the source's cost of samples given an arrival mean and the lengthscales (P,) of force and weights."""
    times = TIMES[: len(y)]
    return lfm.full_information(problem.companion(values[0], mean, values[-1]), times, y, lower={FACTOR: 0.0},
                                grid=times, tolerance=1e-8)


def _estimate_by_horizon(values: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    return _without_band(horizon(values, y)[:, 1])


def horizon(values: jax.Array, y: jax.Array) -> jax.Array:
    """Return (x, l, l') (T, 3) by the source's delayed estimator, with the lengthscales (P,) of force and weights.

    The arrival mean of the window from t - M is the earlier estimate at t - M (equations 13 to 16). Row k comes from
    the window with its centre at k; the first and the last half window come from the first and the last window. The
    arrival mean of the first window is zero.
    """
    half, last = WINDOW // 2, len(TIMES) - 1 - WINDOW

    def window(begin: Any, mean: jax.Array) -> jax.Array:
        return _minimise_cost(values, mean, jax.lax.dynamic_slice_in_dim(y, begin, WINDOW + 1)).state_mean

    def step(estimate: jax.Array, begin: jax.Array) -> tuple[jax.Array, None]:
        return estimate.at[begin + half].set(window(begin, estimate[begin])[half]), None

    estimate = jnp.zeros((len(TIMES), 3)).at[: half + 1].set(window(0, jnp.zeros(3))[: half + 1])
    estimate, _ = jax.lax.scan(step, estimate, jnp.arange(1, last))
    return jax.lax.dynamic_update_slice(estimate, window(last, estimate[last])[half:], (last + half, 0))


@dataclass(frozen=True)
class Method:
    """An estimator of the transcription factor.

    Attributes:
        estimate: map from hyperparameters and a record to estimate and band.
        hyperparameters: kind of hyperparameters, see `_learn`.
        spacing: spacing of the estimates in samples.
        published: published mean squared error.
    """

    estimate: Callable[[jax.Array, jax.Array], tuple[jax.Array, ...]]
    hyperparameters: str
    spacing: int = 1
    published: float = np.nan


HORIZON, SMOOTHER, FULL, BANDS = "delayed MHE, 60 samples", "smoother", "full information", "EP"
METHODS = {
    "smoother, 60 samples": Method(_estimate_by_smoother, "early", published=problem.PUBLISHED["smoother"]),
    HORIZON: Method(_estimate_by_horizon, "early", published=problem.PUBLISHED["delayed MHE"]),
    "delayed MHE, rate a state": Method(_estimate_by_horizon, "window", published=problem.PUBLISHED["delayed MHE"]),
    "full information, rate a state": Method(_estimate_by_cost, "record"),
    "full information, rate in Q": Method(_estimate_by_cost, "weight"),
    SMOOTHER: Method(_estimate_by_smoother, "all"), FULL: Method(_estimate_by_full_information, "all"),
    BANDS: Method(_estimate_by_ep, "all", spacing=10),
    "softplus link": Method(_estimate_with_link, "softplus")}


def transcription(task: Task) -> Result:
    """Return scores of every estimator for a block of records.

    Returns:
        For each estimator, with the prefix ``{method}/``: ``mse``, ``minimum``, ``coverage`` and ``failed`` (N,), with
        errors and coverage without the samples from which the source learns; ``first`` (3, K), estimate and bounds of
        the first record. Also ``truth`` (T,) of the first record, and ``hyperparameters/{kind}`` (N, P) with the
        lengthscale in the first column.
    """
    y, truth = map(np.stack, zip(*(problem.record(task.settings["shape"], index, task.seed)
                                   for index in dataset_indices(task)), strict=True))
    methods = {label: METHODS[label] for label in task.settings["methods"]}
    kinds = dict.fromkeys(method.hyperparameters for method in methods.values())
    hyperparameters = {kind: _learn(kind, y) for kind in kinds}
    result: Result = {"truth": truth[0], **{f"hyperparameters/{kind}": hyperparameters[kind] for kind in kinds}}
    for label, method in methods.items():
        estimate, low, high = map(np.asarray, _compile(method.estimate)(hyperparameters[method.hyperparameters], y))
        exact, scored = truth[:, :: method.spacing], slice(WINDOW // method.spacing, None)
        is_covered = np.where(np.isfinite(low), (low <= exact) & (exact <= high), np.nan)
        result |= {f"{label}/mse": ((estimate - exact)[:, scored] ** 2).mean(axis=1),
                   f"{label}/minimum": estimate.min(axis=1), f"{label}/coverage": is_covered[:, scored].mean(axis=1),
                   f"{label}/first": np.stack([estimate[0], low[0], high[0]]),
                   f"{label}/failed": ~np.isfinite(estimate).all(axis=1) | np.isinf(low).any(axis=1)}
    return result


def _learn(kind: str, y: np.ndarray) -> np.ndarray:
    """Return the hyperparameters (N, P) of a kind from records (N, T, 1)."""
    if kind in ("window", "record", "weight"):
        return learn_rate_as_state(kind, y)
    posterior = problem.learning(kind)
    # The source maximises the likelihood of the first samples.
    options = {"prior": 0.0, "max_distance": _SEARCH_RADIUS} if kind == "early" else {}
    return np.exp([posterior_mode(posterior, record[: len(posterior.bound.times)], **options) for record in y])


def learn_rate_as_state(kind: str, y: np.ndarray) -> np.ndarray:
    """Return lengthscales (N, 2) of force and weights from records (N, T, 1), as in section 3.4 of the source.

    The rate sqrt(3) / lengthscale is a further, constant state, and minimises the cost; there is no likelihood. In the
    source Q is constant, for the first window ("window") or for all samples ("record"). Then only the dynamics depend
    on the rate. Up to boundary terms

        integral of w^2 = integral of (l'' + 2 rate l' + rate^2 l)^2 = integral of l''^2 + 2 rate^2 l'^2 + rate^4 l^2

    increases with the rate, so that a rate of zero is optimal for every force. If Q depends on the rate ("weight"), the
    integral is divided by 4 rate^3, and the cost has a minimum. The density of a path also has the factor |Q|^(-1/2) =
    rate^(-3/2) for each sample. Without this factor a short lengthscale has no cost; with it a path without
    disturbances at a rate of zero has an infinite density. The marginal likelihood has neither defect.

    The algorithm minimises the cost over all other states at a grid of rates, and searches between the neighbours of
    the best one. Gauss-Newton steps of all states (`lfm_ppl.full_information` of `problem.companion` with ``learnt``)
    have the same minimum for a constant Q, and reach it on short records. On full records the cost hardly depends on
    the rate, and they take hundreds of passes.
    """
    costs, grid, lengthscales = _compile_costs(kind), np.log(_LENGTHSCALES), []
    for record in y:
        best = int(np.argmin(costs(grid, record)))
        bounds = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
        minimum = minimize_scalar(lambda z, record: float(costs(np.array([z]), record)[0]), args=(record,),
                                  bounds=bounds, method="bounded", options={"xatol": 5e-3})
        lengthscales.append(np.exp(minimum.x))
    weight_lengthscales = lengthscales if kind == "weight" else np.full(len(y), problem.INITIAL_LENGTHSCALE)
    return np.stack([lengthscales, weight_lengthscales], axis=1)


@functools.cache
def _compile_costs(kind: str) -> Callable[[Any, Any], jax.Array]:
    """Return a function from log lengthscales (G,) and a record to least costs (G,), with the rate's arrival cost."""
    count = WINDOW + 1 if kind == "window" else len(TIMES)

    def cost(z: jax.Array, y: jax.Array) -> jax.Array:
        weight_lengthscale = jnp.exp(z) if kind == "weight" else jnp.asarray(problem.INITIAL_LENGTHSCALE)
        arrival = problem.ARRIVAL * 3.0 * (jnp.exp(-z) - 1.0 / problem.INITIAL_LENGTHSCALE) ** 2
        return _minimise_cost(jnp.stack([jnp.exp(z), weight_lengthscale]), jnp.zeros(3), y[:count]).objective + arrival

    return jax.jit(jax.vmap(cost, in_axes=(0, None)))


# --- a target on reentry, and patients


def _estimate_target(y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return paths (3, T) given distances (T, 1), and whether the estimate has converged."""
    # The arrival cost is 2 |x - guess|^2_P with P = 1e-11 I, next to |y - h|^2_R.
    estimate = lfm.full_information(problem.ballistic(problem.INITIAL_GUESS, 1.0 / 2e-11), problem.TARGET_TIMES, y,
                                    lower={"altitude": 0.0, "speed": 0.0}, grid=problem.TARGET_TIMES, steps=4)
    return jnp.concatenate([estimate.state_mean, estimate.force_mean], axis=1).T, estimate.converged


def ballistic(task: Task) -> Result:
    """Return ``rmse`` (N, 3) and ``converged`` (N,), and the first target's ``estimate`` and ``truth`` (3, T)."""
    y, truth = map(np.stack, zip(*(problem.target(index, task.seed) for index in dataset_indices(task)), strict=True))
    paths, converged = map(np.asarray, _compile(_estimate_target)(y))
    return {"rmse": rmse(paths, truth), "converged": converged, "estimate": paths[0], "truth": truth[0]}


def _estimate_patient(z: jax.Array, y: jax.Array) -> dict[str, jax.Array]:
    """Return the full information estimate given logarithms of parameters (P,) and concentrations (T, 3)."""
    posterior = problem.thyroid_learning()
    model = posterior.likelihood(z, y).model
    lower = dict.fromkeys((*model.state_names, HORMONE), 0.0)
    estimate = lfm.full_information(model, posterior.bound.times, y, lower=lower, steps=2)
    return {"times": estimate.times, "mode": estimate.force(HORMONE).mean, "converged": estimate.converged,
            "lowest": jnp.minimum(estimate.state_mean.min(), estimate.force_mean.min())}


def _estimate_patient_bands(draws: jax.Array, y: jax.Array) -> dict[str, jax.Array]:
    """Return mean and band of the mixture over draws (D, P) of the logarithms of parameters."""
    posterior = problem.thyroid_learning()

    def condition_on(z: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        model = posterior.likelihood(z, y).model
        conditional = lfm.constrained_posterior(model, posterior.bound.times, y, lower={HORMONE: 0.0}, steps=2)
        return conditional.force_mean[:, 0], quantiles(conditional, HORMONE), conditional.converged

    means, parts, converged = jax.vmap(condition_on)(draws)
    low, high = shortest_interval(parts.reshape(-1, parts.shape[-1]), 0.0)
    return {"mean": means.mean(axis=0), "low": low, "high": high, "bands_converged": converged.all()}


def thyroid(task: Task) -> Result:
    """Return estimates of the TRH of every patient at ``times`` (K,), and their errors.

    Returns:
        ``mode``, the full information estimate; ``truth``; ``mean``, the posterior mean; ``low`` and ``high``, the
        bounds of the band, (N, K) each. ``peak`` (N, 2), errors (h) of the time of greatest TRH, and of the peak of the
        best-fitting wave of 24 h. ``lowest`` (N,), the smallest of all concentrations. ``z`` (N, P), logarithms of
        parameters at the mode, and ``draws`` (N, D, P) with their Pareto index ``k`` (N,). ``y`` (T, 3) of the first
        patient at the times ``measured`` (T,).
    """
    posterior = problem.thyroid_learning()
    patients = [problem.patient(index, task.seed) for index in dataset_indices(task)]
    y = np.stack([patient.y for patient in patients])
    z = np.stack([posterior_mode(posterior, values) for values in y])
    seeds = [problem.MAX_DATA_SETS * task.seed + index for index in dataset_indices(task)]
    counts = task.settings["draws"], task.settings["weighted"]
    samples = [sample_parameters(posterior, *inputs, *counts) for inputs in zip(y, z, seeds, strict=True)]
    draws, k = map(np.stack, zip(*samples, strict=True))
    estimates = {name: np.asarray(value) for name, value in
                 (_compile(_estimate_patient)(z, y) | _compile(_estimate_patient_bands)(draws, y)).items()}
    times = estimates.pop("times")[0]
    truth = np.stack([np.interp(times, patient.truth["times"], patient.truth["forces"][HORMONE])
                      for patient in patients])
    mode = estimates["mode"]
    errors = [_distance_of_hours(event_time(times, mode), event_time(times, truth))
              for event_time in (peak_time, acrophase_time)]
    return estimates | {
        "times": times, "truth": truth, "z": z, "draws": draws, "k": k, "peak": np.stack(errors, axis=1),
        "coverage": interval_coverage(estimates["low"], estimates["high"], truth), "rmse": rmse(mode, truth),
        "y": y[0], "measured": patients[0].times}


def sample_parameters(posterior: LogPosterior, y: np.ndarray, mode: np.ndarray, seed: int, draws: int,
                      weighted: int) -> tuple[np.ndarray, float]:
    """Return draws (draws, P) of the logarithms of parameters from their posterior, and the weights' Pareto index.

    Systematic resampling selects them from importance samples about the mode. If the posterior has no curvature at the
    mode, all draws are the mode, and the index is infinite.
    """
    minimum = newton(posterior.objective(y), mode)
    if minimum.curvature is None:
        return np.tile(mode, (draws, 1)), np.inf
    weighted_draws = weighted_posterior(posterior, y, [minimum], weighted, seed)
    share = np.cumsum(weighted_draws.weight)
    indices = np.searchsorted(share / share[-1], (np.arange(draws) + 0.5) / draws)
    return weighted_draws.draws[indices], weighted_draws.weights.k


def quantiles(posterior: ConstrainedPosterior, name: str, count: int = 40) -> jax.Array:
    """Return the quantiles (count, K) of probabilities (i + 1/2) / count, in any order."""
    bounds = [posterior.interval(name, 1.0 - (2.0 * i + 1.0) / count) for i in range(count // 2)]
    return jnp.stack([bound for pair in bounds for bound in pair])


def shortest_interval(values: jax.Array, bound: float = -math.inf, level: float = 0.95) -> tuple[jax.Array, jax.Array]:
    """Return the bounds (K,) of the shortest interval with probability ``level``, or slightly more.

    Args:
        values: quantiles (S, K) of probabilities (i + 1/2) / S, in any order.
        bound: lower bound of the distribution, where the interval may begin.
        level: probability of the interval.
    """
    ordered = jnp.sort(values, axis=0)
    parts = math.ceil(level * len(values))
    # The bound lies half a part below the first quantile, so that its interval ends half a part earlier.
    low = jnp.concatenate([jnp.full_like(ordered[:1], bound), ordered[: len(values) - parts]])
    return _narrowest_band(low, jnp.concatenate([0.5 * (ordered[parts - 1] + ordered[parts])[None], ordered[parts:]]))


def peak_time(times: np.ndarray, paths: np.ndarray) -> np.ndarray:
    """Return the times of the maxima of paths (N, K)."""
    return times[paths.argmax(axis=1)]


def acrophase_time(times: np.ndarray, paths: np.ndarray) -> np.ndarray:
    """Return the times (h) of the maxima of the waves of 24 h fitted to paths (N, K)."""
    angle = 2.0 * np.pi * times / 24.0
    wave = np.stack([np.ones_like(times), np.cos(angle), np.sin(angle)], axis=1)
    _, cosine, sine = np.linalg.lstsq(wave, paths.T, rcond=None)[0]
    return np.arctan2(sine, cosine) * 12.0 / np.pi % 24.0


def _distance_of_hours(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the distance (h) between times of day."""
    return np.abs((a - b + 12.0) % 24.0 - 12.0)
