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

JOINED, BLOCK, HOURS = 4, 6, 14.0
"""Of calls: counts of five minutes that are added to one; of these, how many are held out together, two hours; length
of a day."""

OUTLIER, EVERY = 4.0, 10
"""Gross errors of the simulated measurements, and how often there is one."""

GIVEN = {"bernoulli": {"level": 0.0, "scale": 2.0, "lengthscale": 1.3},
         "student-t": {"level": 0.0, "scale": 1.0, "lengthscale": 1.3, "noise": 0.2}}
"""Parameters of the simulated data."""


class Size(NamedTuple):
    """Bins of the disasters, days of calls, rows of the simulated data, and folds in which all are held out."""

    bins: int = 333
    days: int = 8
    rows: int = 200
    folds: int = 10


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


@functools.lru_cache(maxsize=8)
def problem(name: str, size: Size, seed: int, data: str | None) -> Problem:
    """Return a problem of `NAMES`, with data of the folders ``coal`` and ``calls`` in ``data``; None: simulated counts.

    Raises:
        FileNotFoundError, ValueError: data that are not there, or cannot be read.
    """
    if name in SIMULATED:
        return _simulated(name, size, seed)
    return _coal(size, seed, data) if name == COAL else _calls(name, size, seed, data)


def _build(family: Callable[..., Any], level: Any, scale: Any, lengthscale: Any, daily_scale: Any = None,
           daily_lengthscale: Any = None, **of_family: Any) -> lfm.LatentForceModel:
    """Return forces that are observed themselves: the predictor is the level and their sum."""
    forces: dict[str, Force] = {"u": lfm.Matern(scale, lengthscale, order=1)}
    if daily_scale is not None:
        kernel = PeriodicSquaredExponential(daily_scale, daily_lengthscale, HOURS)
        # With half of them the evidence of eight days is off by four nats.
        forces["daily"] = lfm.Periodic(kernel, functions=21, explained_variance=0.0)
    observation = family(lambda x, u, t: level + u.sum(keepdims=True), **of_family)
    return lfm.LatentForceModel(lambda x, u, t: jnp.zeros(0), forces, observation,
                                lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))


def _folds(rows: int, count: int, block: int, seed: Any) -> np.ndarray:
    """Return the fold of each row: blocks of rows, dealt out at random."""
    dealt = np.random.default_rng(seed).permutation(np.arange(-(-rows // block)) % count)
    return np.repeat(dealt, block)[:rows]


def _coal(size: Size, seed: int, data: str | None) -> Problem:
    functions = loading.load("coal").definitions
    width = (LAST - FIRST) / size.bins
    build = functools.partial(functions["build"], width=width)
    times = FIRST + width * (0.5 + np.arange(size.bins))
    if data is None:
        y = np.asarray(lfm.simulate(jax.random.key(seed), build(**functions["TRUTH"]), times).y)
    else:
        times, y = functions["count"](pd.read_csv(Path(data) / EVENTS)["date"], FIRST, LAST, size.bins)
    priors = {"level": dist.Normal(0.0, 1.5), "scale": dist.LogNormal(-0.3, 0.6),
              "lengthscale": dist.LogNormal(3.0, 0.7)}
    return Problem(times, y, _folds(size.bins, size.folds, 1, [seed, NAMES.index(COAL)]), build, priors)


def _calls(name: str, size: Size, seed: int, data: str | None) -> Problem:
    days = counts.simulated(size.days, seed) if data is None else counts.read(Path(data) / "calls")
    if len(days.dates) < size.days:
        raise ValueError(f"there are {len(days.dates)} days of calls; {size.days} are needed.")
    y = days.calls[:size.days].reshape(-1, JOINED).sum(axis=1)[:, None]
    times = JOINED * counts.BIN / 60.0 * (0.5 + np.arange(len(y)))
    priors: dict[str, dist.Distribution] = {
        "level": dist.Normal(6.0, 1.5), "scale": dist.LogNormal(-1.5, 0.8), "lengthscale": dist.LogNormal(0.7, 0.8)}
    if name.endswith("daily"):
        priors |= {"daily_scale": dist.LogNormal(-1.0, 0.8), "daily_lengthscale": dist.LogNormal(-0.3, 0.5)}
    family: Callable[..., Any] = lfm.PoissonObservation
    if "negative" in name:
        family, priors["concentration"] = lfm.NegativeBinomialObservation, dist.LogNormal(4.0, 1.5)
    # All models of calls have the same folds.
    return Problem(times, y.astype(float), _folds(len(y), size.folds, BLOCK, seed),
                   functools.partial(_build, family), priors)


def _simulated(name: str, size: Size, seed: int) -> Problem:
    given, times = GIVEN[name], 0.1 * np.arange(size.rows)
    build = functools.partial(_build, lfm.BernoulliObservation if name == "bernoulli" else
                              lambda h, noise: lfm.StudentTObservation(h, 4.0, noise))
    drawn = lfm.simulate(jax.random.fold_in(jax.random.key(seed), NAMES.index(name)), build(**given), times)
    y, sites = np.array(drawn.y), lfm.SiteSettings()
    if name == "student-t":
        y[EVERY // 2::EVERY] += OUTLIER
        sites = lfm.SiteSettings(damping=0.5, sweeps=2000)
    priors = {"level": dist.Normal(0.0, 1.0), "scale": dist.LogNormal(0.0, 0.5),
              "lengthscale": dist.LogNormal(0.3, 0.5), "noise": dist.LogNormal(-1.6, 0.5)}
    return Problem(times, y, _folds(size.rows, size.folds, 1, [seed, NAMES.index(name)]), build,
                   {key: priors[key] for key in given}, given, np.asarray(drawn.forces["u"]), sites)
