"""Laplace's approximation of the posterior of forces on a grid."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from lfm_ppl import checks
from lfm_ppl.latent_grid.latent_grid import LatentGrid
from lfm_ppl.model.observation_noise import require_gaussian

METHODS = ("trust-region", "newton")

_HALVINGS = 30
"""Step lengths that Newton's method tries, each half of the one before."""


class LaplaceResult(eqx.Module):
    """The Gaussian that `laplace` found.

    Attributes:
        mode: (R, G), the forces at the mode, or where the search ended.
        sd: (R, G), standard deviations of the forces.
        root: (R G, R G + M), a factor of their posterior covariance, with rows in the order of ``mode``.
        start: (M,), the initial state at the mode.
        log_marginal: approximate log marginal likelihood.
        log_joint: psi at the mode, log p(y | v) - v'v/2.
        gradient: largest entry of the gradient there, in coordinates with a standard normal prior.
        iterations: steps taken.
        stopped: whether the search ended by itself: a step changed psi, or in a trust region promised to change it, by
            less than the tolerance; with Newton's method also where no step length was any better.
        converged: whether the point is a mode: the gradient is below 1e-3 and the curvature that of a maximum. A
            generous tolerance may stop the search before that.
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


class _Search(NamedTuple):
    white: jax.Array
    value: jax.Array
    damping: jax.Array
    taken: jax.Array
    stopped: jax.Array


def laplace(latent: LatentGrid, y: Any, method: str = "trust-region", *, iterations: int = 300,
            tolerance: float = 1e-8) -> LaplaceResult:
    r"""Approximate the posterior of the forces by a Gaussian at its mode.

    With v the forces in coordinates in which their prior is standard normal, u = m + L v (and so for the initial state,
    where it is uncertain), the mode maximises psi(v) = log p(y | v) - v'v/2, and

        p(v | y) ~ N(v*, H^-1),    H = I - d^2 log p(y | v)/dv^2,    log p(y) ~ psi(v*) - log|H|/2.

    Args:
        latent: forces on a grid.
        y: (T, D), NaN where missing.
        method: how the mode is sought. "newton": full steps H^-1 grad psi, halved until psi grows, as in the source;
            where H is not that of a maximum such a step may go anywhere, and the search end at no mode.
            "trust-region": the Gauss-Newton matrix in place of H, which is positive definite, damped as Levenberg and
            Marquardt do, so that every step goes up.
        iterations: most steps.
        tolerance: the search stops where a step changes psi by less than this.

    Returns:
        Mode, covariance and approximate marginal likelihood. Where H is not positive definite at the end the
        Gauss-Newton matrix stands for it, and ``converged`` is False.

    Raises:
        ValueError: an unknown method, numbers that are not positive, or observations that do not fit.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: jnp.exp(u) - x, {"u": lfm.Matern(1.0, 2.0, order=1)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.01])), lfm.Gaussian(jnp.zeros(1), jnp.zeros(1)))
        >>> found = laplace(lfm.LatentGrid(model, jnp.arange(4.0), points=31), jnp.array([[0.0], [0.7], [0.9], [1.0]]))
        >>> bool(found.converged)
        True

    Source: Lawrence, Sanguinetti and Rattray (2006), NIPS 19; Rasmussen and Williams (2006), section 3.4; Nocedal and
    Wright (2006), chapters 4 and 10.
    """
    if not isinstance(latent, LatentGrid):
        raise TypeError(f"latent must be a lfm.LatentGrid, got {type(latent).__name__}.")
    checks.one_of("method", method, METHODS)
    if method == "trust-region":
        require_gaussian(latent.ssm, "method 'trust-region', whose steps are those of least squares,",
                         "method='newton'")
    checks.positive_integer("iterations", iterations)
    checks.positive("tolerance", tolerance)
    return run(latent, latent.checked(y), method, iterations, tolerance)


@eqx.filter_jit
def run(latent: LatentGrid, y: jax.Array, method: str, iterations: int, tolerance: float) -> LaplaceResult:
    """Search and approximate, in compiled code; arguments as in `laplace`."""
    count, size = latent.mean.shape

    def places(white: jax.Array) -> tuple[jax.Array, jax.Array]:
        return latent.force(white[: count * size].reshape(count, size)), latent.start(white[count * size:])

    def objective(white: jax.Array) -> jax.Array:
        u, start = places(white)
        value = latent.log_likelihood(u, y, start) - 0.5 * (white**2).sum()
        return jnp.where(jnp.isnan(value), -jnp.inf, value)

    def residual(white: jax.Array) -> jax.Array:
        u, start = places(white)
        return latent.scored(u, y, start)[1].ravel()

    step = _newton(objective) if method == "newton" else _trust_region(objective, residual)

    def going(search: _Search) -> jax.Array:
        return ~search.stopped & (search.taken < iterations)

    # A known initial state leaves its coordinates idle.
    white = jnp.zeros(count * size + latent.ssm.physical_dim)
    first = _Search(white, objective(white), jnp.zeros(()), jnp.array(0), jnp.array(False))
    search = jax.lax.while_loop(going, lambda now: step(now, tolerance), first)
    return _gaussian(latent, search, objective, residual, places)


def _newton(objective: Any) -> Any:
    gradient, curvature = jax.grad(objective), jax.hessian(objective)

    def step(now: _Search, tolerance: float) -> _Search:
        direction = -jnp.linalg.solve(curvature(now.white), gradient(now.white))

        def shorter(trial: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            length = 0.5 * trial[0]
            return length, objective(now.white + length * direction)

        def worse(trial: tuple[jax.Array, jax.Array]) -> jax.Array:
            return ~(trial[1] > now.value) & (trial[0] > 0.5**_HALVINGS)

        length, value = jax.lax.while_loop(worse, shorter, (jnp.ones(()), objective(now.white + direction)))
        better = value > now.value
        white = jnp.where(better, now.white + length * direction, now.white)
        change = jnp.where(better, value - now.value, 0.0)
        return _Search(white, jnp.where(better, value, now.value), now.damping, now.taken + 1, change < tolerance)

    return step


def _trust_region(objective: Any, residual: Any) -> Any:
    gradient, jacobian = jax.grad(objective), jax.jacrev(residual)

    def step(now: _Search, tolerance: float) -> _Search:
        up, rows = gradient(now.white), jacobian(now.white)
        weight = 1.0 + now.damping
        # (weight I + J'J)^-1, by way of a matrix as large as there are observations.
        inner = weight * jnp.eye(rows.shape[0]) + rows @ rows.T
        direction = (up - rows.T @ jnp.linalg.solve(inner, rows @ up)) / weight
        value = objective(now.white + direction)
        promised = up @ direction - 0.5 * ((rows @ direction) ** 2).sum() - 0.5 * (direction**2).sum()
        change = value - now.value
        ratio = change / jnp.maximum(promised, 1e-300)
        better = (change > 0) & (ratio > 1e-4)
        tighter = jnp.maximum(4.0 * now.damping, 0.1)
        damping = jnp.where(ratio > 0.75, now.damping / 3.0, jnp.where(ratio > 0.25, now.damping, tighter))
        damping = jnp.where(damping < 1e-3, 0.0, damping)
        # At the mode nothing is promised any more; elsewhere a refused step is tried again, shorter.
        stopped = promised < tolerance
        return _Search(jnp.where(better, now.white + direction, now.white), jnp.where(better, value, now.value),
                       jnp.where(jnp.isfinite(ratio), damping, tighter), now.taken + 1, stopped)

    return step


def _gaussian(latent: LatentGrid, search: _Search, objective: Any, residual: Any, places: Any) -> LaplaceResult:
    count, size = latent.mean.shape
    white = search.white
    eye = jnp.eye(white.shape[0])
    full = jnp.linalg.cholesky(-jax.hessian(objective)(white))
    rows = jax.jacrev(residual)(white)
    definite = jnp.isfinite(full).all()
    chol = jnp.where(definite, jnp.where(definite, full, eye), jnp.linalg.cholesky(eye + rows.T @ rows))
    # The factor of the inverse, first in white coordinates, then of the forces.
    inverse = jax.scipy.linalg.solve_triangular(chol, eye, lower=True).T[: count * size]
    root = jnp.einsum("rij,rjn->rin", latent.root, inverse.reshape(count, size, -1)).reshape(count * size, -1)
    u, start = places(white)
    gradient = jnp.abs(jax.grad(objective)(white)).max()
    return LaplaceResult(
        mode=u, sd=jnp.sqrt((root**2).sum(axis=1)).reshape(count, size), root=root, start=start,
        log_marginal=search.value - jnp.log(jnp.diagonal(chol)).sum(), log_joint=search.value, gradient=gradient,
        iterations=search.taken, stopped=search.stopped, converged=definite & (gradient < 1e-3))
