"""Laplace's approximation of the posterior of forces on a grid.

1. Write forces and initial state as linear functions of white coordinates v, in which the prior is N(0, I).
2. Maximise psi(v) = log p(y | v) - v'v/2 from v = 0
   - by Newton's method with steps halved until psi grows, or
   - by Gauss-Newton steps with Levenberg and Marquardt's damping ("trust-region").
3. Stop if a step changes psi, or is predicted to change it, by less than the tolerance.
4. At the mode v*, factorise H = I - d^2 log p(y | v)/dv^2. If it is not positive definite, use I + J'J with the
   Jacobian J of the whitened residuals.
5. Return the Gaussian N(v*, H^-1), mapped to the forces, and log p(y) ~ psi(v*) - log|H|/2.

Source: Rasmussen and Williams (2006), section 3.4; Nocedal and Wright (2006), chapters 4 and 10.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike

from lfm_ppl.latent_grid.latent_grid import LatentGrid
from lfm_ppl.model.observation_noise import require_gaussian
from lfm_ppl.utils import checks
from lfm_ppl.utils.programs import shared_jit

METHODS = ("trust-region", "newton")

_HALVINGS = 30
"""Largest number of step lengths of Newton's method, each half of the previous one."""


class LaplaceResult(eqx.Module):
    """Result of `laplace`: a Gaussian approximation of the posterior.

    Attributes:
        mode: (R, G), the forces at the mode, or at the last iterate.
        sd: (R, G), standard deviations of the forces.
        root: (R G, R G + M), a factor of their posterior covariance, with rows in the order of ``mode``.
        start: (M,), the initial state at the mode.
        log_marginal: approximate log marginal likelihood.
        log_joint: psi at the mode, log p(y | v) - v'v/2.
        gradient: largest absolute entry of the gradient of psi at the mode, in white coordinates.
        iterations: number of steps.
        stopped: whether the search met its stopping criterion: a step changed psi, or in a trust region was predicted
            to change it, by less than the tolerance; for Newton's method also if no step length increased psi.
        converged: whether the point is a mode: the gradient is below 1e-3 and H is positive definite. With a large
            tolerance the search may stop before.
    """

    mode: jax.Array
    sd: jax.Array
    root: jax.Array
    start: jax.Array
    log_marginal: jax.Array
    log_joint: jax.Array
    gradient: jax.Array
    iterations: jax.Array
    stopped: jax.Array
    converged: jax.Array

    def sample(self, key: jax.Array, draws: int) -> jax.Array:
        """Return draws (draws, R, G) of the forces."""
        checks.positive_integer("draws", draws)
        white = jax.random.normal(key, (draws, self.root.shape[1]))
        return self.mode + (white @ self.root.T).reshape(draws, *self.mode.shape)


class LaplaceIterate(NamedTuple):
    """Iterate of the search.

    Attributes:
        white: (R G + M,), white coordinates v.
        value: psi at v.
        damping: Levenberg and Marquardt's damping; not used by Newton's method.
        iterations: number of steps so far.
        stopped: whether the search met its stopping criterion.
    """

    white: jax.Array
    value: jax.Array
    damping: jax.Array
    iterations: jax.Array
    stopped: jax.Array


def laplace(latent: LatentGrid, y: ArrayLike, method: str = "trust-region", *, iterations: int = 300,
            tolerance: float = 1e-8) -> LaplaceResult:
    r"""Approximate the posterior of the forces by a Gaussian at its mode.

    Let v be white coordinates, in which the prior is standard normal: u = m + L v for the forces, and likewise for an
    uncertain initial state. The mode v* maximises psi(v) = log p(y | v) - v'v/2, and

        p(v | y) ~ N(v*, H^-1),    H = I - d^2 log p(y | v)/dv^2,    log p(y) ~ psi(v*) - log|H|/2.

    Args:
        latent: the model with its forces on a grid.
        y: (T, D), NaN where missing.
        method: search method. "newton": steps H^-1 grad psi, halved until psi grows, as in the source. If H is not
            positive definite, such a step may have any direction, and the search may end without a mode.
            "trust-region": steps with the Gauss-Newton matrix, which is positive definite, in place of H, damped as by
            Levenberg and Marquardt, so that every accepted step increases psi.
        iterations: largest number of steps.
        tolerance: the search stops if a step changes psi by less than this.

    Returns:
        Mode, covariance and approximate marginal likelihood. If H is not positive definite at the end, the Gauss-Newton
        matrix replaces it, and ``converged`` is False.

    Raises:
        TypeError: ``latent`` is not a LatentGrid.
        ValueError: an unknown method, a number that is not positive, or observations of the wrong shape.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: jnp.exp(u) - x, {"u": lfm.Matern(1.0, 2.0, order=1)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, sd=0.1), lfm.Gaussian(jnp.zeros(1), jnp.zeros(1)))
        >>> grid = lfm.LatentGrid(model, jnp.arange(4.0), points=31)
        >>> result = laplace(grid, jnp.array([[0.0], [0.7], [0.9], [1.0]]))
        >>> bool(result.converged)
        True

    Source: Lawrence, Sanguinetti and Rattray (2006), NIPS 19; Rasmussen and Williams (2006), section 3.4; Nocedal and
    Wright (2006), chapters 4 and 10.
    """
    if not isinstance(latent, LatentGrid):
        raise TypeError(f"latent must be a lfm.LatentGrid, got {type(latent).__name__}.")
    checks.one_of("method", method, METHODS)
    if method == "trust-region":
        require_gaussian(latent.ssm, "method 'trust-region', a least-squares method,", "method='newton'")
    checks.positive_integer("iterations", iterations)
    checks.positive("tolerance", tolerance)
    return run(latent, latent.checked(y), method, iterations, tolerance)


@shared_jit
def run(latent: LatentGrid, y: jax.Array, method: str, iterations: int, tolerance: float) -> LaplaceResult:
    """Compute Laplace's approximation in compiled code; arguments as in `laplace`."""
    count, size = latent.mean.shape

    def unwhiten(white: jax.Array) -> tuple[jax.Array, jax.Array]:
        return latent.force(white[: count * size].reshape(count, size)), latent.start(white[count * size:])

    def objective(white: jax.Array) -> jax.Array:
        u, start = unwhiten(white)
        value = latent.log_likelihood(u, y, start) - 0.5 * (white**2).sum()
        return jnp.where(jnp.isnan(value), -jnp.inf, value)

    def residual(white: jax.Array) -> jax.Array:
        u, start = unwhiten(white)
        return latent.log_likelihood_and_residuals(u, y, start)[1].ravel()

    step = _newton_step(objective) if method == "newton" else _trust_region_step(objective, residual)

    def is_running(iterate: LaplaceIterate) -> jax.Array:
        return ~iterate.stopped & (iterate.iterations < iterations)

    # The coordinates of an initial state without variance have no effect, and stay zero.
    white = jnp.zeros(count * size + latent.ssm.physical_dim)
    first = LaplaceIterate(white, objective(white), jnp.zeros(()), jnp.array(0), jnp.array(False))
    last = jax.lax.while_loop(is_running, lambda iterate: step(iterate, tolerance), first)
    return _gaussian_at(latent, last, objective, residual, unwhiten)


def _newton_step(objective: Any) -> Any:
    """Return the step of Newton's method with halving of its length."""
    gradient, hessian = jax.grad(objective), jax.hessian(objective)

    def step(iterate: LaplaceIterate, tolerance: float) -> LaplaceIterate:
        direction = -jnp.linalg.solve(hessian(iterate.white), gradient(iterate.white))

        def halve(trial: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            length = 0.5 * trial[0]
            return length, objective(iterate.white + length * direction)

        def is_rejected(trial: tuple[jax.Array, jax.Array]) -> jax.Array:
            return ~(trial[1] > iterate.value) & (trial[0] > 0.5**_HALVINGS)

        length, value = jax.lax.while_loop(is_rejected, halve, (jnp.ones(()), objective(iterate.white + direction)))
        has_improved = value > iterate.value
        white = jnp.where(has_improved, iterate.white + length * direction, iterate.white)
        change = jnp.where(has_improved, value - iterate.value, 0.0)
        return LaplaceIterate(white, jnp.where(has_improved, value, iterate.value), iterate.damping,
                              iterate.iterations + 1, change < tolerance)

    return step


def _trust_region_step(objective: Any, residual: Any) -> Any:
    """Return the Gauss-Newton step with Levenberg and Marquardt's damping."""
    gradient_at, jacobian_at = jax.grad(objective), jax.jacrev(residual)

    def step(iterate: LaplaceIterate, tolerance: float) -> LaplaceIterate:
        gradient, jacobian = gradient_at(iterate.white), jacobian_at(iterate.white)
        weight = 1.0 + iterate.damping
        # (weight I + J'J)^-1 by the Woodbury identity: the matrix to solve has the size of the observations.
        inner = weight * jnp.eye(jacobian.shape[0]) + jacobian @ jacobian.T
        direction = (gradient - jacobian.T @ jnp.linalg.solve(inner, jacobian @ gradient)) / weight
        value = objective(iterate.white + direction)
        predicted_change = (gradient @ direction - 0.5 * ((jacobian @ direction) ** 2).sum()
                            - 0.5 * (direction**2).sum())
        change = value - iterate.value
        ratio = change / jnp.maximum(predicted_change, 1e-300)
        is_accepted = (change > 0) & (ratio > 1e-4)
        raised = jnp.maximum(4.0 * iterate.damping, 0.1)
        damping = jnp.where(ratio > 0.75, iterate.damping / 3.0, jnp.where(ratio > 0.25, iterate.damping, raised))
        damping = jnp.where(damping < 1e-3, 0.0, damping)
        # A rejected step is repeated with more damping; at the mode the predicted change vanishes.
        return LaplaceIterate(
            jnp.where(is_accepted, iterate.white + direction, iterate.white),
            jnp.where(is_accepted, value, iterate.value), jnp.where(jnp.isfinite(ratio), damping, raised),
            iterate.iterations + 1, predicted_change < tolerance)

    return step


def _gaussian_at(latent: LatentGrid, iterate: LaplaceIterate, objective: Any, residual: Any,
                 unwhiten: Any) -> LaplaceResult:
    """Return the Gaussian approximation at the last iterate."""
    count, size = latent.mean.shape
    white = iterate.white
    eye = jnp.eye(white.shape[0])
    hessian_chol = jnp.linalg.cholesky(-jax.hessian(objective)(white))
    jacobian = jax.jacrev(residual)(white)
    is_definite = jnp.isfinite(hessian_chol).all()
    chol = jnp.where(is_definite, jnp.where(is_definite, hessian_chol, eye),
                     jnp.linalg.cholesky(eye + jacobian.T @ jacobian))
    # H^-1 = C^-T C^-1: the rows of C^-T that belong to the forces, mapped from white coordinates to forces.
    inverse = jax.scipy.linalg.solve_triangular(chol, eye, lower=True).T[: count * size]
    root = jnp.einsum("rij,rjn->rin", latent.root, inverse.reshape(count, size, -1)).reshape(count * size, -1)
    u, start = unwhiten(white)
    gradient = jnp.abs(jax.grad(objective)(white)).max()
    return LaplaceResult(
        mode=u, sd=jnp.sqrt((root**2).sum(axis=1)).reshape(count, size), root=root, start=start,
        log_marginal=iterate.value - jnp.log(jnp.diagonal(chol)).sum(), log_joint=iterate.value, gradient=gradient,
        iterations=iterate.iterations, stopped=iterate.stopped, converged=is_definite & (gradient < 1e-3))
