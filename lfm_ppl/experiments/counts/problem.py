"""The problems: a Gaussian process that is observed through a family, with counts of two sources or simulated data."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pandas as pd

import lfm_ppl as lfm
from lfm_ppl import loading
from lfm_ppl.experiments.call_centre import counts
from lfm_ppl.forces import Force, PeriodicSquaredExponential

COAL = "coal"
CALLS = ("calls-poisson", "calls-poisson-daily", "calls-negative-binomial", "calls-negative-binomial-daily")
SIMULATED = ("bernoulli", "student-t")
NAMES = (COAL, *CALLS, *SIMULATED)

FIRST, LAST = 1851.2026, 1962.2218
"""15 March 1851 and 22 March 1962, between which the disasters were counted (years)."""

EVENTS = Path("coal") / "coal.csv"
"""The dates of the disasters, in the folder of data."""

JOINED = 4
"""Counts of five minutes that are added to one."""

BLOCK = 6
"""Counts of calls that are held out together: two hours."""

HOURS = 14.0
"""Length of a day of calls."""

OUTLIER, EVERY = 4.0, 10
"""Gross errors of the simulated measurements, and how often there is one."""


class Problem(NamedTuple):
    """A Gaussian process, observed through a family.

    Attributes:
        times: (T,).
        y: (T, 1).
        folds: (T,), the fold in which an entry is held out.
        build: parameters by name -> the model; its predictor is a level plus all forces.
        priors: name -> prior of the parameters, in the order of the table.
        given: the parameters where they are known; None: they are learnt.
        truth: (T,) the predictor; None where nobody knows it.
        sites: how they are refined, whatever the method. Near gross errors whole new ones run away from where they
            converge.
    """

    times: np.ndarray
    y: np.ndarray
    folds: np.ndarray
    build: Callable[..., lfm.LatentForceModel]
    priors: Mapping[str, dist.Distribution]
    given: Mapping[str, float] | None = None
    truth: np.ndarray | None = None
    sites: lfm.SiteSettings = lfm.SiteSettings()

    def model(self, times: Any, y: Any = None) -> None:
        """Sample the parameters, and score the data."""
        values = {name: numpyro.sample(name, prior) for name, prior in self.priors.items()}
        numpyro.sample("y", lfm.MarginalLikelihood(self.build(**values), times), obs=y)


class Size(NamedTuple):
    """How large the problems are.

    Attributes:
        bins: of the disasters.
        days: of calls.
        rows: of the simulated data.
        folds: in which data are held out.
    """

    bins: int = 333
    days: int = 8
    rows: int = 200
    folds: int = 10


@functools.lru_cache(maxsize=8)
def problem(name: str, size: Size, seed: int, data: str | None) -> Problem:
    """Return a problem.

    Args:
        name: one of `NAMES`.
        size: of it.
        seed: of the simulated data, and of the folds.
        data: a folder with the folders ``coal`` and ``calls``; None: simulated counts.

    Raises:
        FileNotFoundError, ValueError: data that are not there, or cannot be read.
    """
    generator = np.random.default_rng([seed, NAMES.index(name)])
    if name == COAL:
        return _coal(size, seed, data, generator)
    return _calls(name, size, seed, data, generator) if name in CALLS else _simulated(name, size, seed, generator)


def process(forces: Mapping[str, Force], observation: Any, level: Any) -> lfm.LatentForceModel:
    """Return forces that are observed themselves: the predictor is the level and their sum."""
    return lfm.LatentForceModel(lambda x, u, t: jnp.zeros(0), dict(forces),
                                observation(lambda x, u, t: level + u.sum(keepdims=True)),
                                lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))


def _folds(rows: int, count: int, block: int, generator: np.random.Generator) -> np.ndarray:
    """Return the fold of each row: blocks of rows, dealt out at random."""
    blocks = -(-rows // block)
    return np.repeat(generator.permutation(np.arange(blocks) % count), block)[:rows]


def _coal(size: Size, seed: int, data: str | None, generator: np.random.Generator) -> Problem:
    file = loading.load("coal")
    functions = file.model.__globals__
    width = (LAST - FIRST) / size.bins
    times = FIRST + width * (0.5 + np.arange(size.bins))
    if data is None:
        system = functions["build"](**functions["TRUTH"], width=width)
        y = np.asarray(lfm.simulate(jax.random.key(seed), system, times).y)
    else:
        times, y = functions["count"](pd.read_csv(Path(data) / EVENTS)["date"], FIRST, LAST, size.bins)

    def build(level: Any, scale: Any, lengthscale: Any) -> lfm.LatentForceModel:
        force = lfm.Matern(scale, lengthscale, order=2)
        return process({"log rate": force}, lambda h: lfm.PoissonObservation(h, exposure=width), level)

    priors = {"level": dist.Normal(0.0, 1.5), "scale": dist.LogNormal(-0.3, 0.6),
              "lengthscale": dist.LogNormal(3.0, 0.7)}
    return Problem(times, y, _folds(size.bins, size.folds, 1, generator), build, priors)


def _calls(name: str, size: Size, seed: int, data: str | None, generator: np.random.Generator) -> Problem:
    days = counts.simulated(size.days, seed) if data is None else counts.read(Path(data) / "calls")
    if len(days.dates) < size.days:
        raise ValueError(f"there are {len(days.dates)} days of calls; {size.days} are needed.")
    y = days.calls[:size.days].reshape(-1, JOINED).sum(axis=1)[:, None]
    step = JOINED * counts.BIN / 60.0
    times = step * (0.5 + np.arange(len(y)))
    daily, overdispersed = name.endswith("daily"), "negative" in name
    priors: dict[str, dist.Distribution] = {
        "level": dist.Normal(6.0, 1.5), "scale": dist.LogNormal(-1.5, 0.8), "lengthscale": dist.LogNormal(0.7, 0.8)}
    if daily:
        priors |= {"daily_scale": dist.LogNormal(-1.0, 0.8), "daily_lengthscale": dist.LogNormal(-0.3, 0.5)}
    if overdispersed:
        priors["concentration"] = dist.LogNormal(4.0, 1.5)

    def build(level: Any, scale: Any, lengthscale: Any, daily_scale: Any = None, daily_lengthscale: Any = None,
              concentration: Any = None) -> lfm.LatentForceModel:
        forces: dict[str, Force] = {"trend": lfm.Matern(scale, lengthscale, order=1)}
        if daily:
            kernel = PeriodicSquaredExponential(daily_scale, daily_lengthscale, HOURS)
            # With half of them the evidence of eight days is off by four nats.
            forces["daily"] = lfm.Periodic(kernel, functions=21, explained_variance=0.0)
        family = ((lambda h: lfm.NegativeBinomialObservation(h, concentration)) if overdispersed
                  else lfm.PoissonObservation)
        return process(forces, family, level)

    # All models of calls have the same folds.
    folds = _folds(len(y), size.folds, BLOCK, np.random.default_rng(seed))
    return Problem(times, y.astype(float), folds, build, priors)


def _simulated(name: str, size: Size, seed: int, generator: np.random.Generator) -> Problem:
    given = {"level": 0.0, "scale": 2.0, "lengthscale": 1.3} if name == "bernoulli" else {
        "level": 0.0, "scale": 1.0, "lengthscale": 1.3, "noise": 0.2}
    times = 0.1 * np.arange(size.rows)

    def build(level: Any, scale: Any, lengthscale: Any, noise: Any = None) -> lfm.LatentForceModel:
        family = lfm.BernoulliObservation if noise is None else lambda h: lfm.StudentTObservation(h, 4.0, noise)
        return process({"u": lfm.Matern(scale, lengthscale, order=1)}, family, level)

    drawn = lfm.simulate(jax.random.fold_in(jax.random.key(seed), NAMES.index(name)), build(**given), times)
    y = np.array(drawn.y)
    if name == "student-t":
        y[EVERY // 2::EVERY] += OUTLIER
    priors = {"level": dist.Normal(0.0, 1.0), "scale": dist.LogNormal(0.0, 0.5),
              "lengthscale": dist.LogNormal(0.3, 0.5), "noise": dist.LogNormal(-1.6, 0.5)}
    return Problem(times, y, _folds(size.rows, size.folds, 1, generator), build,
                   {key: priors[key] for key in given}, given, np.asarray(drawn.forces["u"]),
                   lfm.SiteSettings(damping=0.5, sweeps=2000) if name == "student-t" else lfm.SiteSettings())
