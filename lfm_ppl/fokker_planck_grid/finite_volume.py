"""Finite volumes for a one-dimensional Fokker-Planck equation: a Markov chain on the cells of a uniform grid.

1. The equation dp/dt = -d/ds [(b - D') p - D dp/ds] with D = g^2 / 2 becomes a master equation dm/dt = A m for the
   masses m of the cells. Its rates come from exponentially fitted fluxes and are never negative. No flux crosses the
   ends. Hence the total mass is constant, and every mass stays non-negative (`birth_death_process`).
2. Over an interval h the masses are exp(A h) m. By uniformisation, exp(A h) is a Poisson mixture of powers of a
   stochastic matrix, a series of non-negative terms without cancellation.
3. `transition` sums the series for a short interval and squares the matrix; `propagate` applies the series to masses
   without a matrix, unless the matrix is faster.
4. `gaussian_masses` integrates a Gaussian over the cells, for initial distributions and jumps.

Source: Scharfetter and Gummel (1969), IEEE Trans. Electron Devices 16; Chang and Cooper (1970), J. Comput. Phys. 6;
Stewart (1994), Introduction to the Numerical Solution of Markov Chains, section 8.2.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

_BASE = 4.0
"""Largest expected number of jumps in the series of a matrix exponential, before squaring."""

_TERMS = 36
"""Terms of this series; the Poisson(4) probability of more jumps is below 1e-21."""

_JUMPS_PER_SERIES = 400.0
"""Largest expected number of jumps of one series for the action on masses; exp(-400) does not underflow."""

_SMALLEST = 1e-280
"""Smaller transition probabilities are set to zero, because arithmetic with subnormal numbers is slow."""


class Grid(NamedTuple):
    """A uniform grid of cells for a one-dimensional state; hashable, static under compilation.

    Attributes:
        low: lower end, in the units of the state.
        high: upper end.
        cells: number of cells N.

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
        """Edges of the cells, (N + 1,)."""
        return np.linspace(self.low, self.high, self.cells + 1)

    @property
    def centres(self) -> np.ndarray:
        """Centres of the cells, (N,)."""
        return self.low + self.width * (np.arange(self.cells) + 0.5)


class BirthDeathProcess(NamedTuple):
    """Birth-death process on the cells, with generator A.

    Attributes:
        up: (N,), rate of moving to the next cell (1/time); zero in the last cell.
        down: (N,), rate of moving to the previous cell (1/time); zero in the first cell.
    """

    up: jax.Array
    down: jax.Array


def bernoulli(z: jax.Array) -> jax.Array:
    """Return the Bernoulli function B(z) = z / (exp(z) - 1), accurate for any z."""
    small = jnp.abs(z) < 1e-3
    safe = jnp.where(small, 1.0, jnp.clip(z, -1e300, 700.0))
    return jnp.where(small, 1.0 - z / 2.0 + z**2 / 12.0 - z**4 / 720.0, safe / jnp.expm1(safe))


@jax.jit
def birth_death_process(velocity: jax.Array, diffusion: jax.Array, width: jax.Array | float) -> BirthDeathProcess:
    """Return the birth-death process with exponentially fitted fluxes.

        J = D / width (B(-q) m_left - B(q) m_right) / width,    q = velocity width / D.

    The fluxes are of second order in the width, exact for the stationary flux of constant coefficients, and upwind
    where the diffusion vanishes.

    Args:
        velocity: (N - 1,), b - D' at the faces between the cells.
        diffusion: (N - 1,), D = g^2 / 2 at the faces, >= 0.
        width: width of a cell.

    Returns:
        Rates (N,) up and down.

    Source: Scharfetter and Gummel (1969), IEEE Trans. Electron Devices 16; Chang and Cooper (1970), J. Comput. Phys. 6.
    """
    floor = 1e-12 * jnp.abs(velocity) * width + 1e-290
    diffusivity = jnp.maximum(diffusion, floor)
    # NaN must stay NaN: it marks a failure in compiled code.
    diffusivity = jnp.where(jnp.isnan(diffusion), diffusion, diffusivity)
    ratio = velocity * width / diffusivity
    boundary = jnp.zeros((*velocity.shape[:-1], 1))
    up = jnp.concatenate([diffusivity / width**2 * bernoulli(-ratio), boundary], axis=-1)
    down = jnp.concatenate([boundary, diffusivity / width**2 * bernoulli(ratio)], axis=-1)
    return BirthDeathProcess(up, down)


def transition(process: BirthDeathProcess, length: jax.Array) -> jax.Array:
    """Return exp(A length) (N, N): column j holds the probabilities of the cells, starting from cell j.

    Uniformisation: with lam the largest rate of leaving a cell and P = I + A / lam,

        exp(A h) = exp(-lam h) sum_k (lam h)^k / k! P^k,    exp(A length) = exp(A h)^(2^s),    h = length / 2^s.

    All terms are non-negative, so that nothing cancels. Columns are rescaled to sum to one after each squaring. Only
    forward-mode derivatives exist: the number of squarings depends on the values, which reverse mode does not allow.

    Source: Jensen (1953), Skand. Aktuarietidskrift 36; Stewart (1994), Introduction to the Numerical Solution of
    Markov Chains, section 8.2.
    """
    size = process.up.shape[-1]
    fastest_rate = jnp.max(process.up + process.down)
    jumps = fastest_rate * length
    squarings = _count(jnp.log2(jnp.maximum(jumps / _BASE, 1.0)), 60)
    theta = jumps / 2.0**squarings
    up, down, stay = _event_probabilities(process, fastest_rate)
    index = np.arange(_TERMS + 1)
    log_factorial = np.append(0.0, np.cumsum(np.log(index[1:])))
    # Poisson probabilities; the double where keeps derivatives finite at theta = 0, and NaN a NaN.
    weights = jnp.exp(index * jnp.log(jnp.where(theta > 0, theta, 1.0)) - log_factorial - theta)
    weights = jnp.where(theta > 0, weights, jnp.where(theta == 0, 1.0 * (index == 0), theta))
    identity = jnp.eye(size)

    def term(k: jax.Array, total: jax.Array) -> jax.Array:
        below = jnp.roll(up[:, None] * total, 1, axis=0)
        above = jnp.roll(down[:, None] * total, -1, axis=0)
        return stay[:, None] * total + below + above + weights[_TERMS - 1 - k] * identity

    def square(_: jax.Array, matrix: jax.Array) -> jax.Array:
        return _normalise_columns(matrix @ matrix)

    base = jax.lax.fori_loop(0, _TERMS, term, weights[_TERMS] * identity)
    return jax.lax.fori_loop(0, squarings, square, _normalise_columns(base))


def propagate(process: BirthDeathProcess, length: jax.Array, masses: jax.Array, adjoint: bool = False) -> jax.Array:
    """Return exp(A length) m (..., N), or exp(A' length) m, by the series of `transition` without the matrix.

    If the series would take longer than the matrix, the matrix is computed after all.

    Args:
        process: the birth-death process.
        length: length of the interval, >= 0.
        masses: (..., N), >= 0.
        adjoint: propagate a function of the cell backwards instead.
    """
    jumps = jnp.max(process.up + process.down) * length
    # Number of jumps for which the series takes as long as the matrix: measured 6000 for 200 cells, 55,000 for 500.
    use_matrix = jumps > 6000.0 * (process.up.shape[-1] / 200.0) ** 2.4

    def by_matrix(m: jax.Array) -> jax.Array:
        matrix = transition(process, length)
        return m @ (matrix if adjoint else matrix.T)

    def by_series(m: jax.Array) -> jax.Array:
        # Under vmap both branches run: with length zero the series ends at once if the matrix is used.
        return _apply_series(process, jnp.where(use_matrix, 0.0, length), m, adjoint)

    return jnp.where(jnp.isnan(jumps), jnp.nan, jax.lax.cond(use_matrix, by_matrix, by_series, masses))


def _apply_series(process: BirthDeathProcess, length: jax.Array, masses: jax.Array, adjoint: bool) -> jax.Array:
    """Apply the series to masses, in sub-intervals of at most `_JUMPS_PER_SERIES` expected jumps."""
    fastest_rate = jnp.max(process.up + process.down)
    jumps = fastest_rate * length
    substeps = _count(jumps / _JUMPS_PER_SERIES, 10**9)
    theta = jumps / jnp.maximum(substeps, 1)
    # Nine standard deviations above the mean of the Poisson distribution.
    terms = _count(theta + 9.0 * jnp.sqrt(theta) + 20.0, 10**4)
    up, down, stay = _event_probabilities(process, fastest_rate)

    def apply_event(m: jax.Array) -> jax.Array:
        if adjoint:
            return stay * m + up * jnp.roll(m, -1, axis=-1) + down * jnp.roll(m, 1, axis=-1)
        return stay * m + jnp.roll(up * m, 1, axis=-1) + jnp.roll(down * m, -1, axis=-1)

    def add_term(k: jax.Array, carry: tuple) -> tuple:
        power, total, weight, sum_of_weights = carry
        factor = theta / (k + 1.0)
        power, weight = apply_event(power) * factor, weight * factor
        return power, total + power, weight, sum_of_weights + weight

    def apply_substep(_: jax.Array, m: jax.Array) -> jax.Array:
        weight = jnp.exp(-theta)
        _, total, _, sum_of_weights = jax.lax.fori_loop(0, terms, add_term, (weight * m, weight * m, weight, weight))
        if adjoint:
            return total / sum_of_weights
        # The series is truncated: rescaling restores the total mass.
        mass, truncated_mass = m.sum(-1, keepdims=True), total.sum(-1, keepdims=True)
        has_mass = truncated_mass > 0
        return total * jnp.where(has_mass, mass / jnp.where(has_mass, truncated_mass, 1.0), truncated_mass)

    # XLA shifts a vector four times as fast as a matrix with one row.
    is_vector = masses.size == masses.shape[-1]
    return jax.lax.fori_loop(0, substeps, apply_substep, masses.ravel() if is_vector else masses).reshape(masses.shape)


def gaussian_masses(grid: Grid, mean: jax.Array, variance: jax.Array) -> jax.Array:
    """Return the masses (N,) of N(mean, variance) in the cells, without the probability outside of the grid.

    For variance zero the mass is split between the two nearest centres such that the mean is preserved.
    """
    return _gaussian_masses(jnp.asarray(grid.edges), mean, variance)


@jax.jit
def _gaussian_masses(edges: jax.Array, mean: jax.Array, variance: jax.Array) -> jax.Array:
    is_point = variance <= 0
    sd = jnp.sqrt(jnp.where(is_point, 1.0, variance))
    below, above = edges[:-1] - mean, edges[1:] - mean
    # In the upper tail the difference of the complementary probabilities avoids cancellation.
    lower = jnp.where(below > 0, -above, below) / sd
    upper = jnp.where(below > 0, -below, above) / sd
    mass = jax.scipy.stats.norm.cdf(upper) - jax.scipy.stats.norm.cdf(lower)
    tent = jnp.maximum(1.0 - jnp.abs(0.5 * (below + above)) / (above - below), 0.0)
    return jnp.where(is_point, tent, jnp.maximum(mass, 0.0))


def _event_probabilities(process: BirthDeathProcess,
                         fastest_rate: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the probabilities (N,) of moving up, down and staying at one jump time of the uniformised process."""
    rate = jnp.where(fastest_rate > 0, fastest_rate, jnp.where(jnp.isnan(fastest_rate), fastest_rate, 1.0))
    up, down = process.up / rate, process.down / rate
    return up, down, jnp.maximum(1.0 - up - down, 0.0)


def _normalise_columns(matrix: jax.Array) -> jax.Array:
    """Set tiny entries to zero, and rescale the columns to sum to one."""
    matrix = jnp.where(matrix < _SMALLEST, 0.0, matrix)
    return matrix / matrix.sum(axis=0)


def _count(value: jax.Array, largest: int) -> jax.Array:
    """Round up to a number of repetitions between 0 and ``largest``; 0 for a value that is not finite."""
    return jnp.clip(jnp.nan_to_num(jnp.ceil(value), nan=0.0, posinf=0.0), 0, largest).astype(int)
