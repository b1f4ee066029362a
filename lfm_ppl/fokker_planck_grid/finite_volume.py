"""Finite volumes for a one-dimensional Fokker-Planck equation: a Markov chain on the cells of a uniform grid.

    dp/dt = -d/ds [(b - D') p - D dp/ds],    D = g^2 / 2,

becomes a master equation for the masses of the cells. Its rates come from exponentially fitted fluxes, so that they
are never negative, and no flux crosses the ends: the chain keeps the mass, and every mass stays non-negative.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

_BASE = 4.0
"""Largest rate times length of the series of the exponential, before squaring."""

_TERMS = 36
"""Terms of that series; the Poisson(4) probability of more is below 1e-21."""

_PIECE = 400.0
"""Largest rate times length of one series for the action on masses; exp(-400) does not underflow."""

_SMALLEST = 1e-280
"""Transition probabilities below it count as zero: arithmetic with subnormal numbers is slow."""


class Grid(NamedTuple):
    """A uniform grid of cells for a one-dimensional state; hashable, static under compilation.

    Attributes:
        low: lower end, in the units of the state.
        high: upper end.
        cells: number N of cells.

    Example:
        >>> Grid(0.0, 1.0, 4).centres.tolist()
        [0.125, 0.375, 0.625, 0.875]
    """

    low: float
    high: float
    cells: int

    @property
    def width(self) -> float:
        """Width of a cell."""
        return (self.high - self.low) / self.cells

    @property
    def edges(self) -> np.ndarray:
        """The ends of the cells, (N + 1,)."""
        return np.linspace(self.low, self.high, self.cells + 1)

    @property
    def centres(self) -> np.ndarray:
        """The middles of the cells, (N,)."""
        return self.low + self.width * (np.arange(self.cells) + 0.5)


class Chain(NamedTuple):
    """A birth-death process on the cells.

    Attributes:
        up: (N,) rate of moving to the next cell, zero in the last one (1/time).
        down: (N,) rate of moving to the previous cell, zero in the first one.
    """

    up: jax.Array
    down: jax.Array

    def apply(self, masses: jax.Array, adjoint: bool = False) -> jax.Array:
        """Return A m (..., N) for masses, dm/dt = A m, or A' m for functions of the cell."""
        if adjoint:
            above = jnp.roll(masses, -1, axis=-1) - masses
            return self.up * above + self.down * (jnp.roll(masses, 1, axis=-1) - masses)
        gained = jnp.roll(self.up * masses, 1, axis=-1) + jnp.roll(self.down * masses, -1, axis=-1)
        return gained - (self.up + self.down) * masses


def bernoulli(z: jax.Array) -> jax.Array:
    """Return B(z) = z / (exp(z) - 1), for any z: 1 - z/2 + ... near zero, -z far below, 0 far above."""
    small = jnp.abs(z) < 1e-3
    safe = jnp.where(small, 1.0, jnp.clip(z, -1e300, 700.0))
    return jnp.where(small, 1.0 - z / 2.0 + z**2 / 12.0 - z**4 / 720.0, safe / jnp.expm1(safe))


@jax.jit
def chain(velocity: jax.Array, diffusion: jax.Array, width: jax.Array | float) -> Chain:
    """Return the chain with exponentially fitted fluxes.

        J = D / width (B(-q) m_left - B(q) m_right) / width,    q = velocity width / D,

    which is second order in the width, exact for the stationary flux of constant coefficients, and upwind where the
    diffusion vanishes.

    Args:
        velocity: (N - 1,) b - D' at the faces between the cells.
        diffusion: (N - 1,) D = g^2 / 2 there, >= 0.
        width: of a cell.

    Returns:
        Rates (N,) up and down.

    Source: Scharfetter and Gummel (1969), IEEE Trans. Electron Devices 16; Chang and Cooper (1970), J. Comput. Phys. 6.
    """
    floor = 1e-12 * jnp.abs(velocity) * width + 1e-290
    diffusivity = jnp.maximum(diffusion, floor)
    # NaN must stay NaN: it is how a failure in compiled code is known.
    diffusivity = jnp.where(jnp.isnan(diffusion), diffusion, diffusivity)
    ratio = velocity * width / diffusivity
    end = jnp.zeros((*velocity.shape[:-1], 1))
    up = jnp.concatenate([diffusivity / width**2 * bernoulli(-ratio), end], axis=-1)
    down = jnp.concatenate([end, diffusivity / width**2 * bernoulli(ratio)], axis=-1)
    return Chain(up, down)


def transition(walk: Chain, length: jax.Array) -> jax.Array:
    """Return exp(A length) (N, N): column j holds the probabilities of the cells, starting from cell j.

    Uniformisation: with lam the largest rate of leaving a cell and P = I + A / lam,

        exp(A h) = exp(-lam h) sum_k (lam h)^k / k! P^k,    exp(A length) = exp(A h)^(2^s),    h = length / 2^s.

    All terms are non-negative, so nothing cancels; columns are rescaled to sum to one after each squaring. It has
    forward-mode derivatives; the number of squarings depends on the values, which reverse mode does not allow.

    Source: Jensen (1953), Skand. Aktuarietidskrift 36; Stewart (1994), Introduction to the Numerical Solution of
    Markov Chains, section 8.2.
    """
    size = walk.up.shape[-1]
    fastest = jnp.max(walk.up + walk.down)
    whole = fastest * length
    squarings = _count(jnp.log2(jnp.maximum(whole / _BASE, 1.0)), 60)
    theta = whole / 2.0**squarings
    up, down, stay = _probabilities(walk, fastest)
    index = np.arange(_TERMS + 1)
    logarithm = np.append(0.0, np.cumsum(np.log(index[1:])))
    weights = jnp.exp(index * jnp.log(jnp.where(theta > 0, theta, 1.0)) - logarithm - theta)
    weights = jnp.where(theta > 0, weights, jnp.where(theta == 0, 1.0 * (index == 0), theta))
    identity = jnp.eye(size)

    def term(k: jax.Array, total: jax.Array) -> jax.Array:
        below = jnp.roll(up[:, None] * total, 1, axis=0)
        above = jnp.roll(down[:, None] * total, -1, axis=0)
        return stay[:, None] * total + below + above + weights[_TERMS - 1 - k] * identity

    base = jax.lax.fori_loop(0, _TERMS, term, weights[_TERMS] * identity)
    square = lambda _, a: _stochastic(a @ a)  # noqa: E731
    return jax.lax.fori_loop(0, squarings, square, _stochastic(base))


def propagate(walk: Chain, length: jax.Array, masses: jax.Array, adjoint: bool = False) -> jax.Array:
    """Return exp(A length) m (..., N), or exp(A' length) m, by the same series without the matrix.

    Where the series would take longer than the matrix, the matrix is made after all.

    Args:
        walk: the chain.
        length: of the interval, >= 0.
        masses: (..., N), >= 0.
        adjoint: propagate a function of the cell backwards instead.
    """
    whole = jnp.max(walk.up + walk.down) * length
    # Events of the series that take as long as the matrix: measured, near 6000 for 200 cells and 55,000 for 500.
    many = whole > 6000.0 * (walk.up.shape[-1] / 200.0) ** 2.4

    def by_matrix(m: jax.Array) -> jax.Array:
        matrix = transition(walk, length)
        return m @ (matrix if adjoint else matrix.T)

    # Under vmap both branches run; the one that is not taken should then end at once.
    short = lambda m: _series(walk, jnp.where(many, 0.0, length), m, adjoint)  # noqa: E731
    return jnp.where(jnp.isnan(whole), jnp.nan, jax.lax.cond(many, by_matrix, short, masses))


def _series(walk: Chain, length: jax.Array, masses: jax.Array, adjoint: bool) -> jax.Array:
    fastest = jnp.max(walk.up + walk.down)
    whole = fastest * length
    pieces = _count(whole / _PIECE, 10**9)
    theta = whole / jnp.maximum(pieces, 1)
    terms = _count(theta + 9.0 * jnp.sqrt(theta) + 20.0, 10**4)
    up, down, stay = _probabilities(walk, fastest)

    def once(m: jax.Array) -> jax.Array:
        if adjoint:
            return stay * m + up * jnp.roll(m, -1, axis=-1) + down * jnp.roll(m, 1, axis=-1)
        return stay * m + jnp.roll(up * m, 1, axis=-1) + jnp.roll(down * m, -1, axis=-1)

    def term(k: jax.Array, carry: tuple) -> tuple:
        power, total, weight, sum_of_weights = carry
        factor = theta / (k + 1.0)
        power, weight = once(power) * factor, weight * factor
        return power, total + power, weight, sum_of_weights + weight

    def piece(_: jax.Array, m: jax.Array) -> jax.Array:
        weight = jnp.exp(-theta)
        _, total, _, sum_of_weights = jax.lax.fori_loop(0, terms, term, (weight * m, weight * m, weight, weight))
        if adjoint:
            return total / sum_of_weights
        before, after = m.sum(-1, keepdims=True), total.sum(-1, keepdims=True)
        return total * jnp.where(after > 0, before / jnp.where(after > 0, after, 1.0), after)

    # XLA's code for shifting a vector is four times as fast as for shifting a row of one.
    single = masses.size == masses.shape[-1]
    return jax.lax.fori_loop(0, pieces, piece, masses.ravel() if single else masses).reshape(masses.shape)


def gaussian_masses(grid: Grid, mean: jax.Array, variance: jax.Array) -> jax.Array:
    """Return the masses (N,) of N(mean, variance) in the cells; what lies outside the grid is left out.

    A known state, of variance zero, is split between the two centres next to it, which keeps its mean.
    """
    return _gaussian_masses(jnp.asarray(grid.edges), mean, variance)


@jax.jit
def _gaussian_masses(edges: jax.Array, mean: jax.Array, variance: jax.Array) -> jax.Array:
    known = variance <= 0
    sd = jnp.sqrt(jnp.where(known, 1.0, variance))
    below, above = edges[:-1] - mean, edges[1:] - mean
    # In the upper tail the difference of the complements keeps its digits.
    lower = jnp.where(below > 0, -above, below) / sd
    upper = jnp.where(below > 0, -below, above) / sd
    mass = jax.scipy.stats.norm.cdf(upper) - jax.scipy.stats.norm.cdf(lower)
    tent = jnp.maximum(1.0 - jnp.abs(0.5 * (below + above)) / (above - below), 0.0)
    return jnp.where(known, tent, jnp.maximum(mass, 0.0))


def _probabilities(walk: Chain, fastest: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Of moving up, down and staying, in one event of the uniformised chain."""
    rate = jnp.where(fastest > 0, fastest, jnp.where(jnp.isnan(fastest), fastest, 1.0))
    up, down = walk.up / rate, walk.down / rate
    return up, down, jnp.maximum(1.0 - up - down, 0.0)


def _stochastic(a: jax.Array) -> jax.Array:
    a = jnp.where(a < _SMALLEST, 0.0, a)
    return a / a.sum(axis=0)


def _count(value: jax.Array, most: int) -> jax.Array:
    """Round up to a whole number of repetitions; none where the value is not finite."""
    return jnp.clip(jnp.nan_to_num(jnp.ceil(value), nan=0.0, posinf=0.0), 0, most).astype(int)
