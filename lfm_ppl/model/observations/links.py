"""Links: maps from a real-valued predictor to a rate or a probability."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from lfm_ppl.utils import checks

Link = tuple[Callable[[jax.Array], jax.Array], Callable[[jax.Array], jax.Array]]
"""Two functions of the predictor: (rate, log rate), or (log probability, log complement)."""

_UNDERFLOW = -35.0
"""Predictor below which softplus(f) = exp(f) to rounding."""


def _log_softplus(f: jax.Array) -> jax.Array:
    """Return log softplus(f) without underflow."""
    return jnp.where(f < _UNDERFLOW, f, jnp.log(jax.nn.softplus(jnp.maximum(f, _UNDERFLOW))))


def _log_positive(f: jax.Array) -> jax.Array:
    """Return log f, or -inf with a zero gradient where f <= 0."""
    return jnp.where(f > 0, jnp.log(jnp.where(f > 0, f, 1.0)), -jnp.inf)


def _log_probability(f: jax.Array) -> jax.Array:
    """Return log f, or -inf with a zero gradient where f is not in (0, 1)."""
    return _log_positive(jnp.where(f < 1, f, -1.0))


RATES: dict[str, Link] = {
    "exp": (jnp.exp, lambda f: f),
    "softplus": (jax.nn.softplus, _log_softplus),
    "identity": (lambda f: f, _log_positive),
}
"""Name -> (rate, log rate) as functions of the predictor; the log rate does not underflow."""

PROBABILITIES: dict[str, Link] = {
    "logit": (jax.nn.log_sigmoid, lambda f: jax.nn.log_sigmoid(-f)),
    "probit": (jax.scipy.stats.norm.logcdf, lambda f: jax.scipy.stats.norm.logcdf(-f)),
    "identity": (_log_probability, lambda f: _log_probability(1.0 - f)),
}
"""Name -> (log p, log(1 - p)) as functions of the predictor."""


def link_name(name: Any, links: dict[str, Link]) -> str:
    """Return the name of a link; raise ValueError if it is not in ``links``."""
    checks.one_of("link", name, links)
    return name
