"""Bases of periodic forces: sines and cosines, or the eigenfunctions of any periodic kernel.

1. A `Basis` has independent weights z with prior variances and a row h(t), so that u(t) = h(t) z(t).
2. `Waves` serves stationary kernels. The weights of each frequency rotate, ``dz/dt = F z``, so that h is constant and
   models keep their exact transitions. The variances are Fourier coefficients of the kernel, by Gauss-Legendre
   quadrature (`fourier_coefficients`).
3. `Eigenfunctions` serves all other kernels. Nystrom's method approximates the eigenfunctions of the kernel from its
   Gram matrix at the midpoints of N equal parts of a cycle; the weights are constant and h depends on time.
4. The leading eigenvectors have their own derivative, which is finite where eigenvalues repeat (`eigenspace`).
5. `spectrum` gives the eigenvalues alone, for concrete kernels, and raises where the kernel is not positive definite.

Source: Reece, Ghosh, Rogers, Roberts and Jennings (2014), Journal of Machine Learning Research 15, sections 4 and 5.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from scipy.special import roots_legendre

from lfm_ppl.forces.eigenspace import leading_eigenvectors
from lfm_ppl.forces.periodic_kernels import PeriodicCovariance
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import matmul, solve_lower
from lfm_ppl.utils.semidefinite import semidefinite_root

_NEGATIVE = 1e-8
"""Negative eigenvalues up to this share of the sum of all eigenvalues are attributed to rounding."""


class Basis(eqx.Module):
    """Weights z and a row h(t) with ``u(t) = h(t) z(t)``; without noise ``dz/dt = F z``, perhaps with F = 0.

    Attributes:
        count: number J of functions.
        stationary: whether h does not depend on time.
    """

    @property
    def count(self) -> int:
        """Number J of functions."""
        raise NotImplementedError

    @property
    def stationary(self) -> bool:
        """Whether h does not depend on time."""
        raise NotImplementedError

    def variances(self) -> jax.Array:
        """Return the prior variances (J,) of the independent weights z, which are constant in time."""
        raise NotImplementedError

    def feedback(self) -> jax.Array:
        """Return F (J, J)."""
        raise NotImplementedError

    def transition(self, dt: ArrayLike) -> jax.Array:
        """Return exp(F dt) (J, J)."""
        raise NotImplementedError

    def row(self, t: ArrayLike) -> jax.Array:
        """Return h(t) (J,)."""
        raise NotImplementedError

    def eigenfunctions(self, t: ArrayLike) -> jax.Array:
        """Return the functions at times t, in a new last axis (..., J); their mean square over a cycle is one."""
        raise NotImplementedError

    def eigenvalues(self) -> jax.Array:
        """Return the variances (J,) of the weights of `eigenfunctions`."""
        raise NotImplementedError

    def covariance(self, t: ArrayLike, s: ArrayLike) -> jax.Array:
        """Return ``sum_j eigenvalue_j phi_j(t) phi_j(s)``, elementwise."""
        return (self.eigenvalues() * self.eigenfunctions(t) * self.eigenfunctions(s)).sum(-1)


class Waves(Basis):
    """A level and pairs of cosine and sine, with the covariance ``level + sum_k power_k cos w_k (t - s)``.

    The state is (level, c_1, ..., c_K, s_1, ..., s_K) with ``u = level + sum_k c_k``; each pair (c_k, s_k) rotates at
    w_k. All matrices are constant, so that models with such a force keep their exact transitions.

    Args:
        level: variance of the level; None: no level.
        frequencies: (K,) in radians per unit of time.
        powers: (K,) variances of the pairs.
    """

    level: Any
    frequencies: jax.Array
    powers: jax.Array

    @property
    def count(self) -> int:
        """Number of functions."""
        return self._level_count + 2 * self.frequencies.shape[0]

    @property
    def _level_count(self) -> int:
        return 0 if self.level is None else 1

    @property
    def stationary(self) -> bool:
        """True."""
        return True

    def variances(self) -> jax.Array:
        """Return the prior variances (J,) of the state."""
        return jnp.concatenate([*self._level_variance(), self.powers, self.powers])

    def feedback(self) -> jax.Array:
        """Return F (J, J)."""
        return self._rotation(jnp.zeros_like(self.frequencies), self.frequencies, 0.0)

    def transition(self, dt: ArrayLike) -> jax.Array:
        """Return exp(F dt) (J, J)."""
        angle = self.frequencies * dt
        return self._rotation(jnp.cos(angle), jnp.sin(angle), 1.0)

    def row(self, t: ArrayLike) -> jax.Array:
        """Return h (J,), the same at all times."""
        pairs = self.frequencies.shape[0]
        return jnp.asarray(np.concatenate([np.ones(self._level_count + pairs), np.zeros(pairs)]))

    def eigenfunctions(self, t: ArrayLike) -> jax.Array:
        """Return the functions 1, sqrt(2) cos and sqrt(2) sin at times t (..., J)."""
        angle = jnp.asarray(t, float)[..., None] * self.frequencies
        pairs = np.sqrt(2.0) * jnp.concatenate([jnp.cos(angle), jnp.sin(angle)], -1)
        return jnp.concatenate([jnp.ones((*angle.shape[:-1], self._level_count)), pairs], -1)

    def eigenvalues(self) -> jax.Array:
        """Return the variances (J,) of the weights of `eigenfunctions`."""
        return jnp.concatenate([*self._level_variance(), 0.5 * self.powers, 0.5 * self.powers])

    def _level_variance(self) -> list[jax.Array]:
        return [] if self.level is None else [jnp.reshape(self.level, (1,))]

    def _rotation(self, cosine: jax.Array, sine: jax.Array, level: float) -> jax.Array:
        c, s = jnp.diag(cosine), jnp.diag(sine)
        pairs = jnp.concatenate([jnp.concatenate([c, s], 1), jnp.concatenate([-s, c], 1)])
        return jax.scipy.linalg.block_diag(level * jnp.eye(self._level_count), pairs) if self._level_count else pairs


class Eigenfunctions(Basis):
    """The leading eigenfunctions of a kernel on a cycle, by Nystrom's method, extended periodically.

    With the midpoints S of N equal parts of the cycle, G = K(S, S), and its leading eigenvectors V (N, J),

        u(t) = K(t, S) V z,    z ~ N(0, (V' G V)^-1);

    V' G V is the diagonal matrix of the eigenvalues mu of G, so that this is ``sum_j w_j phi_j(t)`` with
    ``phi_j = sqrt(N) / mu_j K(t, S) v_j`` and ``w_j ~ N(0, mu_j / N)``. It is treated as a full matrix, since its
    derivative is not diagonal. The state is z, whitened by the Cholesky factor of V' G V.

    Attributes:
        kernel: the kernel.
        points: S (N,).
        vectors: V (N, J).
        whitened: (N, J), V times the inverse of the transposed Cholesky factor.
        spectrum: (J,), mu / N.
    """

    kernel: PeriodicCovariance
    points: jax.Array
    vectors: jax.Array
    whitened: jax.Array
    spectrum: jax.Array

    def __init__(self, kernel: PeriodicCovariance, count: int, points: int):
        self.kernel = kernel
        self.points = cycle_points(kernel, points)
        gram = kernel(self.points[:, None], self.points[None, :])
        self.vectors = leading_eigenvectors(0.5 * (gram + gram.T), count)
        inner = self.vectors.T @ gram @ self.vectors
        # Eigenvectors of eigenvalues at rounding level are arbitrary: the semi-definite factor omits them.
        factor = semidefinite_root(0.5 * (inner + inner.T))
        self.whitened = solve_lower(factor, self.vectors.T).T
        self.spectrum = jnp.diagonal(inner) / points

    @property
    def count(self) -> int:
        """Number J of functions."""
        return self.vectors.shape[1]

    @property
    def stationary(self) -> bool:
        """False."""
        return False

    def variances(self) -> jax.Array:
        """Return ones (J,)."""
        return jnp.ones(self.count)

    def feedback(self) -> jax.Array:
        """Return zeros (J, J)."""
        return jnp.zeros((self.count, self.count))

    def transition(self, dt: ArrayLike) -> jax.Array:
        """Return the identity (J, J)."""
        return jnp.eye(self.count)

    def row(self, t: ArrayLike) -> jax.Array:
        """Return h(t) (J,)."""
        return matmul(self.kernel(t, self.points)[None, :], self.whitened)[0]

    def eigenfunctions(self, t: ArrayLike) -> jax.Array:
        """Return the Nystrom eigenfunctions at times t (..., J)."""
        cross_covariance = self.kernel(jnp.asarray(t, float)[..., None], self.points)
        return cross_covariance @ self.vectors / (self.spectrum * np.sqrt(self.points.shape[0]))

    def eigenvalues(self) -> jax.Array:
        """Return mu / N (J,)."""
        return self.spectrum

    def covariance(self, t: ArrayLike, s: ArrayLike) -> jax.Array:
        """Return the covariance of u(t) and u(s), elementwise."""
        t, s = jnp.asarray(t, float)[..., None], jnp.asarray(s, float)[..., None]
        return ((self.kernel(t, self.points) @ self.whitened) * (self.kernel(s, self.points) @ self.whitened)).sum(-1)


def waves(kernel: PeriodicCovariance, harmonics: int) -> Waves:
    """Return the level and the harmonics 1, ..., ``harmonics`` of a stationary kernel.

    Raises:
        ValueError: a Fourier coefficient is negative, so that the kernel is not positive definite.
    """
    coefficients = fourier_coefficients(kernel, harmonics)
    _check_definite(kernel, coefficients, "Fourier coefficient {index} is {value:.3g}")
    # In compiled code a kernel that is not positive definite gives NaN, and so a log likelihood of -inf.
    total = jnp.abs(coefficients).sum()
    variances = jnp.where(coefficients > -_NEGATIVE * total, jnp.maximum(coefficients, 0.0), jnp.nan)
    frequencies = 2 * np.pi * np.arange(1, harmonics + 1) / kernel.period
    return Waves(variances[0], jnp.asarray(frequencies), variances[1:])


def fourier_coefficients(kernel: PeriodicCovariance, harmonics: int) -> jax.Array:
    """Return q (harmonics + 1,) with ``k(lag) = sum_j q_j cos(2 pi j lag / D)``, for a stationary kernel.

    ``q_j = (2 - [j = 0]) 2/D int_0^(D/2) k(lag) cos(2 pi j lag / D) dlag`` by Gauss-Legendre quadrature, which
    converges exponentially for kernels that are smooth between lag 0, where they may have a kink, and half a period.
    """
    nodes, weights = roots_legendre(64 + 2 * harmonics)
    nodes, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    order = np.arange(harmonics + 1)
    wave = np.cos(np.pi * order[:, None] * nodes) * weights * np.where(order == 0, 1.0, 2.0)[:, None]
    # Evaluate within one cycle of the kernel, from its start.
    return jnp.asarray(wave) @ kernel(kernel.start + 0.5 * kernel.period * nodes, kernel.start)


def cycle_points(kernel: PeriodicCovariance, points: int) -> jax.Array:
    """Return the midpoints (N,) of N equal parts of the cycle."""
    return kernel.start + kernel.period * (np.arange(points) + 0.5) / points


def spectrum(kernel: PeriodicCovariance, points: int) -> np.ndarray:
    """Return the eigenvalues of a concrete kernel.

    For a stationary kernel these are the eigenvalues of the level and of ``points`` harmonics, in this order; each
    harmonic has two eigenfunctions, but one entry here. For any other kernel they are the eigenvalues of Nystrom's
    method with ``points`` points, in descending order.

    Raises:
        ValueError: an eigenvalue is negative, so that the kernel is not positive definite.
    """
    if kernel.stationary:
        values = np.array(fourier_coefficients(kernel, points))
        _check_definite(kernel, values, "Fourier coefficient {index} is {value:.3g}")
        values[1:] *= 0.5
        return values
    times = cycle_points(kernel, points)
    gram = np.asarray(kernel(times[:, None], times[None, :]))
    values = np.linalg.eigvalsh(0.5 * (gram + gram.T))[::-1] / points
    _check_definite(kernel, values, "its least eigenvalue is {value:.3g}")
    return values


def _check_definite(kernel: PeriodicCovariance, values: Any, template: str) -> None:
    """Raise ValueError for a negative entry of ``values``; ``template`` describes it by {index} and {value}."""
    eigenvalues = checks.concrete(values)
    if eigenvalues is None:
        return
    if not np.isfinite(eigenvalues).all():
        raise ValueError(f"the kernel {kernel.name!r} is not finite on its cycle.")
    index = int(eigenvalues.argmin())
    if eigenvalues[index] < -_NEGATIVE * np.abs(eigenvalues).sum():
        violation = template.format(index=index, value=eigenvalues[index])
        raise ValueError(f"the kernel {kernel.name!r} is not positive definite on a cycle of {float(kernel.period):g}: "
                         f"{violation}, the largest is {eigenvalues.max():.3g}. No force has such a covariance.")

