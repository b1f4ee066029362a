"""Priors and supports in words."""

from __future__ import annotations

from typing import Any

import numpy as np

_MOST_NUMBERS = 4
"""Numbers of a vector that are printed."""


def prior(distribution: Any) -> str:
    """Return a distribution in words: its name and its arguments.

    Example:
        >>> import numpyro.distributions as dist
        >>> prior(dist.LogNormal(0.0, 0.5).expand([3]).to_event(1))
        'LogNormal(0, 0.5)'
    """
    while hasattr(distribution, "base_dist") and type(distribution).__name__ in (
            "Independent", "ExpandedDistribution", "MaskedDistribution"):
        distribution = distribution.base_dist
    values = [getattr(distribution, name, None) for name in distribution.arg_constraints]
    return f"{type(distribution).__name__}({', '.join(_number(value) for value in values if value is not None)})"


def support(constraint: Any) -> str:
    """Return a support in words.

    Example:
        >>> import numpyro.distributions as dist
        >>> support(dist.HalfNormal(1.0).support), support(dist.Uniform(2.0, 3.0).support)
        ('> 0', '2 to 3')
    """
    while hasattr(constraint, "base_constraint"):
        constraint = constraint.base_constraint
    low, high = (getattr(constraint, name, None) for name in ("lower_bound", "upper_bound"))
    if low is not None and high is not None:
        return f"{_number(low)} to {_number(high)}"
    if low is not None:
        return f"> {_number(low)}"
    if high is not None:
        return f"< {_number(high)}"
    return type(constraint).__name__.strip("_").lower()


def _number(value: Any) -> str:
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        return type(value).__name__
    flat = array.ravel()
    if flat.size and np.all(flat == flat[0]):
        return f"{flat[0]:.3g}"
    shown = ", ".join(f"{one:.3g}" for one in flat[:_MOST_NUMBERS])
    return f"[{shown}{', ...' if flat.size > _MOST_NUMBERS else ''}]"
