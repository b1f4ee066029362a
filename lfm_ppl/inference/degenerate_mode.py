"""Whether a posterior mode is one of the density's spikes, near which hardly any of the posterior lies.

In a hierarchical model with a group scale tau and members theta_i ~ Normal(mu, tau), the density grows without bound,
or up to a mode far out in the prior of tau, as tau goes to zero and all theta_i to mu. The Laplace approximation there
has nothing to do with the posterior. Positive parameters are judged, in z = log theta, so that units do not matter:

1. the search ran away along z;
2. a draw of the Laplace approximation is not finite, or zero;
3. the mode lies more than four prior standard deviations of z below the prior median, although the curvature at the
   mode is hardly that of the prior. Data that move a parameter so far would make it narrow.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from numpyro.distributions import constraints
from numpyro.infer import init_to_median, init_to_sample

from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.map import MAPResult
from lfm_ppl.likelihoods.handlers.pinned import Pinned
from lfm_ppl.utils.random_keys import split_keys

_PRIOR_DRAWS = 256
_FAR = 4.0
"""Prior standard deviations that make a mode far."""
_UNINFORMED = 0.8
"""Ratio of Laplace to prior standard deviation above which the data say little.

It is one in a spike. Where the data say that theta is at most b, the density is that of the prior times
exp(-theta^2 / (2 b^2)), which has the ratio 0.55 to 0.72 at its mode for the usual priors, since it falls off above."""
_COLLAPSED = 3.0
"""Distance below the prior median, in log theta, below which nothing is suspected; prior draws cost time."""


def degenerate_entries(bound: BoundModel, mode: MAPResult, draws: Mapping[str, np.ndarray]) -> dict[str, list[int]]:
    """Return the positive parameters at whose mode the density has a spike, as site -> entries, in C order.

    Args:
        bound: the model with its data.
        mode: the posterior mode.
        draws: site -> draws (n, ...) of the Laplace approximation.
    """
    trace = bound.trace()
    sites = sorted(bound.sites)  # the flat order
    sizes = [np.size(mode.unconstrained[site]) for site in sites]
    offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
    suspected = _spread_without_data(bound, mode)
    is_below = mode.mode < bound.draw(jax.random.key(0), init_to_median)
    degenerate = {}
    for site, first, last in zip(sites, offsets[:-1], offsets[1:], strict=True):
        distribution = trace[site]["fn"]
        if not _is_positive(distribution.support):
            continue
        values = np.asarray(draws[site]).reshape(len(draws[site]), -1)
        entries = np.arange(values.shape[1])
        if isinstance(distribution, Pinned):
            entries = np.setdiff1d(entries, distribution.indices)
        if entries.size != last - first:
            continue
        impossible = np.any(~np.isfinite(values[:, entries]) | (values[:, entries] <= 0.0), axis=0)
        # To infinity run parameters that the data do not bound, which is no spike.
        runaway = is_below[first:last] & [name in mode.runaway for name in mode.coordinates[first:last]]
        is_degenerate = impossible | runaway | suspected[first:last]
        if is_degenerate.any():
            degenerate[site] = entries[is_degenerate].tolist()
    return degenerate


def _spread_without_data(bound: BoundModel, mode: MAPResult) -> np.ndarray:
    """Return which coordinates (d,) lie far below the prior median, and are not narrower than the prior says."""
    nowhere = np.zeros(bound.size, bool)
    below = bound.draw(jax.random.key(0), init_to_median) - mode.mode
    if not np.any(below > _COLLAPSED):
        return nowhere
    keys = split_keys(jax.random.key(1), _PRIOR_DRAWS)
    prior = np.stack([bound.draw(keys(index), init_to_sample) for index in range(_PRIOR_DRAWS)])
    # The quartiles, because a prior may have no standard deviation.
    spread = np.subtract(*np.quantile(prior, (0.75, 0.25), axis=0)) / 1.349
    deviation = np.sqrt(np.diagonal(mode.covariance))
    return (below > _COLLAPSED) & (below > _FAR * spread) & ~(deviation < _UNINFORMED * spread)


def _is_positive(support: Any) -> bool:
    """Return whether a support is that of positive numbers."""
    while (inner := getattr(support, "base_constraint", getattr(support, "each", None))) is not None:
        support = inner
    if support is constraints.softplus_positive:
        return False
    return getattr(support, "lower_bound", None) == 0.0 and getattr(support, "upper_bound", None) is None
