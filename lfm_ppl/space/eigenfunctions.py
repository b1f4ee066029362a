"""Eigenfunctions of the Laplacian on an interval or a rectangle."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from scipy.special import roots_legendre

from lfm_ppl.utils import checks


class LaplaceBasis(eqx.Module):
    r"""The leading eigenfunctions of the Laplacian, ``-laplacian phi_j = w_j^2 phi_j``, orthonormal on a domain.

    A field is expanded as ``x(r, t) = sum_j c_j(t) phi_j(r)``. With x the distance from the lower end of an interval of
    length L, and n = 0, 1, ... (1, 2, ... for sines), the functions are

        dirichlet:  sqrt(2 / L) sin(w x),                            w = n pi / L,
        neumann:    sqrt(1 / L), sqrt(2 / L) cos(w x),               w = n pi / L,
        periodic:   sqrt(1 / L), sqrt(2 / L) cos(w x) and sin(w x),  w = 2 n pi / L,

    and their products for a rectangle, with the squared wavenumber ``w_1^2 + w_2^2``, in the order of wavenumbers.

    Args:
        domain: (low, high), or ((low, high), (low, high)) for a rectangle, in units of length.
        modes: number of functions, or a pair for a rectangle; odd for periodic edges: a constant, and pairs.
        boundary: "dirichlet" (the field is zero at the edges), "neumann" (no flux through them) or "periodic".

    Raises:
        ValueError, TypeError: the domain is empty, a number of modes is not positive, or the boundary is unknown.

    Example:
        >>> import numpy as np
        >>> basis = LaplaceBasis((0.0, 2.0), 3)
        >>> basis.functions(np.array([0.5, 1.0])).shape, float(basis.wavenumbers[0].round(4))
        ((2, 3), 1.5708)

    Source: Courant and Hilbert (1953), Methods of Mathematical Physics I, chapter V.
    """

    domain: tuple[tuple[float, float], ...] = eqx.field(static=True)
    modes: tuple[int, ...] = eqx.field(static=True)
    boundary: str = eqx.field(static=True)

    def __init__(self, domain: Any, modes: int | Sequence[int], boundary: str = "dirichlet"):
        edges = np.asarray(domain, float)
        if edges.shape not in ((2,), (1, 2), (2, 2)) or not (np.isfinite(edges).all() and (np.diff(edges) > 0).all()):
            raise ValueError("domain must be (low, high), or two such pairs for a rectangle, with low < high; got "
                             f"{domain!r}.")
        self.domain = tuple((float(low), float(high)) for low, high in np.atleast_2d(edges))
        self.modes = tuple(modes) if isinstance(modes, Sequence) else (modes,)
        if len(self.modes) != len(self.domain):
            raise ValueError(f"modes must hold a number for each dimension, {len(self.domain)}; got {modes!r}.")
        checks.one_of("boundary", boundary, ("dirichlet", "neumann", "periodic"))
        for count in self.modes:
            checks.positive_integer("modes", count)
            if boundary == "periodic" and count % 2 == 0:
                raise ValueError(f"modes must be odd for periodic edges, a constant and pairs; got {count}.")
        self.boundary = boundary

    @property
    def wavenumbers(self) -> np.ndarray:
        """The wavenumbers w_j (J,), in 1/length."""
        return np.sqrt((_orders_and_wavenumbers(self)[1]**2).sum(1))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients of a field among the states of a model: "mode 0", "mode 1", ..."""
        return tuple(f"mode {index}" for index in range(np.prod(self.modes)))

    def functions(self, points: ArrayLike) -> Any:
        """Return phi_j (P, J) at places (P,) or (P, d).

        Raises:
            ValueError: a place lies outside of the domain; inside of compiled code its functions are NaN.
        """
        positions, (low, high) = position_array(points, len(self.domain)), np.transpose(self.domain)
        xp = jnp if checks.traced(positions) else np
        is_outside = (xp.abs(positions - 0.5 * (low + high)) / (high - low)).max(1) > 0.5000001
        if xp is np and is_outside.any():
            index = is_outside.argmax()
            raise ValueError(f"points[{index}] = {positions[index].tolist()} lies outside of the domain {self.domain}.")
        orders, wavenumbers = _orders_and_wavenumbers(self)
        angles = wavenumbers * (positions - low)[:, None, :]
        is_sine = (orders > 0) & (orders % 2 == 0 if self.boundary == "periodic" else self.boundary == "dirichlet")
        amplitudes = np.sqrt(np.where(orders == 0, 1.0, 2.0) / (high - low))
        values = (amplitudes * xp.where(is_sine, xp.sin(angles), xp.cos(angles))).prod(-1)
        return xp.where(is_outside[:, None], np.nan, values)

    def weights(self, points: ArrayLike) -> tuple[Any, Any]:
        """Return the weights (P, J) of the coefficients in the field at places, and the variance beyond them, zero."""
        return self.functions(points), np.zeros(np.shape(points)[0])

    def coefficients(self, function: Callable[[Any], ArrayLike]) -> jax.Array:
        """Return the coefficients (J,) of a field, ``int phi_j(r) function(r) dr`` by Gauss-Legendre quadrature.

        Args:
            function: maps places (P,), or (P, 2) in a rectangle, to values (P,); smooth.

        Raises:
            ValueError: the function returns values of another shape.
        """
        nodes, weights = zip(*(roots_legendre(4 * count + 100) for count in self.modes), strict=True)
        low, high = np.transpose(self.domain)
        points = np.stack([grid.ravel() for grid in np.meshgrid(*nodes, indexing="ij")], axis=1)
        points = low + 0.5 * (high - low) * (points + 1.0)
        weight = functools.reduce(np.multiply.outer, weights).ravel() * np.prod(0.5 * (high - low))
        values = jnp.asarray(function(points[:, 0] if len(self.domain) == 1 else points))
        if values.shape != weight.shape:
            raise ValueError(f"function must return a value for each place, shape {weight.shape}; got {values.shape}.")
        return jnp.asarray(self.functions(points).T * weight) @ values


def position_array(points: ArrayLike, dimension: int | None = None) -> Any:
    """Return places (P,) or (P, d) as an array (P, d); ``dimension`` None: any number of dimensions."""
    positions: Any = points if checks.traced(points) else np.asarray(points, float)
    positions = positions[:, None] if positions.ndim == 1 else positions
    if positions.ndim != 2 or positions.shape[0] == 0 or positions.shape[1] != (dimension or positions.shape[1]):
        raise ValueError(f"points must be an array of places (P, {dimension or 'd'}), got shape {np.shape(points)}.")
    checks.finite("points", positions)
    return positions


@functools.lru_cache(maxsize=64)
def _orders_and_wavenumbers(basis: LaplaceBasis) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of the functions (J, d) in each dimension, sines and cosines counted, and wavenumbers."""
    first = int(basis.boundary == "dirichlet")
    grids = np.meshgrid(*(np.arange(first, first + count) for count in basis.modes), indexing="ij")
    orders = np.stack([grid.ravel() for grid in grids], axis=1)
    waves = 2 * np.ceil(orders / 2) if basis.boundary == "periodic" else orders
    wavenumbers = np.pi * waves / np.diff(basis.domain)[:, 0]
    ranks = np.argsort((wavenumbers**2).sum(1), kind="stable")
    return orders[ranks], wavenumbers[ranks]
