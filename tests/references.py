"""Independent mathematics that the tests compare with; no state-space code in here.

`LinearLFM` is dense Gaussian process algebra: a physical system x' = J x + B u + c(t), with the forces' covariance
functions integrated against its impulse response by Gauss-Legendre quadrature. `moments` integrates the moment
equations of a non-linear system with SciPy's DOP853.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from math import factorial

import numpy as np
from scipy.integrate import solve_ivp

NODES, WEIGHTS = np.polynomial.legendre.leggauss(14)


def matern(scale, lengthscale, order: int) -> Callable:
    """Covariance function of a Matern process; it takes complex parameters, for derivatives by a complex step."""

    def kernel(t, s):
        x = np.sqrt(2 * order + 1) * np.abs(t - s) / lengthscale
        terms = [factorial(order + i) / (factorial(i) * factorial(order - i)) * (2 * x) ** (order - i)
                 for i in range(order + 1)]
        return scale**2 * np.exp(-x) * factorial(order) / factorial(2 * order) * sum(terms)

    return kernel


def added(*kernels: Callable) -> Callable:
    return lambda t, s: sum(kernel(t, s) for kernel in kernels)


def zero(t):
    return np.zeros_like(t)


@dataclasses.dataclass
class LinearLFM:
    """dx = (J x + B u + c(t)) dt + G dB, x(start) ~ N(m0, P0), u_r ~ GP(mean_r, kernel_r); w = (x, u).

    Attributes:
        system: J (M, M).
        coupling: B (M, R).
        kernels: R functions (t, s), vectorised.
        means: R functions of t, vectorised.
        start, mean, covariance: the initial condition.
        additive: c(t) (M,) at one time.
        dispersion: G (M, S).
        longest: longest panel of the quadrature; shorter than the scales of the kernels.
    """

    system: np.ndarray
    coupling: np.ndarray
    kernels: list
    start: float
    mean: np.ndarray
    covariance: np.ndarray
    means: list | None = None
    additive: Callable | None = None
    dispersion: np.ndarray | None = None
    longest: float = 1.0
    breaks: tuple = ()

    def _response(self, lag):
        """exp(J lag), zero for negative lags; lag of any shape, then (M, M)."""
        lag = np.asarray(lag)
        return np.where((lag >= 0)[..., None, None], expm(self.system * np.maximum(lag, 0.0)[..., None, None]), 0.0)

    def _panels(self, times):
        edges = np.unique(np.concatenate([[self.start], times, self.breaks]))
        edges = edges[edges >= self.start]
        pieces = [np.linspace(a, b, 1 + int(np.ceil((b - a) / self.longest))) for a, b in zip(edges[:-1], edges[1:],
                                                                                             strict=True)]
        return np.unique(np.concatenate([[self.start], *pieces]))

    def moments(self, times):
        """Return mean (K, W) and covariance (K, K, W, W) of w = (x, u) at ``times`` (K,), in any order."""
        times = np.asarray(times, float)
        size, count = self.coupling.shape[0], len(self.kernels)
        means = self.means or [zero] * count
        edges = self._panels(times)
        left_edges, width = edges[:-1], np.diff(edges)
        nodes = (left_edges[:, None] + width[:, None] * 0.5 * (NODES + 1)).ravel()
        weights = (width[:, None] * 0.5 * WEIGHTS).ravel()
        kind = np.result_type(self.system, self.coupling, np.asarray(self.covariance),
                              *(k(0.0, 1.0) for k in self.kernels))
        total = size + count
        mean = np.zeros((len(times), total), kind)
        cov = np.zeros((len(times), len(times), total, total), kind)
        response = self._response(times[:, None] - nodes)  # (K, N, M, M)
        initial = self._response(times - self.start)
        input_mean = np.stack([m(nodes) for m in means], -1) @ self.coupling.T if count else 0.0
        if self.additive is not None:
            input_mean = input_mean + np.stack([self.additive(t) for t in nodes])
        mean[:, :size] = initial @ self.mean
        if np.ndim(input_mean):
            mean[:, :size] += np.einsum("n,knij,nj->ki", weights, response, input_mean)
        cov[:, :, :size, :size] = np.einsum("kij,jl,qml->kqim", initial, self.covariance, initial)
        if self.dispersion is not None:
            noise = self.dispersion @ self.dispersion.T
            cov[:, :, :size, :size] += np.einsum("n,knij,jl,qnml->kqim", weights, response, noise, response)
        for r, kernel in enumerate(self.kernels):
            mean[:, size + r] = means[r](times)
            g = response @ self.coupling[:, r]  # (K, N, M)
            cov[:, :, size + r, size + r] = kernel(times[:, None], times)
            cross = np.einsum("n,kni,nq->kqi", weights, g, kernel(nodes[:, None], times))
            cov[:, :, :size, size + r] = cross
            cov[:, :, size + r, :size] = cross.swapaxes(0, 1)
            inner = self._inner(r, times, nodes, weights, g, left_edges, width)  # (N, K, M)
            cov[:, :, :size, :size] += np.einsum("n,kni,nqj->kqij", weights, g, inner)
        return mean, cov

    def _inner(self, r, times, nodes, weights, g, left_edges, width):
        """int k(a, b) h(t - b) db at the nodes a: the panel that holds a is cut at the kink b = a."""
        panel_index = np.repeat(np.arange(len(left_edges)), len(NODES))
        matrix = self.kernels[r](nodes[:, None], nodes) * weights * (panel_index[:, None] != panel_index)
        inner = np.einsum("an,kni->aki", matrix, g)
        for low, high in ((left_edges[panel_index], nodes), (nodes, left_edges[panel_index] + width[panel_index])):
            inner_nodes = low[:, None] + (high - low)[:, None] * 0.5 * (NODES + 1)
            mass = (high - low)[:, None] * 0.5 * WEIGHTS * self.kernels[r](nodes[:, None], inner_nodes)
            # The whole panel lies before t or after it.
            last = left_edges[panel_index] + width[panel_index]
            at_last = np.einsum("an,ani->ai", mass, self._response(last[:, None] - inner_nodes) @ self.coupling[:, r])
            inner = inner + np.einsum("akij,aj->aki", self._response(times - last[:, None]), at_last)
        return inner


@dataclasses.dataclass
class Regression:
    """Gaussian algebra of y = C w(t) + e, e ~ N(0, diag(noise)), NaN where missing.

    ``process`` has ``moments``; ``output`` is C (D, W); ``noise`` (D,) or (T, D).
    """

    process: LinearLFM
    output: np.ndarray
    noise: np.ndarray

    def joint(self, times, y, requested_times=()):
        y = np.asarray(y)
        self.count = len(times)
        mean, cov = self.process.moments(np.concatenate([times, np.asarray(requested_times, float)]))
        self.mean, self.cov = mean, cov
        present = np.isfinite(y).ravel()
        n = self.count
        prior = np.einsum("dw,kw->kd", self.output, mean[:n]).ravel()
        k = np.einsum("dw,kqwv,ev->kdqe", self.output, cov[:n, :n], self.output).reshape(y.size, y.size)
        k = k + np.diag(np.broadcast_to(self.noise, y.shape).ravel())
        cross = np.einsum("kqwv,dv->kwqd", cov[:, :n], self.output).reshape(len(mean), mean.shape[1], y.size)
        return present, y.ravel() - prior, k, cross

    def log_likelihood(self, times, y):
        present, residual, k, _ = self.joint(times, y)
        return _log_normal(residual[present], k[np.ix_(present, present)])

    def posterior(self, times, y, requested_times):
        """Return mean (K, W) and covariance (K, K, W, W) of w at ``requested_times``."""
        present, residual, k, cross = self.joint(times, y, requested_times)
        k, cross, n = k[np.ix_(present, present)], cross[:, :, present], self.count
        cross = cross[n:]
        gain = np.linalg.solve(k, cross.reshape(-1, k.shape[0]).T).T.reshape(cross.shape)
        mean = self.mean[n:] + gain @ residual[present]
        return mean, self.cov[n:, n:] - np.einsum("kwn,qvn->kqwv", gain, cross)

    def filtered(self, times, y):
        """Return mean and covariance of w at each time given the rows up to it."""
        present, residual, k, cross = self.joint(times, y)
        row = np.repeat(np.arange(len(times)), np.shape(y)[1])
        mean, covariance = self.mean.copy(), np.stack([self.cov[i, i] for i in range(len(times))])
        for index in range(len(times)):
            past = present & (row <= index)
            gain = np.linalg.solve(k[np.ix_(past, past)], cross[index][:, past].T).T
            mean[index] += gain @ residual[past]
            covariance[index] -= gain @ cross[index][:, past].T
        return mean, covariance

    def leave_one_out(self, times, y):
        """log p(y_k | all other rows), by conditioning on them."""
        present, residual, k, _ = self.joint(times, y)
        row = np.repeat(np.arange(len(times)), np.shape(y)[1])
        values = []
        for index in range(len(times)):
            row_mask, other_mask = present & (row == index), present & (row != index)
            gain = np.linalg.solve(k[np.ix_(other_mask, other_mask)], k[np.ix_(other_mask, row_mask)]).T
            values.append(_log_normal(residual[row_mask] - gain @ residual[other_mask],
                                      k[np.ix_(row_mask, row_mask)] - gain @ k[np.ix_(other_mask, row_mask)]))
        return np.array(values)


def expm(a):
    """Exponential of a stack of matrices: Taylor series with scaling and squaring."""
    if a.size == 0:
        return a
    squarings = max(0, int(np.ceil(np.log2(1e-300 + 4.0 * np.abs(a).sum(-1).max()))))
    a = a / 2.0**squarings
    total = term = np.broadcast_to(np.eye(a.shape[-1]), a.shape)
    for k in range(1, 15):
        term = term @ a / k
        total = total + term
    for _ in range(squarings):
        total = total @ total
    return total


def _log_normal(residual, covariance):
    if residual.size == 0:
        return 0.0
    sign, log_det = np.linalg.slogdet(covariance)
    value = -0.5 * (residual @ np.linalg.solve(covariance, residual) + log_det + np.log(sign)
                    + residual.size * np.log(2 * np.pi))
    return value if np.iscomplexobj(value) else float(value)


def complex_step(function: Callable, theta, step: float = 1e-30):
    """Gradient of an analytic real function, exact to rounding: Im f(theta + i step) / step."""
    theta = np.asarray(theta, complex)
    return np.array([function(theta + 1j * step * e).imag / step for e in np.eye(len(theta))])


class Points:
    """Nodes and weights of the rules for N(0, I), written from their papers.

    ``expectation`` and ``cross`` (Cov(f, x) L^-T) of the values at the nodes.
    """

    def __init__(self, nodes, weights):
        self.nodes, self.weights = np.asarray(nodes, float), np.asarray(weights, float)


def cubature(n: int) -> Points:
    return Points(np.sqrt(n) * np.concatenate([np.eye(n), -np.eye(n)]), np.full(2 * n, 0.5 / n))


def unscented(n: int, alpha: float, kappa: float) -> Points:
    lam = alpha**2 * (n + kappa) - n
    spread = np.sqrt(n + lam)
    nodes = np.concatenate([np.zeros((1, n)), spread * np.eye(n), -spread * np.eye(n)])
    return Points(nodes, np.r_[lam / (n + lam), np.full(2 * n, 0.5 / (n + lam))])


def gauss_hermite(n: int, order: int) -> Points:
    """Golub and Welsch: eigenvalues of the Jacobi matrix of the Hermite polynomials."""
    values, vectors = np.linalg.eigh(np.diag(np.sqrt(np.arange(1.0, order)), 1) + np.diag(np.sqrt(
        np.arange(1.0, order)), -1))
    grids = np.meshgrid(*[values] * n, indexing="ij")
    masses = np.meshgrid(*[vectors[0] ** 2] * n, indexing="ij")
    return Points(np.stack([g.ravel() for g in grids], -1), np.prod([g.ravel() for g in masses], axis=0))


def central_difference(n: int, step: float) -> Points:
    """Mean f0 + sum (f+ - 2 f0 + f-) / (2 h^2), derivative (f+ - f-) / (2 h)."""
    nodes = step * np.concatenate([np.zeros((1, n)), np.eye(n), -np.eye(n)])
    return Points(nodes, np.r_[1.0 - n / step**2, np.full(2 * n, 0.5 / step**2)])


def moments(drift: Callable, diffusion: Callable, points: Points | None, mean, covariance, span,
            jacobian: Callable | None = None, average_jacobian: bool = False):
    """Integrate dm/dt = E f, dP/dt = Cov(f, x) + Cov(x, f) + E D by DOP853 and return (m, P) at span[1].

    ``drift(x, t)`` and ``diffusion(x, t)`` (D = G G') take one point; without points the moments
    come from the Taylor expansion at the mean, with ``jacobian(x, t)``. ``average_jacobian`` takes
    Cov(f, x) = E[f'] P, by Stein's lemma.
    """
    n = len(mean)

    def rate(t, state):
        m, p = state[:n], state[n:].reshape(n, n)
        if points is None:
            f, cross, d = drift(m, t), jacobian(m, t) @ p, diffusion(m, t)
        else:
            chol = np.linalg.cholesky(p) if np.trace(p) > 0 else np.zeros((n, n))
            x = m + points.nodes @ chol.T
            values = np.stack([drift(v, t) for v in x])
            f = points.weights @ values
            if average_jacobian:
                cross = np.einsum("p,pij->ij", points.weights, np.stack([jacobian(v, t) for v in x])) @ p
            else:
                cross = (points.weights[:, None] * values).T @ (x - m)
            d = np.einsum("p,pij->ij", points.weights, np.stack([diffusion(v, t) for v in x]))
        return np.concatenate([f, (cross + cross.T + d).ravel()])

    first = np.concatenate([np.asarray(mean, float), np.asarray(covariance, float).ravel()])
    end = solve_ivp(rate, span, first, method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    return end[:n], end[n:].reshape(n, n)
