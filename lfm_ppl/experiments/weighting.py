"""A posterior by weighted draws of multivariate t distributions: at its mode first, then with its moments.

A second mode far from the first one is not seen, neither in the draws nor in the Pareto index of their weights.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import stats

from lfm_ppl.analysis import importance
from lfm_ppl.inference.optimise import Minimum

FREEDOM = (3, 5)
"""Degrees of freedom of the first and the second t distribution."""

WIDER = (1.2, 1.05)
"""How much wider they are than the curvature and the weighted moments say."""

_LEAST = 0.01
"""Share of the first covariance that is added to the weighted one: a few draws with all the weight make it singular."""


class Weighted(NamedTuple):
    """Draws (D, P) with their importance weights."""

    draws: np.ndarray
    weights: importance.Importance


def weighted(log_density: Callable[[np.ndarray], np.ndarray], mode: Minimum, count: int, seed: int) -> Weighted:
    """Return weighted draws of a density.

    Args:
        log_density: of draws (count, P).
        mode: of the density.
        count: draws that are returned; a third as many go before them.
        seed: of the draws.

    Raises:
        ValueError: there is no curvature at the mode.
    """
    if mode.curvature is None:
        raise ValueError("the posterior has no curvature at its mode; its derivatives there are not finite.")
    generator = np.random.default_rng(seed)
    centre, covariance = mode.point, mode.curvature.factor @ mode.curvature.factor.T
    for freedom, wider, size in zip(FREEDOM, WIDER, (max(count // 3, 30), count), strict=True):
        proposal = stats.multivariate_t(centre, wider**2 * covariance, df=freedom)
        draws = proposal.rvs(size, random_state=generator)
        log_ratio = log_density(draws) - proposal.logpdf(draws)
        weights = importance.smooth(np.where(np.isfinite(log_ratio), log_ratio, -np.inf)[None])
        centre, spread = moments(draws, np.exp(weights.log_weight[0]))
        covariance = spread + _LEAST * covariance
    return Weighted(draws, weights)


def moments(draws: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean (P,) and covariance (P, P) of draws (D, P) with weights (D,) that sum to one."""
    mean = weight @ draws
    return mean, (draws - mean).T @ ((draws - mean) * weight[:, None])
