"""Functions of time whose weighted sum is a periodic force: sines and cosines, or the eigenfunctions of any kernel."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from scipy.special import roots_legendre

from lfm_ppl import checks
from lfm_ppl.forces.eigenspace import leading_eigenvectors
from lfm_ppl.forces.periodic_kernels import Kernel
from lfm_ppl.linalg import matmul, semidefinite_root, solve_lower

_NEGATIVE = 1e-8
"""Share of the largest eigenvalue below zero at which a kernel is not taken for positive definite."""


class Basis(eqx.Module):
    """Weights z and a row h(t) with ``u(t) = h(t) z(t)``; without noise z turns, ``dz/dt = F z``, or stands still.

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
        """Return the prior variances (J,) of z, independent, and the same at all times."""
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
        """Return the functions at times t, in a new last axis (..., J), of mean square one over a cycle."""
        raise NotImplementedError

    def eigenvalues(self) -> jax.Array:
        """Return the variances (J,) of their weights."""
        raise NotImplementedError

    def covariance(self, t: ArrayLike, s: ArrayLike) -> jax.Array:
        """Return ``sum_j eigenvalue_j phi_j(t) phi_j(s)``, elementwise."""
        return (self.eigenvalues() * self.eigenfunctions(t) * self.eigenfunctions(s)).sum(-1)


class Waves(Basis):
    """A level and pairs of cosine and sine: ``sum_k variance_k cos w_k (t - s)`` is their covariance.

    The state (level, c_1, ..., c_K, s_1, ..., s_K) turns, with ``u = level + sum_k c_k``, so that nothing depends on
    time and models with such a force keep their exact transitions.

    Args:
        level: variance of the level, or None for none.
        frequencies: (K,) in radians per unit of time.
        powers: (K,) variances of the pairs.
    """

    level: Any
    frequencies: jax.Array
    powers: jax.Array

    @property
    def count(self) -> int:
        """Number of functions."""
        return self._levels + 2 * self.frequencies.shape[0]

    @property
    def _levels(self) -> int:
        return 0 if self.level is None else 1

    @property
    def stationary(self) -> bool:
        """True."""
        return True

    def variances(self) -> jax.Array:
        """Return the prior variances (J,) of the state."""
        return jnp.concatenate([*self._level(), self.powers, self.powers])

    def feedback(self) -> jax.Array:
        """Return F (J, J)."""
        return self._turning(jnp.zeros_like(self.frequencies), self.frequencies, 0.0)

    def transition(self, dt: ArrayLike) -> jax.Array:
        """Return exp(F dt) (J, J)."""
        angle = self.frequencies * dt
        return self._turning(jnp.cos(angle), jnp.sin(angle), 1.0)

    def row(self, t: ArrayLike) -> jax.Array:
        """Return h (J,), the same at all times."""
        pairs = self.frequencies.shape[0]
        return jnp.asarray(np.concatenate([np.ones(self._levels + pairs), np.zeros(pairs)]))

    def eigenfunctions(self, t: ArrayLike) -> jax.Array:
        """Return one, sqrt(2) cos and sqrt(2) sin at times t (..., J)."""
        angle = jnp.asarray(t, float)[..., None] * self.frequencies
        pairs = np.sqrt(2.0) * jnp.concatenate([jnp.cos(angle), jnp.sin(angle)], -1)
        return jnp.concatenate([jnp.ones((*angle.shape[:-1], self._levels)), pairs], -1)

    def eigenvalues(self) -> jax.Array:
        """Return the variances (J,) of the weights of `eigenfunctions`."""
        return jnp.concatenate([*self._level(), 0.5 * self.powers, 0.5 * self.powers])

    def _level(self) -> list[jax.Array]:
        return [] if self.level is None else [jnp.reshape(self.level, (1,))]

    def _turning(self, cosine: jax.Array, sine: jax.Array, level: float) -> jax.Array:
        c, s = jnp.diag(cosine), jnp.diag(sine)
        pairs = jnp.concatenate([jnp.concatenate([c, s], 1), jnp.concatenate([-s, c], 1)])
        return jax.scipy.linalg.block_diag(level * jnp.eye(self._levels), pairs) if self._levels else pairs


class Eigenfunctions(Basis):
    """The leading eigenfunctions of a kernel on a cycle, by Nystrom's method, extended periodically.

    With N points S in the middle of equal parts of the cycle, G = K(S, S), and its leading eigenvectors V (N, J),

        u(t) = K(t, S) V z,    z ~ N(0, (V' G V)^-1);

    V' G V is the diagonal matrix of the eigenvalues mu of G, so that this is ``sum_j w_j phi_j(t)`` with
    ``phi_j = sqrt(N) / mu_j K(t, S) v_j`` and ``w_j ~ N(0, mu_j / N)``. It is kept as a matrix, since its derivative is
    not diagonal. The state is z made white by its Cholesky factor.

    Attributes:
        kernel: the kernel.
        points: S (N,).
        vectors: V (N, J).
        white: (N, J), V times the inverse of the transposed factor.
        spectrum: (J,), mu / N.
    """

    kernel: Kernel
    points: jax.Array
    vectors: jax.Array
    white: jax.Array
    spectrum: jax.Array

    def __init__(self, kernel: Kernel, count: int, points: int):
        self.kernel = kernel
        self.points = cycle_points(kernel, points)
        gram = kernel(self.points[:, None], self.points[None, :])
        self.vectors = leading_eigenvectors(0.5 * (gram + gram.T), count)
        inner = self.vectors.T @ gram @ self.vectors
        # Eigenvalues at rounding level have no direction of their own; theirs is left out.
        factor = semidefinite_root(0.5 * (inner + inner.T))
        self.white = solve_lower(factor, self.vectors.T).T
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
        return matmul(self.kernel(t, self.points)[None, :], self.white)[0]

    def eigenfunctions(self, t: ArrayLike) -> jax.Array:
        """Return the Nystrom eigenfunctions at times t (..., J)."""
        at_points = self.kernel(jnp.asarray(t, float)[..., None], self.points)
        return at_points @ self.vectors / (self.spectrum * np.sqrt(self.points.shape[0]))

    def eigenvalues(self) -> jax.Array:
        """Return mu / N (J,)."""
        return self.spectrum

    def covariance(self, t: ArrayLike, s: ArrayLike) -> jax.Array:
        """Return the covariance of u(t) and u(s), elementwise."""
        t, s = jnp.asarray(t, float)[..., None], jnp.asarray(s, float)[..., None]
        return ((self.kernel(t, self.points) @ self.white) * (self.kernel(s, self.points) @ self.white)).sum(-1)


def waves(kernel: Kernel, harmonics: int) -> Waves:
    """Return level and harmonics 1, ..., ``harmonics`` of a stationary kernel, with its Fourier coefficients.

    Raises:
        ValueError: a coefficient is negative, so that the kernel is not positive definite.
    """
    coefficients = fourier_coefficients(kernel, harmonics)
    _check_definite(kernel, coefficients, "Fourier coefficient {index} is {value:.3g}")
    # In compiled code a kernel that is not positive definite gives NaN, and so a log likelihood of -inf.
    total = jnp.abs(coefficients).sum()
    kept = jnp.where(coefficients > -_NEGATIVE * total, jnp.maximum(coefficients, 0.0), jnp.nan)
    frequencies = 2 * np.pi * np.arange(1, harmonics + 1) / kernel.period
    return Waves(kept[0], jnp.asarray(frequencies), kept[1:])


def fourier_coefficients(kernel: Kernel, harmonics: int) -> jax.Array:
    """Return q (harmonics + 1,) with ``k(lag) = sum_j q_j cos(2 pi j lag / D)``, for a stationary kernel.

    ``q_j = (2 - [j = 0]) 2/D int_0^(D/2) k(lag) cos(2 pi j lag / D) dlag`` by Gauss-Legendre quadrature, which
    converges exponentially for kernels that are smooth between lag 0, where they may have a kink, and half a period.
    """
    nodes, weights = roots_legendre(64 + 2 * harmonics)
    nodes, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    order = np.arange(harmonics + 1)
    wave = np.cos(np.pi * order[:, None] * nodes) * weights * np.where(order == 0, 1.0, 2.0)[:, None]
    # At times that lie in one cycle of the kernel, whatever its start.
    return jnp.asarray(wave) @ kernel(kernel.start + 0.5 * kernel.period * nodes, kernel.start)


def cycle_points(kernel: Kernel, points: int) -> jax.Array:
    """Return the middles (N,) of N equal parts of the cycle."""
    return kernel.start + kernel.period * (np.arange(points) + 0.5) / points


def spectrum(kernel: Kernel, points: int) -> np.ndarray:
    """Return the eigenvalues of a concrete kernel, falling.

    For a stationary kernel those of the level and of ``points`` harmonics, each of which has two eigenfunctions but
    stands here once, in the order of the harmonics; otherwise those of Nystrom's method with so many points.

    Raises:
        ValueError: one is negative, so that the kernel is not positive definite.
    """
    if kernel.stationary:
        values = np.array(fourier_coefficients(kernel, points))
        _check_definite(kernel, values, "Fourier coefficient {index} is {value:.3g}")
        values[1:] *= 0.5
        return values
    at = cycle_points(kernel, points)
    gram = np.asarray(kernel(at[:, None], at[None, :]))
    values = np.linalg.eigvalsh(0.5 * (gram + gram.T))[::-1] / points
    _check_definite(kernel, values, "its least eigenvalue is {value:.3g}")
    return values


def _check_definite(kernel: Kernel, values: Any, what: str) -> None:
    known = checks.concrete(values)
    if known is None:
        return
    if not np.isfinite(known).all():
        raise ValueError(f"the kernel {kernel.name!r} is not finite on its cycle.")
    index = int(known.argmin())
    if known[index] < -_NEGATIVE * np.abs(known).sum():
        found = what.format(index=index, value=known[index])
        raise ValueError(f"the kernel {kernel.name!r} is not positive definite on a cycle of {float(kernel.period):g}: "
                         f"{found}, the largest is {known.max():.3g}. No force has such a covariance.")

