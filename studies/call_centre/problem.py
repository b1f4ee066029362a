"""Problem: windows of four equal weekdays, their queues and readings, and the model that tracks them."""

from __future__ import annotations

import functools
import warnings
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import lfm_ppl as lfm
from lfm_ppl.io import loading
from lfm_ppl.likelihoods.likelihood_site import likelihood_site

from ..log_posterior import LogPosterior
from . import counts
from .counts import BIN, COUNTS_PER_DAY, DAY, CallCounts

UTILISATION = 0.7
"""Mean rate of arrivals over all days, as a share of `SERVICE_RATE`. The queue of a typical Thursday then reaches about
25 customers at that rate, as in the source's figure."""

SERVICE_RATE = 10.0
"""Service rate in training (customers/min)."""

TEST_RATES = {"constant": (10.0, 10.0), "changed": (15.0, 5.0)}
"""Test -> service rates in the two halves of the test day (customers/min)."""

NOISE = 0.5
"""Standard deviation of the error of a reading (customers); the source does not give its value."""

TRAINING_DAYS, TRAINING_SPACING, TEST_SPACING = 3, 40.0, 180.0
"""Days of training before the test day, and minutes between readings in training and on the test day."""

GRID = BIN * np.arange((TRAINING_DAYS + 1) * COUNTS_PER_DAY + 1)
"""Start of the window and ends of all counts (673,), in minutes."""

TEST_START = TRAINING_DAYS * COUNTS_PER_DAY
"""Index in `GRID` of the start of the test day."""

TRAINING_TIMES = np.arange(0.0, TRAINING_DAYS * DAY - 1e-9, TRAINING_SPACING)
READING_TIMES = np.concatenate([TRAINING_TIMES, np.arange(TRAINING_DAYS * DAY, (TRAINING_DAYS + 1) * DAY - 1e-9,
                                                          TEST_SPACING)])
"""Times of readings in training, and in all four days."""


@dataclass(frozen=True, eq=False)
class CallWindow:
    """Three days of training and a test day, for both tests.

    Attributes:
        date: date of the test day.
        arrivals: true rate of arrivals (672,) in each five minutes (customers/min).
        queues: test -> true number of customers (673,) on `GRID`.
        y: test -> readings (673, 1) as log(1 + customers), NaN where there is none; negative readings count as zero.
    """

    date: np.datetime64
    arrivals: np.ndarray
    queues: dict[str, np.ndarray]
    y: dict[str, np.ndarray]

    @property
    def training(self) -> np.ndarray:
        """Readings (63, 1) as log(1 + customers) at `TRAINING_TIMES`, equal for both tests."""
        return self.y["constant"][np.isin(GRID, TRAINING_TIMES)]


@functools.lru_cache(maxsize=4)
def load_days(data: str | None, weekday: str, seed: int) -> tuple[CallCounts, float]:
    """Return the days of one weekday, and the rate of arrivals that corresponds to one call (customers/min).

    Args:
        data: folder or file of counts; None for simulated counts.
        weekday: weekday.
        seed: seed of simulated counts.

    Raises:
        FileNotFoundError, ValueError: as `counts.read`, or there are too few days.
    """
    all_days = counts.simulate(34, seed) if data is None else counts.read(data)
    days = all_days if data is None else all_days.select_weekday(weekday)
    if len(days.dates) <= TRAINING_DAYS:
        raise ValueError(f"the counts have {len(days.dates)} days on a {weekday}; at least {TRAINING_DAYS + 1} are "
                         f"needed, {TRAINING_DAYS} for training and one for the test.")
    return days, UTILISATION * SERVICE_RATE / float(all_days.calls.mean())


def service_rates(test_rates: tuple[float, float]) -> np.ndarray:
    """Return the service rate (672,) in each five minutes of a window."""
    return np.repeat([SERVICE_RATE, *test_rates], [TEST_START, COUNTS_PER_DAY // 2, COUNTS_PER_DAY // 2])


def build_window(data: str | None, weekday: str, index: int, seed: int = 0) -> CallWindow:
    """Return the window of the days ``index`` to ``index + 3`` of a weekday; ``seed`` also seeds reading errors."""
    days, rate = load_days(data, weekday, seed)
    arrivals = rate * days.calls[index:index + TRAINING_DAYS + 1].ravel()
    errors = NOISE * np.random.default_rng([seed, index]).normal(size=len(GRID))
    with warnings.catch_warnings():  # the study reports overload of all test days in one warning
        warnings.simplefilter("ignore", counts.OverloadWarning)
        queues = {test: counts.queue(arrivals, service_rates(rates)) for test, rates in TEST_RATES.items()}
    is_reading = np.isin(GRID, READING_TIMES)
    y = {test: np.log1p(np.maximum(np.where(is_reading, path + errors, np.nan), 0.0))[:, None]
         for test, path in queues.items()}
    return CallWindow(days.dates[index + TRAINING_DAYS], arrivals, queues, y)


METHODS = ("SQM", "CQM", "WQM", "periodic", "Matern", "resonator")
"""Forces of the model file, where their names are in lower case."""


class ArrivalModel(NamedTuple):
    """Options of the model file: the force of the arrivals, their link, and the number of functions for one cycle."""

    force: str
    link: str = "linear"
    functions: int = 15

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters; all computations use their logarithms z."""
        return tuple(model_file().definitions["names"](self.force))


@functools.cache
def model_file() -> loading.ModelFile:
    """Return the shipped model."""
    return loading.load("call-centre")


@functools.cache
def posterior(arrival_model: ArrivalModel) -> LogPosterior:
    """Return the posterior of z as a function of the training readings (63, 1), compiled once for all windows."""
    with jax.ensure_compile_time_eval():
        bound = lfm.bind(model_file().model, TRAINING_TIMES, np.zeros((len(TRAINING_TIMES), 1)),
                         model_kwargs=arrival_model._asdict())
        return LogPosterior(bound, arrival_model.names, forward_mode=False)


def build_model(arrival_model: ArrivalModel, z: jax.Array, test_rates: jax.Array) -> Any:
    """Return the latent force model of a whole window, with service rates ``test_rates`` (2,) on the test day."""
    values = dict(zip(arrival_model.names, jnp.exp(z), strict=True))
    omega = lfm.Input([0.0, TRAINING_DAYS * DAY, (TRAINING_DAYS + 0.5) * DAY],
                      jnp.concatenate([jnp.array([SERVICE_RATE]), test_rates]))
    keywords = {**arrival_model._asdict(), "service": omega}
    return likelihood_site(model_file().model, (GRID,), keywords, jax.random.key(0), values).example.model
