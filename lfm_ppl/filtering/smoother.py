"""The smoother: state and forces given all observations, and draws of their trajectories.

1. Observation times and requested times are the nodes of one time grid (`time_grid`).
2. The model is linearised about the filter's moments, about iterated posterior moments, or about the moments that
   the factors of an observation family give.
3. One forward and one backward scan give the smoothed moments at all nodes; draws come from the same forward scan.

Source: Särkkä and Sarmavuori (2013), Signal Processing 93.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from lfm_ppl.filtering.arguments import as_rule, check_iterations, check_observations, warn_single_precision
from lfm_ppl.filtering.backward import backward
from lfm_ppl.filtering.breakdown import warn_of_breakdown, warn_of_iterations
from lfm_ppl.filtering.ep.evidence import entry_leave_one_out, evidence, leave_one_out
from lfm_ppl.filtering.ep.moment_matching import assumed_density_filter, quantile_residuals
from lfm_ppl.filtering.ep.settings import FactorSettings, as_settings
from lfm_ppl.filtering.ep.terms import FamilyTerms
from lfm_ppl.filtering.filter import whitened_innovations
from lfm_ppl.filtering.forward import FilterTrace, forward
from lfm_ppl.filtering.integrators.methods import DEFAULT_METHOD, METHODS
from lfm_ppl.filtering.intervals import TimeGrid
from lfm_ppl.filtering.iterated import Anchor, number_of_iterations, posterior_linearisation
from lfm_ppl.filtering.moments import Moments, Record, matvec
from lfm_ppl.filtering.problem import FilterProblem, at_intervals, filter_problem
from lfm_ppl.filtering.sample import sample_errors
from lfm_ppl.filtering.stiffness import warn_of_long_steps
from lfm_ppl.filtering.time_grid import build_time_grid
from lfm_ppl.filtering.update import GaussianUpdate
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.resolution import check_resolution
from lfm_ppl.model.state_space import StateSpaceModel, state_space
from lfm_ppl.utils import checks
from lfm_ppl.utils.linalg import congruence, matmul, safe_sqrt
from lfm_ppl.utils.programs import shared_jit


class MeanSd(NamedTuple):
    """Mean (K,) and standard deviation (K,) of one force or state at the times of a result.

    Every result returns it from ``force(name)`` and ``state(name)``. The standard deviation is NaN where a result has
    none, as a most probable trajectory, which is then the mean.
    """

    mean: jax.Array
    sd: jax.Array


def moments_by_name(kind: str, name: str, names: tuple[str, ...], mean: jax.Array, sd: jax.Array) -> MeanSd:
    """Return the moments of a force or a state, from those (..., N) of all in the order of their names.

    Args:
        kind: "force" or "state", for the message.
        name: of the one that is asked for.
        names: names of all N.
        mean: (..., N).
        sd: (..., N).

    Raises:
        ValueError: unknown name; the message has the nearest ones.
    """
    checks.one_of(kind, name, names)
    index = names.index(name)
    return MeanSd(mean[..., index], sd[..., index])


def input_marginal(result: Any, kind: str, name: str) -> MeanSd:
    """Return the moments of a force or a state of a result that has the moments of w = (x, u).

    Args:
        result: with ``input_mean`` (K, M + R), ``input_covariance`` (K, M + R, M + R), and names of states and forces.
        kind: "force" or "state".
        name: of the one that is asked for.
    """
    count = len(result.state_names)
    names, columns = ((result.state_names, slice(count)) if kind == "state"
                      else (result.force_names, slice(count, None)))
    sd = safe_sqrt(jnp.diagonal(result.input_covariance, axis1=1, axis2=2))
    return moments_by_name(kind, name, names, result.input_mean[:, columns], sd[:, columns])


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
    """Result of `smooth`.

    Attributes:
        times: (K,) requested times.
        mean, covariance: (K, n), (K, n, n) of the joint state, given all observations.
        input_mean, input_covariance: (K, M + R), (K, M + R, M + R) of w = (x, u).
        log_likelihood: (T,), log p(y_k | y_1:k-1).
        leave_one_out: (T,), log p(y_k | y_-k).
        entry_leave_one_out: (T, D), log p of each entry of y given all other entries; zero where the entry is missing.
        whitened_innovation: (T, D), innovations whitened by their Cholesky factor, or randomised quantile residuals
            of an observation family, NaN where missing.
        change: largest change of a smoothed mean in the last iteration, in smoothed standard deviations; NaN
            with fewer than two iterations.
        log_likelihood_change: change of the sum of ``log_likelihood`` in the last iteration; NaN with fewer than two.
        converged: whether the factors of an observation family have converged; true where there are none. Where they
            have not, a model that is not linear is smoothed with the factors of assumed density filtering, and
            ``leave_one_out`` is ``log_likelihood``, divided equally among the entries of a row; in a linear model all
            are -inf.
    """

    times: jax.Array
    mean: jax.Array
    covariance: jax.Array
    input_mean: jax.Array
    input_covariance: jax.Array
    log_likelihood: jax.Array
    leave_one_out: jax.Array
    entry_leave_one_out: jax.Array
    whitened_innovation: jax.Array
    change: jax.Array
    log_likelihood_change: jax.Array
    converged: jax.Array
    _trace: FilterTrace
    _requested: jax.Array
    _input_map: Any
    state_names: tuple[str, ...] = eqx.field(static=True)
    force_names: tuple[str, ...] = eqx.field(static=True)

    def force(self, name: str) -> MeanSd:
        """Return mean (K,) and sd (K,) of a force.

        Raises:
            ValueError: unknown name; the message has the nearest ones.
        """
        return input_marginal(self, "force", name)

    def state(self, name: str) -> MeanSd:
        """Return mean (K,) and sd (K,) of a physical state."""
        return input_marginal(self, "state", name)

    def sample(self, key: jax.Array, draws: int = 1) -> Trajectories:
        """Draw whole trajectories from the joint smoothing distribution, by `sample_errors`.

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


@shared_jit
def _joint_draws(result: SmootherResult, key: jax.Array, draws: int) -> jax.Array:
    """Return draws (K, n, draws) of the joint state."""
    errors = sample_errors(key, result._trace, draws)[result._requested]
    return result.mean[..., None] + errors


@shared_jit
def _sample(result: SmootherResult, key: jax.Array, draws: int) -> Trajectories:
    matrix, offset = result._input_map
    inputs = jnp.moveaxis(matmul(matrix, _joint_draws(result, key, draws)) + offset[..., None], -1, 0)
    size = len(result.state_names)
    forces = {name: inputs[:, :, size + index] for index, name in enumerate(result.force_names)}
    return Trajectories(result.times, inputs[:, :, :size], forces)


def smooth(model: LatentForceModel, times: ArrayLike, y: ArrayLike, rule: Rule | None = None, steps: int = 10,
           max_step: float | None = None, at: ArrayLike | None = None, iterations: int | None = None,
           damping: float = 0.7, tolerance: float | None = None, factors: FactorSettings | str | None = None,
           method: str = DEFAULT_METHOD, about: Anchor | None = None) -> SmootherResult:
    """Smooth: the state and the forces given all observations.

        m_s = m + G (m_s+ - m_p),  P_s = (I - G Phi) P (I - G Phi)' + G (Q + P_s+) G',  G = P Phi' P_p^-1.

    Args:
        model: the latent force model; its functions are read once for each model, as by `jax.jit`.
        times: (T,), non-decreasing.
        y: (T, D), NaN where missing.
        rule: linearisation rule; `Cubature()` by default.
        steps: integration steps between two consecutive times.
        max_step: longest step, in units of time; longer intervals get more steps. None: twice the median step. A linear
            model without known inputs is exact, and needs no steps.
        at: (K,) times at which results are wanted, in any order, also after the last observation (a forecast).
            The observation times by default. They end intervals of the scan, so that results elsewhere change by the
            error of the integration steps.
        iterations: of posterior linearisation; 0 for none. The default is that of `lfm_ppl.MarginalLikelihood`, 3 for
            a model that is not linear, so that both compute the same log likelihood.
        damping: largest fraction of each new iterate that is taken, in (0, 1]; less where the iterates turn back.
        tolerance: largest error of an integration step, in standard deviations, as in `lfm_ppl.MarginalLikelihood`.
        method: of integration, as in `lfm_ppl.MarginalLikelihood`.
        factors: of an observation family, how its factors are refined: "ep" (the default), "variational", "laplace", or
            `lfm_ppl.FactorSettings`.
        about: smoothed moments from which the iterations start, as in `lfm_ppl.MarginalLikelihood`; at requested times
            they are interpolated.

    Returns:
        Moments at the requested times, forces by name, draws of trajectories, diagnostics.

    Raises:
        ValueError, TypeError: as `lfm_ppl.filter`; also for a requested time before the initial time.

    Warns:
        FilterWarning: as `lfm_ppl.filter`; also where the last iteration changes a smoothed mean by more than one
            standard deviation, or the log likelihood by more than 0.5.

    Example:
        >>> import jax.numpy as jnp, lfm_ppl as lfm
        >>> model = lfm.LatentForceModel(
        ...     lambda x, u, t: u - x, {"u": lfm.Matern(1.0, 1.0)},
        ...     lfm.GaussianObservation(lambda x, u, t: x, sd=0.3), lfm.Gaussian(jnp.zeros(1), jnp.eye(1)))
        >>> lfm.smooth(model, jnp.arange(3.0), jnp.ones((3, 1)), at=jnp.linspace(0, 4, 5)).force("u").mean.shape
        (5,)

    Source: Särkkä and Sarmavuori (2013); García-Fernández, Svensson and Särkkä (2017) for the iterations;
    de Jong (1989), Biometrika 76, for the leave-one-out conditionals.
    """
    rule = as_rule(rule)
    checks.one_of("method", method, METHODS)
    check_iterations(iterations, damping, tolerance)
    ssm = state_space(model)
    iterations = number_of_iterations(iterations, ssm, tolerance)
    settings = as_settings(factors, iterations)
    grid = build_time_grid(ssm, times, steps, max_step, at, tolerance=tolerance)._replace(method=method)
    model.check_at(grid.initial_time, np.shape(times)[0])
    check_resolution(model, times, y)
    y = check_observations(y, len(grid.observed), ssm.output_dim, model=model)
    warn_single_precision()
    about = None if about is None or ssm.plan.is_linear else about.on_grid(grid, at is None)
    result = _compiled_smooth(ssm, rule, grid, y, iterations, damping, settings, about)
    warn_of_breakdown(ssm, rule, grid, y, None, result.log_likelihood, settings, result.converged)
    if not isinstance(model.observation, ObservationFamily):
        warn_of_iterations(result.change, result.log_likelihood_change)
    warn_of_long_steps(ssm, rule, grid, steps, lambda: filtered_mean(result, grid), result.log_likelihood)
    return result


def filtered_mean(result: SmootherResult, grid: TimeGrid) -> jax.Array:
    """Return the means (T, n) of the joint state given the observations so far, at the observations of the grid."""
    return result._trace.filtered.mean[jnp.asarray(grid.observed)]


def smooth_on(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, iterations: int, damping: float,
              settings: FactorSettings, about: Anchor | None = None) -> SmootherResult:
    """Smooth on the intervals of a time grid, without checks; for compiled code."""
    problem = filter_problem(ssm, rule, grid)
    if isinstance(ssm.model.observation, ObservationFamily):
        trace, moments, diagnostics = _smooth_family(problem, y, settings, ssm.model.observation)
    else:
        trace, moments, diagnostics = _smooth_gaussian(problem, y, iterations, damping, about)
    times = jnp.asarray(grid.requested_times, float)
    requested = jnp.asarray(grid.requested)
    mean, covariance = (a[requested + 1] for a in moments)
    matrix, offset = jax.vmap(ssm.input_map)(times)
    return SmootherResult(
        times, mean, covariance, matvec(matrix, mean) + offset, congruence(matrix, covariance), **diagnostics,
        _trace=trace, _requested=requested, _input_map=(matrix, offset), state_names=ssm.model.state_names,
        force_names=ssm.model.force_names)


def _smooth_gaussian(problem: FilterProblem, y: jax.Array, iterations: int, damping: float,
                     about: Anchor | None) -> tuple[FilterTrace, Moments, dict[str, jax.Array]]:
    """Return the forward pass, the smoothed moments and the diagnostics, fields of the result by name."""
    updater = GaussianUpdate(y)
    points, change, previous = posterior_linearisation(problem, updater, iterations, damping, about)
    trace = forward(problem, updater, about=points, record=Record.SMOOTHER)
    smoothed = backward(problem, trace)
    at_data, left_out, entries = at_intervals(
        (trace._replace(initial=None), smoothed.leave_one_out, smoothed.entry_leave_one_out), problem.grid.observed)
    residual = whitened_innovations(at_data, y)
    log_likelihood = jnp.where(jnp.isnan(at_data.log_likelihood), -jnp.inf, at_data.log_likelihood)
    return trace, smoothed.moments, {
        "log_likelihood": log_likelihood, "leave_one_out": left_out, "entry_leave_one_out": entries,
        "whitened_innovation": residual, "change": change,
        "log_likelihood_change": at_data.log_likelihood.sum() - previous, "converged": jnp.asarray(True)}


def _smooth_family(problem: FilterProblem, y: jax.Array, settings: FactorSettings,
                   family: ObservationFamily) -> tuple[FilterTrace, Moments, dict[str, jax.Array]]:
    """Return the results of `_smooth_gaussian` for an observation family, with randomised quantile residuals."""
    result = evidence(problem, FamilyTerms(family, y), settings, record=Record.SMOOTHER)
    smoothed = backward(problem, result.trace)
    fixed_point, points = result.refined.fixed_point, result.refined.points
    predictor = at_intervals(smoothed.predictor, problem.grid.observed)
    prequential = assumed_density_filter(problem, y)
    fallback = jnp.full(len(y), -jnp.inf) if points is None else prequential.log_likelihood
    left_out = leave_one_out(predictor, fixed_point.factors, result.entries)
    one_step_ahead, left_out = (jnp.where(fixed_point.converged, value, fallback)
                                for value in (prequential.log_likelihood, left_out))
    entries = entry_leave_one_out(predictor, fixed_point.factors, result.entries)
    counts = jnp.maximum(jnp.isfinite(y).sum(axis=1), 1)
    entries = jnp.where(fixed_point.converged, entries, (fallback / counts)[:, None])
    change = jnp.asarray(jnp.nan) if points is None else fixed_point.change
    residual = quantile_residuals(family, prequential.prediction, y)
    return result.trace, smoothed.moments, {
        "log_likelihood": one_step_ahead, "leave_one_out": left_out,
        "entry_leave_one_out": jnp.where(jnp.isnan(y), 0.0, entries), "whitened_innovation": residual, "change": change,
        "log_likelihood_change": jnp.asarray(jnp.nan), "converged": fixed_point.converged}


_compiled_smooth = shared_jit(smooth_on)
