"""Anderson's acceleration of a fixed-point iteration of factors, with damping.

1. A sweep maps factors to new factors; its move is their difference.
2. The latest steps between factors, and the changes of the move over them, give by least squares the step at which a
   linear map would not move (Anderson). It is taken once moves are small; before, a damped move.
3. Factors that leave an entry without a cavity are halved towards the last valid ones.
4. Where changes grow, two factors react to each other, and the damping grows.
5. The first sweeps may be coarse. Where the change grows at the switch to fine ones, the memory is cleared.

Source: Anderson (1965), Journal of the ACM 12; Walker and Ni (2011), SIAM Journal on Numerical Analysis 49.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.filtering.ep.cavities import FactorMarginals, clip_to_proper
from lfm_ppl.filtering.ep.quadrature import MeanVariance
from lfm_ppl.filtering.ep.settings import FixedPointOptions
from lfm_ppl.filtering.update import Factors
from lfm_ppl.utils.linalg import matmul
from lfm_ppl.utils.semidefinite import solve_semidefinite


class Sweep(NamedTuple):
    """Result of one sweep.

    Attributes:
        factors: new factors, undamped.
        cavity: of the factors that went in.
        log_partition: (T, D), log Z_i of EP with these cavities.
        change: largest change of a factor; infinite where an entry has no cavity.
    """

    factors: Factors
    cavity: FactorMarginals
    log_partition: jax.Array
    change: jax.Array


class FixedPoint(NamedTuple):
    """Factors at the end of the iteration.

    Attributes:
        factors: (T, D) each.
        cavity: of the last sweep.
        log_partition: (T, D), log int q_-i p_i^a of expectation propagation with these cavities.
        change: estimate of the remaining change of a factor, from the last two sweeps.
        sweeps: number of sweeps.
        converged: whether that is below the tolerance and every cavity valid.
    """

    factors: Factors
    cavity: FactorMarginals
    log_partition: jax.Array
    change: jax.Array
    sweeps: jax.Array
    converged: jax.Array


class _State(NamedTuple):
    """State of the iteration.

    Attributes:
        factors: factors of the next sweep.
        base: nu and tau (2, T, D) of the last factors under which every entry had a cavity.
        move: undamped move of a sweep from those.
        fraction: of a move that is taken.
        steps, changes: (memory, 2, T, D), the latest steps between such factors, and the changes of ``move`` over them;
            zero where there is none.
        cavity, log_partition: of the last sweep.
        change: estimate of the remaining change after it; infinite where an entry had no cavity.
        last_change: largest change of a factor in the sweep from ``base``.
        sweeps: number of sweeps.
        fine_sweeps: how many of them were not coarse.
    """

    factors: Factors
    base: jax.Array
    move: jax.Array
    fraction: jax.Array
    steps: jax.Array
    changes: jax.Array
    cavity: FactorMarginals
    log_partition: jax.Array
    change: jax.Array
    last_change: jax.Array
    sweeps: jax.Array
    fine_sweeps: jax.Array


def iterate_factors(sweep: Callable[[Factors, jax.Array], Sweep], start: Factors, damping: float, max_sweeps: int,
                    options: FixedPointOptions) -> FixedPoint:
    """Sweep until the factors do not change.

    Args:
        sweep: maps factors, and whether it may be coarse, to new factors.
        start: first factors.
        damping: largest fraction of a move that is taken.
        max_sweeps: largest number of sweeps.
        options: constants of the iteration.
    """

    def advance(state: _State) -> _State:
        factors = state.factors
        is_coarse = ((state.fine_sweeps == 0) & (state.change > options.coarse_change)
                     & (state.sweeps < options.coarse_sweeps))
        new, cavity, log_partition, change = sweep(factors, is_coarse)
        is_valid = jnp.isfinite(change)
        position = jnp.stack([factors.nu, factors.tau])
        move = jnp.stack([new.nu, new.tau]) - position
        is_larger, is_switch = change > state.last_change, ~is_coarse & (state.fine_sweeps == 0)
        has_grown = is_larger & ~is_switch & (state.sweeps >= options.growing_sweeps)
        fraction = jnp.where(has_grown, jnp.maximum(0.5 * state.fraction, 0.05),
                             jnp.minimum(1.5 * state.fraction, damping))
        fraction = jnp.where(is_valid, fraction, 0.5 * state.fraction)
        # Factors that go on reacting to each other are damped more and more.
        is_near = change < options.linear_change
        fraction = jnp.where(is_near, fraction, jnp.minimum(fraction, options.patience / (1 + state.sweeps)))
        # Where fine sweeps change more than coarse ones left, coarse sweeps have no information on fine ones.
        restart = ~is_valid | has_grown | (is_larger & is_switch) | jnp.isinf(state.last_change)
        slot = state.sweeps % options.memory
        steps = jnp.where(restart, 0.0, state.steps.at[slot].set(position - state.base))
        changes = jnp.where(restart, 0.0, state.changes.at[slot].set(move - state.move))
        # The barrier keeps XLA from computing both again in each of their products.
        steps, changes = jax.lax.optimization_barrier((steps, changes))
        accelerated = _accelerated_step(move, steps, changes, fraction, cavity.marginal.variance)
        base, move = (jnp.where(is_valid, new, old) for new, old in ((position, state.base), (move, state.move)))
        # First factors that are far off are replaced by the result of a sweep from empty factors.
        is_reset = ~is_valid & jnp.isinf(state.last_change) & (state.sweeps == options.sweeps_without_cavity)
        fraction = jnp.where(is_reset, damping, fraction)
        step = jnp.where(is_reset, 0.0, jnp.where(is_valid & is_near, accelerated, fraction * move))
        nu, tau = base + step
        # The remaining change, if this step reduces it as the last one did.
        has_moved = state.last_change > 0
        reduction = jnp.clip(change / jnp.where(has_moved, state.last_change, 1.0), 0.1, 1.0)
        reduction = jnp.where(restart | ~has_moved, 1.0, reduction)
        return _State(factors._replace(nu=nu, tau=tau), base, move, fraction, steps, changes, cavity, log_partition,
                      reduction * change, jnp.where(is_valid, change, state.last_change), state.sweeps + 1,
                      state.fine_sweeps + ~is_coarse)

    def not_converged(state: _State) -> jax.Array:
        is_open = (state.change >= _tolerance(state.change, options)) | (state.fine_sweeps == 0)
        return is_open & (state.sweeps < max_sweeps) & (state.fraction > options.smallest_fraction)

    proper = clip_to_proper(start)
    move = jnp.stack([proper.nu, proper.tau])
    memory = jnp.zeros((options.memory, *move.shape))
    zero, infinite, count = jnp.zeros_like(start.nu), jnp.full((), jnp.inf), jnp.zeros((), int)
    no_cavity = FactorMarginals(MeanVariance(zero, zero), MeanVariance(zero, zero), zero > 0, zero > 0)
    state = _State(start, jnp.zeros_like(move), move, jnp.asarray(damping), memory, memory, no_cavity, zero, infinite,
                   infinite, count, count)
    state = jax.lax.while_loop(not_converged, advance, state)
    converged = (state.change < _tolerance(state.change, options)) & (state.fine_sweeps > 0)
    return FixedPoint(state.factors, state.cavity, state.log_partition, state.change, state.sweeps, converged)


def _accelerated_step(move: jax.Array, steps: jax.Array, changes: jax.Array, fraction: jax.Array,
                      variance: jax.Array) -> jax.Array:
    """Return the step (2, T, D) to the point at which a linear map through the last sweeps would not move.

    Least squares in units of the marginals, as changes are measured.
    """
    units = jnp.stack([jnp.sqrt(variance), variance])

    def flatten(a: jax.Array) -> jax.Array:
        return a.reshape(*a.shape[:-3], -1)

    # The barrier keeps XLA from computing the rows again for each of their products.
    rows = jax.lax.optimization_barrier(jnp.concatenate([flatten(changes), flatten(move)[None]]) * flatten(units))
    gram = jax.lax.dot_general(rows, rows, (((1,), (1,)), ((), ())))
    weights = solve_semidefinite(gram[:-1, :-1], gram[:-1, -1:], tolerance=1e-10)
    correction = matmul(weights.T, flatten(steps + fraction * changes)).reshape(move.shape)
    return fraction * move - correction


def _tolerance(change: jax.Array, options: FixedPointOptions) -> float:
    """Return the largest change of converged factors; in single precision none is as small as 1e-8."""
    return max(options.tolerance, 32 * float(jnp.finfo(change.dtype).eps))
