"""The density of an observation given the state, draws from it, and checks of its noise."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.utils import checks, gaussian_residuals
from lfm_ppl.utils.gaussian_residuals import masked, wrapped
from lfm_ppl.utils.linalg import cholesky, matmul, solve_lower
from lfm_ppl.utils.semidefinite import semidefinite_root


def log_density(ssm: StateSpaceModel, w: jax.Array, t: jax.Array, row: jax.Array,
                y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the log density of the observed entries of y given state and forces, and their whitened residual.

    Args:
        ssm: the state-space model.
        w: (M + R,), state and forces.
        t: the time.
        row: index of the observation, which selects its noise covariance or family parameters.
        y: (D,), NaN where missing.

    Returns:
        log p(y | w), zero where all entries are missing; the whitened residual (D,), NaN for an observation family.
    """
    present = jnp.isfinite(y)
    family = ssm.model.observation
    if isinstance(family, ObservationFamily):
        return row_log_prob(family, row, ssm.observe(w, t), y).sum(), jnp.full(y.shape, jnp.nan)
    residual = jnp.where(present, y, 0.0) - ssm.observe(w, t)
    for index in family.angular:
        residual = residual.at[index].set(wrapped(residual[index], family.period))
    residual, noise = masked(residual, ssm.obs_cov(w, t, row), present)
    factor = cholesky(noise)
    white = solve_lower(factor.chol, residual)
    value = gaussian_residuals.log_density(white, factor.chol, present)
    return jnp.where(factor.degenerate.any(), -jnp.inf, value), white


def row_log_prob(family: ObservationFamily, row: Any, f: jax.Array, y: jax.Array) -> jax.Array:
    """Return log p(y_d | f_d) (D,) of a row at a predictor f (D,), zero where missing."""
    present = jnp.isfinite(y)
    # The masked branch must have a finite derivative, too: replace a missing entry by a value in the support.
    return jnp.where(present, family.select_row(row).log_prob(f, jnp.where(present, y, family.possible(f))), 0.0)


def noisy_observation(ssm: StateSpaceModel, w: jax.Array, t: jax.Array, key: jax.Array, row: Any) -> jax.Array:
    """Draw an observation (D,) at inputs w (M + R,) and time t, with the noise of a row (None: of no row)."""
    family, predictor = ssm.model.observation, ssm.observe(w, t)
    if isinstance(family, ObservationFamily):
        return (family.typical() if row is None else family.select_row(row)).sample(key, predictor)
    return with_noise(key, predictor, ssm.obs_cov(w, t, row))


def replicate(ssm: StateSpaceModel, key: jax.Array, w: jax.Array, times: jax.Array) -> jax.Array:
    """Draw the rows of data (T, D) along a path w (T, M + R), each with the noise of its row."""
    rows = jnp.arange(len(times))
    return jax.vmap(lambda w, t, key, row: noisy_observation(ssm, w, t, key, row))(
        w, times, jax.random.split(key, len(times)), rows)


def with_noise(key: jax.Array, mean: jax.Array, covariance: jax.Array) -> jax.Array:
    """Return a draw of N(mean, covariance): (D,) and (D, D), or (K, D) and (K, D, D)."""
    root = semidefinite_root if covariance.ndim == 2 else jax.vmap(semidefinite_root)
    noise = jax.random.normal(key, (*mean.shape, 1))
    return mean + matmul(root(covariance), noise)[..., 0]


def expected_observation(ssm: StateSpaceModel, w: jax.Array, t: jax.Array) -> jax.Array:
    """Return the expected observation (D,) at inputs w (M + R,) and time t, on the scale of the data."""
    family, predictor = ssm.model.observation, ssm.observe(w, t)
    return family.typical().mean(predictor) if isinstance(family, ObservationFamily) else predictor


def require_gaussian(ssm: StateSpaceModel, method: str, alternative: str) -> None:
    """Raise ValueError for an observation family, where ``method`` is restricted to Gaussian observations."""
    if isinstance(ssm.model.observation, ObservationFamily):
        raise ValueError(f"{method} needs an lfm.GaussianObservation, but the observation of this model is of the "
                         f"family {type(ssm.model.observation).__name__}. Use {alternative} instead.")


def check_noise(ssm: StateSpaceModel, time: Any) -> None:
    """Raise ValueError if the observation noise has no density at the prior mean; traced values pass."""
    if isinstance(ssm.model.observation, ObservationFamily):
        return
    w = jnp.concatenate([ssm.model.initial_state.mean, ssm.stack.mean_at(time)])
    noise = ssm.model.observation.covariance
    rows = jnp.arange(1 if callable(noise) or jnp.ndim(noise) < 3 else noise.shape[0])
    covariance = checks.concrete(jax.vmap(lambda row: ssm.obs_cov(w, jnp.asarray(time, float), row))(rows))
    if covariance is None:
        return
    if not np.isfinite(covariance).all():
        raise ValueError("the covariance of the observation noise is not finite at the prior mean.")
    scale = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    for name, sd in zip(ssm.model.output_names, scale.min(axis=0), strict=True):
        if sd == 0.0:
            raise ValueError(f"the observation noise of {name!r} is zero, so that an observation has no density given "
                             "the state. Give it a positive sd.")
    smallest = np.linalg.eigvalsh(covariance / (scale[:, :, None] * scale[:, None, :])).min(axis=1)
    if smallest.min() < 1e-13:
        raise ValueError("the covariance of the observation noise is singular, so that an observation has no density "
                         f"given the state: {covariance[smallest.argmin()].tolist()}. Leave out the redundant outputs.")
