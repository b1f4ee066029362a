"""The squared exponential process, approximated by a linear SDE."""

from __future__ import annotations

import functools
from math import ceil, factorial, log2
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lfm_ppl.forces.discretise import (
    SUBSTEP,
    discretise_series,
    doublings_for,
    powers,
    step_tangent,
    term_count,
)
from lfm_ppl.forces.stretched import Stretched, covariance_of_derivatives

_FAR = 100.0
"""Dimensionless time lam dt after which nothing is left: every mode decays by exp(-64) or more."""


class SquaredExponential(Stretched):
    """A squared exponential (Gaussian, RBF) process, as a linear SDE of even order.

        k(lag) = scale^2 exp(-lag^2 / (2 lengthscale^2)),
        S(omega) = scale^2 sqrt(2 pi) lengthscale exp(-(omega lengthscale)^2 / 2).

    1/S is an infinite series in omega^2. Cut at order N it leaves a rational spectral density,

        S_N(omega) = scale^2 sqrt(2 pi) lengthscale / sum_{n=0}^N (y / 2)^n / n!,

    with y = (omega lengthscale)^2, whose stable spectral factor is the SDE. The cut is the only
    approximation, and its constant is that of the source, so that S_N(0) = S(0). S_N exceeds S at
    high frequency, so the variance is larger: by 14% at N = 2, 1.7% at 4, 0.30% at 6 and 0.06% at
    8, which is also the largest error of the covariance at any lag. Rescaling to the exact variance
    would make the spectral density worse, and from N = 4 the covariance too; up to
    omega = 1/lengthscale the spectral density is within 2e-6 at N = 6.

    ``covariance`` and ``spectral_density`` are those of the exact process, ``sde_covariance`` and
    ``sde_spectral_density`` those of the SDE.

    The state is ``(u, u'/lam, ..., u^(N-1)/lam^(N-1))``, with lam = (N! 2^N)^(1/2N) / lengthscale,
    the geometric mean of the roots.

    Args:
        scale: standard deviation of u, in the units of the force; > 0.
        lengthscale: in units of time; > 0.
        order: N, one of 2, 4, 6, 8: the number of states.
        mean: a number, or a function of time.

    Raises:
        ValueError: for a scale or lengthscale that is not positive, or another order.
        TypeError: for an order that is not a Python int.

    Example:
        >>> force = SquaredExponential(scale=1.0, lengthscale=2.0)
        >>> force.state_dim, bool(abs(force.sde_covariance(1.0) - force.covariance(1.0)) < 0.01)
        (6, True)

    Source:
        Hartikainen, Seppanen and Sarkka (2012), ICML, section 3.
    """

    orders: ClassVar[tuple[int, ...]] = (2, 4, 6, 8)

    def __init__(self, scale: Any, lengthscale: Any, order: int = 6, mean: Any = 0.0):
        super().__init__(scale, lengthscale, order, mean)

    @property
    def unit(self) -> _Constants:
        """The matrices of the unit process."""
        return _constants(self.order)

    @property
    def rate(self) -> jax.Array:
        """The rate lam, the geometric mean of the roots' moduli, in 1/time."""
        return self.unit.rate / self.lengthscale

    @property
    def state_dim(self) -> int:
        """Number of states, the order."""
        return self.order

    def discretise(self, dt: ArrayLike) -> tuple[jax.Array, jax.Array]:
        """Return transition (n, n) and process noise (n, n) over a step of length dt >= 0."""
        transition, noise = _discretise(self.order, jnp.minimum(self.rate * dt, _FAR))
        return transition, self.scale**2 * noise

    def covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return k(t - s) of the exact process, elementwise."""
        lag = (jnp.asarray(t) - s) / self.lengthscale
        return self.scale**2 * jnp.exp(-0.5 * lag**2)

    def spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Return S(omega) of the exact process, elementwise."""
        ratio = jnp.asarray(omega) * self.lengthscale
        return self.scale**2 * np.sqrt(2 * np.pi) * self.lengthscale * jnp.exp(-0.5 * ratio**2)


class _Constants(NamedTuple):
    """Everything that depends on the order alone, for scale = 1 and lam = 1."""

    rate: float  # lam * lengthscale
    feedback: np.ndarray  # (n, n)
    dispersion: np.ndarray  # (n, 1)
    covariance: np.ndarray  # (n, n) stationary
    series: np.ndarray  # (K, n, n): F^k / k!
    growth: float  # bounds the series as ||F|| does, more closely
    max_doublings: int  # enough to reach _FAR


@functools.cache
def _constants(order: int) -> _Constants:
    rate = (factorial(order) * 2.0**order) ** (0.5 / order)
    characteristic = _stable_factor(order, rate)
    feedback = np.diag(np.ones(order - 1), 1)
    feedback[-1] = -characteristic[:order]
    density = np.sqrt(2 * np.pi) * rate
    dispersion = np.sqrt(density) * np.eye(order)[:, -1:]
    term = np.eye(order)
    series = [term]
    for k in range(1, term_count(order)):
        term = feedback @ term / k
        series.append(term)
    cube = np.linalg.matrix_power(feedback, 3)
    growth = max(np.linalg.norm(cube, 1) ** (1 / 3), np.linalg.norm(cube @ feedback, 1) ** (1 / 4))
    return _Constants(
        rate=rate,
        feedback=feedback,
        dispersion=dispersion,
        covariance=_stationary_covariance(characteristic, density),
        series=np.array(series),
        growth=float(growth),
        max_doublings=ceil(log2(growth * _FAR / SUBSTEP)),
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _discretise(order, x):
    """Return transition and process noise for scale = 1 and lam = 1 over a step x <= _FAR."""
    constants = _constants(order)
    doublings = doublings_for(constants.growth * x)
    step = x * jnp.exp2(-doublings)
    series = powers(step, len(constants.series))[:, None, None] * constants.series
    return discretise_series(series, constants.dispersion, step, doublings, constants.max_doublings)


@_discretise.defjvp
def _discretise_jvp(order, primals, tangents):
    constants = _constants(order)
    transition, noise = _discretise(order, *primals)
    tangent = step_tangent(constants.feedback, constants.dispersion, transition, *tangents)
    return (transition, noise), tangent


def _stable_factor(order, rate):
    """Coefficients a_0, ..., a_N = 1 of the polynomial whose roots are the stable ones.

    With omega = lam w and w^2 = -s^2 the denominator of S_N is ``sum_n (-rate^2 s^2 / 2)^n / n!``;
    of each pair +-s of its roots the one in the left half plane is taken. The roots are distinct.
    """
    denominator = [(-0.5 * rate**2) ** n / factorial(n) for n in range(order + 1)]
    roots = -np.sqrt(np.roots(denominator[::-1]).astype(complex))
    return np.poly(roots).real[::-1]


def _stationary_covariance(characteristic, density):
    """Solve F P + P F' + D = 0 for the companion form.

    P consists of the n spectral moments (`covariance_of_derivatives`), so that the Lyapunov equation has these alone
    as unknowns, which keeps P exact to rounding: row j is
    ``sum_k a_k E[u^(j) u^(k)] = density/2 [j = n - 1]``.
    """
    n = len(characteristic) - 1
    system = np.zeros((n, n))
    for j in range(n):
        for k in range(j % 2, n + 1, 2):
            system[j, (j + k) // 2] += (-1) ** ((j - k) // 2) * characteristic[k]
    moment = np.linalg.solve(system, np.append(np.zeros(n - 1), density / 2))
    return covariance_of_derivatives(moment)
