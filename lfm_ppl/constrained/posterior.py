"""The posterior under constraints: expectation propagation with truncated normal sites."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm

from lfm_ppl import checks
from lfm_ppl.constrained.augmented import rows, stacked_model
from lfm_ppl.constrained.boxes import Boxes, boxes
from lfm_ppl.constrained.constraints import build_constraints
from lfm_ppl.constrained.evidence import Bounded, check_variances, effective_number
from lfm_ppl.constrained.full_information import check_settings
from lfm_ppl.constrained.truncated import quantile
from lfm_ppl.filtering.filter import Pass, as_rule, at_intervals, check_observations, warn_single_precision
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.quadrature import Marginal
from lfm_ppl.filtering.rts import backward
from lfm_ppl.filtering.sites import SiteSettings
from lfm_ppl.filtering.smoother import Trajectories
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.linalg import congruence, diagonal, matmul, safe_sqrt
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.latent_force_model import LatentForceModel

_CANDIDATES = 32
"""Trajectories of which one is chosen by its weight."""

_BATCH = 64
"""Draws side by side."""


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
    _boxes: Boxes
    _problem: Bounded
    _proposal: Pass
    state_names: tuple[str, ...] = eqx.field(static=True)
    force_names: tuple[str, ...] = eqx.field(static=True)

    def interval(self, name: str, level: float = 0.95) -> tuple[jax.Array, jax.Array]:
        """Return the ends (K,), (K,) of the central interval of a state or force.

        A bounded quantity has a truncated normal distribution, so that its interval respects its bounds.

        Raises:
            ValueError: an unknown name, or a level outside of (0, 1).
        """
        names = (*self.state_names, *self.force_names)
        checks.one_of("name", name, names)
        if not 0 < level < 1:
            raise ValueError(f"level must lie between 0 and 1, got {level!r}.")
        index = names.index(name)
        tails = 0.5 * (1.0 - level), 0.5 * (1.0 + level)
        box = self._boxes.box_of(index)
        if box is None:
            mean, sd = (jnp.concatenate(pair, axis=1)[:, index] for pair in (
                (self.state_mean, self.force_mean), (self.state_sd, self.force_sd)))
            low, high = (mean + sd * norm.ppf(tail) for tail in tails)
            return low, high
        entry, sign, bound = box
        cavity = Marginal(*(a[:, entry] for a in self._cavity))
        near, far = (quantile(cavity, self._boxes.widths[entry], tail) for tail in tails)
        return (bound + near, bound + far) if sign > 0 else (bound - far, bound - near)

    def sample(self, key: jax.Array, draws: int = 1) -> Trajectories:
        """Draw trajectories that respect all constraints.

        Each is one of 32 of `lfm_ppl.constrained.feasible_paths`, chosen by their weights: for a linear model from the
        posterior itself as far as 32 represent it (`effective_share` says how well), and not from a Gaussian one.

        Args:
            key: a JAX random key.
            draws: number of trajectories.

        Returns:
            State (draws, K, M) and forces (draws, K) at the times of the grid.
        """
        checks.positive_integer("draws", draws)
        inputs = sampled(self._problem, self._proposal, key, draws)[:, jnp.asarray(self._problem.rows.grid)]
        size = len(self.state_names)
        forces = {name: inputs[:, :, size + i] for i, name in enumerate(self.force_names)}
        return Trajectories(self.times, inputs[:, :, :size], forces)

    def effective_share(self, key: jax.Array, draws: int = 1024) -> jax.Array:
        """Return the share of trajectories that weighted ones are worth, between 1 / ``draws`` and 1."""
        return effective_number(_weights(self._problem, self._proposal, key, draws)) / draws


@eqx.filter_jit
def _weights(problem: Bounded, passed: Pass, key: jax.Array, draws: int) -> jax.Array:
    return problem.paths(key, passed, draws + draws % 2).log_weights[:draws]


@eqx.filter_jit
def sampled(problem: Bounded, passed: Pass, key: jax.Array, draws: int) -> jax.Array:
    """Return trajectories (draws, K, M + R) of (x, u) at the rows of the scan."""
    batch = min(draws, _BATCH)

    def some(key: jax.Array) -> jax.Array:
        return jnp.moveaxis(problem.chosen(key, passed, batch, _CANDIDATES), -1, 0)

    keys = jax.random.split(key, -(-draws // batch))
    found = jax.lax.map(some, keys)
    return found.reshape(-1, *found.shape[2:])[:draws]


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
    found = boxes(build_constraints(model, lower, upper, constraints))
    laid_out = rows(model, times, grid)
    ssm = stacked_model(model, found)
    scan_grid = build_time_grid(ssm, laid_out.times, steps)
    model.check_at(scan_grid.initial_time, np.shape(times)[0])
    y = check_observations(y, np.shape(times)[0], len(model.output_names))
    variance = check_variances(model, np.shape(times)[0])
    warn_single_precision()
    result = _run(Bounded(ssm, as_rule(rule), scan_grid, laid_out, found, variance, SiteSettings(sweeps=sweeps)), y)
    if not checks.traced(result.converged) and not bool(result.converged):
        checks.warn(f"expectation propagation has not converged in {int(result.sweeps)} passes. Raise sweeps, take a "
                    "coarser grid, or see whether the constraints can be respected at all (lfm.full_information).")
    return result


@eqx.filter_jit
def _parts(problem: Bounded, y: jax.Array) -> tuple:
    ssm, laid_out, outputs = problem.ssm, problem.rows, y.shape[1]
    start = Moments(*ssm.initial())
    posterior = problem.propagated(y, "all")
    smoothed = backward(posterior.passed, start, problem.grid)
    at = jnp.asarray(problem.grid.observed)[jnp.asarray(laid_out.grid)]
    times = jnp.asarray(laid_out.times)[jnp.asarray(laid_out.grid)]
    matrix, offset = jax.vmap(ssm.input_map)(times)
    mean, covariance = (at_intervals(a[1:], at) for a in smoothed.moments)
    mean = matmul(matrix, mean[..., None])[..., 0] + offset
    sd = safe_sqrt(jax.vmap(diagonal)(congruence(matrix, covariance)))
    size = ssm.physical_dim
    found = posterior.refined.found
    cavity = Marginal(*(a[jnp.asarray(laid_out.grid), outputs:] for a in found.cavity.cavity))
    proposal = problem.proposal(y, posterior)._replace(steps=None)
    return (times, mean[:, :size], sd[:, :size], mean[:, size:], sd[:, size:], found.sweeps, found.converged,
            cavity), proposal


def _run(problem: Bounded, y: jax.Array) -> ConstrainedPosterior:
    moments, proposal = _parts(problem, y)
    names = problem.ssm.model.state_names, problem.ssm.model.force_names
    return ConstrainedPosterior(*(*moments, problem.boxes, problem, proposal, *names))
