r"""Trajectories that respect all constraints, each with a weight whose mean is the evidence.

Backwards, from the last row to the first:

1. In a linear model with Gaussian factors t, the state at a row given the state at the next row is Gaussian.
2. For each constraint i of the row, in turn: divide out its factor, which leaves N(c; m_i, v_i) for the constrained
   quantity c; draw c from the truncated normal distribution N(c; m_i, v_i) 1(0 <= c <= w); condition the state on c.
3. Draw the remaining components of the state.

With the integral I of all factors, the weight of a trajectory is

    I prod_i  P(0 <= c_i <= w; m_i, v_i) / int N(c; m_i, v_i) t_i(c) dc.

For any factors, its expectation is the probability of the constraints. Good factors reduce its variance: they inform a
draw about the constraints at earlier rows. All trajectories share their covariances, so that each costs only its mean.

Source: Geweke (1991), Keane (1994), Econometrica 62, and Hajivassiliou, McFadden and Ruud (1996), Journal of
Econometrics 72, for the simulator; Carter and Kohn (1994), Biometrika 81, for backward sampling.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.constrained.truncated import log_share, quantile
from lfm_ppl.filtering.ep.factor_updates import gaussian_terms
from lfm_ppl.filtering.ep.quadrature import MeanVariance
from lfm_ppl.filtering.forward import FilterTrace
from lfm_ppl.filtering.moments import Moments
from lfm_ppl.filtering.smoothing_kernel import smoothing_kernel
from lfm_ppl.filtering.update import Factors
from lfm_ppl.utils.linalg import congruence, diagonal, matmul
from lfm_ppl.utils.random_keys import split_by_name
from lfm_ppl.utils.semidefinite import semidefinite_root

_ROUNDING_VARIANCE = 1e-13
"""Variances below this multiple of the predicted variance (of a state: of its variance before the draws of its row) are
rounding errors; the quantity is determined by what was drawn before."""

_TOLERATED_VIOLATION = 1e-6
"""Tolerated violation of a constraint by a determined quantity, in predicted standard deviations."""


class FeasiblePaths(NamedTuple):
    """Weighted trajectories.

    Attributes:
        states: (N, n, S), states at the ends of the intervals.
        values: (N, B, S), constrained quantities, between 0 and their width where a constraint holds.
        log_weights: (S,), logarithms of weights with the expectation P / I, where P is the integral of the exact
            terms, and I the integral of the factors.
    """

    states: jax.Array
    values: jax.Array
    log_weights: jax.Array


def sample_feasible_paths(key: jax.Array, forward_pass: FilterTrace, is_constrained: jax.Array, widths: jax.Array,
                          count: int) -> FeasiblePaths:
    """Draw trajectories; the second half of them with the mirrored random numbers of the first half.

    Args:
        key: a JAX random key.
        forward_pass: a complete forward scan with factors; the last B entries of its observations are the constraints.
        is_constrained: (N, B), whether a constraint holds at the end of an interval.
        widths: (B,), widths of the boxes.
        count: number of trajectories S, even.
    """
    intervals, size = forward_pass.phi.shape[:2]
    keys = split_by_name(key, ("uniforms", "normals"))
    # The quantiles of zero and one may be infinite.
    uniforms = jax.random.uniform(keys["uniforms"], (intervals, is_constrained.shape[1], count // 2), minval=1e-12,
                                  maxval=1.0 - 1e-12)
    normals = jax.random.normal(keys["normals"], (intervals, size, count // 2))
    uniforms = jnp.concatenate([uniforms, 1.0 - uniforms], axis=-1)
    normals = jnp.concatenate([normals, -normals], axis=-1)
    rows = (forward_pass._replace(initial=None), is_constrained, uniforms, normals)

    def step_back(carry: tuple, inputs: tuple) -> tuple[tuple, tuple]:
        next_state, total = carry
        row, predicted, phi, process_cov = inputs
        filtered = row[0].filtered
        gain, conditional_cov, _ = smoothing_kernel(filtered, predicted, phi, process_cov)
        mean = filtered.mean[:, None] + matmul(gain, next_state - predicted.mean[:, None])
        state, values, log_weights = _sample_row(mean, conditional_cov, row, widths)
        return (state, total + log_weights), (state, values)

    tree_map = jax.tree_util.tree_map
    last_row = tree_map(lambda a: a[-1], rows)
    last = Moments(*last_row[0].filtered)
    state, values, total = _sample_row(jnp.broadcast_to(last.mean[:, None], (size, count)), last.covariance, last_row,
                                       widths)
    earlier_rows = tree_map(lambda a: a[:-1], rows)
    transitions = tree_map(lambda a: a[1:], (forward_pass.predicted, forward_pass.phi, forward_pass.process_cov))
    (_, total), (earlier_states, earlier_values) = jax.lax.scan(
        jax.checkpoint(step_back), (state, total), (earlier_rows, *transitions), reverse=True)
    return FeasiblePaths(jnp.concatenate([earlier_states, state[None]]),
                         jnp.concatenate([earlier_values, values[None]]), total)


def _sample_row(mean: jax.Array, covariance: jax.Array, row: tuple,
                widths: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Draw the state at a row, with its constrained quantities.

    Args:
        mean: (n, S), of the state given the state at the next row.
        covariance: (n, n).
        row: the forward scan, whether constraints hold (B,), uniforms (B, S) and normals (n, S) of the row.
        widths: (B,).

    Returns:
        States (n, S), constrained quantities (B, S), and log weights (S,).
    """
    forward_row, is_constrained, uniforms, normals = row
    size, count = mean.shape
    number = is_constrained.shape[0]
    initial_variance = diagonal(covariance)
    terms = forward_row.update.factor_terms
    outputs = terms.value.shape[0] - number
    log_weights, values = jnp.zeros(count), []
    for index in range(number):
        factors = Factors(*(a[outputs + index] for a in terms.factors))
        h = forward_row.update.jacobian[outputs + index]
        gain = matmul(covariance, h[:, None])[:, 0]
        variance = (h * gain).sum()
        value = terms.value[outputs + index] + matmul(h[None], mean - forward_row.predicted.mean[:, None])[0]
        predicted_variance = terms.variance[outputs + index, outputs + index]
        is_determined = ~(variance > _ROUNDING_VARIANCE * predicted_variance)
        safe_variance = jnp.where(is_determined, 1.0, variance)
        # Divide the factor out: cavity precision = 1 / variance - tau.
        precision_ratio = jnp.maximum(1.0 - factors.tau * safe_variance, _ROUNDING_VARIANCE)
        cavity = MeanVariance(factors.centre + (value - factors.centre - safe_variance * factors.nu) / precision_ratio,
                              jnp.broadcast_to(safe_variance / precision_ratio, value.shape))
        log_weight = log_share(cavity, widths[index]) - gaussian_terms(factors, cavity, 1.0)
        # A determined quantity is not drawn: its weight is the indicator over the factor, which the proposal contains.
        is_violated = (jnp.maximum(-value, value - widths[index])
                       > _TOLERATED_VIOLATION * jnp.sqrt(jnp.maximum(predicted_variance, 1e-300)))
        distance = value - factors.centre
        log_weight = jnp.where(
            is_determined, jnp.where(is_violated, -jnp.inf, (0.5 * factors.tau * distance - factors.nu) * distance),
            log_weight)
        draw = jnp.where(is_determined, jnp.clip(value, 0.0, widths[index]),
                         quantile(cavity, widths[index], uniforms[index]))
        log_weights = log_weights + jnp.where(is_constrained[index], log_weight, 0.0)
        values.append(jnp.where(is_constrained[index], draw, value))
        gain = jnp.where(is_constrained[index] & ~is_determined, gain / safe_variance, 0.0)
        mean = mean + gain[:, None] * (draw - value)
        covariance = congruence(jnp.eye(size) - gain[:, None] * h, covariance)
        # The variance of what is drawn is a rounding error, whose square root must not be taken.
        is_rounding = diagonal(covariance) <= _ROUNDING_VARIANCE * initial_variance
        covariance = jnp.where(is_rounding[:, None] | is_rounding[None, :], 0.0, covariance)
    state = mean + matmul(semidefinite_root(covariance), normals)
    return state, jnp.stack(values) if values else jnp.zeros((0, count)), log_weights
