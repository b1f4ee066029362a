"""The smoother: the state and the forces given all observations, and draws of their trajectories."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.filtering.breakdown import warn_of_breakdown
from lfm_ppl.filtering.filter import (
    Pass,
    as_rule,
    at_intervals,
    check_observations,
    forward,
    preparation,
    warn_single_precision,
    whitened_innovations,
)
from lfm_ppl.filtering.iterated import Iterated, posterior_linearisation
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.rts import Smoothed, backward
from lfm_ppl.filtering.simulation_smoother import smoothing_errors
from lfm_ppl.filtering.sites import (
    FamilyTerms,
    SiteSettings,
    as_settings,
    assumed_density_filter,
    leave_one_out,
    quantile_residuals,
)
from lfm_ppl.filtering.sites import evidence as site_evidence
from lfm_ppl.filtering.time_grid import TimeGrid, build_time_grid
from lfm_ppl.linalg import congruence, matmul, safe_sqrt
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.resolution import check_resolution
from lfm_ppl.model.state_space import StateSpaceModel, state_space


class Marginal(NamedTuple):
    """Mean (K,) and standard deviation (K,) of one force or state at the requested times."""

    mean: jax.Array
    sd: jax.Array


class Trajectories(NamedTuple):
    """Draws of whole trajectories at the requested times.

    Attributes:
        times: (K,).
        state: (draws, K, M), the physical state.
        forces: name -> (draws, K).
    """

    times: jax.Array
    state: jax.Array
    forces: dict[str, jax.Array]


class SmootherResult(eqx.Module):
    """The outcome of `smooth`.

    Attributes:
        times: (K,) requested times.
        mean, covariance: (K, n), (K, n, n) of the joint state, given all observations.
        input_mean, input_covariance: (K, M + R), (K, M + R, M + R) of w = (x, u).
        log_likelihood: (T,), log p(y_k | y_1:k-1).
        leave_one_out: (T,), log p(y_k | y_-k).
        whitened_innovation: (T, D), innovations whitened by their Cholesky factor, or randomised quantile residuals
            of an observation family, NaN where missing.
        change: largest change of a smoothed mean in the last iteration, in smoothed standard deviations; NaN
            with fewer than two iterations.
        converged: whether the sites of an observation family have converged; true where there are none. Where they
            have not, a model that is not linear is smoothed with the sites of assumed density filtering, and
            ``leave_one_out`` is ``log_likelihood``; in a linear model both are -inf.
    """

    times: jax.Array
    mean: jax.Array
    covariance: jax.Array
    input_mean: jax.Array
    input_covariance: jax.Array
    log_likelihood: jax.Array
    leave_one_out: jax.Array
    whitened_innovation: jax.Array
    change: jax.Array
    converged: jax.Array
    _start: Moments
    _passed: Pass
    _requested: jax.Array
    _input_map: Any
    state_names: tuple[str, ...] = eqx.field(static=True)
    force_names: tuple[str, ...] = eqx.field(static=True)

    def force(self, name: str) -> Marginal:
        """Return mean (K,) and sd (K,) of a force.

        Raises:
            ValueError: unknown name; the message has the nearest ones.
        """
        return self._marginal("force", name, self.force_names, len(self.state_names))

    def state(self, name: str) -> Marginal:
        """Return mean (K,) and sd (K,) of a physical state."""
        return self._marginal("state", name, self.state_names, 0)

    def _marginal(self, kind: str, name: str, names: tuple[str, ...], first: int) -> Marginal:
        checks.one_of(kind, name, names)
        index = first + names.index(name)
        return Marginal(self.input_mean[:, index], safe_sqrt(self.input_covariance[:, index, index]))

    def sample(self, key: jax.Array, draws: int = 1) -> Trajectories:
        """Draw whole trajectories from the joint smoothing distribution, by `smoothing_errors`.

        Draws and moments are of one scan, so that the draws have the mean and covariance of the result at each time.

        Args:
            key: a JAX random key.
            draws: number of trajectories.

        Returns:
            Physical state and forces at the requested times, jointly Gaussian in time.

        Example:
            >>> result.sample(jax.random.key(0), 3).state.shape  # doctest: +SKIP
            (3, 25, 1)
        """
        checks.positive_integer("draws", draws)
        return _sample(self, key, draws)

    def sample_joint(self, key: jax.Array, draws: int = 1) -> jax.Array:
        """Draw trajectories of the joint state, the forces' own states included: (draws, K, n); see `sample`."""
        checks.positive_integer("draws", draws)
        return jnp.moveaxis(_joint_draws(self, key, draws), -1, 0)


@eqx.filter_jit
def _joint_draws(result: SmootherResult, key: jax.Array, draws: int) -> jax.Array:
    """Return draws (K, n, draws) of the joint state."""
    errors = smoothing_errors(key, result._passed, result._start, draws)[result._requested]
    return result.mean[..., None] + errors


@eqx.filter_jit
def _sample(result: SmootherResult, key: jax.Array, draws: int) -> Trajectories:
    matrix, offset = result._input_map
    inputs = jnp.moveaxis(matmul(matrix, _joint_draws(result, key, draws)) + offset[..., None], -1, 0)
    size = len(result.state_names)
    forces = {name: inputs[:, :, size + index] for index, name in enumerate(result.force_names)}
    return Trajectories(result.times, inputs[:, :, :size], forces)


def check_iterations(iterations: int, damping: float, tolerance: float | None = None) -> None:
    """Raise where the iterations are not a whole number >= 0, the damping outside (0, 1], or there is a tolerance."""
    if iterations != 0:
        checks.positive_integer("iterations", iterations)
    if not 0 < damping <= 1:
        raise ValueError("damping must lie in (0, 1] (the largest share of each new iterate that is taken), "
                         f"got {damping}.")
    if iterations and tolerance is not None:
        raise ValueError("iterations need integration steps of equal length, whose ends all passes share, and with a "
                         f"tolerance the steps follow the moments; leave out tolerance={tolerance:g} or iterations.")


def smooth(model: LatentForceModel, times: Any, y: Any, rule: Rule | None = None, steps: int = 10,
           max_step: float | None = None, at: Any = None, iterations: int = 0, damping: float = 0.7,
           tolerance: float | None = None, sites: SiteSettings | str | None = None) -> SmootherResult:
    """Smooth: the state and the forces given all observations.

        m_s = m + G (m_s+ - m_p),  P_s = (I - G Phi) P (I - G Phi)' + G (Q + P_s+) G',  G = P Phi' P_p^-1.

    Args:
        model: the latent force model.
        times: (T,), non-decreasing.
        y: (T, D), NaN where missing.
        rule: linearisation rule; `Cubature()` by default.
        steps: integration steps between two consecutive times.
        max_step: longest step, in units of time; longer intervals get more steps. None: twice the median step. A linear
            model without known inputs is exact, and needs no steps.
        at: (K,) times at which results are wanted, in any order, also after the last observation (a forecast).
            The observation times by default. They end intervals of the scan, so that results elsewhere change by the
            error of the integration steps.
        iterations: of posterior linearisation, 0 for none.
        damping: largest share of each new iterate that is taken, in (0, 1]; less where the iterates turn back.
        tolerance: largest error of an integration step, in standard deviations, as in `lfm_ppl.MarginalLikelihood`.
        sites: of an observation family, how its sites are refined: "ep" (the default), "variational", "laplace", or
            `lfm_ppl.SiteSettings`.

    Returns:
        Moments at the requested times, forces by name, draws of trajectories, diagnostics.

    Raises:
        ValueError, TypeError: as `lfm_ppl.filter`; also for a requested time before the initial time.

    Warns:
        FilterWarning: as `lfm_ppl.filter`.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, jnp.array([0.1])), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        >>> lfm.smooth(model, jnp.arange(3.0), jnp.ones((3, 1)), at=jnp.linspace(0, 4, 5)).force("u").mean.shape
        (5,)

    Source: Särkkä and Sarmavuori (2013); García-Fernández, Svensson and Särkkä (2017) for the iterations;
    de Jong (1989), Biometrika 76, for the leave-one-out conditionals.
    """
    rule = as_rule(rule)
    check_iterations(iterations, damping, tolerance)
    settings = as_settings(sites, iterations)
    ssm = state_space(model)
    grid = build_time_grid(ssm, times, steps, max_step, at, tolerance=tolerance)
    model.check_at(grid.initial_time, np.shape(times)[0])
    check_resolution(model, times, y)
    y = check_observations(y, len(grid.observed), ssm.output_dim, model=model)
    warn_single_precision()
    result = _run_smoother(ssm, rule, grid, y, iterations, damping, settings)
    warn_of_breakdown(ssm, rule, grid, y, None, result.log_likelihood, settings, result.converged)
    return result


def smooth_on(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, iterations: int, damping: float,
              settings: SiteSettings) -> SmootherResult:
    """Smooth on the intervals of a time grid, without checks; for compiled code."""
    start = Moments(*ssm.initial())
    passed, smoothed, iterated, scores = _smooth_intervals(ssm, rule, grid, y, start, iterations, damping, settings)
    times = jnp.asarray(grid.requested_times, float)
    requested = jnp.asarray(grid.requested)
    mean, covariance = (a[requested + 1] for a in smoothed.moments)
    matrix, offset = jax.vmap(ssm.input_map)(times)
    observed = jnp.asarray(grid.observed)
    at_data = jax.tree.map(lambda a: a[observed], passed)
    one_step_ahead, left_out, residual, converged = scores or (
        at_data.log_likelihood, smoothed.leave_one_out[observed], whitened_innovations(at_data, y), jnp.asarray(True))
    return SmootherResult(
        times, mean, covariance, matmul(matrix, mean[..., None])[..., 0] + offset, congruence(matrix, covariance),
        one_step_ahead, left_out, residual,
        jnp.asarray(jnp.nan) if iterated is None else iterated.change, converged, start, passed, requested,
        (matrix, offset), ssm.model.state_names, ssm.model.force_names)


def _smooth_intervals(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, start: Moments, iterations: int,
                      damping: float, settings: SiteSettings) -> tuple[Pass, Smoothed, Iterated | None, tuple | None]:
    """Return the forward and the backward scan, the iterations, and the terms of an observation family."""
    if isinstance(ssm.model.observation, ObservationFamily):
        return _smooth_family(ssm, rule, grid, y, start, settings, ssm.model.observation)
    iterated, prepared = None, preparation(ssm, rule, grid)
    if iterations:
        iterated = posterior_linearisation(ssm, rule, grid, y, start, iterations, damping, prepared)
    passed = forward(ssm, rule, grid, y, start=start, linearization_point=None if iterated is None else iterated.points,
                     keep="all", prepared=prepared)
    return passed, backward(passed, start, grid), iterated, None


def _smooth_family(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, start: Moments,
                   settings: SiteSettings, family: ObservationFamily) -> tuple[Pass, Smoothed, Iterated | None, tuple]:
    """Return the scans with the refined sites, and one-step-ahead and leave-one-out terms, residuals, convergence."""
    evidence = site_evidence(ssm, rule, grid, y, FamilyTerms(family, y), settings, start, keep="all")
    smoothed = backward(evidence.passed, start, grid)
    assert smoothed.predictor is not None
    sites, points = evidence.refined.found, evidence.refined.points
    predictor = jax.tree.map(lambda a: at_intervals(a, grid.observed), smoothed.predictor)
    prequential = assumed_density_filter(ssm, rule, grid, y, start)
    fallback = -jnp.inf if points is None else prequential.log_likelihood
    left_out = leave_one_out(predictor, sites.sites, evidence.entries)
    scores = (jnp.where(sites.converged, prequential.log_likelihood, fallback),
              jnp.where(sites.converged, left_out, fallback),
              quantile_residuals(family, prequential.prediction, y), sites.converged)
    return evidence.passed, smoothed, None if points is None else Iterated(points, sites.change), scores


_run_smoother = eqx.filter_jit(smooth_on)
