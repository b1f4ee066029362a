"""Links: from a predictor, which may be any real number, to a rate or a probability."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl import checks


class RateLink(NamedTuple):
    """A rate > 0 as a function of the predictor, and its logarithm without underflow."""

    rate: Callable[[jax.Array], jax.Array]
    log_rate: Callable[[jax.Array], jax.Array]


class ProbabilityLink(NamedTuple):
    """Logarithms of p and of 1 - p as functions of the predictor."""

    log_probability: Callable[[jax.Array], jax.Array]
    log_complement: Callable[[jax.Array], jax.Array]


_UNDERFLOW = -35.0
"""Predictor below which softplus(f) = exp(f) to the last digit."""


def _log_softplus(f: jax.Array) -> jax.Array:
    return jnp.where(f < _UNDERFLOW, f, jnp.log(jax.nn.softplus(jnp.maximum(f, _UNDERFLOW))))


def _log_positive(f: jax.Array) -> jax.Array:
    """Return log f, -inf with a zero gradient where f <= 0."""
    return jnp.where(f > 0, jnp.log(jnp.where(f > 0, f, 1.0)), -jnp.inf)


def _log_share(f: jax.Array) -> jax.Array:
    """Return log f, -inf with a zero gradient where f is no probability."""
    return _log_positive(jnp.where(f < 1, f, -1.0))


RATES = {
    "exp": RateLink(jnp.exp, lambda f: f),
    "softplus": RateLink(jax.nn.softplus, _log_softplus),
    "identity": RateLink(lambda f: f, _log_positive),
}
PROBABILITIES = {
    "logit": ProbabilityLink(jax.nn.log_sigmoid, lambda f: jax.nn.log_sigmoid(-f)),
    "probit": ProbabilityLink(jax.scipy.stats.norm.logcdf, lambda f: jax.scipy.stats.norm.logcdf(-f)),
    "identity": ProbabilityLink(_log_share, lambda f: _log_share(1.0 - f)),
}


def checked(name: Any, known: dict[str, Any]) -> str:
    """Return the name of a link; raise ValueError where it is unknown."""
    checks.one_of("link", name, known)
    return name
