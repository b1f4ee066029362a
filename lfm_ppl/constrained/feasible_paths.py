r"""Trajectories that respect all constraints, each with a weight whose mean is the evidence.

Backwards, from the last row to the first: the state at a row given the next one is Gaussian in a linear model with
Gaussian sites. Constraint by constraint its own site is taken out, the constrained quantity c drawn from the truncated
normal distribution that is left, N(c; m, v) 1(0 <= c <= w), and the rest of the state given c. With I the integral of
all sites t the weight of a trajectory is

    I prod_i  P(0 <= c_i <= w; m_i, v_i) / int N(c; m_i, v_i) t_i(c) dc,

and its mean is the integral without sites, whatever these are. They look ahead: a draw knows of the constraints at
earlier rows by their sites. Covariances are the same for all trajectories, which therefore cost as much as their means.

Source: Geweke (1991), Keane (1994), Econometrica 62, and Hajivassiliou, McFadden and Ruud (1996), Journal of
Econometrics 72, for the simulator; Carter and Kohn (1994), Biometrika 81, for backward sampling.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from lfm_ppl.constrained.truncated import log_share, quantile
from lfm_ppl.filtering.filter import Pass
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.quadrature import Marginal
from lfm_ppl.filtering.sites import gaussian_terms
from lfm_ppl.filtering.smoothing_kernel import smoothing_kernel
from lfm_ppl.filtering.update import Sites
from lfm_ppl.linalg import congruence, diagonal, matmul, semidefinite_root

_KNOWN = 1e-13
"""Share of the predicted variance of a quantity, and of a state's before it is drawn, below which it is known."""

_RESPECTED = 1e-6
"""Distance in predicted standard deviations by which a known quantity may lie outside."""


class Paths(NamedTuple):
    """Trajectories and their weights.

    Attributes:
        states: (N, n, S) at the intervals' ends.
        values: (N, B, S) of the constrained quantities, between 0 and their width where a constraint holds.
        log_weights: (S,), logarithms of what has the mean P / I: the integral of the factors over that of the sites.
    """

    states: jax.Array
    values: jax.Array
    log_weights: jax.Array


def feasible_paths(key: jax.Array, passed: Pass, held: jax.Array, widths: jax.Array, count: int) -> Paths:
    """Draw trajectories; half of them with the random numbers of the other half mirrored.

    Args:
        key: a JAX random key.
        passed: a forward scan with sites, everything kept; the last B entries are the constraints.
        held: (N, B), whether a constraint holds at the interval's end.
        widths: (B,).
        count: S, an even number.
    """
    rows, size = passed.phi.shape[:2]
    number = held.shape[1]
    keys = jax.random.split(key)
    # Not zero and not one, whose quantiles may be infinite.
    shares = jax.random.uniform(keys[0], (rows, number, count // 2), minval=1e-12, maxval=1.0 - 1e-12)
    normals = jax.random.normal(keys[1], (rows, size, count // 2))
    shares = jnp.concatenate([shares, 1.0 - shares], axis=-1)
    normals = jnp.concatenate([normals, -normals], axis=-1)

    def at_row(mean: jax.Array, covariance: jax.Array, row: tuple) -> tuple[jax.Array, jax.Array, jax.Array]:
        one, held, shares, normals = row
        before = diagonal(covariance)
        terms, first = one.site_terms, one.site_terms.value.shape[0] - number
        log_weights, values = jnp.zeros(count), []
        for index in range(number):
            sites = Sites(*(a[first + index] for a in terms.sites))
            h = one.jacobian[first + index]
            gain = matmul(covariance, h[:, None])[:, 0]
            variance = (h * gain).sum()
            now = terms.value[first + index] + matmul(h[None], mean - one.predicted.mean[:, None])[0]
            largest = terms.variance[first + index, first + index]
            known = ~(variance > _KNOWN * largest)
            safe = jnp.where(known, 1.0, variance)
            left = jnp.maximum(1.0 - sites.tau * safe, _KNOWN)
            cavity = Marginal(sites.centre + (now - sites.centre - safe * sites.nu) / left,
                              jnp.broadcast_to(safe / left, now.shape))
            outside = jnp.maximum(-now, now - widths[index]) > _RESPECTED * jnp.sqrt(jnp.maximum(largest, 1e-300))
            term = log_share(cavity, widths[index]) - gaussian_terms(sites, cavity, 1.0)
            # What is determined already is as it is: its site, which the proposal holds, is divided out there.
            away = now - sites.centre
            term = jnp.where(known, jnp.where(outside, -jnp.inf, (0.5 * sites.tau * away - sites.nu) * away), term)
            drawn = jnp.where(known, jnp.clip(now, 0.0, widths[index]), quantile(cavity, widths[index], shares[index]))
            take = held[index] & ~known
            log_weights = log_weights + jnp.where(held[index], term, 0.0)
            values.append(jnp.where(held[index], drawn, now))
            gain = jnp.where(take, gain / safe, 0.0)
            mean = mean + gain[:, None] * (drawn - now)
            covariance = congruence(jnp.eye(size) - gain[:, None] * h, covariance)
            # What is drawn has no variance but for rounding, of which no square root must be taken.
            gone = diagonal(covariance) <= _KNOWN * before
            covariance = jnp.where(gone[:, None] | gone[None, :], 0.0, covariance)
        state = mean + matmul(semidefinite_root(covariance), normals)
        return state, jnp.stack(values) if values else jnp.zeros((0, count)), log_weights

    def step(carry: tuple, inputs: tuple) -> tuple[tuple, tuple]:
        later, total = carry
        row, predicted, phi, process_cov = inputs
        filtered = row[0].filtered
        gain, conditional, _ = smoothing_kernel(filtered, predicted, phi, process_cov)
        mean = filtered.mean[:, None] + matmul(gain, later - predicted.mean[:, None])
        state, values, more = at_row(mean, conditional, row)
        return (state, total + more), (state, values)

    tree = jax.tree_util.tree_map
    every = (passed._replace(steps=None), held, shares, normals)
    end = tree(lambda a: a[-1], every)
    last = Moments(*end[0].filtered)
    state, values, total = at_row(jnp.broadcast_to(last.mean[:, None], (size, count)), last.covariance, end)
    later = tree(lambda a: a[1:], (passed.predicted, passed.phi, passed.process_cov))
    (_, total), (states, inside) = jax.lax.scan(
        jax.checkpoint(step), (state, total), (tree(lambda a: a[:-1], every), *later), reverse=True)
    return Paths(jnp.concatenate([states, state[None]]), jnp.concatenate([inside, values[None]]), total)
