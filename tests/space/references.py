"""Space-time Gaussian processes by dense algebra, written once more in NumPy."""

from __future__ import annotations

import numpy as np
from scipy.integrate import quad
from scipy.special import j0


def matern(order, scale, lengthscale):
    """Kernel of a Matern process of order 0, 1 or 2, as a function of the lag."""
    def kernel(lag):
        x = np.sqrt(2 * order + 1) * np.abs(lag) / lengthscale
        return scale**2 * np.exp(-x) * (1.0, 1.0 + x, 1.0 + x + x**2 / 3.0)[order]
    return kernel


def squared_exponential(scale, lengthscale):
    return lambda lag: scale**2 * np.exp(-0.5 * (lag / lengthscale)**2)


def spectral_density(kernel, wavenumber, dimension, reach):
    """Fourier transform of an isotropic kernel, by quadrature up to a lag ``reach``."""
    if dimension == 1:
        if wavenumber == 0.0:
            return 2.0 * quad(kernel, 0.0, reach, epsabs=1e-13, limit=400)[0]
        return 2.0 * quad(kernel, 0.0, reach, weight="cos", wvar=wavenumber, epsabs=1e-13, limit=400)[0]
    return 2.0 * np.pi * quad(lambda r: r * kernel(r) * j0(wavenumber * r), 0.0, reach, epsabs=1e-13, limit=1000)[0]


def response_covariance(green, kernel, first, second, nodes=50):
    """Covariance of int green(t - s) u(s) ds from 0 to two times, by Gauss-Legendre quadrature off the diagonal."""
    x, w = np.polynomial.legendre.leggauss(nodes)

    def rule(low, high):
        return low + 0.5 * (high - low) * (x + 1.0), 0.5 * (high - low) * w

    early, late = min(first, second), max(first, second)
    total = 0.0
    for low, high in ((0.0, early), (early, late)):
        for s, weight in zip(*rule(low, high), strict=True):
            middle = min(s, early)
            inner = sum((v * green(early - r) * kernel(s - r)).sum()
                        for r, v in (rule(0.0, middle), rule(middle, early)))
            total += weight * green(late - s) * inner
    return total


def condition(cross, covariance, y):
    """Mean and covariance reduction of a Gaussian process given data with ``covariance``, and their log density."""
    factor = np.linalg.cholesky(covariance)
    white, half = np.linalg.solve(factor, y), np.linalg.solve(factor, cross.T)
    log_density = -0.5 * white @ white - np.log(np.diagonal(factor)).sum() - 0.5 * len(y) * np.log(2 * np.pi)
    return half.T @ white, half.T @ half, log_density
