"""How good estimates are: errors, coverage, intervals of densities on a grid, and their standard errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr
from scipy.interpolate import make_interp_spline

from lfm_ppl import checks
from lfm_ppl.results import arviz_data

Z = 1.959963984540054
"""Half the width of a 95% interval, in standard deviations."""

SE = " se"
"""What the column of a standard error ends with."""

_FINER = 40
"""Nodes of the fine grid for one of the given grid."""

_FLOOR = -700.0
"""Log densities below the largest one by more than this are zero in double precision."""


class Estimate(NamedTuple):
    """A number with its standard error.

    Attributes:
        value: the number; NaN where there is none.
        error: its standard error; NaN where it cannot be told.
    """

    value: float
    error: float

    def __str__(self) -> str:
        """Return ``value (error)`` with the digits that the error leaves."""
        if not np.isfinite(self.value):
            return "-"
        if not (np.isfinite(self.error) and self.error > 0):
            return f"{self.value:.3g}"
        digits = int(np.clip(1 - np.floor(np.log10(self.error)), 0, 6))
        return f"{self.value:.{digits}f} ({self.error:.{digits}f})"


def pair(name: str, estimate: Estimate) -> dict[str, float]:
    """Return the entries ``name`` and ``name se`` of a row of a table."""
    return {name: estimate.value, f"{name}{SE}": estimate.error}


def readable(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a table with each estimate and its standard error in one cell, ``0.91 (0.03)``; text stays as it is."""
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


def mean_of(values: Any) -> Estimate:
    """Return the mean of independent numbers with its standard error; NaN entries are left out.

    Example:
        >>> str(mean_of([1.0, 2.0, 3.0]))
        '2.00 (0.58)'
    """
    known = np.asarray(values, float).ravel()
    known = known[np.isfinite(known)]
    if known.size == 0:
        return Estimate(np.nan, np.nan)
    error = known.std(ddof=1) / np.sqrt(known.size) if known.size > 1 else np.nan
    return Estimate(float(known.mean()), float(error))


def sd_of(values: Any) -> float:
    """Return the standard deviation of independent numbers; NaN of a single one."""
    known = np.asarray(values, float)  # xarray's own would leave NaN out
    return float(known.std(ddof=1)) if known.size > 1 else np.nan


def rate_of(hits: Any) -> Estimate:
    """Return the share of True among independent outcomes with its binomial standard error sqrt(p (1 - p) / n).

    Where all outcomes are the same, p in the error is (k + 1) / (n + 2), since none of n does not show that it never
    happens.

    Example:
        >>> str(rate_of([True] * 20 + [False] * 80))
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
    return Estimate(float(ratio), mean_of(first - ratio * second).error / float(second.mean()))


def rmse(estimate: Any, truth: Any) -> Any:
    """Return the root of the mean squared difference over the last axis."""
    return np.sqrt(np.mean((np.asarray(estimate) - np.asarray(truth)) ** 2, axis=-1))


def covered(low: Any, high: Any, truth: Any) -> Any:
    """Return the share of entries of ``truth`` along the last axis that lie between ``low`` and ``high``."""
    truth = np.asarray(truth)
    return np.mean((np.asarray(low) <= truth) & (truth <= np.asarray(high)), axis=-1)


def interval(mean: Any, sd: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of the 95% interval of a normal distribution."""
    mean, reach = np.asarray(mean), Z * np.asarray(sd)
    return mean - reach, mean + reach


def judged(what: str, mean: Any, band: tuple[Any, Any], truth: Any) -> dict[str, Any]:
    """Return ``{what}_rmse`` and ``{what}_coverage`` of paths (..., T): of their mean, and of their band.

    Example:
        >>> found = judged("smoother", [0.0, 1.0], interval([0.0, 1.0], [1.0, 1.0]), [0.0, 4.0])
        >>> {name: round(float(value), 3) for name, value in found.items()}
        {'smoother_rmse': 2.121, 'smoother_coverage': 0.5}
    """
    return {f"{what}_rmse": rmse(mean, truth), f"{what}_coverage": covered(*band, truth)}


def spread(draws: np.ndarray, count: int) -> np.ndarray:
    """Return ``count`` draws (count, P), spread evenly over draws (P, chains, draws)."""
    flat = draws.reshape(len(draws), -1)
    return flat[:, np.linspace(0, flat.shape[1] - 1, count).round().astype(int)].T


def total_moments(mean: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation (...) of a mixture of components with mean and variance (S, ...)."""
    return mean.mean(axis=0), np.sqrt(variance.mean(axis=0) + mean.var(axis=0))


def diagnose(names: Sequence[str], draws: np.ndarray) -> dict[str, np.ndarray]:
    """Return ``mean``, ``sd``, 95% interval ``low`` and ``high``, bulk ``ess`` and ``r_hat`` of parameters.

    Args:
        names: of the P parameters.
        draws: (P, chains, draws).

    Returns:
        Name -> array (P,).
    """
    dataset = xr.Dataset({name: (("chain", "draw"), row) for name, row in zip(names, draws, strict=True)})
    summary = arviz_data.summary(arviz_data.build({"posterior": dataset}))
    columns = {"mean": "mean", "sd": "sd", "low": "q2.5", "high": "q97.5", "ess": "ess_bulk", "r_hat": "r_hat"}
    return {name: summary[column].to_numpy() for name, column in columns.items()}


def relative_errors_of_sd(draws: np.ndarray) -> np.ndarray:
    """Return the Monte Carlo errors of standard deviations, as shares of them, (P,) of draws (P, chains, draws).

    The standard deviation s follows the mean of (x - m)^2, so that its error is s times that of the mean of
    ((x - m)^2 / s^2 - 1) / 2: larger for heavy tails than for a normal distribution, and with the autocorrelation of
    the squares. NaN where all draws of a parameter are equal.
    """
    mean, variance = draws.mean(axis=(1, 2), keepdims=True), draws.var(axis=(1, 2), keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = 0.5 * ((draws - mean) ** 2 / variance - 1.0)
    return np.array([arviz_data.mcse_mean(one) for one in squares])


class GridPosterior:
    r"""Posterior of one parameter under a flat prior, from its log likelihood at the nodes of a grid.

        p(theta | y) = exp(L(theta)) / integral of exp(L)   on the interval that the nodes span.

    Between the nodes L is a cubic spline, which is exact for a Gaussian likelihood; the integrals are trapezoidal
    sums on nodes forty times as dense. Between a node where the likelihood is zero, or NaN, and its neighbours there is
    no posterior. It counts as zero more than 700 below its peak: several nodes must lie where there is a posterior.

    Args:
        nodes: (G,), increasing; at least four.
        log_likelihood: (G,); -inf where the likelihood is zero.

    Raises:
        ValueError: nodes that do not increase, shapes that do not fit, or no finite log likelihood.

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
            raise ValueError("log_likelihood is nowhere finite: there is no posterior on these nodes.")
        relative = np.where(np.isnan(values), -np.inf, values) - np.max(values[np.isfinite(values)])
        self.x = np.unique(np.concatenate([np.linspace(a, b, _FINER + 1) for a, b in
                                           zip(nodes[:-1], nodes[1:], strict=True)]))
        log_density = np.full(self.x.size, -np.inf)
        possible = np.flatnonzero(relative > _FLOOR)
        for run in np.split(possible, np.flatnonzero(np.diff(possible) > 1) + 1):
            # A spline across the edge of a run would overshoot beside it, by more than the peak is high.
            spline = make_interp_spline(nodes[run], relative[run], min(3, len(run) - 1))
            inside = (self.x >= nodes[run[0]]) & (self.x <= nodes[run[-1]])
            log_density[inside] = spline(self.x[inside])
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
        """Return the value below which a share ``p`` of the posterior lies."""
        return np.interp(p, self.distribution, self.x)

    def below(self, value: float) -> float:
        """Return the posterior probability of a value below ``value``."""
        return float(np.interp(value, self.x, self.distribution))

    def cut(self, share: float = 0.01) -> bool:
        """Return whether an end of the grid cuts the posterior off: its density there is over ``share`` of the peak."""
        return bool(max(self.density[0], self.density[-1]) > share * self.density.max())


def density_quantiles(x: Any, width: float, density: Any, p: Any) -> np.ndarray:
    """Return quantiles of densities that are constant in the cells of a regular grid.

    Args:
        x: (N,) cell centres.
        width: of a cell.
        density: (..., N).
        p: (Q,) probabilities.

    Returns:
        (Q, ...).

    Example:
        >>> density_quantiles([0.5, 1.5], 1.0, [[0.5, 0.5]], [0.25, 0.5]).ravel().tolist()
        [0.5, 1.0]
    """
    x, density, p = np.asarray(x, float), np.asarray(density, float), np.atleast_1d(np.asarray(p, float))
    edges = np.append(x - 0.5 * width, x[-1] + 0.5 * width)
    mass = np.maximum(density, 0.0).reshape(-1, x.size)
    below = np.concatenate([np.zeros((len(mass), 1)), np.cumsum(mass, axis=1)], axis=1)
    below /= below[:, -1:]
    found = np.array([np.interp(p, row, edges) for row in below])
    return found.T.reshape(p.size, *density.shape[:-1])
