"""Robust adaptive Metropolis as pure functions of the state.

One step:
1. Propose ``x + S_n U`` with ``U ~ N(0, I)``.
2. Accept with probability ``alpha_n = min(1, pi(x + S_n U) / pi(x))``.
3. In the warm-up, update the Cholesky factor ``S_n`` of the proposal covariance so that the mean of ``alpha_n``
   approaches the target ``alpha*``.

Source: Vihola (2012), Robust adaptive Metropolis algorithm with coerced acceptance rate, Statistics and Computing 22,
997-1008.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from numpyro.infer.util import ParamInfo

from lfm_ppl.inference.kernels.algorithm import SamplingAlgorithm


class RAMState(NamedTuple):
    """State of a chain. Every field can be collected with ``extra_fields`` of ``MCMC.run``.

    Attributes:
        i: number of steps taken, warm-up included.
        z: unconstrained parameters, a pytree (a dict of sites for a NumPyro model).
        potential_energy: minus the log density at ``z``; never NaN.
        accept_prob: acceptance probability of the last proposal, in [0, 1].
        accepted: whether the last proposal was taken.
        mean_accept_prob: mean of ``accept_prob`` over the present phase (warm-up or sampling).
        step_size: geometric mean of the proposal's scales, ``det(S)^(1/d)``.
        chol_proposal: Cholesky factor ``S`` of the proposal covariance, (d, d), in flat order.
        num_warmup: length of the warm-up.
        rng_key: random key of the next step.
    """

    i: jax.Array
    z: Any
    potential_energy: jax.Array
    accept_prob: jax.Array
    accepted: jax.Array
    mean_accept_prob: jax.Array
    step_size: jax.Array
    chol_proposal: jax.Array
    num_warmup: jax.Array
    rng_key: jax.Array


class Adaptation(NamedTuple):
    """How the proposal adapts.

    Attributes:
        target_accept_prob: ``alpha*``; None for 0.44 in one dimension and 0.234 otherwise.
        exponent: ``gamma`` of the adaptation steps ``min(1, d n^-gamma)``.
        throughout: adapt after the warm-up as well.
    """

    target_accept_prob: float | None
    exponent: float
    throughout: bool


def robust_metropolis(potential_at: Callable[[Any], Callable[[Any], jax.Array]], adaptation: Adaptation,
                      num_warmup: int) -> SamplingAlgorithm:
    """Return robust adaptive Metropolis; its tuning is the first proposal factor (d, d).

    Args:
        potential_at: from the data to minus the log density, a function of the position. NaN or an infinity rejects.
        adaptation: of the proposal.
        num_warmup: number of steps that adapt the proposal.
    """

    def init(key: jax.Array, point: ParamInfo, data: Any, factor: jax.Array) -> RAMState:
        return initial_state(point.z, point.potential_energy, key, factor, num_warmup)

    def step(state: RAMState, data: Any) -> RAMState:
        rng_key, key_noise, key_accept = jax.random.split(state.rng_key, 3)
        proposal, noise = propose(state, key_noise)
        energy = finite_or_infinity(potential_at(data)(proposal))
        accept_prob = acceptance(state.potential_energy - energy)
        accepted = jax.random.uniform(key_accept, (), noise.dtype) < accept_prob
        new_state = state._replace(z=choose(accepted, proposal, state.z), accepted=accepted, rng_key=rng_key,
                                   potential_energy=jnp.where(accepted, energy, state.potential_energy))
        return adapt_proposal(new_state, noise, accept_prob, adaptation)

    return SamplingAlgorithm(init, step, summary)


def summary(state: Any) -> dict[str, jax.Array]:
    """Return the flat position and the statistics of the last step of a random walk."""
    return {"z": ravel_pytree(state.z)[0], "acceptance_rate": state.accept_prob, "accepted": state.accepted,
            "lp": state.potential_energy}


def initial_state(
    z: Any, potential_energy: jax.Array, rng_key: jax.Array, chol: jax.Array, num_warmup: int
) -> RAMState:
    """Return the state before the first step, with proposal factor ``chol`` of shape (d, d)."""
    flat, _ = ravel_pytree(z)
    chol = chol.astype(flat.dtype)
    zero = jnp.zeros((), flat.dtype)
    return RAMState(
        i=jnp.array(0),
        z=z,
        potential_energy=potential_energy,
        accept_prob=zero,
        accepted=jnp.array(False),
        mean_accept_prob=zero,
        step_size=_geometric_mean_scale(chol),
        chol_proposal=chol,
        num_warmup=jnp.array(num_warmup),
        rng_key=rng_key,
    )


def propose(state: RAMState, key: jax.Array) -> tuple[Any, jax.Array]:
    """Return a proposal ``x + S U``, shaped like ``state.z``, and the draw ``U`` (d,)."""
    flat, unravel = ravel_pytree(state.z)
    noise = jax.random.normal(key, flat.shape, flat.dtype)
    return unravel(flat + state.chol_proposal @ noise), noise


def finite_or_infinity(energy: jax.Array) -> jax.Array:
    """Replace NaN and minus infinity by infinity, which no chain accepts."""
    return jnp.where(jnp.isfinite(energy), energy, jnp.inf)


def acceptance(log_ratio: jax.Array) -> jax.Array:
    """Return ``min(1, exp(log_ratio))``; zero for NaN, as of inf - inf where both points are impossible."""
    ratio = jnp.exp(jnp.minimum(log_ratio, 0.0))
    return jnp.where(jnp.isnan(ratio), 0.0, ratio)


def choose(accepted: jax.Array, proposal: Any, present: Any) -> Any:
    """Return the proposal if it is accepted, else the present position."""
    return jax.tree_util.tree_map(partial(jnp.where, accepted), proposal, present)


def adapt_proposal(state: RAMState, noise: jax.Array, accept_prob: jax.Array, adaptation: Adaptation) -> RAMState:
    """Count a step and adapt the proposal.

    Args:
        state: the state after the step in position and energy, and before it in the other fields.
        noise: the draw ``U`` (d,) of the proposal.
        accept_prob: ``alpha_n``.
        adaptation: of the proposal.
    """
    accept_prob = accept_prob.astype(noise.dtype)
    i = state.i + 1
    warming_up = i <= state.num_warmup
    eta = jnp.minimum(1.0, noise.size * i.astype(noise.dtype) ** -adaptation.exponent)
    eta = jnp.where(warming_up | adaptation.throughout, eta, 0.0)
    target = adaptation.target_accept_prob or (0.44 if noise.size == 1 else 0.234)
    chol = adapt(state.chol_proposal, noise, eta * (accept_prob - target))
    in_phase = jnp.where(warming_up, i, i - state.num_warmup)
    return state._replace(
        i=i,
        accept_prob=accept_prob,
        mean_accept_prob=state.mean_accept_prob + (accept_prob - state.mean_accept_prob) / in_phase,
        step_size=_geometric_mean_scale(chol),
        chol_proposal=chol,
    )


def adapt(chol: jax.Array, noise: jax.Array, weight: jax.Array) -> jax.Array:
    r"""Return the proposal's Cholesky factor after one step of robust adaptation.

        S_{n+1} S_{n+1}' = S_n (I + w U U' / |U|^2) S_n',    w = eta_n (alpha_n - alpha*)

    A step that would overflow or underflow the factor, on a flat or a collapsed target, is skipped, so that the
    factor is always finite with a positive diagonal.

    Args:
        chol: factor ``S_n`` of shape (d, d); the proposal was ``x + S_n U``.
        noise: the draw ``U`` of shape (d,).
        weight: ``w`` above -1: the step times the excess of the acceptance probability over its
            target. Zero returns the factor unchanged, to the last bit.

    Returns:
        Factor ``S_{n+1}`` of shape (d, d).

    Source:
        Vihola (2012), Robust adaptive Metropolis algorithm with coerced acceptance rate, Statistics
        and Computing 22, 997-1008, equation (1).
    """
    tiny = jnp.finfo(chol.dtype).tiny
    direction = noise / jnp.sqrt(jnp.maximum(jnp.sum(noise**2), tiny))
    updated = rank_one_update(chol, direction, weight)
    usable = jnp.all(jnp.isfinite(updated)) & jnp.all(jnp.diagonal(updated) > tiny)
    return jnp.where(usable, updated, chol)


def rank_one_update(chol: jax.Array, direction: jax.Array, weight: jax.Array) -> jax.Array:
    r"""Return the Cholesky factor of ``S (I + c u u') S'`` in O(d^2).

    The factor is ``S T`` with ``T`` the Cholesky factor of ``I + c u u'``, which has a closed form.
    With ``t_j = 1 + c sum_{i<=j} u_i^2`` and ``t_0 = 1``,

        T_jj = sqrt(t_j / t_{j-1}),    T_ij = c u_i u_j / sqrt(t_j t_{j-1})   for i > j,

    so that column ``j`` of ``S T`` is
    ``S_j T_jj + c u_j / sqrt(t_j t_{j-1}) sum_{i>j} S_i u_i``: two running sums and no loop. Both
    signs of ``c`` are the same formula. Every ``t_j`` lies between 1 and ``1 + c |u|^2``, hence a
    downdate is as stable as an update and the diagonal stays positive; a ``c`` that would make the
    matrix indefinite is treated as one that makes it all but singular.

    Args:
        chol: lower triangular factor ``S`` of shape (d, d) with a positive diagonal.
        direction: vector ``u`` of shape (d,), in the coordinates of the standardised space.
        weight: scalar ``c``, above ``-1 / |u|^2``.

    Returns:
        Lower triangular factor of shape (d, d) with a positive diagonal.

    Example:
        >>> import jax.numpy as jnp
        >>> rank_one_update(jnp.eye(2), jnp.array([1.0, 0.0]), 3.0).tolist()
        [[2.0, 0.0], [0.0, 1.0]]
    """
    pivots = jnp.maximum(1.0 + weight * jnp.cumsum(direction**2), jnp.finfo(chol.dtype).eps)
    previous = jnp.concatenate([jnp.ones_like(pivots[:1]), pivots[:-1]])
    terms = (chol * direction)[:, 1:]
    later_columns = jnp.pad(jax.lax.cumsum(terms, axis=1, reverse=True), ((0, 0), (0, 1)))
    below = weight * direction / jnp.sqrt(pivots * previous)
    return chol * jnp.sqrt(pivots / previous) + later_columns * below


def _geometric_mean_scale(chol: jax.Array) -> jax.Array:
    return jnp.exp(jnp.mean(jnp.log(jnp.diagonal(chol))))
