"""Sigma-point rules: statistical linear regression on a few points.

`SigmaPointRule.linearise` approximates f(v) for v ~ N(m, P):

1. Split the inputs (`InputStructure`) into non-linear ones, in which the points vary, averaged ones, which are linear
   given these, and constant ones, whose Jacobian is known.
2. Factorise the covariance of the non-linear inputs, P_aa = L L', with a floor for inputs without variance.
3. Place the points v_i = m + L xi_i, xi_i the nodes of a unit Gaussian. Averaged inputs take their conditional mean.
4. Average the values: b = sum w_i f(v_i).
5. For the averaged inputs, average the Jacobians at the points (Stein's lemma).
6. For the non-linear inputs, regress the values on the nodes, or average the Jacobians; subtract the part of the
   regression that the averaged inputs explain.
7. The residual covariance is that of the regression errors, plus the variance of the Jacobians of the averaged inputs
   times their conditional covariance.

Each rule is a choice of nodes and weights (`UnitPoints`).

Source: Särkkä (2013), Bayesian Filtering and Smoothing, chapters 5 and 6; García-Fernández, Svensson, Morelande and
Särkkä (2015), IEEE Transactions on Signal Processing 63(20), for statistical linear regression.
"""

from __future__ import annotations

import itertools
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl.linearisation.input_selection import InputStructure
from lfm_ppl.linearisation.rule import AffineMap, Function, Inputs, Rule, partial_jacobian, selection
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import cholesky, congruence, matmul, outer_square

_MOST_POINTS = 10_000
"""Largest number of points of a rule: its residual weights, a square matrix, then take 0.8 GB."""


class UnitPoints(NamedTuple):
    """Nodes and weights of a rule for N(0, I) in ``dim`` dimensions.

    Attributes:
        nodes: (p, dim), the nodes ``xi``.
        weights: (p,), weights ``w`` of expectations and regression, with ``sum w = 1``, ``sum w xi = 0`` and
            ``sum w xi xi' = I``.
        residual_weights: (p, p), symmetric ``W``; the residual covariance is ``E' W E`` for residuals E (p, D). W must
            be positive semi-definite, or the residual covariance may be negative: where weights are negative, diag(w)
            is not, and another quadrature of the residuals is needed (`CentralDifference` shows one).
    """

    nodes: np.ndarray
    weights: np.ndarray
    residual_weights: np.ndarray


class SigmaPointRule(Rule):
    """Base of the sigma-point rules.

    With nodes ``xi_i`` and weights ``w_i`` of the standard Gaussian and ``P = L L'``, at ``v_i = m + L xi_i``,

        b = sum w_i f(v_i),    A = (sum w_i f(v_i) xi_i') L^-1,    Omega = Cov(f) - A P A'.

    The points vary the non-linear inputs only. Inputs that are linear given these take their conditional mean, and
    their slope is the expectation of the Jacobian (Stein's lemma).

    Attributes:
        full_state: whether the points vary the full joint state, as in the original papers, instead of the non-linear
            inputs only.
    """

    full_state: bool = eqx.field(static=True, default=False, kw_only=True)

    is_regression: ClassVar[bool] = True
    """Whether the slope in the non-linear inputs is the regression on the nodes, instead of the average Jacobian.
    Both agree in expectation (Stein's lemma), but the regression divides the sampling error of the nodes' higher
    moments by the standard deviation of the input, which may be arbitrarily small."""

    def points(self, dim: int) -> UnitPoints:
        """Return nodes and weights for ``dim`` >= 1 dimensions.

        Nodes with non-zero third moments, such as the vertices of a simplex, need ``is_regression = False``.
        """
        raise NotImplementedError

    def linearise(self, function: Function, inputs: Inputs, structure: InputStructure,
                  jacobian: jax.Array) -> AffineMap:
        """See `Rule.linearise`."""
        if not structure.nonlinear:
            return _linearise_without_points(function, inputs, structure, jacobian)
        unit = self.points(len(structure.nonlinear))
        nodes, weights = jnp.asarray(unit.nodes), jnp.asarray(unit.weights)
        count, size = len(structure.nonlinear), inputs.mean.shape[0]
        factor = cholesky(inputs.covariance[:count, :count], inputs.min_sd**2)
        chol = factor.chol
        # Conditional mean of the averaged inputs given the node xi: m_r + gain xi with gain = P_ra L^-T.
        gain = factor.solve_lower(inputs.covariance[count:, :count].T).T
        root = jnp.concatenate([chol, gain]) if structure.averaged else chol
        input_root = matmul(selection((*structure.nonlinear, *structure.averaged), size), root)
        sigma_points = inputs.mean + matmul(nodes, input_root.T)
        values, extras = jax.vmap(function)(sigma_points)
        value = (weights[:, None] * values).sum(0)
        if structure.averaged:
            jacobians, mean_jacobian = _average_jacobian(function, sigma_points, weights, structure.averaged)
            jacobian = jacobian + matmul(mean_jacobian, selection(structure.averaged, size).T)
            averaged_regression = matmul(mean_jacobian, gain)
        else:
            jacobians, mean_jacobian, averaged_regression = None, None, jnp.zeros(())
        # The regression of the values on the nodes is (slope L + mean_jacobian gain): both kinds of inputs follow xi.
        if self.is_regression:
            regression = matmul((weights[:, None] * values).T, nodes)
            slope = factor.solve_upper((regression - averaged_regression).T).T
        else:
            _, slope = _average_jacobian(function, sigma_points, weights, structure.nonlinear)
            regression = matmul(slope, chol) + averaged_regression
        jacobian = jacobian + matmul(slope, selection(structure.nonlinear, size).T)
        errors = values - value - matmul(nodes, regression.T)
        residual = matmul(matmul(errors.T, jnp.asarray(unit.residual_weights)), errors)
        if jacobians is not None:
            # Given xi, the averaged inputs vary by their conditional covariance; a varying Jacobian makes this part of
            # the output deviate from the affine map.
            conditional_cov = inputs.covariance[count:, count:] - outer_square(gain)
            deviations = jax.vmap(lambda j: congruence(j - mean_jacobian, conditional_cov))(jacobians)
            residual = residual + (weights[:, None, None] * deviations).sum(0)
        return AffineMap(value, jacobian, residual, self._expectation(function, inputs, weights, unit, extras))

    def _expectation(self, function: Function, inputs: Inputs, weights: jax.Array, unit: UnitPoints, extras):
        # With a negative weight, an average of covariance matrices may be indefinite: use the value at the mean.
        if np.all(unit.weights >= 0):
            return jax.tree.map(lambda e: jnp.tensordot(weights, e, axes=1), extras)
        return function(inputs.mean)[1]


def _average_jacobian(function: Function, sigma_points: jax.Array, weights: jax.Array,
                      indices: tuple[int, ...]) -> tuple[jax.Array, jax.Array]:
    """Return the Jacobians (p, D, len(indices)) at the sigma points, and their weighted average."""
    jacobians = jax.vmap(lambda v: partial_jacobian(function, v, indices))(sigma_points)
    return jacobians, (weights[:, None, None] * jacobians).sum(0)


def _linearise_without_points(function: Function, inputs: Inputs, structure: InputStructure,
                              jacobian: jax.Array) -> AffineMap:
    """Return the exact affine map of a function that is linear at every time."""
    value, extra = function(inputs.mean)
    if structure.averaged:
        varying_jacobian = partial_jacobian(function, inputs.mean, structure.averaged)
        jacobian = jacobian + matmul(varying_jacobian, selection(structure.averaged, inputs.mean.shape[0]).T)
    return AffineMap(value, jacobian, jnp.zeros((value.shape[0],) * 2), extra)


class Unscented(SigmaPointRule):
    """The unscented transform (Julier and Uhlmann).

    ``2 a + 1`` points, exact to degree 3: ``m`` and ``m +- sqrt(a + lambda) L_i``, ``lambda = alpha^2 (a + kappa)
    - a``.

    Args:
        alpha: spread of the points, > 0.
        beta: weight of the centre in the covariance; 2 suits a Gaussian.
        kappa: second spread parameter, > -a for a inputs.
        full_state: vary the full state instead of the non-linear inputs only.

    Example:
        >>> Unscented(1.0, 0.0, 0.0).points(1).weights.tolist()
        [0.0, 0.5, 0.5]

    Source: Särkkä (2007), IEEE Transactions on Automatic Control 52(9); Hartikainen (2013), section 2.4.
    """

    alpha: float = eqx.field(static=True, default=1.0)
    beta: float = eqx.field(static=True, default=0.0)
    kappa: float = eqx.field(static=True, default=2.0)

    def __check_init__(self):
        checks.positive("alpha", self.alpha)
        checks.finite("beta", self.beta)
        checks.finite("kappa", self.kappa)

    def points(self, dim: int) -> UnitPoints:
        """See `SigmaPointRule.points`."""
        scale = self.alpha**2 * (dim + self.kappa)
        if scale <= 0:
            raise ValueError(f"Unscented needs alpha^2 (n + kappa) > 0; with kappa = {self.kappa:g} and {dim} "
                             "non-linear inputs it is not. Raise kappa.")
        nodes = np.concatenate([np.zeros((1, dim)), np.sqrt(scale) * np.eye(dim), -np.sqrt(scale) * np.eye(dim)])
        weights = np.full(2 * dim + 1, 0.5 / scale)
        weights[0] = (scale - dim) / scale
        centre = weights[0] + 1.0 - self.alpha**2 + self.beta
        return UnitPoints(nodes, weights, np.diag(np.concatenate([[centre], weights[1:]])))


class Cubature(SigmaPointRule):
    """The spherical cubature rule of degree 3: ``m +- sqrt(a) L_i``, equal weights.

    Args:
        full_state: vary the full state, as in the paper, instead of the non-linear inputs only.

    Example:
        >>> Cubature().points(2).weights.tolist()
        [0.25, 0.25, 0.25, 0.25]

    Source: Arasaratnam, Haykin and Hurd (2010), IEEE Transactions on Signal Processing 58(10).
    """

    def points(self, dim: int) -> UnitPoints:
        """See `SigmaPointRule.points`."""
        nodes = np.sqrt(dim) * np.concatenate([np.eye(dim), -np.eye(dim)])
        weights = np.full(2 * dim, 0.5 / dim)
        return UnitPoints(nodes, weights, np.diag(weights))


class GaussHermite(SigmaPointRule):
    """Tensor product of Gauss-Hermite rules with ``order`` points per input, exact to degree ``2 order - 1``.

    Args:
        order: points per non-linear input, at least 2; ``a`` inputs take ``order^a`` points.
        full_state: vary the full state instead of the non-linear inputs only.

    Example:
        >>> GaussHermite(3).points(1).nodes.ravel().round(4).tolist()
        [-1.7321, 0.0, 1.7321]

    Source: Ito and Xiong (2000), IEEE Transactions on Automatic Control 45(5).
    """

    order: int = eqx.field(static=True, default=5)

    def __check_init__(self):
        checks.positive_integer("order", self.order)
        if self.order < 2:
            raise ValueError("order must be at least 2: one point determines no slope. lfm.Taylor() uses one point.")

    def points(self, dim: int) -> UnitPoints:
        """See `SigmaPointRule.points`."""
        if self.order**dim > _MOST_POINTS:
            raise ValueError(f"GaussHermite({self.order}) in {dim} dimensions has {self.order}^{dim} points; use "
                             "lfm.Cubature() or lfm.Unscented(), whose number of points is linear in the dimension.")
        nodes_1d, weights_1d = np.polynomial.hermite_e.hermegauss(self.order)
        nodes = np.array(list(itertools.product(nodes_1d, repeat=dim)))
        weights = np.prod(list(itertools.product(weights_1d / weights_1d.sum(), repeat=dim)), axis=1)
        return UnitPoints(nodes, weights, np.diag(weights))


class CentralDifference(SigmaPointRule):
    """Stirling's interpolation to second order: the central difference (divided difference) filter.

    Central differences over ``step`` standard deviations replace derivatives.

    Args:
        step: half-width of the differences in standard deviations, at least 1; sqrt(3) matches the fourth moment of a
            Gaussian.
        full_state: vary the full state instead of the non-linear inputs only.

    Example:
        >>> CentralDifference(2.0).points(1).weights.tolist()
        [0.75, 0.125, 0.125]

    Source: Nørgaard, Poulsen and Ravn (2000), Automatica 36(11); Ito and Xiong (2000).
    """

    step: float = eqx.field(static=True, default=float(np.sqrt(3.0)))

    def __check_init__(self):
        checks.positive("step", self.step)
        if self.step < 1:
            raise ValueError(f"step must be at least 1, got {self.step:g}: below it the covariance of the residual is "
                             "not positive semi-definite.")

    def points(self, dim: int) -> UnitPoints:
        """See `SigmaPointRule.points`."""
        square = self.step**2
        nodes = self.step * np.concatenate([np.zeros((1, dim)), np.eye(dim), -np.eye(dim)])
        weights = np.full(2 * dim + 1, 0.5 / square)
        weights[0] = (square - dim) / square
        # Cov(f) = sum_i (f+ - f-)^2 / 4 h^2 + (h^2 - 1)(f+ + f- - 2 f0)^2 / 4 h^4; the first term is A P A'.
        second_differences = np.zeros((dim, 2 * dim + 1))
        second_differences[:, 0] = -2.0
        second_differences[np.arange(dim), 1 + np.arange(dim)] = 1.0
        second_differences[np.arange(dim), 1 + dim + np.arange(dim)] = 1.0
        scale = (square - 1.0) / (4.0 * square**2)
        return UnitPoints(nodes, weights, scale * second_differences.T @ second_differences)


class MonteCarlo(SigmaPointRule):
    """Fixed random points: the Monte Carlo Kalman filter.

    The draws are antithetic and whitened, so that their mean is zero and their covariance the identity: the rule is
    exact for linear functions. The slope is the average Jacobian over the draws, which is accurate also for a known or
    nearly known state. The seed is fixed, so that the likelihood is a smooth, deterministic function of the parameters.

    Args:
        samples: number of points, even, larger than twice the number of non-linear inputs.
        seed: random seed of the draws.
        full_state: vary the full state instead of the non-linear inputs only.

    Example:
        >>> MonteCarlo(100, seed=1).points(2).nodes.shape
        (100, 2)
    """

    is_regression: ClassVar[bool] = False

    samples: int = eqx.field(static=True, default=1000)
    seed: int = eqx.field(static=True, default=0)

    def __check_init__(self):
        checks.positive_integer("samples", self.samples)
        if self.samples % 2:
            raise ValueError(f"samples must be even (the draws are antithetic), got {self.samples}.")

    def points(self, dim: int) -> UnitPoints:
        """See `SigmaPointRule.points`."""
        if self.samples < 2 * dim + 2:
            raise ValueError(f"MonteCarlo needs more than {2 * dim + 1} samples for {dim} inputs, got {self.samples}.")
        half: np.ndarray = np.random.default_rng(self.seed).standard_normal((self.samples // 2, dim))
        chol = np.linalg.cholesky(half.T @ half / half.shape[0])
        half = np.linalg.solve(chol, half.T).T
        weights = np.full(self.samples, 1.0 / self.samples)
        return UnitPoints(np.concatenate([half, -half]), weights, np.diag(weights))
