"""The problem: windows of four same weekdays, their queues and readings, and the model that tracks them."""

from __future__ import annotations

import functools
import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import loading
from lfm_ppl.experiments.call_centre import counts
from lfm_ppl.experiments.call_centre.counts import BIN, DAY, OPEN, Counts
from lfm_ppl.inference.bound_model import bind
from lfm_ppl.inference.likelihood_site import likelihood_site
from lfm_ppl.inference.log_posterior import LogPosterior
from lfm_ppl.model.inputs import Input

UTILISATION = 0.7
"""Mean rate of arrivals over all days, as a share of `SERVICE`: the queue of a middling Thursday then reaches some 25
customers at that rate, as in the source's figure."""

SERVICE = 10.0
"""Service rate of training (customers/min)."""

TESTED = {"constant": (10.0, 10.0), "changed": (15.0, 5.0)}
"""Test -> service rates in the two halves of the test day (customers/min)."""

NOISE = 0.5
"""Standard deviation of the error of a reading (customers); the source does not give its own."""

TRAIN, EVERY, RARELY = 3, 40.0, 180.0
"""Days of training before the test day, and minutes between readings, in training and on the test day."""

GRID = BIN * np.arange((TRAIN + 1) * OPEN + 1)
"""(673,) ends of all counts, in minutes."""

FIRST = TRAIN * OPEN
"""Index in `GRID` of the beginning of the test day."""

TRAINING = np.arange(0.0, TRAIN * DAY - 1e-9, EVERY)
READ = np.concatenate([TRAINING, np.arange(TRAIN * DAY, (TRAIN + 1) * DAY - 1e-9, RARELY)])
"""Times of readings: of training, and of all four days."""


class Window(NamedTuple):
    """Three days to learn from and one to track, whose ``date`` it is, at both service rates.

    Attributes:
        arrivals: (672,) true rate in each five minutes (customers/min).
        queues: test -> (673,) true number of customers on `GRID`.
        y: test -> (673, 1) readings as log(1 + customers), NaN where there is none; those below zero as zero.
    """

    date: np.datetime64
    arrivals: np.ndarray
    queues: dict[str, np.ndarray]
    y: dict[str, np.ndarray]

    @property
    def training(self) -> np.ndarray:
        """Readings (63, 1) as log(1 + customers) at the times `TRAINING`, alike for both service rates."""
        return self.y["constant"][np.isin(GRID, TRAINING)]


@functools.lru_cache(maxsize=4)
def days(data: str | None, weekday: str, seed: int) -> tuple[Counts, float]:
    """Return the days of one weekday, and the rate that one call of their counts stands for (customers/min).

    The data are a folder or file of counts, None: simulated ones, of this seed. Raises FileNotFoundError or ValueError
    as `counts.read`, or because there are too few days.
    """
    everything = counts.simulated(34, seed) if data is None else counts.read(data)
    chosen = everything if data is None else everything.on(weekday)
    if len(chosen.dates) <= TRAIN:
        raise ValueError(f"there are {len(chosen.dates)} days that are {weekday}; {TRAIN} to learn from and one to "
                         "track are needed.")
    return chosen, UTILISATION * SERVICE / float(everything.calls.mean())


def service(tested: tuple[float, float]) -> np.ndarray:
    """Return the service rate (672,) in each five minutes of a window."""
    return np.repeat([SERVICE, *tested], [FIRST, OPEN // 2, OPEN // 2])


def window(data: str | None, weekday: str, index: int, seed: int = 0) -> Window:
    """Return the days ``index``, from zero, to ``index + 3`` of a weekday, see `days`; the seed is of errors, too."""
    chosen, rate = days(data, weekday, seed)
    arrivals = rate * chosen.calls[index:index + TRAIN + 1].ravel()
    errors = NOISE * np.random.default_rng([seed, index]).normal(size=len(GRID))
    with warnings.catch_warnings():  # the study says on how many days queues grow for hours
        warnings.simplefilter("ignore", counts.OverloadWarning)
        queues = {test: counts.queue(arrivals, service(rates)) for test, rates in TESTED.items()}
    y = {test: np.log1p(np.maximum(np.where(np.isin(GRID, READ), path + errors, np.nan), 0.0))[:, None]
         for test, path in queues.items()}
    return Window(chosen.dates[index + TRAIN], arrivals, queues, y)


METHODS = ("SQM", "CQM", "WQM", "periodic", "Matern", "resonator")
"""Forces of the model file, which writes them in lower case."""


class Method(NamedTuple):
    """A model of the arrivals: options of the model file, with the number of ``functions`` of which a cycle is made."""

    force: str
    link: str = "linear"
    functions: int = 15

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters; everything here is in their logarithms z."""
        return tuple(model_file().definitions["names"](self.force))


@functools.cache
def model_file() -> loading.ModelFile:
    """Return the shipped model."""
    return loading.load("call-centre")


@functools.cache
def posterior(method: Method) -> LogPosterior:
    """Return the posterior given the training, readings (63, 1) as logarithms; compiled once for all windows."""
    with jax.ensure_compile_time_eval():
        bound = bind(model_file().model, TRAINING, np.zeros((len(TRAINING), 1)), **method._asdict())
        return LogPosterior(bound, method.names, forward_mode=False)


def system(method: Method, z: jax.Array, tested: jax.Array) -> Any:
    """Return the latent force model of a whole window, with service rates ``tested`` (2,) on the test day."""
    values = dict(zip(method.names, jnp.exp(z), strict=True))
    omega = Input([0.0, TRAIN * DAY, (TRAIN + 0.5) * DAY], jnp.concatenate([jnp.array([SERVICE]), tested]))
    keywords = {**method._asdict(), "service": omega}
    return likelihood_site(model_file().model, (GRID,), keywords, jax.random.key(0), values).example.model
