"""Problems: a Gaussian process observed through a family, with counts from two sources or simulated data.

1. ``coal``: dates of coal-mining disasters, counted in bins of equal width, with a Poisson family.
2. ``calls-*``: calls of a bank in bins of twenty minutes, with Poisson and negative binomial families, each with and
   without a force of period one day.
3. ``bernoulli`` and ``student-t``: simulated binary data, and simulated measurements with outliers.
4. Each problem assigns its rows to folds at random. The folds are held out in turn to score predictions.

Sources: Nickisch, Solin and Grigorevskiy (ICML 2018) for 1; Weinberg, Brown and Stroud (2007) for 2.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pandas as pd

import lfm_ppl as lfm
from lfm_ppl.forces import Force, PeriodicSquaredExponential
from lfm_ppl.io import loading

from ..call_centre import counts

COAL = "coal"
CALLS = ("calls-poisson", "calls-poisson-daily", "calls-negative-binomial", "calls-negative-binomial-daily")
SIMULATED = ("bernoulli", "student-t")
NAMES = (COAL, *CALLS, *SIMULATED)

FIRST_DATE, LAST_DATE = 1851.2026, 1962.2218
"""15 March 1851 and 22 March 1962, the period of the disasters (years)."""

DISASTERS = Path("coal") / "coal.csv"
"""File with the dates of the disasters, in the folder of data."""

BINS_PER_COUNT, BLOCK, DAY_HOURS = 4, 6, 14.0
"""For calls: five-minute bins summed to one count, counts held out together (two hours), and length of a day (h)."""

OUTLIER, OUTLIER_SPACING = 4.0, 10
"""Size of the outliers in the simulated measurements, and rows from one to the next."""

TRUE_PARAMETERS = {"bernoulli": {"level": 0.0, "scale": 2.0, "lengthscale": 1.3},
                   "student-t": {"level": 0.0, "scale": 1.0, "lengthscale": 1.3, "noise": 0.2}}
"""Parameters of the simulated data."""


class ProblemSize(NamedTuple):
    """Number of bins of disasters, days of calls, rows of simulated data, and folds."""

    bins: int = 333
    days: int = 8
    rows: int = 200
    folds: int = 10


@dataclass(frozen=True, eq=False)
class CountsProblem:
    """A Gaussian process observed through a family.

    Attributes:
        times: times (T,).
        y: data (T, 1).
        folds: fold (T,) in which each row is held out.
        build_model: map from parameters by name to the model, whose predictor is a level plus all forces.
        priors: parameter -> prior, in the order of the table.
        true_parameters: parameters of simulated data; None if the parameters are learnt.
        truth: true predictor (T,); None if unknown.
        factors: factor settings of all methods. Near outliers, undamped factor updates diverge.
    """

    times: np.ndarray
    y: np.ndarray
    folds: np.ndarray
    build_model: Callable[..., lfm.LatentForceModel]
    priors: Mapping[str, dist.Distribution]
    true_parameters: Mapping[str, float] | None = None
    truth: np.ndarray | None = None
    factors: lfm.FactorSettings = lfm.FactorSettings()

    def model(self, times: Any, y: Any = None) -> None:
        """Sample the parameters and condition on the data: a NumPyro model."""
        values = {name: numpyro.sample(name, prior) for name, prior in self.priors.items()}
        numpyro.sample("y", lfm.MarginalLikelihood(self.build_model(**values), times), obs=y)


@functools.lru_cache(maxsize=8)
def build_problem(name: str, size: ProblemSize, seed: int, data: str | None) -> CountsProblem:
    """Return a problem of `NAMES`.

    Args:
        name: name of the problem.
        size: size of the data, and number of folds.
        seed: seed of simulated data and of the folds.
        data: folder with the folders ``coal`` and ``calls``; None for simulated counts.

    Raises:
        FileNotFoundError, ValueError: the data are missing or cannot be read.
    """
    if name in SIMULATED:
        return _build_simulated(name, size, seed)
    return _build_coal(size, seed, data) if name == COAL else _build_calls(name, size, seed, data)


def _build_model(family: Callable[..., Any], level: Any, scale: Any, lengthscale: Any, daily_scale: Any = None,
                 daily_lengthscale: Any = None, **family_parameters: Any) -> lfm.LatentForceModel:
    """Return a model without dynamics, whose predictor is the level plus the sum of the forces."""
    forces: dict[str, Force] = {"u": lfm.Matern(scale, lengthscale, order=1)}
    if daily_scale is not None:
        kernel = PeriodicSquaredExponential(daily_scale, daily_lengthscale, DAY_HOURS)
        # With half as many functions the log evidence of eight days is off by four nats.
        forces["daily"] = lfm.Periodic(kernel, functions=21, explained_variance=0.0)
    observation = family(lambda x, u, t: level + u.sum(keepdims=True), **family_parameters)
    return lfm.LatentForceModel(lambda x, u, t: jnp.zeros(0), forces, observation,
                                lfm.Gaussian(jnp.zeros(0), jnp.zeros((0, 0))))


def _assign_folds(rows: int, count: int, block: int, seed: Any) -> np.ndarray:
    """Return the fold of each row (rows,): blocks of rows are assigned to ``count`` folds at random."""
    block_folds = np.random.default_rng(seed).permutation(np.arange(-(-rows // block)) % count)
    return np.repeat(block_folds, block)[:rows]


def _build_coal(size: ProblemSize, seed: int, data: str | None) -> CountsProblem:
    definitions = loading.load("coal").definitions
    width = (LAST_DATE - FIRST_DATE) / size.bins
    build_model = functools.partial(definitions["build"], width=width)
    times = FIRST_DATE + width * (0.5 + np.arange(size.bins))
    if data is None:
        y = np.asarray(lfm.simulate(jax.random.key(seed), build_model(**definitions["TRUTH"]), times).y)
    else:
        dates = pd.read_csv(Path(data) / DISASTERS)["date"]
        times, y = definitions["count"](dates, FIRST_DATE, LAST_DATE, size.bins)
    priors = {"level": dist.Normal(0.0, 1.5), "scale": dist.LogNormal(-0.3, 0.6),
              "lengthscale": dist.LogNormal(3.0, 0.7)}
    folds = _assign_folds(size.bins, size.folds, 1, [seed, NAMES.index(COAL)])
    return CountsProblem(times, y, folds, build_model, priors)


def _build_calls(name: str, size: ProblemSize, seed: int, data: str | None) -> CountsProblem:
    days = counts.simulate(size.days, seed) if data is None else counts.read(Path(data) / "calls")
    if len(days.dates) < size.days:
        raise ValueError(f"there are {len(days.dates)} days of calls; {size.days} are needed.")
    y = days.calls[:size.days].reshape(-1, BINS_PER_COUNT).sum(axis=1)[:, None]
    times = BINS_PER_COUNT * counts.BIN / 60.0 * (0.5 + np.arange(len(y)))
    priors: dict[str, dist.Distribution] = {
        "level": dist.Normal(6.0, 1.5), "scale": dist.LogNormal(-1.5, 0.8), "lengthscale": dist.LogNormal(0.7, 0.8)}
    if name.endswith("daily"):
        priors |= {"daily_scale": dist.LogNormal(-1.0, 0.8), "daily_lengthscale": dist.LogNormal(-0.3, 0.5)}
    family: Callable[..., Any] = lfm.PoissonObservation
    if "negative" in name:
        family, priors["concentration"] = lfm.NegativeBinomialObservation, dist.LogNormal(4.0, 1.5)
    # The seed of the folds does not contain the name: all models of calls have the same folds.
    folds = _assign_folds(len(y), size.folds, BLOCK, seed)
    return CountsProblem(times, y.astype(float), folds, functools.partial(_build_model, family), priors)


def _build_simulated(name: str, size: ProblemSize, seed: int) -> CountsProblem:
    parameters, times = TRUE_PARAMETERS[name], 0.1 * np.arange(size.rows)
    build_model = functools.partial(_build_model, lfm.BernoulliObservation if name == "bernoulli" else
                                    lambda h, noise: lfm.StudentTObservation(h, 4.0, noise))
    key = jax.random.fold_in(jax.random.key(seed), NAMES.index(name))
    simulation = lfm.simulate(key, build_model(**parameters), times)
    y, factors = np.array(simulation.y), lfm.FactorSettings()
    if name == "student-t":
        y[OUTLIER_SPACING // 2::OUTLIER_SPACING] += OUTLIER
        factors = lfm.FactorSettings(damping=0.5, sweeps=2000)
    priors = {"level": dist.Normal(0.0, 1.0), "scale": dist.LogNormal(0.0, 0.5),
              "lengthscale": dist.LogNormal(0.3, 0.5), "noise": dist.LogNormal(-1.6, 0.5)}
    folds = _assign_folds(size.rows, size.folds, 1, [seed, NAMES.index(name)])
    return CountsProblem(times, y, folds, build_model, {key: priors[key] for key in parameters}, parameters,
                         np.asarray(simulation.forces["u"]), factors)
