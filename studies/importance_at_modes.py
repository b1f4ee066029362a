"""Importance samples of a posterior, from multivariate t distributions at its modes, then with the moments about them.

With several modes the proposal is the mixture of one t distribution about each,

    q(z) = sum_k (n_k / n) t_k(z),    w_i proportional to p(z_i) / q(z_i),

and n_k of the n draws come from the k-th. How much of the posterior is about each mode say the mixture weights m_k with
which sum_k m_k t_k fits the weighted draws best. A mode that is not given and lies far from those that are is not seen,
neither in the draws nor in the Pareto index of their weights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import special, stats

from lfm_ppl.accuracy import importance_weights
from lfm_ppl.inference.optimise import Minimum

from .log_posterior import LogPosterior

FREEDOM = (3, 5)
"""Degrees of freedom of the first and the second t distribution."""

WIDER = (1.2, 1.05)
"""How much wider they are than the curvature and the weighted moments say."""

LEAST_SHARE = 0.1
"""A mode gets at least this share of the draws, before shares are made to sum to one: how much of the posterior is
there has to be learnt from them."""

LEAST_MASS = 1e-3
"""With less of the posterior about a mode its t distribution stays as it was: draws there say nothing of moments."""

_ITERATIONS = 100
"""In which they are fitted. They settle in a few, unless t distributions overlap so much that they mean little."""

_LEAST = 0.01
"""Share of the first covariance that is added to the weighted one: a few draws with all the weight make it singular."""


class Weighted(NamedTuple):
    """Draws from a posterior.

    Attributes:
        draws: (D, P).
        weights: their importance weights.
        mixture_weights: (K,) share of the posterior about each mode, as far as their t distributions can be told
            apart; they sum to one.
    """

    draws: np.ndarray
    weights: importance_weights.Importance
    mixture_weights: np.ndarray

    @property
    def weight(self) -> np.ndarray:
        """Weights (D,), which sum to one."""
        return np.exp(self.weights.log_weight[0])

    @property
    def summary(self) -> dict[str, Any]:
        """``posterior_mean`` and ``posterior_sd`` (P,), Pareto index ``k``, and effective number of draws ``ess``."""
        mean, covariance = moments(self.draws, self.weight)
        return {"posterior_mean": mean, "posterior_sd": np.sqrt(np.diag(covariance)), "k": self.weights.k,
                "ess": self.weights.ess}

    def resampled(self, count: int, seed: int) -> np.ndarray:
        """Return (count, P) of the draws, each as often as its weight says, in random order."""
        return self.draws[importance_weights.resample(self.weights.log_weight, count, seed)]


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
        ValueError: there is no curvature at any mode; no draw has a density.
    """
    about = [(mode.point, mode.curvature.factor @ mode.curvature.factor.T)
             for mode in modes if mode.curvature is not None]
    if not about:
        raise ValueError("the posterior has no curvature at a mode; its derivatives there are not finite.")
    generator = np.random.default_rng(seed)
    sizes = np.full(len(about), max(count // 3, 30))
    for freedom, wider in zip(FREEDOM, WIDER, strict=True):
        proposals = [stats.multivariate_t(centre, wider**2 * covariance, df=freedom) for centre, covariance in about]
        draws = np.concatenate([proposal.rvs(size, random_state=generator).reshape(size, -1)
                                for proposal, size in zip(proposals, sizes, strict=True)])
        log_t = np.stack([proposal.logpdf(draws) for proposal in proposals])
        log_ratio = log_density(draws) - special.logsumexp(log_t, axis=0, b=(sizes / sizes.sum())[:, None])
        weights = importance_weights.smooth(np.where(np.isfinite(log_ratio), log_ratio, -np.inf)[None])
        mass, belongs = _mixture_weights(np.exp(weights.log_weight[0]), log_t)
        about = [_next(draws, members, *component) for members, component in zip(belongs, about, strict=True)]
        share = np.maximum(mass, LEAST_SHARE)
        sizes = _shared_out(count, share / share.sum())
    return Weighted(draws, weights, mass)


def weighted_posterior(posterior: LogPosterior, y: Any, modes: Sequence[Minimum], count: int, seed: int) -> Weighted:
    """Return weighted draws of the posterior of the logarithms z of parameters, given the data y; see `weighted`."""
    return weighted(lambda z: np.sum(posterior.log_densities_of(z, y), axis=0), modes, count, seed)


def _mixture_weights(weight: np.ndarray, log_t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return weights (K,) of the mixture that fits best, by expectation maximisation, and parts of the weights (K, D).

    The draws have the weights ``weight`` (D,), and under the parts of the mixture the log densities ``log_t`` (K, D).
    """
    mass = np.full(len(log_t), 1.0 / len(log_t))
    for _ in range(_ITERATIONS if len(log_t) > 1 else 1):
        belongs = weight * special.softmax(log_t + np.log(np.maximum(mass, 1e-300))[:, None], axis=0)
        mass = belongs.sum(axis=1)
    return mass, belongs


def _next(draws: np.ndarray, weight: np.ndarray, centre: np.ndarray,
          covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted moments, with a little of the covariance of before; all as before where weights are tiny."""
    if weight.sum() < LEAST_MASS:
        return centre, covariance
    mean, spread = moments(draws, weight / weight.sum())
    return mean, spread + _LEAST * covariance


def _shared_out(count: int, share: np.ndarray) -> np.ndarray:
    """Return positive integers (K,) that sum to ``count``, or K, by shares (K,) that sum to one."""
    return 1 + np.diff(np.round(max(count - len(share), 0) * np.append(0.0, np.cumsum(share)))).astype(int)


def moments(draws: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean (P,) and covariance (P, P) of draws (D, P) with weights (D,) that sum to one."""
    mean = weight @ draws
    return mean, (draws - mean).T @ ((draws - mean) * weight[:, None])
