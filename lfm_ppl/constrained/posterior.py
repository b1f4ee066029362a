"""The posterior under constraints: expectation propagation with truncated normal sites."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri
from jax.scipy.stats import norm

from lfm_ppl import checks
from lfm_ppl.constrained.augmented import Rows, rows, stacked_model, with_rows
from lfm_ppl.constrained.constraints import Constraints, build_constraints
from lfm_ppl.constrained.full_information import check_settings
from lfm_ppl.filtering.filter import as_rule, at_rows, check_observations, warn_single_precision
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.quadrature import Marginal, Tilted
from lfm_ppl.filtering.rts import backward
from lfm_ppl.filtering.sites import SiteSettings, evidence
from lfm_ppl.filtering.time_grid import TimeGrid, build_time_grid
from lfm_ppl.filtering.update import Sites
from lfm_ppl.linalg import congruence, diagonal, matmul, safe_sqrt
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.state_space import StateSpaceModel

_BELOW, _TERMS = 5.0, 60
"""Standard deviations below the bound from which the mean is a continued fraction, and its terms."""
_FAR = 100.0
"""The same, from which the variance is an asymptotic series."""
_UNDERFLOW = -600.0
"""Logarithm of a probability from which its exponential is not used."""


class BoundedTerms(eqx.Module):
    """Factors N(y; f, R) of the data, and 1(f >= 0) of the constraints.

    Attributes:
        y: (K, D), NaN where missing.
        variance: (K, D), R.
        held: (K, C), whether the constraint holds at the row.
    """

    y: jax.Array
    variance: jax.Array
    held: jax.Array

    @property
    def present(self) -> jax.Array:
        """(K, D + C), whether an entry has a factor."""
        return jnp.concatenate([jnp.isfinite(self.y), self.held], axis=1)

    def tilted(self, cavity: Marginal, near: Marginal, power: float) -> Tilted:
        """Return the tilted moments in closed form; the power of an indicator is itself, that of the data must be 1."""
        data = self.y.shape[1]
        measured = _measured(Marginal(*(a[:, :data] for a in cavity)), self.y, self.variance)
        truncated = truncated_moments(Marginal(*(a[:, data:] for a in cavity)))
        return Tilted(*(jnp.concatenate(pair, axis=1) for pair in zip(measured, truncated, strict=True)))


def _measured(cavity: Marginal, y: jax.Array, variance: jax.Array) -> Tilted:
    y = jnp.where(jnp.isfinite(y), y, 0.0)
    total = cavity.variance + variance
    gain = cavity.variance / total
    return Tilted(norm.logpdf(y, cavity.mean, jnp.sqrt(total)), cavity.mean + gain * (y - cavity.mean), gain * variance)


def truncated_moments(cavity: Marginal) -> Tilted:
    """Return log P(f >= 0), and mean and variance of f given f >= 0, for f ~ N(cavity).

    With a = m / sd and h = phi(a) / Phi(a) these are log Phi(a), m + sd h and sd^2 (1 - h (h + a)).
    """
    sd = jnp.sqrt(cavity.variance)
    a = cavity.mean / sd
    log_share = norm.logcdf(a)
    near = jnp.maximum(a, -_BELOW)
    above = near + jnp.exp(norm.logpdf(near) - norm.logcdf(near))
    # Far below the bound a and h cancel; h = z + 1 / (z + 2 / (z + 3 / ...)) with z = -a.
    z = jnp.maximum(-a, _BELOW)
    below = jnp.zeros_like(z)
    for term in range(_TERMS, 0, -1):
        below = term / (z + below)
    mean = jnp.where(a < -_BELOW, below, above)
    square = 1.0 / jnp.maximum(-a, _FAR) ** 2
    share = jnp.where(a < -_FAR, square * (1.0 - square * (6.0 - 50.0 * square)), 1.0 - (mean - a) * mean)
    return Tilted(log_share, sd * mean, cavity.variance * share)


class ConstrainedPosterior(eqx.Module):
    """The outcome of `constrained_posterior`.

    Attributes:
        times: (K,), at which the constraints hold.
        state_mean, state_sd: (K, M), of the physical state.
        force_mean, force_sd: (K, R), of the forces.
        sweeps: passes of expectation propagation.
        converged: whether the sites have converged.
    """

    times: jax.Array
    state_mean: jax.Array
    state_sd: jax.Array
    force_mean: jax.Array
    force_sd: jax.Array
    sweeps: jax.Array
    converged: jax.Array
    _cavity: Marginal
    _constraints: Constraints
    state_names: tuple[str, ...] = eqx.field(static=True)
    force_names: tuple[str, ...] = eqx.field(static=True)

    def interval(self, name: str, level: float = 0.95) -> tuple[jax.Array, jax.Array]:
        """Return the ends (K,), (K,) of the central interval of a state or force.

        A bounded quantity has a truncated normal distribution, so that its interval respects the bound; of one with two
        bounds the other one enters as a Gaussian, and the ends are kept within it.

        Raises:
            ValueError: an unknown name, or a level outside of (0, 1).
        """
        names = (*self.state_names, *self.force_names)
        checks.one_of("name", name, names)
        if not 0 < level < 1:
            raise ValueError(f"level must lie between 0 and 1, got {level!r}.")
        index, given = names.index(name), self._constraints
        tails = 0.5 * (1.0 - level), 0.5 * (1.0 + level)
        if index in given.lower_indices:
            i = given.lower_indices.index(index)
            low, high = (given.lower[i] + self._quantile(i, tail) for tail in tails)
        elif index in given.upper_indices:
            i = given.upper_indices.index(index)
            low, high = (given.upper[i] - self._quantile(len(given.lower_indices) + i, 1.0 - tail) for tail in tails)
        else:
            mean, sd = (jnp.concatenate(pair, axis=1)[:, index] for pair in (
                (self.state_mean, self.force_mean), (self.state_sd, self.force_sd)))
            low, high = (mean + sd * norm.ppf(tail) for tail in tails)
        if index in given.upper_indices:
            bound = given.upper[given.upper_indices.index(index)]
            low, high = jnp.minimum(low, bound), jnp.minimum(high, bound)
        return low, high

    def _quantile(self, entry: int, share: float) -> jax.Array:
        """Return a quantile (K,) of a constraint: Phi((m - q) / sd) = (1 - share) Phi(m / sd).

        Where the mean lies so far below the bound that Phi underflows, the distribution is an exponential one.
        """
        mean, sd = self._cavity.mean[:, entry], jnp.sqrt(self._cavity.variance[:, entry])
        tail = jnp.log1p(-share) + norm.logcdf(mean / sd)
        ordinary = tail > _UNDERFLOW
        value = mean - sd * ndtri(jnp.exp(jnp.where(ordinary, tail, -1.0)))
        exponential = -jnp.log1p(-share) * sd**2 / jnp.where(mean < 0, -mean, 1.0)
        return jnp.maximum(jnp.where(ordinary, value, exponential), 0.0)


def constrained_posterior(model: LatentForceModel, times: Any, y: Any, lower: Mapping[str, Any] | None = None,
                          upper: Mapping[str, Any] | None = None,
                          constraints: Callable[..., Any] | Sequence[Callable[..., Any]] = (), grid: Any = None,
                          rule: Rule | None = None, steps: int = 10, sweeps: int = 200) -> ConstrainedPosterior:
    r"""Approximate the posterior of state and forces under constraints by expectation propagation.

    On every row of the grid the factor 1(c >= 0) is a site, a Gaussian that gives the marginal of c the mean and the
    variance of the truncated normal N(c; cavity) 1(c >= 0).

    Args:
        model: the latent force model, with independent observation noise of the outputs.
        times: (T,), non-decreasing.
        y: (T, D), NaN where missing.
        lower: name of a state, force or output -> its lower bound.
        upper: the same for upper bounds.
        constraints: functions c(x, u, t), feasible where >= 0.
        grid: (K,) times at which the constraints hold; as in `lfm_ppl.full_information`.
        rule: linearisation rule; `Cubature()` by default.
        steps: integration steps between two times of the grid or the data.
        sweeps: passes, at most.

    Returns:
        Means, standard deviations, and intervals that respect the bounds.

    Raises:
        ValueError, TypeError: as `lfm_ppl.full_information`; outputs whose noise is correlated, zero, or a function.

    Warns:
        UserWarning: the sites have not converged.

    Example:
        >>> import jax.numpy as jnp, numpy as np, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        >>> times = np.arange(3.0)
        >>> found = lfm.constrained_posterior(model, times, jnp.ones((3, 1)), lower={"u": 0.0}, grid=times)
        >>> bool(found.interval("u")[0].min() >= 0)
        True

    Source: Minka (2001), Expectation propagation for approximate Bayesian inference; Cunningham, Hennig and
    Lacoste-Julien (2011), Gaussian probabilities and expectation propagation.
    """
    check_settings(model, 1.0, sweeps)
    if model.observation.angular:
        raise ValueError("the posterior under constraints takes no angular outputs; observe their sine and cosine, or "
                         "take lfm.full_information.")
    found = build_constraints(model, lower, upper, constraints)
    laid_out = rows(model, times, grid)
    ssm = stacked_model(model, found)
    scan_grid = build_time_grid(ssm, laid_out.times, steps)
    model.check_at(scan_grid.initial_time, np.shape(times)[0])
    y = check_observations(y, np.shape(times)[0], len(model.output_names))
    variance = _variances(model, np.shape(times)[0])
    warn_single_precision()
    result = _run(ssm, found, as_rule(rule), scan_grid, laid_out, y, variance, SiteSettings(sweeps=sweeps))
    if not checks.traced(result) and not bool(result.converged):
        checks.warn(f"expectation propagation has not converged in {int(result.sweeps)} passes. Raise sweeps, take a "
                    "coarser grid, or see whether the constraints can be respected at all (lfm.full_information).")
    return result


def _variances(model: LatentForceModel, count: int) -> jax.Array:
    """Return the noise variances (T, D), after checking that there is nothing else."""
    covariance = model.observation.covariance
    if callable(covariance):
        raise ValueError("the posterior under constraints takes a fixed observation covariance; the model's is a "
                         "function of (x, u, t).")
    value = jnp.asarray(covariance, float)
    if value.ndim > 1:
        known = checks.concrete(value)
        if known is not None and np.any(known * (1.0 - np.eye(known.shape[-1]))):
            raise ValueError("the posterior under constraints takes outputs with independent noise; the observation "
                             "covariance has entries off its diagonal.")
        value = jnp.diagonal(value, axis1=-2, axis2=-1)
    checks.positive("the observation covariance", value, "Sites need observations with noise.")
    return jnp.broadcast_to(value, (count, value.shape[-1]))


@eqx.filter_jit
def _run(ssm: StateSpaceModel, constraints: Constraints, rule: Rule, grid: TimeGrid, laid_out: Rows, y: jax.Array,
         variance: jax.Array, settings: SiteSettings) -> ConstrainedPosterior:
    count, outputs = len(laid_out.times), y.shape[1]
    held = jnp.zeros((count, constraints.count), bool).at[laid_out.grid].set(True)
    noise = jnp.ones((count, outputs)).at[laid_out.data].set(variance)
    start = Moments(*ssm.initial())

    whole = with_rows(y, jnp.zeros((len(laid_out.grid), constraints.count)), laid_out)
    measured = whole[:, :outputs]
    present, nothing = jnp.isfinite(measured), jnp.zeros((count, constraints.count))
    first = Sites(jnp.concatenate([jnp.where(present, measured, 0.0), nothing], axis=1), jnp.zeros_like(whole),
                  jnp.concatenate([jnp.where(present, 1.0 / noise, 0.0), nothing], axis=1))
    posterior = evidence(ssm, rule, grid, whole, BoundedTerms(measured, noise, held), settings, start, first, "all")
    smoothed = backward(posterior.passed, start, grid)
    at = jnp.asarray(grid.observed)[jnp.asarray(laid_out.grid)]
    times = jnp.asarray(laid_out.times)[jnp.asarray(laid_out.grid)]
    matrix, offset = jax.vmap(ssm.input_map)(times)
    mean, covariance = (at_rows(a[1:], at) for a in smoothed.moments)
    mean = matmul(matrix, mean[..., None])[..., 0] + offset
    sd = safe_sqrt(jax.vmap(diagonal)(congruence(matrix, covariance)))
    size = ssm.physical_dim
    found = posterior.refined.found
    cavity = Marginal(*(a[jnp.asarray(laid_out.grid), outputs:] for a in found.cavity.cavity))
    return ConstrainedPosterior(
        times, mean[:, :size], sd[:, :size], mean[:, size:], sd[:, size:],
        found.sweeps, found.converged, cavity, constraints, ssm.model.state_names, ssm.model.force_names)
