"""The squared exponential process, approximated by a linear SDE.

1. `_FITS` holds, for each order, a rational spectral density that approximates exp(-omega^2 / 2): its poles and zeros
   minimise the error of the log likelihood of noisy data (see `SquaredExponential`).
2. The poles are scaled by their geometric mean lam, which gives the characteristic polynomial a and the feedback
   matrix in companion form. The zeros give the polynomial b, whose coefficients are the measurement row.
3. The stationary covariance holds spectral moments alone, which solve a small linear system.
4. A step of length x = lam dt uses the precomputed terms F^k / k!, scaled by powers of the substep, and doubling (see
   `lfm_ppl.forces.discretise`); its derivative in x is given in closed form.
5. All of these matrices depend on the order alone and are computed once per order, in NumPy.

Source: Hartikainen, Seppanen and Sarkka (2012), ICML, section 3.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, log2
from typing import Any, ClassVar

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

_HIGHEST_FREQUENCY = 12.0
"""Frequency in units of 1/lengthscale above which the exact process has no power, exp(-72) of S(0)."""

_FREQUENCIES = 400
"""Number of frequencies in the estimate of the error."""

_LONGEST_STEP = 150.0
"""Dimensionless step lam dt beyond which the transition is zero: every mode has decayed by exp(-65) or more."""


@dataclass(frozen=True)
class RationalDensity:
    """A rational spectral density in units of the lengthscale: S_n(omega) / S(0) = ratio |b(i omega) / a(i omega)|^2.

    a and b are the real polynomials, normalised to one at zero, with the roots below and the complex conjugates of
    the complex roots. S_n is positive by construction; it is zero at a root of b on the imaginary axis.
    """

    delta: float  # spectral density of the noise assumed in the fit, relative to S(0)
    ratio: float  # S_n(0) / S(0)
    poles: tuple[complex, ...]  # roots of a in the left half plane, one of each conjugate pair
    zeros: tuple[complex, ...]  # roots of b, one of each conjugate pair


# Each entry minimises int_0^inf ((S_n - S) / (S + delta S(0)))^2 domega over ratio, poles and zeros, by the
# Levenberg-Marquardt method, starting from the poles of the Taylor form, with delta lowered from 0.01 by factors of
# ten. The function `fitted` in tests/forces/test_squared_exponential.py repeats this computation. One more zero, the
# largest number that an SDE allows, gains little or nothing. The noise per frequency of 200 observations over ten
# lengthscales, with a signal-to-noise ratio of 1e4 in variance, is 2e-6 S(0), hence delta = 1e-6. Orders below six are
# inaccurate at frequencies where S is that small; a larger delta improves their fit at lower frequencies.
_FITS = {
    2: RationalDensity(1e-1, 0.900860218653, (-0.834068893570 + 0.886982939694j,), ()),
    4: RationalDensity(
        1e-3,
        0.975668714090,
        (-1.065251139209 + 0.747526822942j, -1.135367124910 + 2.321413751666j),
        (5.068059989583j,),
    ),
    6: RationalDensity(
        1e-6,
        0.981491185945,
        (-0.980915321165 + 0.650227563040j, -1.026942816886 + 1.986570861209j, -1.144671204150 + 3.458840571253j),
        (-0.203265820319 + 5.967540208165j, 8.666318962048j),
    ),
    7: RationalDensity(
        1e-6,
        1.003862143104,
        (-1.191503548795, -1.209861048986 + 1.194642351504j, -1.270261062794 + 2.435328467553j,
         -1.386534576148 + 3.800379235293j),
        (-0.377024893386 + 6.099268117885j, 7.910793281397j),
    ),
    8: RationalDensity(
        1e-6,
        0.999576156275,
        (-1.508392164157 + 0.552703237327j, -1.540943865424 + 1.671833388071j, -1.609424048511 + 2.837836649036j,
         -1.713278937556 + 4.122782996844j),
        (-0.616250606620 + 6.364262088075j, 7.219674833815j, 11.875488262141j),
    ),
}


class SquaredExponential(Stretched):
    r"""A squared exponential (Gaussian, RBF) process, as a linear SDE.

        k(lag) = scale^2 exp(-lag^2 / (2 lengthscale^2)),
        S(omega) = scale^2 sqrt(2 pi) lengthscale exp(-(omega lengthscale)^2 / 2).

    No SDE of finite order has this spectral density. That of order n has a rational one, of degree n in omega^2,

        S_n(omega) = c |b(i omega)|^2 / |a(i omega)|^2,    a of degree n, b of degree n - 2 (n - 3 if odd),

    positive at every frequency, with constants that minimise the mean square of (S_n - S) / (S + delta S(0)) over
    frequency. To second order this mean square determines the error of the log likelihood of data with a noise of
    spectral density delta S(0). The error of the best rational approximation of an exponential falls by a factor of
    9.3 with each order, that of a Taylor expansion of 1/S much more slowly.

    Neither the variance nor S(0) is exact. Errors of k (over any lag, relative to scale^2), of S (relative, up to
    omega = 2 / lengthscale), and of the log likelihood of up to 200 observations of u over 1/3 to 10 lengthscales,
    for signal-to-noise ratios of 1, 100 and 10^4 in variance (mean error plus 2.5 standard deviations over data sets):

        order    delta     k        S        1         100      10^4
        2        1e-1      0.055    0.18     1.5       18       100
        4        1e-3      0.012    0.026    0.07      0.9      24
        6        1e-6      0.0093   0.019    0.05      0.07     0.10
        7        1e-6      0.0020   0.0041   0.011     0.015    0.02
        8        1e-6      0.0002   0.0004   0.001     0.002    0.003

    The default is the lowest order with a clear margin below an error of 0.1 in all of these log likelihoods; at
    order 6 the least favourable data sets reach 0.12. Where data can distinguish the SDE from the exact process, an
    `lfm.ApproximationWarning` is given, see `lfm_ppl.model.resolution`.

    ``covariance`` and ``spectral_density`` describe the exact process, ``sde_covariance`` and
    ``sde_spectral_density`` the SDE.

    The state is ``(v, v'/lam, ..., v^(n-1)/lam^(n-1))``, where v has the spectral density c / |a|^2, and the
    measurement is ``u = b(d/dt) v``; lam is the geometric mean of the moduli of the roots of a.

    Args:
        scale: standard deviation of u, in the units of the force; > 0.
        lengthscale: in units of time; > 0.
        order: n, one of 2, 4, 6, 7, 8: the number of states.
        mean: a number, or a function of time.

    Raises:
        ValueError: scale or lengthscale is not positive, or there is no SDE of this order.
        TypeError: the order is not a Python int.

    Example:
        >>> force = SquaredExponential(scale=1.0, lengthscale=2.0)
        >>> force.state_dim, bool(abs(force.sde_covariance(1.0) - force.covariance(1.0)) < 0.002)
        (7, True)

    Source:
        Hartikainen, Seppanen and Sarkka (2012), ICML, section 3, for SDEs of rational spectral densities; Cody,
        Meinardus and Varga (1969), Journal of Approximation Theory 2, for rational approximations of exp(-x);
        Whittle (1953), Arkiv for Matematik 2, for the likelihood by frequency.
    """

    orders: ClassVar[tuple[int, ...]] = (2, 4, 6, 7, 8)

    def __init__(self, scale: Any, lengthscale: Any, order: int = 7, mean: Any = 0.0):
        super().__init__(scale, lengthscale, order, mean)

    @property
    def unit(self) -> UnitSquaredExponential:
        """The matrices of the unit process."""
        return _unit_process(self.order)

    @property
    def rate(self) -> jax.Array:
        """The rate lam, the geometric mean of the roots' moduli, in 1/time."""
        return self.unit.rate / self.lengthscale

    def discretise(self, dt: ArrayLike) -> tuple[jax.Array, jax.Array]:
        """Return transition (n, n) and process noise (n, n) over a step of length dt >= 0."""
        transition, noise = _discretise(self.order, jnp.minimum(self.rate * dt, _LONGEST_STEP))
        return transition, self.scale**2 * noise

    def measurement(self, t: ArrayLike) -> np.ndarray:
        """Return H (n,), the coefficients of b in units of lam."""
        return self.unit.measurement

    def covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return k(t - s) of the exact process, elementwise."""
        lag = (jnp.asarray(t) - s) / self.lengthscale
        return self.scale**2 * jnp.exp(-0.5 * lag**2)

    def covariances(self, lag: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the covariances at ``lag`` of the exact process and of the SDE, for concrete parameters.

        They are computed in NumPy, without compilation: ``k_n(lag) = sum_j r_j exp(p_j |lag|)`` with the roots p_j of
        a and the residues r_j of S_n.
        """
        lag = np.abs(lag) / float(self.lengthscale)
        poles, residues = _residues(self.order)
        variance = float(self.scale) ** 2
        return variance * np.exp(-0.5 * lag**2), variance * (np.exp(lag[..., None] * poles) @ residues).real

    def spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Return S(omega) of the exact process, elementwise."""
        ratio = jnp.asarray(omega) * self.lengthscale
        return self.scale**2 * np.sqrt(2 * np.pi) * self.lengthscale * jnp.exp(-0.5 * ratio**2)

    def approximation_error(self, precision: Callable[[np.ndarray], np.ndarray], spacing: float, count: int) -> float:
        r"""Return the error of a log likelihood due to the SDE: |mean| + 2 standard deviations over data sets.

        The Fourier coefficients of ``count`` evenly spaced observations of u with noise are nearly independent. The
        ratio of their variances under the exact process and under the SDE, and the moments of the error, are

            e(omega) = (1 + sum_k q S) / (1 + sum_k q S_n)    at omega + 2 pi k / spacing,
            |mean| = count/2 avg(e - 1 - log e),    variance = count/2 avg((e - 1)^2),

        where avg is the average over frequencies from zero to pi / spacing.

        Args:
            precision: q(omega), the inverse of the spectral density of the noise in units of u^2 time.
            spacing: time between observations.
            count: number of observations.

        Source: Whittle (1953), Arkiv for Matematik 2.
        """
        fit, nyquist, limit = _FITS[self.order], np.pi / spacing, _HIGHEST_FREQUENCY / float(self.lengthscale)
        highest = min(nyquist, limit)
        shifts = np.arange(-np.ceil(0.5 * limit / nyquist), np.ceil(0.5 * limit / nyquist) + 1)
        omega = highest * (np.arange(_FREQUENCIES) + 0.5)[:, None] / _FREQUENCIES + 2.0 * nyquist * shifts
        ratio = omega * float(self.lengthscale)
        exact, rational = np.exp(-0.5 * ratio**2), fit.ratio * np.ones(ratio.shape)
        for roots, power in ((_roots(fit.zeros), 2), (_roots(fit.poles), -2)):
            rational *= np.prod(np.abs(1.0 - 1j * ratio[..., None] / roots), axis=-1) ** power
        signal = precision(omega) * float(self.scale) ** 2 * np.sqrt(2.0 * np.pi) * float(self.lengthscale)
        excess = (1.0 + (signal * exact).sum(axis=1)) / (1.0 + (signal * rational).sum(axis=1)) - 1.0
        pairs = 0.5 * count * highest / nyquist
        mean, variance = pairs * (excess - np.log1p(excess)).mean(), pairs * (excess**2).mean()
        return float(mean + 2.0 * np.sqrt(variance))


@dataclass(frozen=True)
class UnitSquaredExponential:
    """The matrices of the SDE with scale = 1 and lam = 1; they depend on the order alone."""

    rate: float  # lam * lengthscale
    feedback: np.ndarray  # (n, n)
    dispersion: np.ndarray  # (n, 1)
    measurement: np.ndarray  # (n,)
    covariance: np.ndarray  # (n, n) stationary
    series: np.ndarray  # (K, n, n): F^k / k!
    growth: float  # bound on the terms of the series, tighter than ||F||
    max_doublings: int  # number needed for a step of _LONGEST_STEP


@functools.cache
def _unit_process(order: int) -> UnitSquaredExponential:
    fit = _FITS[order]
    rate = float(np.exp(np.mean(np.log(np.abs(_roots(fit.poles))))))
    characteristic, numerator = (_polynomial(roots, rate) for roots in (fit.poles, fit.zeros))
    feedback = np.diag(np.ones(order - 1), 1)
    feedback[-1] = -characteristic[:order] / characteristic[order]
    # a(0) = b(0) = 1, so that v and u have the same spectral density at zero.
    density = fit.ratio * np.sqrt(2 * np.pi) * rate
    dispersion = np.sqrt(density) * np.eye(order)[:, -1:]
    term = np.eye(order)
    series = [term]
    for k in range(1, term_count(order)):
        term = feedback @ term / k
        series.append(term)
    cube = np.linalg.matrix_power(feedback, 3)
    growth = max(np.linalg.norm(cube, 1) ** (1 / 3), np.linalg.norm(cube @ feedback, 1) ** (1 / 4))
    return UnitSquaredExponential(
        rate=rate,
        feedback=feedback,
        dispersion=dispersion,
        measurement=np.append(numerator, np.zeros(order - len(numerator))),
        covariance=_stationary_covariance(characteristic, density),
        series=np.array(series),
        growth=float(growth),
        max_doublings=ceil(log2(growth * _LONGEST_STEP / SUBSTEP)),
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _discretise(order, x):
    """Return transition and process noise for scale = 1 and lam = 1 over a step x <= _LONGEST_STEP."""
    unit = _unit_process(order)
    doublings = doublings_for(unit.growth * x)
    step = x * jnp.exp2(-doublings)
    series = powers(step, len(unit.series))[:, None, None] * unit.series
    return discretise_series(series, unit.dispersion, step, doublings, unit.max_doublings)


@_discretise.defjvp
def _discretise_jvp(order, primals, tangents):
    unit = _unit_process(order)
    transition, noise = _discretise(order, *primals)
    tangent = step_tangent(unit.feedback, unit.dispersion, transition, *tangents)
    return (transition, noise), tangent


@functools.cache
def _residues(order):
    """Return the roots of a (n,) in units of 1/lengthscale, and the residues of S_n (n,) at them for scale = 1."""
    fit = _FITS[order]
    poles, zeros = _roots(fit.poles), _roots(fit.zeros)
    # The analytic continuation of |b|^2 / |a|^2 is b(s) b(-s) / (a(s) a(-s)); each polynomial is a product of factors.
    numerator = np.prod(1.0 - (poles[:, None] / zeros) ** 2, axis=1)
    denominator = 1.0 - (poles[:, None] / poles) ** 2 + np.eye(order)
    return poles, -0.5 * np.sqrt(2 * np.pi) * fit.ratio * poles * numerator / np.prod(denominator, axis=1)


def _roots(half):
    """Return all roots of a real polynomial, given one root of each conjugate pair."""
    half = np.asarray(half, complex)
    return np.append(half, half[half.imag != 0.0].conj())


def _polynomial(roots, rate):
    """Return the coefficients, in ascending order, of the real polynomial in s / rate with these roots.

    The polynomial is one at zero. The leading coefficient of a is one as well, up to rounding, since rate is the
    geometric mean of the moduli of its roots.
    """
    coefficients = np.atleast_1d(np.poly(_roots(roots) / rate)).real[::-1]
    return coefficients / coefficients[0]


def _stationary_covariance(characteristic, density):
    """Solve F P + P F' + D = 0 for the companion form.

    The entries of P are the n spectral moments (`covariance_of_derivatives`). They are the only unknowns of the
    Lyapunov equation, which keeps P exact to rounding: row j is ``sum_k a_k E[v^(j) v^(k)] = density/2 [j = n - 1]``.
    """
    n = len(characteristic) - 1
    system = np.zeros((n, n))
    for j in range(n):
        for k in range(j % 2, n + 1, 2):
            system[j, (j + k) // 2] += (-1) ** ((j - k) // 2) * characteristic[k]
    moment = np.linalg.solve(system, np.append(np.zeros(n - 1), density / 2))
    return covariance_of_derivatives(moment)
