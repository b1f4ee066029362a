"""Linearisation of the dynamics at one time, with the constant linear part of the model removed.

1. The drift f(w, t) of w = K(t) s + k(t) has a constant linear part, which an integrating factor treats exactly.
2. A rule linearises the remainder about Gaussian moments of the states that enter non-linearly; sparsity of the drift
   determines these states.
3. The result is embedded in the joint state: a Jacobian, a remainder of the mean, and the expectation of G G'.

Source: Särkkä and Sarmavuori (2013), Signal Processing 93.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name

from lfm_ppl.filtering.moments import Moments, matvec
from lfm_ppl.filtering.transition import IntegratingFactor, LinearPart
from lfm_ppl.linearisation.input_selection import InputStructure
from lfm_ppl.linearisation.rule import AffineMap, Function, Inputs, Rule, partial_jacobian, selection
from lfm_ppl.linearisation.sigma_points import SigmaPointRule
from lfm_ppl.model.state_space import StateSpaceModel
from lfm_ppl.utils.linalg import congruence, diagonal, fastest_rate, matmul, outer_square

MINIMUM_SD = "lfm_ppl: minimum standard deviation"
"""Name under which `minimum_sd` is stored for the derivative of an interval instead of being computed again."""

Congruence = Callable[[jax.Array, bool], jax.Array]
"""Maps a matrix C, and whether it reads force states only, to C P C'; forms of P only what a rule needs."""


class Dynamics(NamedTuple):
    """A model, a linearisation rule, and the constant linear part of the dynamics."""

    ssm: StateSpaceModel
    rule: Rule
    linear: LinearPart


class DriftLinearisation(NamedTuple):
    """Linearised dynamics at a Runge-Kutta node, the constant linear part removed.

    Attributes:
        remainder: (M,), expectation of the drift less the linear part.
        jacobian: (M, n), Jacobian of the linearised drift less the linear part.
        diffusion: (M, M), expectation of G G'; None without process noise.
    """

    remainder: jax.Array
    jacobian: jax.Array
    diffusion: jax.Array | None


def minimum_sd(dynamics: Dynamics, factor: IntegratingFactor, t: jax.Array, h: jax.Array,
               moments: Moments, settles: bool = False) -> jax.Array:
    """Return the standard deviation below which a coordinate counts as known: 1e-6 of its size during a step.

    Args:
        dynamics: the model and the rule.
        factor: the integrating factor of the step.
        t: time of its start.
        h: its length.
        moments: at its start.
        settles: whether the time constant of a stiff state limits its change, however long the step is.
    """
    ssm = dynamics.ssm
    size = ssm.physical_dim
    matrix, offset = ssm.input_map(t)
    w = matvec(matrix, moments.mean) + offset
    if settles:
        jacobian = partial_jacobian(lambda v: (ssm.drift(v, t), ()), w, tuple(range(size)))
        h = jnp.minimum(h, 1.0 / fastest_rate(jacobian))
    change = jnp.abs(ssm.drift(w, t)) * h
    if (dispersion := ssm.dispersion(w, t)) is not None:
        change = change + jnp.sqrt(h * (dispersion**2).sum(1) + 1e-300)
    forces = jnp.sqrt(diagonal(factor.force_cov_full) + 1e-300)
    if isinstance(dynamics.rule, SigmaPointRule) and dynamics.rule.full_state:
        scale = jnp.abs(moments.mean) + jnp.concatenate([change, forces])
    else:
        outputs = jnp.sqrt(diagonal(congruence(matrix[size:, size:], factor.force_cov_full)) + 1e-300)
        scale = (jnp.abs(w) + jnp.concatenate([change, outputs]))[jnp.asarray(ssm.drift_structure.nonlinear, int)]
    scale = jnp.where(jnp.isfinite(scale), scale, 0.0)
    return checkpoint_name(jax.lax.stop_gradient(1e-6 * scale + 1e-150), MINIMUM_SD)


def linearise(ssm: StateSpaceModel, rule: Rule, function: Function, structure: InputStructure, jacobian: jax.Array,
              t: jax.Array, about: tuple[jax.Array, Congruence], min_sd: jax.Array) -> AffineMap:
    """Linearise a function of w = K s + k about a Gaussian in s; the Jacobian of the result is (D, n).

    Args:
        ssm: the model.
        rule: the linearisation rule.
        function: maps w (M + R,) to (D,) and further arrays.
        structure: how the function depends on w.
        jacobian: (D, M + R), its Jacobian in the constant inputs, zero elsewhere.
        t: time.
        about: mean (n,) of the Gaussian and its covariance as a `Congruence`.
        min_sd: see `minimum_sd`.
    """
    mean, covariance = about
    matrix, offset = ssm.input_map(t)
    if isinstance(rule, SigmaPointRule) and rule.full_state:
        total = ssm.state_dim
        full_structure = InputStructure(tuple(range(total)), (), (), (), True)
        inputs = Inputs(mean, covariance(jnp.eye(total), False), min_sd)

        def function_of_state(s: jax.Array) -> tuple[jax.Array, Any]:
            return function(matvec(matrix, s) + offset)

        return rule.linearise(function_of_state, inputs, full_structure, jnp.zeros((jacobian.shape[0], total)))
    nonlinear = (*structure.nonlinear, *structure.averaged)
    needs_covariance = isinstance(rule, SigmaPointRule) and bool(structure.nonlinear)
    rows = matmul(selection(nonlinear, ssm.input_dim).T, matrix) if nonlinear else matrix[:0]
    reads_forces_only = all(index >= ssm.physical_dim for index in nonlinear)
    nonlinear_covariance = covariance(rows, reads_forces_only) if needs_covariance else jnp.zeros((0, 0))
    inputs = Inputs(matvec(matrix, mean) + offset, nonlinear_covariance, min_sd)
    affine = rule.linearise(function, inputs, structure, jacobian)
    return affine._replace(jacobian=matmul(affine.jacobian, matrix))


def covariance_of(moments: Moments) -> Congruence:
    """Return the function C -> C P C' for the covariance P of moments."""
    return lambda rows, reads_forces_only: congruence(rows, moments.covariance)


def linearise_drift(dynamics: Dynamics, t: jax.Array, mean: jax.Array, covariance: Congruence, min_sd: jax.Array,
                    about: Moments | None = None) -> DriftLinearisation:
    """Linearise the dynamics at a node.

    Args:
        dynamics: the model and the rule.
        t: time of the node.
        mean: (n,), where the affine drift is evaluated: that of the filter at the node, or the origin of deviations.
        covariance: of the filter at the node.
        min_sd: see `minimum_sd`.
        about: moments to linearise about; None: the filter's moments.
    """
    ssm, rule, linear = dynamics

    def function(w: jax.Array) -> tuple[jax.Array, Any]:
        dispersion = ssm.dispersion(w, t)
        return ssm.drift(w, t), () if dispersion is None else outer_square(dispersion)

    point = (mean, covariance) if about is None else (about.mean, covariance_of(about))
    affine = linearise(ssm, rule, function, ssm.drift_structure, linear.jacobian, t, point, min_sd)
    drift = affine.value
    if about is not None:
        drift = drift + matvec(affine.jacobian, mean - about.mean)
    remainder = drift - matvec(linear.rows, mean)
    return DriftLinearisation(remainder, affine.jacobian - linear.rows,
                              affine.extra if isinstance(affine.extra, jax.Array) else None)


def linearisation_indices(ssm: StateSpaceModel, rule: Rule) -> np.ndarray:
    """Return the indices (k,) of the joint states whose moments a linearisation of the dynamics needs."""
    if isinstance(rule, SigmaPointRule) and rule.full_state:
        return np.arange(ssm.state_dim)
    structure = ssm.drift_structure
    is_needed = np.isin(np.arange(ssm.input_dim), (*structure.nonlinear, *structure.averaged))
    size = ssm.physical_dim
    forces = [np.full(force.state_dim, flag) for force, flag in zip(ssm.stack.forces, is_needed[size:], strict=True)]
    return np.flatnonzero(np.concatenate([is_needed[:size], *forces]))


def embed_in_state(ssm: StateSpaceModel, rule: Rule, moments: Moments) -> Moments:
    """Return moments (..., n), (..., n, n) of the joint state from the linearised states; others are zero."""
    indices = linearisation_indices(ssm, rule)
    if is_contiguous(indices):
        first = int(indices[0]) if indices.size else 0
        width = first, ssm.state_dim - first - indices.size
        leading = ((0, 0),) * (moments.mean.ndim - 1)
        return Moments(jnp.pad(moments.mean, (*leading, width)), jnp.pad(moments.covariance, (*leading, width, width)))
    rows = np.eye(ssm.state_dim)[indices]
    return Moments(matmul(moments.mean[..., None, :], rows)[..., 0, :], congruence(rows.T, moments.covariance))


def columns(a: jax.Array, indices: np.ndarray) -> jax.Array:
    """Return the entries at ``indices`` along the last axis; XLA fuses a slice, but not a gather."""
    if not is_contiguous(indices):
        return a[..., indices]
    first = int(indices[0]) if indices.size else 0
    return a[..., first:first + indices.size]


def is_contiguous(indices: np.ndarray) -> bool:
    """Return whether indices follow one another without a gap."""
    return bool((np.diff(indices) == 1).all())
