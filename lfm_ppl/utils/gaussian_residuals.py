"""Residuals of Gaussian observations: missing entries, log densities, angles."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.utils.linalg import diagonal

_LOG_2PI = float(np.log(2.0 * np.pi))


def masked(residual: jax.Array, covariance: jax.Array, present: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return residual and covariance without their missing entries, in unchanged shapes.

    A missing entry has the residual zero and the row and column of the identity, so that it contributes nothing to
    quadratic forms and log determinants.

    Args:
        residual: (..., D), arbitrary where missing.
        covariance: (..., D, D); leading dimensions broadcast.
        present: (..., D), whether an entry is observed.
    """
    present_pairs = present[..., :, None] & present[..., None, :]
    return jnp.where(present, residual, 0.0), jnp.where(present_pairs, covariance, jnp.eye(present.shape[-1]))


def log_density(white: jax.Array, chol: jax.Array, present: jax.Array | None = None) -> jax.Array:
    """Return the log density (...) of the Gaussian N(0, L L') at a residual.

    Args:
        white: (..., D), L^-1 times the residual.
        chol: (..., D, D), the lower triangular L.
        present: (..., D), whether an entry is observed, for arguments from `masked`; None: all are observed.
    """
    count = white.shape[-1] if present is None else present.sum(-1)
    scale = jnp.log(diagonal(chol)).sum(-1)
    return -0.5 * ((white**2).sum(-1) + count * _LOG_2PI) - scale


TURN = 2.0 * float(np.pi)
"""Period of an angle in radians."""


def wrapped(angle: jax.Array, period: float = TURN) -> jax.Array:
    """Return the angle reduced to [-period / 2, period / 2]."""
    scale = TURN / period
    return jnp.arctan2(jnp.sin(scale * angle), jnp.cos(scale * angle)) / scale
