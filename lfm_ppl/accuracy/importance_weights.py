"""Importance weights of posterior draws, and moments corrected by them.

1. Average the replicates of the reference likelihood of each draw, with the variance of the average.
2. Smooth the largest ratios by a generalised Pareto distribution; its index k measures reliability.
3. Correct means and standard deviations by the weights, with standard errors of the changes (the delta method).

Source: Vehtari et al. (2024), JMLR 25(72).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pandas as pd

from lfm_ppl.results import arviz_data

LARGEST_K = 0.7
"""Pareto k above which no affordable number of draws gives a reliable mean."""

COLUMNS = ("mean", "sd", "corrected_mean", "corrected_sd", "shift", "shift_se", "sd_ratio", "sd_ratio_se",
           "corrected_mean_se")


class Importance(NamedTuple):
    """Pareto-smoothed importance weights.

    Attributes:
        log_weight: (C, S), normalised: the weights sum to one.
        k: Pareto shape of the tail of the ratios; -inf where all ratios are equal, +inf where too few draws.
        threshold: k below which the weighted means of S draws are reliable, ``min(1 - 1 / log10 S, 0.7)``.
        ess: effective number of draws, one over the sum of the squared weights.
    """

    log_weight: np.ndarray
    k: float
    threshold: float
    ess: float

    @property
    def reliable(self) -> bool:
        """Whether k is below its threshold."""
        return self.k < self.threshold


class Averaged(NamedTuple):
    """Noisy log likelihoods, averaged over replicates.

    Attributes:
        log_mean: (...), log of the mean of the likelihoods, whose expectation is the likelihood.
        variance: (...), of log_mean over repetitions; NaN of a single replicate, and where all replicates find the data
            impossible; infinite where all but one do.
    """

    log_mean: np.ndarray
    variance: np.ndarray


def smooth(log_ratio: np.ndarray, relative_efficiency: float = 1.0) -> Importance:
    """Return Pareto-smoothed, normalised importance weights of draws.

    The M largest ratios are replaced by the expected order statistics of a generalised Pareto distribution that is
    fitted to them. Its shape k tells how heavy their tail is: ratios have a finite variance below 1/2, a finite mean
    below 1.

    Args:
        log_ratio: (C, S) log ratios of the target's density to that of the draws, up to a constant; -inf for a draw
            that the target does not allow.
        relative_efficiency: effective draws for each draw, at most 1, which sets how many ratios count as the tail.

    Returns:
        The weights.

    Raises:
        ValueError: a ratio is NaN or +inf, or all are -inf.

    Example:
        >>> found = smooth(np.random.default_rng(0).normal(size=(4, 50)))
        >>> found.reliable, round(float(np.exp(found.log_weight).sum()), 12)
        (True, 1.0)

    Source: Vehtari et al. (2024), Pareto smoothed importance sampling, JMLR 25(72).
    """
    log_ratio = np.asarray(log_ratio, float)
    if np.isnan(log_ratio).any() or np.isposinf(log_ratio).any():
        raise ValueError("the log ratios must be numbers or -inf; got NaN or +inf.")
    if not np.isfinite(log_ratio).any():
        raise ValueError("the reference gives every draw a likelihood of zero.")
    log_weight, k = arviz_data.psis(log_ratio.ravel(), relative_efficiency)
    count = log_ratio.size
    threshold = min(1.0 - 1.0 / math.log10(count), LARGEST_K) if count > 1 else 0.0
    return Importance(log_weight.reshape(log_ratio.shape), k, threshold, float(1.0 / np.exp(2.0 * log_weight).sum()))


def average(estimates: np.ndarray) -> Averaged:
    """Average unbiased estimates of likelihoods over replicates, and tell what noise is left.

    The variance of the log of the mean is that of the jackknife, ``(R - 1) / R sum_r (l_-r - mean)^2``, where l_-r
    leaves out replicate r. It assumes no distribution of the estimates.

    Args:
        estimates: (..., R) log likelihoods of R replicates.

    Example:
        >>> average(np.log([[1.0, 3.0]])).log_mean.round(3).tolist()
        [0.693]
    """
    estimates = np.asarray(estimates, float)
    replicates = estimates.shape[-1]
    log_mean = _log_mean(estimates)
    if replicates == 1:
        return Averaged(log_mean, np.full(log_mean.shape, np.nan))
    left_out = np.stack([_log_mean(np.delete(estimates, r, axis=-1)) for r in range(replicates)], axis=-1)
    with np.errstate(invalid="ignore"):  # of a draw that some or all replicates find impossible
        variance = (replicates - 1) * left_out.var(axis=-1)
    return Averaged(log_mean, np.where(np.isfinite(estimates).sum(axis=-1) == 1, np.inf, variance))


def _log_mean(logs: np.ndarray) -> np.ndarray:
    largest = logs.max(axis=-1, keepdims=True)
    largest = np.where(np.isfinite(largest), largest, 0.0)
    with np.errstate(divide="ignore"):
        return np.log(np.exp(logs - largest).mean(axis=-1)) + largest[..., 0]


def corrected_moments(draws: Mapping[str, np.ndarray], draw_index: np.ndarray, log_weight: np.ndarray) -> pd.DataFrame:
    """Return mean and sd of every scalar before and after weighting, with Monte Carlo standard errors.

    Ratios w_i are known for a subset of the draws x_i. What they change is estimated on the subset alone and added to
    what all draws say, so that the draws' own Monte Carlo error cancels in the change:

        corrected mean = mean(all) + sum_i w_i x_i - mean(subset),
        corrected sd = sd(all) * sd_w(subset) / sd(subset).

    The standard errors are standard errors of the linearised changes (the delta method),

        phi_i = S w_i (x_i - m_w) - (x_i - m),    psi_i = [S w_i ((x_i - m_w)^2 / v_w - 1) - ((x_i - m)^2 / v - 1)] / 2,

    whose effective sample size accounts for the chains. Noise in the ratios is part of the weights that phi and psi
    vary with, and so part of the standard errors.

    Args:
        draws: label -> (C, N), all draws of scalars.
        draw_index: (S,), draws of each chain that have weights.
        log_weight: (C, S), normalised.

    Returns:
        A table with one row for each scalar: mean, sd, corrected_mean, corrected_sd, shift (the change of the mean in
        sds), shift_se, sd_ratio, sd_ratio_se, and corrected_mean_se.

    Source: Owen (2013), Monte Carlo theory, methods and examples, section 9.2, for the delta method.
    """
    weight = np.exp(log_weight) * log_weight.size
    rows = {label: _corrected(np.asarray(values, float), draw_index, weight) for label, values in draws.items()}
    return pd.DataFrame.from_dict(rows, orient="index", columns=list(COLUMNS), dtype=float)


def _corrected(values: np.ndarray, draw_index: np.ndarray, weight: np.ndarray) -> tuple[float, ...]:
    mean, sd = float(values.mean()), float(values.std(ddof=1)) if values.size > 1 else 0.0
    if np.ptp(values) == 0.0:  # fixed, or derived from what is fixed
        return mean, 0.0, mean, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0
    if np.ptp(weight) == 0.0:
        return mean, sd, mean, sd, 0.0, 0.0, 1.0, 0.0, arviz_data.mcse_mean(values)
    x = values[:, draw_index]
    m, v = x.mean(), x.var()
    m_w = (weight * x).mean()
    v_w = (weight * (x - m_w) ** 2).mean()
    phi = weight * (x - m_w) - (x - m)
    change, change_se = float(m_w - m), arviz_data.mcse_mean(phi)
    psi = 0.5 * (weight * ((x - m_w) ** 2 / v_w - 1.0) - ((x - m) ** 2 / v - 1.0)) if v_w > 0 else np.nan * x
    ratio = math.sqrt(v_w / v)
    # The mean of all draws shares the subset with the change.
    shared = 2.0 * float((phi * (x - m)).mean()) / values.size
    total = math.sqrt(max(arviz_data.mcse_mean(values) ** 2 + change_se**2 + shared, 0.0))
    return (mean, sd, mean + change, sd * ratio, change / sd, change_se / sd, ratio,
            ratio * arviz_data.mcse_mean(psi), total)


def resample(log_weight: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
    """Return (count,) indices of draws, each as often as its weight says, in random order.

    Systematic resampling: the number of copies of a draw is its expected number, rounded up or down.

    Args:
        log_weight: normalised, of any shape; the indices are into the flat array.
        count: number of indices.
        seed: of the offset and the order.

    Example:
        >>> sorted(resample(np.log([0.5, 0.25, 0.25]), 4).tolist())
        [0, 0, 1, 2]
    """
    generator = np.random.default_rng(seed)
    cumulative = np.cumsum(np.exp(np.ravel(log_weight)))
    positions = (np.arange(count) + generator.uniform()) / count
    index = np.searchsorted(cumulative / cumulative[-1], positions)
    return generator.permutation(index)
