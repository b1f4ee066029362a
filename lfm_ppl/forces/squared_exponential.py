"""The squared exponential process, approximated by a linear SDE."""

from __future__ import annotations

import functools
from math import ceil, log2
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

_FAR = 150.0
"""Dimensionless time lam dt after which nothing is left: every mode decays by exp(-65) or more."""


class _Fit(NamedTuple):
    """A rational spectral density in units of the lengthscale: S_n(omega) / S(0) = ratio |b(i omega) / a(i omega)|^2.

    a and b are the real polynomials, one at zero, with the roots below and the conjugates of those that are complex.
    S_n is therefore positive whatever the numbers, and touches zero at a root of b on the imaginary axis.
    """

    delta: float  # noise that the fit assumes, relative to S(0)
    ratio: float  # S_n(0) / S(0)
    poles: tuple[complex, ...]  # roots of a in the left half plane, one of each pair
    zeros: tuple[complex, ...]  # roots of b


# Each minimises int_0^inf ((S_n - S) / (S + delta S(0)))^2 domega over all parameters, by non-linear least squares
# (Levenberg and Marquardt), with delta lowered by factors of ten from 0.01 on, from the poles of the Taylor form.
# `fitted` in tests/forces/test_squared_exponential.py is that computation; the tests there repeat it. One zero more,
# the most that an SDE allows, gains little or nothing. The noise per frequency of 200 observations over ten
# lengthscales, with a signal-to-noise ratio of 1e4 in variance, is 2e-6 S(0), hence delta = 1e-6. Orders below six
# cannot fit as far as that, and with a larger delta fit the frequencies better that they do reach.
_FITS = {
    2: _Fit(1e-1, 0.900860218653, (-0.834068893570 + 0.886982939694j,), ()),
    4: _Fit(
        1e-3,
        0.975668714090,
        (-1.065251139209 + 0.747526822942j, -1.135367124910 + 2.321413751666j),
        (5.068059989583j,),
    ),
    6: _Fit(
        1e-6,
        0.981491185945,
        (-0.980915321165 + 0.650227563040j, -1.026942816886 + 1.986570861209j, -1.144671204150 + 3.458840571253j),
        (-0.203265820319 + 5.967540208165j, 8.666318962048j),
    ),
    7: _Fit(
        1e-6,
        1.003862143104,
        (-1.191503548795, -1.209861048986 + 1.194642351504j, -1.270261062794 + 2.435328467553j,
         -1.386534576148 + 3.800379235293j),
        (-0.377024893386 + 6.099268117885j, 7.910793281397j),
    ),
    8: _Fit(
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
    frequency. To second order that is what decides the error of the log likelihood of data whose noise has the spectral
    density delta S(0). Rational approximations of an exponential gain a factor of 9.3 with each order, a Taylor
    expansion of 1/S much less.

    Neither the variance nor S(0) is exact. Errors of k (over any lag, relative to scale^2), of S (relative, up to
    omega = 2 / lengthscale), and of the log likelihood of up to 200 observations of u over 1/3 to 10 lengthscales,
    by the ratio of signal to noise in variance (a mean error and 2.5 standard deviations over data sets):

        order    delta     k        S        1         100      10^4
        2        1e-1      0.055    0.18     1.5       18       100
        4        1e-3      0.012    0.026    0.07      0.9      24
        6        1e-6      0.0093   0.019    0.05      0.07     0.10
        7        1e-6      0.0020   0.0041   0.011     0.015    0.02
        8        1e-6      0.0002   0.0004   0.001     0.002    0.003

    The default is the lowest order that keeps all of these log likelihoods within 0.1, with room; at order 6 the
    least favourable data sets reach 0.12. Where data can tell the SDE from the process there is an
    `lfm.ApproximationWarning`, see `lfm_ppl.model.resolution`.

    ``covariance`` and ``spectral_density`` are those of the exact process, ``sde_covariance`` and
    ``sde_spectral_density`` those of the SDE.

    The state is ``(v, v'/lam, ..., v^(n-1)/lam^(n-1))`` of the process v with the spectral density c / |a|^2, and
    ``u = b(d/dt) v`` is in the measurement; lam is the geometric mean of the roots of a.

    Args:
        scale: standard deviation of u, in the units of the force; > 0.
        lengthscale: in units of time; > 0.
        order: n, one of 2, 4, 6, 7, 8: the number of states.
        mean: a number, or a function of time.

    Raises:
        ValueError: for a scale or lengthscale that is not positive, or another order.
        TypeError: for an order that is not a Python int.

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

    def measurement(self, t: ArrayLike) -> np.ndarray:
        """Return H (n,), the coefficients of b in units of lam."""
        return self.unit.measurement

    def covariance(self, t: ArrayLike, s: ArrayLike = 0.0) -> jax.Array:
        """Return k(t - s) of the exact process, elementwise."""
        lag = (jnp.asarray(t) - s) / self.lengthscale
        return self.scale**2 * jnp.exp(-0.5 * lag**2)

    def covariances(self, lag: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the covariances at ``lag`` of the exact process and of the SDE, for parameters that are numbers.

        In NumPy, without compilation: ``k_n(lag) = sum_j r_j exp(p_j |lag|)`` with the roots p_j of a and the residues
        r_j of S_n.
        """
        lag = np.abs(lag) / float(self.lengthscale)
        poles, residues = _residues(self.order)
        variance = float(self.scale) ** 2
        return variance * np.exp(-0.5 * lag**2), variance * (np.exp(lag[..., None] * poles) @ residues).real

    def spectral_density(self, omega: ArrayLike) -> jax.Array:
        """Return S(omega) of the exact process, elementwise."""
        ratio = jnp.asarray(omega) * self.lengthscale
        return self.scale**2 * np.sqrt(2 * np.pi) * self.lengthscale * jnp.exp(-0.5 * ratio**2)


class _Constants(NamedTuple):
    """Everything that depends on the order alone, for scale = 1 and lam = 1."""

    rate: float  # lam * lengthscale
    feedback: np.ndarray  # (n, n)
    dispersion: np.ndarray  # (n, 1)
    measurement: np.ndarray  # (n,)
    covariance: np.ndarray  # (n, n) stationary
    series: np.ndarray  # (K, n, n): F^k / k!
    growth: float  # bounds the series as ||F|| does, more closely
    max_doublings: int  # enough to reach _FAR


@functools.cache
def _constants(order: int) -> _Constants:
    fit = _FITS[order]
    rate = float(np.exp(np.mean(np.log(np.abs(_roots(fit.poles))))))
    characteristic, numerator = (_polynomial(roots, rate) for roots in (fit.poles, fit.zeros))
    feedback = np.diag(np.ones(order - 1), 1)
    feedback[-1] = -characteristic[:order] / characteristic[order]
    # a and b are one at zero, where v therefore has the spectral density of u.
    density = fit.ratio * np.sqrt(2 * np.pi) * rate
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
        measurement=np.append(numerator, np.zeros(order - len(numerator))),
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


@functools.cache
def _residues(order):
    """The roots of a (n,) in units of 1/lengthscale, and the residues of S_n (n,) there for scale = 1."""
    fit = _FITS[order]
    poles, zeros = _roots(fit.poles), _roots(fit.zeros)
    # c |b|^2 / |a|^2 continued to the plane, in factors: b(s) b(-s) / (a(s) a(-s)).
    numerator = np.prod(1.0 - (poles[:, None] / zeros) ** 2, axis=1)
    others = 1.0 - (poles[:, None] / poles) ** 2 + np.eye(order)
    return poles, -0.5 * np.sqrt(2 * np.pi) * fit.ratio * poles * numerator / np.prod(others, axis=1)


def _roots(half):
    """All roots of a real polynomial, from one of each conjugate pair."""
    half = np.asarray(half, complex)
    return np.append(half, half[half.imag != 0.0].conj())


def _polynomial(roots, rate):
    """Coefficients, of rising power, of the real polynomial in s / rate with these roots and their conjugates.

    It is one at zero; the leading coefficient of a is one too, up to rounding, as rate is the roots' geometric mean.
    """
    coefficients = np.atleast_1d(np.poly(_roots(roots) / rate)).real[::-1]
    return coefficients / coefficients[0]


def _stationary_covariance(characteristic, density):
    """Solve F P + P F' + D = 0 for the companion form.

    P consists of the n spectral moments (`covariance_of_derivatives`), so that the Lyapunov equation has these alone
    as unknowns, which keeps P exact to rounding: row j is
    ``sum_k a_k E[v^(j) v^(k)] = density/2 [j = n - 1]``.
    """
    n = len(characteristic) - 1
    system = np.zeros((n, n))
    for j in range(n):
        for k in range(j % 2, n + 1, 2):
            system[j, (j + k) // 2] += (-1) ** ((j - k) // 2) * characteristic[k]
    moment = np.linalg.solve(system, np.append(np.zeros(n - 1), density / 2))
    return covariance_of_derivatives(moment)
