r"""Linear response: by how much smoothed covariances change where sites are given a say in them.

Expectation propagation has the posterior mean as the derivative of its log evidence by a linear source J at s, and the
second derivative, d m / d J, is a covariance again. It is not that of its Gaussian q, which holds the sites fixed: a
source moves the marginals, these the cavities, and these the sites. At the fixed point a site is a function of the
moments mu = (z, z^2 - 1) of its marginal, z = (f - m) / sd, and moves by S dmu,

    S = (C_q^-1 - C_p^-1) / a,    C_q = diag(1, 2),    C_p = [[1, skewness], [skewness, 2 + excess kurtosis]],

C_q and C_p the covariances of (z, z^2) under the marginal and under the tilted distribution, which have the same mean
and variance, and a the power of EP. All such moments, of the state and of its products, answer together:

    covariance of linear response = (C^-1 - sum_i E_i' S_i E_i)^-1,

with C that of phi = (s - m, (s - m)(s - m)') under q at all times, and E_i phi the moments of entry i. Under q the
state is a Markov process, s = m + G (s_later - m_later) + noise, and so is phi, in the wide sense. The sum is then that
of one scan that takes the sites in as observations of phi with precisions -S, from the last row to the first, and of
one adjoint scan back: no inverse of a covariance, and linear in time. Where sites are Gaussian, S is zero.

How near the exact covariance it is, docs/observations.md has. Where two modes have nearly the same mass the response is
no small change, and no better.

Source: Opper and Winther (2004), Variational linear response, NIPS 16; Welling and Teh (2004), Linear response
algorithms for approximate inference in graphical models, Neural Computation 16.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.filtering.filter import Pass
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.quadrature import tilted_shape
from lfm_ppl.filtering.rts import Smoothed, at_start
from lfm_ppl.filtering.sites import Converged, FamilyTerms
from lfm_ppl.filtering.time_grid import TimeGrid
from lfm_ppl.forces.sde import block_diagonal
from lfm_ppl.linalg import (
    congruence,
    diagonal,
    matmul,
    semidefinite_root,
    solve_lower,
    solve_semidefinite,
    symmetric,
)
from lfm_ppl.model.state_space import StateSpaceModel

LARGEST_STATE = 8
"""Most joint states whose products, half of the square of them, are carried along."""

_SINGULAR = 1e-9
"""Conditional share of a variance below which a state tells nothing of the one before it: gains would magnify noise."""

_LEAST, _LARGEST = 0.25, 4.0
"""Least and largest factor by which the variance of a combination of states may change; beyond, there are two modes."""

_LEAST_SPREAD = 1e-3
"""Least 2 + kurtosis - skewness^2 that is reckoned with; it is zero for two atoms and 2 for a Gaussian."""


class _Row(NamedTuple):
    """One interval, and the sites at its end.

    Attributes:
        gain: G (n, n), from the state at the end to that at the start.
        covariance: (n, n), smoothed, at the end.
        jacobian: (D, n), of the predictors in standard deviations.
        correlation: (D, D), of these, smoothed.
        precision: (2 D, 2 D), -S of all entries.
    """

    gain: jax.Array
    covariance: jax.Array
    jacobian: jax.Array
    correlation: jax.Array
    precision: jax.Array


def responds(ssm: StateSpaceModel) -> bool:
    """Whether a model is linear, with few states.

    In one that is not, a source moves the points of linearisation, too, whose errors are the larger ones.
    """
    linear = not (ssm.drift_structure.points or ssm.observation_structure.points or callable(ssm.model.process_noise))
    return linear and ssm.state_dim <= LARGEST_STATE


def response(passed: Pass, smoothed: Smoothed, start: Moments, grid: TimeGrid, terms: FamilyTerms, found: Converged,
             power: float) -> jax.Array:
    """Return what linear response adds to the smoothed covariances (N + 1, n, n) of the nodes.

    Zero where sites have not converged, and at nodes at which a variance would change by more than a factor of four.

    Args:
        passed: the forward scan with the converged sites.
        smoothed: what the backward scan left of it.
        start: moments at the initial time.
        grid: the time grid.
        terms: the factors of the data.
        found: the sites.
        power: a of EP.
    """
    rows = _rows(passed, smoothed, start, grid, terms, found, power)
    size = start.mean.shape[0]
    dim = size + size * (size + 1) // 2

    def take_in(change: jax.Array, row: _Row) -> tuple[jax.Array, jax.Array]:
        through, weight = _site(row, change)
        after = change - congruence(through, weight)
        return congruence(_lifted(row.gain), after), change

    def give_back(adjoint: jax.Array, at: tuple[_Row, jax.Array]) -> tuple[jax.Array, jax.Array]:
        row, change = at
        through, weight = _site(row, change)
        features, gain = _features(row.jacobian), matmul(through, weight)
        adjoint = congruence(_lifted(row.gain).T, adjoint)
        # (I - K E)' Lambda (I - K E) + E' W E, without a product of large matrices.
        pulled = matmul(adjoint, gain)
        crossed = matmul(pulled, features)
        adjoint = adjoint - crossed - crossed.T + congruence(features.T, weight + symmetric(matmul(gain.T, pulled)))
        own = (_moments(row.covariance) + change)[:size]
        return adjoint, change[:size, :size] - congruence(own, adjoint)

    first, changes = jax.lax.scan(take_in, jnp.zeros((dim, dim)), rows, reverse=True)
    _, at_ends = jax.lax.scan(give_back, jnp.zeros((dim, dim)), (rows, changes))
    added = jnp.concatenate([first[None, :size, :size], at_ends])
    small = found.converged & jax.vmap(_is_small)(added, smoothed.moments.covariance)
    return jnp.where(small[:, None, None], added, 0.0)


def _rows(passed: Pass, smoothed: Smoothed, start: Moments, grid: TimeGrid, terms: FamilyTerms, found: Converged,
          power: float) -> _Row:
    assert smoothed.predictor is not None
    usable = terms.present & found.cavity.valid & ~found.cavity.known
    skewness, kurtosis = tilted_shape(lambda f: power * terms.log_prob(f), found.cavity.cavity, found.cavity.marginal)
    spread = power * jnp.maximum(2.0 + kurtosis - skewness**2, _LEAST_SPREAD)
    by_entry = jnp.stack([skewness**2, -skewness, 0.5 * (skewness**2 - kurtosis)]) / spread
    by_entry = jnp.where(usable & jnp.isfinite(by_entry), by_entry, 0.0)
    count = len(passed.predicted.mean)
    at_end = jnp.zeros((3, count, by_entry.shape[2])).at[:, jnp.asarray(grid.observed)].set(by_entry)
    has = jnp.zeros((count, by_entry.shape[2]), bool).at[jnp.asarray(grid.observed)].set(usable)
    still = (jnp.asarray(grid.intervals.length) == 0) & (jnp.asarray(grid.intervals.jump) < 0)
    singular = max(_SINGULAR, 1e3 * float(jnp.finfo(passed.phi.dtype).eps))

    def row(now: jax.Array, predicted: jax.Array, phi: jax.Array, at_rest: jax.Array, covariance: jax.Array,
            jacobian: jax.Array, of_predictor: jax.Array, precision: jax.Array, has: jax.Array) -> _Row:
        gain = solve_semidefinite(predicted, matmul(phi, now), tolerance=singular).T
        gain = jnp.where(at_rest, jnp.eye(len(now)), gain)
        inverse_sd = jnp.where(has, 1.0 / jnp.sqrt(jnp.where(has, diagonal(of_predictor), 1.0)), 0.0)
        first, both, second = map(jnp.diag, precision)
        return _Row(gain, covariance, inverse_sd[:, None] * jnp.where(has[:, None], jacobian, 0.0),
                    inverse_sd[:, None] * jnp.where(has[:, None] & has, of_predictor, 0.0) * inverse_sd,
                    jnp.concatenate([jnp.concatenate([first, both], 1), jnp.concatenate([both, second], 1)]))

    return jax.vmap(row)(at_start(passed.filtered, start).covariance, passed.predicted.covariance, passed.phi, still,
                         smoothed.moments.covariance[1:], passed.jacobian, smoothed.predictor.covariance,
                         jnp.moveaxis(at_end, 0, 1), has)


def _site(row: _Row, change: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return C E' (dim, 2 D) and (I + T M)^-1 T (2 D, 2 D) of a row's sites, with M = E C E' and T = -S.

    C is the covariance of phi under q and ``change``, what later sites have added to it.
    """
    features = _features(row.jacobian)
    through = matmul(_moments(row.covariance) + change, features.T)
    own = block_diagonal([row.correlation, 2.0 * row.correlation**2]) + congruence(features, change)
    weight = jnp.linalg.solve(jnp.eye(len(own)) + matmul(row.precision, own), row.precision)
    return through, symmetric(weight)


def _pairs(size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pairs a <= b of states, and how often each product occurs among all n^2."""
    a, b = np.triu_indices(size)
    return a, b, np.where(a == b, 1.0, 2.0)


def _lifted(gain: jax.Array) -> jax.Array:
    """Return the matrix that takes phi to that of G s."""
    a, b, _ = _pairs(gain.shape[0])
    of_products = _products(gain, a, b) * np.where(a == b, 0.5, 1.0)
    return block_diagonal([gain, of_products])


def _moments(covariance: jax.Array) -> jax.Array:
    """Return the covariance of phi under a Gaussian: Cov(s_a s_b, s_c s_d) = P_ac P_bd + P_ad P_bc."""
    a, b, _ = _pairs(covariance.shape[0])
    return block_diagonal([covariance, _products(covariance, a, b)])


def _products(m: jax.Array, a: np.ndarray, b: np.ndarray) -> jax.Array:
    """Return M_ac M_bd + M_ad M_bc for the pairs (a, b) and (c, d)."""
    on_a, on_b = m[a], m[b]
    return on_a[:, a] * on_b[:, b] + on_a[:, b] * on_b[:, a]


def _features(jacobian: jax.Array) -> jax.Array:
    """Return E (2 D, dim): z = H s and z^2 of each predictor."""
    a, b, often = _pairs(jacobian.shape[1])
    return block_diagonal([jacobian, often * jacobian[:, a] * jacobian[:, b]])


def _is_small(added: jax.Array, covariance: jax.Array) -> jax.Array:
    """Whether the variance of any combination of states changes by a factor that is trusted."""
    root = semidefinite_root(covariance)
    relative = solve_lower(root, solve_lower(root, added).T)
    factor = 1.0 + jnp.linalg.eigvalsh(symmetric(jnp.where(jnp.isfinite(relative), relative, jnp.inf)))
    return jnp.all((factor > _LEAST) & (factor < _LARGEST))
