"""Moments of the joint state, predictions, and affine maps of Gaussian variables."""

from __future__ import annotations

import enum
from typing import Any, NamedTuple

import jax

from lfm_ppl.utils.linalg import congruence, matmul


class Moments(NamedTuple):
    """Mean (n,) and covariance (n, n) of the joint state."""

    mean: jax.Array
    covariance: jax.Array


class Prediction(NamedTuple):
    """Moments at the end of an interval, and the affine map s -> phi s + ... + N(0, process_cov) that leads there.

    Attributes:
        moments: predicted moments.
        phi, process_cov: (n, n), empty arrays unless the map is recorded.
        nodes: recorded steps of the interval, see `Record.LINEARIZATION`; None unless they are recorded.
    """

    moments: Moments
    phi: Any
    process_cov: Any
    nodes: Any = None


class Record(enum.Enum):
    """Output of a forward pass: the fields of `FilterTrace` that it fills.

    ============== ============== ========================= ================= =================== ==============
    record         log likelihood predicted, filtered,      gain, transition  nodes: moments at   process noise
                                  innovation                matrices          ends of steps       of intervals
    ============== ============== ========================= ================= =================== ==============
    LIKELIHOOD     yes
    MOMENTS        yes            yes
    LINEARIZATION  yes            yes                       yes               yes
    SMOOTHER       yes            yes                       yes                                   yes
    ============== ============== ========================= ================= =================== ==============

    LINEARIZATION is for the backward scan of the smoother's adjoint and the next linearisation points of iterated
    posterior linearisation, SMOOTHER for smoothed moments and trajectories.
    """

    LIKELIHOOD = "likelihood"
    MOMENTS = "moments"
    LINEARIZATION = "linearisation"
    SMOOTHER = "smoother"


def matvec(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Return the product of a matrix (..., m, n) and a vector (..., n)."""
    return matmul(matrix, vector[..., None])[..., 0]


def compose(first: tuple[jax.Array, jax.Array], second: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
    """Return phi and process_cov of two maps s -> phi s + N(0, process_cov), one after the other."""
    return matmul(second[0], first[0]), congruence(second[0], first[1]) + second[1]


def transform(moments: Moments, phi: jax.Array, process_cov: jax.Array) -> Moments:
    """Return the moments of phi s + N(0, process_cov)."""
    return Moments(matvec(phi, moments.mean), congruence(phi, moments.covariance) + process_cov)
