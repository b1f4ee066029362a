"""A posterior by weighted draws of multivariate t distributions: at its modes first, then with the moments about them.

With several modes the proposal is the mixture of one t distribution about each,

    q(z) = sum_k (n_k / n) t_k(z),    w_i proportional to p(z_i) / q(z_i),

and n_k of the n draws come from the k-th. A mode that is not given and lies far from those that are is not seen,
neither in the draws nor in the Pareto index of their weights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import special, stats

from lfm_ppl.analysis import importance
from lfm_ppl.inference.optimise import Minimum

FREEDOM = (3, 5)
"""Degrees of freedom of the first and the second t distribution."""

WIDER = (1.2, 1.05)
"""How much wider they are than the curvature and the weighted moments say."""

LEAST_SHARE = 0.1
"""A mode gets at least this share of the draws, before shares are made to sum to one: how much of the posterior is
there has to be learnt from them."""

_LEAST = 0.01
"""Share of the first covariance that is added to the weighted one: a few draws with all the weight make it singular."""


class Weighted(NamedTuple):
    """Draws from a posterior.

    Attributes:
        draws: (D, P).
        weights: their importance weights.
        mass: (K,) share of the posterior about each mode; sums to one.
    """

    draws: np.ndarray
    weights: importance.Importance
    mass: np.ndarray


def weighted(log_density: Callable[[np.ndarray], np.ndarray], modes: Sequence[Minimum], count: int,
             seed: int) -> Weighted:
    """Return weighted draws of a density.

    Args:
        log_density: of draws (count, P).
        modes: of the density; those without curvature are left out.
        count: draws that are returned, though at least one for each mode; for each mode a third as many go before
            them.
        seed: of the draws.

    Raises:
        ValueError: there is no curvature at any mode.
    """
    used = [mode for mode in modes if mode.curvature is not None]
    if not used:
        raise ValueError("the posterior has no curvature at its mode; its derivatives there are not finite.")
    generator = np.random.default_rng(seed)
    about = [(mode.point, mode.curvature.factor @ mode.curvature.factor.T) for mode in used]
    sizes = np.full(len(used), max(count // 3, 30))
    for freedom, wider in zip(FREEDOM, WIDER, strict=True):
        proposals = [stats.multivariate_t(centre, wider**2 * covariance, df=freedom) for centre, covariance in about]
        draws = np.concatenate([proposal.rvs(size, random_state=generator).reshape(size, -1)
                                for proposal, size in zip(proposals, sizes, strict=True)])
        parts = np.stack([proposal.logpdf(draws) for proposal in proposals]) + np.log(sizes / sizes.sum())[:, None]
        log_proposal = special.logsumexp(parts, axis=0)
        log_ratio = log_density(draws) - log_proposal
        weights = importance.smooth(np.where(np.isfinite(log_ratio), log_ratio, -np.inf)[None])
        # Each draw counts for a mode as far as its proposal made it.
        weight = np.exp(weights.log_weight[0] + parts - log_proposal)
        mass = weight.sum(axis=1)
        about = [_next(draws, own, *one) for own, one in zip(weight, about, strict=True)]
        share = np.maximum(mass, LEAST_SHARE)
        sizes = _shared_out(count, share / share.sum())
    return Weighted(draws, weights, mass)


def _next(draws: np.ndarray, weight: np.ndarray, centre: np.ndarray,
          covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted moments, with a little of the covariance of before; as before where nothing has weight."""
    if not weight.sum() > 0:
        return centre, covariance
    mean, spread = moments(draws, weight / weight.sum())
    return mean, spread + _LEAST * covariance


def _shared_out(count: int, share: np.ndarray) -> np.ndarray:
    """Return positive integers (K,) that sum to ``count`` where it is large enough, by shares (K,) that sum to one."""
    return np.maximum(np.diff(np.round(count * np.append(0.0, np.cumsum(share)))).astype(int), 1)


def moments(draws: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean (P,) and covariance (P, P) of draws (D, P) with weights (D,) that sum to one."""
    mean = weight @ draws
    return mean, (draws - mean).T @ ((draws - mean) * weight[:, None])
