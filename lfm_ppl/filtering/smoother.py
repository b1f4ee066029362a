"""The smoother: the state and the forces given all observations, and draws of their trajectories."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lfm_ppl import checks
from lfm_ppl.filtering.breakdown import warn_of_breakdown
from lfm_ppl.filtering.dense_output import Branches, Places, dense_output, places, steps_to_end
from lfm_ppl.filtering.filter import (
    Pass,
    Points,
    as_rule,
    at_intervals,
    check_observations,
    completed,
    forward,
    preparation,
    warn_single_precision,
    whitened_innovations,
)
from lfm_ppl.filtering.iterated import Iterated, NodePlaces, interpolated, node_places, posterior_linearisation
from lfm_ppl.filtering.linear_response import responds, response
from lfm_ppl.filtering.predict import Moments
from lfm_ppl.filtering.rts import Smoothed, backward
from lfm_ppl.filtering.simulation_smoother import smoothing_errors
from lfm_ppl.filtering.sites import (
    FamilyTerms,
    SiteSettings,
    as_settings,
    assumed_density_filter,
    is_linear,
    leave_one_out,
    quantile_residuals,
)
from lfm_ppl.filtering.sites import evidence as site_evidence
from lfm_ppl.filtering.time_grid import TimeGrid, build_time_grid, interval_at
from lfm_ppl.linalg import congruence, matmul, safe_sqrt, semidefinite_root, solve_lower
from lfm_ppl.linearisation.rule import Rule
from lfm_ppl.model.latent_force_model import LatentForceModel
from lfm_ppl.model.observations.family import ObservationFamily
from lfm_ppl.model.resolution import check_resolution
from lfm_ppl.model.state_space import StateSpaceModel, state_space

LONGEST_FORECAST = 10_000
"""Most intervals of a forecast; a longer one gets a long last interval (or `max_step`)."""

_MOST_KEPT = 2_000_000
"""Entries of a covariance at each integration step up to which steps are kept for requested times between the data.

Beyond, each such time makes a whole interval's steps of its own. The data alone decide, not the times requested."""


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


class Joint(NamedTuple):
    """What draws of trajectories are made of.

    Attributes:
        start: moments at the initial time.
        passed: forward scan over intervals that end at the requested times, among others.
        requested: (K,) the requested times among these.
        covariance: (K, n, n), smoothed by that scan; None where it is that of the result. Of draws it is the result's:
            integration errors differ in intervals that are cut at the requested times, and linear response is added.
    """

    start: Moments
    passed: Pass
    requested: jax.Array
    covariance: jax.Array | None


class SmootherResult(eqx.Module):
    """The outcome of `smooth`.

    Attributes:
        times: (K,) requested times.
        mean, covariance: (K, n), (K, n, n) of the joint state, given all observations; of an observation family the
            covariance is that of linear response (`SiteSettings`).
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
    _joint: Joint
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

        At each time they have the covariance of the result. Of an observation family, correlations between times are
        those of the Gaussian under all sites.

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
    start, passed, requested, covariance = result._joint
    errors = smoothing_errors(key, passed, start, draws)[requested]
    if covariance is not None:
        errors = jax.vmap(_recoloured)(errors, covariance, result.covariance)
    return result.mean[..., None] + errors


@eqx.filter_jit
def _sample(result: SmootherResult, key: jax.Array, draws: int) -> Trajectories:
    matrix, offset = result._input_map
    inputs = jnp.moveaxis(matmul(matrix, _joint_draws(result, key, draws)) + offset[..., None], -1, 0)
    size = len(result.state_names)
    forces = {name: inputs[:, :, size + index] for index, name in enumerate(result.force_names)}
    return Trajectories(result.times, inputs[:, :, :size], forces)


def _recoloured(errors: jax.Array, covariance: jax.Array, wanted: jax.Array) -> jax.Array:
    """Give errors (n, draws) of one covariance another: L_w L^-1 e, with the two Cholesky factors."""
    return matmul(semidefinite_root(wanted), solve_lower(semidefinite_root(covariance), errors))


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
            The observation times by default. They change nothing elsewhere.
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
    grids = smoothing_grids(ssm, times, steps, max_step, at, iterations, tolerance)
    model.check_at(grids.marginals.initial_time, np.shape(times)[0])
    check_resolution(model, times, y)
    y = check_observations(y, len(grids.marginals.observed), ssm.output_dim, model=model)
    warn_single_precision()
    result = _run_smoother(ssm, rule, grids, y, iterations, damping, settings)
    warn_of_breakdown(ssm, rule, grids.marginals, y, None, result.log_likelihood, settings, result.converged)
    return result


class SmoothingGrids(NamedTuple):
    """The scans of a smoother.

    Attributes:
        marginals: of the scan that gives the likelihood and the smoothed moments.
        joint: for draws of trajectories, with intervals that end at the requested times too; None where ``marginals``
            serves: without requested times, and for a model whose intervals are exact whatever their length.
        where: the requested times among ``marginals``; None where ``joint`` is.
        nodes: where those of ``joint`` lie among those of ``marginals``, about whose iterated moments it is
            linearised; None without iterations, for an observation family, and where ``joint`` is None.
        times: (K,) requested times.
    """

    marginals: TimeGrid
    joint: TimeGrid | None
    where: Places | None
    nodes: NodePlaces | None
    times: Any


def smoothing_grids(ssm: StateSpaceModel, times: Any, steps: int, max_step: float | None, at: Any,
                    iterations: int, tolerance: float | None = None) -> SmoothingGrids:
    """Lay out the time grids of a smoother; a forecast goes on in intervals as long as the data's median interval."""
    joint = build_time_grid(ssm, times, steps, max_step, at, tolerance=tolerance)
    # Where breakpoints of known inputs are traced, so are the places of requested times: they are nodes of one grid.
    if at is None or ssm.time_invariant or checks.traced(joint.since):
        return SmoothingGrids(joint, None, None, None, joint.requested_times)
    known = np.asarray(times, float)
    beyond = np.array([])
    if joint.requested_times.max() > known[-1]:
        gaps = np.diff(known)
        gap = np.median(gaps[gaps > 0]) if np.any(gaps > 0) else joint.requested_times.max() - known[-1]
        count = int(np.ceil((joint.requested_times.max() - known[-1]) / gap * (1 - 1e-12)))
        beyond = known[-1] + gap * np.arange(1, min(count, LONGEST_FORECAST) + 1)
        beyond[-1] = max(beyond[-1], joint.requested_times.max())
    base = build_time_grid(ssm, times, steps, max_step, np.append(known[-1:], beyond), tolerance=tolerance,
                           until=float(max(known[-1], joint.requested_times.max())))
    has_family = isinstance(ssm.model.observation, ObservationFamily)
    where = places(base, joint.requested_times)
    if tolerance is None:
        joint = joint._replace(steps=_steps_as_long(joint, base))
    nodes = node_places(joint, base) if iterations and not has_family else None
    return SmoothingGrids(base, joint, where, nodes, joint.requested_times)


def _steps_as_long(grid: TimeGrid, base: TimeGrid) -> int:
    """Return with how many steps in each interval those of a grid are as short as the base's, or with all of its own.

    Many requested times cut the intervals of the data into short ones, of which each would take as many steps as a
    whole one.
    """
    begin, length = (np.asarray(a) for a in (grid.since, grid.intervals.length))
    step = np.asarray(base.intervals.length)[interval_at(begin + length / 2, base)] / base.steps
    moved = length > 0
    return int(np.clip(np.ceil(length[moved] / step[moved] * (1 - 1e-9)).max(initial=1), 1, grid.steps))


def smooth_on(ssm: StateSpaceModel, rule: Rule, grids: SmoothingGrids, y: jax.Array, iterations: int,
              damping: float, settings: SiteSettings) -> SmootherResult:
    """The same on time grids, without checks; for compiled code."""
    grid = grids.marginals
    start = Moments(*ssm.initial())
    small = len(grid.observed) * grid.steps * ssm.state_dim**2 <= _MOST_KEPT
    about_points = bool(iterations) or isinstance(ssm.model.observation, ObservationFamily)
    with_steps = grids.where is not None and (small or about_points)
    passed, smoothed, found, scored, added = _smooth_intervals(ssm, rule, grid, y, start, iterations, damping, settings,
                                                               with_steps=with_steps)
    times = jnp.asarray(grids.times, float)
    if grids.joint is None or grids.where is None:
        at = jnp.asarray(grid.requested)
        mean, covariance = (a[at + 1] for a in smoothed.moments)
        joint = Joint(start, passed._replace(steps=None), at, None if added is None else covariance)
    else:
        points = None if found is None or grids.nodes is None else interpolated(found.points, grids.nodes)
        drawn, pieces, *_, added = _smooth_intervals(ssm, rule, grids.joint, y, start, iterations, damping, settings,
                                                     points)
        at = jnp.asarray(grids.joint.requested)
        joint = Joint(start, drawn._replace(steps=None), at, pieces.moments.covariance[at + 1])
        branches = Branches(grid, passed.predicted, passed.filtered, smoothed.moments, smoothed.adjoint)
        if passed.steps is not None:
            branches = branches._replace(
                steps=steps_to_end(ssm, grid, passed.steps),
                linearization_point=None if found is None else completed(ssm, rule, found.points.nodes))
        mean, covariance = dense_output(ssm, rule, branches, start, grids.where)
    if added is not None:
        covariance = covariance + added[at + 1]
    matrix, offset = jax.vmap(ssm.input_map)(times)
    observed = jnp.asarray(grid.observed)
    at_data = jax.tree_util.tree_map(lambda a: a[observed], passed._replace(steps=None))
    one_step_ahead, left_out, residual, converged = scored or (
        at_data.log_likelihood, smoothed.leave_one_out[observed], whitened_innovations(at_data, y), jnp.asarray(True))
    return SmootherResult(
        times, mean, covariance, matmul(matrix, mean[..., None])[..., 0] + offset, congruence(matrix, covariance),
        one_step_ahead, left_out, residual,
        jnp.asarray(jnp.nan) if found is None else found.change, converged, joint, (matrix, offset),
        ssm.model.state_names, ssm.model.force_names)


def _smooth_intervals(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, start: Moments, iterations: int,
                      damping: float, settings: SiteSettings, points: Points | None = None, with_steps: bool = False
                      ) -> tuple[Pass, Smoothed, Iterated | None, tuple | None, jax.Array | None]:
    """Smooth on one time grid; of a family also its one-step-ahead and leave-one-out terms, and its residuals.

    And what linear response adds to the covariances of the nodes; None where it is left out. About ``points``, where
    they are given, a model with Gaussian observations is linearised once, without iterations. Its integration steps
    are kept ``with_steps``.
    """
    if isinstance(ssm.model.observation, ObservationFamily):
        return _smooth_family(ssm, rule, grid, y, start, settings, ssm.model.observation, with_steps)
    found, prepared = None, preparation(ssm, rule, grid)
    if iterations and points is None:
        found = posterior_linearisation(ssm, rule, grid, y, start, iterations, damping, prepared)
        points = found.points
    passed = forward(ssm, rule, grid, y, start=start, linearization_point=points,
                     keep="steps" if with_steps else "all", prepared=prepared)
    return passed, backward(passed, start, grid), found, None, None


def _smooth_family(ssm: StateSpaceModel, rule: Rule, grid: TimeGrid, y: jax.Array, start: Moments,
                   settings: SiteSettings, family: ObservationFamily, with_steps: bool) -> tuple:
    found = site_evidence(ssm, rule, grid, y, FamilyTerms(family, y), settings, start,
                          keep="steps" if with_steps and not is_linear(ssm) else "all")
    smoothed = backward(found.passed, start, grid)
    assert smoothed.predictor is not None
    refined_sites = found.refined.found
    at = jax.tree_util.tree_map(lambda a: at_intervals(a, grid.observed), smoothed.predictor)
    ahead = assumed_density_filter(ssm, rule, grid, y, start)
    points, converged = found.refined.points, refined_sites.converged
    else_ahead = lambda a: jnp.where(  # noqa: E731
        converged, a, -jnp.inf if points is None else ahead.log_likelihood)
    scored = (else_ahead(ahead.log_likelihood), else_ahead(leave_one_out(at, refined_sites.sites, found.entries)),
              quantile_residuals(family, ahead.prediction, y), converged)
    iterated = None if points is None else Iterated(points, refined_sites.change)
    added = None
    if settings.method == "ep" and settings.linear_response and responds(ssm):
        added = response(found.passed, smoothed, start, grid, FamilyTerms(family, y), refined_sites, settings.power)
    return found.passed, smoothed, iterated, scored, added


_run_smoother = eqx.filter_jit(smooth_on)
