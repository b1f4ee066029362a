r"""Gaussian processes in space and time, as independent copies v_j of a temporal force.

The covariance of a field u(r, t) is the product of an isotropic kernel in space, k(|r - r'|), and that of the force.

1. `SpectralField` expands it in eigenfunctions of the Laplacian, with the spectral density of the kernel.
2. `SeparableField` factorises the covariance of N points by Cholesky's method with complete pivoting, which may stop at
   a rank below N.
3. It predicts at other places given the pivots P: the weights are ``K(r, P) L_P^-T``, and the variance that they do not
   explain is added.

Sources: Solin and Särkkä (2020), Statistics and Computing 30; Hartikainen (2013), doctoral thesis, section 3.3;
Harbrecht, Peters and Schneider (2012), Applied Numerical Mathematics 62.
"""

from __future__ import annotations

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from lfm_ppl.forces.matern import Matern
from lfm_ppl.forces.sde import ApproximationWarning, Force
from lfm_ppl.forces.squared_exponential import SquaredExponential
from lfm_ppl.space.eigenfunctions import LaplaceBasis, position_array
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import safe_sqrt, solve_lower
from lfm_ppl.utils.semidefinite import pivoted_cholesky

_LARGEST_LOSS = 0.05
"""Share of the variance left out above which there is a warning."""

_MANY_MODES = {1: 10_001, 2: 401}
"""Number of functions in each dimension that stand for all functions."""

Kernel = Matern | SquaredExponential


class SpaceTimeField(eqx.Module):
    """A sum of ``rank`` independent copies of a temporal force, with weights that depend on the place."""

    spatial_kernel: Kernel
    temporal_force: Force
    rank: int = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def _set(self, spatial_kernel: Kernel, temporal_force: Force, rank: int, name: str) -> None:
        """Set the fields after checks of their types and means."""
        if not isinstance(spatial_kernel, Kernel):
            raise TypeError("spatial_kernel must be an lfm.Matern or an lfm.SquaredExponential, got "
                            f"{type(spatial_kernel).__name__}.")
        if not isinstance(temporal_force, Force):
            raise TypeError(f"temporal_force must be a force such as lfm.Matern, got {type(temporal_force).__name__}.")
        for argument, process in (("spatial_kernel", spatial_kernel), ("temporal_force", temporal_force)):
            if callable(process.mean) or (checks.concrete(process.mean) or 0.0) != 0.0:
                raise ValueError(f"{argument} must have mean zero; add a mean to the dynamics or the observation.")
        self.spatial_kernel, self.temporal_force, self.rank, self.name = spatial_kernel, temporal_force, rank, name

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the forces: "NAME 0", "NAME 1", ..."""
        return tuple(f"{self.name} {index}" for index in range(self.rank))

    @property
    def forces(self) -> dict[str, Force]:
        """The forces v_j by name."""
        return dict.fromkeys(self.names, self.temporal_force)

    def _warn_of(self, lost_variance: jax.Array, remedy: str) -> None:
        share = checks.concrete(lost_variance)
        if share is not None and share > _LARGEST_LOSS:
            checks.warn(f"the {self.rank} forces of the field {self.name!r} leave out {100 * float(share):.0f}% of its "
                        f"variance. Use {remedy}.", ApproximationWarning)


class SpectralField(SpaceTimeField):
    r"""A space-time Gaussian process in a basis: ``u(r, t) = sum_j sqrt(S(w_j)) phi_j(r) v_j(t)``.

    The v_j are independent copies of the temporal force, and S is the spectral density of the spatial kernel. The
    covariance approaches ``k(|r - r'|) cov(v(t), v(t'))`` with the number of modes, away from the edges; there u obeys
    the boundary condition of the basis. It is the source of `heat` and `wave`.

    Args:
        basis: the eigenfunctions.
        spatial_kernel: `Matern` or `SquaredExponential`, whose scale, lengthscale (in units of length) and order are
            read; a squared exponential kernel is exact here. Parameters may be traced.
        temporal_force: any force of mean zero. The scales multiply: give one of the two the scale 1.
        name: name of the forces, before their numbers.

    Warns:
        ApproximationWarning: outside of compiled code, where `lost_variance` is above 0.05.

    Raises:
        TypeError: an argument is of another type.
        ValueError: kernel or force has a mean.

    Example:
        >>> import lfm_ppl as lfm
        >>> basis = lfm.LaplaceBasis((0.0, 1.0), 20)
        >>> source = SpectralField(basis, lfm.Matern(2.0, 0.3), lfm.Matern(1.0, 5.0))
        >>> source.names[:2], bool(source.lost_variance < 0.01)
        (('source 0', 'source 1'), True)

    Source: Solin and Särkkä (2020), Statistics and Computing 30, equation 20.
    """

    basis: LaplaceBasis

    def __init__(self, basis: LaplaceBasis, spatial_kernel: Kernel, temporal_force: Force, name: str = "source"):
        if not isinstance(basis, LaplaceBasis):
            raise TypeError(f"basis must be an lfm.LaplaceBasis, got {type(basis).__name__}.")
        self._set(spatial_kernel, temporal_force, len(basis.names), name)
        self.basis = basis
        if not checks.traced(self):
            self._warn_of(self.lost_variance, "more modes")

    @property
    def domain(self) -> tuple[tuple[float, float], ...]:
        """The domain of the basis."""
        return self.basis.domain

    @property
    def amplitudes(self) -> jax.Array:
        """The factors sqrt(S(w_j)) (J,)."""
        # The square root of a density that underflows would have an infinite derivative.
        return jnp.exp(0.5 * _log_density(self.spatial_kernel, self.basis))

    @property
    def lost_variance(self) -> jax.Array:
        """Share of the variance of the field in functions beyond the modes, on average over the domain."""
        basis = self.basis
        counts = tuple(max(_MANY_MODES[len(basis.modes)], 2 * count + 1) for count in basis.modes)
        density = jnp.exp(_log_density(self.spatial_kernel, LaplaceBasis(basis.domain, counts, basis.boundary)))
        return 1.0 - (self.amplitudes**2).sum() / density.sum()

    def weights(self, points: ArrayLike) -> tuple[jax.Array, Any]:
        """Return the weights (P, J) of the forces in the field at places, and the variance beyond them, zero."""
        functions, variance = self.basis.weights(points)
        return functions * self.amplitudes, variance


class SeparableField(SpaceTimeField):
    r"""A space-time Gaussian process at N points: ``u(r_i, t) = sum_j L_ij v_j(t)`` with ``L L' = K``.

    Its covariance is ``k(|r_i - r_k|) cov(v(t), v(t'))``, exactly at full rank. Below it, L are the leading columns of
    a Cholesky factor whose pivots are the points with the largest remaining variance.

    Args:
        points: (N,) or (N, d), the places of data.
        spatial_kernel: as of `SpectralField`.
        temporal_force: a stationary force of mean zero. The scales multiply: give one of the two the scale 1.
        rank: number of forces; None: N.
        name: name of the forces, before their numbers.

    Warns:
        ApproximationWarning: outside of compiled code, where `lost_variance` is above 0.05.

    Raises:
        TypeError: an argument is of another type.
        ValueError: points have a wrong shape or are not finite, the rank is not between 1 and N, or the force is not
            stationary or has a mean.

    Example:
        >>> import numpy as np
        >>> import lfm_ppl as lfm
        >>> field = SeparableField(np.linspace(0.0, 1.0, 30), lfm.SquaredExponential(1.0, 0.5), lfm.Matern(1.0, 2.0), 6)
        >>> len(field.forces), field(np.zeros(6)).shape, bool(field.lost_variance < 1e-4)
        (6, (30,), True)

    Source: Hartikainen (2013), doctoral thesis, section 3.3; Harbrecht, Peters and Schneider (2012).
    """

    points: np.ndarray
    root: jax.Array
    pivots: jax.Array

    def __init__(self, points: ArrayLike, spatial_kernel: Kernel, temporal_force: Force, rank: int | None = None,
                 name: str = "field"):
        self.points = position_array(points)
        rank = len(self.points) if rank is None else rank
        checks.positive_integer("rank", rank)
        if rank > len(self.points):
            raise ValueError(f"rank must be at most the number of points, {len(self.points)}; got {rank}.")
        self._set(spatial_kernel, temporal_force, rank, name)
        if not temporal_force.stationary:
            raise ValueError(f"temporal_force must be stationary, got {type(temporal_force).__name__}.")
        self.root, self.pivots = pivoted_cholesky(self._covariance(self.points, self.points), rank)
        self._warn_of(self.lost_variance, "a higher rank")

    @property
    def domain(self) -> tuple[tuple[float, float], ...]:
        """The box about the points."""
        return tuple(zip(self.points.min(0).tolist(), self.points.max(0).tolist(), strict=True))

    @property
    def lost_variance(self) -> jax.Array:
        """Share of the variance at the points that the columns of L leave out."""
        return 1.0 - (self.root**2).sum() / (len(self.points) * self.spatial_kernel.scale**2)

    def __call__(self, u: jax.Array) -> jax.Array:
        """Return the field (N,) at the points, from the values u (rank,) of its forces."""
        if jnp.shape(u) != (self.rank,):
            raise ValueError(f"u must hold the values of the {self.rank} forces, got shape {jnp.shape(u)}.")
        return self.root @ u

    def weights(self, points: ArrayLike) -> tuple[jax.Array, jax.Array]:
        """Return the weights (P, rank) of the forces in the field at places (P,) or (P, d), and its variance beyond.

        Given the forces, the field at a place is normal, with the mean ``weights @ v`` and this variance (P,).
        """
        positions = position_array(points, self.points.shape[1])
        cross = self._covariance(jnp.asarray(self.points)[self.pivots], positions)
        weights = solve_lower(self.root[self.pivots], cross).T
        residual = jnp.maximum(self.spatial_kernel.scale**2 - (weights**2).sum(1), 0.0)
        return weights, residual * self.temporal_force.covariance(0.0)

    def _covariance(self, first: Any, second: Any) -> jax.Array:
        return self.spatial_kernel.covariance(safe_sqrt(((first[:, None, :] - second[None, :, :])**2).sum(-1)))


def _log_density(kernel: Kernel, basis: LaplaceBasis) -> jax.Array:
    r"""Return log S(w_j) (J,) of an isotropic kernel in d dimensions.

        squared exponential:  S = scale^2 (2 pi)^(d/2) l^d exp(-l^2 w^2 / 2),
        Matern:               S = scale^2 (4 pi)^(d/2) G(nu + d/2) / G(nu) a^nu (a + w^2)^-(nu + d/2),  a = 2 nu / l^2.

    Source: Rasmussen and Williams (2006), Gaussian Processes for Machine Learning, equations 4.11 and 4.15.
    """
    half, square, scale = 0.5 * len(basis.domain), basis.wavenumbers**2, 2.0 * jnp.log(kernel.scale)
    if isinstance(kernel, SquaredExponential):
        return scale + half * jnp.log(2 * np.pi * kernel.lengthscale**2) - 0.5 * kernel.lengthscale**2 * square
    nu, rate = kernel.order + 0.5, 2.0 * (kernel.order + 0.5) / kernel.lengthscale**2
    constant = half * math.log(4.0 * math.pi) + math.lgamma(nu + half) - math.lgamma(nu)
    return scale + constant + nu * jnp.log(rate) - (nu + half) * jnp.log(rate + square)
