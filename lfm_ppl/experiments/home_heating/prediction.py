"""The fifth day: predicted or tracked with a known heater, or predicted under a thermostat."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from scipy.stats import norm

from lfm_ppl.engine.task import Result
from lfm_ppl.experiments.home_heating import learning, problem
from lfm_ppl.filtering.filter import FilterState
from lfm_ppl.filtering.filter import filter as gaussian_filter
from lfm_ppl.filtering.smoother import smooth
from lfm_ppl.switching.rao_blackwellised import RaoBlackwellisedResult, rao_blackwellised

EVERY = 3
"""Hours between two measurements where a day is tracked; the source has 100 minutes."""

_LAST = problem.TRAIN - 1
SCORED = problem.FINE >= problem.TRAIN
"""Which of the times `problem.FINE` are of the fifth day."""


class Filtered(NamedTuple):
    """Temperature inside at every hour, and the joint state at the last hour of learning.

    Attributes:
        mean, variance: (120,) given all measurements so far, the variance that of a measurement.
        state, covariance: (n,), (n, n).
    """

    mean: jax.Array
    variance: jax.Array
    state: jax.Array
    covariance: jax.Array


def masked(y: np.ndarray, indoor: str = "none", outdoor: bool = True) -> np.ndarray:
    """Return measurements (120, 3) without those inside on the fifth day: "none", or one in `EVERY` hours ("some").

    Args:
        y: (120, 3).
        indoor: what is kept.
        outdoor: whether the temperature outside is known on the fifth day, a perfect forecast of the weather.
    """
    y = y.copy()
    hidden = np.arange(len(y)) >= problem.TRAIN
    y[hidden if indoor == "none" else hidden & ~tracked(), 0] = np.nan
    if not outdoor:
        y[hidden, 1] = np.nan
    return y


def tracked() -> np.ndarray:
    """Return which hours (120,) of the fifth day are measured where it is tracked."""
    return (problem.TIMES >= problem.TRAIN) & (problem.TIMES % EVERY == 0) & (problem.TIMES > problem.TRAIN)


@functools.cache
def filtered(method: str, store: str, functions: int) -> Callable[..., Filtered]:
    """Return the compiled filter: from z, measurements (120, 3) and the weather to `Filtered`."""

    def run(z: jax.Array, y: jax.Array, outdoor: dict[str, Any]) -> Filtered:
        values = learning.values_of(method, store, z, outdoor)
        home = problem.site(method, store, functions, values, y).model
        found = gaussian_filter(home, problem.TIMES, problem.given(y)[0], steps=1)
        return Filtered(found.filtered_mean[:, 0], found.filtered_covariance[:, 0, 0] + values["noise_sd"] ** 2,
                        found.filtered_mean[_LAST], found.filtered_covariance[_LAST])

    return jax.jit(run)


@functools.cache
def filtered_under_draws(method: str, store: str, functions: int) -> Callable[..., Filtered]:
    """Return the same for several z (S, P)."""
    one = filtered(method, store, functions)
    return jax.jit(lambda zs, y, outdoor: jax.lax.map(lambda z: one(z, y, outdoor), zs))


@functools.cache
def smoothed(method: str, store: str, functions: int) -> Callable[..., tuple[jax.Array, jax.Array]]:
    """Return the compiled smoother of the residual: mean and standard deviation (120,) in K/h."""

    def run(z: jax.Array, y: jax.Array, outdoor: dict[str, Any]) -> tuple[jax.Array, jax.Array]:
        values = learning.values_of(method, store, z, outdoor)
        home = problem.site(method, store, functions, values, y).model
        found = smooth(home, problem.TIMES, problem.given(y)[0], steps=1)
        return found.force("residual").mean, found.force("residual").sd

    return jax.jit(run)


@functools.cache
def under_thermostat(method: str, store: str, functions: int, particles: int) -> Callable[..., RaoBlackwellisedResult]:
    """Return the compiled prediction, from the filter's state at the last measurement to the end of the fifth day."""

    def run(key: jax.Array, z: jax.Array, outdoor: dict[str, Any], start: Filtered, weather: jax.Array,
            set_points: jax.Array, on: jax.Array) -> RaoBlackwellisedResult:
        values = learning.values_of(method, store, z, outdoor)
        y = jnp.full((len(problem.FINE), 2), jnp.nan).at[:, 1].set(weather)
        return rao_blackwellised(
            key, lambda heater: problem.under(method, store, functions, values, heater), problem.thermostat(set_points),
            problem.FINE, y=y, start=FilterState(np.asarray(float(_LAST)), start.state, start.covariance),
            initial=on, particles=particles, steps=1)

    return jax.jit(run)


def known_heater(method: str, store: str, functions: int, window: problem.Window, z: np.ndarray) -> Result:
    """Return scores and paths of the fifth day with its heater known: predicted, tracked, and without the weather.

    Returns:
        ``{what}_rmse``, ``{what}_ell`` and ``{what}_inside`` for ``ahead``, ``track`` and ``blind``; ``mean`` and
        ``sd`` (24,) of the day ahead.
    """
    run = filtered(method, store, functions)
    found: Result = {}
    test = problem.TIMES >= problem.TRAIN
    between = test & ~tracked()
    for what, y, rows in (("ahead", masked(window.y), test), ("track", masked(window.y, "some"), between),
                          ("blind", masked(window.y, outdoor=False), test)):
        one = run(jnp.asarray(z), jnp.asarray(y), window.outdoor)
        mean, variance = np.asarray(one.mean)[rows], np.asarray(one.variance)[rows]
        found |= {f"{what}_{name}": value for name, value in gaussian_scores(mean, variance, window.y[rows, 0]).items()}
        if what == "ahead":
            found |= {"mean": mean, "sd": np.sqrt(variance)}
    return found


def gaussian_scores(mean: np.ndarray, variance: np.ndarray, truth: np.ndarray) -> Result:
    """Return root mean squared error, sum of the log densities of all measurements, and share in 95% bands."""
    away = truth - mean
    return {"rmse": float(np.sqrt(np.mean(away**2))),
            "ell": float(norm.logpdf(truth, mean, np.sqrt(variance)).sum()),
            "inside": float(np.mean(np.abs(away) <= 1.959963984540054 * np.sqrt(variance)))}


def thermostat_ahead(method: str, store: str, functions: int, window: problem.Window, z: np.ndarray, particles: int,
                     key: jax.Array, hourly_weather: bool = True) -> tuple[Result, RaoBlackwellisedResult]:
    """Return scores of the fifth day under its thermostat, every ten minutes, and the prediction itself.

    Raises:
        ValueError: the set points of the window are not known.
    """
    problem.thermostat(window.set_points)
    assert window.fine is not None
    start = filtered(method, store, functions)(jnp.asarray(z), jnp.asarray(masked(window.y)), window.outdoor)
    weather = np.where(np.isclose(problem.FINE % 1.0, 0.0) & hourly_weather, window.fine[:, 1], np.nan)
    found = under_thermostat(method, store, functions, particles)(
        key, jnp.asarray(z), window.outdoor, start, jnp.asarray(weather), jnp.asarray(window.set_points), window.on)
    truth = window.fine[:, :1]
    mean, density, below = (np.asarray(part)[SCORED, 0] for part in _judge(found.observed, jnp.asarray(truth)))
    return {"rmse": float(np.sqrt(np.mean((truth[SCORED, 0] - mean) ** 2))), "ell": float(density.sum()),
            "inside": float(np.mean(np.abs(below - 0.5) <= 0.475)), "mean": mean,
            "on": np.asarray(found.input_mean)[SCORED]}, found


@jax.jit
def _judge(mixture: Any, truth: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    one = type(mixture)(mixture.mean[:, :, :1], mixture.variance[:, :, :1], mixture.log_weights)
    away = (truth[:, None, :] - one.mean) / jnp.sqrt(one.variance)
    below = (jnp.exp(one.log_weights)[:, :, None] * ndtr(away)).sum(1)
    return one.moments()[0], one.log_density(truth), below
