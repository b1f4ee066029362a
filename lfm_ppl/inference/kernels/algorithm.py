"""The common form of every sampler."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple


class SamplingAlgorithm(NamedTuple):
    """A Markov chain as pure functions, which JAX can trace.

    ``data`` are the arguments of the target density. They are passed to each function, so that a compiled program
    serves every data set of the same shape.

    Attributes:
        init: ``(key, point, data, tuning) -> state``. ``point`` is a NumPyro ``ParamInfo``: the position, its potential
            energy and, for NUTS, the gradient. ``tuning`` are arrays such as the first proposal covariance.
        step: ``(state, data) -> state``.
        summary: ``state -> {name: array}``: the flat position ``z`` (d,) and the statistics of the last step, named as
            in ArviZ. ``lp`` is minus the log density of ``z``.
    """

    init: Callable[[Any, Any, Any, Any], Any]
    step: Callable[[Any, Any], Any]
    summary: Callable[[Any], dict[str, Any]]
