"""Starting points and mass matrix of NUTS from a Laplace approximation of the posterior.

1. The mode is searched from the prior median and from prior draws (`lfm_ppl.inference.map.mode_of`).
2. The Laplace approximation N(mode, C) is usable where the search converged, the Hessian is positive semi-definite, and
   no other start ended in a second mode of similar height. Along directions in which the density is flat at the mode,
   C has variance one, as a mass matrix without an approximation.
3. Each chain starts at a draw of the approximation widened to `_WIDENING` standard deviations, so that the chains are
   overdispersed, which R-hat requires. Draws far outside of the posterior, as beyond the edge of a skewed posterior,
   are pulled towards the mode.
4. C, of the chain's coordinates, is the initial inverse mass matrix, and it regularises the matrices that NUTS
   estimates in its warm-up.

Source: Stan Development Team, Stan reference manual, "HMC algorithm parameters" (windows and regularisation of the
warm-up); Gelman and Rubin (1992), Statistical Science 7, 457-472 (overdispersed starting points).
"""

from __future__ import annotations

import warnings

import equinox as eqx
import jax
import numpy as np

from lfm_ppl.inference.bound_model import BoundModel
from lfm_ppl.inference.map import MAPResult, mode_of

MAX_PARAMETERS = 100
"""Largest number of parameters with a dense mass matrix: a step costs d^2, and the estimate needs about d draws."""

_WIDENING = 2.0
"""Standard deviations of the starting points, in units of the Laplace approximation's."""

_SIMILAR_HEIGHT = 5.0
"""Largest difference of the log densities of two modes that both matter: below exp(-5), a mode has less than 1%."""

_SEPARATION = 3.0
"""Distance in standard deviations from which two ends of the search are two modes."""

NEGLIGIBLE_RISE = 1e-3
"""Rise of the log density within one step that the search may leave: 0.04 standard deviations."""

_PULLS = 6
"""Number of halvings of the distance of a starting point to the mode, before the mode itself is the start."""


class Laplace(eqx.Module):
    """Gaussian approximation of the posterior of the unconstrained parameters.

    Attributes:
        mode: (d,).
        covariance: (d, d), the inverse Hessian of minus the log density at the mode, one along flat directions.
    """

    mode: np.ndarray
    covariance: np.ndarray


class UnusableModeError(ValueError):
    """Reason why the Laplace approximation does not describe the posterior; its text completes "since ..."."""


def laplace_approximation(key: jax.Array, bound: BoundModel) -> Laplace:
    """Return the Laplace approximation of the posterior.

    Args:
        key: random key of the starting points of the search.
        bound: the model and its data.

    Raises:
        UnusableModeError: the search did not converge, the Hessian has a negative eigenvalue, or there are several
            modes of similar height.
        ValueError: no prior draw has a finite density.
    """
    if bound.size > MAX_PARAMETERS:
        raise UnusableModeError(f"the model has {bound.size} parameters, more than {MAX_PARAMETERS}")
    with warnings.catch_warnings():
        # The same conditions raise below, with a remedy that fits here.
        warnings.simplefilter("ignore")
        result = mode_of(key, bound, negligible_rise=NEGLIGIBLE_RISE)
    if not np.all(np.isfinite(result.covariance)):
        raise UnusableModeError("the Hessian at the posterior mode is not finite")
    if not result.converged:
        raise UnusableModeError(f"the search of the posterior mode did not converge: {result.message.rstrip('.')}")
    if has_second_mode(result):
        raise UnusableModeError("the posterior has several modes of similar height")
    return Laplace(result.mode, result.start_covariance)


def has_second_mode(result: MAPResult) -> bool:
    """Return whether another start ended far from the mode at a similar log density."""
    factor = np.linalg.cholesky(result.covariance)
    for end, log_density in zip(result.restart_ends, result.restart_log_densities, strict=True):
        distance = np.linalg.norm(np.linalg.solve(factor, end - result.mode)) if np.isfinite(log_density) else 0.0
        drop = result.log_density - log_density
        # On a curved ridge of one mode, where L-BFGS may end early, the density falls as the Gaussian's does.
        if distance > _SEPARATION and drop < min(_SIMILAR_HEIGHT, 0.1 * distance**2):
            return True
    return False


def starting_points(key: jax.Array, bound: BoundModel, laplace: Laplace, chains: int) -> np.ndarray:
    """Return one point (C, d) of finite log density and gradient for each chain.

    Args:
        key: a JAX random key.
        bound: the model and its data.
        laplace: the approximation of the posterior.
        chains: C.
    """
    factor = np.linalg.cholesky(laplace.covariance)
    normals = np.asarray(jax.random.normal(key, (chains, bound.size)))
    peak = float(bound.log_density_gradient(laplace.mode)[0])
    return np.stack([_pulled_point(bound, laplace.mode, _WIDENING * factor @ normal, peak) for normal in normals])


def _pulled_point(bound: BoundModel, mode: np.ndarray, displacement: np.ndarray, peak: float) -> np.ndarray:
    """Return the first of mode + displacement / 2^k whose log density is not far below the widened Gaussian's."""
    # Of a Gaussian posterior the expected drop is _WIDENING^2 d / 2; three times as much leaves room for skewness.
    largest_drop = 1.5 * _WIDENING**2 * mode.size + 10.0
    for halvings in range(_PULLS):
        point = mode + displacement / 2**halvings
        value, gradient = bound.log_density_gradient(point)
        if np.isfinite(value) and np.all(np.isfinite(gradient)) and peak - float(value) < largest_drop:
            return point
    return mode
