"""The curvature at a mode, made positive definite without hiding which directions are flat."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Curvature:
    """Eigendecomposition ``H = D^(1/2) V diag(values) V' D^(1/2)`` with a unit diagonal inside.

    Attributes:
        root: diagonal of ``D^(1/2)``, the scale of each coordinate, shape (d,).
        vectors: ``V``, orthonormal columns, shape (d, d).
        values: eigenvalues of the scaled matrix, ascending, shape (d,).
        floor: smallest eigenvalue that counts as curvature; those below are raised to it.
    """

    root: np.ndarray
    vectors: np.ndarray
    values: np.ndarray
    floor: float

    @property
    def flat(self) -> np.ndarray:
        """Which directions have no curvature beyond rounding, shape (d,)."""
        return np.abs(self.values) <= self.floor

    @property
    def definite(self) -> bool:
        """Whether all directions have positive curvature beyond rounding."""
        return bool((self.values > self.floor).all())

    @property
    def factor(self) -> np.ndarray:
        """A square root ``R`` of the inverse, ``R R' = H^-1``, flat and negative ones floored."""
        return self.vectors / np.sqrt(np.maximum(self.values, self.floor)) / self.root[:, None]

    @property
    def start_covariance(self) -> np.ndarray:
        """The inverse (d, d), with variance one of the coordinates along each flat direction, of no known scale."""
        columns = self.vectors / self.root[:, None]
        variances = np.where(self.flat, 1.0 / (columns**2).sum(axis=0), 1.0 / np.maximum(self.values, self.floor))
        return (columns * variances) @ columns.T

    @property
    def log_determinant(self) -> float:
        """Log determinant of the floored matrix."""
        floored = np.maximum(self.values, self.floor)
        return float(np.sum(np.log(floored)) + 2 * np.sum(np.log(self.root)))

    def newton_step(self, gradient: np.ndarray) -> np.ndarray:
        """Return ``-|H|^-1 g``, a descent direction, with nothing along flat directions."""
        along = self.vectors.T @ (gradient / self.root)
        along = np.where(self.flat, 0.0, along / np.where(self.flat, 1.0, np.abs(self.values)))
        return -(self.vectors @ along) / self.root

    def flat_slope(self, gradient: np.ndarray) -> float:
        """Return the steepest slope of the scaled objective along a flat direction."""
        along = self.vectors.T @ (gradient / self.root)
        return float(np.max(np.abs(along[self.flat]), initial=0.0))

    def coordinates(self, directions: np.ndarray) -> np.ndarray:
        """Return the indices of the coordinates that take part in the given directions."""
        share = np.abs(self.vectors[:, directions])
        return np.flatnonzero(np.any(share >= 0.3 * share.max(axis=0, initial=1e-300), axis=1))


def decompose(hessian: np.ndarray, noise: float) -> Curvature:
    """Return the curvature of a symmetric matrix in coordinates that give it a unit diagonal.

    The scaling makes the verdict on flat directions independent of the units of the coordinates.

    Args:
        hessian: finite matrix of shape (d, d).
        noise: error of the scaled entries, which becomes the floor of the eigenvalues. A diagonal
            entry far below that, relative to the largest one, is taken for zero and not scaled up.
    """
    diagonal = np.abs(np.diag(hessian))
    root = np.sqrt(np.where(diagonal > 1e-4 * noise * diagonal.max(initial=0.0), diagonal, 1.0))
    values, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T) / np.outer(root, root))
    return Curvature(root, vectors, values, noise)


def finite_difference_hessian(
    gradient: Callable[[np.ndarray], np.ndarray], point: np.ndarray
) -> np.ndarray:
    """Return the Hessian by central differences of the gradient, shape (d, d)."""
    steps = np.cbrt(np.finfo(float).eps) * np.maximum(1.0, np.abs(point))
    columns = [
        (gradient(point + h * unit) - gradient(point - h * unit)) / (2 * h)
        for h, unit in zip(steps, np.eye(point.size), strict=True)
    ]
    return np.stack(columns, axis=1)
