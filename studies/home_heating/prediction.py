"""Learning from four days of a home, and predictions of the fifth day.

1. Find the most likely parameters, in logarithms z, given four days of temperatures and heater (`find_mode`), or
   sample their posterior (`posterior`).
2. In the real house the heater of the fifth day is known. Filter the five days with the fifth day's indoor temperatures
   hidden; their predictive moments give the scores (`predict_with_known_heater`).
3. In a simulated home the heater follows a thermostat. Start a Rao-Blackwellised particle filter at the last
   measurement, and predict temperatures and heater jointly (`predict_under_thermostat`).
4. With the posterior, average the predictive densities over its draws (`_compute_posterior`).
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpyro.infer import MCMC
from scipy.special import logsumexp, ndtr
from scipy.stats import norm

import lfm_ppl as lfm
from lfm_ppl.inference.bind import bind_arguments
from lfm_ppl.inference.optimise import quasi_newton
from lfm_ppl.parallel.task import Result, Task
from lfm_ppl.switching.mixture import Mixture
from lfm_ppl.switching.rao_blackwellised import RaoBlackwellisedResult

from .. import chains, scores, timing
from ..log_posterior import LogPosterior
from ..tasks import stack_results
from . import problem
from .problem import FINE, TIMES, TRAIN, Model, Window

SAMPLERS = ("RAM", "NUTS")
RESIDUALS = ("SQM", "matern")
"""Residuals in the figure of smoothed forces."""

QUANTILES = (0.025, 0.25, 0.5, 0.75, 0.975)
EVERY = 3
"""Hours between two measurements of a tracked day; the source has 100 minutes."""

SCORED, AHEAD, TRACKED = FINE >= TRAIN, TIMES >= TRAIN, (TIMES > TRAIN) & (TIMES % EVERY == 0)
"""Masks of the fifth day in `FINE` (149,) and in `TIMES` (120,), and of the measurements of a tracked fifth day."""


def compute(task: Task) -> Result:
    """Return the result of a task, with its CPU time ``cpu_s``."""
    model = Model(*(task.settings[name] for name in Model._fields))
    run = {"house": _compute_house, "homes": _compute_homes, "posterior": _compute_posterior}[task.name.split("/")[0]]
    seconds, result = timing.time_call(run, task, model)
    return {**result, "cpu_s": seconds}


def _find_modes(task: Task, model: Model) -> Iterator[tuple[Window, np.ndarray, float]]:
    """Yield every window with its most likely parameters and their log density; each search starts at the last mode."""
    z = None
    for window in problem.house(task.settings["data"])[:task.settings["windows"]]:
        z, density = find_mode(model, window, z)
        yield window, z, density


def _compute_house(task: Task, model: Model) -> Result:
    """Return scores and paths of every window, and the residual (120,) of the window in the figure."""
    rows, residual = [], {}
    for index, (window, z, density) in enumerate(_find_modes(task, model)):
        rows.append({**predict_with_known_heater(model, window, z), "z": z, "density": density})
        if index == task.settings["shown"] and model.method in RESIDUALS:
            mean, sd = smooth_residual(model, z, mask_fifth_day(window.y), window.outdoor)
            residual = {"residual": np.asarray(mean), "residual_sd": np.asarray(sd)}
    return stack_results(rows) | residual


def _compute_homes(task: Task, model: Model) -> Result:
    """Return scores and paths of every simulated home, and quantiles (5, 144) of the first."""
    rows = []
    for index in range(task.settings["homes"]):
        window = problem.home(index, model.store, task.seed)
        z, _ = find_mode(model, window)
        key = jax.random.fold_in(task.key, index)
        result, prediction = predict_under_thermostat(model, window, z, task.settings["particles"], key)
        rows.append({**result, "z": z})
        if index == 0:
            rows[0]["quantiles"] = np.asarray(prediction.observed.quantiles(QUANTILES))[:, SCORED, 0]
    return stack_results(rows, first_only=("quantiles",))


def _compute_posterior(task: Task, model: Model) -> Result:
    """Return scores of some windows with the most likely parameters and with their posterior."""
    rows = []
    for index, (window, z, _) in enumerate(_find_modes(task, model)):
        if index % task.settings["every"]:
            continue
        sampled = posterior(task.settings["sampler"], model, window, z, jax.random.fold_in(task.key, index),
                            tuple(task.settings["chains"]))
        draws = scores.thin_draws(sampled["draws"], 100)
        moments = filter_under_draws(model, draws, mask_fifth_day(window.y), window.outdoor)
        mean, variance = (np.asarray(moment)[:, AHEAD] for moment in moments[:2])
        truth, point = window.y[AHEAD, 0], predict_with_known_heater(model, window, z)
        densities = logsumexp(norm.logpdf(truth, mean, np.sqrt(variance)), axis=0) - np.log(len(draws))
        rows.append({"ell": float(densities.sum()), "rmse": scores.rmse(mean.mean(axis=0), truth),
                     "point_ell": point["ahead_ell"], "point_rmse": point["ahead_rmse"],
                     "r_hat": np.max(sampled["r_hat"]), "ess": np.min(sampled["ess"]),
                     **{name: sampled[name] for name in ("mean", "sd", "divergences", "seconds")}})
    return stack_results(rows)


def find_mode(model: Model, window: Window, start: np.ndarray | None = None) -> tuple[np.ndarray, float]:
    """Return the most likely logarithms z (P,) of the parameters given the first four days, and their log density.

    The priors are those in the model file, with standard deviations of 0.7 to 1 in the logarithm. Without priors some
    scales diverge, since four days do not determine them. The prior of the weather parameters adds a constant to the
    log density. The search starts at ``start``, or at the prior medians.
    """
    objective = _log_posterior(model).objective(window.learnt)
    minimum = quasi_newton(objective, model.medians if start is None else start, 60)
    return minimum.point, -minimum.value


@functools.cache
def _log_posterior(model: Model) -> LogPosterior:
    """Return the posterior given the first four days; all windows share its compiled programs."""
    with jax.ensure_compile_time_eval():
        example = jnp.zeros((TRAIN, 3)), dict.fromkeys(problem.OUTDOOR, jnp.ones(()))
        return LogPosterior(bind_arguments(model.program, (example,), {}), model.names)


def posterior(sampler: str, model: Model, window: Window, mode: np.ndarray, key: jax.Array,
              size: tuple[int, int, int]) -> Result:
    """Return draws of z and their diagnostics, see `chains.sample`.

    Chains start around ``mode`` (P,); ``size`` has the number of chains, the warm-up and the draws of each.
    """
    start_key, run_key = jax.random.split(key)
    return chains.sample(_sampler(sampler, model, *size), model.names, run_key, window.learnt,
                         init_params=chains.draw_starts(model.names, mode, size[0], start_key))


@functools.cache
def _sampler(sampler: str, model: Model, count: int, warmup: int, draws: int) -> MCMC:
    """Return the sampler of a model; one object, so that all windows share its compiled programs."""
    kernel: Any = (lfm.RAM(model.program, initial_scale=0.3, initial_covariance=np.eye(len(model.names)))
                   if sampler == "RAM" else chains.nuts(model.program))
    return chains.sampler(kernel, count, warmup, draws, jit_model_args=True)


def mask_fifth_day(y: np.ndarray, tracked: bool = False, weather: bool = True) -> np.ndarray:
    """Return measurements (120, 3) without the indoor temperatures of the fifth day.

    If ``tracked``, one in `EVERY` hours remains. With ``weather`` the outdoor temperatures of the fifth day remain, as
    a perfect forecast.
    """
    y = y.copy()
    y[AHEAD & ~TRACKED if tracked else AHEAD, 0] = np.nan
    if not weather:
        y[AHEAD, 1] = np.nan
    return y


@functools.partial(jax.jit, static_argnums=0)
def filter_window(model: Model, z: Any, y: Any, outdoor: dict[str, Any]) -> tuple[jax.Array, ...]:
    """Filter measurements y (120, 3) with parameters exp(z).

    Returns:
        Mean and variance (120,) of an indoor measurement given all earlier and simultaneous ones; mean (n,) and
        covariance (n, n) of the joint state at the last hour of training.
    """
    values = model.values(z, outdoor)
    result = model.likelihood(values, y[:, 2]).filter(y[:, :2])
    mean, covariance = result.filtered_mean, result.filtered_covariance
    return mean[:, 0], covariance[:, 0, 0] + values["noise_sd"] ** 2, mean[TRAIN - 1], covariance[TRAIN - 1]


@functools.partial(jax.jit, static_argnums=0)
def filter_under_draws(model: Model, draws: Any, y: Any, outdoor: dict[str, Any]) -> tuple[jax.Array, ...]:
    """Return the results of `filter_window` for several z (S, P)."""
    return jax.lax.map(lambda z: filter_window(model, z, y, outdoor), draws)


@functools.partial(jax.jit, static_argnums=0)
def smooth_residual(model: Model, z: Any, y: Any, outdoor: dict[str, Any]) -> tuple[jax.Array, jax.Array]:
    """Return mean and standard deviation (120,) in K/h of the smoothed residual."""
    residual = model.likelihood(model.values(z, outdoor), y[:, 2]).smooth(y[:, :2]).force("residual")
    return residual.mean, residual.sd


@functools.partial(jax.jit, static_argnums=(0, 1))
def run_thermostat(model: Model, particles: int, key: jax.Array, z: Any, window: Window, mean: jax.Array,
                   covariance: jax.Array) -> RaoBlackwellisedResult:
    """Predict a window from the state and the heater at the last measurement to the end of the fifth day."""
    assert window.fine is not None
    values, outdoor = model.values(z, window.outdoor), jnp.asarray(window.fine)[:, 1]
    y = jnp.stack([jnp.full(len(FINE), jnp.nan), jnp.where(np.isclose(FINE % 1.0, 0.0), outdoor, jnp.nan)], axis=1)
    return lfm.rao_blackwellised(
        key, lambda heater: model.likelihood(values, heater).model, problem.thermostat(window.set_points), FINE, y=y,
        initial=window.on, start=lfm.FilterState(np.asarray(TRAIN - 1.0), mean, covariance), particles=particles,
        steps=1)


def predict_with_known_heater(model: Model, window: Window, z: np.ndarray) -> Result:
    """Return scores and paths of the fifth day with a known heater.

    ``{kind}_rmse``, ``{kind}_ell`` and ``{kind}_inside`` are the scores of the day ahead ("ahead"), of a tracked day
    ("track") and of the day ahead without weather ("blind"); ``mean`` and ``sd`` (24,) belong to the day ahead.
    """
    result: Result = {}
    for kind, y, hours in (("ahead", mask_fifth_day(window.y), AHEAD),
                           ("track", mask_fifth_day(window.y, tracked=True), AHEAD & ~TRACKED),
                           ("blind", mask_fifth_day(window.y, weather=False), AHEAD)):
        mean, variance = (np.asarray(moment)[hours] for moment in filter_window(model, z, y, window.outdoor)[:2])
        result |= {f"{kind}_{name}": value
                   for name, value in gaussian_scores(mean, variance, window.y[hours, 0]).items()}
        if kind == "ahead":
            result |= {"mean": mean, "sd": np.sqrt(variance)}
    return result


def gaussian_scores(mean: np.ndarray, variance: np.ndarray, truth: np.ndarray) -> Result:
    """Return the root mean squared error, the sum of the log densities of measurements, and the coverage."""
    sd = np.sqrt(variance)
    return {"rmse": scores.rmse(mean, truth), "ell": float(norm.logpdf(truth, mean, sd).sum()),
            "inside": scores.interval_coverage(*scores.interval(mean, sd), truth)}


def predict_under_thermostat(model: Model, window: Window, z: np.ndarray, particles: int,
                             key: jax.Array) -> tuple[Result, RaoBlackwellisedResult]:
    """Return scores of the fifth day under the thermostat, every ten minutes, and the prediction.

    The outdoor temperature is known at every full hour.

    Raises:
        ValueError: the window has no set points.
    """
    problem.thermostat(window.set_points)
    assert window.fine is not None
    state = filter_window(model, z, mask_fifth_day(window.y), window.outdoor)[2:]
    forecast = run_thermostat(model, particles, key, z, window, *state)
    day: Mixture = jax.tree.map(lambda part: part[SCORED], forecast.observed)
    indoor, truth = Mixture(day.mean[:, :, :1], day.variance[:, :, :1], day.log_weights), window.fine[SCORED, :1]
    mean, z_scores = indoor.moments()[0], (truth[:, None] - indoor.mean) / jnp.sqrt(indoor.variance)
    below = (np.exp(day.log_weights) * ndtr(z_scores)[:, :, 0]).sum(axis=1)
    return {"rmse": scores.rmse(mean[:, 0], truth[:, 0]), "ell": float(indoor.log_density(truth).sum()),
            "inside": float(np.mean(np.abs(below - 0.5) <= 0.475)), "mean": np.asarray(mean)[:, 0],
            "on": np.asarray(forecast.input_mean)[SCORED]}, forecast
