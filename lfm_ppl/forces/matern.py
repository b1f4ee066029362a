"""Matern processes of half-integer smoothness, exact as linear SDEs.

1. For nu = p + 1/2 the spectral density is rational: the process is the linear SDE of p + 1 states whose feedback has
   the (p + 1)-fold eigenvalue -lam.
2. In units of lam and scale all matrices depend on p alone; `_unit_matern` computes them once, in exact arithmetic
   where that matters.
3. The transition over x = lam dt is exp(-x) times a polynomial in x with nilpotent coefficients.
4. The process noise is P - A P A' on long steps. On short steps this difference cancels, and the integral of
   exp(F s) L L' exp(F s)' is taken by Gauss-Legendre quadrature instead.
5. The derivatives of both in dt are given in closed form, which is cheaper than differentiating steps 3 and 4.

Source: Hartikainen, Seppanen and Sarkka (2012), ICML, section 3.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from fractions import Fraction
from math import comb, factorial
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lfm_ppl.forces.discretise import gauss_legendre, powers, step_tangent
from lfm_ppl.forces.parameters import Mean
from lfm_ppl.forces.stretched import Stretched, covariance_of_derivatives
from lfm_ppl.utils.linalg import matmul

_LONGEST_STEP = 750.0
"""Number of e-folds x beyond which exp(-x) underflows to zero in float64."""


class Matern(Stretched):
    """A Matern process with smoothness nu = order + 1/2.

    With p = `order`, ``lam = sqrt(2 p + 1) / lengthscale`` and ``x = lam |lag|``,

        k(lag) = scale^2 exp(-x) p!/(2p)! sum_{i=0}^p (p + i)! / (i! (p - i)!) (2 x)^(p - i),
        S(omega) = scale^2 c / lam (1 + (omega / lam)^2)^-(p + 1),    c = 2 4^p p!^2 / (2p)!.

    The state is ``(u, u'/lam, ..., u^(p)/lam^p)``: its stationary covariance is ``scale^2`` times
    a constant matrix, and nothing over- or underflows for lengthscales from 1e-8 to 1e8. The
    transition is ``exp(-lam dt)`` times a polynomial, and the process noise keeps full relative
    accuracy from dt = 0 to any number of lengthscales.

    Args:
        scale: standard deviation of u, in the units of the force; > 0.
        lengthscale: in units of time; > 0.
        order: p, a Python int from 0 to 5; u is p times differentiable.
        mean: a number, or a function of time.

    Raises:
        ValueError: scale or lengthscale is not positive, or the order is out of range.
        TypeError: the order is not a Python int.

    Example:
        >>> force = Matern(scale=2.0, lengthscale=1.0, order=1)
        >>> force.state_dim, round(float(force.covariance(0.0)), 6)
        (2, 4.0)

    Source:
        Hartikainen, Seppanen and Sarkka (2012), ICML, section 3.
    """

    orders: ClassVar[range] = range(6)

    def __init__(self, scale: ArrayLike, lengthscale: ArrayLike, order: int = 1, mean: Mean = 0.0):
        super().__init__(scale, lengthscale, order, mean)

    @property
    def unit(self) -> UnitMatern:
        """The matrices of the unit process; the only eigenvalue of its feedback is -1."""
        return _unit_matern(self.order)

    @property
    def rate(self) -> jax.Array:
        """The rate lam = sqrt(2 nu) / lengthscale, in 1/time."""
        return np.sqrt(2 * self.order + 1) / self.lengthscale

    def discretise(self, dt: ArrayLike) -> tuple[jax.Array, jax.Array]:
        """Return transition (n, n) and process noise (n, n) over a step of length dt >= 0."""
        # Beyond _LONGEST_STEP the transition is zero; clipping keeps the powers of x finite.
        transition, noise = _discretise(self.order, jnp.minimum(self.rate * dt, _LONGEST_STEP))
        return transition, self.scale**2 * noise

    def covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return k(t - s), elementwise."""
        x = jnp.minimum(self.rate * jnp.abs(jnp.asarray(t) - s), _LONGEST_STEP)
        kernel = self.unit.kernel
        return self.scale**2 * jnp.exp(-x) * (powers(x, self.order + 1) * kernel).sum(-1)

    def spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Return S(omega), elementwise."""
        ratio = jnp.asarray(omega) / self.rate
        density = self.unit.density * self.scale**2 / self.rate
        return density * (1.0 + ratio**2) ** -(self.order + 1)


@dataclass(frozen=True)
class UnitMatern:
    """The matrices of a Matern process with scale = 1 and lam = 1; they depend on the order alone."""

    feedback: np.ndarray  # (n, n)
    density: float  # spectral density c of the driving noise
    dispersion: np.ndarray  # (n, 1)
    covariance: np.ndarray  # (n, n) stationary
    chol_covariance: np.ndarray  # (n, n)
    polynomial: np.ndarray  # (n, n, n): exp(F x) = exp(-x) sum_k polynomial[k] x^k
    kernel: np.ndarray  # (n,): k(x) = exp(-x) sum_k kernel[k] x^k
    nodes: np.ndarray  # (m,) Gauss-Legendre rule on [0, 1]
    weights: np.ndarray
    switch: float  # step x below which the process noise is computed by quadrature


@functools.cache
def _unit_matern(p: int) -> UnitMatern:
    n = p + 1
    feedback = np.diag(np.ones(p, dtype=int), 1)
    feedback[-1] = [-comb(n, k) for k in range(n)]
    nilpotent = feedback + np.eye(n, dtype=int)
    polynomial = [np.linalg.matrix_power(nilpotent, k) / factorial(k) for k in range(n)]
    moment = [Fraction(1)]
    for k in range(p):
        moment.append(moment[k] * Fraction(2 * k + 1, 2 * p - 1 - 2 * k))
    covariance = covariance_of_derivatives(moment)
    kernel = [
        Fraction(factorial(p) * factorial(2 * p - k) * 2**k)
        / (factorial(2 * p) * factorial(p - k) * factorial(k))
        for k in range(n)
    ]
    # At the switch below, both branches of the noise have a relative accuracy of 1e-14 in every entry.
    nodes, weights = gauss_legendre(min(2 * p + 8, 16))
    density = float(Fraction(2 * 4**p * factorial(p) ** 2, factorial(2 * p)))
    return UnitMatern(
        feedback=feedback.astype(float),
        density=density,
        dispersion=np.sqrt(density) * np.eye(n)[:, -1:],
        covariance=covariance,
        chol_covariance=np.linalg.cholesky(covariance),
        polynomial=np.array(polynomial),
        kernel=np.array(kernel, dtype=float),
        nodes=nodes,
        weights=weights,
        switch=min(p + 1.0, 5.0),
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _discretise(order, x):
    """Return transition and process noise for scale = 1 and lam = 1 over a step x."""
    unit = _unit_matern(order)
    monomials = powers(x, order + 1)[:, None, None]
    transition = jnp.exp(-x) * (monomials * unit.polynomial).sum(0)
    # P - A P A' cancels on short steps; the quadrature is inaccurate on long ones.
    propagated = matmul(transition, jnp.asarray(unit.chol_covariance))
    long = unit.covariance - matmul(propagated, propagated.T)
    short = _short_noise(jnp.minimum(x, unit.switch), unit)
    return transition, jnp.where(x < unit.switch, short, long)


@_discretise.defjvp
def _discretise_jvp(order, primals, tangents):
    unit = _unit_matern(order)
    transition, noise = _discretise(order, *primals)
    tangent = step_tangent(unit.feedback, unit.dispersion, transition, *tangents)
    return (transition, noise), tangent


def _short_noise(x, unit):
    """Return ``c int_0^x v(y) v(y)' dy`` (n, n), where v(y) is the last column of the transition matrix."""
    y = x * unit.nodes
    last = unit.polynomial[:, :, -1]
    weight = np.sqrt(unit.density * unit.weights)
    column = (powers(y, len(last))[:, :, None] * last).sum(1) * (jnp.exp(-y) * weight)[:, None]
    return x * (column[:, :, None] * column[:, None, :]).sum(0)
