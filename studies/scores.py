"""Scores of estimates, with standard errors.

1. Means, rates and ratios over independent data sets are `Estimate` objects: a value with its standard error.
2. A path with a band has a root mean squared error and a coverage (`score_path`).
3. A chain has means, standard deviations, intervals, effective sample sizes and R-hat (`diagnose`), and a Monte Carlo
   error of its standard deviations (`relative_errors_of_sd`).
4. A log likelihood on a grid becomes a posterior (`GridPosterior`): interpolate it by a cubic spline on each run of
   nodes with positive likelihood, exponentiate on a grid forty times as dense, and normalise by the trapezoidal rule.
5. Cell densities of a grid filter become quantiles (`density_quantiles`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr
from scipy.interpolate import make_interp_spline

from lfm_ppl.results import arviz_data
from lfm_ppl.utils import checks

Z = 1.959963984540054
"""Half the width of a 95% interval of a normal distribution, in standard deviations."""

SE = " se"
"""Suffix of a column with standard errors."""

_FINER = 40
"""Intervals of the fine grid in each interval of the nodes."""

_FLOOR = -700.0
"""Log density, relative to the largest one, below which the density counts as zero (exp underflows near -745)."""


class Estimate(NamedTuple):
    """A number with its standard error.

    Attributes:
        value: the number; NaN where there is none.
        error: its standard error; NaN where it is unknown.
    """

    value: float
    error: float

    def __str__(self) -> str:
        """Return ``value (error)``, rounded to two significant digits of the error."""
        if not np.isfinite(self.value):
            return "-"
        if not (np.isfinite(self.error) and self.error > 0):
            return f"{self.value:.3g}"
        digits = int(np.clip(1 - np.floor(np.log10(self.error)), 0, 6))
        return f"{self.value:.{digits}f} ({self.error:.{digits}f})"


def estimate_cells(name: str, estimate: Estimate) -> dict[str, float]:
    """Return the cells ``name`` and ``name se`` of a table row."""
    return {name: estimate.value, f"{name}{SE}": estimate.error}


def readable(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a table of text, with each estimate and its standard error in one cell such as ``0.91 (0.03)``."""
    columns: dict[str, list[str]] = {}
    for name in frame.columns:
        if name.endswith(SE):
            continue
        if not pd.api.types.is_numeric_dtype(frame[name]):
            columns[name] = frame[name].map(str).tolist()
            continue
        errors = frame.get(f"{name}{SE}", pd.Series(np.nan, frame.index))
        columns[name] = [str(Estimate(value, error)) for value, error in zip(frame[name], errors, strict=True)]
    return pd.DataFrame(columns, index=frame.index)


def estimate_mean(values: Any) -> Estimate:
    """Return the mean of independent numbers with its standard error, without NaN entries.

    Example:
        >>> str(estimate_mean([1.0, 2.0, 3.0]))
        '2.00 (0.58)'
    """
    finite = np.asarray(values, float).ravel()
    finite = finite[np.isfinite(finite)]
    if finite.size == 0:
        return Estimate(np.nan, np.nan)
    error = finite.std(ddof=1) / np.sqrt(finite.size) if finite.size > 1 else np.nan
    return Estimate(float(finite.mean()), float(error))


def sample_sd(values: Any) -> float:
    """Return the sample standard deviation of independent numbers; NaN for a single number."""
    sample = np.asarray(values, float)  # xarray's std would skip NaN
    return float(sample.std(ddof=1)) if sample.size > 1 else np.nan


def estimate_rate(hits: Any) -> Estimate:
    """Return the share of True among independent outcomes with its binomial standard error sqrt(p (1 - p) / n).

    Where all outcomes are equal, the error uses p = (k + 1) / (n + 2): k = 0 of n does not prove that p = 0.

    Example:
        >>> str(estimate_rate([True] * 20 + [False] * 80))
        '0.200 (0.040)'
    """
    outcomes = np.asarray(hits, bool).ravel()
    n, k = outcomes.size, int(outcomes.sum())
    if n == 0:
        return Estimate(np.nan, np.nan)
    p = k / n if 0 < k < n else (k + 1) / (n + 2)
    return Estimate(k / n, float(np.sqrt(p * (1 - p) / n)))


def paired_ratio(first: Any, second: Any) -> Estimate:
    """Return the ratio r of means of paired values, with the standard error of mean(first - r second) / mean(second).

    Example:
        >>> str(paired_ratio(np.array([1.0, 2.1]), np.array([2.0, 4.0])))
        '0.517 (0.011)'
    """
    first, second = np.asarray(first, float), np.asarray(second, float)
    ratio = first.mean() / second.mean()
    return Estimate(float(ratio), estimate_mean(first - ratio * second).error / float(second.mean()))


def rmse(estimate: Any, truth: Any) -> Any:
    """Return the root mean squared error over the last axis."""
    return np.sqrt(np.mean((np.asarray(estimate) - np.asarray(truth)) ** 2, axis=-1))


def interval_coverage(low: Any, high: Any, truth: Any) -> Any:
    """Return the share of entries of ``truth`` between ``low`` and ``high``, along the last axis."""
    truth = np.asarray(truth)
    return np.mean((np.asarray(low) <= truth) & (truth <= np.asarray(high)), axis=-1)


def interval(mean: Any, sd: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds of the 95% interval of a normal distribution."""
    mean, reach = np.asarray(mean), Z * np.asarray(sd)
    return mean - reach, mean + reach


def score_path(prefix: str, mean: Any, band: tuple[Any, Any], truth: Any) -> dict[str, Any]:
    """Return the error ``{prefix}_rmse`` of a path's mean (..., T) and the coverage ``{prefix}_coverage`` of its band.

    Example:
        >>> path_scores = score_path("smoother", [0.0, 1.0], interval([0.0, 1.0], [1.0, 1.0]), [0.0, 4.0])
        >>> {name: round(float(value), 3) for name, value in path_scores.items()}
        {'smoother_rmse': 2.121, 'smoother_coverage': 0.5}
    """
    return {f"{prefix}_rmse": rmse(mean, truth), f"{prefix}_coverage": interval_coverage(*band, truth)}


def thin_draws(draws: np.ndarray, count: int) -> np.ndarray:
    """Return ``count`` draws (count, P) at equal distances among the draws (P, chains, draws)."""
    flat = draws.reshape(len(draws), -1)
    return flat[:, np.linspace(0, flat.shape[1] - 1, count).round().astype(int)].T


def total_moments(mean: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation (...) of an equal mixture of S components with mean and variance (S, ...)."""
    return mean.mean(axis=0), np.sqrt(variance.mean(axis=0) + mean.var(axis=0))


def diagnose(names: Sequence[str], draws: np.ndarray) -> dict[str, np.ndarray]:
    """Return ``mean``, ``sd``, the 95% interval ``low`` and ``high``, bulk ``ess`` and ``r_hat`` of parameters.

    Args:
        names: names of the P parameters.
        draws: draws (P, chains, draws).

    Returns:
        Name -> array (P,).
    """
    dataset = xr.Dataset({name: (("chain", "draw"), row) for name, row in zip(names, draws, strict=True)})
    summary = arviz_data.summary(arviz_data.build({"posterior": dataset}))
    columns = {"mean": "mean", "sd": "sd", "low": "q2.5", "high": "q97.5", "ess": "ess_bulk", "r_hat": "r_hat"}
    return {name: summary[column].to_numpy() for name, column in columns.items()}


def relative_errors_of_sd(draws: np.ndarray) -> np.ndarray:
    """Return the relative Monte Carlo errors (P,) of the standard deviations of draws (P, chains, draws).

    By the delta method the relative error of s is the Monte Carlo error of the mean of ((x - m)^2 / s^2 - 1) / 2. It
    accounts for heavy tails and for the autocorrelation of the squares. NaN where all draws of a parameter are equal.
    """
    mean, variance = draws.mean(axis=(1, 2), keepdims=True), draws.var(axis=(1, 2), keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = 0.5 * ((draws - mean) ** 2 / variance - 1.0)
    return np.array([arviz_data.mcse_mean(row) for row in squares])


class GridPosterior:
    r"""Posterior of one parameter under a flat prior, from its log likelihood at the nodes of a grid.

        p(theta | y) = exp(L(theta)) / integral of exp(L)   on the interval spanned by the nodes.

    Between the nodes L is a cubic spline, which is exact for a Gaussian likelihood. Integrals use the trapezoidal rule
    on a grid forty times as dense. The density is zero between a node with zero or NaN likelihood and its neighbours. A
    likelihood counts as zero where L lies more than 700 below its maximum, so that the grid needs several nodes within
    the bulk of the posterior.

    Args:
        nodes: increasing nodes (G,), at least four.
        log_likelihood: log likelihood (G,); -inf where the likelihood is zero.

    Raises:
        ValueError: the nodes do not increase, the shapes differ, or no log likelihood is finite.

    Example:
        >>> nodes = np.linspace(-8.0, 10.0, 41)
        >>> posterior = GridPosterior(nodes, -0.5 * (nodes - 1.0) ** 2)
        >>> f"{posterior.mean:.4f} {posterior.sd:.4f} {posterior.quantile(0.975):.3f}"
        '1.0000 1.0000 2.960'
    """

    def __init__(self, nodes: Any, log_likelihood: Any) -> None:
        nodes, values = np.asarray(nodes, float), np.asarray(log_likelihood, float)
        checks.finite("nodes", nodes)
        if nodes.ndim != 1 or nodes.size < 4 or np.any(np.diff(nodes) <= 0):
            raise ValueError(f"nodes must be a vector of at least four increasing numbers, got shape {nodes.shape}.")
        if values.shape != nodes.shape:
            raise ValueError(f"log_likelihood must have the shape of nodes, {nodes.shape}, got {values.shape}.")
        if not np.isfinite(values).any():
            raise ValueError("log_likelihood is not finite at any node; choose nodes where the likelihood is positive.")
        relative = np.where(np.isnan(values), -np.inf, values) - np.max(values[np.isfinite(values)])
        self.x = np.unique(np.concatenate([np.linspace(a, b, _FINER + 1) for a, b in
                                           zip(nodes[:-1], nodes[1:], strict=True)]))
        log_density = np.full(self.x.size, -np.inf)
        possible = np.flatnonzero(relative > _FLOOR)
        for run in np.split(possible, np.flatnonzero(np.diff(possible) > 1) + 1):
            # A spline across a jump to zero likelihood would overshoot by more than the height of the peak.
            spline = make_interp_spline(nodes[run], relative[run], min(3, len(run) - 1))
            is_inside = (self.x >= nodes[run[0]]) & (self.x <= nodes[run[-1]])
            log_density[is_inside] = spline(self.x[is_inside])
        density = np.exp(log_density - log_density.max())
        steps = 0.5 * np.diff(self.x) * (density[1:] + density[:-1])
        self.density = density / steps.sum()
        self.distribution = np.concatenate([[0.0], np.cumsum(steps) / steps.sum()])

    @property
    def mean(self) -> float:
        """Posterior mean."""
        return float(np.trapezoid(self.density * self.x, self.x))

    @property
    def sd(self) -> float:
        """Posterior standard deviation."""
        return float(np.sqrt(np.trapezoid(self.density * (self.x - self.mean) ** 2, self.x)))

    def quantile(self, p: Any) -> Any:
        """Return the quantile of probability ``p``."""
        return np.interp(p, self.distribution, self.x)

    def cdf(self, value: float) -> float:
        """Return the posterior probability of a value below ``value``."""
        return float(np.interp(value, self.x, self.distribution))

    def is_cut_off(self, share: float = 0.01) -> bool:
        """Return whether the grid truncates the posterior: the density at an end exceeds ``share`` of its maximum."""
        return bool(max(self.density[0], self.density[-1]) > share * self.density.max())


def density_quantiles(x: Any, width: float, density: Any, p: Any) -> np.ndarray:
    """Return quantiles of piecewise constant densities on a regular grid.

    Args:
        x: cell centres (N,).
        width: cell width.
        density: densities (..., N).
        p: probabilities (Q,).

    Returns:
        Quantiles (Q, ...).

    Example:
        >>> density_quantiles([0.5, 1.5], 1.0, [[0.5, 0.5]], [0.25, 0.5]).ravel().tolist()
        [0.5, 1.0]
    """
    x, density, p = np.asarray(x, float), np.asarray(density, float), np.atleast_1d(np.asarray(p, float))
    edges = np.append(x - 0.5 * width, x[-1] + 0.5 * width)
    mass = np.maximum(density, 0.0).reshape(-1, x.size)
    distribution = np.concatenate([np.zeros((len(mass), 1)), np.cumsum(mass, axis=1)], axis=1)
    distribution /= distribution[:, -1:]
    quantiles = np.array([np.interp(p, row, edges) for row in distribution])
    return quantiles.T.reshape(p.size, *density.shape[:-1])
